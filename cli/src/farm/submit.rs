//! `pantaray submit`: a scene becomes a job of the farm.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::Args;
use engine::scene::{Roots, Scene, load_confined, load_frame};
use engine::{Error, Result};
use protocol::admin::MissingRequest;
use protocol::job::{BakeSettings, Estimate, JobRequest};
use worker::client::Client;
use worker::digest;

use super::files::{Files, collect};
use super::jobs::table;
use super::{Connection, left, pair, random_key, watch};
use crate::console::{Answer, Console};
use crate::{figures, signals, values};

/// Submit a scene to the farm; files that the farm does not have are uploaded
#[derive(Debug, Args)]
pub struct Arguments {
    /// The scene file, .xml
    scene: PathBuf,
    #[command(flatten)]
    connection: Connection,
    /// What to call the job [default: the scene's name]
    #[arg(long)]
    name: Option<String>,
    /// The project that it is counted to
    #[arg(long, default_value = "default")]
    project: String,
    /// From 0 to 100: twice the priority, twice the chance
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(i64).range(0..=100))]
    priority: i64,
    /// Begin paused
    #[arg(long)]
    paused: bool,
    /// A job that must have succeeded before
    #[arg(long, value_name = "JOB")]
    after: Vec<String>,
    /// A label that workers must have
    #[arg(long, value_name = "LABEL")]
    requires: Vec<String>,
    /// Publish what there is when batches fail, marked as incomplete
    #[arg(long)]
    partial: bool,
    /// Batches to run at once at most
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    running_max: Option<i64>,
    /// Batches that may fail before the job is given up
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(i64).range(0..))]
    failed_max: i64,
    /// Show, sequence and shot, with slashes
    #[arg(long, value_name = "SHOW/SEQ/SHOT", default_value = "")]
    shot: String,
    /// For people
    #[arg(long, default_value = "")]
    comment: String,
    /// Rays per point, instead of the shaders' own numbers
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(16..=65_536))]
    samples: Option<u32>,
    /// How far bricks are opened, as for `bake`
    #[arg(long, value_name = "LOD")]
    lod: Option<String>,
    /// What stands in for what is not opened, as for `bake`
    #[arg(long, value_name = "KIND")]
    farfield: Option<String>,
    /// Turns every point's rays differently; the same seed gives the same bytes
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Bake whole batches only, evenly spaced, up to about N points of each bake set
    #[arg(long, value_name = "N", value_parser = values::count)]
    max_points: Option<u64>,
    /// The frame that patterns in the scene's paths stand for
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    frame: Option<i64>,
    /// First and last frame: a job for each
    #[arg(long, value_name = "A:B", value_parser = frames, conflicts_with = "frame", allow_hyphen_values = true)]
    frames: Option<(i64, i64)>,
    /// An asset root of the farm: the scene's `root:NAME/path` is looked for below DIR here and not uploaded
    #[arg(long, value_name = "NAME=DIR", value_parser = pair)]
    root: Vec<(String, PathBuf)>,
    /// A key by which the coordinator knows a repeated submission [default: a random one]
    #[arg(long)]
    key: Option<String>,
    /// Wait until it is done; exit code 1 if it fails
    #[arg(long, conflicts_with = "dry_run")]
    wait: bool,
    /// Upload and check the scene, say what it would ask of the farm, and submit nothing
    #[arg(long)]
    dry_run: bool,
}

/// Uploads, submits, and waits if asked to.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    let (text, files) = gather(&arguments)?;
    let control = console.control();
    let hashes = upload(&client, &arguments.project, &files, &mut |done| {
        control.progress.update("upload", done, "");
        match control.cancel.load(std::sync::atomic::Ordering::Relaxed) {
            true => Err(Error::new(engine::ErrorKind::Cancelled, "nothing was submitted")),
            false => Ok(()),
        }
    })?;
    if arguments.dry_run {
        let estimate = client.validate(&request(arguments, text, hashes))?;
        return Answer::new(&estimate, describe(&estimate));
    }
    let key = arguments.key.clone().unwrap_or_else(random_key);
    let wait = arguments.wait;
    let submitted = client.submit(&request(arguments, text, hashes), &key)?;
    if !wait {
        return Answer::new(&submitted, submitted.jobs.join("\n"));
    }
    let mut jobs = Vec::new();
    for job in &submitted.jobs {
        jobs.push(watch::until_done(&client, job, console, signals::cancel_flag(), || left(job))?);
    }
    watch::judge(&jobs)
}

/// What a scene would ask of the farm.
fn describe(estimate: &Estimate) -> String {
    let known = |number: Option<u64>, show: fn(u64) -> String| number.map_or("?".into(), show);
    let mut rows = vec![["BAKE SET", "POINTS", "BATCHES", "RESULT"].map(String::from)];
    let row = |name: &str, points, batches, bytes| {
        [
            name.into(),
            known(points, figures::count),
            known(batches, figures::count),
            known(bytes, figures::bytes),
        ]
    };
    rows.extend(estimate.sets.iter().map(|set| row(&set.name, set.points, set.batches, set.result_bytes)));
    rows.push(row("all", estimate.points, estimate.batches, estimate.result_bytes));
    let inputs = figures::bytes(estimate.input_bytes);
    let seconds = estimate.worker_seconds.map_or("no bake has shown how long that takes".into(), |seconds| {
        format!("about {} of one worker", figures::seconds(seconds))
    });
    format!("{}\nit reads {inputs}; {seconds}", table(&rows))
}

/// The scene's text and the files that it needs, over all frames.
fn gather(arguments: &Arguments) -> Result<(String, Files)> {
    let roots: Roots = arguments.root.iter().cloned().collect();
    let folders: Vec<PathBuf> = roots.values().cloned().collect();
    let (first, last) = arguments.frames.unwrap_or((0, 0));
    let mut files = Files::new();
    for frame in first..=last {
        let frame = arguments.frames.map(|_| frame).or(arguments.frame);
        collect(&load(&arguments.scene, frame, &roots)?, &folders, &mut files)?;
    }
    let text = std::fs::read_to_string(&arguments.scene);
    Ok((text.map_err(|error| Error::io("read scene", &arguments.scene, error))?, files))
}

fn load(path: &Path, frame: Option<i64>, roots: &Roots) -> Result<Scene> {
    if roots.is_empty() { load_frame(path, frame) } else { load_confined(path, frame, roots) }
}

/// Uploads the files that the farm does not have; their hashes.
fn upload(
    client: &Client,
    project: &str,
    files: &Files,
    progress: &mut dyn FnMut(f64) -> Result<()>,
) -> Result<BTreeMap<String, String>> {
    let mut hashes = BTreeMap::new();
    let mut paths: BTreeMap<String, (&Path, u64)> = BTreeMap::new();
    for (name, path) in files {
        progress(0.0)?;
        let content = digest::of_file(path)?;
        paths.insert(content.sha256.clone(), (path, content.bytes));
        hashes.insert(name.clone(), content.sha256);
    }
    if paths.is_empty() {
        return Ok(hashes);
    }
    let request = MissingRequest { project: project.into(), sha256: paths.keys().cloned().collect() };
    let missing: BTreeSet<String> = client.missing_assets(&request)?.missing.into_iter().collect();
    let total: u64 = missing.iter().filter_map(|sha256| paths.get(sha256)).map(|(_, bytes)| bytes).sum();
    let mut done = 0;
    for sha256 in &missing {
        let Some((path, bytes)) = paths.get(sha256) else { continue };
        client.upload(&client.own(&format!("/v1/assets/{sha256}?project={project}")), path)?;
        done += bytes;
        progress(done as f64 / total.max(1) as f64)?;
    }
    Ok(hashes)
}

fn request(arguments: Arguments, scene: String, files: BTreeMap<String, String>) -> JobRequest {
    let stem = arguments.scene.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut shot = arguments.shot.splitn(3, '/').map(str::to_owned);
    let mut part = || shot.next().unwrap_or_default();
    JobRequest {
        name: arguments.name.unwrap_or(stem),
        project: arguments.project,
        scene,
        files,
        settings: BakeSettings {
            lod: arguments.lod,
            far_field: arguments.farfield,
            seed: arguments.seed,
            samples: arguments.samples,
            max_points: arguments.max_points,
            frame: arguments.frame,
        },
        priority: arguments.priority,
        paused: arguments.paused,
        depends_on: arguments.after,
        requires: arguments.requires,
        running_max: arguments.running_max,
        failed_max: arguments.failed_max,
        partial: arguments.partial,
        show: part(),
        sequence: part(),
        shot: part(),
        comment: arguments.comment,
        frames: arguments.frames,
    }
}

/// `A:B`.
fn frames(text: &str) -> Result<(i64, i64), String> {
    let (first, last) = text.split_once(':').ok_or("expected A:B")?;
    let number = |text: &str| text.parse::<i64>().map_err(|_| format!("`{text}` is not a frame"));
    match (number(first)?, number(last)?) {
        (first, last) if first <= last && last - first < 100_000 => Ok((first, last)),
        _ => Err("the first frame must not come after the last, 100,000 at most".into()),
    }
}
