//! `pantaray relight`: a picture from a baked stream.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use engine::bake::Control;
use engine::relight::{
    Environment, Picture, RelightOptions, Viewpoint, find_attribute, noted, noted_attribute, relight,
};
use engine::scene::{self, Camera, UpAxis, Weight};
use engine::stream::MicrogridStream;
use engine::stream::file::MgsReader;
use engine::{Error, ErrorKind, Result};
use glam::{DMat4, DVec3};
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched};
use crate::{figures, values};

/// Light a baked stream and draw a picture of it
#[derive(Debug, Args)]
pub struct Arguments {
    /// The baked stream, .mgs
    #[arg(value_name = "BAKED.mgs")]
    input: PathBuf,
    /// The picture, .png or .exr
    #[arg(short, long, value_name = "PIC")]
    output: PathBuf,
    /// The light: `sky`, `overcast`, `sunset`, or a latitude-longitude map, .hdr or .exr
    #[arg(long, value_name = "SKY|FILE", default_value = "sky")]
    env: String,
    /// Turn the light about the up axis, degrees, counter-clockwise seen from above
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true)]
    rotate: f64,
    #[command(flatten)]
    view: View,
    /// Brighten a .png by so many stops
    #[arg(long, value_name = "STOPS", default_value_t = 0.0, allow_negative_numbers = true)]
    exposure: f32,
    /// The attribute of visibility coefficients [default: the one named after occlusion]
    #[arg(long, value_name = "NAME")]
    attribute: Option<String>,
    /// Samples per pixel along each axis
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=4))]
    supersampling: u32,
    /// How directions weighed in the bake [default: as the stream says, or uniform]
    #[arg(long)]
    weight: Option<Weighting>,
    /// Leave the environment out of the picture, which gets alpha
    #[arg(long)]
    no_background: bool,
}

/// Where to look from; everything in view if nothing is said.
#[derive(Debug, Args)]
struct View {
    /// A camera of the scene
    #[arg(long, value_name = "NAME", requires = "scene", conflicts_with = "eye")]
    camera: Option<String>,
    /// The scene file that has the camera
    #[arg(long, value_name = "SCENE", requires = "camera")]
    scene: Option<PathBuf>,
    /// Where the eye is, in the stream's units
    #[arg(long, value_name = "X,Y,Z", requires = "target", value_parser = values::vector, allow_hyphen_values = true)]
    eye: Option<DVec3>,
    /// What it looks at
    #[arg(long, value_name = "X,Y,Z", requires = "eye", value_parser = values::vector, allow_hyphen_values = true)]
    target: Option<DVec3>,
    /// Vertical field of view, degrees [default: 40]
    #[arg(long, value_name = "DEGREES", requires = "eye")]
    fov: Option<f64>,
    /// Pixels across and down [default: the camera's, or 1280x720]
    #[arg(long, value_name = "WxH", value_parser = values::resolution)]
    size: Option<[u32; 2]>,
}

/// How directions weighed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Weighting {
    /// All the same
    Uniform,
    /// By the cosine to the normal
    Cosine,
}

/// What was drawn.
#[derive(Debug, Serialize)]
pub struct Relit {
    output: PathBuf,
    width: u32,
    height: u32,
    attribute: String,
    grids: u64,
    grids_in_view: u64,
    faces: u64,
    faces_unbaked: u64,
    repaired_pixels: u64,
}

/// Draws and says what.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    // What can be wrong is found before the stream is read
    let mut options = RelightOptions::new(Environment::open(&arguments.env)?);
    let reader = streams::open(&arguments.input)?;
    options.viewpoint = arguments.view.viewpoint(reader.schema().up)?;
    options.rotation_degrees = arguments.rotate;
    options.exposure_stops = arguments.exposure;
    options.supersampling = arguments.supersampling;
    options.background = !arguments.no_background;
    options.attribute = arguments.attribute;
    learn_how_it_was_baked(&reader, &mut options).map_err(|error| error.at(&arguments.input))?;
    if let Some(weight) = arguments.weight {
        options.weight = weight.into();
    }
    let relit = draw(reader, &options, &arguments.output, console.control())?;
    Answer::new(&relit, relit.describe())
}

/// Draws a stream to a file.
pub fn draw(
    reader: MgsReader,
    options: &RelightOptions,
    output: &Path,
    control: Control<'_>,
) -> Result<Relit> {
    let mut stream = Watched::new(reader, "relight", control);
    let picture = relight(&mut stream, options, &mut |_| {})?;
    picture.save(output)?;
    Ok(Relit::of(&picture, output))
}

/// Weight and domain as the bake noted them in the stream.
pub fn learn_how_it_was_baked(reader: &MgsReader, options: &mut RelightOptions) -> Result<()> {
    if options.attribute.is_none() {
        options.attribute = noted_attribute(reader.metadata()).map(str::to_owned);
    }
    let column = find_attribute(reader.schema(), options.attribute.as_deref())?;
    (options.weight, options.domain) = noted(reader.metadata(), &reader.schema().attributes[column].name);
    Ok(())
}

impl View {
    fn viewpoint(&self, up: UpAxis) -> Result<Viewpoint> {
        let resolution = self.size.unwrap_or([1280, 720]);
        if let (Some(eye), Some(target)) = (self.eye, self.target) {
            let world_from_camera = look_at(eye, target, up)?;
            let fov_degrees = self.fov.unwrap_or(40.0);
            return Ok(Viewpoint::Camera(Camera {
                name: "eye".into(),
                fov_degrees,
                resolution,
                world_from_camera,
            }));
        }
        let (Some(name), Some(path)) = (&self.camera, &self.scene) else {
            return Ok(Viewpoint::Automatic(resolution));
        };
        let mut camera = find_camera(path, name)?;
        camera.resolution = self.size.unwrap_or(camera.resolution);
        Ok(Viewpoint::Camera(camera))
    }
}

fn find_camera(path: &Path, name: &str) -> Result<Camera> {
    let cameras = scene::load(path)?.cameras;
    if let Some(camera) = cameras.iter().find(|camera| camera.name == name) {
        return Ok(camera.clone());
    }
    let names = || cameras.iter().map(|camera| camera.name.as_str());
    let hint = match engine::error::nearest(name, names()) {
        Some(near) => format!("did you mean `{near}`?"),
        None if cameras.is_empty() => "it has none; use `--eye` and `--target`".into(),
        None => format!("it has {}", names().collect::<Vec<_>>().join(", ")),
    };
    let message = format!("the scene has no camera `{}`", name.escape_debug());
    Err(Error::new(ErrorKind::NotFound, message).at(path).hint(hint))
}

/// World from camera for an eye that looks at a target and keeps upright.
fn look_at(eye: DVec3, target: DVec3, up: UpAxis) -> Result<DMat4> {
    let (vertical, forward) = match up {
        UpAxis::Y => (DVec3::Y, DVec3::NEG_Z),
        UpAxis::Z => (DVec3::Z, DVec3::Y),
    };
    let Some(back) = (eye - target).try_normalize() else {
        return Err(Error::invalid("the eye and what it looks at are the same place"));
    };
    // Straight up or down, the top of the picture is where an upright eye looks
    let right = vertical.cross(back).try_normalize().unwrap_or_else(|| forward.cross(vertical).normalize());
    let columns = [right.extend(0.0), back.cross(right).extend(0.0), back.extend(0.0), eye.extend(1.0)];
    let [x, y, z, w] = columns;
    Ok(DMat4::from_cols(x, y, z, w))
}

impl Relit {
    fn of(picture: &Picture, output: &Path) -> Self {
        let stats = &picture.stats;
        Self {
            output: output.into(),
            width: picture.width,
            height: picture.height,
            attribute: stats.attribute.clone(),
            grids: stats.drawn.grids,
            grids_in_view: stats.drawn.grids_in_view,
            faces: stats.drawn.faces,
            faces_unbaked: stats.drawn.faces_unbaked,
            repaired_pixels: stats.repaired_pixels,
        }
    }

    fn describe(&self) -> String {
        let mut text = format!(
            "{}: {} × {}, {} faces of {} grids in view, lit by `{}`",
            self.output.display(),
            self.width,
            self.height,
            figures::count(self.faces),
            figures::count(self.grids_in_view),
            self.attribute
        );
        if self.faces_unbaked > 0 {
            text.push_str(&format!(
                "\n{} faces were not baked and left out",
                figures::count(self.faces_unbaked)
            ));
        }
        if self.repaired_pixels > 0 {
            text.push_str(&format!(
                "\n{} broken pixels of the environment became black",
                self.repaired_pixels
            ));
        }
        text
    }
}

impl From<Weighting> for Weight {
    fn from(weight: Weighting) -> Self {
        match weight {
            Weighting::Uniform => Self::Uniform,
            Weighting::Cosine => Self::Cosine,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a mirrored or rolled camera and the pole where "upright" means nothing.
    #[test]
    fn an_eye_stays_upright_and_sees_its_target_ahead() {
        for up in [UpAxis::Y, UpAxis::Z] {
            let eye = DVec3::new(1.0, 2.0, 3.0);
            let offsets = [DVec3::new(-3.0, 1.0, 0.5), DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
            for offset in offsets {
                let matrix = look_at(eye, eye + offset, up).unwrap();
                assert!((matrix.determinant() - 1.0).abs() < 1e-12, "{up:?} {offset}");
                let ahead = matrix.inverse().transform_point3(eye + offset);
                assert!(
                    ahead.abs_diff_eq(DVec3::new(0.0, 0.0, -offset.length()), 1e-12),
                    "{up:?} {offset} {ahead}"
                );
                let top = if up == UpAxis::Y { matrix.y_axis.y } else { matrix.y_axis.z };
                assert!(top >= -1e-12, "{up:?} {offset}");
            }
        }
        assert!(look_at(DVec3::ONE, DVec3::ONE, UpAxis::Y).is_err());
    }
}
