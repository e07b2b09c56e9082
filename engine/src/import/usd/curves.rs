//! BasisCurves prims: curves of all bases become lines of varying radius.

use std::ops::Range;

use glam::DVec3;

use super::basis::{Basis, Weight, Wrap};
use super::dress::{Elements, dress};
use super::points::widths;
use super::primvar::{Interpolation, Values};
use super::read::{Geometry, Stage};
use super::value;
use super::walk::Prim;
use crate::Result;
use crate::import::mesh::Face;
use crate::stream::Attribute;

const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

/// Lines of a span at most.
const LINES_MAX: f64 = 32.0;

/// A point on a curve, as sums of what the prim has.
#[derive(Default)]
struct Sample {
    curve: u32,
    /// Control points of the prim and their weights.
    vertex: Vec<Weight>,
    /// Values of the prim per end of a span, and the share of the second.
    varying: (u32, u32, f32),
}

/// Points of the curves that are read at once, about: some 100 MB with all that is made of them.
pub(super) const PART_POINTS: usize = if cfg!(test) { 1 << 12 } else { 1 << 17 };

/// Samples for each point, about: curves that bend much have more.
pub(super) const SAMPLES_PER_POINT: usize = 3;

/// Bytes of a sample, and of what stays in memory for each point of the prim: its place, width and number.
pub(super) const SAMPLE_BYTES: u64 = 144;
pub(super) const POINT_BYTES: u64 = 40;

/// Reads the curves of one of the prim's parts: those whose first point is one of its [`PART_POINTS`].
pub(super) fn read(stage: &Stage, prim: &Prim, part: usize, attributes: &[Attribute]) -> Result<Geometry> {
    let path = prim.path.as_str();
    let mut geometry = Geometry::default();
    let points = stage.value(path, "points").and_then(|value| value::vectors(&value)).unwrap_or_default();
    let counts = stage.integers(path, "curveVertexCounts").unwrap_or_default();
    let total: i64 = counts.iter().map(|&count| count.clamp(0, i64::from(u32::MAX))).sum();
    if counts.iter().any(|&count| count < 0) || total != points.len() as i64 {
        let found = points.len();
        return Err(stage.broken(path, format!("{found} points, `curveVertexCounts` has {total}")));
    }
    let (basis, wrap) = kind(stage, path)?;
    let sizes = Sizes::of(basis, wrap, &counts);
    let mut widths = widths(stage, prim);
    if widths.as_ref().is_some_and(|widths| widths.len() < sizes.count(widths.interpolation)) {
        geometry.report.skip("widths without a value for every point", u64::from(part == 0));
        widths = None;
    }
    let all = widths.iter().flat_map(|widths| &widths.values);
    let width_max = f64::from(all.copied().fold(0.0, f32::max));
    let mut sampler = Sampler { basis, wrap, points: &points, width_max, samples: Vec::new(), ends: 0 };
    sampler.run(&counts, part * PART_POINTS..(part + 1) * PART_POINTS, &mut geometry)?;
    let Geometry { mesh, report, .. } = &mut geometry;

    // Everything a prim has for its curves and points is summed for the samples
    let samples = &sampler.samples;
    let resample = |values: Values| -> Option<Values> {
        (values.len() >= sizes.count(values.interpolation)).then(|| at_samples(&values, samples))
    };
    mesh.positions = samples.iter().map(|sample| sum(&points, &sample.vertex)).collect();
    mesh.point_numbers = samples.iter().map(point_number).collect();
    if let Some(widths) = &widths {
        mesh.radii = at_samples(widths, samples).values.iter().map(|width| 0.5 * width).collect();
    }
    let elements = Elements { faces: 1, points: samples.len(), corners: samples.len(), corner_sources: &[] };
    dress(stage, prim, attributes, &elements, &resample, mesh, report);
    Ok(geometry)
}

/// What a prim's points mean, and how its curves end; the schema's fallbacks are cubic Bézier curves that end where they do.
fn kind(stage: &Stage, path: &str) -> Result<(Basis, Wrap)> {
    let text = |name, fallback: &str| stage.text(path, name).unwrap_or_else(|| fallback.into());
    let unknown = |name, found: &str, expected| {
        Err(stage.broken(path, format!("curves of {name} `{found}`, expected one of {expected}")))
    };
    let basis = match (text("type", "cubic").as_str(), text("basis", "bezier").as_str()) {
        ("linear", _) => Basis::Linear,
        ("cubic", "bezier") => Basis::Bezier,
        ("cubic", "bspline") => Basis::BSpline,
        ("cubic", "catmullRom") => Basis::CatmullRom,
        ("cubic", other) => return unknown("basis", other, "`bezier`, `bspline`, `catmullRom`"),
        (other, _) => return unknown("type", other, "`linear`, `cubic`"),
    };
    let wrap = match text("wrap", "nonperiodic").as_str() {
        "nonperiodic" => Wrap::Open,
        "periodic" => Wrap::Periodic,
        "pinned" => Wrap::Pinned,
        other => return unknown("wrap", other, "`nonperiodic`, `periodic`, `pinned`"),
    };
    Ok((basis, wrap))
}

/// The number of the control point that a sample is, if it is one.
fn point_number(sample: &Sample) -> u32 {
    match sample.vertex[..] {
        [(index, 1.0)] => index as u32,
        _ => u32::MAX,
    }
}

fn sum(points: &[DVec3], weights: &[Weight]) -> DVec3 {
    weights.iter().map(|&(index, weight)| points[index] * weight).sum()
}

/// How many values the curves of a prim have, by interpolation.
struct Sizes {
    curves: usize,
    points: usize,
    ends: usize,
}

impl Sizes {
    fn of(basis: Basis, wrap: Wrap, counts: &[i64]) -> Self {
        let ends = |&count: &i64| match (basis.spans(wrap, count as usize), wrap) {
            (Some(spans), Wrap::Periodic) => spans,
            (Some(spans), _) => spans + 1,
            (None, _) => 0,
        };
        Self {
            curves: counts.len(),
            points: counts.iter().map(|&count| count as usize).sum(),
            ends: counts.iter().map(ends).sum(),
        }
    }

    fn count(&self, interpolation: Interpolation) -> usize {
        match interpolation {
            Interpolation::Constant => 1,
            Interpolation::Uniform => self.curves,
            Interpolation::Vertex => self.points,
            Interpolation::Varying | Interpolation::FaceVarying => self.ends,
        }
    }
}

/// Values at samples.
fn at_samples(values: &Values, samples: &[Sample]) -> Values {
    let components = values.components;
    let mut out = Vec::with_capacity(samples.len() * components);
    let get = |element: usize, i: usize| values.get(element).map_or(0.0, |value| value[i]);
    for sample in samples {
        out.extend((0..components).map(|i| match values.interpolation {
            Interpolation::Constant => get(0, i),
            Interpolation::Uniform => get(sample.curve as usize, i),
            Interpolation::Vertex => {
                sample.vertex.iter().map(|&(index, weight)| f64::from(get(index, i)) * weight).sum::<f64>()
                    as f32
            }
            Interpolation::Varying | Interpolation::FaceVarying => {
                let (first, second, share) = sample.varying;
                get(first as usize, i) * (1.0 - share) + get(second as usize, i) * share
            }
        }));
    }
    Values { interpolation: Interpolation::Vertex, components, values: out, indices: None }
}

/// Cuts curves into lines.
struct Sampler<'a> {
    basis: Basis,
    wrap: Wrap,
    points: &'a [DVec3],
    /// The largest width; zero where there are none.
    width_max: f64,
    samples: Vec<Sample>,
    /// Values per end of a span that the curves so far have.
    ends: u32,
}

impl Sampler<'_> {
    /// Adds the curves whose first point is in `wanted`.
    fn run(&mut self, counts: &[i64], wanted: Range<usize>, geometry: &mut Geometry) -> Result<()> {
        let mut first = 0;
        for (curve, &count) in counts.iter().enumerate() {
            let count = count as usize;
            let spans = self.basis.spans(self.wrap, count);
            let is_wanted = wanted.contains(&first);
            geometry.report.source.vertices += if is_wanted { count as u64 } else { 0 };
            match spans {
                Some(spans) if is_wanted => self.curve(curve as u32, first, count, spans, geometry)?,
                // Values of the curves before are passed over
                Some(spans) => self.ends += self.ends_of(spans),
                None => {
                    let reason = "curves of a number of points that their basis cannot have";
                    geometry.report.skip(reason, u64::from(is_wanted));
                }
            }
            first += count;
        }
        Ok(())
    }

    /// Ends of spans that a curve has.
    fn ends_of(&self, spans: usize) -> u32 {
        if self.wrap == Wrap::Periodic { spans as u32 } else { spans as u32 + 1 }
    }

    /// Adds the samples and lines of a curve, whose points begin at `first`.
    fn curve(
        &mut self,
        curve: u32,
        first: usize,
        count: usize,
        spans: usize,
        geometry: &mut Geometry,
    ) -> Result<()> {
        let start = self.samples.len() as u32;
        let is_periodic = self.wrap == Wrap::Periodic;
        let ends = self.ends_of(spans);
        for span in 0..spans {
            let control = self.basis.control(self.wrap, count, span);
            let lines = self.lines(&control, first);
            // The end of a span is the beginning of the next one
            let last = lines + u32::from(span + 1 == spans && !is_periodic);
            for i in 0..last {
                let t = f64::from(i) / f64::from(lines);
                let (a, b) = (span as u32, (span as u32 + 1) % ends.max(1));
                let varying = (self.ends + a, self.ends + b, t as f32);
                self.samples.push(Sample { curve, vertex: self.weigh(&control, first, t), varying });
            }
        }
        let end = self.samples.len() as u32;
        for sample in start + 1..end {
            geometry.mesh.push_face(FACE, &[sample - 1, sample], &mut geometry.report)?;
        }
        if is_periodic && end > start + 1 {
            geometry.mesh.push_face(FACE, &[end - 1, start], &mut geometry.report)?;
        }
        self.ends += ends;
        Ok(())
    }

    /// The control points of the prim at `t` in a span, each once.
    fn weigh(&self, control: &[Vec<Weight>], first: usize, t: f64) -> Vec<Weight> {
        let mut sum: Vec<Weight> = Vec::with_capacity(4);
        for (points, factor) in control.iter().zip(self.basis.weights(t)) {
            for &(index, weight) in points {
                match sum.iter_mut().find(|(known, _)| *known == first + index) {
                    Some((_, known)) => *known += weight * factor,
                    None => sum.push((first + index, weight * factor)),
                }
            }
        }
        sum.retain(|&(_, weight)| weight != 0.0);
        sum
    }

    /// Lines for a span, so that none is off the curve by more than a quarter of its radius; without one, by more than
    /// a hundredth of its length.
    fn lines(&self, control: &[Vec<Weight>], first: usize) -> u32 {
        if self.basis == Basis::Linear {
            return 1;
        }
        let place = |points: &Vec<Weight>| -> DVec3 {
            points.iter().map(|&(index, weight)| self.points[first + index] * weight).sum()
        };
        let points: [DVec3; 4] = std::array::from_fn(|i| place(&control[i]));
        let chord = points[3].distance(points[0]);
        let tolerance = if self.width_max > 0.0 { 0.125 * self.width_max } else { 0.01 * chord };
        let lines = (self.basis.bend(&points) / (8.0 * tolerance)).sqrt().ceil();
        // What is not a number becomes one line
        lines.clamp(1.0, LINES_MAX).max(1.0) as u32
    }
}
