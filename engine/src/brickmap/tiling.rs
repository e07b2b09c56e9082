//! Tilings: how to cut a block of quads into tiles that are full and nearly square.
//!
//! A dynamic program over all ways to cut a block in two, again and again (guillotine cuts). Blocks come in few sizes and
//! shapes, so the ways found are kept.

use std::collections::HashMap;
use std::ops::Range;

use crate::brick::leaf::FACES_MAX;

/// A tile of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// First column, first row, columns, rows.
    place: [u8; 4],
}

impl Tile {
    /// Its columns.
    pub fn columns(&self) -> Range<usize> {
        let [first, _, count, _] = self.place.map(usize::from);
        first..first + count
    }

    /// Its rows.
    pub fn rows(&self) -> Range<usize> {
        let [_, first, _, count] = self.place.map(usize::from);
        first..first + count
    }
}

/// Tilings by columns, rows, and how much wider than high a cell is in halves of an octave.
#[derive(Debug, Default)]
pub struct Tilings {
    known: HashMap<(u8, u8, i8), Box<[Tile]>>,
}

impl Tilings {
    /// The tiles of a block of `columns` by `rows` quads whose cells have the given width and height.
    pub fn tiles(&mut self, columns: usize, rows: usize, [width, height]: [f32; 2]) -> &[Tile] {
        let shape = (2.0 * (width / height).log2()).clamp(-8.0, 8.0).round() as i8;
        self.known
            .entry((columns as u8, rows as u8, shape))
            .or_insert_with(|| tiling(columns, rows, 2.0_f32.powf(0.5 * f32::from(shape))))
    }
}

/// The cheapest tiling for cells `aspect` times as wide as high.
fn tiling(columns: usize, rows: usize, aspect: f32) -> Box<[Tile]> {
    // Cost of the best tiling of every smaller block, and where its first cut is: 0 for none, columns, then rows
    let mut table = vec![(0.0_f32, 0_usize); (columns + 1) * (rows + 1)];
    let at = |c: usize, r: usize| r * (columns + 1) + c;
    for r in 1..=rows {
        for c in 1..=columns {
            let whole = if c * r <= FACES_MAX { (tile_cost(c, r, aspect), 0) } else { (f32::INFINITY, 0) };
            let across = (1..=c / 2).map(|cut| (table[at(cut, r)].0 + table[at(c - cut, r)].0, cut));
            let down = (1..=r / 2).map(|cut| (table[at(c, cut)].0 + table[at(c, r - cut)].0, columns + cut));
            table[at(c, r)] =
                across.chain(down).fold(whole, |best, next| if next.0 < best.0 { next } else { best });
        }
    }
    let (mut tiles, mut stack) = (Vec::new(), vec![[0, 0, columns, rows]]);
    while let Some([column, row, c, r]) = stack.pop() {
        let cut = table[at(c, r)].1;
        if cut == 0 {
            tiles.push(Tile { place: [column, row, c, r].map(|n| n as u8) });
        } else if cut <= columns {
            stack.extend([[column + cut, row, c - cut, r], [column, row, cut, r]]);
        } else {
            let cut = cut - columns;
            stack.extend([[column, row + cut, c, r - cut], [column, row, c, cut]]);
        }
    }
    tiles.into_boxed_slice()
}

/// What a leaf of the given quads costs, in cells: the box of a sheet has the sheet's area and, at an angle, that of its
/// sides squared; the nodes above a leaf cost about as much as a full leaf.
fn tile_cost(columns: usize, rows: usize, aspect: f32) -> f32 {
    let (width, height) = (columns as f32 * aspect.sqrt(), rows as f32 / aspect.sqrt());
    width * height + 0.25 * (width * width + height * height) + FACES_MAX as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches quads that are in no tile or in two, tiles that are too large, and tilings that leave tiles half empty.
    #[test]
    fn tiles_cover_a_block_once_and_are_full() {
        let mut tilings = Tilings::default();
        for (columns, rows) in [(15, 15), (1, 9), (4, 8), (3, 3), (2, 12), (7, 1), (5, 5), (254, 1), (16, 8)]
        {
            for cell in [[1.0, 1.0], [5.0, 1.0], [1.0, 100.0]] {
                let mut covered = vec![0; columns * rows];
                let tiles = tilings.tiles(columns, rows, cell);
                for tile in tiles {
                    assert!(tile.columns().len() * tile.rows().len() <= FACES_MAX);
                    for (column, row) in tile.columns().flat_map(|c| tile.rows().map(move |r| (c, r))) {
                        covered[row * columns + column] += 1;
                    }
                }
                assert!(covered.iter().all(|&n| n == 1), "{columns} x {rows}");
                // Long cells may be worth a leaf of a few
                let fill = (columns * rows) as f64 / tiles.len() as f64;
                let least = if cell[0] == cell[1] { 4.5 } else { 1.5 };
                assert!(fill >= least, "{columns} x {rows}: {fill} quads a tile");
            }
        }
    }
}
