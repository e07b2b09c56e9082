//! What came of a scenario: figures, what was wanted of them, and what contradicts itself.

use serde::Serialize;

/// What is wanted of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Wanted {
    /// No more than this.
    AtMost(f64),
    /// No less than this.
    AtLeast(f64),
    /// Nothing: it is told.
    Any,
}

/// A figure of a scenario.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Figure {
    /// What it says, with its unit.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// What is wanted of it.
    pub wanted: Wanted,
}

impl Figure {
    /// Whether it is as wanted; what is no number never is.
    pub fn passes(&self) -> bool {
        match self.wanted {
            Wanted::AtMost(most) => self.value <= most,
            Wanted::AtLeast(least) => self.value >= least,
            Wanted::Any => true,
        }
    }
}

/// What came of a scenario.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// The scenario.
    pub scenario: &'static str,
    /// Whether all figures are as wanted and nothing contradicts itself.
    pub passed: bool,
    /// How long it took.
    pub seconds: f64,
    /// Its figures.
    pub figures: Vec<Figure>,
    /// What contradicts itself, or could not be done.
    pub problems: Vec<String>,
}

impl Outcome {
    /// The outcome of figures and problems.
    pub fn new(scenario: &'static str, seconds: f64, figures: Vec<Figure>, problems: Vec<String>) -> Self {
        let passed = problems.is_empty() && figures.iter().all(Figure::passes);
        Self { scenario, passed, seconds, figures, problems }
    }

    /// Lines for people.
    pub fn text(&self) -> String {
        let verdict = if self.passed { "PASS" } else { "FAIL" };
        let mut lines = vec![format!("{verdict}  {}  ({:.1} s)", self.scenario, self.seconds)];
        for figure in &self.figures {
            let wanted = match figure.wanted {
                Wanted::AtMost(most) => format!("  at most {}", short(most)),
                Wanted::AtLeast(least) => format!("  at least {}", short(least)),
                Wanted::Any => String::new(),
            };
            let mark = if figure.passes() { ' ' } else { '!' };
            lines.push(format!("  {mark} {:<52} {:>10}{wanted}", figure.name, short(figure.value)));
        }
        lines.extend(self.problems.iter().map(|problem| format!("  ! {problem}")));
        lines.join("\n")
    }
}

/// A number with as many places as it needs.
fn short(value: f64) -> String {
    match value.abs() {
        size if value.fract() == 0.0 && size < 1e12 => format!("{value:.0}"),
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 1.0 => format!("{value:.2}"),
        _ => format!("{value:.4}"),
    }
}

/// A figure that is told.
pub fn told(name: &'static str, value: f64) -> Figure {
    Figure { name, value, wanted: Wanted::Any }
}

/// A figure that may not be greater.
pub fn at_most(name: &'static str, value: f64, most: f64) -> Figure {
    Figure { name, value, wanted: Wanted::AtMost(most) }
}

/// A figure that may not be less.
pub fn at_least(name: &'static str, value: f64, least: f64) -> Figure {
    Figure { name, value, wanted: Wanted::AtLeast(least) }
}

/// The value below which a share of the values lies; 0 where there are none.
pub fn percentile(values: &[f64], share: f64) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let place = (share * values.len() as f64).ceil() as usize;
    values.get(place.saturating_sub(1)).copied().unwrap_or(0.0)
}

/// Spearman's rank correlation of pairs, by which order follows order; no number where either is constant.
pub fn rank_correlation(pairs: &[(f64, f64)]) -> f64 {
    let first = ranks(pairs.iter().map(|pair| pair.0).collect());
    let second = ranks(pairs.iter().map(|pair| pair.1).collect());
    let mean = (pairs.len() as f64 + 1.0) / 2.0;
    let moment = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - mean) * (b - mean)).sum::<f64>();
    moment(&first, &second) / (moment(&first, &first) * moment(&second, &second)).sqrt()
}

/// Ranks from 1 on; equal values share the mean of theirs.
fn ranks(values: Vec<f64>) -> Vec<f64> {
    let rank = |value: &f64| {
        let below = values.iter().filter(|other| *other < value).count() as f64;
        let equal = values.iter().filter(|other| *other == value).count() as f64;
        below + (equal + 1.0) / 2.0
    };
    values.iter().map(rank).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a correlation that is not one, and a figure without a value that passes.
    #[test]
    fn figures_are_what_they_say() {
        let up: Vec<(f64, f64)> = (0..9).map(|i| (f64::from(i), f64::from(i * i))).collect();
        assert!((rank_correlation(&up) - 1.0).abs() < 1e-12);
        let down: Vec<(f64, f64)> = up.iter().map(|&(a, b)| (a, -b)).collect();
        assert!((rank_correlation(&down) + 1.0).abs() < 1e-12);
        // By hand: ranks 1 2 3 4 against 1.5 1.5 4 3
        let mixed = [(1.0, 5.0), (2.0, 5.0), (3.0, 9.0), (4.0, 7.0)];
        assert!((rank_correlation(&mixed) - 0.737_864_787_372_622).abs() < 1e-12);
        assert!(!at_least("x", rank_correlation(&[(1.0, 1.0), (2.0, 1.0)]), 0.5).passes());
        assert_eq!((percentile(&[3.0, 1.0, 2.0], 0.5), percentile(&[], 0.9)), (2.0, 0.0));
    }
}
