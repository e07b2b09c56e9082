//! From what lines met to an aggregate: one factor, and whether it is of one layer or of many.

use glam::Vec3;

use super::lines::{Column, LINES_MAX, Lines};
use super::moments::Moments;
use crate::brick::far::{Aggregate, Record};

/// Newton steps. The curve is concave and the start below it, so every step stays below.
const STEPS: usize = 6;

/// A step that changes the factor by less than this share is the last: the record's codes are coarser.
const ACCURACY: f32 = 1.0 / 512.0;

/// Columns are summed up in this many parts, one an element of a vector.
const LANES: usize = 16;

/// The shares of the box's outline that the geometry would cover if nothing lay behind anything else, for every line.
#[inline(always)]
pub fn covered(moments: &Moments, lines: &Lines<'_>, out: &mut Column) {
    let [xx, yy, zz, xy, yz, xz] = moments.shown();
    let [dx, dy, dz] = &lines.directions.along;
    for i in 0..lines.directions.count.min(LINES_MAX) {
        let (x, y, z) = (dx[i], dy[i], dz[i]);
        let square = (xx * x * x + yy * y * y + zz * z * z) + 2.0 * (xy * x * y + yz * y * z + xz * x * z);
        let positive = if square > 0.0 { square } else { 0.0 };
        out[i] = if lines.shown[i] > 0.0 { positive.sqrt() / lines.shown[i] } else { 0.0 };
    }
}

/// The sum of `f` over the lines, in an order that vectors can keep.
#[inline(always)]
pub fn sum(count: usize, f: impl Fn(usize) -> f32) -> f32 {
    let mut parts = [0.0_f32; LANES];
    // Bounded, so that no index is checked and the loops become vectors
    for chunk in 0..(count / LANES).min(LINES_MAX / LANES) {
        for lane in 0..LANES {
            parts[lane] += f(LANES * chunk + lane);
        }
    }
    // Halves, of lengths that are known
    for lane in 0..8 {
        parts[lane] += parts[lane + 8];
    }
    for lane in 0..4 {
        parts[lane] += parts[lane + 4];
    }
    for lane in 0..2 {
        parts[lane] += parts[lane + 2];
    }
    parts[0] + parts[1]
}

#[inline(always)]
fn single(x: f32) -> f32 {
    if x < 1.0 { x } else { 1.0 }
}

#[inline(always)]
fn layered(x: f32) -> (f32, f32) {
    let rest = 1.0 - 0.125 * if x < 8.0 { x } else { 8.0 };
    let square = rest * rest;
    let fourth = square * square;
    (1.0 - fourth * fourth, fourth * square * rest)
}

#[inline(always)]
fn square(x: f32) -> f32 {
    x * x
}

/// A Newton step towards what is `missing`, never back.
#[inline(always)]
fn step(missing: f32, slope: f32) -> f32 {
    if slope > 0.0 && missing > 0.0 { missing / slope } else { 0.0 }
}

/// The record for lines that lost `lost` (0 to 1) where `covered` is what they might have.
#[inline(always)]
pub fn fit(moments: &Moments, lines: &Lines<'_>, covered: &Column, lost: &Column) -> Record {
    let count = lines.directions.count;
    let (total, covered_sum) = (sum(count, |i| lost[i]), sum(count, |i| covered[i]));
    if total <= 0.0 || covered_sum <= 0.0 {
        return Aggregate { scale: Vec3::ZERO, correlation: Vec3::ZERO, is_layered: false }.encode();
    }
    let start = total / covered_sum;
    let (mut one, mut many) = (start, start);
    for _ in 0..STEPS {
        let (value, slope) = (
            sum(count, |i| single(one * covered[i])),
            sum(count, |i| if one * covered[i] < 1.0 { covered[i] } else { 0.0 }),
        );
        let one_step = step(total - value, slope);
        let (value, slope) = (
            sum(count, |i| layered(many * covered[i]).0),
            sum(count, |i| covered[i] * layered(many * covered[i]).1),
        );
        let many_step = step(total - value, slope);
        one += one_step;
        many += many_step;
        if one_step <= ACCURACY * one && many_step <= ACCURACY * many {
            break;
        }
    }
    let single_error = sum(count, |i| square(single(one * covered[i]) - lost[i]));
    let layered_error = sum(count, |i| square(layered(many * covered[i]).0 - lost[i]));
    let is_layered = layered_error < single_error;
    aggregate(moments, lines.half, if is_layered { many } else { one }, is_layered).encode()
}

/// The aggregate of geometry in a box with the given half extents, its areas multiplied by `factor`.
pub fn aggregate(moments: &Moments, half: Vec3, factor: f32, is_layered: bool) -> Aggregate {
    let [xx, yy, zz, xy, yz, xz] = moments.shown();
    let root = Vec3::new(xx, yy, zz).max(Vec3::ZERO).map(f32::sqrt);
    let faces = 4.0 * Vec3::new(half.y * half.z, half.z * half.x, half.x * half.y);
    let share = |area: f32, face: f32| if face > 0.0 { factor * area / face } else { 0.0 };
    let correlation = |product: f32, a: f32, b: f32| if a * b > 0.0 { product / (a * b) } else { 0.0 };
    Aggregate {
        scale: Vec3::new(share(root.x, faces.x), share(root.y, faces.y), share(root.z, faces.z)),
        correlation: Vec3::new(
            correlation(xy, root.x, root.y),
            correlation(yz, root.y, root.z),
            correlation(xz, root.z, root.x),
        ),
        is_layered,
    }
}
