//! What a tile's vertices are expected to be: bilinear between its four corners, so that only what differs is stored.

/// Vertices of a predicted tile at most: they fill a vector.
pub const PREDICTED_VERTICES_MAX: usize = 16;

/// The corners of a tile, whose vertices are `stride` to a row: the first and the last of the first row, then of the last.
#[inline(always)]
pub fn corners(stride: usize, vertices: usize) -> [usize; 4] {
    [0, stride - 1, vertices - stride, vertices - 1]
}

/// Where among the vertices that are no corners a vertex stands; none if it is a corner.
#[inline(always)]
pub fn place(vertex: usize, corners: [usize; 4]) -> Option<usize> {
    let before = corners.iter().filter(|&&corner| corner < vertex).count();
    (!corners.contains(&vertex)).then(|| vertex - before)
}

/// How far a vertex lies across and down, and both multiplied, in 256ths.
#[inline(always)]
pub fn weights(vertex: usize, columns: usize, rows: usize) -> [i32; 3] {
    let (across, down) = (vertex % (columns + 1) * (256 / columns), vertex / (columns + 1) * (256 / rows));
    [across as i32, down as i32, (across * down >> 8) as i32]
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
