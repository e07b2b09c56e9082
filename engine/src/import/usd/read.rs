//! The composed stage: values at the frame that is imported, and prims as meshes.

use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use openusd::sdf::Value;
use openusd::usd::{self, TimeCode};

use super::fence::Stop;
use super::guard::Guard;
use super::material::{Cover, Images};
use super::walk::{Kind, Prim};
use super::{curves, points, polygons};
use crate::import::ImportOptions;
use crate::import::ImportReport;
use crate::import::mesh::Mesh;
use crate::stream::Attribute;
use crate::{Error, ErrorKind, Result};

/// A prim as a mesh, in its own space.
#[derive(Debug, Default)]
pub(super) struct Geometry {
    /// Faces, lines and points; not finished.
    pub mesh: Mesh,
    /// What was counted and left out.
    pub report: ImportReport,
    /// What lets light through. Faces name it by their material, from 1.
    pub covers: Vec<Cover>,
}

/// An open file.
pub(super) struct Stage {
    /// The library's stage. It lives in the thread that reads.
    pub stage: usd::Stage,
    /// The file.
    pub path: PathBuf,
    /// What may be held at once, in bytes.
    pub memory_bytes: u64,
    /// Metres per unit of the scene, and its up axis.
    pub options: ImportOptions,
    /// Textures read so far.
    pub images: Images,
    layer_bytes_left: Rc<Cell<u64>>,
    frame: Option<f64>,
}

impl Stage {
    /// Opens a file with everything it is made of.
    pub fn open(path: &Path, options: &ImportOptions, stop: Stop) -> Result<Self> {
        // The library's own error for a file that is not there names no reason
        std::fs::File::open(path).map_err(|error| Error::io("open the file", path, error))?;
        let name = path.to_str().ok_or_else(|| Error::invalid("a path that is not UTF-8").at(path))?;
        // What layers hold is decoded as they are opened: about twice their size on disk and more
        let guard = Guard::new(path.to_path_buf(), options.memory_bytes / 2, stop);
        let layer_bytes_left = guard.bytes_left();
        let stage = usd::Stage::builder().resolver(guard).open(name).map_err(|error| {
            Error::new(ErrorKind::Corrupt, format!("not a USD file that can be read: {error:#}")).at(path)
        })?;
        Ok(Self {
            stage,
            path: path.to_path_buf(),
            memory_bytes: options.memory_bytes,
            options: options.clone(),
            images: Images::default(),
            layer_bytes_left,
            frame: options.frame,
        })
    }

    /// What the layers read so far take once they are decoded.
    pub fn layer_bytes(&self) -> u64 {
        let limit = self.memory_bytes / 2;
        2 * (limit - self.layer_bytes_left.get().min(limit))
    }

    /// The value of an attribute at the frame; without one its default, or else its first sample.
    pub fn value(&self, prim: &str, attribute: &str) -> Option<Value> {
        let attribute = self.stage.attribute(format!("{prim}.{attribute}"));
        let at = |time: Option<TimeCode>| match attribute.get_at::<Value>(time).ok().flatten() {
            Some(Value::None | Value::ValueBlock) | None => None,
            Some(value) => Some(value),
        };
        match self.frame {
            Some(frame) => at(Some(TimeCode::new(frame))),
            None => at(None).or_else(|| at(Some(TimeCode::EARLIEST))),
        }
    }

    /// A token or string.
    pub fn text(&self, prim: &str, attribute: &str) -> Option<String> {
        super::value::text(&self.value(prim, attribute)?)
    }

    /// Numbers of a scalar, tuple or array.
    pub fn numbers(&self, prim: &str, attribute: &str) -> Option<Vec<f64>> {
        super::value::numbers(&self.value(prim, attribute)?)
    }

    /// Whole numbers of an array.
    pub fn integers(&self, prim: &str, attribute: &str) -> Option<Vec<i64>> {
        super::value::integers(&self.value(prim, attribute)?)
    }

    /// A field of an attribute, such as `interpolation`.
    pub fn field(&self, prim: &str, attribute: &str, field: &str) -> Option<Value> {
        self.stage.attribute(format!("{prim}.{attribute}")).get_metadata::<Value>(field).ok().flatten()
    }

    /// A list of whole numbers in a prim's metadata, such as `inactiveIds`.
    pub fn prim_list(&self, prim: &str, field: &str) -> Vec<i64> {
        // The library reads any field by its object's path, and offers it for attributes
        match self.stage.attribute(prim).get_metadata::<Value>(field).ok().flatten() {
            Some(Value::Int64ListOp(list)) => list.flatten(),
            Some(value) => super::value::integers(&value).unwrap_or_default(),
            None => Vec::new(),
        }
    }

    /// Reads a part of a prim; `attributes` are those that primvars become.
    pub fn geometry(&self, prim: &Prim, part: usize, attributes: &[Attribute]) -> Result<Geometry> {
        match prim.kind {
            Kind::Mesh => polygons::read(self, prim, attributes),
            Kind::Points => points::read(self, prim, attributes),
            Kind::Curves => curves::read(self, prim, part, attributes),
        }
    }

    /// An error about a prim.
    pub fn broken(&self, prim: &str, message: impl std::fmt::Display) -> Error {
        Error::invalid(format!("prim `{prim}`: {message}")).at(&self.path)
    }
}
