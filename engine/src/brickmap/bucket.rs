//! Pass 1: count micropolygons in a sparse grid of cells, and cut the grid into partitions (paper, section 4.1).
//!
//! Every microgrid belongs to the cell of its middle vertex. Bounds need not be known: cells have the size of a power of
//! two, and when the table of occupied cells is half full, cells double their size. A partition is a set of cells, by
//! halving the longest axis of an implicit k-d tree until few enough micropolygons are left. It plays the part of the
//! paper's chunk, but coarser: chunks of 64 KB were measured to cost a quarter of the tree's quality.

use glam::{DVec3, I64Vec3};

/// Cells that a table holds before they are merged.
const CELLS_MAX: usize = 1 << 17;
/// Slots of the table: twice as many.
const SLOTS: usize = 2 * CELLS_MAX;

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
    slots: Vec<Cell>,
    occupied: usize,
    /// A cell is `2^exponent` units wide.
    exponent: i32,
}

impl Cells {
    /// No cells yet; they start `2^exponent` units wide.
    pub fn new(exponent: i32) -> Self {
        Self { slots: vec![FREE; SLOTS], occupied: 0, exponent }
    }

    /// Counts `count` micropolygons at a position.
    pub fn add(&mut self, position: DVec3, count: u64) {
        let key = self.key(position);
        self.insert(key, count.max(1));
        while self.occupied > CELLS_MAX {
            self.coarsen();
        }
    }

    /// Adds what another table has counted. The cells come out as if one table had counted everything.
    pub fn merge(&mut self, mut other: Self) {
        while self.exponent < other.exponent {
            self.coarsen();
        }
        while other.exponent < self.exponent {
            other.coarsen();
        }
        // A sum of two tables fits the slots, since each is at most half full
        other.slots.iter().filter(|cell| cell.count > 0).for_each(|cell| self.insert(cell.key, cell.count));
        while self.occupied > CELLS_MAX {
            self.coarsen();
        }
    }

    /// Cuts the cells into partitions of at most `micropolygons_max` each, where cells allow it, numbered along the k-d
    /// tree. Returns their counts.
    pub fn partition(&mut self, micropolygons_max: u64) -> Vec<u64> {
        let mut order: Vec<u32> =
            (0..self.slots.len() as u32).filter(|&slot| self.slots[slot as usize].count > 0).collect();
        order.sort_unstable_by_key(|&slot| self.slots[slot as usize].key.to_array());
        let mut counts = Vec::new();
        // An explicit stack of ranges, right halves below left ones
        let mut stack = vec![0..order.len()];
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
            let size = high - low;
            let axis = if size.x >= size.y.max(size.z) {
                0
            } else if size.y >= size.z {
                1
            } else {
                2
            };
            let middle = low[axis] + size[axis] / 2;
            cells.sort_by_key(|&slot| self.slots[slot as usize].key[axis] > middle);
            let left = cells.partition_point(|&slot| self.slots[slot as usize].key[axis] <= middle);
            stack.push(range.start + left..range.end);
            stack.push(range.start..range.start + left);
        }
        counts
    }

    /// Gives back the memory of slots that are not needed; nothing can be counted any more.
    pub fn shrink(&mut self) {
        let slots = vec![FREE; (2 * self.occupied).next_power_of_two()];
        let old = std::mem::replace(&mut self.slots, slots);
        for cell in old.into_iter().filter(|cell| cell.count > 0) {
            let slot = self.slot(cell.key);
            self.slots[slot] = cell;
        }
    }

    /// Bytes in memory.
    pub fn memory_bytes(&self) -> u64 {
        size_of_val(&self.slots[..]) as u64
    }

    /// The partition of a position that was counted.
    pub fn partition_of(&self, position: DVec3) -> Option<usize> {
        let cell = self.slots[self.slot(self.key(position))];
        (cell.count > 0).then_some(cell.partition as usize)
    }

    fn key(&self, position: DVec3) -> I64Vec3 {
        (position * crate::brick::lattice::exp2(-self.exponent)).floor().as_i64vec3()
    }

    /// The slot that holds `key`, or the free one where it belongs.
    fn slot(&self, key: I64Vec3) -> usize {
        let mixed = key
            .to_array()
            .iter()
            .fold(0_u64, |hash, &k| (hash ^ k as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29));
        let mut slot = (mixed >> 20) as usize % self.slots.len();
        while self.slots[slot].count > 0 && self.slots[slot].key != key {
            slot = (slot + 1) % self.slots.len();
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
        let old = std::mem::replace(&mut self.slots, vec![FREE; SLOTS]);
        (self.occupied, self.exponent) = (0, self.exponent + 1);
        old.into_iter().filter(|cell| cell.count > 0).for_each(|cell| self.insert(cell.key >> 1, cell.count));
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
        let mut cells = Cells::new(-6);
        points.iter().for_each(|&point| cells.add(point, 3));
        // The same by two tables of very different shares
        let mut shares = [Cells::new(-6), Cells::new(-6)];
        points.iter().enumerate().for_each(|(i, &point)| shares[usize::from(i % 1000 == 0)].add(point, 3));
        let [mut merged, small] = shares;
        assert!(small.exponent < merged.exponent);
        merged.merge(small);
        assert_eq!(merged.exponent, cells.exponent);
        assert_eq!(merged.partition(50_000), cells.partition(50_000));
        let counts = cells.partition(50_000);
        assert_eq!(counts.iter().sum::<u64>(), 1_200_000);
        assert!(counts.iter().all(|&count| count <= 50_000) && counts.len() < 80, "{}", counts.len());
        let mut found = vec![0; counts.len()];
        cells.shrink();
        points.iter().for_each(|&point| found[cells.partition_of(point).unwrap()] += 3);
        assert_eq!(found, counts);
        let mut few = Cells::new(0);
        few.add(DVec3::ZERO, 7);
        few.shrink();
        assert!(few.memory_bytes() < 200 && few.partition(1) == [7]);
    }
}
