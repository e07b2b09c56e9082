//! The Hilbert curve in three dimensions: from a position to its place along the curve.
//!
//! The curve is J. Skilling's ("Programming the Hilbert curve", AIP Conference Proceedings 707, 2004). His procedure walks
//! from the coarsest bit to the finest and exchanges or inverts axes on the way. What it has done to the axes so far is
//! one of 96 states, so here a table made by the compiler gives for each state and octant the octant's place and the next
//! state: one look-up per bit.

use glam::DVec3;

use crate::math::Bounds;

/// Bits per axis: three times as many fill a 64-bit key but one bit.
pub const BITS: u32 = 21;

/// Positions quantised to 2^21 cells per axis of a cube, and their places along the Hilbert curve through it.
///
/// The cube has the longest edge of a box as its own, so that cells are as long as they are wide, whatever the box.
#[derive(Clone, Copy, Debug)]
pub struct HilbertCurve {
    origin: DVec3,
    /// Edge of the cube, never zero.
    edge: f64,
}

impl HilbertCurve {
    /// The curve through the cube at the lower corner of `bounds` that holds them.
    pub fn new(bounds: &Bounds) -> Self {
        let edge = bounds.size().max_element();
        Self { origin: bounds.min, edge: if edge > 0.0 { edge } else { 1.0 } }
    }

    /// The place along the curve of the cell that holds `position`, 63 bits; outside counts to the nearest cell.
    pub fn key(&self, position: DVec3) -> u64 {
        let cells = f64::from(1u32 << BITS);
        // The division comes first: it cannot overflow where the edge is tiny. `as` saturates, and sends NaN to 0.
        let offset = (position - self.origin) / self.edge * cells;
        index(offset.to_array().map(|x| (x as u32).min((1 << BITS) - 1)), BITS)
    }
}

/// The place of `cell` along the Hilbert curve through a cube of 2^`bits` cells per axis, `bits` from 1 to 21.
///
/// Consecutive places are cells that share a side, and cells with the same leading bits are consecutive.
fn index(cell: [u32; 3], bits: u32) -> u64 {
    debug_assert!((1..=BITS).contains(&bits) && cell.iter().all(|&x| x >> bits == 0));
    let octants = spread(cell[0]) << 2 | spread(cell[1]) << 1 | spread(cell[2]);
    let (mut key, mut state) = (0, START);
    for level in (0..bits).rev() {
        let octant = (octants >> (3 * level) & 7) as usize;
        let step = STEPS[8 * state + octant];
        key = key << 3 | u64::from(step & 7);
        state = usize::from(step >> 3);
    }
    key
}

/// The orders in which the axes may stand.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// Axes in their own order, none inverted, no parity.
const START: usize = 0;

/// For every state and octant the next state and, in the low three bits, the octant's place.
const STEPS: [u16; 96 * 8] = {
    let mut steps = [0; 96 * 8];
    let mut i = 0;
    while i < steps.len() {
        steps[i] = step(i / 8, i % 8);
        i += 1;
    }
    steps
};

/// One level of Skilling's procedure. A state is the order of the axes, which of them are inverted, and the parity of
/// the third Gray code bits so far.
const fn step(state: usize, octant: usize) -> u16 {
    let (mut order, parity) = (ORDERS[state / 16], state & 1);
    let mut inverted = [state >> 3 & 1, state >> 2 & 1, state >> 1 & 1];

    // The octant's bits as the procedure finds them at this level
    let mut bits = [0; 3];
    let mut axis = 0;
    while axis < 3 {
        bits[axis] = (octant >> (2 - order[axis]) & 1) ^ inverted[axis];
        axis += 1;
    }

    // Their Gray code is the place
    let gray = [bits[0], bits[0] ^ bits[1], bits[0] ^ bits[1] ^ bits[2]];
    let place = (gray[0] ^ parity) << 2 | (gray[1] ^ parity) << 1 | (gray[2] ^ parity);

    // What happens to finer levels: inversion of the first axis, or exchange with it
    axis = 0;
    while axis < 3 {
        if bits[axis] == 1 {
            inverted[0] ^= 1;
        } else {
            (order[0], order[axis]) = (order[axis], order[0]);
            (inverted[0], inverted[axis]) = (inverted[axis], inverted[0]);
        }
        axis += 1;
    }
    let mut number = 0;
    while ORDERS[number][0] != order[0] || ORDERS[number][1] != order[1] {
        number += 1;
    }
    let next = number * 16 + inverted[0] * 8 + inverted[1] * 4 + inverted[2] * 2 + (parity ^ gray[2]);
    (next * 8 + place) as u16
}

/// Puts two zero bits between the bits of a number below 2^21.
fn spread(x: u32) -> u64 {
    let mut x = u64::from(x) & 0x1f_ffff;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Skilling's published procedure, branch by branch, as the yardstick of the one above.
    fn published(mut x: [u32; 3], bits: u32) -> u64 {
        let mut q = 1 << (bits - 1);
        while q > 1 {
            for i in 0..3 {
                if x[i] & q != 0 {
                    x[0] ^= q - 1;
                } else {
                    let t = (x[0] ^ x[i]) & (q - 1);
                    x[0] ^= t;
                    x[i] ^= t;
                }
            }
            q >>= 1;
        }
        x[1] ^= x[0];
        x[2] ^= x[1];
        let (mut t, mut q) = (0, 1 << (bits - 1));
        while q > 1 {
            if x[2] & q != 0 {
                t ^= q - 1;
            }
            q >>= 1;
        }
        x = x.map(|x| x ^ t);
        (0..bits).rev().fold(0, |key, bit| x.iter().fold(key, |key, x| key << 1 | u64::from(x >> bit & 1)))
    }

    /// Catches any curve that jumps, meets a cell twice or misses one: all cells of cubes of up to 16 per axis.
    #[test]
    fn consecutive_cells_are_neighbours_and_every_cell_comes_once() {
        for bits in 1..=4 {
            let edge = 1u32 << bits;
            let mut order = vec![None; 1 << (3 * bits)];
            for z in 0..edge {
                for y in 0..edge {
                    for x in 0..edge {
                        let key = index([x, y, z], bits) as usize;
                        assert_eq!(order[key].replace([x, y, z]), None, "key {key} comes twice");
                    }
                }
            }
            let order: Vec<[u32; 3]> =
                order.into_iter().map(|cell| cell.expect("every key has a cell")).collect();
            for pair in order.windows(2) {
                let steps: u32 = (0..3).map(|axis| pair[0][axis].abs_diff(pair[1][axis])).sum();
                assert_eq!(steps, 1, "{:?} and {:?} are consecutive", pair[0], pair[1]);
            }
            // Every octant, and every octant of an octant, is one run
            for run in order.chunks(8) {
                assert!(run.iter().all(|cell| cell.map(|x| x >> 1) == run[0].map(|x| x >> 1)));
            }
        }
    }

    /// Catches a box without extent, a position outside, and numbers that overflow on the way to a cell.
    #[test]
    fn strange_boxes_and_positions_have_keys() {
        let point = Bounds { min: DVec3::ONE, max: DVec3::ONE };
        assert_eq!(HilbertCurve::new(&point).key(DVec3::ONE), 0);
        let tiny = Bounds { min: DVec3::ZERO, max: DVec3::splat(f64::MIN_POSITIVE / 4.0) };
        assert_ne!(HilbertCurve::new(&tiny).key(tiny.max), HilbertCurve::new(&tiny).key(tiny.min));
        let huge = Bounds { min: DVec3::splat(f64::MIN), max: DVec3::splat(f64::MAX) };
        HilbertCurve::new(&huge).key(DVec3::ZERO);
        let unit = HilbertCurve::new(&Bounds { min: DVec3::ZERO, max: DVec3::ONE });
        assert_eq!(unit.key(DVec3::splat(-5.0)), unit.key(DVec3::ZERO));
        assert_eq!(unit.key(DVec3::splat(5.0)), unit.key(DVec3::ONE));
    }

    proptest! {
        /// Catches a slip in the table at the full 21 bits, where no exhaustive test reaches.
        #[test]
        fn agrees_with_the_published_procedure(cell in prop::array::uniform3(0u32..1 << BITS)) {
            prop_assert_eq!(index(cell, BITS), published(cell, BITS));
        }
    }
}
