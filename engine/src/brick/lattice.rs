//! The integer lattice that all vertices of a brick map lie on.
//!
//! One step for the whole map, a power of two of scene units, so that a shared vertex has the same integers in every
//! grid, leaf and brick, and an origin can be compared with a vertex exactly. A geometry of coarser detail uses
//! multiples of `2^shift` steps; its leaves then store fewer bits.

use glam::{DVec3, I64Vec3, IVec3};

use crate::math::Bounds;
use crate::{Error, ErrorKind, Result};

/// Coordinates stay within ±2^29 so that any difference of two fits 31 bits.
pub const COORDINATE_MAX: i32 = 1 << 29;

/// An edge is at least `2^EDGE_BITS` steps long: rounding moves a vertex by at most 1/256 of an edge, which keeps
/// the bumps that rounding gives to an oblique plane below a quarter of a degree. Chosen by measurement:
/// `docs/performance/cpu.md`.
pub const EDGE_BITS: i32 = 7;

/// Largest shift of a geometry.
pub const SHIFT_MAX: u8 = 20;

/// The integer lattice of a brick map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// The step is `2^exponent` scene units.
    pub exponent: i32,
    /// Lattice coordinates of the zero of the map's coordinates, a multiple of `2^SHIFT_MAX`.
    pub origin: I64Vec3,
}

impl Lattice {
    /// The lattice with the given step for geometry within `bounds`; the step is doubled until coordinates fit.
    ///
    /// # Errors
    /// [`ErrorKind::Limit`] when positions are too far away for any step (over about 10^18 steps).
    pub fn new(exponent: i32, bounds: &Bounds) -> Result<Self> {
        let extent = bounds.size().max_element().max(0.0);
        let mut exponent = exponent.clamp(-60, 60);
        while extent * exp2(-exponent) > f64::from(COORDINATE_MAX) {
            exponent += 1;
        }
        let center = if bounds.is_empty() { DVec3::ZERO } else { bounds.center() };
        let scaled = center * exp2(-exponent);
        if scaled.is_nan() || scaled.abs().max_element() >= 1e18 {
            return Err(Error::new(
                ErrorKind::Limit,
                format!("geometry at {center} is too far from the origin for its detail"),
            )
            .hint("move the scene nearer to the origin, or use coarser units"));
        }
        let origin = scaled.round().as_i64vec3() >> i32::from(SHIFT_MAX) << i32::from(SHIFT_MAX);
        Ok(Self { exponent, origin })
    }

    /// Scene units of one step.
    pub fn step(&self) -> f64 {
        exp2(self.exponent)
    }

    /// The coordinates of `position`, rounded to multiples of `2^shift`. Positions outside the map's bounds are
    /// clamped to the coordinate range.
    pub fn snap(&self, position: DVec3, shift: u8) -> IVec3 {
        let scale = exp2(-self.exponent - i32::from(shift));
        let scaled = position * scale;
        let steps = I64Vec3::new(rounded(scaled.x), rounded(scaled.y), rounded(scaled.z)) << i32::from(shift);
        let limit = I64Vec3::splat(i64::from(COORDINATE_MAX));
        (steps - self.origin).clamp(-limit, limit).as_ivec3()
    }

    /// The coordinates of `position`, not rounded.
    pub fn exact(&self, position: DVec3) -> DVec3 {
        position * exp2(-self.exponent) - self.origin.as_dvec3()
    }

    /// The position of a vertex with the given coordinates, in scene units.
    pub fn position(&self, coordinates: IVec3) -> DVec3 {
        (self.origin + coordinates.as_i64vec3()).as_dvec3() * self.step()
    }

    /// The shift of a geometry whose typical edge is `edge` scene units long: 0 for the finest.
    pub fn shift_for_edge(&self, edge: f64) -> u8 {
        (exponent_for_edge(edge) - self.exponent).clamp(0, i32::from(SHIFT_MAX)) as u8
    }
}

/// The exponent of the step for edges `edge` scene units long.
pub fn exponent_for_edge(edge: f64) -> i32 {
    if !(edge > 0.0 && edge.is_finite()) {
        return -20;
    }
    floor_log2(edge) - EDGE_BITS
}

/// `2^e` exactly, for -1022 <= e <= 1023.
pub fn exp2(e: i32) -> f64 {
    f64::from_bits(((e + 1023) as u64) << 52)
}

/// `x.round() as i64`, without the call of a library that rounding is on processors of no particular kind.
#[inline]
fn rounded(x: f64) -> i64 {
    let whole = x as i64;
    let rest = x - whole as f64;
    whole.saturating_add(i64::from(rest >= 0.5) - i64::from(rest <= -0.5))
}

fn floor_log2(x: f64) -> i32 {
    ((x.to_bits() >> 52) & 0x7ff) as i32 - 1023
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a lattice that gives a far copy of an object other integers than the near one.
    #[test]
    fn a_translation_by_whole_steps_keeps_the_differences() {
        let near = Bounds { min: DVec3::ZERO, max: DVec3::splat(10.0) };
        let far = Bounds { min: DVec3::splat(50_000.0), max: DVec3::splat(50_010.0) };
        let (a, b) = (Lattice::new(-10, &near).unwrap(), Lattice::new(-10, &far).unwrap());
        let (p, q) = (DVec3::new(1.234, 5.678, 9.1), DVec3::new(3.3, 0.1, 7.7));
        let shift = DVec3::splat(50_000.0);
        assert_eq!(a.snap(p, 0) - a.snap(q, 0), b.snap(p + shift, 0) - b.snap(q + shift, 0));
    }

    /// Catches rounding that is off by more than half a step.
    #[test]
    fn snapping_moves_by_at_most_half_a_step() {
        let lattice = Lattice::new(-7, &Bounds { min: DVec3::splat(-3.0), max: DVec3::splat(3.0) }).unwrap();
        for shift in [0, 3] {
            let p = DVec3::new(0.123_456, -2.7, 1.999);
            let moved = (lattice.position(lattice.snap(p, shift)) - p).abs().max_element();
            assert!(moved <= 0.5 * lattice.step() * exp2(i32::from(shift)), "{moved}");
        }
    }

    /// Catches rounding that is not that of `round`: at halves, at the least number below one, and out of range.
    #[test]
    fn rounding_is_the_usual_one() {
        let special = [0.0, 0.5, -0.5, 1.5, 2.5, -2.5, 0.499_999_999_999_999_94, 4_503_599_627_370_497.5];
        let edges = [1e18, -1e18, 9.3e18, -9.3e18, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
        let many = (0..10_000).map(|i| (f64::from(i) - 5000.0) * 0.01);
        for x in special.into_iter().chain(special.map(|x| -x)).chain(edges).chain(many) {
            assert_eq!(rounded(x), x.round() as i64, "{x}");
        }
    }

    /// Catches coordinates that overflow for a scene 10^7 wide with details of 10^-3.
    #[test]
    fn the_step_grows_until_coordinates_fit() {
        let bounds = Bounds { min: DVec3::splat(-1e7), max: DVec3::splat(1e7) };
        let lattice = Lattice::new(-40, &bounds).unwrap();
        for corner in [bounds.min, bounds.max] {
            let back = lattice.position(lattice.snap(corner, 0));
            assert!((back - corner).abs().max_element() <= lattice.step());
        }
    }
}
