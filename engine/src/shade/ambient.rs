//! Ambient occlusion and the bent normal: what the coefficients of visibility say of them, exactly and at no cost.
//!
//! Over the hemisphere band 1 is b = ∫ T(ω) ω dω but for a factor, so that the share of the cosine-weighted hemisphere that is
//! open is ∫ T (n·ω) dω / π = n·b / π, and b points to where the open directions are. With cosine weight b has the cosine in
//! it, and the share is band 0; over the sphere, which has no cosine, band 0 is the share of all directions.

use glam::Vec3;

use super::sample::Spread;

const Y_0: f32 = 0.282_094_79;
const Y_1: f32 = 0.488_602_51;

/// Bands that are needed.
pub const BANDS_MIN: u32 = 2;

/// The open share, from 0 to 1, and the unit vector to the middle of what is open; `normal` where nothing is.
///
/// `coefficients` are visibility in [`BANDS_MIN`] bands and more. `mean_cosine` is that of the point's directions to its normal:
/// what is wholly open has the share 1 exactly, whatever the rays' rotation.
pub fn from_coefficients(
    coefficients: &[f32],
    normal: Vec3,
    spread: Spread,
    mean_cosine: f32,
) -> (f32, Vec3) {
    use std::f32::consts::{PI, TAU};
    let [all, y, z, x] = std::array::from_fn(|i| coefficients[i]);
    let bent = Vec3::new(x, y, z) / Y_1;
    let share = match spread {
        Spread::Hemisphere => normal.dot(bent) / (TAU * mean_cosine),
        Spread::CosineHemisphere => all / (Y_0 * PI),
        Spread::Sphere => all / (Y_0 * 2.0 * TAU),
    };
    (share.clamp(0.0, 1.0), bent.try_normalize().unwrap_or(normal))
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;
    use crate::brick::bundle::Bundle;
    use crate::shade::sample::Sampler;
    use crate::shade::sh_occlusion::project;

    /// What a point finds about `normal` whose directions are open where `is_open` says so.
    fn found(spread: Spread, normal: Vec3, index: u64, is_open: impl Fn(Vec3) -> bool) -> (f32, Vec3) {
        let sampler = Sampler::new(4096, 3, 4);
        let mut bundle = Bundle::new();
        bundle.push_origin(IVec3::ZERO);
        sampler.push_rays(index, normal, spread, 0..4096, &mut bundle);
        for ray in 0..4096 {
            if !is_open(Vec3::from_slice(&bundle.directions[ray][..3])) {
                bundle.extinguish(ray as u16, 1 << 24);
            }
        }
        let mut coefficients = [0.0; 4];
        project(&bundle, 0..4096, &sampler, spread, 2, &mut coefficients);
        from_coefficients(&coefficients, normal, spread, sampler.mean_cosine(index))
    }

    /// Catches a factor that is lost, and an open point that is not exactly open whatever its rotation.
    #[test]
    fn what_is_open_has_the_share_one() {
        let normal = Vec3::new(0.48, -0.64, 0.6);
        for spread in [Spread::Hemisphere, Spread::CosineHemisphere, Spread::Sphere] {
            for index in 0..8 {
                let (open, bent) = found(spread, normal, index, |_| true);
                assert!((open - 1.0).abs() < 1e-4, "{spread:?}: {open}");
                assert!(spread == Spread::Sphere || bent.dot(normal) > 0.999_9, "{spread:?}: {bent}");
            }
        }
    }

    /// Catches a wrong weight: a cap of 60 degrees about the normal has the share sin² 60°, its rest the share cos² 60°.
    #[test]
    fn a_cap_has_its_share() {
        for spread in [Spread::Hemisphere, Spread::CosineHemisphere] {
            let (cap, _) = found(spread, Vec3::Y, 1, |d| d.y > 0.5);
            let (ring, _) = found(spread, Vec3::Y, 1, |d| d.y <= 0.5);
            assert!((cap - 0.75).abs() < 2e-3 && (ring - 0.25).abs() < 2e-3, "{spread:?}: {cap} {ring}");
        }
        let (half, bent) = found(Spread::Sphere, Vec3::Z, 1, |d| d.x > 0.0);
        assert!((half - 0.5).abs() < 2e-3 && bent.x > 0.999, "{half} {bent}");
    }

    /// Catches a bent normal that does not bend: a wall beside a point leaves a quarter of the sphere, whose middle leans by
    /// 45 degrees.
    #[test]
    fn a_wall_bends_the_normal_away() {
        let (half, bent) = found(Spread::Hemisphere, Vec3::Z, 5, |d| d.x > 0.0);
        let middle = Vec3::new(1.0, 0.0, 1.0).normalize();
        assert!((half - 0.5).abs() < 2e-3 && bent.dot(middle) > 0.999, "{half} {bent}");
        let (none, bent) = found(Spread::Hemisphere, Vec3::Z, 5, |_| false);
        assert_eq!((none, bent), (0.0, Vec3::Z));
    }
}
