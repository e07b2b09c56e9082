//! `pantaray build`: the brick map alone.

use std::path::PathBuf;

use clap::Args;
use engine::Result;
use engine::bake::{BakeOptions, build_map};
use engine::brickmap::FarField;
use engine::scene;

use crate::bake::{Resources, continuable, describe};
use crate::console::{Answer, Console};

/// Build the brick map of a scene's occluders, which `bake` into the same folder then reuses
#[derive(Debug, Args)]
pub struct Arguments {
    /// The scene file, .xml
    scene: PathBuf,
    /// The folder of the results; made if it is not there
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    resources: Resources,
    /// What stands in for what is not opened: `paper` (the paper's sums of areas, fast to build) or `directional` (from lines
    /// through the geometry; does not leak)
    #[arg(long, value_name = "KIND", default_value = "directional", value_parser = str::parse::<FarField>)]
    farfield: FarField,
    /// The frame that patterns such as `####` in the scene's paths stand for
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    frame: Option<i64>,
}

/// Builds and says how it went.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let options = BakeOptions { far_field: arguments.farfield, ..arguments.resources.options() };
    let scene = scene::load_frame(&arguments.scene, arguments.frame)?;
    let report = build_map(&scene, &options, &arguments.output, console.control()).map_err(continuable)?;
    Answer::new(&report, describe(&report))
}
