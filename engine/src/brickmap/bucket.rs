//! Bucket counting: a sparse grid of cells, cut into partitions (paper, section 4.1).
//!
//! Every microgrid belongs to the cell of its middle vertex. Bounds need not be known: cells have the size of a power of
//! two, and when the table of occupied cells is half full, cells double their size. A partition is a set of cells, by
//! halving the longest axis of an implicit k-d tree until few enough micropolygons are left. It plays the part of the
//! paper's chunk, but coarser: chunks of 64 KB were measured to cost a quarter of the tree's quality.

use glam::{DVec3, I64Vec3};

use crate::brick::lattice::exp2;

/// Cells that a table holds before they are merged: 12 MB with the free slots.
pub const CELLS_MAX: usize = 1 << 17;

/// Cells are so large that coordinates stay below this: neighbours are distinct far from the origin too.
const KEY_MAX: f64 = (1_u64 << 48) as f64;

/// An occupied cell.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Cell {
    key: I64Vec3,
    /// Micropolygons; 0 marks a free slot.
    count: u64,
    partition: u32,
}

const FREE: Cell = Cell { key: I64Vec3::ZERO, count: 0, partition: u32::MAX };

/// Counts of micropolygons in a sparse grid.
#[derive(Debug)]
pub struct Cells {
    /// Twice as many slots as cells, a power of two.
    slots: Vec<Cell>,
    occupied: usize,
    /// A cell is `2^exponent` units wide.
    exponent: i32,
}

impl Cells {
    /// A table for `cells_max` cells (a power of two), `2^exponent` units wide at first.
    pub fn new(exponent: i32, cells_max: usize) -> Self {
        Self { slots: vec![FREE; 2 * cells_max], occupied: 0, exponent }
    }

    /// Counts `count` micropolygons at a position, which is finite and within 1e100.
    pub fn add(&mut self, position: DVec3, count: u64) {
        while (position * exp2(-self.exponent)).abs().max_element() >= KEY_MAX {
            self.coarsen();
        }
        self.insert(self.key(position), count.max(1));
        while self.occupied > self.slots.len() / 2 {
            self.coarsen();
        }
    }

    /// Cuts the cells into partitions of at most `micropolygons_max` each, where cells allow it, numbered along the k-d
    /// tree. Returns their counts.
    pub fn partition(&mut self, micropolygons_max: u64) -> Vec<u64> {
        let occupied = |&slot: &u32| self.slots[slot as usize].count > 0;
        let mut order: Vec<u32> = (0..self.slots.len() as u32).filter(occupied).collect();
        let mut counts = Vec::new();
        // An explicit stack of ranges, right halves below left ones
        let mut stack = Vec::from([0..order.len()]);
        while let Some(range) = stack.pop() {
            let cells = &mut order[range.clone()];
            let total: u64 = cells.iter().map(|&slot| self.slots[slot as usize].count).sum();
            let keys = || cells.iter().map(|&slot| self.slots[slot as usize].key);
            let (low, high) = keys().fold((I64Vec3::MAX, I64Vec3::MIN), |(l, h), k| (l.min(k), h.max(k)));
            if total <= micropolygons_max || low == high {
                for &slot in cells.iter() {
                    self.slots[slot as usize].partition = counts.len() as u32;
                }
                if total > 0 {
                    counts.push(total);
                }
                continue;
            }
            let axis = longest_axis((high - low).to_array());
            let middle = low[axis] + (high[axis] - low[axis]) / 2;
            cells.sort_by_key(|&slot| self.slots[slot as usize].key[axis] > middle);
            let left = cells.partition_point(|&slot| self.slots[slot as usize].key[axis] <= middle);
            stack.push(range.start + left..range.end);
            stack.push(range.start..range.start + left);
        }
        counts
    }

    /// The partition of a position that was counted.
    pub fn partition_of(&self, position: DVec3) -> Option<usize> {
        let cell = self.slots[self.slot(self.key(position))];
        (cell.count > 0).then_some(cell.partition as usize)
    }

    fn key(&self, position: DVec3) -> I64Vec3 {
        (position * exp2(-self.exponent)).floor().as_i64vec3()
    }

    /// The slot that holds `key`, or the free one where it belongs.
    fn slot(&self, key: I64Vec3) -> usize {
        let mixed = key
            .to_array()
            .iter()
            .fold(0_u64, |hash, &k| (hash ^ k as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29));
        let mask = self.slots.len() - 1;
        let mut slot = (mixed >> 20) as usize & mask;
        while self.slots[slot].count > 0 && self.slots[slot].key != key {
            slot = (slot + 1) & mask;
        }
        slot
    }

    fn insert(&mut self, key: I64Vec3, count: u64) {
        let slot = self.slot(key);
        let cell = &mut self.slots[slot];
        self.occupied += usize::from(cell.count == 0);
        *cell = Cell { key, count: cell.count + count, partition: u32::MAX };
    }

    /// Doubles the cells' size.
    fn coarsen(&mut self) {
        self.exponent += 1;
        if self.occupied == 0 {
            return;
        }
        let free = vec![FREE; self.slots.len()];
        let old = std::mem::replace(&mut self.slots, free);
        self.occupied = 0;
        old.into_iter().filter(|cell| cell.count > 0).for_each(|cell| self.insert(cell.key >> 1, cell.count));
    }
}

/// The axis of the largest of three numbers, the first of equals.
pub fn longest_axis<T: PartialOrd>([x, y, z]: [T; 3]) -> usize {
    if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::hash::{hash32, unit_f32};

    /// Catches a micropolygon that gets lost or is counted twice, also when cells have been merged many times.
    #[test]
    fn partitions_hold_everything_once() {
        let points: Vec<DVec3> = (0..400_000_u32)
            .map(|i| {
                DVec3::from_array([0, 1, 2].map(|axis| f64::from(unit_f32(hash32(3 * i + axis))) * 1000.0))
            })
            .collect();
        let mut cells = Cells::new(-6, CELLS_MAX);
        points.iter().for_each(|&point| cells.add(point, 3));
        let counts = cells.partition(50_000);
        assert_eq!(counts.iter().sum::<u64>(), 1_200_000);
        assert!(counts.iter().all(|&count| count <= 50_000) && counts.len() < 80, "{}", counts.len());
        let mut found = vec![0; counts.len()];
        points.iter().for_each(|&point| found[cells.partition_of(point).unwrap()] += 3);
        assert_eq!(found, counts);
    }

    /// Catches cells whose numbers overflow far away, so that a position is not found again.
    #[test]
    fn far_positions_are_found_again() {
        let mut cells = Cells::new(-30, 64);
        let points = [1e-9, 1.0, -3e7, 1e12, -1e25, 1e99].map(|x| DVec3::new(x, -x, 1.0));
        points.iter().for_each(|&point| cells.add(point, 1));
        cells.partition(1);
        assert!(points.iter().all(|&point| cells.partition_of(point).is_some()));
    }
}
