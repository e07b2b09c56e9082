//! The `sh_occlusion` shader: visibility projected to spherical harmonics.
//!
//! V_lm(x) = ∫ T(x, ω) Y_lm(ω) dω over the hemisphere about the normal or the sphere, where T is the product of
//! (1 - opacity) along the ray; with cosine weight the integrand has the clamped cosine to the normal besides.

use glam::Vec3;

use super::sample::{Sampler, Spread};
use super::sh::{self, COEFFICIENTS_MAX};
use crate::brick::bundle::Bundle;

/// Adds the rays `range` of a bundle to the `bands²` coefficients `out`.
pub fn project(
    bundle: &Bundle,
    range: std::ops::Range<usize>,
    sampler: &Sampler,
    spread: Spread,
    bands: usize,
    out: &mut [f32],
) {
    let mut basis = [0.0; COEFFICIENTS_MAX];
    let mut sums = [0.0_f32; COEFFICIENTS_MAX];
    for ray in range {
        let visibility = sampler.visibility(bundle, ray);
        if visibility > 0.0 {
            sh::evaluate(bands, Vec3::from_slice(&bundle.directions[ray][..3]), &mut basis);
            for (sum, y) in sums.iter_mut().zip(&basis[..bands * bands]) {
                *sum += visibility * y;
            }
        }
    }
    let measure = spread.measure(sampler.samples());
    for (out, sum) in out.iter_mut().zip(&sums[..bands * bands]) {
        *out += measure * sum;
    }
}
