//! The instance: a child that is a prototype's whole tree under an affine map, 64 bytes.
//!
//! ```text
//! byte  0  brick     u32      root of the prototype's tree; numbered below the brick that holds the record
//!       4  exponent  i16      a unit of `linear` is 2^exponent
//!       6  low       3 x u16  lower 16 bits of the offset
//!      12  high      3 x i32  upper 32 bits; a unit of the 48 is 2^-12 steps
//!      24  linear    9 x i32  three columns; the largest number has 31 bits
//!      60  evenness  f32      squared ratio of the smallest to the largest stretch: above 0, 1 for a similarity
//! ```
//!
//! A prototype has a lattice of its own. A point x of the map's lattice is p = linear (x - c) + offset on it, where c is the
//! lower corner of the child's decoded box: near the instance both terms are small, so that a vertex that was placed by the
//! exact matrix comes back to its own integers.

use bytemuck::{Pod, Zeroable};
use glam::{DMat3, DVec3, IVec3, Vec3};

use super::lattice::exp2;

/// Bytes of a record.
pub const INSTANCE_BYTES: usize = 64;
const _: () = assert!(size_of::<Instance>() == INSTANCE_BYTES);

/// Binary places of the offset.
const OFFSET_BITS: i32 = 12;
/// Bits of the largest number of `linear`.
const LINEAR_BITS: i32 = 31;
/// The map stretches by less than `2^STRETCH_BITS`, either way.
const STRETCH_BITS: i32 = 60;
/// A prototype is entered from at most `2^DISTANCE_BITS` of its steps away: all coordinates fit 31 bits then.
const DISTANCE_BITS: i32 = 29;

/// The record, as it lies in a brick.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Instance {
    /// Root brick of the prototype's tree.
    pub brick: u32,
    exponent: i16,
    low: [u16; 3],
    high: [i32; 3],
    linear: [[i32; 3]; 3],
    evenness: f32,
}

impl Instance {
    /// A record for the map p = `linear` (x - c) + `offset`; none when it stretches too far or too unevenly to be stored.
    pub fn new(brick: u32, linear: DMat3, offset: DVec3) -> Option<Self> {
        let columns = linear.to_cols_array_2d();
        let largest = columns.as_flattened().iter().fold(0.0_f64, |largest, x| largest.max(x.abs()));
        let evenness = evenness(&linear);
        // The exponent of the largest number, then one more where rounding would carry
        let mut exponent = ((largest.to_bits() >> 52) as i32 - 1023) + 1 - LINEAR_BITS;
        if (largest * exp2(-exponent.clamp(-500, 500))).round() >= exp2(LINEAR_BITS) {
            exponent += 1;
        }
        let is_small = offset.is_finite() && offset.abs().max_element() < exp2(47 - OFFSET_BITS) - 1.0;
        if !(evenness > 0.0 && is_small) || (exponent + LINEAR_BITS).abs() > STRETCH_BITS {
            return None;
        }
        let fixed = offset.to_array().map(|x| (x * exp2(OFFSET_BITS)).round() as i64);
        Some(Self {
            brick,
            exponent: exponent as i16,
            low: fixed.map(|x| x as u16),
            high: fixed.map(|x| (x >> 16) as i32),
            linear: columns.map(|column| column.map(|x| (x * exp2(-exponent)).round() as i32)),
            evenness,
        })
    }

    /// Reads the record that `bytes` start with; there are at least [`INSTANCE_BYTES`].
    #[inline(always)]
    pub fn read(bytes: &[u8]) -> Self {
        bytemuck::pod_read_unaligned(&bytes[..INSTANCE_BYTES])
    }

    /// Whether decoding makes sense, in brick `number`.
    pub fn is_sound(&self, number: u32) -> bool {
        let largest = self.linear.as_flattened().iter().fold(0, |largest, x| largest.max(x.unsigned_abs()));
        self.brick < number
            && (i32::from(self.exponent) + LINEAR_BITS).abs() <= STRETCH_BITS
            && largest >> (LINEAR_BITS - 2) != 0
            && self.evenness > 0.0
            && self.evenness <= 1.0
    }

    /// The linear part, prototype's lattice from the map's.
    pub fn linear(&self) -> DMat3 {
        let unit = exp2(i32::from(self.exponent));
        DMat3::from_cols_array_2d(&self.linear.map(|column| column.map(|x| f64::from(x) * unit)))
    }

    /// Where a point of the map lies on the prototype's lattice, not rounded. `from_corner` is x - c.
    #[inline]
    pub fn point(&self, from_corner: DVec3) -> DVec3 {
        let offset = std::array::from_fn(|axis| {
            let fixed = i64::from(self.high[axis]) << 16 | i64::from(self.low[axis]);
            fixed as f64 * exp2(-OFFSET_BITS)
        });
        let [x, y, z] = self.linear.map(|column| DVec3::from_array(column.map(f64::from)));
        let turned = x * from_corner.x + y * from_corner.y + z * from_corner.z;
        turned * exp2(i32::from(self.exponent)) + DVec3::from_array(offset)
    }

    /// The map of directions, whose columns' largest number is about 1; a ray that is `t` long becomes one that is
    /// `t * ray_scale()` long.
    #[inline]
    pub fn directions(&self) -> [Vec3; 3] {
        let unit = exp2(-LINEAR_BITS) as f32;
        self.linear.map(|column| Vec3::from_array(column.map(|x| x as f32 * unit)))
    }

    /// See [`directions`](Self::directions).
    #[inline(always)]
    pub fn ray_scale(&self) -> f32 {
        exp2(i32::from(self.exponent) + LINEAR_BITS) as f32
    }

    /// What squared angles of boxes are multiplied with, so that no box inside looks larger than it is from the map.
    #[inline(always)]
    pub fn evenness(&self) -> f32 {
        self.evenness
    }

    /// What a squared distance in steps of the map is on the prototype's lattice, at least, where angles inside are judged by
    /// [`evenness`](Self::evenness): that is counted as distance.
    pub fn distance2_inside(&self, distance2: f64) -> f64 {
        // The largest stretch is at least the longest column's, the smallest that times the root of the evenness
        let columns = self.directions().map(|column| f64::from(column.length_squared()));
        let stretch2 = columns.iter().fold(0.0_f64, |largest, &x| largest.max(x));
        let scale = exp2(i32::from(self.exponent) + LINEAR_BITS);
        let evenness = f64::from(self.evenness);
        // A hair less, so that rounding never closes what a walk opens
        0.999_99 * distance2 * stretch2 * scale * scale * evenness * evenness
    }

    /// Whether the prototype can be entered from points whose squared distance from the instance's box, in steps of the map,
    /// is `distance2`. From farther away its far field stands in for it.
    #[inline(always)]
    pub fn is_within_reach(&self, distance2: f32) -> bool {
        // No direction is stretched by more than three times the largest number
        let stretch = 3.0 * self.ray_scale();
        distance2.sqrt() * stretch <= exp2(DISTANCE_BITS) as f32
    }
}

/// Rounds a point on a prototype's lattice.
#[inline]
pub fn round(point: DVec3) -> IVec3 {
    let limit = exp2(DISTANCE_BITS + 1);
    // Adding half and rounding down is the same for equal numbers wherever they came from
    (point + 0.5).floor().clamp(DVec3::splat(-limit), DVec3::splat(limit)).as_ivec3()
}

/// The squared ratio of a map's smallest to its largest stretch; exactly 1 for what is a similarity but for rounding, 0 for
/// what cannot be inverted. By Jacobi's rotations, which need no trigonometry.
fn evenness(linear: &DMat3) -> f32 {
    let mut a = (linear.transpose() * *linear).to_cols_array_2d();
    for _ in 0..12 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = 1.0_f64.copysign(theta) / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for k in 0..3 {
                (a[k][p], a[k][q]) = (c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]);
            }
            let (row_p, row_q) = (a[p], a[q]);
            for k in 0..3 {
                (a[p][k], a[q][k]) = (c * row_p[k] - s * row_q[k], s * row_p[k] + c * row_q[k]);
            }
        }
    }
    let squares = [a[0][0], a[1][1], a[2][2]];
    let (low, high) = squares.iter().fold((f64::MAX, 0.0_f64), |(l, h), &x| (l.min(x), h.max(x)));
    let ratio = low / high;
    if ratio > 1.0 - 1e-9 {
        1.0
    } else if ratio > 0.0 && high.is_finite() {
        ratio as f32
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::hash::{hash32, unit_f32};

    struct Random(u32);

    impl Random {
        fn unit(&mut self) -> f64 {
            self.0 = hash32(self.0);
            f64::from(unit_f32(self.0))
        }

        fn vector(&mut self) -> DVec3 {
            DVec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0
        }

        fn rotation(&mut self) -> DMat3 {
            let x = self.vector().normalize();
            let y = self.vector().cross(x).normalize();
            DMat3::from_cols(x, y, x.cross(y))
        }
    }

    /// Catches a record that moves points by more than a thousandth of a step within a prototype of a million steps: points
    /// on an instance would no longer be its vertices.
    #[test]
    fn points_keep_their_places() {
        let mut random = Random(1);
        for case in 0..2000 {
            let scale = [1.0, 0.01, 300.0, 1.0 / 3.0][case % 4];
            let linear = random.rotation() * scale;
            let offset = random.vector() * 1e6;
            let record = Instance::new(7, linear, offset).unwrap();
            assert!(record.is_sound(8) && !record.is_sound(7));
            assert_eq!(record.evenness(), 1.0, "case {case}");
            let from_corner = random.vector() * 1e6 / scale;
            let moved = (record.point(from_corner) - (linear * from_corner + offset)).length();
            assert!(moved < 1e-3, "case {case}: {moved}");
            let direction = random.vector().normalize();
            let [x, y, z] = record.directions();
            let d = direction.as_vec3();
            let turned = (x * d.x + y * d.y + z * d.z) * record.ray_scale();
            assert!((turned.as_dvec3() - linear * direction).length() < 1e-6 * scale, "case {case}");
        }
    }

    /// Catches a stretch that is measured wrongly, so that boxes inside would be closed too early.
    #[test]
    fn evenness_is_the_ratio_of_stretches() {
        let mut random = Random(2);
        for _ in 0..1000 {
            let stretch = DVec3::new(random.unit(), random.unit(), random.unit()) + 0.01;
            let linear = random.rotation() * DMat3::from_diagonal(stretch) * random.rotation();
            let expected = (stretch.min_element() / stretch.max_element()).powi(2);
            let found = f64::from(evenness(&linear));
            assert!((found / expected - 1.0).abs() < 1e-5, "{found} {expected}");
        }
        assert_eq!(evenness(&(random.rotation() * 1e-5)), 1.0);
        assert_eq!(evenness(&DMat3::from_diagonal(DVec3::new(-2.0, 2.0, 2.0))), 1.0);
    }

    /// Catches a map that cannot be stored but is, wrongly.
    #[test]
    fn impossible_maps_are_refused() {
        let fine = DMat3::IDENTITY;
        assert!(Instance::new(0, fine, DVec3::splat(-3e10)).is_some());
        assert!(Instance::new(0, fine, DVec3::splat(1e11)).is_none());
        assert!(Instance::new(0, fine, DVec3::splat(f64::NAN)).is_none());
        assert!(Instance::new(0, fine * 1e30, DVec3::ZERO).is_none());
        assert!(Instance::new(0, fine * 1e-30, DVec3::ZERO).is_none());
        assert!(Instance::new(0, DMat3::ZERO, DVec3::ZERO).is_none());
        assert!(Instance::new(0, fine * f64::INFINITY, DVec3::ZERO).is_none());
        let almost = Instance::new(0, fine * (2.0 - 1e-12), DVec3::ZERO).unwrap();
        assert!(almost.is_sound(1) && (almost.linear().x_axis.x - 2.0).abs() < 1e-9);
    }

    /// Catches a hostile record that passes.
    #[test]
    fn unsound_records_are_found() {
        let record = Instance::new(3, DMat3::IDENTITY, DVec3::splat(-1.0)).unwrap();
        let change = |at: usize, bytes: &[u8]| {
            let mut changed = *bytemuck::bytes_of(&record).first_chunk::<INSTANCE_BYTES>().unwrap();
            changed[at..at + bytes.len()].copy_from_slice(bytes);
            Instance::read(&changed)
        };
        assert!(change(0, &[3]).is_sound(4) && !change(0, &[9]).is_sound(4));
        assert!(!change(4, &30_000_i16.to_le_bytes()).is_sound(4));
        assert!(!change(24, &[0; 36]).is_sound(4));
        for evenness in [0.0, -1.0, 1.5, f32::NAN, f32::INFINITY] {
            assert!(!change(60, &evenness.to_le_bytes()).is_sound(4), "{evenness}");
        }
    }
}
