//! Real spherical harmonics: evaluation, projection, the clamped cosine, and the triple product.
//!
//! The basis is orthonormal over the sphere. Coefficient (l, m) has the index `l(l+1) + m`. Signs are those of
//! Ramamoorthi and Hanrahan ("An Efficient Representation for Irradiance Environment Maps", 2001): no
//! Condon-Shortley phase, so that Y_1,-1 = +0.488603 y, Y_10 = +0.488603 z and Y_11 = +0.488603 x.

use glam::{DVec3, Vec3};

mod quadrature;
mod triple;

pub use quadrature::gauss_legendre;
pub use triple::TripleProduct;

/// Bands at most.
pub const BANDS_MAX: usize = 6;

/// Coefficients at most: `BANDS_MAX`².
pub const COEFFICIENTS_MAX: usize = BANDS_MAX * BANDS_MAX;

/// Coefficients of `bands` bands.
pub const fn coefficient_count(bands: usize) -> usize {
    bands * bands
}

/// Bands of `coefficients` coefficients; none unless it is the square of 1 to 6.
pub const fn bands_of(coefficients: usize) -> Option<usize> {
    let mut bands = 1;
    while bands <= BANDS_MAX {
        if bands * bands == coefficients {
            return Some(bands);
        }
        bands += 1;
    }
    None
}

/// The index of coefficient (l, m), |m| <= l.
pub const fn index(l: usize, m: isize) -> usize {
    (l * (l + 1)).strict_add_signed(m)
}

/// Writes one evaluation routine for a scalar type: single precision for work, double precision for tables and tests.
macro_rules! evaluation {
    ($(#[$doc:meta])* $name:ident, $scalar:ty, $vector:ty) => {
        $(#[$doc])*
        #[inline]
        #[allow(clippy::excessive_precision, reason = "one table of constants serves both precisions")]
        pub fn $name(bands: usize, d: $vector, out: &mut [$scalar]) {
            assert!((1..=BANDS_MAX).contains(&bands), "{bands} bands, 1 to {BANDS_MAX} are possible");
            let out = &mut out[..bands * bands];
            let (x, y, z) = (d.x, d.y, d.z);
            out[0] = 0.282_094_791_773_878_14;
            if bands == 1 {
                return;
            }
            out[1] = 0.488_602_511_902_919_9 * y;
            out[2] = 0.488_602_511_902_919_9 * z;
            out[3] = 0.488_602_511_902_919_9 * x;
            if bands == 2 {
                return;
            }
            // cN and sN are the real and imaginary parts of (x + iy)^N.
            let zz = z * z;
            let (c2, s2) = (x * x - y * y, 2.0 * x * y);
            let p21 = 1.092_548_430_592_079_2 * z;
            out[4] = 0.546_274_215_296_039_6 * s2;
            out[5] = p21 * y;
            out[6] = 0.315_391_565_252_520_05 * (3.0 * zz - 1.0);
            out[7] = p21 * x;
            out[8] = 0.546_274_215_296_039_6 * c2;
            if bands == 3 {
                return;
            }
            let (c3, s3) = (x * c2 - y * s2, x * s2 + y * c2);
            let p31 = 0.457_045_799_464_465_8 * (5.0 * zz - 1.0);
            let p32 = 1.445_305_721_320_277 * z;
            out[9] = 0.590_043_589_926_643_5 * s3;
            out[10] = p32 * s2;
            out[11] = p31 * y;
            out[12] = 0.373_176_332_590_115_4 * z * (5.0 * zz - 3.0);
            out[13] = p31 * x;
            out[14] = p32 * c2;
            out[15] = 0.590_043_589_926_643_5 * c3;
            if bands == 4 {
                return;
            }
            let (c4, s4) = (x * c3 - y * s3, x * s3 + y * c3);
            let p41 = 0.669_046_543_557_289_2 * z * (7.0 * zz - 3.0);
            let p42 = 0.473_087_347_878_780_04 * (7.0 * zz - 1.0);
            let p43 = 1.770_130_769_779_930_4 * z;
            out[16] = 0.625_835_735_449_176_1 * s4;
            out[17] = p43 * s3;
            out[18] = p42 * s2;
            out[19] = p41 * y;
            out[20] = 0.105_785_546_915_204_31 * ((35.0 * zz - 30.0) * zz + 3.0);
            out[21] = p41 * x;
            out[22] = p42 * c2;
            out[23] = p43 * c3;
            out[24] = 0.625_835_735_449_176_1 * c4;
            if bands == 5 {
                return;
            }
            let (c5, s5) = (x * c4 - y * s4, x * s4 + y * c4);
            let p51 = 0.452_946_651_195_696_94 * ((21.0 * zz - 14.0) * zz + 1.0);
            let p52 = 2.396_768_392_486_662 * z * (3.0 * zz - 1.0);
            let p53 = 0.489_238_299_435_250_4 * (9.0 * zz - 1.0);
            let p54 = 2.075_662_314_881_041_6 * z;
            out[25] = 0.656_382_056_840_170_1 * s5;
            out[26] = p54 * s4;
            out[27] = p53 * s3;
            out[28] = p52 * s2;
            out[29] = p51 * y;
            out[30] = 0.116_950_322_453_423_59 * z * ((63.0 * zz - 70.0) * zz + 15.0);
            out[31] = p51 * x;
            out[32] = p52 * c2;
            out[33] = p53 * c3;
            out[34] = p54 * c4;
            out[35] = 0.656_382_056_840_170_1 * c5;
        }
    };
}

evaluation! {
    /// Writes the `bands`² basis functions in direction `d`, a unit vector, to the head of `out`.
    ///
    /// Polynomials alone: the same bits on every machine. `d` must be of unit length to about 1e-6; other lengths
    /// are not normalised.
    ///
    /// # Panics
    /// When `bands` is not 1 to 6 or `out` is shorter than `bands`².
    evaluate, f32, Vec3
}

evaluation! {
    /// [`evaluate`] in double precision, for tables and tests.
    ///
    /// # Panics
    /// When `bands` is not 1 to 6 or `out` is shorter than `bands`².
    evaluate_f64, f64, DVec3
}

/// The clamped cosine max(0, n·ω) in spherical harmonics: it is zonal about its normal n.
pub struct ZonalCosine;

impl ZonalCosine {
    /// A_l: coefficient (l, m) of the clamped cosine about n is A_l Y_lm(n).
    ///
    /// A_l = 2π ∫₀¹ t P_l(t) dt (Ramamoorthi and Hanrahan 2001, equation 8, with their √(4π/(2l+1)) multiplied in).
    pub const BANDS: [f64; BANDS_MAX] = {
        use std::f64::consts::PI;
        [PI, 2.0 * PI / 3.0, PI / 4.0, 0.0, -PI / 24.0, 0.0]
    };

    /// Writes the `bands`² coefficients of the clamped cosine about the unit vector `normal` to the head of `out`.
    ///
    /// # Panics
    /// When `bands` is not 1 to 6 or `out` is shorter than `bands`².
    pub fn evaluate(bands: usize, normal: Vec3, out: &mut [f32]) {
        evaluate(bands, normal, out);
        for l in 0..bands {
            for value in &mut out[l * l..(l + 1) * (l + 1)] {
                *value *= Self::BANDS[l] as f32;
            }
        }
    }
}

/// Projects radiance to `bands` bands: per colour Σ L(ω) Y_lm(ω) Δω over `samples` of (direction, solid angle in
/// steradian, linear RGB). Coefficients past `bands`² are zero.
///
/// # Panics
/// When `bands` is not 1 to 6.
pub fn project(
    bands: usize,
    samples: impl IntoIterator<Item = (DVec3, f64, [f32; 3])>,
) -> [[f64; COEFFICIENTS_MAX]; 3] {
    let mut light = [[0.0; COEFFICIENTS_MAX]; 3];
    let mut basis = [0.0; COEFFICIENTS_MAX];
    let count = coefficient_count(bands);
    for (direction, solid_angle, rgb) in samples {
        evaluate_f64(bands, direction, &mut basis);
        for (coefficients, value) in light.iter_mut().zip(rgb) {
            let weight = f64::from(value) * solid_angle;
            for (sum, y) in coefficients[..count].iter_mut().zip(&basis) {
                *sum += weight * y;
            }
        }
    }
    light
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Directions and weights that integrate polynomials over the sphere: midpoints in z and φ, fine enough for 1e-6.
    fn sphere(mut visit: impl FnMut(DVec3, f64)) {
        let (rows, columns) = (20_000, 16);
        let weight = 4.0 * std::f64::consts::PI / f64::from(rows * columns);
        for row in 0..rows {
            let z = (2.0 * f64::from(row) + 1.0) / f64::from(rows) - 1.0;
            let r = (1.0 - z * z).sqrt();
            for column in 0..columns {
                let phi = std::f64::consts::TAU * (f64::from(column) + 0.5) / f64::from(columns);
                visit(DVec3::new(r * phi.cos(), r * phi.sin(), z), weight);
            }
        }
    }

    /// Catches a wrong constant or polynomial in any of the 36 functions.
    #[test]
    fn the_basis_is_orthonormal() {
        let mut gram = vec![0.0; COEFFICIENTS_MAX * COEFFICIENTS_MAX];
        sphere(|d, weight| {
            let mut y = [0.0; COEFFICIENTS_MAX];
            evaluate_f64(BANDS_MAX, d, &mut y);
            for i in 0..COEFFICIENTS_MAX {
                for j in 0..COEFFICIENTS_MAX {
                    gram[i * COEFFICIENTS_MAX + j] += weight * y[i] * y[j];
                }
            }
        });
        for (at, &value) in gram.iter().enumerate() {
            let (i, j) = (at / COEFFICIENTS_MAX, at % COEFFICIENTS_MAX);
            let expected = f64::from(u8::from(i == j));
            assert!((value - expected).abs() < 1e-6, "<Y_{i}, Y_{j}> = {value}");
        }
    }

    /// Catches a flipped sign or a swapped order, which orthonormality cannot see.
    #[test]
    fn signs_and_order_are_those_of_ramamoorthi_and_hanrahan() {
        let d = DVec3::new(2.0, 3.0, 6.0) / 7.0;
        let mut y = [0.0; COEFFICIENTS_MAX];
        evaluate_f64(BANDS_MAX, d, &mut y);
        let rh = [
            0.282095,
            0.488603 * d.y,
            0.488603 * d.z,
            0.488603 * d.x,
            1.092548 * d.x * d.y,
            1.092548 * d.y * d.z,
            0.315392 * (3.0 * d.z * d.z - 1.0),
            1.092548 * d.x * d.z,
            0.546274 * (d.x * d.x - d.y * d.y),
        ];
        for (i, expected) in rh.into_iter().enumerate() {
            assert!((y[i] - expected).abs() < 1e-6, "Y_{i} = {}, {expected} expected", y[i]);
        }
        // Without the Condon-Shortley phase every function is positive where (x + iy)^m and P_lm(z) are.
        let near_pole = DVec3::new(0.04, 0.01, 1.0).normalize();
        evaluate_f64(BANDS_MAX, near_pole, &mut y);
        for l in 1..BANDS_MAX {
            for m in 1..=l as isize {
                assert!(y[index(l, m)] > 0.0 && y[index(l, -m)] > 0.0, "Y_{l},±{m} is negative");
            }
        }
    }

    /// Catches an error in any band: Σ_m Y_lm(a) Y_lm(b) = (2l+1)/4π P_l(a·b).
    #[test]
    fn the_addition_theorem_holds() {
        let a = DVec3::new(0.3, -0.5, 0.7).normalize();
        let b = DVec3::new(-0.2, 0.9, 0.1).normalize();
        let (mut ya, mut yb) = ([0.0; COEFFICIENTS_MAX], [0.0; COEFFICIENTS_MAX]);
        evaluate_f64(BANDS_MAX, a, &mut ya);
        evaluate_f64(BANDS_MAX, b, &mut yb);
        let t = a.dot(b);
        let (mut before, mut legendre) = (0.0, 1.0);
        for l in 0..BANDS_MAX {
            let sum: f64 = (l * l..(l + 1) * (l + 1)).map(|i| ya[i] * yb[i]).sum();
            let degree = l as f64;
            let expected = (2.0 * degree + 1.0) / (4.0 * std::f64::consts::PI) * legendre;
            assert!((sum - expected).abs() < 1e-12, "band {l}: {sum}, {expected} expected");
            (before, legendre) =
                (legendre, ((2.0 * degree + 1.0) * t * legendre - degree * before) / (degree + 1.0));
        }
    }

    /// Catches a narrower copy that differs from the one under test.
    #[test]
    fn fewer_bands_and_single_precision_agree() {
        let d = DVec3::new(-0.6, 0.48, 0.64);
        let mut all = [0.0; COEFFICIENTS_MAX];
        evaluate_f64(BANDS_MAX, d, &mut all);
        for bands in 1..=BANDS_MAX {
            let mut y = [7.0_f32; COEFFICIENTS_MAX];
            evaluate(bands, d.as_vec3(), &mut y);
            for i in 0..COEFFICIENTS_MAX {
                let expected = if i < bands * bands { all[i] as f32 } else { 7.0 };
                assert!((y[i] - expected).abs() < 2e-6, "{bands} bands, Y_{i} = {}", y[i]);
            }
            assert_eq!(bands_of(coefficient_count(bands)), Some(bands));
        }
        assert_eq!([bands_of(0), bands_of(8), bands_of(49)], [None; 3]);
    }

    /// Catches a wrong A_l and a cosine turned the wrong way: the coefficients are compared with a quadrature.
    #[test]
    fn the_clamped_cosine_is_its_own_projection() {
        let normal = DVec3::new(0.48, -0.6, 0.64);
        // The cosine's edge is turned into the pole's frame, where midpoints in z meet it exactly.
        let tangent = normal.any_orthonormal_pair();
        let mut expected = [0.0; COEFFICIENTS_MAX];
        sphere(|d, weight| {
            let mut y = [0.0; COEFFICIENTS_MAX];
            evaluate_f64(BANDS_MAX, tangent.0 * d.x + tangent.1 * d.y + normal * d.z, &mut y);
            expected.iter_mut().zip(y).for_each(|(sum, y)| *sum += weight * d.z.max(0.0) * y);
        });
        let mut cosine = [0.0_f32; COEFFICIENTS_MAX];
        ZonalCosine::evaluate(BANDS_MAX, normal.as_vec3(), &mut cosine);
        for i in 0..COEFFICIENTS_MAX {
            assert!((f64::from(cosine[i]) - expected[i]).abs() < 2e-6, "{i}: {} {}", cosine[i], expected[i]);
        }
    }

    /// Catches a projection that forgets the solid angle or mixes colours.
    #[test]
    fn projecting_a_band_limited_function_returns_it() {
        let (nodes, weights) = gauss_legendre(8);
        let mut samples = Vec::new();
        for (z, weight) in nodes.iter().zip(&weights) {
            for column in 0..16 {
                let phi = std::f64::consts::TAU * f64::from(column) / 16.0;
                let r = (1.0 - z * z).sqrt();
                let d = DVec3::new(r * phi.cos(), r * phi.sin(), *z);
                let mut y = [0.0; 9];
                evaluate_f64(3, d, &mut y);
                let rgb = [1.0, (y[1] + 2.0 * y[7]) as f32, (3.0 * y[8]) as f32];
                samples.push((d, weight * std::f64::consts::TAU / 16.0, rgb));
            }
        }
        let light = project(3, samples);
        let mut expected = [[0.0; COEFFICIENTS_MAX]; 3];
        expected[0][0] = (4.0 * std::f64::consts::PI).sqrt();
        (expected[1][1], expected[1][7], expected[2][8]) = (1.0, 2.0, 3.0);
        for (color, (found, wanted)) in light.iter().zip(&expected).enumerate() {
            for i in 0..COEFFICIENTS_MAX {
                assert!((found[i] - wanted[i]).abs() < 1e-6, "colour {color}, {i}: {}", found[i]);
            }
        }
    }
}
