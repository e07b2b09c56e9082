//! What a stream holds: counts, bounds, and the range and mean of every attribute.

use std::fmt;

use serde::Serialize;

use super::values;
use crate::Result;
use crate::math::Bounds;
use crate::stream::file::StreamCounts;
use crate::stream::schema::UpAxis;
use crate::stream::{Microgrid, MicrogridStream, Rate, ValueType};

/// A stream in numbers. Serialises as the `inspect STREAM --json` of `docs/formats.md`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StreamSummary {
    /// Microgrids.
    pub grids: u64,
    /// Points, lines, triangles and quads.
    pub micropolygons: u64,
    /// Vertices, counted once per grid.
    pub vertices: u64,
    /// The box of all vertices, scene units.
    pub bounds: SummaryBounds,
    /// The attributes in the schema's order.
    pub attributes: Vec<AttributeSummary>,
    /// Metres per scene unit.
    #[serde(skip)]
    pub meters_per_unit: f64,
    /// Which axis points up.
    #[serde(skip)]
    pub up: UpAxis,
}

/// A box in scene units; of an empty stream it is +infinity to -infinity, in JSON nulls.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SummaryBounds {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
}

/// An attribute in numbers, as stored: bytes run from 0 to 255.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AttributeSummary {
    /// Its name.
    pub name: String,
    /// The type of a component.
    #[serde(rename = "type")]
    pub value_type: ValueType,
    /// Components per value.
    pub components: u16,
    /// The least value of each component; +infinity, in JSON null, where there is no finite one.
    pub min: Vec<f64>,
    /// The greatest value of each component; -infinity where there is none.
    pub max: Vec<f64>,
    /// The mean of each component over vertices, or over grids for an attribute per grid; NaN where there is none.
    pub mean: Vec<f64>,
    /// Values that are NaN or infinite; they count for nothing above. Left out of JSON when there are none.
    #[serde(skip_serializing_if = "is_zero")]
    pub not_finite: u64,
    /// Per vertex or per grid.
    #[serde(skip)]
    pub rate: Rate,
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// Reads a whole stream from its start and sums it up, in constant memory.
///
/// # Errors
/// Those of the stream.
pub fn inspect_stream(stream: &mut dyn MicrogridStream) -> Result<StreamSummary> {
    stream.rewind()?;
    let schema = stream.schema().clone();
    let mut counts = StreamCounts::default();
    let mut tallies: Vec<Vec<Tally>> = schema
        .attributes
        .iter()
        .map(|attribute| vec![Tally::default(); usize::from(attribute.components)])
        .collect();
    let mut grid = Microgrid::default();
    while stream.next(&mut grid)? {
        counts.add(&grid);
        for ((attribute, column), tallies) in schema.attributes.iter().zip(&grid.columns).zip(&mut tallies) {
            values::for_each(attribute, column, |component, value| tallies[component].add(value));
        }
    }
    let attributes =
        schema.attributes.into_iter().zip(&tallies).map(|(attribute, tallies)| AttributeSummary {
            name: attribute.name,
            value_type: attribute.value_type,
            components: attribute.components,
            min: tallies.iter().map(|tally| tally.min).collect(),
            max: tallies.iter().map(|tally| tally.max).collect(),
            mean: tallies.iter().map(Tally::mean).collect(),
            not_finite: tallies.iter().map(|tally| tally.not_finite).sum(),
            rate: attribute.rate,
        });
    Ok(StreamSummary {
        grids: counts.grids,
        micropolygons: counts.micropolygons,
        vertices: counts.vertices,
        bounds: counts.bounds.into(),
        attributes: attributes.collect(),
        meters_per_unit: schema.meters_per_unit,
        up: schema.up,
    })
}

/// Range and sum of one component. The sum is compensated (Neumaier 1974): billions of values lose nothing.
#[derive(Clone)]
struct Tally {
    min: f64,
    max: f64,
    sum: f64,
    compensation: f64,
    count: u64,
    not_finite: u64,
}

impl Default for Tally {
    fn default() -> Self {
        let (min, max) = (f64::INFINITY, f64::NEG_INFINITY);
        Self { min, max, sum: 0.0, compensation: 0.0, count: 0, not_finite: 0 }
    }
}

impl Tally {
    fn add(&mut self, value: f64) {
        if !value.is_finite() {
            self.not_finite += 1;
            return;
        }
        self.min = self.min.min(value);
        self.max = self.max.max(value);
        let sum = self.sum + value;
        self.compensation +=
            if self.sum.abs() >= value.abs() { self.sum - sum + value } else { value - sum + self.sum };
        self.sum = sum;
        self.count += 1;
    }

    fn mean(&self) -> f64 {
        (self.sum + self.compensation) / self.count as f64
    }
}

impl From<Bounds> for SummaryBounds {
    fn from(bounds: Bounds) -> Self {
        Self { min: bounds.min.to_array(), max: bounds.max.to_array() }
    }
}

impl fmt::Display for StreamSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let up = match self.up {
            UpAxis::Y => "y",
            UpAxis::Z => "z",
        };
        writeln!(f, "grids          {}", self.grids)?;
        writeln!(f, "micropolygons  {}", self.micropolygons)?;
        writeln!(f, "vertices       {}", self.vertices)?;
        writeln!(f, "space          {} metres per unit, {up} up", self.meters_per_unit)?;
        if self.vertices > 0 {
            let Bounds { min, max } = Bounds { min: self.bounds.min.into(), max: self.bounds.max.into() };
            writeln!(f, "bounds         {min} to {max}")?;
        }
        let width =
            self.attributes.iter().map(|attribute| attribute.name.len() + 4).max().unwrap_or(0).max(13);
        writeln!(f, "\n{:width$}  {:10}  {:>14}  {:>14}  {:>14}", "attribute", "type", "min", "max", "mean")?;
        for attribute in &self.attributes {
            attribute.fmt_rows(f, width)?;
        }
        Ok(())
    }
}

impl AttributeSummary {
    fn fmt_rows(&self, f: &mut fmt::Formatter<'_>, width: usize) -> fmt::Result {
        let kind = match self.value_type {
            ValueType::F32 => "f32",
            ValueType::F16 => "f16",
            ValueType::U8 => "u8",
            ValueType::U32 => "u32",
        };
        let kind = if self.rate == Rate::Grid { format!("{kind}/grid") } else { kind.to_string() };
        for component in 0..usize::from(self.components) {
            let name =
                if self.components == 1 { self.name.clone() } else { format!("{}_{component}", self.name) };
            let [min, max, mean] = [&self.min, &self.max, &self.mean].map(|values| values[component]);
            writeln!(f, "{name:width$}  {kind:10}  {min:>14.6}  {max:>14.6}  {mean:>14.6}")?;
        }
        if self.not_finite > 0 {
            writeln!(f, "{:width$}  {} values are NaN or infinite", self.name, self.not_finite)?;
        }
        Ok(())
    }
}
