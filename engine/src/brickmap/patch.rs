//! Regular patches in the faces of a microgrid: rows of quads whose vertices are numbered in rows too.
//!
//! A microgrid is often one regular patch, or many small ones: the leaflets of a frond, the blades of a tuft. Leaves cut
//! from patches are compact and share their vertices.

use super::spill::Quantised;
use crate::brick::leaf::FACES_MAX;

/// A tile of fewer quads than this is pooled with others: a leaf of its own would be too empty.
const TILE_QUADS_MIN: usize = 6;

/// A regular patch of quads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patch {
    /// Its first face, upper left.
    pub first_face: usize,
    /// The first face's first vertex.
    pub first_vertex: usize,
    /// Quads across.
    pub columns: usize,
    /// Quads down.
    pub rows: usize,
}

/// A rectangle of quads in a patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// First column and row.
    pub at: [usize; 2],
    /// Columns and rows.
    pub size: [usize; 2],
}

impl Tile {
    /// Quads in it.
    pub fn quads(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// Whether it is worth a leaf of its own.
    pub fn is_full(&self) -> bool {
        self.quads() >= TILE_QUADS_MIN
    }
}

/// Finds the patches of a grid of quads; faces in none of them are given to `loose`.
pub fn find(grid: &Quantised, patches: &mut Vec<Patch>, mut loose: impl FnMut(usize)) {
    patches.clear();
    let faces = grid.arities.len();
    if grid.columns > 0 {
        let columns = usize::from(grid.columns);
        let rows = faces / columns;
        patches.push(Patch { first_face: 0, first_vertex: 0, columns, rows });
        return;
    }
    let mut face = 0;
    while face < faces {
        match patch_at(grid, face) {
            Some(patch) => {
                face += patch.columns * patch.rows;
                patches.push(patch);
            }
            None => {
                loose(face);
                face += 1;
            }
        }
    }
}

/// The patch that starts with a face of a grid of quads.
fn patch_at(grid: &Quantised, first_face: usize) -> Option<Patch> {
    let corners = grid.indices[4 * first_face..].first_chunk::<4>()?.map(usize::from);
    let first_vertex = corners[0];
    let down_first = corners[3] == first_vertex + 1;
    let wide = corners[if down_first { 1 } else { 3 }].checked_sub(first_vertex)?;
    let columns = wide.checked_sub(1).filter(|&columns| columns > 0)?;
    let matches = |k: usize, found: &[u8]| {
        let a = first_vertex + (k / columns) * wide + k % columns;
        let [b, d] = if down_first { [a + wide, a + 1] } else { [a + 1, a + wide] };
        [a, b, a + wide + 1, d] == [0, 1, 2, 3].map(|i| usize::from(found[i]))
    };
    let rest = grid.indices[4 * first_face..].chunks_exact(4).enumerate();
    let rows = rest.take_while(|(k, found)| matches(*k, found)).count() / columns;
    (rows > 0).then_some(Patch { first_face, first_vertex, columns, rows })
}

impl Patch {
    /// Vertices across.
    pub fn wide(&self) -> usize {
        self.columns + 1
    }

    /// Cuts the patch into tiles of up to eight quads, nearly square by the lengths of a quad's sides.
    pub fn tiles(&self, across: f32, down: f32, each: &mut dyn FnMut(Tile)) {
        let shapes = [[4, 2], [2, 4], [8, 1], [1, 8]];
        let cost = |shape: &[usize; 2]| {
            let mut cost = 0.0;
            self.cut(*shape, &mut |tile| {
                let half_perimeter = across * tile.size[0] as f32 + down * tile.size[1] as f32;
                // Quads that will share a leaf with strangers cost more
                let leaves = if tile.is_full() { 1.0 } else { 1.3 * tile.quads() as f32 / FACES_MAX as f32 };
                cost += leaves * half_perimeter;
            });
            cost
        };
        // A patch of one leaf needs no thought
        let best = if self.columns * self.rows <= FACES_MAX {
            [self.columns, self.rows]
        } else {
            let costs = shapes.map(|shape| cost(&shape));
            let best = (0..4).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).expect("there are four");
            shapes[best]
        };
        self.cut(best, each);
    }

    /// Cuts into tiles of a shape; a last strip that is lower has wider tiles.
    fn cut(&self, [columns, rows]: [usize; 2], each: &mut dyn FnMut(Tile)) {
        for row in (0..self.rows).step_by(rows) {
            let high = rows.min(self.rows - row);
            let across = columns.max(FACES_MAX / high).min(FACES_MAX / high);
            for column in (0..self.columns).step_by(across) {
                each(Tile { at: [column, row], size: [across.min(self.columns - column), high] });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(patches: &[(usize, usize, bool)]) -> Quantised {
        let mut grid = Quantised::default();
        let mut first = 0;
        for &(columns, rows, down_first) in patches {
            for face in 0..columns * rows {
                let a = first + face / columns * (columns + 1) + face % columns;
                let (b, d) = if down_first { (a + columns + 1, a + 1) } else { (a + 1, a + columns + 1) };
                grid.arities.push(4);
                grid.indices.extend([a, b, a + columns + 2, d].map(|i| i as u8));
            }
            first += (columns + 1) * (rows + 1);
        }
        grid
    }

    /// Catches faces that belong to no tile or to two, and tiles that are too large.
    #[test]
    fn tiles_cover_patches_once() {
        for (columns, rows) in
            [(1, 1), (2, 4), (4, 2), (15, 15), (14, 15), (1, 100), (127, 1), (3, 7), (5, 2)]
        {
            let patch = Patch { first_face: 0, first_vertex: 0, columns, rows };
            for (across, down) in [(1.0, 1.0), (1.0, 20.0), (20.0, 1.0)] {
                let mut seen = vec![0; columns * rows];
                patch.tiles(across, down, &mut |tile| {
                    assert!(tile.quads() <= FACES_MAX);
                    for row in tile.at[1]..tile.at[1] + tile.size[1] {
                        for column in tile.at[0]..tile.at[0] + tile.size[0] {
                            seen[row * columns + column] += 1;
                        }
                    }
                });
                assert!(seen.iter().all(|&count| count == 1), "{columns} x {rows}");
            }
        }
    }

    /// Catches patches that run into each other, and quads that are taken for a patch they are not.
    #[test]
    fn patches_are_found_one_after_the_other() {
        let (mut patches, mut loose) = (Vec::new(), Vec::new());
        let mut grid = grid(&[(2, 4, false), (2, 4, false), (1, 4, true), (5, 3, false)]);
        grid.arities.push(4);
        grid.indices.extend([1, 9, 30, 4]);
        find(&grid, &mut patches, |face| loose.push(face));
        let found: Vec<_> = patches.iter().map(|p| (p.first_face, p.columns, p.rows)).collect();
        assert_eq!(found, [(0, 2, 4), (8, 2, 4), (16, 1, 4), (20, 5, 3)]);
        assert_eq!(loose, [35]);
    }
}
