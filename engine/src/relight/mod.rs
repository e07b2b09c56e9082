//! Relighting: a picture from a baked stream, an environment and a camera (`docs/relight.md`).
//!
//! Outgoing radiance is albedo/π times the triple product of light, visibility and clamped cosine in spherical
//! harmonics: [`environment`] and [`sky`] make the light, [`transfer`] multiplies, [`view`], [`raster`] and [`draw`]
//! put grids into a z-buffer, [`picture`] writes files. [`visible`] tells which faces a camera sees at all.

pub mod draw;
pub mod environment;
mod exr_map;
pub mod latlong;
pub mod picture;
pub mod raster;
mod rgbe;
pub mod sky;
pub mod transfer;
pub mod view;
pub mod visible;

pub use environment::{Environment, Sun, Window, scene_from_map};
pub use latlong::LatLong;
pub use picture::Picture;
pub use sky::{Sky, SunPosition};
pub use visible::{Visible, VisibleFaces, visible_faces};

#[cfg(test)]
mod tests;

use draw::{Columns, Lit, Shading};
use raster::Sample;
use view::View;

use crate::error::nearest;
use crate::math::Bounds;
use crate::scene::{Camera, Domain, ShOcclusion, Weight};
use crate::shade::sh::{BANDS_MAX, bands_of};
use crate::stream::schema::names;
use crate::stream::{Microgrid, MicrogridStream, Schema, ValueType};
use crate::{Error, ErrorKind, Result};

/// Where to look from.
#[derive(Clone, Debug, PartialEq)]
pub enum Viewpoint {
    /// Through this camera.
    Camera(Camera),
    /// From where all that was baked is in view, in a picture of this width and height.
    Automatic([u32; 2]),
}

/// What to draw and how.
#[derive(Clone, Debug, PartialEq)]
pub struct RelightOptions {
    /// Where to look from.
    pub viewpoint: Viewpoint,
    /// The light.
    pub environment: Environment,
    /// Turns the environment about the up axis, counter-clockwise seen from above, degrees.
    pub rotation_degrees: f64,
    /// Brightens the PNG, in stops.
    pub exposure_stops: f32,
    /// The attribute of visibility coefficients; none means the one whose name says so.
    pub attribute: Option<String>,
    /// An attribute whose own values are drawn instead of light.
    pub shown: Option<String>,
    /// How directions weighed when it was baked.
    pub weight: Weight,
    /// Where its rays went; none means the hemisphere if the stream has normals, else the sphere.
    pub domain: Option<Domain>,
    /// Bands of the light; none means as many as the visibility has.
    pub light_bands: Option<u32>,
    /// Bands of the clamped cosine; none means as many as the visibility has.
    pub cosine_bands: Option<u32>,
    /// What tapers the light's bands.
    pub window: Window,
    /// Whether the environment is drawn behind the scene; otherwise the picture has alpha.
    pub background: bool,
    /// Samples per pixel along each axis, 1 to 4.
    pub supersampling: u32,
}

impl RelightOptions {
    /// The defaults for an environment: automatic framing at 1280 × 720, background, 2 × 2 samples per pixel.
    ///
    /// A map is projected to the visibility's bands and no more. A sun would ring there and leave black and blue
    /// patches where the sum turns negative, so an environment that has one gets all 6 bands under a Lanczos window.
    pub fn new(environment: Environment) -> Self {
        let sunny = environment.sun().is_some();
        Self {
            viewpoint: Viewpoint::Automatic([1280, 720]),
            environment,
            rotation_degrees: 0.0,
            exposure_stops: 0.0,
            attribute: None,
            shown: None,
            weight: Weight::Uniform,
            domain: None,
            light_bands: sunny.then_some(BANDS_MAX as u32),
            cosine_bands: None,
            window: if sunny { Window::Lanczos } else { Window::None },
            background: true,
            supersampling: 2,
        }
    }
}

/// What relighting met.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RelightStats {
    /// Grids, faces and what was left out.
    pub drawn: draw::Drawn,
    /// The attribute that was used.
    pub attribute: String,
    /// Pixels of the environment's file that were not finite or negative.
    pub repaired_pixels: u64,
}

/// Draws a baked stream under an environment.
///
/// The stream is rewound first; it is read once, and once more before that to frame it automatically. Memory is the
/// frame's, 16 bytes per sample, whatever the stream's size. The same picture from any number of threads.
///
/// # Errors
/// When the options contradict the stream (no such attribute, not a square of 1 to 6 coefficients, an impossible
/// camera), or the stream cannot be read.
pub fn relight(
    stream: &mut dyn MicrogridStream,
    options: &RelightOptions,
    progress: &mut dyn FnMut(f64),
) -> Result<Picture> {
    let schema = stream.schema().clone();
    let shading = shading(&schema, options)?;
    let two_passes = matches!(options.viewpoint, Viewpoint::Automatic(_));
    let camera = match &options.viewpoint {
        Viewpoint::Camera(camera) => camera.clone(),
        Viewpoint::Automatic(resolution) => {
            // An impossible size is refused before the stream is read.
            let unit = Bounds { min: glam::DVec3::ZERO, max: glam::DVec3::ONE };
            View::new(
                &view::frame(&unit, schema.up, *resolution)?,
                options.supersampling,
                schema.meters_per_unit,
            )?;
            let bounds = baked_bounds(stream, &mut |done| progress(0.3 * done))?;
            view::frame(&bounds, schema.up, *resolution)?
        }
    };
    let view = View::new(&camera, options.supersampling, schema.meters_per_unit)?;
    let mut samples = vec![Sample::<[f32; 3]>::EMPTY; view.width * view.height];
    stream.rewind()?;
    let start = if two_passes { 0.3 } else { 0.0 };
    let mut second = |done: f64| progress(start + (1.0 - start) * done);
    let drawn = draw::draw(stream, &view, Some(&shading), &mut samples, &mut second)?;
    let (rgb, alpha) = resolve(&samples, &view, schema.up, options);
    Ok(Picture {
        width: camera.resolution[0],
        height: camera.resolution[1],
        rgb,
        alpha,
        exposure_stops: options.exposure_stops,
        stats: RelightStats {
            drawn,
            attribute: schema.attributes[shading.column()].name.clone(),
            repaired_pixels: options.environment.repaired_pixels(),
        },
    })
}

/// Checks the options against the stream and contracts the light.
fn shading(schema: &Schema, options: &RelightOptions) -> Result<Shading> {
    if !(-100.0..=100.0).contains(&options.exposure_stops) || !options.rotation_degrees.is_finite() {
        return Err(Error::invalid(format!(
            "an exposure of `{}` stops and a rotation of `{}` degrees",
            options.exposure_stops, options.rotation_degrees
        ))
        .hint("exposure goes from -100 to 100, the rotation is any finite number"));
    }
    if let Some(name) = &options.shown {
        return find_shown(schema, name).map(Shading::Shown);
    }
    let column = find_attribute(schema, options.attribute.as_deref())?;
    let components = usize::from(schema.attributes[column].components);
    let visibility_bands = bands_of(components).expect("checked by find_attribute");
    let bands = |name: &str, asked: Option<u32>| match asked {
        None => Ok(visibility_bands),
        Some(bands) if (1..=BANDS_MAX as u32).contains(&bands) => Ok(bands as usize),
        Some(bands) => {
            Err(Error::invalid(format!("`{bands}` bands of the {name}, 1 to {BANDS_MAX} are possible")))
        }
    };
    let light_bands = bands("light", options.light_bands)?;
    let cosine_bands = bands("cosine", options.cosine_bands)?;
    let frame = scene_from_map(schema.up, options.rotation_degrees);
    let light = options.environment.project(light_bands, frame, options.window);
    let transfer =
        transfer::Transfer::new(&light, light_bands, visibility_bands, cosine_bands, options.weight);
    let normals = schema.find(names::NORMAL).is_some();
    let domain = options.domain.unwrap_or(if normals { Domain::Hemisphere } else { Domain::Sphere });
    Ok(Shading::Lit(Lit { transfer, column, domain }))
}

/// The column of the attribute called `name`.
fn find_shown(schema: &Schema, name: &str) -> Result<usize> {
    schema.find(name).ok_or_else(|| {
        let names = || schema.attributes.iter().map(|attribute| attribute.name.as_str());
        let hint = match nearest(name, names()) {
            Some(near) => format!("did you mean `{near}`?"),
            None => format!("it has {}", names().collect::<Vec<_>>().join(", ")),
        };
        let message = format!("the stream has no attribute `{}`", name.escape_debug());
        Error::new(ErrorKind::NotFound, message).hint(hint)
    })
}

/// The column of visibility coefficients: the one that is asked for, else the first that is named after occlusion.
///
/// # Errors
/// [`ErrorKind::NotFound`] when there is none, [`ErrorKind::Invalid`] when the one asked for cannot be coefficients.
pub fn find_attribute(schema: &Schema, asked: Option<&str>) -> Result<usize> {
    const STANDARD: [&str; 8] = [
        names::NORMAL,
        names::RADIUS,
        names::OPACITY,
        names::ALBEDO,
        names::RADIANCE,
        names::ID,
        names::INSTANCE,
        names::BAKED,
    ];
    let possible = |column: &usize| {
        let attribute = &schema.attributes[*column];
        let number = matches!(attribute.value_type, ValueType::F16 | ValueType::F32);
        let standard = STANDARD.contains(&attribute.name.as_str());
        number && !standard && bands_of(usize::from(attribute.components)).is_some()
    };
    let candidates: Vec<usize> = (0..schema.attributes.len()).filter(possible).collect();
    let name = |column: usize| schema.attributes[column].name.as_str();
    let listed = || {
        let names: Vec<String> = candidates.iter().map(|&column| format!("`{}`", name(column))).collect();
        if names.is_empty() {
            "the stream has no attribute of 1, 4, 9, 16, 25 or 36 coefficients; bake it first".into()
        } else {
            format!("it could be {}", names.join(", "))
        }
    };
    if let Some(asked) = asked {
        if let Some(&column) = candidates.iter().find(|&&column| name(column) == asked) {
            return Ok(column);
        }
        let error = match schema.find(asked) {
            Some(column) => Error::invalid(format!(
                "attribute `{asked}` of {} components holds no visibility coefficients",
                schema.attributes[column].components
            )),
            None => Error::new(ErrorKind::NotFound, format!("no attribute `{}`", asked.escape_debug())),
        };
        let near = nearest(asked, candidates.iter().map(|&column| name(column)));
        return Err(error.hint(near.map_or_else(listed, |near| format!("did you mean `{near}`"))));
    }
    ["sh_occlusion", "occlusion"]
        .into_iter()
        .find_map(|word| {
            // Ambient occlusion is one number, not one coefficient
            let is_named =
                |column: &usize| name(*column).contains(word) && !name(*column).contains("ambient");
            candidates.iter().copied().find(is_named)
        })
        .ok_or_else(|| Error::new(ErrorKind::NotFound, "no attribute is named `sh_occlusion`").hint(listed()))
}

/// The first attribute of visibility coefficients that a stream's metadata names; none where it names none.
pub fn noted_attribute(metadata: &[(String, String)]) -> Option<&str> {
    // Other outputs of the shader are no coefficients
    let output = |name: &str| metadata.iter().find(|(key, _)| key.strip_suffix(".output") == Some(name));
    let is_coefficients =
        |name: &&str| output(name).is_none_or(|(_, output)| output == ShOcclusion::COEFFICIENTS);
    let baked = metadata.iter().filter(|(_, value)| value == "sh_occlusion");
    baked.filter_map(|(key, _)| key.strip_suffix(".shader")).find(is_coefficients)
}

/// How an attribute was baked, as its stream's metadata says: weight, and domain where that is said.
pub fn noted(metadata: &[(String, String)], attribute: &str) -> (Weight, Option<Domain>) {
    let noted = |what: &str| {
        let key = format!("{attribute}.{what}");
        metadata.iter().find(|(name, _)| *name == key).map(|(_, value)| value.as_str())
    };
    let weight = if noted("weight") == Some("cosine") { Weight::Cosine } else { Weight::Uniform };
    let domain = match noted("domain") {
        Some("hemisphere") => Some(Domain::Hemisphere),
        Some("sphere") => Some(Domain::Sphere),
        _ => None,
    };
    (weight, domain)
}

/// The box of all vertices that were baked. Leaves the stream at its end.
fn baked_bounds(stream: &mut dyn MicrogridStream, progress: &mut dyn FnMut(f64)) -> Result<Bounds> {
    let schema = stream.schema().clone();
    let columns = Columns::new(&schema);
    let partial = schema.find(names::BAKED).is_some();
    let mut bounds = Bounds::EMPTY;
    let mut grid = Microgrid::default();
    stream.rewind()?;
    while stream.next(&mut grid)? {
        if partial {
            for vertex in (0..grid.vertex_count()).filter(|&v| columns.is_baked(&schema, &grid, v)) {
                bounds.add(grid.position(vertex));
            }
        } else {
            bounds = bounds.union(&grid.bounds());
        }
        progress(stream.progress());
    }
    Ok(bounds)
}

/// Averages samples to pixels, with the environment or nothing behind them.
fn resolve(
    samples: &[Sample<[f32; 3]>],
    view: &View,
    up: crate::scene::UpAxis,
    options: &RelightOptions,
) -> (Vec<f32>, Vec<f32>) {
    use rayon::prelude::*;
    let n = view.supersampling;
    let (width, height) = (view.width / n, view.height / n);
    let map_from_scene = scene_from_map(up, options.rotation_degrees).transpose();
    let mut rgb = vec![0.0; 3 * width * height];
    let mut alpha = vec![0.0; width * height];
    let rows = rgb.par_chunks_mut(3 * width).zip(alpha.par_chunks_mut(width)).enumerate();
    rows.for_each(|(row, (rgb, alpha))| {
        for (column, (rgb, alpha)) in rgb.chunks_exact_mut(3).zip(alpha).enumerate() {
            let mut covered = 0;
            for at in 0..n * n {
                let (x, y) = (column * n + at % n, row * n + at / n);
                let sample = &samples[y * view.width + x];
                let empty = sample.inverse_depth == 0.0;
                covered += usize::from(!empty);
                let value = if !empty {
                    sample.paint
                } else if options.background {
                    let ray = view.ray(x as f32 + 0.5, y as f32 + 0.5);
                    options.environment.radiance(map_from_scene * ray)
                } else {
                    [0.0; 3]
                };
                rgb.iter_mut().zip(value).for_each(|(sum, value)| *sum += value);
            }
            let share = 1.0 / (n * n) as f32;
            rgb.iter_mut().for_each(|sum| *sum *= share);
            *alpha = if options.background { 1.0 } else { covered as f32 * share };
        }
    });
    (rgb, alpha)
}
