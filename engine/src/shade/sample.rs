//! Directions: a spherical Fibonacci set of n points, rotated and shifted per point by integer hashes.
//!
//! Direction i of n has the height z = 1 - (i + u)/n over the hemisphere (1 - 2(i + u)/n over the sphere, and the square
//! root of the former for cosine weights) and stands at i/φ + v turns, φ the golden ratio. u and v are hashes of
//! (seed, bake set, point index): a Cranley-Patterson rotation of the lattice, unbiased, and the same on every machine.
//! After Keinert et al., "Spherical Fibonacci Mapping", 2015.

use glam::Vec3;

use crate::brick::bundle::Bundle;
use crate::brick::leaf::EXTINCTION_PER_OCTAVE;
use crate::math::hash::{combine, hash32, unit_f32};
use crate::math::trig::cos_sin_turns;
use crate::scene::{Domain, ShOcclusion, Weight};

/// Transmittance below which a ray ends by chance; survivors count as this much.
///
/// A ray of transmittance T < c survives with probability T/c and counts c: right on average for any c. Small values cost
/// time in deep foliage, large ones noise (0.1 to 0.25 was measured to be the best range).
pub const SURVIVAL_TRANSMITTANCE: f32 = 0.1;

/// Strata of the thresholds at which rays end.
const STRATA: usize = 256;

/// How a point's directions are spread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spread {
    /// Uniform over the hemisphere about the normal.
    Hemisphere,
    /// Over the hemisphere, denser by the cosine to the normal.
    CosineHemisphere,
    /// Uniform over the sphere.
    Sphere,
}

impl Spread {
    /// How the directions of a point are spread; a point without a normal gets the sphere.
    pub fn new(shader: &ShOcclusion, has_normal: bool) -> Self {
        match (shader.domain, shader.weight) {
            _ if !has_normal => Self::Sphere,
            // The clamped cosine is zero below the horizon: rays there would be wasted
            (_, Weight::Cosine) => Self::CosineHemisphere,
            (Domain::Hemisphere, Weight::Uniform) => Self::Hemisphere,
            (Domain::Sphere, Weight::Uniform) => Self::Sphere,
        }
    }

    /// What one of `samples` directions stands for: steradians, or steradians times cosine.
    pub fn measure(self, samples: u32) -> f32 {
        let whole = match self {
            Self::Hemisphere => 2.0,
            Self::CosineHemisphere => 1.0,
            Self::Sphere => 4.0,
        };
        (whole * std::f64::consts::PI / f64::from(samples)) as f32
    }
}

/// How a point's directions are turned about its normal and shifted along it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rotation {
    /// What everything else of the point is hashed from; itself the shift.
    pub hash: u32,
    /// Cosine of the angle about the normal.
    pub cos: f32,
    /// Its sine.
    pub sin: f32,
}

/// Makes the rays of points, for a fixed number of samples.
#[derive(Debug)]
pub struct Sampler {
    samples: u32,
    key: u32,
    /// Cosine and sine of i/φ turns.
    turns: Vec<[f32; 2]>,
    /// Extinction at which a ray of a stratum ends.
    limits: [u32; STRATA],
    transmittances: Transmittances,
}

impl Sampler {
    /// A sampler for `samples` rays a point; `seed` and `bake_set` (a hash of its name) make its rotations.
    pub fn new(samples: u32, seed: u64, bake_set: u32) -> Self {
        let turn = |i: u32| {
            // 1/φ as a 64-bit fraction keeps the product exact modulo one
            let fraction = u64::from(i).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let (cos, sin) = cos_sin_turns((fraction >> 11) as f64 / (1_u64 << 53) as f64);
            [cos as f32, sin as f32]
        };
        let transmittances = Transmittances::new();
        let limits = std::array::from_fn(|stratum| {
            let threshold = SURVIVAL_TRANSMITTANCE * (stratum as f32 + 0.5) / STRATA as f32;
            (0..u32::MAX).find(|&e| transmittances.of(e) < threshold).unwrap_or(u32::MAX) - 1
        });
        Self {
            samples,
            key: combine(combine(hash32(seed as u32), (seed >> 32) as u32), bake_set),
            turns: (0..samples).map(turn).collect(),
            limits,
            transmittances,
        }
    }

    /// Rays a point.
    pub fn samples(&self) -> u32 {
        self.samples
    }

    /// How the directions of point `index` are turned.
    pub fn rotation(&self, index: u64) -> Rotation {
        let hash = combine(combine(self.key, index as u32), (index >> 32) as u32);
        let (cos, sin) = cos_sin_turns(f64::from(unit_f32(hash32(hash ^ 0x68bc_21eb))));
        Rotation { hash, cos: cos as f32, sin: sin as f32 }
    }

    /// The mean of the cosines between the normal of point `index` and its directions, uniform over the hemisphere: one half but
    /// for the shift along the normal.
    pub fn mean_cosine(&self, index: u64) -> f32 {
        let shift = f64::from(unit_f32(self.rotation(index).hash));
        let samples = f64::from(self.samples);
        (1.0 - (0.5 * (samples - 1.0) + shift) / samples) as f32
    }

    /// Cosine and sine of every sample's angle, before a point's rotation.
    pub fn turns(&self) -> &[[f32; 2]] {
        &self.turns
    }

    /// The extinctions at which the rays of each stratum end.
    pub fn limits(&self) -> &[u32] {
        &self.limits
    }

    /// Transmittances of the extinctions below one octave.
    pub fn fractions(&self) -> &[f32] {
        &self.transmittances.fractions
    }

    /// Adds the rays `range` of point `index` to the bundle's newest origin.
    pub fn push_rays(
        &self,
        index: u64,
        normal: Vec3,
        spread: Spread,
        range: std::ops::Range<u32>,
        bundle: &mut Bundle,
    ) {
        let Rotation { hash, cos, sin } = self.rotation(index);
        let shift = unit_f32(hash);
        let threshold = hash32(hash ^ 0x02e5_be93);
        let (tangent, bitangent) = frame(normal);
        let step = 1.0 / self.samples as f32;
        for i in range {
            let height = (i as f32 + shift) * step;
            let z = match spread {
                Spread::Hemisphere => 1.0 - height,
                Spread::CosineHemisphere => (1.0 - height).max(0.0).sqrt(),
                Spread::Sphere => 1.0 - 2.0 * height,
            };
            let radius = (1.0 - z * z).max(0.0).sqrt();
            let [c, s] = self.turns[i as usize];
            let (x, y) = (radius * (c * cos - s * sin), radius * (c * sin + s * cos));
            let direction = x * tangent + y * bitangent + z * normal;
            // Thresholds follow the golden ratio too: neighbours in the lattice get different ones
            let stratum = threshold.wrapping_add(i.wrapping_mul(0x9e37_79b9)) >> 24;
            bundle.push_ray(direction, self.limits[stratum as usize]);
        }
    }

    /// What a ray counts: 0 if it ended, otherwise its transmittance, at least [`SURVIVAL_TRANSMITTANCE`].
    #[inline]
    pub fn visibility(&self, bundle: &Bundle, ray: usize) -> f32 {
        if !bundle.is_alive(ray as u16) {
            return 0.0;
        }
        match bundle.extinction[ray] {
            0 => 1.0,
            extinction => self.transmittances.of(extinction).max(SURVIVAL_TRANSMITTANCE),
        }
    }
}

/// The one quotient of [`frame`].
pub fn frame_factor(normal: Vec3) -> f32 {
    -1.0 / (1.0_f32.copysign(normal.z) + normal.z)
}

/// Two unit vectors that make a right-handed frame with the unit vector `normal`.
///
/// Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
fn frame(normal: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0_f32.copysign(normal.z);
    let a = frame_factor(normal);
    let b = normal.x * normal.y * a;
    (
        Vec3::new(1.0 + sign * normal.x * normal.x * a, sign * b, -sign * normal.x),
        Vec3::new(b, sign + normal.y * normal.y * a, -normal.y),
    )
}

/// Transmittances of whole extinctions.
#[derive(Debug)]
struct Transmittances {
    /// 2^(-k/4096).
    fractions: Vec<f32>,
}

impl Transmittances {
    fn new() -> Self {
        // Square roots and products are exact to the last bit on every machine; powers from a library are not
        let steps = EXTINCTION_PER_OCTAVE as usize;
        let mut step = 0.5_f64;
        for _ in 0..steps.trailing_zeros() {
            step = step.sqrt();
        }
        let mut value = 1.0_f64;
        let fractions = (0..steps)
            .map(|_| {
                let fraction = value as f32;
                value *= step;
                fraction
            })
            .collect();
        Self { fractions }
    }

    fn of(&self, extinction: u32) -> f32 {
        let octaves = extinction / self.fractions.len() as u32;
        if octaves > 120 {
            return 0.0;
        }
        self.fractions[extinction as usize % self.fractions.len()] * f32::from_bits((127 - octaves) << 23)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::leaf::extinction_from_opacity;

    fn rays(samples: u32, spread: Spread, normal: Vec3, index: u64) -> Vec<Vec3> {
        let mut bundle = Bundle::new();
        bundle.push_origin(glam::IVec3::ZERO);
        Sampler::new(samples, 1, 2).push_rays(index, normal, spread, 0..samples, &mut bundle);
        bundle.directions.iter().map(|d| Vec3::from_slice(&d[..3])).collect()
    }

    /// Catches directions that are not unit vectors, leave their hemisphere, or clump: their means are known.
    #[test]
    fn directions_are_spread_as_promised() {
        let normal = Vec3::new(0.6, -0.64, 0.48);
        for (spread, mean) in
            [(Spread::Hemisphere, 0.5), (Spread::CosineHemisphere, 2.0 / 3.0), (Spread::Sphere, 0.0)]
        {
            for index in 0..20 {
                let rays = rays(512, spread, normal, index);
                assert!(rays.iter().all(|d| (d.length() - 1.0).abs() < 1e-6));
                let along: f32 = rays.iter().map(|d| d.dot(normal)).sum::<f32>() / 512.0;
                assert!((along - mean).abs() < 0.003, "{spread:?} {along}");
                let beside = rays.iter().map(|&d| d - normal * d.dot(normal)).sum::<Vec3>() / 512.0;
                assert!(beside.length() < 0.01, "{spread:?} {beside}");
                if spread != Spread::Sphere {
                    assert!(rays.iter().all(|d| d.dot(normal) > -1e-6));
                }
            }
        }
    }

    /// Catches two points with the same rays, and a point whose rays change.
    #[test]
    fn rotations_are_a_function_of_the_point() {
        let of = |index| rays(16, Spread::Sphere, Vec3::Z, index);
        assert_eq!(of(3), of(3));
        assert_ne!(of(3), of(4));
        assert_ne!(of(0), of(1 << 32));
    }

    /// Catches a survival rule that is biased: its mean must be the transmittance.
    #[test]
    fn ending_by_chance_is_unbiased() {
        let sampler = Sampler::new(4096, 5, 6);
        let mut bundle = Bundle::new();
        for opacity in [0.0, 0.3, 0.5, 0.9, 0.93, 0.97, 0.99] {
            let mut sum = 0.0;
            for half in 0..2 {
                bundle.clear(f32::INFINITY, 0.0);
                bundle.push_origin(glam::IVec3::ZERO);
                sampler.push_rays(9, Vec3::Z, Spread::Sphere, 2048 * half..2048 * (half + 1), &mut bundle);
                (0..2048)
                    .for_each(|ray| _ = bundle.extinguish(ray, u32::from(extinction_from_opacity(opacity))));
                sum += (0..2048).map(|ray| sampler.visibility(&bundle, ray)).sum::<f32>();
            }
            let mean = sum / 4096.0;
            assert!((mean - (1.0 - opacity)).abs() < 0.001, "{opacity}: {mean}");
        }
    }
}
