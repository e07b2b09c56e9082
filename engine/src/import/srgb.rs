//! sRGB bytes to linear light, by arithmetic whose bits are the same on every machine.

use std::sync::LazyLock;

/// Linear light of every sRGB byte (IEC 61966-2-1).
static LINEAR: LazyLock<[f32; 256]> =
    LazyLock::new(|| std::array::from_fn(|i| decode(i as f64 / 255.0) as f32));

/// The linear value, 0 to 1, of an sRGB byte.
pub(super) fn linear(byte: u8) -> f32 {
    LINEAR[usize::from(byte)]
}

/// The linear value, 0 to 1, of an sRGB value in 0 to 1.
pub(super) fn decode(value: f64) -> f64 {
    let value = value.clamp(0.0, 1.0);
    if value <= 0.04045 { value / 12.92 } else { power_2_4((value + 0.055) / 1.055) }
}

/// The byte of a linear value in 0 to 1; what is not a number is 0.
pub(super) fn unit_byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// `x^2.4` for x in (0, 1]: Newton's iteration for the fifth root of x^12. The standard library's `powf` may differ
/// between platforms in its last bit.
fn power_2_4(x: f64) -> f64 {
    let x4 = x * x * x * x;
    let x12 = x4 * x4 * x4;
    let mut y = 1.0_f64;
    // Starts above the root and falls by at least a fifth of the error a step: 64 steps suffice for x of 0.05 and up
    for _ in 0..64 {
        let y4 = y * y * y * y;
        y -= (y * y4 - x12) / (5.0 * y4);
    }
    y
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches an iteration that has not converged, or the wrong curve.
    #[test]
    fn bytes_follow_the_standard_curve() {
        for byte in 0..=255_u8 {
            let value = f64::from(byte) / 255.0;
            let expected = if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
            assert!((f64::from(linear(byte)) - expected).abs() < 1e-7, "byte {byte}");
        }
        assert_eq!([unit_byte(0.5), unit_byte(f32::NAN), unit_byte(7.0)], [128, 0, 255]);
    }
}
