//! Which streams are parts of one geometry, and so share a lattice shift.

use super::OccluderStream;

/// The geometry of every stream, numbered from 0.
pub fn geometries_of(occluders: &[OccluderStream<'_>]) -> Vec<usize> {
    let geometries = occluders.iter().scan(0, |next, occluder| {
        *next += usize::from(*next == 0 || !occluder.continues);
        Some(*next - 1)
    });
    geometries.collect()
}

/// Gives all streams of a geometry the finest of their shifts, and 0 where one has copies that share bricks: points on those lie
/// on the finest lattice. `numbers` are the streams that `shifts` are of, `shared` the others. Returns the shift per geometry.
pub fn unite_shifts(
    shifts: &mut [u8],
    numbers: &[usize],
    shared: &[usize],
    geometries: Vec<usize>,
) -> Vec<u8> {
    let mut united = vec![u8::MAX; geometries.last().map_or(0, |&last| last + 1)];
    numbers.iter().zip(&*shifts).for_each(|(&number, &shift)| {
        let least = &mut united[geometries[number]];
        *least = shift.min(*least);
    });
    shared.iter().for_each(|&number| united[geometries[number]] = 0);
    shifts.iter_mut().zip(numbers).for_each(|(shift, &number)| *shift = united[geometries[number]]);
    united
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches points of a geometry that lie on another lattice than its vertices, which would shadow themselves.
    #[test]
    fn parts_of_a_geometry_share_a_shift() {
        // Geometries of one, three and two streams; the second and the last stream have copies that share bricks
        let geometries = vec![0, 1, 1, 1, 2, 2];
        let (numbers, shared) = ([0, 2, 3, 4], [1, 5]);
        let mut shifts = [3, 2, 1, 4];
        let united = unite_shifts(&mut shifts, &numbers, &shared, geometries.clone());
        assert_eq!((united, shifts), (vec![3, 0, 0], [3, 0, 0, 0]));
        let mut shifts = [3, 5, 2, 1, 4, 6];
        let united = unite_shifts(&mut shifts, &[0, 1, 2, 3, 4, 5], &[], geometries);
        assert_eq!((united, shifts), (vec![3, 1, 4], [3, 1, 1, 1, 4, 4]));
    }
}
