//! `pantaray demo`: a jungle clearing, baked where a camera sees it and lit by three skies, in one go.
//!
//! Nothing here is special: the scene file it writes and every step from there are what the other subcommands do.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use engine::bake::folder::write_atomically;
use engine::bake::{Control, bake};
use engine::relight::{Environment, RelightOptions, Viewpoint, Visible, visible_faces};
use engine::scene::{self, Camera, Procedural, ProceduralKind, UpAxis};
use engine::stats::Report;
use engine::stream::file::{MgsReader, StreamCounts};
use engine::stream::procedural::{ProceduralStream, demo_camera};
use engine::{Error, Result};
use serde::Serialize;

use crate::bake::{Resources, continuable, describe};
use crate::console::{Answer, Console};
use crate::relight::{draw, learn_how_it_was_baked};
use crate::streams::{self, Watched};
use crate::{figures, values};

/// Bake a jungle clearing of ten million micropolygons and relight it under three skies
///
/// Leaves DIR/scene.xml, which `pantaray bake` takes as well, DIR/baked with the result, and three pictures.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The folder of the results; made if it is not there
    #[arg(long, value_name = "DIR", default_value = "demo")]
    out: PathBuf,
    /// About how many micropolygons the jungle has
    #[arg(long, value_name = "N", default_value = "10M", value_parser = values::count)]
    micropolygons: u64,
    /// Another seed grows another jungle
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Pixels of the pictures; each shows another bit of the jungle that must be baked
    #[arg(long, value_name = "WxH", default_value = "800x450", value_parser = values::resolution)]
    size: [u32; 2],
    /// Bake at least so many points, if the jungle has them: where too few are seen, the camera looks closer
    #[arg(long, value_name = "N", default_value = "300000", value_parser = values::count)]
    points: u64,
    #[command(flatten)]
    resources: Resources,
}

/// The pictures' skies and how many stops each is brightened by: it is dark under trees.
const LIGHTS: [(&str, f32); 3] = [("sky", 2.0), ("overcast", 0.8), ("sunset", 1.2)];

/// The jungle is in metres.
const METERS_PER_UNIT: f64 = 1.0;

/// With +y up.
const UP: UpAxis = UpAxis::Y;

/// The most samples per pixel, along each axis, to look for visible faces with.
const SUPERSAMPLING_MAX: u32 = 4;

/// What the demo made.
#[derive(Debug, Serialize)]
struct Made {
    scene: PathBuf,
    stream: PathBuf,
    pictures: Vec<PathBuf>,
    report: Report,
    seconds: f64,
}

/// Grows, looks, bakes, lights.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let start = Instant::now();
    let control = console.control();
    let out = &arguments.out;
    std::fs::create_dir_all(out).map_err(|error| Error::io("create the folder", out, error))?;
    let jungle = Procedural {
        kind: ProceduralKind::Jungle,
        seed: arguments.seed,
        micropolygons: arguments.micropolygons,
    };
    let (world_from_camera, fov_degrees) = demo_camera(&jungle, METERS_PER_UNIT, UP)?;
    let camera =
        Camera { name: "clearing".into(), fov_degrees, resolution: arguments.size, world_from_camera };

    let (seen, supersampling) =
        write_seen(&jungle, &camera, arguments.points, &out.join("seen.mgs"), control)?;
    let scene_path = out.join("scene.xml");
    write_atomically(&scene_path, scene_xml(&jungle, &camera).as_bytes())?;

    let scene = scene::load(&scene_path)?;
    let baked = out.join("baked");
    let report = bake(&scene, &arguments.resources.options(), &baked, control).map_err(continuable)?;

    let stream = baked.join("seen.mgs");
    let pictures = light(&stream, &camera, supersampling, out, control)?;
    let made = Made { scene: scene_path, stream, pictures, report, seconds: start.elapsed().as_secs_f64() };
    Answer::new(&made, made.describe(&seen, supersampling))
}

/// Writes the faces that the camera sees as a stream of their own. Returns what they count, and how many samples per
/// pixel along each axis show no gap between them.
fn write_seen(
    jungle: &Procedural,
    camera: &Camera,
    points_min: u64,
    path: &Path,
    control: Control<'_>,
) -> Result<(StreamCounts, u32)> {
    let mut supersampling = 1;
    loop {
        let stream = ProceduralStream::new(jungle, METERS_PER_UNIT, UP)?;
        let mut looking = Watched::new(stream, "look", control);
        let faces = visible_faces(&mut looking, camera, supersampling, &mut |_| {})?;
        let stream = ProceduralStream::new(jungle, METERS_PER_UNIT, UP)?;
        let mut seen = Watched::new(Visible::new(stream, faces)?, "write", control);
        let counts = streams::copy(&mut seen, path, &[])?;
        if counts.vertices >= points_min || supersampling == SUPERSAMPLING_MAX {
            return Ok((counts, supersampling));
        }
        supersampling += 1;
    }
}

/// The scene as a file that `pantaray bake` reads.
fn scene_xml(jungle: &Procedural, camera: &Camera) -> String {
    let Camera { name, fov_degrees, resolution: [width, height], world_from_camera } = camera;
    let matrix = world_from_camera.to_cols_array().map(|number| number.to_string()).join(" ");
    let Procedural { seed, micropolygons, .. } = jungle;
    format!(
        r#"<?xml version="1.0" encoding="UTF-8"?>
<!-- A jungle clearing. All of it occludes; what the camera sees is baked. -->
<scene version="1" units="m" up="y">
  <camera name="{name}" fov="{fov_degrees}" resolution="{width} {height}" matrix="{matrix}"/>
  <shaders>
    <shader name="occlusion" type="sh_occlusion">
      <param name="bands" value="3"/>
      <param name="samples" value="512"/>
    </shader>
  </shaders>
  <geometries>
    <geometry name="jungle" occluder="true">
      <stream procedural="jungle" seed="{seed}" micropolygons="{micropolygons}"/>
    </geometry>
    <!-- The faces of the jungle that the camera sees -->
    <geometry name="seen" occluder="false">
      <stream file="seen.mgs"/>
      <bakeset name="seen" occluders="jungle">
        <attribute name="sh_occlusion" shader="occlusion"/>
      </bakeset>
    </geometry>
  </geometries>
</scene>
"#
    )
}

/// Draws the baked stream under every sky.
fn light(
    stream: &Path,
    camera: &Camera,
    supersampling: u32,
    out: &Path,
    control: Control<'_>,
) -> Result<Vec<PathBuf>> {
    let mut pictures = Vec::with_capacity(LIGHTS.len());
    for (sky, stops) in LIGHTS {
        let reader = MgsReader::open(stream)?;
        let mut options = RelightOptions::new(Environment::open(sky)?);
        options.viewpoint = Viewpoint::Camera(camera.clone());
        options.supersampling = supersampling;
        options.exposure_stops = stops;
        learn_how_it_was_baked(&reader, &mut options)?;
        let picture = out.join(format!("{sky}.png"));
        draw(reader, &options, &picture, control)?;
        pictures.push(picture);
    }
    Ok(pictures)
}

impl Made {
    fn describe(&self, seen: &StreamCounts, supersampling: u32) -> String {
        let mut text = format!(
            "The camera sees {} faces of {} micropolygons; their {} vertices were baked.\n\n{}\n\n",
            figures::count(seen.micropolygons),
            figures::count(self.report.micropolygons),
            figures::count(seen.vertices),
            describe(&self.report),
        );
        text.push_str(&format!("The demo took {}. Its pictures:\n", figures::seconds(self.seconds)));
        self.pictures.iter().for_each(|picture| text.push_str(&format!("  {}\n", picture.display())));
        let (scene, stream) = (self.scene.display(), self.stream.display());
        text.push_str(&format!("\nThe scene is {scene}, the baked stream {stream}. Try another light:\n"));
        text.push_str(&format!(
            "  pantaray relight {stream} -o mine.png --env MAP.hdr --camera clearing --scene {scene} --supersampling {supersampling}\n"
        ));
        text
    }
}
