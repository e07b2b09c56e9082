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

/// A line through one cell of the noise's lattice along x, already blended in z: what varies along it is cheap.
///
/// The noise is K. Perlin's with quintic fade ("Improving Noise", 2002), its derivatives I. Quilez's
/// ("Gradient noise derivatives").
#[derive(Clone, Copy)]
pub struct NoiseLine {
    /// Value at x = 0 and per x of the left corners' ramp, then of the right corners' (counted from their side).
    left: [f32; 2],
    right: [f32; 2],
    /// The same for the derivatives in z.
    left_dz: [f32; 2],
    right_dz: [f32; 2],
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

impl NoiseLine {
    /// The line at `z` (0 to 1) through the cell whose lower corner is the lattice point `(cell_x, cell_z)`.
    pub fn new(seed: u32, cell_x: i32, cell_z: i32, z: f32) -> Self {
        let (w, dw) = fade(z);
        let side = |cell_x: i32| {
            let column = combine(seed, cell_x as u32);
            let gradient = |cell_z: i32| DIRECTIONS[(combine(column, cell_z as u32) >> 28) as usize];
            let (near, far) = (gradient(cell_z), gradient(cell_z.wrapping_add(1)));
            let (at_near, at_far) = (near[1] * z, far[1] * (z - 1.0));
            let ramp = [at_near + w * (at_far - at_near), near[0] + w * (far[0] - near[0])];
            let slope = near[1] + w * (far[1] - near[1]) + dw * (at_far - at_near);
            (ramp, [slope, dw * (far[0] - near[0])])
        };
        let ((left, left_dz), (right, right_dz)) = (side(cell_x), side(cell_x.wrapping_add(1)));
        Self { left, right, left_dz, right_dz }
    }

    /// The noise at `x` from 0 to 1.
    #[inline]
    pub fn sample(&self, x: f32) -> NoiseSample {
        let (u, du) = fade(x);
        let left = self.left[0] + self.left[1] * x;
        let across = self.right[0] + self.right[1] * (x - 1.0) - left;
        let left_dz = self.left_dz[0] + self.left_dz[1] * x;
        let across_dz = self.right_dz[0] + self.right_dz[1] * (x - 1.0) - left_dz;
        NoiseSample {
            value: left + u * across,
            dx: self.left[1] + u * (self.right[1] - self.left[1]) + du * across,
            dz: left_dz + u * across_dz,
        }
    }
}

/// The quintic fade and its derivative.
#[inline]
fn fade(t: f32) -> (f32, f32) {
    let t2 = t * t;
    (t2 * t * (t * (6.0 * t - 15.0) + 10.0), 30.0 * t2 * (t * (t - 2.0) + 1.0))
}

/// Noise at a point of the plane, its lattice one unit wide: for scattering, where points are few.
pub fn noise(seed: u32, x: f32, z: f32) -> f32 {
    let (cell_x, cell_z) = (x.floor(), z.floor());
    NoiseLine::new(seed, cell_x as i32, cell_z as i32, z - cell_z).sample(x - cell_x).value
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a jump at a lattice line or derivatives that belong to another function.
    #[test]
    fn noise_is_continuous_and_its_derivatives_are_its_own() {
        let at = |cell_x, x, z| NoiseLine::new(3, cell_x, -2, z).sample(x);
        for i in 0..=10 {
            let z = i as f32 * 0.1;
            assert!((at(6, 1.0, z).value - at(7, 0.0, z).value).abs() < 1e-6);
            let (x, step) = (0.05 + z * 0.9, 1e-3);
            let sample = at(6, x, 0.4);
            let slope = (at(6, x + step, 0.4).value - at(6, x - step, 0.4).value) / (2.0 * step);
            assert!((sample.dx - slope).abs() < 1e-2, "{} {slope}", sample.dx);
            let slope = (at(6, x, 0.4 + step).value - at(6, x, 0.4 - step).value) / (2.0 * step);
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
