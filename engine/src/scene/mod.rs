//! The scene: what to bake, as an XML file declares it (paper, section 4; `docs/scene.md`).
//!
//! Text becomes a tree that knows its places (`xml`), the tree becomes typed values (`element`, `parse`, `shader`,
//! `geometry`), names are resolved on the way (`names`), and files and transforms are checked (`files`, `matrix`).
//! Instance files may be large: [`instances`] streams them.

mod dice;
mod element;
mod files;
mod geometry;
pub mod instances;
mod matrix;
mod names;
mod output;
mod parse;
mod shader;
#[cfg(test)]
mod tests;
mod xml;

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use glam::DMat4;

pub use self::dice::{Dice, Edge};
pub use self::files::Roots;
pub use self::instances::{InstanceReader, for_each_instance};
pub use self::output::Output;
pub use self::parse::UNITS;
pub use self::xml::{DEPTH_MAX, ELEMENTS_MAX, SCENE_BYTES_MAX, VALUE_BYTES_MAX};
pub use crate::stream::schema::UpAxis;
use crate::{Error, ErrorKind, Result};

/// Reads and checks a scene file whose paths have no frame patterns.
///
/// # Errors
/// As [`load_frame`].
pub fn load(path: &Path) -> Result<Scene> {
    load_frame(path, None)
}

/// Reads and checks a scene file; `frame` fills patterns such as `####` and `%04d` in its paths.
///
/// What instance files hold is checked when [`for_each_instance`] reads them.
///
/// # Errors
/// [`ErrorKind::NotFound`] and [`ErrorKind::Io`] for the file itself, and those of [`parse_frame`].
pub fn load_frame(path: &Path, frame: Option<i64>) -> Result<Scene> {
    parse_frame(path, &read(path)?, frame)
}

/// Reads and checks a scene file from elsewhere: it may name files below its own folder and, as `root:NAME/path`, below
/// `roots`, and no others.
///
/// # Errors
/// As [`load_frame`]; [`ErrorKind::Invalid`] for a path that leads out of its folder.
pub fn load_confined(path: &Path, frame: Option<i64>, roots: &Roots) -> Result<Scene> {
    parse::scene(&xml::Document::parse(path, &read(path)?)?, frame, Some(roots))
}

/// A scene file's text.
fn read(path: &Path) -> Result<String> {
    let file = File::open(path).map_err(|source| Error::io("open scene", path, source))?;
    let mut bytes = Vec::new();
    // One byte more than allowed tells a file that is too long, however long it claims to be
    let read = file.take(SCENE_BYTES_MAX as u64 + 1).read_to_end(&mut bytes);
    read.map_err(|source| Error::io("read scene", path, source))?;
    if bytes.len() > SCENE_BYTES_MAX {
        return Err(xml::too_long(bytes.len() as u64).at(path));
    }
    String::from_utf8(bytes).map_err(|error| not_utf8(path, error.as_bytes(), error.utf8_error()))
}

/// Checks the text of a scene whose paths have no frame patterns.
///
/// # Errors
/// As [`parse_frame`].
pub fn parse(path: &Path, text: &str) -> Result<Scene> {
    parse_frame(path, text, None)
}

/// Checks the text of a scene. `path` names it in errors and is the base of the paths in it.
///
/// # Errors
/// With line and column, what was expected and the nearest valid name: [`ErrorKind::Invalid`] for whatever is wrong
/// with the text, [`ErrorKind::NotFound`] for a file that is not there, [`ErrorKind::Unsupported`] for what the
/// grammar declares and this version cannot do yet, [`ErrorKind::Limit`] beyond a stated limit.
pub fn parse_frame(path: &Path, text: &str, frame: Option<i64>) -> Result<Scene> {
    parse::scene(&xml::Document::parse(path, text)?, frame, None)
}

fn not_utf8(path: &Path, bytes: &[u8], error: std::str::Utf8Error) -> Error {
    let before = String::from_utf8_lossy(&bytes[..error.valid_up_to()]);
    let (line, column) = xml::place_in(before.trim_start_matches('\u{feff}'));
    let error = Error::invalid("text is not UTF-8").at_text(path, line, column);
    match bytes {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => error.hint("it looks like UTF-16: save the file as UTF-8"),
        _ => error.hint("save the file as UTF-8"),
    }
}

/// A validated scene. Everything refers to everything by name; names are unique over the scene within their kind
/// (camera, shader, geometry, bake set).
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The file it was read from.
    pub path: PathBuf,
    /// The frame that it was read for.
    pub frame: Option<i64>,
    /// Metres per scene unit.
    pub meters_per_unit: f64,
    /// Which axis points up.
    pub up: UpAxis,
    /// The cameras.
    pub cameras: Vec<Camera>,
    /// The shaders.
    pub shaders: Vec<Shader>,
    /// The geometries.
    pub geometries: Vec<Geometry>,
}

/// A pinhole camera. It looks along its own -z, with +y up in the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Its name.
    pub name: String,
    /// Vertical field of view in degrees, more than 0 and less than 180.
    pub fov_degrees: f64,
    /// Width and height in pixels.
    pub resolution: [u32; 2],
    /// World from camera.
    pub world_from_camera: DMat4,
}

/// A shader and its parameters, checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Shader {
    /// Its name.
    pub name: String,
    /// What it computes.
    pub kind: ShaderKind,
}

/// What a shader computes.
#[derive(Clone, Debug, PartialEq)]
pub enum ShaderKind {
    /// Directional occlusion in spherical harmonics.
    ShOcclusion(ShOcclusion),
}

/// Parameters of `sh_occlusion`.
#[derive(Clone, Debug, PartialEq)]
pub struct ShOcclusion {
    /// Bands, 1 to 6; bands² coefficients.
    pub bands: u32,
    /// Rays per point, 16 to 65,536.
    pub samples: u32,
    /// Hemisphere about the normal, or the whole sphere.
    pub domain: Domain,
    /// Uniform, or weighted with the cosine to the normal.
    pub weight: Weight,
    /// Rays end here, in scene units.
    pub max_distance: Option<f64>,
    /// How coefficients are stored: f32 or f16.
    pub storage: crate::stream::ValueType,
}

impl ShOcclusion {
    /// The output of all coefficients.
    pub const COEFFICIENTS: &str = "coefficients";
    /// The output of the share of the hemisphere, weighted with the cosine, that is open: 1 number.
    pub const AMBIENT_OCCLUSION: &str = "ambient_occlusion";
    /// The output of the mean open direction: a unit vector.
    pub const BENT_NORMAL: &str = "bent_normal";
    /// The output of the coefficients' standard error: 1 number.
    pub const ERROR: &str = "error";
}

impl Default for ShOcclusion {
    fn default() -> Self {
        Self {
            bands: 3,
            samples: 512,
            domain: Domain::Hemisphere,
            weight: Weight::Uniform,
            max_distance: None,
            storage: crate::stream::ValueType::F32,
        }
    }
}

/// Where rays go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Domain {
    /// The hemisphere about the normal; a vertex without a normal gets the sphere.
    Hemisphere,
    /// The whole sphere.
    Sphere,
}

/// How directions weigh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weight {
    /// All the same.
    Uniform,
    /// By the cosine to the normal.
    Cosine,
}

/// A stream in the scene: an occluder, the carrier of bake sets, or both.
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    /// Its name.
    pub name: String,
    /// Whether it occludes.
    pub occluder: bool,
    /// Where its microgrids come from, concatenated in order.
    pub streams: Vec<StreamSource>,
    /// Its copies; none means one, where it stands.
    pub instances: Vec<Instances>,
    /// What to bake on it.
    pub bake_sets: Vec<BakeSet>,
}

/// Where microgrids come from.
#[derive(Clone, Debug, PartialEq)]
pub enum StreamSource {
    /// A file: .mgs, or one that is imported, and perhaps diced.
    File(PathBuf, Option<Dice>),
    /// A generator.
    Procedural(Procedural),
}

/// A procedural stream's parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Procedural {
    /// What it makes.
    pub kind: ProceduralKind,
    /// Same seed, same bytes.
    pub seed: u64,
    /// About how many micropolygons it makes.
    pub micropolygons: u64,
}

/// The generators.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProceduralKind {
    /// Plants of several species scattered on terrain, around a clearing.
    Jungle,
    /// A meadow.
    Grass,
    /// Bare ground.
    Terrain,
}

/// Copies of a geometry.
#[derive(Clone, Debug, PartialEq)]
pub enum Instances {
    /// One copy: world from object.
    Matrix(DMat4),
    /// A CSV file of 16 columns, one copy a line; may hold millions.
    File(PathBuf),
}

/// A stream to be cloned and decorated with shader outputs.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeSet {
    /// Its name, and that of the output file.
    pub name: String,
    /// The geometries it sees; none means every occluder.
    pub occluders: Vec<String>,
    /// What to add, in order.
    pub attributes: Vec<BakeAttribute>,
}

/// An attribute to add to a bake set.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeAttribute {
    /// The attribute's name in the output.
    pub name: String,
    /// The shader that computes it.
    pub shader: String,
    /// Which of the shader's [outputs](ShaderKind::outputs).
    pub output: String,
}
