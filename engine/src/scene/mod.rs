//! The scene: what to bake, as an XML file declares it (paper, section 4; `docs/scene.md`).

use std::path::PathBuf;

use glam::DMat4;

pub use crate::stream::schema::UpAxis;

/// A validated scene. Everything refers to everything by name; names are unique over the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The file it was read from.
    pub path: PathBuf,
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
    /// A file: .mgs, .ply, .obj, .gltf or .glb.
    File(PathBuf),
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
}
