//! The bake, from a scene to decorated streams: the only place that names every stage.
//!
//! Import → brick map → batches → cut, trace, shade → merge. Each step leaves its result in the bake's folder, so an
//! interrupted bake continues where it was, and the result is the same bytes. A farm orders the same steps as tasks.

mod copies;
pub mod folder;
pub mod frames;
pub mod inputs;
pub mod map;
mod run;
pub mod set;
#[cfg(test)]
mod tests;
pub mod tracer;
pub mod work;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use folder::{Folder, write_atomically};
use inputs::Inputs;
use map::{all_occluders, open_map};
use set::{SetBake, identity, require_sets};
use work::BakeWork;

use crate::batch::BatchPlan;
use crate::brick::lanes::InstructionSet;
use crate::brickmap::{BrickMap, FarField};
use crate::cut::Lod;
use crate::output::{Part, PartLog};
use crate::scene::Scene;
use crate::stats::{BakeSetReport, Report, peak_rss_bytes};
use crate::trace::Device;
use crate::{Error, ErrorKind, Result};

/// Memory that is the least a bake can do with.
pub const MEMORY_BYTES_MIN: u64 = 256 << 20;

/// How to bake. [`Default`] is the command line's default.
#[derive(Clone, Debug)]
pub struct BakeOptions {
    /// Bound on the process's anonymous memory.
    pub memory_bytes: u64,
    /// Worker threads.
    pub threads: usize,
    /// What traces.
    pub device: Device,
    /// How far to open the brick map.
    pub lod: Lod,
    /// What stands in for what is not opened.
    pub far_field: FarField,
    /// Same seed, same bytes.
    pub seed: u64,
    /// Rays per point, instead of the shaders' own numbers.
    pub samples: Option<u32>,
    /// Bake whole batches, evenly spaced, up to about this many points of each bake set.
    pub points_max: Option<u64>,
    /// Begin anew where the folder holds an unfinished bake.
    pub restart: bool,
    /// The inner loops to use.
    pub instructions: InstructionSet,
}

impl Default for BakeOptions {
    fn default() -> Self {
        Self {
            memory_bytes: 1 << 30,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            device: Device::default(),
            lod: Lod::Off,
            far_field: FarField::Directional,
            seed: 0,
            samples: None,
            points_max: None,
            restart: false,
            instructions: InstructionSet::detect(),
        }
    }
}

/// What long work tells about itself.
pub trait Progress: Sync {
    /// A share of `stage`, from 0 to 1, is done. `detail` is a rate or a count for people.
    fn update(&self, stage: &str, done: f64, detail: &str);
}

/// Tells nobody.
#[derive(Clone, Copy, Debug)]
pub struct Quiet;

impl Progress for Quiet {
    fn update(&self, _stage: &str, _done: f64, _detail: &str) {}
}

/// What drives a bake: where progress goes, and a flag that ends it.
#[derive(Clone, Copy)]
pub struct Control<'a> {
    /// Told now and then.
    pub progress: &'a dyn Progress,
    /// Set it, and the work ends with [`ErrorKind::Cancelled`] within about a second.
    pub cancel: &'a AtomicBool,
}

impl Control<'_> {
    fn check(&self) -> Result<()> {
        if self.cancel.load(Ordering::Relaxed) {
            return Err(Error::new(ErrorKind::Cancelled, "the bake was cancelled"));
        }
        Ok(())
    }

    fn stage<'b>(&'b self, stage: &'b str) -> impl FnMut(f64) -> Result<()> + 'b {
        move |done| {
            self.progress.update(stage, done, "");
            self.check()
        }
    }
}

/// Bakes every bake set of `scene` into the folder `target`: `<bake set>.mgs` each, and `report.json`.
///
/// An interrupted bake in the same folder is continued if scene, inputs and options are the same.
///
/// # Errors
/// Anything wrong with the inputs, the disk or the memory; nothing half-written is left where a result belongs.
pub fn bake(scene: &Scene, options: &BakeOptions, target: &Path, control: Control<'_>) -> Result<Report> {
    bake_with_maps(scene, options, target, &target.join("brickmap"), control)
}

/// [`bake`] with the brick maps in the folder `maps`, which other bakes may use before and after, not meanwhile.
fn bake_with_maps(
    scene: &Scene,
    options: &BakeOptions,
    target: &Path,
    maps_folder: &Path,
    control: Control<'_>,
) -> Result<Report> {
    let start = Instant::now();
    if options.memory_bytes < MEMORY_BYTES_MIN {
        return Err(Error::new(
            ErrorKind::Limit,
            format!("{} bytes of memory are too few", options.memory_bytes),
        )
        .hint("at least 256MiB are needed"));
    }
    require_sets(scene)?;
    let folder = Folder::open(target)?;
    let mut report = Report::default();

    // Import, and see whether this is the bake that the folder knows
    let inputs = import(scene, options, &folder, control)?;
    report_imports(&inputs, &mut report);
    let sets = SetBake::all(scene, &inputs, options)?;
    folder.claim(identity(scene, &inputs, options), options.restart)?;

    // Bake the sets, one brick map for all that see the same occluders
    let mut maps: Vec<(Vec<usize>, Arc<BrickMap>)> = Vec::new();
    let mut work = BakeWork::default();
    for set in &sets {
        let map = match maps.iter().find(|(occluders, _)| *occluders == set.occluders) {
            Some((_, map)) => map.clone(),
            None => {
                let places = (maps_folder, &*folder.work("build")?);
                let map = open_map(scene, &inputs, &set.occluders, options, places, &mut report, control)?;
                maps.push((set.occluders.clone(), Arc::new(map)));
                maps[maps.len() - 1].1.clone()
            }
        };
        report.bake_sets.push(run(set, map, &folder, &mut work, control)?);
    }
    folder.finish(maps_folder)?;

    // Report
    report.bake = work.report(options);
    report.warnings.extend_from_slice(work.troubles());
    report.bake.points = report.bake_sets.iter().map(|set| set.points).sum();
    write_report(&mut report, start, target)?;
    Ok(report)
}

/// Builds the brick map of all occluders of `scene` into the folder `target`, as `pantaray build` does.
///
/// # Errors
/// As [`bake`].
pub fn build_map(
    scene: &Scene,
    options: &BakeOptions,
    target: &Path,
    control: Control<'_>,
) -> Result<Report> {
    let start = Instant::now();
    let folder = Folder::open(target)?;
    let mut report = Report::default();
    let inputs = import(scene, options, &folder, control)?;
    let places = (&*folder.path().join("brickmap"), &*folder.work("build")?);
    open_map(scene, &inputs, &all_occluders(scene)?, options, places, &mut report, control)?;
    folder.finish(places.0)?;
    write_report(&mut report, start, target)?;
    Ok(report)
}

fn import(scene: &Scene, options: &BakeOptions, folder: &Folder, control: Control<'_>) -> Result<Inputs> {
    let memory_bytes = options.memory_bytes / 2;
    Inputs::prepare(scene, &folder.work("import")?, memory_bytes, &mut control.stage("import"))
}

fn report_imports(inputs: &Inputs, report: &mut Report) {
    for (path, import) in &inputs.reports {
        report.skipped.extend(import.skipped.iter().cloned());
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        report.warnings.extend(import.warnings.iter().map(|warning| format!("{name}: {warning}")));
    }
}

fn write_report(report: &mut Report, start: Instant, target: &Path) -> Result<()> {
    report.peak_rss_bytes = peak_rss_bytes();
    report.seconds = start.elapsed().as_secs_f64();
    let json = serde_json::to_vec_pretty(&report).map_err(|e| Error::invalid(e.to_string()))?;
    write_atomically(&target.join("report.json"), &json)
}

/// Bakes one set into the folder, continuing what an earlier bake left there.
fn run(
    set: &SetBake<'_>,
    map: Arc<BrickMap>,
    folder: &Folder,
    work: &mut BakeWork,
    control: Control<'_>,
) -> Result<BakeSetReport> {
    let name = &set.bake_set.name;
    let mut report = BakeSetReport { name: name.clone(), ..Default::default() };
    let scratch = folder.work("sets")?.join(name);
    std::fs::create_dir_all(&scratch).map_err(|e| Error::io("create the folder", &scratch, e))?;

    // Split the points into batches
    let start = Instant::now();
    let plan = Arc::new(set.plan(&scratch, control)?);
    (report.stream_points, report.split_seconds) = (plan.stream_points(), start.elapsed().as_secs_f64());
    let batches = set.batches(&plan);
    report.points = batches.iter().map(|&batch| u64::from(plan.batch(batch as usize).count)).sum();

    // Trace those that are not done
    let mut log = PartLog::open(scratch.join("parts"), &set.format(&plan)?, plan.len() as u32)?;
    let todo: Vec<u32> =
        batches.iter().copied().filter(|&b| !log.completed().contains(u64::from(b))).collect();
    report.batches_continued = (batches.len() - todo.len()) as u64;
    report.batches = todo.len() as u64;
    trace(set, &plan, map, &todo, &mut log, work, control)?;
    log.sync()?;

    // Merge
    let start = Instant::now();
    set.merge(&plan, &mut log, false, &scratch, &folder.path().join(format!("{name}.mgs")), control)?;
    report.merge_seconds = start.elapsed().as_secs_f64();
    Ok(report)
}

/// Traces the batches `todo` and appends their parts to the log.
fn trace(
    set: &SetBake<'_>,
    plan: &Arc<BatchPlan>,
    map: Arc<BrickMap>,
    todo: &[u32],
    log: &mut PartLog,
    work: &mut BakeWork,
    control: Control<'_>,
) -> Result<()> {
    let mut tracer = set.tracer(plan.clone(), map)?;
    let mut part = Part::default();
    for (done, &batch) in todo.iter().enumerate() {
        tracer.expect(todo.get(done + 1).copied())?;
        tracer.trace(batch, &mut part, work, control.cancel)?;
        log.append(&part)?;
        let rate = work.rays as f64 / work.seconds.max(1e-9) / 1e6;
        let share = (done + 1) as f64 / todo.len() as f64;
        control.progress.update("trace", share, &format!("{rate:.1} M rays/s"));
        control.check()?;
    }
    tracer.finish(work);
    Ok(())
}
