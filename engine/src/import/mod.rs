//! Import: PLY, OBJ, glTF and USD become compact microgrids, handed to a sink one by one (`docs/import.md`).
//!
//! Each format leaves an indexed `mesh` in memory; `polygon` turns what has more than four corners into
//! triangles, `cut` parts the faces into clusters of at most 256 vertices, `emit` writes them out as microgrids.
//! Nothing is allocated because a file says so: lengths are checked against the file's size, and the memory that a
//! file needs is computed and compared with [`ImportOptions::memory_bytes`] before it is taken.

mod assembly;
mod budget;
mod columns;
mod confine;
mod cut;
mod diced;
mod emit;
mod gltf;
mod large;
mod leaves;
mod lines;
mod mesh;
mod obj;
mod parts;
mod ply;
mod polygon;
mod radius;
mod srgb;
mod usd;

#[cfg(test)]
mod assets;
#[cfg(test)]
mod hostile;
#[cfg(test)]
mod malformed;

use std::path::Path;

pub use self::assembly::Copies;
pub use self::parts::{Part, Parts, SavedParts, Step, import_parts};
pub use self::usd::PRIMS_KEY;
use crate::stream::{Microgrid, Schema, schema::UpAxis};
use crate::{Error, Result};

/// What a file takes and becomes, as far as that is known before it is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Expected {
    /// Bytes that the import will hold at once, at most.
    pub memory_bytes: u64,
    /// Micropolygons that leaves become, cut along their texture.
    pub leaves: u64,
}

/// Receives an imported stream: the schema once, then every grid in order.
pub trait GridSink {
    /// Learns what is to come, before anything else.
    ///
    /// # Errors
    /// When the sink does not want it; the import stops with this error.
    fn expect(&mut self, _: &Expected) -> Result<()> {
        Ok(())
    }

    /// Learns the attributes and the space of the grids that follow, and what the file says about itself.
    ///
    /// # Errors
    /// When the sink cannot take such a stream; the import stops with this error.
    fn begin(&mut self, schema: &Schema, metadata: &[(String, String)]) -> Result<()>;

    /// The grids that follow stand once for each of `copies`, until the next call; those before the first call stand
    /// once, where they are.
    ///
    /// # Errors
    /// When the sink cannot take it; the import stops with this error.
    fn copies(&mut self, copies: &Copies) -> Result<()>;

    /// Takes the next grid. The memory stays with the caller.
    ///
    /// # Errors
    /// When the sink cannot take it; the import stops with this error.
    fn grid(&mut self, grid: &Microgrid) -> Result<()>;
}

/// The space to import into, and how much memory that may take.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportOptions {
    /// Metres per unit of the scene. glTF is in metres and converted; PLY and OBJ carry no unit and are taken as
    /// they are.
    pub meters_per_unit: f64,
    /// The scene's up axis. glTF has +y up and is converted; PLY and OBJ carry no axis and are taken as they are.
    pub up: UpAxis,
    /// What the import may hold in memory at once, in bytes.
    pub memory_bytes: u64,
    /// The time code at which USD is read; none takes default values.
    pub frame: Option<f64>,
    /// How fine to dice; none keeps faces as they are.
    pub dice: Option<crate::dice::Rate>,
    /// Texels along the edges of leaves that are cut along their texture; none means two where faces are diced, and
    /// that leaves stay whole where they are not.
    pub texels: Option<f64>,
    /// Micropolygons that the leaves of a file may become.
    pub leaves_max: u64,
    /// Where meshes larger than memory wait on disk; none is the system's folder for temporary files.
    pub scratch: Option<std::path::PathBuf>,
    /// Seconds that may pass until a USD file yields its next prim: a broken one may take for ever.
    pub patience_seconds: u64,
}

impl ImportOptions {
    /// Where meshes larger than memory wait on disk.
    fn scratch_folder(&self) -> std::path::PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }
}

impl Default for ImportOptions {
    fn default() -> Self {
        Self {
            meters_per_unit: 1.0,
            up: UpAxis::Y,
            memory_bytes: 1 << 30,
            frame: None,
            dice: None,
            texels: None,
            leaves_max: 1 << 28,
            scratch: None,
            patience_seconds: 300,
        }
    }
}

/// What a file holds by its own count, before anything is split, skipped or placed in several copies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SourceCounts {
    /// Positions that a file lists; for glTF the vertices of the primitives that a scene places.
    pub vertices: u64,
    /// Faces of three corners.
    pub triangles: u64,
    /// Faces of four corners.
    pub quads: u64,
    /// Faces of five corners and more.
    pub ngons: u64,
    /// Line segments.
    pub lines: u64,
    /// Points.
    pub points: u64,
}

/// What an import did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImportReport {
    /// Grids handed to the sink.
    pub grids: u64,
    /// Faces in these grids.
    pub micropolygons: u64,
    /// Vertices in these grids; one on a border between grids counts in each.
    pub vertices: u64,
    /// What the file holds by its own count.
    pub source: SourceCounts,
    /// What was left out: the reason, and how often.
    pub skipped: Vec<(String, u64)>,
    /// What was understood differently from what the file may have meant.
    pub warnings: Vec<String>,
}

/// Distinct warnings that a report lists at most: a broken file may cause one per face.
const WARNINGS_MAX: usize = 64;

impl ImportReport {
    /// Counts `count` things left out for `reason`.
    fn skip(&mut self, reason: &str, count: u64) {
        if count == 0 {
            return;
        }
        match self.skipped.iter_mut().find(|(known, _)| known == reason) {
            Some((_, known)) => *known += count,
            None => self.skipped.push((reason.into(), count)),
        }
    }

    /// Adds a warning, once, while there is room.
    fn warn(&mut self, warning: String) {
        if self.warnings.len() < WARNINGS_MAX && !self.warnings.contains(&warning) {
            self.warnings.push(warning);
        }
    }
}

/// The formats read here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Ply,
    Obj,
    Gltf,
    Usd,
}

impl Format {
    fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?;
        match extension.to_ascii_lowercase().as_str() {
            "ply" => Some(Self::Ply),
            "obj" => Some(Self::Obj),
            "gltf" | "glb" => Some(Self::Gltf),
            "usd" | "usda" | "usdc" | "usdz" => Some(Self::Usd),
            _ => None,
        }
    }
}

/// The names of files that are read.
pub const EXTENSIONS: [&str; 8] = ["ply", "obj", "gltf", "glb", "usd", "usda", "usdc", "usdz"];

/// Whether [`import`] reads files of this name: one of [`EXTENSIONS`], in any case.
pub fn is_importable(path: &Path) -> bool {
    Format::of(path).is_some()
}

/// Reads `path` and hands its geometry to `sink` as microgrids. Same file and options, same grids.
///
/// # Errors
/// [`Unsupported`](crate::ErrorKind::Unsupported) for other formats and for extensions that this version cannot
/// read, [`Limit`](crate::ErrorKind::Limit) when the file needs more than [`ImportOptions::memory_bytes`],
/// [`Corrupt`](crate::ErrorKind::Corrupt) or [`Invalid`](crate::ErrorKind::Invalid) with the place for a broken
/// file, and whatever the sink returns. Grids handed over before an error are valid, but not all there are.
pub fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let Some(format) = Format::of(path) else {
        return Err(Error::unsupported("this is not a format that can be imported").at(path).hint(format!(
            "files of these names are read: {}",
            EXTENSIONS.map(|e| format!(".{e}")).join(" ")
        )));
    };
    if !(options.meters_per_unit.is_finite() && options.meters_per_unit > 0.0) {
        return Err(Error::invalid(format!(
            "`{}` metres per unit is not a positive number",
            options.meters_per_unit
        )));
    }
    let mut report = match format {
        Format::Ply => ply::import(path, options, sink),
        Format::Obj => obj::import(path, options, sink),
        Format::Gltf => gltf::import(path, options, sink),
        Format::Usd => usd::import(path, options, sink),
    }
    .map_err(|error| error.at(path))?;
    if report.micropolygons == 0 {
        report.warn("there is no geometry in this file".into());
    }
    Ok(report)
}
