//! Gauss-Legendre quadrature, exact for polynomials in z.

/// The `n` nodes in (-1, 1), ascending, and their weights, which sum to 2: exact for polynomials of degree 2n - 1.
///
/// Newton's iteration on P_n from the Chebyshev estimate (Press et al., "Numerical Recipes", section 4.6).
///
/// # Panics
/// When `n` is 0 or more than 64.
pub fn gauss_legendre(n: usize) -> (Vec<f64>, Vec<f64>) {
    assert!((1..=64).contains(&n), "{n} nodes, 1 to 64 are possible");
    let (mut nodes, mut weights) = (Vec::with_capacity(n), Vec::with_capacity(n));
    for i in (0..n).rev() {
        let mut z = (std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
        // Converges quadratically: five steps reach the last bit, the rest cost nothing.
        for _ in 0..10 {
            let (value, slope) = legendre(n, z);
            z -= value / slope;
        }
        let (_, slope) = legendre(n, z);
        nodes.push(z);
        weights.push(2.0 / ((1.0 - z * z) * slope * slope));
    }
    (nodes, weights)
}

/// P_n(z) and its derivative, |z| < 1.
fn legendre(n: usize, z: f64) -> (f64, f64) {
    let (mut before, mut value) = (0.0, 1.0);
    for degree in 0..n {
        let k = degree as f64;
        (before, value) = (value, ((2.0 * k + 1.0) * z * value - k * before) / (k + 1.0));
    }
    (value, n as f64 * (z * value - before) / (z * z - 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a wrong node or weight: z^k must integrate to 2/(k+1) up to the promised degree, and not beyond.
    #[test]
    fn it_is_exact_to_its_degree_and_no_further() {
        for n in [1, 2, 8, 12] {
            let (nodes, weights) = gauss_legendre(n);
            let integral =
                |k: usize| -> f64 { nodes.iter().zip(&weights).map(|(z, w)| w * z.powi(k as i32)).sum() };
            for k in 0..2 * n {
                let expected = if k % 2 == 0 { 2.0 / (k as f64 + 1.0) } else { 0.0 };
                assert!((integral(k) - expected).abs() < 1e-13, "n {n}, degree {k}: {}", integral(k));
            }
            assert!((integral(2 * n) - 2.0 / (2.0 * n as f64 + 1.0)).abs() > 1e-8, "n {n}");
        }
    }
}
