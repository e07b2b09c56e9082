//! `pantaray bake`: every bake set of a scene, decorated.

use std::path::{Path, PathBuf};

use clap::Args;
use engine::bake::frames::{Frames, bake_frames};
use engine::bake::{BakeOptions, bake};
use engine::brickmap::FarField;
use engine::cut::Lod;
use engine::stats::{BakeSetReport, Report};
use engine::trace::Device;
use engine::{Error, ErrorKind, Result, scene};

use crate::console::{Answer, Console};
use crate::{figures, values};

/// Bake a scene: `DIR/<bake set>.mgs` for each bake set, and DIR/report.json
///
/// Run again after an interruption, the same command continues where it was, and the result is the same bytes.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The scene file, .xml
    scene: PathBuf,
    /// The folder of the results; made if it is not there
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// What traces: cpu, gpu or gpu:N (see `pantaray devices`), all (every GPU shares each batch), software (a slow adapter
    /// for tests), or auto, which is the best GPU and the CPU where there is none
    #[arg(long, default_value = "auto", value_parser = str::parse::<Device>)]
    device: Device,
    #[command(flatten)]
    resources: Resources,
    /// Rays per point, instead of the shaders' own numbers
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(16..=65_536))]
    samples: Option<u32>,
    /// How far bricks are opened: `off` (all the way), `paper`, or `footprint[:Q]`, down to Q footprints of a ray
    #[arg(long, value_name = "LOD", default_value = "off", value_parser = parse_lod)]
    lod: Lod,
    /// What stands in for what is not opened: `paper` (the paper's sums of areas, fast to build) or `directional` (from lines
    /// through the geometry; does not leak)
    #[arg(long, value_name = "KIND", default_value = "directional", value_parser = str::parse::<FarField>)]
    farfield: FarField,
    /// Turns every point's rays differently; the same seed gives the same bytes
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// The frame that patterns such as `####` in the scene's paths stand for
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    frame: Option<i64>,
    /// Bake frames FIRST to LAST, every STEP, each into DIR/FRAME; what does not change is built once
    #[arg(long, value_name = "FIRST-LAST[xSTEP]", allow_hyphen_values = true, conflicts_with = "frame")]
    frames: Option<Frames>,
    /// Bake whole batches only, evenly spaced, up to about N points of each bake set; `baked` marks them
    #[arg(long, value_name = "N", value_parser = values::count)]
    max_points: Option<u64>,
    /// Begin anew where the folder holds an unfinished bake
    #[arg(long)]
    restart: bool,
}

/// What work may use of the machine.
#[derive(Clone, Debug, Args)]
pub struct Resources {
    /// Anonymous memory that the process may take, from 256MiB up
    #[arg(long, value_name = "SIZE", default_value = "1GiB", value_parser = values::size)]
    pub memory: u64,
    /// Worker threads [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
}

impl Resources {
    /// The options of a bake that may use this much.
    pub fn options(&self) -> BakeOptions {
        let options = BakeOptions::default();
        let threads = self.threads.map_or(options.threads, usize::from);
        BakeOptions { memory_bytes: self.memory, threads, ..options }
    }
}

/// Bakes and says how it went.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let options = BakeOptions {
        device: arguments.device,
        lod: arguments.lod,
        far_field: arguments.farfield,
        seed: arguments.seed,
        samples: arguments.samples,
        points_max: arguments.max_points,
        restart: arguments.restart,
        ..arguments.resources.options()
    };
    if let Some(frames) = arguments.frames {
        return run_frames(&arguments.scene, frames, &options, &arguments.output, console);
    }
    let scene = scene::load_frame(&arguments.scene, arguments.frame)?;
    let report = bake(&scene, &options, &arguments.output, console.control()).map_err(continuable)?;
    let mut text = describe(&report);
    for set in &report.bake_sets {
        text.push_str(&format!("\n{}", arguments.output.join(format!("{}.mgs", set.name)).display()));
    }
    Answer::new(&report, text)
}

/// Bakes a range of frames and says how each went.
fn run_frames(
    scene: &Path,
    frames: Frames,
    options: &BakeOptions,
    output: &Path,
    console: &Console,
) -> Result<Answer> {
    let load = |frame| scene::load_frame(scene, Some(frame));
    let report = bake_frames(frames, &load, options, output, console.control()).map_err(continuable)?;
    let mut lines: Vec<String> = Vec::new();
    for frame in &report.frames {
        lines.push(format!("frame {}\n{}", frame.frame, describe(&frame.report)));
    }
    lines.push(format!(
        "{} frames in {}, {} of them with brick maps that were there",
        report.frames.len(),
        figures::seconds(report.seconds),
        report.maps_reused
    ));
    Answer::new(&report, lines.join("\n"))
}

/// Says how to go on after a cancellation.
pub fn continuable(error: Error) -> Error {
    match error.kind() {
        ErrorKind::Cancelled => error.hint("run the same command again to continue"),
        _ => error,
    }
}

/// A report as a few lines for people.
pub fn describe(report: &Report) -> String {
    let mut lines = vec![describe_map(report)];
    let bake = &report.bake;
    if !report.bake_sets.is_empty() {
        lines.push(format!(
            "traced     {} rays for {} points in {}: {} rays/s on {} threads ({}, {})",
            figures::short(bake.rays as f64),
            figures::count(bake.points),
            figures::seconds(bake.seconds),
            figures::short(bake.rays_per_second),
            bake.threads,
            bake.device,
            bake.instructions,
        ));
        lines.push(format!(
            "loaded     {:.2} bytes per ray, {:.2} % of brick requests answered from memory",
            bake.io_bytes_per_ray,
            100.0 * bake.cache_hit_ratio,
        ));
    }
    lines.extend(report.bake_sets.iter().map(describe_set));
    lines.push(format!(
        "altogether {}, peak resident memory {}",
        figures::seconds(report.seconds),
        figures::bytes(report.peak_rss_bytes)
    ));
    lines.extend(
        report
            .skipped
            .iter()
            .map(|(reason, times)| format!("left out   {}: {reason}", figures::count(*times))),
    );
    lines.extend(report.warnings.iter().map(|warning| format!("warning    {warning}")));
    lines.join("\n")
}

fn describe_map(report: &Report) -> String {
    let map = &report.brickmap;
    let how = match map.reused {
        true => "reused".into(),
        false => format!(
            "built in {}, {} micropolygons/s",
            figures::seconds(map.seconds),
            figures::short(map.micropolygons_per_second)
        ),
    };
    format!(
        "brick map  {} micropolygons in {} bricks, {} ({:.1} bytes each), {how}",
        figures::count(report.micropolygons),
        figures::count(map.bricks),
        figures::bytes(map.bytes),
        map.bytes_per_micropolygon,
    )
}

fn describe_set(set: &BakeSetReport) -> String {
    let continued = match set.batches_continued {
        0 => String::new(),
        batches => format!(", {} of its batches from before", figures::count(batches)),
    };
    format!(
        "bake set   {}: {} of {} points{continued}; split in {}, merged in {}",
        set.name,
        figures::count(set.points),
        figures::count(set.stream_points),
        figures::seconds(set.split_seconds),
        figures::seconds(set.merge_seconds),
    )
}

/// Reads a level of detail; a wrong one is wrong usage.
fn parse_lod(text: &str) -> Result<Lod, String> {
    Lod::parse(text).map_err(|error| match error.hint_text() {
        Some(hint) => format!("{error}, {hint}"),
        None => error.to_string(),
    })
}
