//! How far two streams of the same shape differ, attribute by attribute.

use std::fmt;

use serde::Serialize;

use super::values;
use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Rate, Schema};
use crate::{Error, Result};

/// Two streams compared. Serialises as the `compare A B --json` of `docs/formats.md`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// The attributes that both streams have, in A's order; `baked`, which only says where to look, is not among them.
    pub attributes: Vec<AttributeComparison>,
    /// Vertices that were compared.
    #[serde(skip)]
    pub vertices: u64,
    /// Vertices that one of the streams has not baked.
    #[serde(skip)]
    pub skipped: u64,
    /// Attributes of A alone.
    #[serde(skip)]
    pub only_a: Vec<String>,
    /// Attributes of B alone.
    #[serde(skip)]
    pub only_b: Vec<String>,
}

/// An attribute compared, per component. A value that is not a number makes every figure of its component NaN, in
/// JSON null.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AttributeComparison {
    /// Its name.
    pub name: String,
    /// Root of the mean squared difference.
    pub rmse: Vec<f64>,
    /// Greatest absolute difference.
    pub max: Vec<f64>,
    /// Mean of B - A.
    pub bias: Vec<f64>,
    /// Root of the mean squared difference over the 2l+1 coefficients of each SH band, where there are bands² components
    /// (1 to 6 bands); otherwise empty.
    pub bands: Vec<f64>,
}

/// Positions may differ by this much of a grid's size, since the same place may stand on different anchors.
const POSITION_TOLERANCE: f64 = 1e-5;

/// Compares two streams of the same grids from their starts. Vertices whose `baked` is 0 in either stream are skipped.
/// `opacity` and `albedo` in bytes count as value / 255; an attribute per grid counts once per vertex.
///
/// # Errors
/// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when grids, faces or positions differ (with the grid's number),
/// when no attribute is in both, or when no vertex is left to compare; otherwise those of the streams.
pub fn compare(a: &mut dyn MicrogridStream, b: &mut dyn MicrogridStream) -> Result<Comparison> {
    a.rewind()?;
    b.rewind()?;
    let schemas = [a.schema().clone(), b.schema().clone()];
    let mut pairs = pair_attributes(&schemas)?;
    let mut grids = [Microgrid::default(), Microgrid::default()];
    let mut skip = Vec::new();
    let (mut vertices, mut skipped) = (0, 0);
    for number in 0_u64.. {
        let more = [a.next(&mut grids[0])?, b.next(&mut grids[1])?];
        match more {
            [true, true] => {}
            [false, false] => break,
            [first, _] => {
                let (ends, goes_on) = if first { ("B", "A") } else { ("A", "B") };
                return Err(Error::invalid(format!(
                    "stream {ends} ends before grid {number}, stream {goes_on} goes on"
                )));
            }
        }
        check_same_shape(&grids, number)?;
        mark_skipped(&schemas, &grids, &mut skip);
        let skipped_here = skip.iter().filter(|&&skip| skip).count() as u64;
        skipped += skipped_here;
        vertices += skip.len() as u64 - skipped_here;
        pairs.iter_mut().for_each(|pair| pair.add(&schemas, &grids, &skip));
    }
    if vertices == 0 {
        return Err(Error::invalid(format!(
            "nothing to compare: {skipped} vertices, none baked in both streams"
        )));
    }
    let only = |own: &Schema, other: &Schema| -> Vec<String> {
        let names = own.attributes.iter().map(|attribute| &attribute.name);
        names.filter(|name| other.find(name).is_none()).cloned().collect()
    };
    Ok(Comparison {
        attributes: pairs.iter().map(|pair| pair.finish(&schemas[0])).collect(),
        vertices,
        skipped,
        only_a: only(&schemas[0], &schemas[1]),
        only_b: only(&schemas[1], &schemas[0]),
    })
}

/// An attribute of both streams and its differences so far.
struct Pair {
    columns: [usize; 2],
    components: usize,
    differences: Vec<Difference>,
    values: [Vec<f64>; 2],
}

/// The differences of one component.
#[derive(Clone, Default)]
struct Difference {
    count: u64,
    sum: f64,
    squares: f64,
    max: f64,
}

fn pair_attributes(schemas: &[Schema; 2]) -> Result<Vec<Pair>> {
    let [a, b] = schemas;
    if a.meters_per_unit != b.meters_per_unit || a.up != b.up {
        return Err(Error::invalid("the streams stand in different units or up axes"));
    }
    let mut pairs = Vec::new();
    for (column, attribute) in a.attributes.iter().enumerate() {
        let Some(other) = b.find(&attribute.name).filter(|_| attribute.name != names::BAKED) else {
            continue;
        };
        let components = [attribute.components, b.attributes[other].components];
        if components[0] != components[1] {
            return Err(Error::invalid(format!(
                "attribute `{}` has {} components in A and {} in B",
                attribute.name, components[0], components[1]
            )));
        }
        let components = usize::from(components[0]);
        pairs.push(Pair {
            columns: [column, other],
            components,
            differences: vec![Difference::default(); components],
            values: [Vec::new(), Vec::new()],
        });
    }
    if pairs.is_empty() {
        let names = |schema: &Schema| {
            let names: Vec<&str> =
                schema.attributes.iter().map(|attribute| attribute.name.as_str()).collect();
            if names.is_empty() { "none".to_string() } else { names.join(" ") }
        };
        return Err(Error::invalid("the streams have no attribute in common").hint(format!(
            "A has {}; B has {}",
            names(a),
            names(b)
        )));
    }
    Ok(pairs)
}

fn check_same_shape([a, b]: &[Microgrid; 2], number: u64) -> Result<()> {
    if a.vertex_count() != b.vertex_count() || a.face_count() != b.face_count() {
        return Err(Error::invalid(format!(
            "grid {number} has {} vertices and {} faces in A, {} and {} in B",
            a.vertex_count(),
            a.face_count(),
            b.vertex_count(),
            b.face_count()
        )));
    }
    if a.arities != b.arities || a.indices != b.indices {
        return Err(Error::invalid(format!("grid {number} has other faces in A than in B")));
    }
    if a.anchor == b.anchor && a.positions == b.positions {
        return Ok(());
    }
    let offsets = a.positions.iter().chain(&b.positions);
    let longest = offsets.fold(0.0_f32, |longest, offset| longest.max(offset.abs().max_element()));
    // A grid on another anchor is rounded otherwise: allow for the offsets' last bits besides the size.
    let tolerance = POSITION_TOLERANCE * a.bounds().size().max_element() + f64::from(longest * f32::EPSILON);
    let far = |&vertex: &usize| (a.position(vertex) - b.position(vertex)).abs().max_element() > tolerance;
    match (0..a.vertex_count()).find(far) {
        None => Ok(()),
        Some(vertex) => Err(Error::invalid(format!(
            "vertex {vertex} of grid {number} is at {} in A and at {} in B",
            a.position(vertex),
            b.position(vertex)
        ))),
    }
}

/// For every vertex, whether either stream says that it was not baked.
fn mark_skipped(schemas: &[Schema; 2], grids: &[Microgrid; 2], skip: &mut Vec<bool>) {
    skip.clear();
    skip.resize(grids[0].vertex_count(), false);
    for (schema, grid) in schemas.iter().zip(grids) {
        if let Some(column) = schema.find(names::BAKED) {
            for (vertex, skip) in skip.iter_mut().enumerate() {
                *skip |= grid.value(schema, column, vertex, 0) == 0.0;
            }
        }
    }
}

impl Pair {
    fn attribute<'a>(&self, schemas: &'a [Schema; 2], stream: usize) -> &'a Attribute {
        &schemas[stream].attributes[self.columns[stream]]
    }

    fn add(&mut self, schemas: &[Schema; 2], grids: &[Microgrid; 2], skip: &[bool]) {
        let mut strides = [0; 2];
        for stream in 0..2 {
            let attribute = self.attribute(schemas, stream);
            strides[stream] = if attribute.rate == Rate::Vertex { self.components } else { 0 };
            values::unit_values(
                attribute,
                &grids[stream].columns[self.columns[stream]],
                &mut self.values[stream],
            );
        }
        for (vertex, _) in skip.iter().enumerate().filter(|&(_, &skip)| !skip) {
            let [a, b] =
                [0, 1].map(|stream| &self.values[stream][vertex * strides[stream]..][..self.components]);
            for ((difference, a), b) in self.differences.iter_mut().zip(a).zip(b) {
                difference.add(b - a);
            }
        }
    }

    fn finish(&self, schema: &Schema) -> AttributeComparison {
        let bands = (1..=6).find(|bands| bands * bands == self.components).unwrap_or(0);
        let band = |l: usize| {
            let coefficients = &self.differences[l * l..(l + 1) * (l + 1)];
            let mean =
                coefficients.iter().map(Difference::mean_square).sum::<f64>() / coefficients.len() as f64;
            mean.sqrt()
        };
        AttributeComparison {
            name: schema.attributes[self.columns[0]].name.clone(),
            rmse: self.differences.iter().map(|difference| difference.mean_square().sqrt()).collect(),
            max: self.differences.iter().map(|difference| difference.max).collect(),
            bias: self
                .differences
                .iter()
                .map(|difference| difference.sum / difference.count as f64)
                .collect(),
            bands: (0..bands).map(band).collect(),
        }
    }
}

impl Difference {
    fn add(&mut self, difference: f64) {
        self.count += 1;
        self.sum += difference;
        self.squares += difference * difference;
        // `f64::max` would forget a NaN.
        self.max =
            if difference.is_nan() || self.max.is_nan() { f64::NAN } else { self.max.max(difference.abs()) };
    }

    fn mean_square(&self) -> f64 {
        self.squares / self.count as f64
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "compared  {} vertices, {} not baked in both", self.vertices, self.skipped)?;
        let width =
            self.attributes.iter().map(|attribute| attribute.name.len() + 8).max().unwrap_or(0).max(13);
        writeln!(f, "\n{:width$}  {:>12}  {:>12}  {:>12}", "attribute", "rmse", "max", "bias B - A")?;
        for AttributeComparison { name, rmse, max, bias, bands } in &self.attributes {
            for component in 0..rmse.len() {
                let label = if rmse.len() == 1 { name.clone() } else { format!("{name}_{component}") };
                let (rmse, max, bias) = (rmse[component], max[component], bias[component]);
                writeln!(f, "{label:width$}  {rmse:>12.6}  {max:>12.6}  {bias:>12.6}")?;
            }
            for (l, rmse) in bands.iter().enumerate().filter(|_| bands.len() > 1) {
                writeln!(f, "{:width$}  {rmse:>12.6}", format!("{name} band {l}"))?;
            }
        }
        for (stream, names) in [("A", &self.only_a), ("B", &self.only_b)] {
            if !names.is_empty() {
                writeln!(f, "only in {stream}: {}", names.join(" "))?;
            }
        }
        Ok(())
    }
}
