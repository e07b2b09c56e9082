//! Splitting a node of the k-d tree on disk: exact selection by counting, then one pass that scatters.
//!
//! Points have a total order along an axis: by coordinate, equal coordinates by index. Both make one 128-bit key, so
//! that keys are unique and the point of a given rank is exactly one. Counting keys in up to 65,536 cells and again
//! inside the cell that holds the rank finds it in few passes (mostly one), whatever the distribution: a multi-pass
//! radix selection (J. I. Munro and M. S. Paterson, "Selection and Sorting with Limited Storage", 1980).

use std::cmp::Ordering;

use super::Point;
use super::scratch::{PointFile, PointWriter};
use crate::math::Bounds;
use crate::{Error, ErrorKind, Result};

/// Bits of a counter's number: 65,536 counters, 512 KiB.
const CELL_BITS: u32 = 16;

/// The axis to split a box: its longest, the first of equals.
pub fn longest_axis(bounds: &Bounds) -> usize {
    let size = bounds.size().to_array();
    (1..3).fold(0, |best, axis| if size[axis] > size[best] { axis } else { best })
}

/// Compares two points along an axis; points of one stream are never equal.
pub fn compare(a: &Point, b: &Point, axis: usize) -> Ordering {
    a.position[axis].total_cmp(&b.position[axis]).then(a.index.cmp(&b.index))
}

/// The place of a point in the order of [`compare`], as a number.
fn key(coordinate: f64, index: u64) -> u128 {
    let bits = coordinate.to_bits();
    // Negative numbers are ordered backwards by magnitude, positive ones come after all of them.
    let ordered = if bits >> 63 == 1 { !bits } else { bits | 1 << 63 };
    u128::from(ordered) << 64 | u128::from(index)
}

/// A range of keys, both ends included, that holds the wanted rank.
struct Cell {
    low: u128,
    high: u128,
    /// Points with smaller keys.
    below: u64,
    /// Points inside.
    inside: u64,
}

/// Splits `node` at `rank` of its longest axis: the `rank` smallest points go to `left`, the others to `right`.
///
/// `held` is memory for up to `held_max` points, at least one; it is empty before and after. The sets do not depend
/// on its size, and the order of the points in the files matters to nobody.
///
/// # Errors
/// When the disk is full or refuses.
pub fn split_on_disk(
    mut node: PointFile,
    rank: u64,
    held: &mut Vec<Point>,
    held_max: usize,
    mut left: PointWriter,
    mut right: PointWriter,
) -> Result<(PointFile, PointFile)> {
    let axis = longest_axis(&node.bounds);
    let cell = find_cell(&mut node, axis, rank, held_max as u64)?;

    // Scatter; points of the cell that holds the rank wait in memory
    held.clear();
    node.for_each(|point| {
        let key = key(point.position[axis], point.index);
        if key < cell.low {
            left.push(point)
        } else if key > cell.high {
            right.push(point)
        } else {
            held.push(*point);
            Ok(())
        }
    })?;
    drop(node);

    // Split the cell itself
    let middle = (rank - cell.below) as usize;
    if middle > 0 && middle < held.len() {
        held.select_nth_unstable_by(middle, |a, b| compare(a, b, axis));
    }
    held[..middle].iter().try_for_each(|point| left.push(point))?;
    held[middle..].iter().try_for_each(|point| right.push(point))?;
    held.clear();
    Ok((left.finish()?, right.finish()?))
}

/// Narrows the range of keys around `rank` until it holds at most `inside_max` points. At most eight passes, since
/// every one takes 16 of the 128 bits.
fn find_cell(node: &mut PointFile, axis: usize, rank: u64, inside_max: u64) -> Result<Cell> {
    debug_assert!(rank < node.points && inside_max > 0);
    let mut cell = Cell {
        low: key(node.bounds.min[axis], 0),
        high: key(node.bounds.max[axis], u64::MAX),
        below: 0,
        inside: node.points,
    };
    let mut counters = Vec::new();
    while cell.inside > inside_max {
        if cell.low == cell.high {
            return Err(Error::new(ErrorKind::Invalid, "two points have one index"));
        }
        let shift = (128 - (cell.high - cell.low).leading_zeros()).saturating_sub(CELL_BITS);
        counters.clear();
        counters.resize(1 << CELL_BITS, 0u64);
        node.for_each(|point| {
            let key = key(point.position[axis], point.index);
            if (cell.low..=cell.high).contains(&key) {
                counters[((key - cell.low) >> shift) as usize] += 1;
            }
            Ok(())
        })?;
        let (mut counter, mut below) = (0, cell.below);
        while below + counters[counter] <= rank {
            below += counters[counter];
            counter += 1;
        }
        let low = cell.low + ((counter as u128) << shift);
        let high = cell.high.min(low + ((1 << shift) - 1));
        cell = Cell { low, high, below, inside: counters[counter] };
    }
    Ok(cell)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec3, Vec3};
    use proptest::prelude::*;

    fn check(coordinates: &[f64], rank: usize, held_max: usize) {
        let folder = tempfile::tempdir().expect("a folder");
        let mut node = PointWriter::create(folder.path().join("node.tmp")).expect("a file");
        let mut points: Vec<Point> = coordinates
            .iter()
            .enumerate()
            .map(|(i, &x)| Point {
                index: 7 * i as u64,
                position: DVec3::new(0.0, x, 0.0),
                normal: Vec3::ZERO,
            })
            .collect();
        points.iter().for_each(|point| node.push(point).expect("written"));
        let writer = |name: &str| PointWriter::create(folder.path().join(name)).expect("a file");
        let (mut left, mut right) = split_on_disk(
            node.finish().expect("written"),
            rank as u64,
            &mut Vec::new(),
            held_max,
            writer("left.tmp"),
            writer("right.tmp"),
        )
        .expect("split");

        points.sort_by(|a, b| compare(a, b, 1));
        for (file, expected) in [(&mut left, &points[..rank]), (&mut right, &points[rank..])] {
            let mut got = Vec::new();
            file.for_each(|point| {
                got.push(*point);
                Ok(())
            })
            .expect("read");
            got.sort_by(|a, b| compare(a, b, 1));
            assert_eq!(got, expected);
            let mut bounds = Bounds::EMPTY;
            expected.iter().for_each(|point| bounds.add(point.position));
            assert_eq!(file.bounds, bounds);
        }
    }

    /// Catches an order of keys that is not the order of numbers, and ties that are not decided by index.
    #[test]
    fn keys_are_ordered_like_numbers() {
        let numbers = [f64::MIN, -1.0, -5e-324, 0.0, 5e-324, 0.5, 1.0, 1.0 + f64::EPSILON, f64::MAX];
        for pair in numbers.windows(2) {
            assert!(key(pair[0], u64::MAX) < key(pair[1], 0), "{} and {}", pair[0], pair[1]);
        }
        assert!(key(1.0, 3) < key(1.0, 4));
    }

    /// Catches a selection that needs distinct coordinates: here a thousand points share one, and the memory holds one.
    #[test]
    fn equal_coordinates_are_split_by_index() {
        check(&[2.5; 1000], 333, 1);
        let mut mostly = vec![1.0; 1000];
        mostly.extend([-1.0, 0.0, 2.0, 1e300, -1e300]);
        check(&mostly, 500, 3);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Catches a point on the wrong side, lost or doubled, and bounds that do not fit, for any coordinates.
        #[test]
        fn the_smaller_points_go_left(
            coordinates in prop::collection::vec(prop_oneof![-1e3..1e3, -1e-3..1e-3, Just(0.0), Just(7.0)], 2..300),
            rank in any::<prop::sample::Index>(),
            held_max in 1usize..50,
        ) {
            let rank = 1 + rank.index(coordinates.len() - 1);
            check(&coordinates, rank, held_max);
        }
    }
}
