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
    add_up(bundle, range, sampler, spread, bands, |visibility, _| visibility, out);
}

/// Adds to `out`, of `bands²` numbers, half the differences between two estimates of the coefficients: from the rays of even and
/// of odd numbers of `range`. [`half_split_error`] is what they say.
pub fn project_halves(
    bundle: &Bundle,
    range: std::ops::Range<usize>,
    sampler: &Sampler,
    spread: Spread,
    bands: usize,
    out: &mut [f32],
) {
    let sign = |visibility: f32, i: usize| if i.is_multiple_of(2) { visibility } else { -visibility };
    add_up(bundle, range, sampler, spread, bands, sign, out);
}

/// The standard error of coefficients, as the root of its mean square over all of them: they are the means of two independent
/// estimates that differ by twice `halves`, see [`project_halves`].
///
/// Each half of a spherical Fibonacci set is spread a little less evenly than the whole, so that it says too much rather than too
/// little.
pub fn half_split_error(halves: &[f32]) -> f32 {
    (halves.iter().map(|half| half * half).sum::<f32>() / halves.len() as f32).sqrt()
}

/// Adds what `weight` makes of the visibility of each ray in `range` and of its number there.
#[inline(always)]
fn add_up(
    bundle: &Bundle,
    range: std::ops::Range<usize>,
    sampler: &Sampler,
    spread: Spread,
    bands: usize,
    weight: impl Fn(f32, usize) -> f32,
    out: &mut [f32],
) {
    let mut basis = [0.0; COEFFICIENTS_MAX];
    let mut sums = [0.0_f32; COEFFICIENTS_MAX];
    for (i, ray) in range.enumerate() {
        let visibility = sampler.visibility(bundle, ray);
        if visibility > 0.0 {
            let visibility = weight(visibility, i);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::bundle::RAYS_MAX;

    /// Coefficients of a point that sees what `is_open`, and the error that they are said to have.
    fn found(sampler: &Sampler, index: u64, is_open: impl Fn(Vec3) -> bool) -> ([f32; 9], f32) {
        let (samples, normal) = (sampler.samples(), Vec3::new(0.6, 0.0, 0.8));
        let mut bundle = Bundle::new();
        bundle.push_origin(glam::IVec3::ZERO);
        sampler.push_rays(index, normal, Spread::Hemisphere, 0..samples, &mut bundle);
        for (ray, d) in bundle.directions.clone().iter().enumerate() {
            if !is_open(Vec3::from_slice(&d[..3])) {
                bundle.extinguish(ray as u16, 1 << 24);
            }
        }
        let (mut coefficients, mut halves) = ([0.0; 9], [0.0; 9]);
        let all = 0..samples as usize;
        project(&bundle, all.clone(), sampler, Spread::Hemisphere, 3, &mut coefficients);
        project_halves(&bundle, all, sampler, Spread::Hemisphere, 3, &mut halves);
        (coefficients, half_split_error(&halves))
    }

    /// Catches an error that is not the one that is made: against many more rays, over many points, where the sky is chequered.
    #[test]
    fn the_error_is_what_more_rays_say() {
        let is_open = |d: Vec3| (d * 7.3).floor().as_ivec3().element_sum() % 2 == 0;
        let (mut truth, sampler) = ([0.0; 9], Sampler::new(RAYS_MAX as u32, 1, 2));
        for index in 0..8 {
            let (more, _) = found(&sampler, 1000 + index, is_open);
            truth.iter_mut().zip(more).for_each(|(truth, c)| *truth += c / 8.0);
        }
        for samples in [64, 512] {
            let sampler = Sampler::new(samples, 1, 2);
            let (mut made, mut said) = (0.0, 0.0);
            for index in 0..200 {
                let (coefficients, error) = found(&sampler, index, is_open);
                made += coefficients.iter().zip(truth).map(|(c, t)| (c - t) * (c - t)).sum::<f32>() / 9.0;
                said += error * error;
            }
            let ratio = (said / made).sqrt();
            assert!((0.9..1.8).contains(&ratio), "{samples} rays: {ratio}");
        }
        assert_eq!(found(&sampler, 1, |_| false).1, 0.0);
    }
}
