//! The microgrid: an indexed mesh of at most 256 vertices, the unit of everything that streams.

use glam::{DVec3, Vec3};

use super::schema::{Attribute, Rate, Schema, ValueType};
use crate::math::Bounds;
use crate::{Error, Result};

/// Vertices of a grid at most: face indices are 8 bits.
pub const VERTICES_MAX: usize = 256;

/// Faces of a grid at most. A regular grid of 256 vertices has 225; soups may refer to a vertex many times.
pub const FACES_MAX: usize = 1024;

/// An indexed mesh of at most 256 vertices. Faces are micropolygons: points, lines, triangles or quads.
///
/// Positions are single precision offsets from a double precision anchor, so that a scene hundreds of metres wide
/// in centimetres loses nothing. All vectors keep their capacity over [`clear`](Self::clear): a loop over a stream
/// allocates nothing once warm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Microgrid {
    /// What positions are relative to, in scene units.
    pub anchor: DVec3,
    /// Offsets from the anchor, one per vertex.
    pub positions: Vec<Vec3>,
    /// Vertices per face: 1 (point), 2 (line), 3 or 4.
    pub arities: Vec<u8>,
    /// The faces' vertex indices, one face after the other.
    pub indices: Vec<u8>,
    /// Attribute values as little-endian bytes, one column per attribute of the schema.
    pub columns: Vec<Vec<u8>>,
}

impl Microgrid {
    /// Empties the grid, keeps its memory and makes `columns` columns.
    pub fn clear(&mut self, columns: usize) {
        self.anchor = DVec3::ZERO;
        self.positions.clear();
        self.arities.clear();
        self.indices.clear();
        self.columns.resize_with(columns, Vec::new);
        self.columns.iter_mut().for_each(Vec::clear);
    }

    /// Vertices.
    pub fn vertex_count(&self) -> usize {
        self.positions.len()
    }

    /// Faces, which are the micropolygons.
    pub fn face_count(&self) -> usize {
        self.arities.len()
    }

    /// The position of a vertex in scene units.
    pub fn position(&self, vertex: usize) -> DVec3 {
        self.anchor + self.positions[vertex].as_dvec3()
    }

    /// The faces as slices of vertex indices, in order.
    pub fn faces(&self) -> impl Iterator<Item = &[u8]> {
        let mut rest = self.indices.as_slice();
        self.arities.iter().map(move |&arity| {
            let (face, tail) = rest.split_at(usize::from(arity));
            rest = tail;
            face
        })
    }

    /// Adds a face of 1 to 4 vertices.
    pub fn push_face(&mut self, face: &[u8]) {
        debug_assert!((1..=4).contains(&face.len()));
        self.arities.push(face.len() as u8);
        self.indices.extend_from_slice(face);
    }

    /// The box of the vertices in scene units.
    pub fn bounds(&self) -> Bounds {
        let (min, max) = self
            .positions
            .iter()
            .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(min, max), &p| (min.min(p), max.max(p)));
        if self.positions.is_empty() {
            return Bounds::EMPTY;
        }
        Bounds { min: self.anchor + min.as_dvec3(), max: self.anchor + max.as_dvec3() }
    }

    /// Component `component` of attribute `column` at `vertex` as a number; bytes are not normalised.
    pub fn value(&self, schema: &Schema, column: usize, vertex: usize, component: usize) -> f32 {
        let attribute = &schema.attributes[column];
        let index = match attribute.rate {
            Rate::Vertex => vertex * usize::from(attribute.components) + component,
            Rate::Grid => component,
        };
        decode(attribute.value_type, &self.columns[column], index)
    }

    /// Like [`value`](Self::value), with bytes read as value / 255: opacity and albedo.
    pub fn unit_value(&self, schema: &Schema, column: usize, vertex: usize, component: usize) -> f32 {
        let value = self.value(schema, column, vertex, component);
        if schema.attributes[column].value_type == ValueType::U8 { value * (1.0 / 255.0) } else { value }
    }

    /// The first three components of an attribute at `vertex`.
    pub fn vec3(&self, schema: &Schema, column: usize, vertex: usize) -> Vec3 {
        Vec3::from_array(std::array::from_fn(|i| self.unit_value(schema, column, vertex, i)))
    }

    /// Appends single precision values to a column, converted to the attribute's type.
    pub fn push_values(&mut self, attribute: &Attribute, column: usize, values: &[f32]) {
        let bytes = &mut self.columns[column];
        for &value in values {
            match attribute.value_type {
                ValueType::F32 => bytes.extend_from_slice(&value.to_le_bytes()),
                ValueType::F16 => bytes.extend_from_slice(&half::f16::from_f32(value).to_le_bytes()),
                ValueType::U8 => bytes.push(value.round().clamp(0.0, 255.0) as u8),
                ValueType::U32 => bytes.extend_from_slice(&(value as u32).to_le_bytes()),
            }
        }
    }

    /// Checks everything a reader of the grid relies on: counts, indices, finite numbers, column lengths.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) with what is wrong.
    pub fn validate(&self, schema: &Schema) -> Result<()> {
        let vertices = self.vertex_count();
        if vertices == 0 || vertices > VERTICES_MAX {
            return Err(Error::invalid(format!(
                "a grid of {vertices} vertices, 1 to {VERTICES_MAX} are possible"
            )));
        }
        if self.face_count() > FACES_MAX {
            return Err(Error::invalid(format!(
                "a grid of {} faces, at most {FACES_MAX} are possible",
                self.face_count()
            )));
        }
        let mut corners = 0;
        for &arity in &self.arities {
            if !(1..=4).contains(&arity) {
                return Err(Error::invalid(format!("a face of {arity} vertices, 1 to 4 are possible")));
            }
            corners += usize::from(arity);
        }
        if corners != self.indices.len() {
            return Err(Error::invalid(format!("{} face indices, {corners} expected", self.indices.len())));
        }
        if let Some(index) = self.indices.iter().find(|&&index| usize::from(index) >= vertices) {
            return Err(Error::invalid(format!("face index {index} in a grid of {vertices} vertices")));
        }
        if !self.anchor.is_finite() || !self.positions.iter().all(|p| p.is_finite()) {
            return Err(Error::invalid("a position is not a finite number"));
        }
        if self.columns.len() != schema.attributes.len() {
            return Err(Error::invalid(format!(
                "{} attribute columns, {} expected",
                self.columns.len(),
                schema.attributes.len()
            )));
        }
        for (attribute, column) in schema.attributes.iter().zip(&self.columns) {
            let values = if attribute.rate == Rate::Vertex { vertices } else { 1 };
            let expected = values * attribute.value_bytes();
            if column.len() != expected {
                return Err(Error::invalid(format!(
                    "attribute `{}` has {} bytes, {expected} expected",
                    attribute.name,
                    column.len()
                )));
            }
        }
        Ok(())
    }
}

/// Component `index` of a column of `value_type` as a number.
pub fn decode(value_type: ValueType, bytes: &[u8], index: usize) -> f32 {
    match value_type {
        ValueType::F32 => f32::from_le_bytes(bytes[4 * index..4 * index + 4].try_into().expect("4 bytes")),
        ValueType::F16 => {
            half::f16::from_le_bytes(bytes[2 * index..2 * index + 2].try_into().expect("2 bytes")).to_f32()
        }
        ValueType::U8 => f32::from(bytes[index]),
        ValueType::U32 => {
            u32::from_le_bytes(bytes[4 * index..4 * index + 4].try_into().expect("4 bytes")) as f32
        }
    }
}
