//! The far field of a child: six bytes that stand in for it where it is not opened.
//!
//! ```text
//! kind       bit 0 of byte 3 (low) and bit 0 of byte 4 (high)
//! must open  bit 0 of byte 5: the child is never closed, whatever its size
//!
//! 0, 1 aggregate  byte 0-2  scales   3 x u8          c = (u / 128)^2
//!                      3-5  r        3 x 7 bits      xy, yz, xz: signed / 63, in the upper bits
//! 2 plate              0-1  normal   2 x i8          a, b from -127 to 127: (a + b, a - b, 254 - 2 max(|a|, |b|))
//!                        2  low      u8              / 255 of the box's range along the normal
//!                        3  high     upper 7 bits    / 127 of that range
//! 3 scalar             0-1  extinction  u16          the paper's, the same from everywhere
//! ```
//!
//! An *aggregate* is a matrix S whose root of d'Sd is the area that the geometry shows to a direction d (SGGX: Heitz et al.,
//! "The SGGX Microflake Distribution", 2015), as shares of the faces of the child's decoded box: x = sqrt(d'Sd) / projected
//! area of the box. Its opacity is min(1, x) (kind 0, a single layer) or 1 - (1 - x/8)^8 (kind 1, many layers). A *plate* is
//! what the box has between two planes; it is opaque.
//!
//! The functions here are the meaning of the bytes. Their operations on single precision numbers are never fused and have one
//! order, so that vectors can repeat them bit by bit. Everything belongs to the decoded box.

use glam::{IVec3, Vec3};

use super::bundle::EXTINCTION_OPAQUE;
use super::leaf::{EXTINCTION_PER_OCTAVE, OPAQUE};
use super::node::FAR_BYTES;

/// The stored form.
pub type Record = [u8; FAR_BYTES];

/// What a record is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// An aggregate of one layer.
    Single,
    /// An aggregate of many layers.
    Layered,
    /// An opaque plate.
    Plate,
    /// The same extinction from everywhere.
    Scalar,
}

/// The kind of a record.
#[inline(always)]
pub fn kind(record: &Record) -> Kind {
    match record[3] & 1 | (record[4] & 1) << 1 {
        0 => Kind::Single,
        1 => Kind::Layered,
        2 => Kind::Plate,
        _ => Kind::Scalar,
    }
}

/// Whether the child is never closed.
#[inline(always)]
pub fn must_open(record: &Record) -> bool {
    record[5] & 1 != 0
}

/// The record with its must-open mark set.
pub fn marked(mut record: Record) -> Record {
    record[5] |= 1;
    record
}

/// The record of an extinction that is the same from everywhere.
pub fn scalar(extinction: u16) -> Record {
    let [low, high] = extinction.to_le_bytes();
    [low, high, 0, 1, 1, 0]
}

/// A child's decoded box in lattice steps, its centre relative to the ray's origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenBox {
    /// Centre.
    pub center: Vec3,
    /// Half extents, not padded.
    pub half: Vec3,
}

/// What a ray along `direction` (any length above zero) that meets the box loses: units of
/// [`EXTINCTION_PER_OCTAVE`], [`EXTINCTION_OPAQUE`] if everything.
pub fn extinction(record: &Record, direction: Vec3, bounds: &SeenBox) -> u32 {
    match kind(record) {
        Kind::Single | Kind::Layered => Aggregate::decode(record).extinction(direction, bounds.half),
        Kind::Plate => {
            let (enter, leave) = pass(direction, bounds);
            let plate = Plate::decode(record, bounds.half);
            if plate.is_met(direction, bounds, enter, leave) { EXTINCTION_OPAQUE } else { 0 }
        }
        Kind::Scalar => match u16::from_le_bytes([record[0], record[1]]) {
            OPAQUE => EXTINCTION_OPAQUE,
            extinction => u32::from(extinction),
        },
    }
}

/// Where a ray from zero enters a box, not before its start, and where it leaves it. A walk's own values, from a box padded
/// against rounding, serve as well.
pub fn pass(direction: Vec3, bounds: &SeenBox) -> (f32, f32) {
    let inverse = direction.map(|d| 1.0 / if d.abs() < 1e-18 { 1e-18_f32.copysign(d) } else { d });
    let (middle, half) = (bounds.center * inverse, bounds.half * inverse.abs());
    ((middle - half).max_element().max(0.0), (middle + half).min_element())
}

/// A decoded record of kind [`Single`](Kind::Single) or [`Layered`](Kind::Layered).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aggregate {
    /// Areas shown along the axes, as shares of the box's faces: 0 to 3.97.
    pub scale: Vec3,
    /// Correlations xy, yz, xz: -1 to 1.
    pub correlation: Vec3,
    /// Whether it has many layers.
    pub is_layered: bool,
}

impl Aggregate {
    /// Reads a record.
    #[inline(always)]
    pub fn decode(record: &Record) -> Self {
        let root = |at: usize| f32::from(record[at]) * (1.0 / 128.0);
        let correlation = |at: usize| f32::from(record[at] as i8 >> 1) * (1.0 / 63.0);
        let root = Vec3::new(root(0), root(1), root(2));
        Self {
            scale: root * root,
            correlation: Vec3::new(correlation(3), correlation(4), correlation(5)),
            is_layered: record[3] & 1 != 0,
        }
    }

    /// The nearest record.
    pub fn encode(&self) -> Record {
        let scale = self.scale.to_array().map(|c| (128.0 * c.max(0.0).sqrt()).round().min(255.0) as u8);
        let [xy, yz, xz] =
            self.correlation.to_array().map(|r| (((63.0 * r).round().clamp(-63.0, 63.0) as i8) << 1) as u8);
        let [x, y, z] = scale;
        [x, y, z, xy | u8::from(self.is_layered), yz, xz]
    }

    /// sqrt(d'Sd) over the projected area of a box with the given half extents; 0 where the box shows no area.
    #[inline(always)]
    pub fn covered(&self, direction: Vec3, half: Vec3) -> f32 {
        let (d, h, c, r) = (direction, half, self.scale, self.correlation);
        let face = Vec3::new((h.y * h.z) * d.x, (h.z * h.x) * d.y, (h.x * h.y) * d.z);
        let shown = Vec3::new(c.x * face.x, c.y * face.y, c.z * face.z);
        let projected = (face.x.abs() + face.y.abs()) + face.z.abs();
        let squares = (shown.x * shown.x + shown.y * shown.y) + shown.z * shown.z;
        let products = (r.x * (shown.x * shown.y) + r.y * (shown.y * shown.z)) + r.z * (shown.x * shown.z);
        let square = squares + 2.0 * products;
        // Also false for a box without area, where both are zero
        if square > 0.0 && projected > 0.0 { square.sqrt() / projected } else { 0.0 }
    }

    /// See [`extinction`].
    #[inline(always)]
    pub fn extinction(&self, direction: Vec3, half: Vec3) -> u32 {
        let x = self.covered(direction, half);
        let (inverse, layers) = if self.is_layered { (0.125, 8.0) } else { (1.0, 1.0) };
        let transmittance = 1.0 - x * inverse;
        if transmittance > 0.0 {
            (octaves(transmittance) * (layers * EXTINCTION_PER_OCTAVE)).round_ties_even() as u32
        } else {
            EXTINCTION_OPAQUE
        }
    }
}

/// `-log2(t)` for 0 < t <= 1, within 5e-5; exact at powers of two.
#[inline(always)]
fn octaves(t: f32) -> f32 {
    let bits = t.to_bits();
    let exponent = ((bits >> 23) as i32 - 127) as f32;
    let f = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000) - 1.0;
    // log2(1 + f) = f + f (1 - f) q(f), q interpolated at the four Chebyshev nodes
    let q = ((-0.044_873_955 * f + 0.150_533_2) * f - 0.269_578) * f + 0.442_418_58;
    -(exponent + (f + (f * (1.0 - f)) * q))
}

/// The share of light that a stored extinction lets through, within 2e-5; exact at whole octaves and for [`OPAQUE`].
#[inline(always)]
pub fn transmittance(extinction: u16) -> f32 {
    if extinction == OPAQUE {
        return 0.0;
    }
    // 2^-(whole + f), with the Taylor series of 2^-f
    let power = f32::from(extinction) * (1.0 / EXTINCTION_PER_OCTAVE);
    let whole = power.floor();
    let x = (power - whole) * -std::f32::consts::LN_2;
    let series =
        (((((x * (1.0 / 720.0) + 1.0 / 120.0) * x + 1.0 / 24.0) * x + 1.0 / 6.0) * x + 0.5) * x + 1.0) * x
            + 1.0;
    series * f32::from_bits((127 - whole as u32) << 23)
}

/// A decoded record of kind [`Plate`](Kind::Plate).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plate {
    /// Normal; whole numbers, not of unit length.
    pub normal: Vec3,
    /// Range along the normal from the box's centre, in lattice steps times the normal's length.
    pub low: f32,
    /// Its upper end.
    pub high: f32,
}

/// Relative error of plate arithmetic: a few roundings of 2^-24.
const PLATE_ERROR: f32 = 1.0 / (1 << 21) as f32;

impl Plate {
    /// Reads the record of a child whose decoded box has the given half extents.
    #[inline(always)]
    pub fn decode(record: &Record, half: Vec3) -> Self {
        let normal = plate_normal([record[0] as i8, record[1] as i8]).as_vec3();
        let reach = reach(normal, half);
        let low = f32::from(record[2]) * (reach * (2.0 / 255.0)) - reach;
        let high = f32::from(record[3] >> 1) * (reach * (2.0 / 127.0)) - reach;
        Self { normal, low, high }
    }

    /// The record whose plate contains everything from `low` to `high` along the normal with the given code, inside a box of
    /// the given half extents. Both are as in [`Plate`].
    pub fn encode(code: [i8; 2], low: f32, high: f32, half: Vec3) -> Record {
        let reach = reach(plate_normal(code).as_vec3(), half);
        let share = |d: f32, steps: f32| {
            if reach > 0.0 { f64::from(d / reach + 1.0) * 0.5 * f64::from(steps) } else { 0.0 }
        };
        // A hair outward, so that rounding in the decoder takes nothing away
        let low = (share(low, 255.0) - 1e-3).floor().clamp(0.0, 255.0) as u8;
        let high = (share(high, 127.0) + 1e-3).ceil().clamp(0.0, 127.0) as u8;
        [code[0] as u8, code[1] as u8, low, high << 1, 1, 0]
    }

    /// Whether a ray from zero meets the plate between `enter` and `leave`, which are where it passes the box (see [`pass`]).
    #[inline(always)]
    pub fn is_met(&self, direction: Vec3, bounds: &SeenBox, enter: f32, leave: f32) -> bool {
        let n = self.normal;
        let product = |v: Vec3| (n.x * v.x + n.y * v.y) + n.z * v.z;
        let (slope, middle) = (product(direction), product(bounds.center));
        // Never thinner than rounding
        let pad = (reach(n, bounds.center) + reach(n, bounds.half)) * PLATE_ERROR;
        let (a, b) = (enter * slope, leave * slope);
        a.min(b) <= (middle + self.high) + pad && a.max(b) >= (middle + self.low) - pad
    }
}

/// How far a box with the given half extents reaches along a normal.
#[inline(always)]
fn reach(normal: Vec3, half: Vec3) -> f32 {
    (normal.x * half.x).abs() + (normal.y * half.y).abs() + (normal.z * half.z).abs()
}

/// The normal of a code: an octahedron's upper half, turned so that it fills the square. Opposite normals are the same plate.
#[inline(always)]
pub fn plate_normal([a, b]: [i8; 2]) -> IVec3 {
    let (a, b) = (i32::from(a), i32::from(b));
    IVec3::new(a + b, a - b, 254 - 2 * a.abs().max(b.abs()))
}

/// The code of the normal nearest to `normal`, which has some length.
pub fn plate_code(normal: Vec3) -> [i8; 2] {
    let normal = if normal.z < 0.0 { -normal } else { normal };
    let scaled = normal * (127.0 / normal.abs().element_sum());
    [scaled.x + scaled.y, scaled.x - scaled.y].map(|c| c.round().clamp(-127.0, 127.0) as i8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::hash::{hash32, unit_f32};

    struct Random(u32);

    impl Random {
        fn unit(&mut self) -> f32 {
            self.0 = hash32(self.0);
            unit_f32(self.0)
        }

        fn vector(&mut self) -> Vec3 {
            Vec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0
        }
    }

    fn opacity(extinction: u32) -> f64 {
        1.0 - (-f64::from(extinction) / f64::from(EXTINCTION_PER_OCTAVE)).exp2()
    }

    /// Catches an opacity that is not the share of its box that a flat sheet covers, or a layered one that is not eight of them.
    #[test]
    fn an_aggregate_has_the_opacity_of_its_closed_form() {
        let mut random = Random(1);
        for case in 0..2000 {
            let half = (random.vector().abs() + 0.01) * [1.0, 1e3, 1e8][case % 3];
            let normal = random.vector().normalize();
            let direction = random.vector() * [1.0, 3.0][case % 2];
            // A sheet of area `area` across `normal`: S = area² n n'
            let faces = 4.0 * Vec3::new(half.y * half.z, half.z * half.x, half.x * half.y);
            let area = random.unit() * faces.min_element();
            let aggregate = Aggregate {
                scale: normal.abs() * area / faces,
                correlation: Vec3::new(normal.x * normal.y, normal.y * normal.z, normal.x * normal.z)
                    .signum(),
                is_layered: case % 5 == 0,
            };
            let d = direction.as_dvec3();
            let projected = (faces.as_dvec3() * d.abs()).element_sum();
            let x = f64::from(area) * d.dot(normal.as_dvec3()).abs() / projected;
            let expected = if case % 5 == 0 { 1.0 - (1.0 - x / 8.0).powi(8) } else { x.min(1.0) };
            let got = opacity(aggregate.extinction(direction, half));
            // An edge-on sheet is the root of a difference: eps becomes sqrt(eps)
            assert!((got - expected).abs() < 1e-3, "case {case}: {got} {expected}");
        }
    }

    /// Catches a record that loses more than its bits, or a mark that changes an aggregate's numbers.
    #[test]
    fn aggregates_round_trip_through_their_record() {
        let mut random = Random(2);
        for _ in 0..1000 {
            let bytes: [u8; 6] = std::array::from_fn(|_| (255.9 * random.unit()) as u8);
            let mut record = bytes;
            record[4] &= !1;
            record[5] &= !1;
            // -64 is not a code that the encoder makes
            record[3..6].iter_mut().filter(|byte| **byte >> 1 == 64).for_each(|byte| *byte = 0);
            let aggregate = Aggregate::decode(&record);
            assert_eq!(aggregate.encode(), record);
            let marked = marked(record);
            assert!(must_open(&marked) && !must_open(&record));
            assert_eq!((Aggregate::decode(&marked), kind(&marked)), (aggregate, kind(&record)));
        }
        let full = Aggregate { scale: Vec3::ONE, correlation: Vec3::ONE, is_layered: false };
        assert_eq!(Aggregate::decode(&full.encode()), full);
    }

    /// Catches a wall across its box that lets light through, and an empty aggregate that does not.
    #[test]
    fn the_ends_of_the_scale_are_exact() {
        let record = Aggregate { scale: Vec3::Z, correlation: Vec3::ZERO, is_layered: false }.encode();
        let half = Vec3::new(7.0, 5.0, 0.0);
        let bounds = SeenBox { center: Vec3::new(0.0, 0.0, 30.0), half };
        assert_eq!(extinction(&record, Vec3::new(0.1, -0.05, 1.0), &bounds), EXTINCTION_OPAQUE);
        assert_eq!(extinction(&[0; 6], Vec3::Z, &bounds), 0);
        let half_open = Aggregate { scale: Vec3::splat(0.5), correlation: Vec3::ONE, is_layered: false };
        let got = opacity(half_open.extinction(Vec3::ONE, Vec3::ONE));
        assert!((got - 0.5).abs() < 0.01, "{got}");
    }

    /// Catches a logarithm that is off by more than it says, or jumps between its pieces.
    #[test]
    fn the_logarithm_is_close() {
        for i in 1..200_000 {
            let t = i as f32 / 200_000.0;
            let error = (f64::from(octaves(t)) + f64::from(t).log2()).abs();
            assert!(error < 5.5e-5, "{t}: {error}");
        }
        assert_eq!([1.0, 0.5, 0.125].map(octaves), [0.0, 1.0, 3.0]);
    }

    /// Catches transmittances that are not those of the opacities that extinctions are made from.
    #[test]
    fn transmittance_inverts_extinction() {
        for i in 0..=1000 {
            let opacity = i as f32 / 1000.0;
            let extinction = crate::brick::leaf::extinction_from_opacity(opacity);
            let error = (transmittance(extinction) - (1.0 - opacity)).abs();
            // Half a unit of extinction is 8.5e-5 of the transmittance
            assert!(error < 9e-5, "{opacity}: {error}");
        }
        assert_eq!([0, 4096, 8192, OPAQUE].map(transmittance), [1.0, 0.5, 0.25, 0.0]);
    }

    /// Catches a plate that does not contain what it was made for, or is much thicker, or whose normal is another.
    #[test]
    fn a_plate_is_opaque_between_its_planes_only() {
        let mut random = Random(3);
        let (mut met, mut missed) = (0, 0);
        for case in 0..4000 {
            let scale = [1.0, 40.0, 1e7][case % 3];
            let half = (random.vector().abs() + 0.02) * scale;
            let normal = random.vector();
            let code = plate_code(normal);
            let coded = plate_normal(code).as_vec3();
            assert!(coded.normalize().dot(normal.normalize()).abs() > 0.999_9, "{normal} {coded}");
            let reach = reach(coded, half);
            let (low, high) = (-0.1 * reach, 0.15 * reach);
            let record = Plate::encode(code, low, high, half);
            assert_eq!((kind(&record), must_open(&record)), (Kind::Plate, false));
            let plate = Plate::decode(&record, half);
            assert!(plate.low <= low && plate.high >= high && plate.high - plate.low < 0.3 * reach);

            // A ray from outside through a point of the box
            let center = random.vector().normalize() * 10.0 * scale;
            let bounds = SeenBox { center, half };
            let direction = (center + half * random.vector()).normalize();
            let (enter, leave) = pass(direction, &bounds);
            let along = |t: f32| f64::from(coded.dot(direction * t - center));
            let samples: Vec<f64> =
                (0..=200).map(|i| along(enter + (leave - enter) * i as f32 / 200.0)).collect();
            let inside = |low: f64, high: f64| samples.iter().any(|&s| low <= s && s <= high);
            let is_met = extinction(&record, direction, &bounds) == EXTINCTION_OPAQUE;
            if inside(f64::from(low), f64::from(high)) {
                assert!(is_met, "case {case}");
                met += 1;
            } else if !inside(f64::from(plate.low - 0.02 * reach), f64::from(plate.high + 0.02 * reach)) {
                assert!(!is_met, "case {case}");
                missed += 1;
            }
        }
        assert!(met > 500 && missed > 500, "{met} {missed}: the test is empty");
    }

    /// Catches a flat box whose plate has no thickness and is missed for that.
    #[test]
    fn a_plate_without_thickness_is_met() {
        let half = Vec3::new(900.0, 0.0, 333.3);
        let record = Plate::encode(plate_code(Vec3::Y), 0.0, 0.0, half);
        let mut random = Random(4);
        for _ in 0..1000 {
            let center = Vec3::new(1e4 * random.unit(), 3333.3, -1e3);
            let direction = (center + half * random.vector()).normalize();
            assert_eq!(extinction(&record, direction, &SeenBox { center, half }), EXTINCTION_OPAQUE);
        }
    }

    /// Catches a paper's record that lost its number.
    #[test]
    fn a_scalar_is_its_extinction() {
        let bounds = SeenBox { center: Vec3::X, half: Vec3::ONE };
        let [low, high] = 1234_u16.to_le_bytes();
        assert_eq!(extinction(&scalar(1234), Vec3::X, &bounds), 1234);
        assert_eq!(scalar(1234), [low, high, 0, 1, 1, 0]);
        assert_eq!(extinction(&scalar(OPAQUE), Vec3::X, &bounds), EXTINCTION_OPAQUE);
    }
}
