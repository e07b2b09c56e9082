//! The bases of curves: which control points a span has, and how they weigh along it.

use glam::DVec3;

/// What a curve's control points mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Basis {
    /// Corners of a line.
    Linear,
    /// Cubic Bézier spans, three points further each.
    Bezier,
    /// Uniform cubic B-spline.
    BSpline,
    /// Catmull-Rom spline, through its points.
    CatmullRom,
}

/// How a curve ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wrap {
    /// Where its basis ends.
    Open,
    /// Where it begins.
    Periodic,
    /// At its first and last point, by points that are made up beyond them.
    Pinned,
}

/// A weighted control point.
pub(super) type Weight = (usize, f64);

impl Basis {
    /// Spans of a curve of `points` control points; none for a number that the basis cannot have.
    pub fn spans(self, wrap: Wrap, points: usize) -> Option<usize> {
        match (self, wrap) {
            (Self::Linear, Wrap::Periodic) => (points >= 3).then_some(points),
            (Self::Linear, _) => (points >= 2).then(|| points - 1),
            (Self::Bezier, Wrap::Periodic) => (points >= 3 && points.is_multiple_of(3)).then_some(points / 3),
            (Self::Bezier, _) => (points >= 4 && points % 3 == 1).then(|| (points - 1) / 3),
            (_, Wrap::Periodic) => (points >= 3).then_some(points),
            (_, Wrap::Open) => (points >= 4).then(|| points - 3),
            (_, Wrap::Pinned) => (points >= 2).then(|| points - 1),
        }
    }

    /// The four control points of a span as sums of the curve's points; two for a line.
    pub fn control(self, wrap: Wrap, points: usize, span: usize) -> Vec<Vec<Weight>> {
        let at = |index: usize| vec![(index % points, 1.0)];
        match (self, wrap) {
            (Self::Linear, _) => (0..2).map(|i| at(span + i)).collect(),
            (Self::Bezier, _) => (0..4).map(|i| at(3 * span + i)).collect(),
            (_, Wrap::Open | Wrap::Periodic) => (0..4).map(|i| at(span + i)).collect(),
            // Beyond an end the line goes straight on
            (_, Wrap::Pinned) => (0..4)
                .map(|i| match span + i {
                    0 => vec![(0, 2.0), (1, -1.0)],
                    index if index > points => vec![(points - 1, 2.0), (points - 2, -1.0)],
                    index => at(index - 1),
                })
                .collect(),
        }
    }

    /// How the control points of a span weigh at `t` from 0 to 1.
    pub fn weights(self, t: f64) -> [f64; 4] {
        let s = 1.0 - t;
        match self {
            Self::Linear => [s, t, 0.0, 0.0],
            Self::Bezier => [s * s * s, 3.0 * t * s * s, 3.0 * t * t * s, t * t * t],
            Self::BSpline => [
                s * s * s / 6.0,
                (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
                (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0,
                t * t * t / 6.0,
            ],
            Self::CatmullRom => [
                0.5 * (-t * s * s),
                0.5 * (2.0 + t * t * (3.0 * t - 5.0)),
                0.5 * (2.0 + s * s * (3.0 * s - 5.0)),
                0.5 * (-s * t * t),
            ],
        }
    }

    /// The largest second derivative along a span: at one of its ends, since it is linear between.
    pub fn bend(self, points: &[DVec3; 4]) -> f64 {
        let [a, b, c, d] = *points;
        let ends = match self {
            Self::Linear => return 0.0,
            Self::Bezier => [6.0 * (a - 2.0 * b + c), 6.0 * (b - 2.0 * c + d)],
            Self::BSpline => [a - 2.0 * b + c, b - 2.0 * c + d],
            Self::CatmullRom => [2.0 * a - 5.0 * b + 4.0 * c - d, -a + 4.0 * b - 5.0 * c + 2.0 * d],
        };
        ends[0].length().max(ends[1].length())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(basis: Basis, wrap: Wrap, points: &[f64], span: usize, t: f64) -> f64 {
        let weights = basis.weights(t);
        let control = basis.control(wrap, points.len(), span);
        control
            .iter()
            .zip(weights)
            .map(|(sum, w)| w * sum.iter().map(|&(i, w)| w * points[i]).sum::<f64>())
            .sum()
    }

    /// Catches a basis whose weights do not sum to one, or spans that do not meet.
    #[test]
    fn spans_join_and_reproduce_lines() {
        let line: Vec<f64> = (0..7).map(f64::from).collect();
        for basis in [Basis::Linear, Basis::Bezier, Basis::BSpline, Basis::CatmullRom] {
            for wrap in [Wrap::Open, Wrap::Pinned] {
                let spans = basis.spans(wrap, line.len()).unwrap();
                let step = if basis == Basis::Bezier { 3.0 } else { 1.0 };
                let first = point(basis, wrap, &line, 0, 0.0);
                for span in 0..spans {
                    for t in [0.0, 0.25, 1.0] {
                        let expected = first + step * (span as f64 + t);
                        assert!(
                            (point(basis, wrap, &line, span, t) - expected).abs() < 1e-12,
                            "{basis:?} {wrap:?}"
                        );
                    }
                }
            }
        }
        let pinned =
            [Basis::BSpline, Basis::CatmullRom].map(|b| point(b, Wrap::Pinned, &[5.0, 1.0, 7.0], 1, 1.0));
        assert_eq!(pinned, [7.0; 2]);
        assert_eq!(Basis::Bezier.spans(Wrap::Open, 5), None);
        assert_eq!(Basis::BSpline.spans(Wrap::Periodic, 4), Some(4));
    }

    /// Catches a bound on the bend that is below it somewhere along the span.
    #[test]
    fn the_bend_is_that_of_the_span() {
        let points =
            [DVec3::ZERO, DVec3::new(1.0, 3.0, 0.0), DVec3::new(2.0, -1.0, 4.0), DVec3::new(5.0, 0.0, 1.0)];
        for basis in [Basis::Bezier, Basis::BSpline, Basis::CatmullRom] {
            let at = |t: f64| -> DVec3 { basis.weights(t).iter().zip(points).map(|(&w, p)| w * p).sum() };
            let h = 1e-3;
            let found = (1..1000)
                .map(|i| f64::from(i) / 1000.0)
                .map(|t| ((at(t + h) - 2.0 * at(t) + at(t - h)) / (h * h)).length());
            let largest = found.fold(0.0, f64::max);
            let bend = basis.bend(&points);
            assert!(largest <= bend * 1.001 && largest > 0.99 * bend, "{basis:?} {largest} {bend}");
        }
    }
}
