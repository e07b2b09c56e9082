//! The triple product ∫ L V C of three functions in spherical harmonics.

use glam::DVec3;

use super::{COEFFICIENTS_MAX, coefficient_count, evaluate_f64, gauss_legendre};

/// Entries below this are zeros that the quadrature's rounding left.
const ENTRY_MIN: f64 = 1e-9;

/// The coupling coefficients T_ijk = ∫ Y_i Y_j Y_k of real spherical harmonics, without the zeros.
#[derive(Clone, Debug)]
pub struct TripleProduct {
    bands: [usize; 3],
    entries: Vec<Entry>,
}

/// One coupling coefficient that is not zero.
#[derive(Clone, Copy, Debug)]
struct Entry {
    light: u8,
    visibility: u8,
    cosine: u8,
    value: f64,
}

impl TripleProduct {
    /// The table for a light, a visibility and a cosine of so many bands each.
    ///
    /// By Gauss-Legendre quadrature in z and equal steps in φ, which is exact here: products of three functions of
    /// degree 5 have degree 15, 12 nodes are exact to 23 and 32 steps to frequency 31.
    ///
    /// # Panics
    /// When a number of bands is not 1 to 6.
    pub fn new(bands_light: usize, bands_visibility: usize, bands_cosine: usize) -> Self {
        let bands = [bands_light, bands_visibility, bands_cosine];
        let [lights, visibilities, cosines] = bands.map(coefficient_count);
        let bands_most = bands_light.max(bands_visibility).max(bands_cosine);
        let mut table = vec![0.0; lights * visibilities * cosines];
        let steps = 32;
        let (nodes, weights) = gauss_legendre(12);
        for (&z, &weight) in nodes.iter().zip(&weights) {
            let r = (1.0 - z * z).sqrt();
            for step in 0..steps {
                let phi = std::f64::consts::TAU * f64::from(step) / f64::from(steps);
                let mut y = [0.0; COEFFICIENTS_MAX];
                evaluate_f64(bands_most, DVec3::new(r * phi.cos(), r * phi.sin(), z), &mut y);
                let weight = weight * std::f64::consts::TAU / f64::from(steps);
                for (row, pair) in table.chunks_exact_mut(cosines).enumerate() {
                    let product = weight * y[row / visibilities] * y[row % visibilities];
                    pair.iter_mut().zip(&y).for_each(|(sum, y)| *sum += product * y);
                }
            }
        }
        let entries = table
            .iter()
            .enumerate()
            .filter(|(_, value)| value.abs() >= ENTRY_MIN)
            .map(|(at, &value)| Entry {
                light: (at / (visibilities * cosines)) as u8,
                visibility: (at / cosines % visibilities) as u8,
                cosine: (at % cosines) as u8,
                value,
            })
            .collect();
        Self { bands, entries }
    }

    /// Bands of the light, the visibility and the cosine.
    pub fn bands(&self) -> [usize; 3] {
        self.bands
    }

    /// Coupling coefficients that are not zero.
    pub fn entry_count(&self) -> usize {
        self.entries.len()
    }

    /// ∫ L V C, coefficient by coefficient.
    ///
    /// # Panics
    /// When a slice is shorter than its bands².
    pub fn integrate(&self, light: &[f64], visibility: &[f64], cosine: &[f64]) -> f64 {
        self.entries
            .iter()
            .map(|e| {
                e.value
                    * light[usize::from(e.light)]
                    * visibility[usize::from(e.visibility)]
                    * cosine[usize::from(e.cosine)]
            })
            .sum()
    }

    /// M with ∫ L V C = Σ_kj M\[k\]\[j\] C_k V_j: the light contracted away, once per environment.
    ///
    /// Row-major, one row of visibility coefficients per cosine coefficient.
    ///
    /// # Panics
    /// When `light` is shorter than its bands².
    pub fn contract(&self, light: &[f64]) -> Vec<f64> {
        let visibilities = coefficient_count(self.bands[1]);
        let mut matrix = vec![0.0; visibilities * coefficient_count(self.bands[2])];
        for e in &self.entries {
            matrix[usize::from(e.cosine) * visibilities + usize::from(e.visibility)] +=
                e.value * light[usize::from(e.light)];
        }
        matrix
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a wrong index order or weight: ∫ Y_i Y_j Y_0 = δ_ij Y_0, whichever of the three is Y_0.
    #[test]
    fn the_constant_function_couples_equals_alone() {
        let triple = TripleProduct::new(3, 4, 3);
        let unit =
            |i: usize| -> [f64; COEFFICIENTS_MAX] { std::array::from_fn(|k| f64::from(u8::from(k == i))) };
        for i in 0..9 {
            for j in 0..9 {
                let expected = if i == j { 0.282_094_791_773_878 } else { 0.0 };
                for [a, b, c] in [[0, i, j], [i, 0, j], [i, j, 0]] {
                    let found = triple.integrate(&unit(a), &unit(b), &unit(c));
                    assert!((found - expected).abs() < 1e-12, "T_{a},{b},{c} = {found}");
                }
            }
        }
    }

    /// Catches a wrong coupling: Gaunt's ∫ Y_10² Y_20 = 1/√(5π), and z-rotations of its kin.
    #[test]
    fn known_coupling_coefficients() {
        let triple = TripleProduct::new(3, 3, 3);
        let unit = |i: usize| -> [f64; 9] { std::array::from_fn(|k| f64::from(u8::from(k == i))) };
        let found = triple.integrate(&unit(2), &unit(2), &unit(6));
        assert!((found - 1.0 / (5.0 * std::f64::consts::PI).sqrt()).abs() < 1e-12, "{found}");
        // x² and y² share what z² leaves: Y_11² Y_20 = Y_1-1² Y_20 = -1/(2 √(5π)).
        for i in [1, 3] {
            let found = triple.integrate(&unit(i), &unit(i), &unit(6));
            assert!((found + 0.5 / (5.0 * std::f64::consts::PI).sqrt()).abs() < 1e-12, "{found}");
        }
    }

    /// Catches zeros that are kept: of the 729 products of three times 3 bands, symmetry leaves 83.
    #[test]
    fn the_table_is_sparse() {
        assert_eq!(TripleProduct::new(3, 3, 3).entry_count(), 83);
    }

    /// Catches a contraction that differs from the sum it stands for.
    #[test]
    fn contracting_the_light_first_changes_nothing() {
        let triple = TripleProduct::new(5, 3, 4);
        let value = |seed: usize, i: usize| ((seed * 37 + i * 17) % 23) as f64 / 11.0 - 1.0;
        let light: Vec<f64> = (0..25).map(|i| value(1, i)).collect();
        let visibility: Vec<f64> = (0..9).map(|i| value(2, i)).collect();
        let cosine: Vec<f64> = (0..16).map(|i| value(3, i)).collect();
        let matrix = triple.contract(&light);
        let sum: f64 = (0..16)
            .flat_map(|k| (0..9).map(move |j| (k, j)))
            .map(|(k, j)| matrix[k * 9 + j] * cosine[k] * visibility[j])
            .sum();
        assert!((sum - triple.integrate(&light, &visibility, &cosine)).abs() < 1e-12);
    }
}
