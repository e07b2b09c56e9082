//! Several streams in a row under one schema.

use std::sync::Arc;

use half::f16;

use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Piece, Rate, Schema, ValueType, microgrid};
use crate::{Error, Result};

/// Streams one after the other, with the union of their attributes.
///
/// An attribute that a stream lacks is filled in: `opacity` and `baked` with 1, `albedo` with 0.5, all others with 0
/// (for `N` this means no normal). Where two streams store an attribute differently, the wider type holds both: f16
/// and f32 become f32, u8 and u32 become u32, u8 and a float become f32 (`opacity` and `albedo` then as value / 255);
/// per grid and per vertex become per vertex. u32 beside a float is refused, since f32 cannot hold every u32.
pub struct Concat {
    parts: Vec<Part>,
    schema: Arc<Schema>,
    part: usize,
    scratch: Microgrid,
}

struct Part {
    stream: Box<dyn MicrogridStream>,
    sources: Arc<Sources>,
    /// Whether the stream's own schema is the merged one.
    identical: bool,
}

/// For every column of the merged schema, where it comes from.
struct Sources(Vec<Source>);

enum Source {
    /// The same type and rate.
    Copy(usize),
    /// Another type or rate; values are multiplied by the factor.
    Convert { column: usize, from: Attribute, scale: f32 },
    /// Not there: one value, ready for copying.
    Missing(Vec<u8>),
}

impl Concat {
    /// Streams one after the other. All must stand in the same units and up axis: see [`Convert`](super::Convert).
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for no stream at all, different spaces, or attributes that
    /// cannot be joined; the message names the attribute.
    pub fn new(streams: Vec<Box<dyn MicrogridStream>>) -> Result<Self> {
        let Some(first) = streams.first() else {
            return Err(Error::invalid("no streams to join"));
        };
        let mut schema = first.schema().clone();
        for stream in &streams[1..] {
            let other = stream.schema();
            if other.meters_per_unit != schema.meters_per_unit || other.up != schema.up {
                return Err(Error::invalid("streams in different units or up axes cannot be joined"));
            }
            for attribute in &other.attributes {
                match schema.find(&attribute.name) {
                    Some(column) => widen(&mut schema.attributes[column], attribute)?,
                    None => schema.attributes.push(attribute.clone()),
                }
            }
        }
        schema.validate()?;
        let part = |stream: Box<dyn MicrogridStream>| {
            let own = stream.schema();
            let sources = schema.attributes.iter().map(|attribute| Source::of(attribute, own)).collect();
            let identical = own.attributes == schema.attributes;
            Part { identical, sources: Arc::new(Sources(sources)), stream }
        };
        let parts = streams.into_iter().map(part).collect();
        Ok(Self { parts, schema: Arc::new(schema), part: 0, scratch: Microgrid::default() })
    }
}

impl MicrogridStream for Concat {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.part = 0;
        self.parts.iter_mut().try_for_each(|part| part.stream.rewind())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        while let Some(part) = self.parts.get_mut(self.part) {
            let target = if part.identical { &mut *grid } else { &mut self.scratch };
            if part.stream.next(target)? {
                if !part.identical {
                    part.sources.merge(&mut self.scratch, &self.schema, grid);
                }
                return Ok(true);
            }
            self.part += 1;
        }
        Ok(false)
    }

    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        while let Some(part) = self.parts.get_mut(self.part) {
            if let Some(inner) = part.stream.next_piece()? {
                if part.identical {
                    return Ok(Some(inner));
                }
                let (sources, schema) = (part.sources.clone(), self.schema.clone());
                return Ok(Some(Box::new(MergedPiece { inner, sources, schema })));
            }
            self.part += 1;
        }
        Ok(None)
    }

    fn progress(&self) -> f64 {
        let current = self.parts.get(self.part).map_or(0.0, |part| part.stream.progress());
        (self.part as f64 + current) / self.parts.len() as f64
    }
}

/// A piece of one part, its grids brought to the merged schema.
struct MergedPiece {
    inner: Box<dyn Piece>,
    sources: Arc<Sources>,
    schema: Arc<Schema>,
}

impl Piece for MergedPiece {
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        let Self { inner, sources, schema } = *self;
        let (mut decoded, mut copy) = (Microgrid::default(), Microgrid::default());
        inner.read(&mut decoded, &mut |source| {
            // Merging takes its source apart
            copy.clone_from(source);
            sources.merge(&mut copy, &schema, grid);
            each(grid)
        })
    }
}

impl Sources {
    /// Moves a grid of the part's schema to one of the merged schema.
    fn merge(&self, from: &mut Microgrid, schema: &Schema, to: &mut Microgrid) {
        to.clear(schema.attributes.len());
        to.anchor = from.anchor;
        std::mem::swap(&mut to.positions, &mut from.positions);
        std::mem::swap(&mut to.arities, &mut from.arities);
        std::mem::swap(&mut to.indices, &mut from.indices);
        let vertices = to.positions.len();
        for (index, source) in self.0.iter().enumerate() {
            let attribute = &schema.attributes[index];
            let values = if attribute.rate == Rate::Vertex { vertices } else { 1 };
            match source {
                Source::Copy(column) => std::mem::swap(&mut to.columns[index], &mut from.columns[*column]),
                Source::Missing(value) => {
                    (0..values).for_each(|_| to.columns[index].extend_from_slice(value));
                }
                Source::Convert { column, from: own, scale } => {
                    convert(&from.columns[*column], own, attribute, values, *scale, &mut to.columns[index]);
                }
            }
        }
    }
}

impl Source {
    fn of(attribute: &Attribute, own: &Schema) -> Self {
        let Some(column) = own.find(&attribute.name) else {
            return Self::Missing(default_value(attribute));
        };
        let from = &own.attributes[column];
        if from == attribute {
            return Self::Copy(column);
        }
        let is_unit = matches!(attribute.name.as_str(), names::OPACITY | names::ALBEDO);
        let bytes_to_float = from.value_type == ValueType::U8 && attribute.value_type == ValueType::F32;
        let scale = if is_unit && bytes_to_float { 1.0 / 255.0 } else { 1.0 };
        Self::Convert { column, from: from.clone(), scale }
    }
}

/// Makes `attribute` wide enough for `other`.
fn widen(attribute: &mut Attribute, other: &Attribute) -> Result<()> {
    use ValueType::{F16, F32, U8, U32};
    let name = &attribute.name;
    if attribute.components != other.components {
        return Err(Error::invalid(format!(
            "attribute `{name}` has {} components in one stream and {} in another",
            attribute.components, other.components
        )));
    }
    let is_unit = matches!(name.as_str(), names::OPACITY | names::ALBEDO);
    attribute.value_type = match (attribute.value_type, other.value_type) {
        (a, b) if a == b => a,
        (U8, U32) | (U32, U8) if !is_unit => U32,
        (F32 | F16 | U8, F32 | F16 | U8) => F32,
        _ => {
            return Err(Error::invalid(format!(
                "attribute `{name}` is of type u32 in one stream and of a type that cannot be joined with it in another"
            )));
        }
    };
    if other.rate == Rate::Vertex {
        attribute.rate = Rate::Vertex;
    }
    Ok(())
}

/// One value of an attribute that a stream lacks.
fn default_value(attribute: &Attribute) -> Vec<u8> {
    let number: f32 = match attribute.name.as_str() {
        names::OPACITY | names::BAKED => 1.0,
        names::ALBEDO => 0.5,
        _ => 0.0,
    };
    let is_unit = matches!(attribute.name.as_str(), names::OPACITY | names::ALBEDO);
    let bytes = match attribute.value_type {
        ValueType::F32 => number.to_le_bytes().to_vec(),
        ValueType::F16 => f16::from_f32(number).to_le_bytes().to_vec(),
        ValueType::U8 => vec![if is_unit { (255.0 * number).round() as u8 } else { number as u8 }],
        ValueType::U32 => (number as u32).to_le_bytes().to_vec(),
    };
    bytes.repeat(usize::from(attribute.components))
}

/// Appends `values` values of `from`'s column in `to`'s type, which is f32 or, from u8, u32.
fn convert(column: &[u8], from: &Attribute, to: &Attribute, values: usize, scale: f32, out: &mut Vec<u8>) {
    let components = usize::from(from.components);
    for value in 0..values {
        let first = if from.rate == Rate::Vertex { value * components } else { 0 };
        for index in first..first + components {
            if from.value_type == to.value_type {
                let width = from.value_type.bytes();
                out.extend_from_slice(&column[index * width..(index + 1) * width]);
                continue;
            }
            let number = microgrid::decode(from.value_type, column, index);
            match to.value_type {
                ValueType::U32 => out.extend_from_slice(&(number as u32).to_le_bytes()),
                _ => out.extend_from_slice(&(number * scale).to_le_bytes()),
            }
        }
    }
}
