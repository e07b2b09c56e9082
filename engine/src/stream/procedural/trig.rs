//! Sine and cosine whose bits are the same on every machine: only IEEE additions and products.

/// The golden angle in radians, by which successive leaves turn about their stem.
pub const GOLDEN_ANGLE: f32 = 2.399_963_2;

/// A full turn in radians.
pub const TURN: f32 = std::f32::consts::TAU;

/// Sine and cosine of `angle` in radians, to about 2e-7 for angles up to some thousand turns.
///
/// Reduced to an eighth of a turn in three parts (Cody and Waite), then the polynomials of S. Moshier's Cephes
/// `sinf` and `cosf`. The standard library's functions differ between platforms, which would break "same seed, same
/// bytes".
pub fn sincos(angle: f32) -> (f32, f32) {
    let quarter = (angle * std::f32::consts::FRAC_2_PI + 0.5).floor();
    let r = ((angle - quarter * 1.570_312_5) - quarter * 4.837_513e-4) - quarter * 7.549_79e-8;
    let r2 = r * r;
    let sin = r + r * r2 * (-1.666_665_5e-1 + r2 * (8.332_161e-3 - r2 * 1.951_529_6e-4));
    let cos = 1.0 - 0.5 * r2 + r2 * r2 * (4.166_664_6e-2 + r2 * (-1.388_731_6e-3 + r2 * 2.443_315_7e-5));
    match quarter as i64 & 3 {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Turns the unit vector `(cos, sin)` by the angle whose cosine and sine `step` holds.
pub fn turn((cos, sin): (f32, f32), step: (f32, f32)) -> (f32, f32) {
    (cos * step.0 - sin * step.1, sin * step.0 + cos * step.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a wrong quadrant, a wrong coefficient or a reduction that loses bits.
    #[test]
    fn agrees_with_the_standard_library() {
        for i in -20_000..20_000 {
            let angle = i as f32 * 0.003_7;
            let (sin, cos) = sincos(angle);
            assert!((sin - angle.sin()).abs() < 4e-7, "sin {angle}");
            assert!((cos - angle.cos()).abs() < 4e-7, "cos {angle}");
        }
    }

    /// Catches a change of bits, which would change every procedural stream.
    #[test]
    fn bits_are_frozen() {
        let bits = [0.1f32, 2.0, -7.5].map(|angle| sincos(angle).0.to_bits());
        assert_eq!(bits, [0x3dcc_7577, 0x3f68_c7b7, 0xbf70_20c4]);
    }
}
