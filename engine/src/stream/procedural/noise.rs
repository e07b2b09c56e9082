//! Random numbers and gradient noise from integer hashes.

use glam::Vec3;

use crate::math::hash::{combine, hash32, unit_f32};

/// A small counter-based generator: splitmix's scheme with the engine's 32-bit hash.
#[derive(Clone, Copy, Debug)]
pub struct Rng(u32);

impl Rng {
    /// A generator that starts at `seed`.
    pub fn new(seed: u32) -> Self {
        Self(seed)
    }

    /// The next 32 bits.
    pub fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9);
        hash32(self.0)
    }

    /// A number in [0, 1).
    pub fn unit(&mut self) -> f32 {
        unit_f32(self.bits())
    }

    /// A number in [-1, 1).
    pub fn signed(&mut self) -> f32 {
        2.0 * self.unit() - 1.0
    }

    /// A number in [low, high).
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// A whole number in low..=high.
    pub fn count(&mut self, low: u32, high: u32) -> u32 {
        low + (self.unit() * (high - low + 1) as f32) as u32
    }

    /// Three numbers in [-1, 1), one draw of the hash each.
    pub fn vec3(&mut self) -> Vec3 {
        Vec3::new(self.signed(), self.signed(), self.signed())
    }
}

/// Hermite step from 0 below `low` to 1 above `high`.
pub fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Sixteen unit directions, 22.5 degrees apart.
const DIRECTIONS: [[f32; 2]; 16] = [
    [1.0, 0.0],
    [0.923_879_5, 0.382_683_43],
    [0.707_106_77, 0.707_106_77],
    [0.382_683_43, 0.923_879_5],
    [0.0, 1.0],
    [-0.382_683_43, 0.923_879_5],
    [-0.707_106_77, 0.707_106_77],
    [-0.923_879_5, 0.382_683_43],
    [-1.0, 0.0],
    [-0.923_879_5, -0.382_683_43],
    [-0.707_106_77, -0.707_106_77],
    [-0.382_683_43, -0.923_879_5],
    [0.0, -1.0],
    [0.382_683_43, -0.923_879_5],
    [0.707_106_77, -0.707_106_77],
    [0.923_879_5, -0.382_683_43],
];

/// The gradients at the corners of one cell of the noise's lattice, ready for bilinear blending.
///
/// The noise is K. Perlin's with quintic fade ("Improving Noise", 2002), its derivatives I. Quilez's
/// ("Gradient noise derivatives").
#[derive(Clone, Copy)]
pub struct NoiseCell {
    corners: [[f32; 2]; 4],
}

/// Noise, about -0.7 to 0.7, and its derivatives per lattice cell.
#[derive(Clone, Copy)]
pub struct NoiseSample {
    /// The value.
    pub value: f32,
    /// d value / dx, x in lattice cells.
    pub dx: f32,
    /// d value / dz, z in lattice cells.
    pub dz: f32,
}

impl NoiseCell {
    /// The cell whose lower corner is the lattice point `(x, z)`.
    pub fn new(seed: u32, x: i32, z: i32) -> Self {
        let gradient =
            |x: i32, z: i32| DIRECTIONS[(combine(combine(seed, x as u32), z as u32) >> 28) as usize];
        let (x1, z1) = (x.wrapping_add(1), z.wrapping_add(1));
        Self { corners: [gradient(x, z), gradient(x1, z), gradient(x, z1), gradient(x1, z1)] }
    }

    /// The noise at `(x, z)` inside the cell, each from 0 to 1.
    pub fn sample(&self, x: f32, z: f32) -> NoiseSample {
        let [ga, gb, gc, gd] = self.corners;
        let a = ga[0] * x + ga[1] * z;
        let b = gb[0] * (x - 1.0) + gb[1] * z;
        let c = gc[0] * x + gc[1] * (z - 1.0);
        let d = gd[0] * (x - 1.0) + gd[1] * (z - 1.0);
        let (u, du) = fade(x);
        let (w, dw) = fade(z);
        let (along_x, along_z, twist) = (b - a, c - a, a - b - c + d);
        let blend = |i: usize| {
            ga[i] + u * (gb[i] - ga[i]) + w * (gc[i] - ga[i]) + u * w * (ga[i] - gb[i] - gc[i] + gd[i])
        };
        NoiseSample {
            value: a + u * along_x + w * along_z + u * w * twist,
            dx: blend(0) + du * (along_x + w * twist),
            dz: blend(1) + dw * (along_z + u * twist),
        }
    }
}

/// The quintic fade and its derivative.
fn fade(t: f32) -> (f32, f32) {
    let t2 = t * t;
    (t2 * t * (t * (6.0 * t - 15.0) + 10.0), 30.0 * t2 * (t * (t - 2.0) + 1.0))
}

/// Noise at a point of the plane, its lattice one unit wide: for scattering, where points are few.
pub fn noise(seed: u32, x: f32, z: f32) -> f32 {
    let (cell_x, cell_z) = (x.floor(), z.floor());
    NoiseCell::new(seed, cell_x as i32, cell_z as i32).sample(x - cell_x, z - cell_z).value
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a jump at a lattice line or derivatives that belong to another function.
    #[test]
    fn noise_is_continuous_and_its_derivatives_are_its_own() {
        let (left, right) = (NoiseCell::new(3, 6, -2), NoiseCell::new(3, 7, -2));
        for i in 0..=10 {
            let z = i as f32 * 0.1;
            assert!((left.sample(1.0, z).value - right.sample(0.0, z).value).abs() < 1e-6);
            let (x, step) = (0.05 + z * 0.9, 1e-3);
            let sample = left.sample(x, 0.4);
            let slope = (left.sample(x + step, 0.4).value - left.sample(x - step, 0.4).value) / (2.0 * step);
            assert!((sample.dx - slope).abs() < 1e-2, "{} {slope}", sample.dx);
            let slope = (left.sample(x, 0.4 + step).value - left.sample(x, 0.4 - step).value) / (2.0 * step);
            assert!((sample.dz - slope).abs() < 1e-2, "{} {slope}", sample.dz);
        }
    }

    /// Catches a generator that is stuck or leaves its range.
    #[test]
    fn random_numbers_fill_their_range() {
        let mut rng = Rng::new(5);
        let mut seen = [0; 8];
        for _ in 0..8000 {
            seen[rng.count(0, 7) as usize] += 1;
            assert!((-1.0..1.0).contains(&rng.signed()));
        }
        assert!(seen.iter().all(|&n| (800..1200).contains(&n)), "{seen:?}");
    }
}
