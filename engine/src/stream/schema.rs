//! The attributes that a stream's vertices or grids carry, and the space they stand in.

use serde::{Deserialize, Serialize};

use crate::{Error, Result};

/// The type of one component of an attribute. All little endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ValueType {
    /// IEEE 754 single.
    F32,
    /// IEEE 754 half.
    F16,
    /// Unsigned byte. `albedo` and `opacity` read it as value / 255.
    U8,
    /// Unsigned 32-bit integer.
    U32,
}

impl ValueType {
    /// Bytes of one component.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F32 | Self::U32 => 4,
            Self::F16 => 2,
            Self::U8 => 1,
        }
    }
}

/// How often an attribute's value changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rate {
    /// One value per vertex.
    Vertex,
    /// One value per grid.
    Grid,
}

/// One attribute of a stream.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Attribute {
    /// Its name: 1 to 64 of `A-Z a-z 0-9 _ . : -`, unique in the schema.
    pub name: String,
    /// The type of a component.
    pub value_type: ValueType,
    /// Components per value, 1 to 256.
    pub components: u16,
    /// Per vertex or per grid.
    pub rate: Rate,
}

impl Attribute {
    /// An attribute of one value per vertex.
    pub fn vertex(name: &str, value_type: ValueType, components: u16) -> Self {
        Self { name: name.into(), value_type, components, rate: Rate::Vertex }
    }

    /// An attribute of one value per grid.
    pub fn grid(name: &str, value_type: ValueType, components: u16) -> Self {
        Self { name: name.into(), value_type, components, rate: Rate::Grid }
    }

    /// Bytes of one value.
    pub fn value_bytes(&self) -> usize {
        self.value_type.bytes() * usize::from(self.components)
    }
}

/// Names of the attributes that the engine itself reads.
///
/// `N` is the unit normal (3 components), `radius` the radius of points and lines in scene units, `opacity` from 0
/// to 1, `albedo` and `radiance` linear RGB, `id` the identity of the object, `instance` the copy's number, `point` that
/// of the point in its file. Positions (`P`) are not an attribute: every grid has them.
pub mod names {
    /// Unit normal, 3 components.
    pub const NORMAL: &str = "N";
    /// Radius of points and lines, scene units.
    pub const RADIUS: &str = "radius";
    /// Opacity from 0 to 1, one component.
    pub const OPACITY: &str = "opacity";
    /// Diffuse reflectance, linear RGB.
    pub const ALBEDO: &str = "albedo";
    /// Outgoing radiance, linear RGB.
    pub const RADIANCE: &str = "radiance";
    /// Identity of the object, u32.
    pub const ID: &str = "id";
    /// Number of the copy in an instanced geometry, u32.
    pub const INSTANCE: &str = "instance";
    /// Number of the point in the object of the imported file, u32; 4,294,967,295 where there is none.
    pub const POINT: &str = "point";
    /// Set to 1 on points that a partial bake computed, u8.
    pub const BAKED: &str = "baked";
}

/// Which axis points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// +y.
    Y,
    /// +z.
    Z,
}

/// The attributes of a stream and the space it stands in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Schema {
    /// Metres per scene unit.
    pub meters_per_unit: f64,
    /// Which axis points up.
    pub up: UpAxis,
    /// The attributes, in the order of a grid's columns.
    pub attributes: Vec<Attribute>,
}

/// Attributes a schema may hold at most.
pub const ATTRIBUTES_MAX: usize = 64;

impl Default for Schema {
    fn default() -> Self {
        Self { meters_per_unit: 1.0, up: UpAxis::Y, attributes: Vec::new() }
    }
}

impl Schema {
    /// The column that holds `name`.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.attributes.iter().position(|attribute| attribute.name == name)
    }

    /// Checks names, counts and the types of standard attributes.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) with the attribute's name.
    pub fn validate(&self) -> Result<()> {
        if !(self.meters_per_unit.is_finite() && self.meters_per_unit > 0.0) {
            return Err(Error::invalid(format!(
                "`{}` metres per unit is not a positive number",
                self.meters_per_unit
            )));
        }
        if self.attributes.len() > ATTRIBUTES_MAX {
            return Err(Error::invalid(format!(
                "{} attributes, at most {ATTRIBUTES_MAX} are possible",
                self.attributes.len()
            )));
        }
        for (index, attribute) in self.attributes.iter().enumerate() {
            let name = &attribute.name;
            let legal = |c: char| c.is_ascii_alphanumeric() || "_.:-".contains(c);
            if name.is_empty() || name.len() > 64 || !name.chars().all(legal) {
                return Err(Error::invalid(format!("`{}` cannot name an attribute", name.escape_default())));
            }
            if self.find(name) != Some(index) {
                return Err(Error::invalid(format!("attribute `{name}` is there twice")));
            }
            if !(1..=256).contains(&attribute.components) {
                return Err(Error::invalid(format!(
                    "attribute `{name}` has {} components, 1 to 256 are possible",
                    attribute.components
                )));
            }
            let expected = match name.as_str() {
                names::NORMAL | names::ALBEDO | names::RADIANCE => 3,
                names::RADIUS
                | names::OPACITY
                | names::ID
                | names::INSTANCE
                | names::POINT
                | names::BAKED => 1,
                _ => attribute.components,
            };
            if attribute.components != expected {
                return Err(Error::invalid(format!(
                    "attribute `{name}` has {} components, {expected} expected",
                    attribute.components
                )));
            }
        }
        Ok(())
    }
}
