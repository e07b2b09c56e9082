//! From visibility at a point to outgoing radiance: the triple product with the light contracted once.

use glam::Vec3;

use crate::scene::Weight;
use crate::shade::sh::{COEFFICIENTS_MAX, TripleProduct, ZonalCosine, coefficient_count, evaluate};

/// What turns visibility coefficients into reflected light, for one environment.
///
/// Uniform visibility: E = Σ_ijk L_i V_j C_k T_ijk with C the clamped cosine about the normal, so that a point
/// costs 3 · cosine² · visibility² multiplications. Cosine-weighted visibility has the cosine in it: E = Σ_j L_j V_j.
#[derive(Clone, Debug)]
pub struct Transfer {
    cosine_bands: usize,
    visibility_count: usize,
    /// Per colour, per cosine coefficient (one only when V is cosine weighted): a row of `visibility_count`. The
    /// cosine's A_l and the 1/π of a diffuse reflector are multiplied in.
    matrix: Vec<f32>,
    rows: usize,
}

impl Transfer {
    /// For `light` of so many bands (per colour), visibility of `visibility_bands`, and the clamped cosine in
    /// `cosine_bands`, which count for uniformly weighted visibility only.
    ///
    /// # Panics
    /// When a number of bands is not 1 to 6.
    pub fn new(
        light: &[[f64; COEFFICIENTS_MAX]; 3],
        light_bands: usize,
        visibility_bands: usize,
        cosine_bands: usize,
        weight: Weight,
    ) -> Self {
        use std::f64::consts::FRAC_1_PI;
        let visibility_count = coefficient_count(visibility_bands);
        let rows = if weight == Weight::Cosine { 1 } else { coefficient_count(cosine_bands) };
        let mut matrix = Vec::with_capacity(3 * rows * visibility_count);
        if weight == Weight::Cosine {
            let shared = coefficient_count(light_bands).min(visibility_count);
            for color in light {
                let lit = |j: usize| if j < shared { color[j] * FRAC_1_PI } else { 0.0 };
                matrix.extend((0..visibility_count).map(|j| lit(j) as f32));
            }
        } else {
            let triple = TripleProduct::new(light_bands, visibility_bands, cosine_bands);
            for color in light {
                for (at, value) in triple.contract(color).into_iter().enumerate() {
                    let l = (at / visibility_count).isqrt();
                    matrix.push((value * ZonalCosine::BANDS[l] * FRAC_1_PI) as f32);
                }
            }
        }
        Self {
            cosine_bands: if weight == Weight::Cosine { 0 } else { cosine_bands },
            visibility_count,
            matrix,
            rows,
        }
    }

    /// Radiance that a white diffuse reflector sends out, before negative values are clamped.
    ///
    /// Without a normal the clamped cosine is averaged over all normals, which leaves its band 0. It is not asked
    /// for when V is cosine weighted.
    pub fn radiance(&self, normal: Option<Vec3>, visibility: &[f32]) -> [f32; 3] {
        let mut basis = [0.0; COEFFICIENTS_MAX];
        let used = match normal {
            _ if self.cosine_bands == 0 => {
                basis[0] = 1.0;
                1
            }
            Some(normal) => {
                evaluate(self.cosine_bands, normal, &mut basis);
                self.rows
            }
            None => {
                evaluate(1, Vec3::Z, &mut basis);
                1
            }
        };
        let count = self.visibility_count;
        std::array::from_fn(|color| {
            let matrix = &self.matrix[color * self.rows * count..][..used * count];
            // Rows are added first: this loop runs over neighbours in memory, and the compiler makes it SIMD.
            let mut transfer = [0.0; COEFFICIENTS_MAX];
            for (row, &y) in matrix.chunks_exact(count).zip(&basis) {
                for (sum, &m) in transfer[..count].iter_mut().zip(row) {
                    *sum += m * y;
                }
            }
            transfer.iter().zip(&visibility[..count]).map(|(t, v)| t * v).sum()
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::relight::environment::{Environment, Window};
    use crate::shade::sh::{evaluate_f64, gauss_legendre};

    /// Coefficients of the open hemisphere about +z in 6 bands, weighted, by quadrature.
    fn open_hemisphere(weight: impl Fn(f64) -> f64) -> [f32; COEFFICIENTS_MAX] {
        let (nodes, weights) = gauss_legendre(16);
        let mut sum = [0.0; COEFFICIENTS_MAX];
        for (node, step) in nodes.iter().zip(&weights) {
            let z = 0.5 * (node + 1.0);
            let r = (1.0 - z * z).sqrt();
            for column in 0..16 {
                let phi = std::f64::consts::TAU * f64::from(column) / 16.0;
                let mut y = [0.0; COEFFICIENTS_MAX];
                evaluate_f64(6, glam::DVec3::new(r * phi.cos(), r * phi.sin(), z), &mut y);
                let solid_angle = 0.5 * step * std::f64::consts::TAU / 16.0;
                sum.iter_mut().zip(y).for_each(|(sum, y)| *sum += weight(z) * solid_angle * y);
            }
        }
        sum.map(|value| value as f32)
    }

    /// Catches a lost factor anywhere between environment and radiance, by a white furnace: under L = 1 an open
    /// hemisphere reflects exactly 1 in any number of bands from 2 up. It is half a constant plus an odd function;
    /// the clamped cosine is z/2 plus an even one; so V·C integrates to bands 0 and 1 alone: π/2 + π/2.
    #[test]
    fn a_white_furnace_is_white() {
        let open = open_hemisphere(|_| 1.0);
        assert!(
            (open[0] - 1.772_454).abs() < 1e-5 && (open[2] - 1.534_99).abs() < 1e-5 && open[6].abs() < 1e-6
        );
        let environment = Environment::uniform([1.0, 0.5, 0.25]);
        for bands in 1..=6 {
            let light = environment.project(bands, DMat3::IDENTITY, Window::None);
            let transfer = Transfer::new(&light, bands, bands, bands, Weight::Uniform);
            let found = transfer.radiance(Some(Vec3::Z), &open);
            // One band knows of no direction: V_00 C_00 / π = 1/2.
            let expected = if bands == 1 { 0.5 } else { 1.0 };
            for (value, scale) in found.into_iter().zip([1.0, 0.5, 0.25]) {
                assert!((value - expected * scale).abs() < 1e-5, "{bands} bands: {found:?}");
            }
            // Seen from behind, the same hemisphere reflects nothing of it.
            let behind = transfer.radiance(Some(Vec3::NEG_Z), &open);
            assert!(bands == 1 || behind[0].abs() < 1e-5, "{bands} bands: {behind:?}");
        }
    }

    /// Catches cosine-weighted visibility that is weighted twice, or not divided by π.
    #[test]
    fn cosine_weighted_visibility_is_a_dot_product() {
        let environment = Environment::uniform([2.0; 3]);
        let light = environment.project(3, DMat3::IDENTITY, Window::None);
        let transfer = Transfer::new(&light, 3, 3, 3, Weight::Cosine);
        for normal in [None, Some(Vec3::X)] {
            let [r, ..] = transfer.radiance(normal, &open_hemisphere(|z| z));
            assert!((r - 2.0).abs() < 1e-5, "{r}");
        }
    }

    /// Catches a transfer with mixed numbers of bands that is not the triple product's sum.
    #[test]
    fn it_is_the_triple_product() {
        let axis = glam::DVec3::new(0.6, 0.0, 0.8);
        let map = crate::relight::LatLong::from_fn(64, 32, |d| [(2.0 * d.dot(axis)).exp() as f32, 1.0, 0.0]);
        let light = Environment::from_map(map).project(5, DMat3::IDENTITY, Window::Hann);
        let visibility: [f32; 9] = std::array::from_fn(|i| 1.0 / (i as f32 + 1.0));
        let normal = Vec3::new(0.0, 0.6, 0.8);
        let mut cosine = [0.0; 16];
        ZonalCosine::evaluate(4, normal, &mut cosine);
        let expected = TripleProduct::new(5, 3, 4).integrate(
            &light[0],
            &visibility.map(f64::from),
            &cosine.map(f64::from),
        ) * std::f64::consts::FRAC_1_PI;
        let [found, ..] = Transfer::new(&light, 5, 3, 4, Weight::Uniform).radiance(Some(normal), &visibility);
        assert!((f64::from(found) - expected).abs() < 1e-5 * expected.abs(), "{found}, {expected} expected");
    }
}
