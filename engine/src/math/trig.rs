//! Sine and cosine with the same bits on every machine: polynomials in double precision, no library calls.

/// Cosine and sine of `turns` full turns, to within 1e-14.
///
/// Taylor polynomials on an eighth of a turn; multiplications and additions only, none of them fused.
pub fn cos_sin_turns(turns: f64) -> (f64, f64) {
    let quarter = (4.0 * (turns - turns.floor())).round();
    let angle = (turns - turns.floor() - 0.25 * quarter) * std::f64::consts::TAU;
    let square = angle * angle;
    let series = |first: f64, start: f64| {
        let (mut sum, mut term, mut k) = (first, first, start);
        for _ in 0..10 {
            term = -term * square / (k * (k + 1.0));
            sum += term;
            k += 2.0;
        }
        sum
    };
    let (cos, sin) = (series(1.0, 1.0), series(angle, 2.0));
    match quarter as i32 & 3 {
        0 => (cos, sin),
        1 => (-sin, cos),
        2 => (-cos, -sin),
        _ => (sin, -cos),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a wrong quadrant or a series that stops too early.
    #[test]
    fn agrees_with_the_library() {
        for i in -1000..1000 {
            let turns = f64::from(i) * 0.003_7;
            let (cos, sin) = cos_sin_turns(turns);
            let (sin_std, cos_std) = (turns * std::f64::consts::TAU).sin_cos();
            assert!((cos - cos_std).abs() < 1e-13 && (sin - sin_std).abs() < 1e-13, "{turns}");
        }
    }
}
