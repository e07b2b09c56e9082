//! The shaders of a bake set: each runs once a batch, whatever number of attributes its outputs fill.

use super::BakeOptions;
use crate::batch::Point;
use crate::scene::{BakeSet, Output, Scene, ShOcclusion, Shader, ShaderKind};
use crate::shade::ambient;
use crate::shade::sh_occlusion::half_split_error;
use crate::stream::Attribute;
use crate::trace::Shading;
use crate::{Error, Result};

/// A shader, and what it needs to run.
pub(super) struct Run {
    /// The shader as the scene has it.
    pub shader: Shader,
    /// Rays per point.
    pub samples: u32,
    /// What traces.
    pub program: Program,
}

/// What computes a shader's numbers.
pub(super) enum Program {
    /// Visibility in all directions.
    Spherical(Shading),
}

/// An attribute to add, and where its numbers come from.
pub(super) struct Column {
    /// Which run.
    pub run: usize,
    /// Which of its numbers.
    pub output: Output,
    /// The attribute.
    pub attribute: Attribute,
}

/// The shaders of a bake set and its attributes.
pub(super) struct Runs {
    /// The shaders, each once.
    pub runs: Vec<Run>,
    /// The attributes, in the scene's order.
    pub columns: Vec<Column>,
}

impl Runs {
    /// The shaders of `set`, with the samples that the options ask for; `shift` is that of the points' own stream in the
    /// brick map.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when a shader or an output is unknown.
    pub fn new(scene: &Scene, options: &BakeOptions, set: &BakeSet, shift: u8) -> Result<Self> {
        let mut all = Self { runs: Vec::new(), columns: Vec::new() };
        for wanted in &set.attributes {
            let unknown =
                || Error::invalid(format!("no shader is called `{}`", wanted.shader)).at(&scene.path);
            let shader = scene.shaders.iter().find(|shader| shader.name == wanted.shader);
            let shader = shader.ok_or_else(unknown)?;
            let output = shader.kind.outputs().into_iter().find(|output| output.name == wanted.output);
            let output = output.ok_or_else(|| {
                let message = format!("shader `{}` has no output `{}`", shader.name, wanted.output);
                Error::invalid(message).at(&scene.path)
            })?;
            let run = match all.runs.iter().position(|run| run.shader.name == shader.name) {
                Some(run) => run,
                None => {
                    all.runs.push(Run::new(shader, options, set, shift));
                    all.runs.len() - 1
                }
            };
            let attribute = Attribute::vertex(&wanted.name, shader.kind.storage(), output.components as u16);
            all.columns.push(Column { run, output, attribute });
        }
        Ok(all)
    }
}

impl Run {
    fn new(shader: &Shader, options: &BakeOptions, set: &BakeSet, shift: u8) -> Self {
        match &shader.kind {
            ShaderKind::ShOcclusion(parameters) => {
                let samples = options.samples.unwrap_or(parameters.samples);
                let wanted = set.attributes.iter().filter(|attribute| attribute.shader == shader.name);
                let wanted: Vec<&str> = wanted.map(|attribute| &*attribute.output).collect();
                let of_band_one = [ShOcclusion::AMBIENT_OCCLUSION, ShOcclusion::BENT_NORMAL];
                let bands = match wanted.iter().any(|output| of_band_one.contains(output)) {
                    true => parameters.bands.max(ambient::BANDS_MIN),
                    false => parameters.bands,
                };
                let traced = ShOcclusion { samples, bands, ..parameters.clone() };
                let mut shading = Shading::new(&traced, options.seed, &set.name, shift);
                if wanted.contains(&ShOcclusion::ERROR) {
                    shading = shading.with_halves();
                }
                let program = Program::Spherical(shading);
                Self { shader: shader.clone(), samples, program }
            }
        }
    }
}

impl Program {
    /// Numbers that are computed at a point.
    pub fn values(&self) -> usize {
        match self {
            Self::Spherical(shading) => shading.values(),
        }
    }

    /// Writes the numbers of `output` at `point` to `row`; `values` are those that were computed there.
    pub fn push_output(&self, output: &Output, point: &Point, values: &[f32], row: &mut Vec<f32>) {
        match self {
            Self::Spherical(_) if output.first == 0 => row.extend_from_slice(&values[..output.components]),
            Self::Spherical(shading) if output.name == ShOcclusion::ERROR => {
                row.push(half_split_error(&values[shading.coefficients()..]));
            }
            Self::Spherical(shading) => {
                let (normal, spread) = shading.spread(point.normal);
                let has_normal = point.normal != glam::Vec3::ZERO;
                let normal = if has_normal { normal } else { glam::Vec3::ZERO };
                let mean_cosine = shading.sampler().mean_cosine(point.index);
                let (open, bent) = ambient::from_coefficients(values, normal, spread, mean_cosine);
                match output.components {
                    1 => row.push(open),
                    _ => row.extend_from_slice(&bent.to_array()),
                }
            }
        }
    }
}
