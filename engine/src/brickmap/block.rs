//! Blocks: runs of a grid's faces that lie in rows.

use glam::IVec3;

use super::spill::Quantised;

/// Faces of a grid one after the other: quads in rows over vertices in rows, or a single face of any kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// First face.
    pub face: usize,
    /// Where the first face's indices start.
    pub corner: usize,
    /// First vertex.
    pub vertex: usize,
    /// Vertices from one row to the next.
    pub stride: usize,
    /// Quads across.
    pub columns: usize,
    /// Rows of quads.
    pub rows: usize,
    /// Faces from one row to the next.
    pub face_stride: usize,
}

impl Block {
    /// Its faces. They follow one another unless it is a part of a block.
    pub fn faces(&self) -> usize {
        self.columns * self.rows
    }

    /// A face by its place.
    pub fn face_at(&self, column: usize, row: usize) -> usize {
        self.face + row * self.face_stride + column
    }

    /// Where the indices of a face of this block start.
    pub fn corner_of(&self, face: usize) -> usize {
        self.corner + 4 * (face - self.face)
    }

    /// A part of it.
    pub fn part(&self, columns: std::ops::Range<usize>, rows: std::ops::Range<usize>) -> Self {
        let skipped = rows.start * self.face_stride + columns.start;
        Self {
            face: self.face + skipped,
            corner: self.corner + 4 * skipped,
            vertex: self.vertex + rows.start * self.stride + columns.start,
            columns: columns.len(),
            rows: rows.len(),
            ..*self
        }
    }

    /// The lengths of a cell across and down, measured in its middle.
    pub fn cell(&self, vertices: &[IVec3]) -> [f32; 2] {
        let first = self.vertex + (self.rows / 2) * self.stride + self.columns / 2;
        let at = |vertex: usize| vertices[vertex].as_vec3();
        // The middle vertex has a neighbour before it, except in a single row or column
        let before = |step: usize, is_single: bool| {
            at(first).distance(at(if is_single { first + step } else { first - step }))
        };
        [before(1, self.columns == 1).max(1.0), before(self.stride, self.rows == 1).max(1.0)]
    }
}

/// Finds the blocks of a grid; every face is in one.
pub fn blocks(grid: &Quantised, out: &mut Vec<Block>) {
    out.clear();
    let faces = grid.arities.len();
    let columns = usize::from(grid.columns);
    if let Some(rows) = faces.checked_div(columns) {
        let stride = columns + 1;
        out.push(Block { face: 0, corner: 0, vertex: 0, stride, columns, rows, face_stride: columns });
        return;
    }
    let (mut face, mut corner) = (0, 0);
    while face < faces {
        let block = first_block(grid, face, corner);
        corner += block.faces() * usize::from(grid.arities[face]);
        face += block.faces();
        out.push(block);
    }
}

/// The block that starts with a face.
fn first_block(grid: &Quantised, face: usize, corner: usize) -> Block {
    let mut block = Block { face, corner, vertex: 0, stride: 0, columns: 1, rows: 1, face_stride: 1 };
    let Some((vertex, stride, across_first)) = quad(grid, face, corner) else { return block };
    let fits = |n: usize, at: usize| quad(grid, face + n, corner + 4 * n) == Some((at, stride, across_first));
    (block.vertex, block.stride) = (vertex, stride);
    while fits(block.columns, vertex + block.columns) {
        block.columns += 1;
    }
    block.face_stride = block.columns;
    let row_fits = |row: usize| {
        (0..block.columns).all(|column| fits(row * block.columns + column, vertex + row * stride + column))
    };
    while row_fits(block.rows) {
        block.rows += 1;
    }
    block
}

/// The first vertex of a face that is a quad over two rows of vertices, the distance of the rows, and whether its second
/// vertex is in the first row.
fn quad(grid: &Quantised, face: usize, corner: usize) -> Option<(usize, usize, bool)> {
    if grid.arities.get(face) != Some(&4) {
        return None;
    }
    let [a, b, c, d] = [0, 1, 2, 3].map(|i| usize::from(grid.indices[corner + i]));
    let across_first = b == a + 1;
    let below = if across_first { d } else { b };
    let next = if across_first { b } else { d };
    (next == a + 1 && c == below + 1 && below > next).then(|| (a, below - a, across_first))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(quads: &[[u8; 4]]) -> Quantised {
        let mut grid = Quantised { vertices: vec![IVec3::ZERO; 256], ..Quantised::default() };
        for quad in quads {
            grid.arities.push(4);
            grid.indices.extend(quad);
        }
        grid
    }

    /// Catches rows that are missed, faces that are lost, and quads of another diagonal that are taken for a row's.
    #[test]
    fn rows_are_found() {
        let row = |a: u8, wide: u8| [a, a + 1, a + wide + 1, a + wide];
        let turned = |a: u8, wide: u8| [a + 1, a + wide + 1, a + wide, a];
        let quads = [
            row(0, 4),
            row(1, 4),
            row(2, 4),
            row(4, 4),
            row(5, 4),
            row(6, 4),
            row(20, 3),
            row(21, 3),
            row(23, 3),
            turned(40, 3),
            turned(41, 3),
        ];
        let mut found = Vec::new();
        blocks(&grid(&quads), &mut found);
        let shapes: Vec<_> = found.iter().map(|b| (b.face, b.vertex, b.columns, b.rows)).collect();
        assert_eq!(shapes[..2], [(0, 0, 3, 2), (6, 20, 2, 1)]);
        assert_eq!(found.iter().map(Block::faces).sum::<usize>(), quads.len());
        assert!(found[2..].iter().all(|block| block.faces() == 1));
    }
}
