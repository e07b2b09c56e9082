//! What a tile's vertices are expected to be: bilinear between its four corners, so that only what differs is stored.

use super::FACES_MAX;

/// Vertices of a predicted tile at most: they fill a vector.
pub const PREDICTED_VERTICES_MAX: usize = 16;

/// The corners of a tile, whose vertices are `stride` to a row: the first and the last of the first row, then of the last.
#[inline(always)]
pub const fn corners(stride: usize, vertices: usize) -> [usize; 4] {
    [0, stride - 1, vertices - stride, vertices - 1]
}

/// Where among the vertices that are no corners a vertex stands; none if it is a corner.
#[inline(always)]
pub fn place(vertex: usize, corners: [usize; 4]) -> Option<usize> {
    let (place, is_corner) = stands(vertex, corners);
    (!is_corner).then_some(place)
}

/// Where a vertex stands among its like, and whether it is a corner.
#[inline(always)]
const fn stands(vertex: usize, corners: [usize; 4]) -> (usize, bool) {
    let (mut before, mut is_corner, mut i) = (0, false, 0);
    while i < 4 {
        before += (corners[i] < vertex) as usize;
        is_corner |= corners[i] == vertex;
        i += 1;
    }
    (if is_corner { before } else { vertex - before }, is_corner)
}

/// How far a vertex lies across and down, and both multiplied, in 256ths.
#[inline(always)]
pub const fn weights(vertex: usize, columns: usize, rows: usize) -> [i32; 3] {
    let (across, down) = (vertex % (columns + 1) * (256 / columns), vertex / (columns + 1) * (256 / rows));
    [across as i32, down as i32, (across * down >> 8) as i32]
}

/// [`place`] and [`weights`] of a tile's first vertices; a corner's place is that among the corners.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Lanes {
    /// Places.
    pub places: [u8; PREDICTED_VERTICES_MAX],
    /// Weights, one kind after the other.
    pub weights: [[u16; PREDICTED_VERTICES_MAX]; 3],
}

/// Lanes by columns - 1 and rows - 1.
pub static LANES: [[Lanes; FACES_MAX]; FACES_MAX] = all_lanes();

const fn all_lanes() -> [[Lanes; FACES_MAX]; FACES_MAX] {
    let none = Lanes { places: [0; PREDICTED_VERTICES_MAX], weights: [[0; PREDICTED_VERTICES_MAX]; 3] };
    let mut all = [[none; FACES_MAX]; FACES_MAX];
    let mut shape = 0;
    while shape < FACES_MAX * FACES_MAX {
        let (columns, rows) = (shape / FACES_MAX + 1, shape % FACES_MAX + 1);
        let vertices = (columns + 1) * (rows + 1);
        let corners = corners(columns + 1, vertices);
        let lanes = &mut all[columns - 1][rows - 1];
        let mut vertex = 0;
        while vertex < vertices && vertex < PREDICTED_VERTICES_MAX {
            let (place, _) = stands(vertex, corners);
            lanes.places[vertex] = place as u8;
            let [across, down, both] = weights(vertex, columns, rows);
            lanes.weights[0][vertex] = across as u16;
            lanes.weights[1][vertex] = down as u16;
            lanes.weights[2][vertex] = both as u16;
            vertex += 1;
        }
        shape += 1;
    }
    all
}

/// A coordinate by those of the corners. It wraps around, everywhere in the same way.
#[inline(always)]
pub fn predict([first, right, below, last]: [i32; 4], [across, down, both]: [i32; 3]) -> i32 {
    let (width, height) = (right.wrapping_sub(first), below.wrapping_sub(first));
    let twist = last.wrapping_sub(right).wrapping_sub(height);
    let sum = across
        .wrapping_mul(width)
        .wrapping_add(down.wrapping_mul(height))
        .wrapping_add(both.wrapping_mul(twist));
    first.wrapping_add(sum >> 8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches weights or corners that are not those of a plane, where nothing is left to store.
    #[test]
    fn a_plane_is_predicted_to_a_few_steps() {
        for (columns, rows) in [(2, 4), (4, 2), (7, 1), (3, 2), (2, 2), (1, 6)] {
            let at = |vertex: usize| {
                let (c, r) = ((vertex % (columns + 1)) as i32, (vertex / (columns + 1)) as i32);
                1000 + 84 * c - 60 * r
            };
            let vertices = (columns + 1) * (rows + 1);
            let corners = corners(columns + 1, vertices);
            let mut places = Vec::new();
            for vertex in 0..vertices {
                let predicted = predict(corners.map(at), weights(vertex, columns, rows));
                places.extend(place(vertex, corners));
                let is_corner = corners.contains(&vertex);
                assert!(is_corner || (predicted - at(vertex)).abs() <= 8, "{columns} {rows} {vertex}");
            }
            assert_eq!(places, (0..vertices - 4).collect::<Vec<_>>());
        }
    }
}
