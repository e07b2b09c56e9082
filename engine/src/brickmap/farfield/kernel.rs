//! The shooter's inner loops over plain arrays, and what an instruction set must give to replace them bit by bit.
//!
//! All multiply-adds written as such are fused, on every machine; all else is not.

use glam::IVec3;

use super::lines::{LINES_MAX, Lines};
use super::shapes::{BLOCK, Shape, TRIANGLES};
use crate::brick::LatticeBox;
use crate::brick::node::{Node, WIDTH};

/// Boxes of a node's children relative to the lines' center, in lattice steps.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub struct Boxes {
    /// Centres, per axis.
    pub center: [[f32; WIDTH]; 3],
    /// Half extents, padded against rounding, per axis.
    pub half: [[f32; WIDTH]; 3],
}

impl Boxes {
    /// Puts a box into a slot.
    #[inline(always)]
    pub fn put(&mut self, slot: usize, bounds: &LatticeBox, lines: &Lines<'_>) {
        for axis in 0..3 {
            let low = bounds.min[axis].wrapping_sub(lines.center[axis]) as f32;
            let high = bounds.max[axis].wrapping_sub(lines.center[axis]) as f32;
            let (center, half) = ((low + high) * 0.5, (high - low) * 0.5);
            let reach = lines.half[axis] + lines.half[axis];
            self.center[axis][slot] = center;
            self.half[axis][slot] = ((center.abs() + half) + reach).mul_add(BOX_ERROR, half);
        }
    }
}

/// Relative error of box arithmetic: a few roundings of 2^-24.
pub const BOX_ERROR: f32 = 1.0 / (1 << 21) as f32;

/// The inner loops. Methods are inlined into callers that have the instruction set enabled.
///
/// # Safety
/// The methods of an implementation may only be called where its instruction set is available.
pub trait Kernel {
    /// Decodes the boxes of a node's children.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn boxes(node: &Node, lines: &Lines<'_>, out: &mut Boxes);

    /// For each box the lines of `mask` that meet it; between [`Lines::from`] and [`Lines::to`] if `CLIP`.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn meet_boxes<const CLIP: bool>(
        boxes: &Boxes,
        lines: &Lines<'_>,
        mask: u64,
        out: &mut [u64; WIDTH],
    );

    /// The corners of a leaf's triangles relative to `reference`: corner, axis, lane. Lanes without a triangle have no meaning.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn corners(
        shape: &Shape,
        blocks: [&[[i32; BLOCK]; 3]; 2],
        reference: [i32; 3],
        out: &mut [[[f32; TRIANGLES]; 3]; 3],
    );

    /// The lines of `mask` that meet a triangle of the leaf, and for each of these which triangles, one bit a lane.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn meet_leaf<const CLIP: bool>(
        shape: &Shape,
        blocks: [&[[i32; BLOCK]; 3]; 2],
        lines: &Lines<'_>,
        mask: u64,
        triangles: &mut [u16; LINES_MAX],
    ) -> u64;
}

/// The loops over arrays.
#[derive(Clone, Copy, Debug)]
pub struct Plain;

#[inline(always)]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

impl Kernel for Plain {
    #[inline(always)]
    unsafe fn corners(
        shape: &Shape,
        blocks: [&[[i32; BLOCK]; 3]; 2],
        reference: [i32; 3],
        out: &mut [[[f32; TRIANGLES]; 3]; 3],
    ) {
        for corner in 0..3 {
            for axis in 0..3 {
                for lane in 0..TRIANGLES {
                    let vertex = usize::from(shape.corners[corner][lane]);
                    let position = blocks[vertex / BLOCK % 2][axis][vertex % BLOCK];
                    out[corner][axis][lane] = position.wrapping_sub(reference[axis]) as f32;
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn boxes(node: &Node, lines: &Lines<'_>, out: &mut Boxes) {
        for axis in 0..3 {
            let base = node.origin[axis].wrapping_sub(lines.center[axis]) as f32;
            let scale = f32::from_bits((u32::from(node.exponent[axis]) + 126) << 23);
            let reach = lines.half[axis] + lines.half[axis];
            for slot in 0..WIDTH {
                let (lower, upper) = (f32::from(node.lower[axis][slot]), f32::from(node.upper[axis][slot]));
                let center = (lower + upper).mul_add(scale, base);
                let half = (upper - lower) * scale;
                out.center[axis][slot] = center;
                out.half[axis][slot] = ((center.abs() + half) + reach).mul_add(BOX_ERROR, half);
            }
        }
    }

    #[inline(always)]
    unsafe fn meet_boxes<const CLIP: bool>(
        boxes: &Boxes,
        lines: &Lines<'_>,
        mask: u64,
        out: &mut [u64; WIDTH],
    ) {
        *out = [0; WIDTH];
        let mut rest = mask;
        while rest != 0 {
            let line = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let (mut enter, mut leave) = if CLIP {
                ([lines.from[line]; WIDTH], [lines.to[line]; WIDTH])
            } else {
                ([f32::MIN; WIDTH], [f32::MAX; WIDTH])
            };
            for axis in 0..3 {
                let (inverse, offset) = (lines.directions.inverse[axis][line], lines.offset[axis][line]);
                for slot in 0..WIDTH {
                    let middle = boxes.center[axis][slot].mul_add(inverse, -offset);
                    let half = boxes.half[axis][slot];
                    enter[slot] = max((-half).mul_add(inverse.abs(), middle), enter[slot]);
                    leave[slot] = min(half.mul_add(inverse.abs(), middle), leave[slot]);
                }
            }
            for slot in 0..WIDTH {
                out[slot] |= u64::from(enter[slot] <= leave[slot]) << line;
            }
        }
    }

    #[inline(always)]
    unsafe fn meet_leaf<const CLIP: bool>(
        shape: &Shape,
        blocks: [&[[i32; BLOCK]; 3]; 2],
        lines: &Lines<'_>,
        mask: u64,
        triangles: &mut [u16; LINES_MAX],
    ) -> u64 {
        // Vertices relative to the lines
        let count = if shape.is_large { 2 * BLOCK } else { BLOCK };
        let mut vertices = [[0.0_f32; 2 * BLOCK]; 3];
        for axis in 0..3 {
            for v in 0..count {
                let position = blocks[v / BLOCK][axis][v % BLOCK];
                vertices[axis][v] = position.wrapping_sub(lines.center[axis]) as f32;
            }
        }
        let mut met = 0;
        let mut rest = mask;
        while rest != 0 {
            let line = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            // Seen along the line, a triangle is met if it holds the zero of the plane across
            let seen = |frame: &[[f32; LINES_MAX]; 3], across: f32| {
                let mut seen = [0.0_f32; 2 * BLOCK];
                for v in 0..count {
                    let sum = vertices[2][v].mul_add(frame[2][line], -across);
                    let sum = vertices[1][v].mul_add(frame[1][line], sum);
                    seen[v] = vertices[0][v].mul_add(frame[0][line], sum);
                }
                seen
            };
            let x = seen(&lines.directions.right, lines.across[0][line]);
            let y = seen(&lines.directions.up, lines.across[1][line]);
            let depth = if CLIP { seen(&lines.directions.along, lines.across[2][line]) } else { x };
            let (from, to) = (lines.from[line], lines.to[line]);
            let mut lanes = 0_u16;
            for lane in 0..TRIANGLES {
                let [a, b, c] =
                    [0, 1, 2].map(|corner| usize::from(shape.corners[corner][lane]) % (2 * BLOCK));
                let edge = |p: usize, q: usize| x[p].mul_add(y[q], -(y[p] * x[q]));
                let (ab, bc, ca) = (edge(a, b), edge(b, c), edge(c, a));
                let (mut low, mut high) = (min(min(ab, bc), ca), max(max(ab, bc), ca));
                if CLIP {
                    let area = (ab + bc) + ca;
                    let sum = ab.mul_add(depth[c], ca.mul_add(depth[b], bc * depth[a]));
                    let (after, before) = ((-from).mul_add(area, sum), to.mul_add(area, -sum));
                    low = min(low, min(after, before));
                    high = max(high, max(after, before));
                }
                lanes |= u16::from(low >= 0.0 || high <= 0.0) << lane;
            }
            lanes &= shape.present;
            triangles[line] = lanes;
            met |= u64::from(lanes != 0) << line;
        }
        met
    }
}

/// The plane of every line that a normal and two distances cut out of it: for each line from where to where.
#[inline(always)]
pub fn slab(
    lines: &Lines<'_>,
    normal: glam::Vec3,
    middle: f32,
    low: f32,
    high: f32,
    out: &mut [[f32; LINES_MAX]; 2],
) {
    let n = normal;
    let (along, start) = (&lines.directions.along, &lines.start);
    for i in 0..LINES_MAX {
        let slope = (n.x * along[0][i] + n.y * along[1][i]) + n.z * along[2][i];
        let base = ((n.x * start[0][i] + n.y * start[1][i]) + n.z * start[2][i]) - middle;
        let inverse = 1.0 / if slope.abs() < 1e-9 { 1e-9 } else { slope };
        let (a, b) = ((low - base) * inverse, (high - base) * inverse);
        out[0][i] = min(a, b);
        out[1][i] = max(a, b);
    }
}

/// The center of the lines as whole numbers: see [`Lines::center`].
pub fn relative(position: IVec3, lines: &Lines<'_>) -> glam::Vec3 {
    (position - lines.center).as_vec3()
}
