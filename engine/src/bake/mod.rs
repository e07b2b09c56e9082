//! The bake, from a scene to decorated streams: the only place that names every stage.
//!
//! Import → brick map → batches → cut, trace, shade → merge. Each step leaves its result in the bake's folder, so an
//! interrupted bake continues where it was, and the result is the same bytes. A farm orders the same steps as tasks.

pub mod folder;
pub mod inputs;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use folder::{Folder, write_atomically};
use inputs::Inputs;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use crate::batch::{BatchPlan, KeepAll, Point, RAYS_PER_BATCH_MAX, SplitOptions, evenly_spaced, split};
use crate::brick::lanes::InstructionSet;
use crate::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
use crate::cut::{Arena, Lod};
use crate::output::{MergeOptions, Part, PartFormat, PartLog, merge};
use crate::scene::{BakeSet, Scene, Shader, ShaderKind};
use crate::stats::{BakeReport, BakeSetReport, Report, peak_rss_bytes};
use crate::stream::{Attribute, MicrogridStream};
use crate::trace::{BatchCounts, Shading, SphericalTracer, TraceOptions};
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
            lod: Lod::Off,
            far_field: FarField::Paper,
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

/// A brick map and what its streams are called in the scene.
struct Occluders {
    /// Geometry numbers, in the order of the map's streams.
    geometries: Vec<usize>,
    map: Arc<BrickMap>,
}

/// Bakes every bake set of `scene` into the folder `target`: `<bake set>.mgs` each, and `report.json`.
///
/// An interrupted bake in the same folder is continued if scene, inputs and options are the same.
///
/// # Errors
/// Anything wrong with the inputs, the disk or the memory; nothing half-written is left where a result belongs.
pub fn bake(scene: &Scene, options: &BakeOptions, target: &Path, control: Control<'_>) -> Result<Report> {
    let start = Instant::now();
    if options.memory_bytes < MEMORY_BYTES_MIN {
        return Err(Error::new(
            ErrorKind::Limit,
            format!("{} bytes of memory are too few", options.memory_bytes),
        )
        .hint("at least 256MiB are needed"));
    }
    if scene.geometries.iter().all(|geometry| geometry.bake_sets.is_empty()) {
        return Err(Error::invalid("the scene has no bake set")
            .at(&scene.path)
            .hint("add a <bakeset> to a <geometry>, or use `pantaray build` for the brick map alone"));
    }
    let folder = Folder::open(target)?;
    let mut report = Report::default();

    // Import, and see whether this is the bake that the folder knows
    let inputs = Inputs::prepare(
        scene,
        &folder.work("import")?,
        options.memory_bytes / 2,
        &mut control.stage("import"),
    )?;
    for (path, import) in &inputs.reports {
        report.skipped.extend(import.skipped.iter().cloned());
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        report.warnings.extend(import.warnings.iter().map(|warning| format!("{name}: {warning}")));
    }
    let identity = identity(scene, &inputs, options);
    folder.claim(identity, options.restart)?;

    // Bake the sets, one brick map for all that see the same occluders
    let mut maps: Vec<Occluders> = Vec::new();
    let mut work = BakeWork::default();
    for (number, geometry) in scene.geometries.iter().enumerate() {
        for bake_set in &geometry.bake_sets {
            let seen = occluders_of(scene, bake_set);
            if !maps.iter().any(|map| map.geometries == seen) {
                maps.push(open_map(scene, &inputs, seen.clone(), options, &folder, &mut report, control)?);
            }
            let occluders = maps.iter().find(|map| map.geometries == seen).expect("just made");
            let set = BakeSetJob {
                scene,
                inputs: &inputs,
                geometry: number,
                bake_set,
                occluders,
                options,
                identity,
            };
            report.bake_sets.push(set.run(&folder, &mut work, control)?);
        }
    }
    folder.finish()?;

    // Report
    report.bake = work.report(options);
    report.bake.points = report.bake_sets.iter().map(|set| set.points).sum();
    report.peak_rss_bytes = peak_rss_bytes();
    report.seconds = start.elapsed().as_secs_f64();
    let json = serde_json::to_vec_pretty(&report).map_err(|e| Error::invalid(e.to_string()))?;
    write_atomically(&target.join("report.json"), &json)?;
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
    let inputs = Inputs::prepare(
        scene,
        &folder.work("import")?,
        options.memory_bytes / 2,
        &mut control.stage("import"),
    )?;
    let all = (0..scene.geometries.len()).filter(|&g| scene.geometries[g].occluder).collect();
    open_map(scene, &inputs, all, options, &folder, &mut report, control)?;
    folder.finish()?;
    report.peak_rss_bytes = peak_rss_bytes();
    report.seconds = start.elapsed().as_secs_f64();
    let json = serde_json::to_vec_pretty(&report).map_err(|e| Error::invalid(e.to_string()))?;
    write_atomically(&target.join("report.json"), &json)?;
    Ok(report)
}

/// The geometries that a bake set sees.
fn occluders_of(scene: &Scene, bake_set: &BakeSet) -> Vec<usize> {
    let sees = |name: &String| bake_set.occluders.is_empty() || bake_set.occluders.contains(name);
    let geometries = scene.geometries.iter().enumerate();
    geometries.filter(|(_, g)| g.occluder && sees(&g.name)).map(|(number, _)| number).collect()
}

/// A hash of everything that the baked bytes depend on.
fn identity(scene: &Scene, inputs: &Inputs, options: &BakeOptions) -> u64 {
    let mut hash = Xxh3::new();
    inputs.identities.iter().for_each(|identity| hash.update(&identity.to_le_bytes()));
    for geometry in &scene.geometries {
        hash.update(format!("{} {} {:?}\n", geometry.name, geometry.occluder, geometry.bake_sets).as_bytes());
    }
    let BakeOptions { lod, far_field, seed, samples, points_max, .. } = options;
    hash.update(
        format!("{:?}\n{lod:?} {far_field:?} {seed} {samples:?} {points_max:?}", scene.shaders).as_bytes(),
    );
    hash.digest()
}

/// Opens the brick map of the given geometries, building it if it is not there.
fn open_map(
    scene: &Scene,
    inputs: &Inputs,
    geometries: Vec<usize>,
    options: &BakeOptions,
    folder: &Folder,
    report: &mut Report,
    control: Control<'_>,
) -> Result<Occluders> {
    if geometries.is_empty() {
        return Err(Error::invalid("the scene has no occluder")
            .at(&scene.path)
            .hint("give at least one <geometry> occluder=\"true\""));
    }
    let build_options = BuildOptions {
        memory_bytes: options.memory_bytes,
        threads: options.threads,
        scratch: folder.work("build")?,
        far_field: options.far_field,
    };
    let mut hash = Xxh3::new();
    geometries.iter().for_each(|&geometry| hash.update(&inputs.identities[geometry].to_le_bytes()));
    let key = crate::brickmap::content_key(hash.digest128(), &build_options);
    let path = folder.path().join("brickmap").join(key);
    let map_report = &mut report.brickmap;
    map_report.reused = path.join("manifest.json").exists();
    if !map_report.reused {
        let start = Instant::now();
        let mut streams =
            geometries.iter().map(|&geometry| inputs.open(scene, geometry)).collect::<Result<Vec<_>>>()?;
        let mut occluders: Vec<OccluderStream<'_>> =
            streams.iter_mut().map(|stream| OccluderStream { stream: stream.as_mut() }).collect();
        let progress = |stage: &str, done: f64| control.progress.update(stage, done, "");
        let built = build(&mut occluders, &build_options, &path, &progress, control.cancel)?;
        map_report.seconds += start.elapsed().as_secs_f64();
        report.skipped.extend(built.skipped());
    }
    let map = BrickMap::open(&path)?;
    let manifest = map.manifest();
    report.micropolygons += manifest.micropolygons;
    report.grids += manifest.grids;
    map_report.bricks += u64::from(map.brick_count());
    map_report.bytes += manifest.bytes;
    map_report.bytes_per_micropolygon = map_report.bytes as f64 / report.micropolygons.max(1) as f64;
    if map_report.seconds > 0.0 {
        map_report.micropolygons_per_second = report.micropolygons as f64 / map_report.seconds;
    }
    Ok(Occluders { geometries, map: Arc::new(map) })
}

/// One bake set on its way.
struct BakeSetJob<'a> {
    scene: &'a Scene,
    inputs: &'a Inputs,
    geometry: usize,
    bake_set: &'a BakeSet,
    occluders: &'a Occluders,
    options: &'a BakeOptions,
    identity: u64,
}

impl BakeSetJob<'_> {
    fn run(&self, folder: &Folder, work: &mut BakeWork, control: Control<'_>) -> Result<BakeSetReport> {
        let mut report = BakeSetReport { name: self.bake_set.name.clone(), ..Default::default() };
        let target = folder.path().join(format!("{}.mgs", self.bake_set.name));
        let scratch = folder.work("sets")?.join(&self.bake_set.name);
        std::fs::create_dir_all(&scratch).map_err(|e| Error::io("create the folder", &scratch, e))?;
        let shaders = self.shaders()?;
        let mut stream = self.inputs.open(self.scene, self.geometry)?;

        // Split the points into batches
        let start = Instant::now();
        let plan = self.plan(stream.as_mut(), &shaders, &scratch, control)?;
        (report.stream_points, report.split_seconds) = (plan.stream_points(), start.elapsed().as_secs_f64());
        let all: Vec<u32> = (0..plan.len() as u32).collect();
        let batches = self.options.points_max.map_or(all, |points| evenly_spaced(&plan, points));
        report.points = batches.iter().map(|&batch| u64::from(plan.batch(batch as usize).count)).sum();

        // Trace those that are not done
        let attributes = self.attributes(&shaders);
        let bake =
            xxh3_64(format!("{:016x} {} {:016x}", self.identity, self.bake_set.name, plan.hash()).as_bytes());
        let format = PartFormat::new(bake, &attributes, plan.points_per_batch_max())?;
        let mut log = PartLog::open(scratch.join("parts"), &format, plan.len() as u32)?;
        let todo: Vec<u32> =
            batches.iter().copied().filter(|&b| !log.completed().contains(u64::from(b))).collect();
        report.batches_continued = (batches.len() - todo.len()) as u64;
        report.batches = todo.len() as u64;
        self.trace(&plan, &shaders, &format, &todo, &mut log, work, control)?;
        log.sync()?;

        // Merge
        let start = Instant::now();
        let partial = self.options.points_max.is_some();
        stream.rewind()?;
        let options = MergeOptions {
            scratch: &scratch,
            memory_bytes: self.options.memory_bytes / 4,
            partial,
            metadata: &self.metadata(&shaders),
        };
        merge(stream.as_mut(), &plan, &mut log, &options, &target, &mut control.stage("merge"))?;
        report.merge_seconds = start.elapsed().as_secs_f64();
        Ok(report)
    }

    /// The shaders of the set's attributes, with the samples that the options ask for.
    fn shaders(&self) -> Result<Vec<Shading>> {
        let shift = self.occluders.geometries.iter().position(|&g| g == self.geometry);
        let shift = shift.map_or(0, |stream| self.occluders.map.shift(stream));
        let shading = |name: &str| {
            let Shader { kind, .. } = self.scene.shaders.iter().find(|shader| shader.name == name)?;
            match kind {
                ShaderKind::ShOcclusion(shader) => {
                    let mut shader = shader.clone();
                    shader.samples = self.options.samples.unwrap_or(shader.samples);
                    Some(Shading::new(&shader, self.options.seed, &self.bake_set.name, shift))
                }
            }
        };
        let unknown =
            |name: &str| Error::invalid(format!("no shader is called `{name}`")).at(&self.scene.path);
        let attributes = self.bake_set.attributes.iter();
        attributes.map(|a| shading(&a.shader).ok_or_else(|| unknown(&a.shader))).collect()
    }

    /// The output's new attributes.
    fn attributes(&self, shaders: &[Shading]) -> Vec<Attribute> {
        let pairs = self.bake_set.attributes.iter().zip(shaders);
        pairs
            .map(|(a, shading)| {
                Attribute::vertex(&a.name, shading.shader.storage, shading.coefficients() as u16)
            })
            .collect()
    }

    /// What the output says about its spherical harmonics.
    fn metadata(&self, shaders: &[Shading]) -> Vec<(String, String)> {
        let mut metadata = vec![(
            "sh.convention".into(),
            "real orthonormal, index l(l+1)+m, no Condon-Shortley phase".into(),
        )];
        for (attribute, Shading { shader, .. }) in self.bake_set.attributes.iter().zip(shaders) {
            let of = |what: &str| format!("{}.{what}", attribute.name);
            metadata.push((of("shader"), "sh_occlusion".into()));
            metadata.push((of("bands"), shader.bands.to_string()));
            metadata.push((of("samples"), shader.samples.to_string()));
            metadata.push((of("domain"), format!("{:?}", shader.domain).to_lowercase()));
            metadata.push((of("weight"), format!("{:?}", shader.weight).to_lowercase()));
        }
        metadata
    }

    /// The set's batches: those of an interrupted bake if they are there.
    fn plan(
        &self,
        stream: &mut dyn MicrogridStream,
        shaders: &[Shading],
        scratch: &Path,
        control: Control<'_>,
    ) -> Result<BatchPlan> {
        if let Ok(plan) = BatchPlan::open(scratch) {
            return Ok(plan);
        }
        let samples = shaders.iter().map(|shading| shading.shader.samples).max().unwrap_or(1);
        let options = SplitOptions {
            bake_set: self.bake_set.name.clone(),
            points_per_batch_max: (RAYS_PER_BATCH_MAX / samples).max(1),
            scratch: PathBuf::from(scratch),
            memory_bytes: self.options.memory_bytes / 2,
        };
        split(stream, &mut KeepAll, &options, &mut control.stage("batches"))
    }

    /// Traces the batches `todo` and appends their parts to the log.
    #[expect(
        clippy::too_many_arguments,
        reason = "the parts of one loop; a struct for them would have no meaning"
    )]
    fn trace(
        &self,
        plan: &BatchPlan,
        shaders: &[Shading],
        format: &PartFormat,
        todo: &[u32],
        log: &mut PartLog,
        work: &mut BakeWork,
        control: Control<'_>,
    ) -> Result<()> {
        let options = TraceOptions {
            lod: self.options.lod,
            seed: self.options.seed,
            threads: self.options.threads,
            instructions: self.options.instructions,
        };
        let map = &self.occluders.map;
        let arena = Arena::new(map.clone(), arena_bytes(self.options, map), self.options.lod == Lod::Off)?;
        let mut tracer = SphericalTracer::new(arena, options, self.scene.meters_per_unit);
        let (mut points, mut part): (Vec<Point>, Part) = Default::default();
        let (mut values, mut row): (Vec<Vec<f32>>, Vec<f32>) = (vec![Vec::new(); shaders.len()], Vec::new());
        for (done, &batch) in todo.iter().enumerate() {
            let start = Instant::now();
            plan.read(batch as usize, &mut points)?;
            for (shading, values) in shaders.iter().zip(&mut values) {
                values.resize(points.len() * shading.coefficients(), 0.0);
                let counts = tracer.trace(&points, shading, control.cancel, values)?;
                work.add(&counts);
            }
            part.start(batch, points.iter().map(|point| point.index), format);
            for point in 0..points.len() {
                row.clear();
                for (shading, values) in shaders.iter().zip(&values) {
                    let count = shading.coefficients();
                    row.extend_from_slice(&values[point * count..(point + 1) * count]);
                }
                part.set_row(format, point, &row);
            }
            log.append(&part)?;
            work.batches += 1;
            work.seconds += start.elapsed().as_secs_f64();
            let rate = work.rays as f64 / work.seconds.max(1e-9) / 1e6;
            control.progress.update(
                "trace",
                (done + 1) as f64 / todo.len() as f64,
                &format!("{rate:.1} M rays/s"),
            );
            control.check()?;
        }
        work.add_arena(&tracer);
        Ok(())
    }
}

/// The share of the memory that the arena may take: what the rest of the bake does not need.
fn arena_bytes(options: &BakeOptions, map: &BrickMap) -> u64 {
    // Directory and arena tables per brick, a few MiB per thread, points and parts of a batch, waiting rays
    let tables = 24 * u64::from(map.brick_count());
    let fixed = (96 << 20) + (options.threads as u64 * (4 << 20)).min(options.memory_bytes / 4);
    options.memory_bytes.saturating_sub(tables + fixed).max(options.memory_bytes / 4)
}

/// What all bake sets together took.
#[derive(Debug, Default)]
struct BakeWork {
    batches: u64,
    rays: u64,
    seconds: f64,
    counts: BatchCounts,
    requests: u64,
    misses: u64,
    read_bytes: u64,
}

impl BakeWork {
    fn add(&mut self, counts: &BatchCounts) {
        self.rays += counts.rays;
        self.counts.walk += counts.walk;
        self.counts.cut_bytes += counts.cut_bytes;
        self.counts.select_seconds += counts.select_seconds;
    }

    fn add_arena(&mut self, tracer: &SphericalTracer) {
        let counts = tracer.arena_counts();
        self.requests += counts.requests;
        self.misses += counts.misses;
        self.read_bytes += counts.read_bytes;
    }

    fn report(&self, options: &BakeOptions) -> BakeReport {
        let ratio = |a: u64, b: u64| a as f64 / b.max(1) as f64;
        let walk = &self.counts.walk;
        BakeReport {
            rays: self.rays,
            batches: self.batches,
            seconds: self.seconds,
            rays_per_second: self.rays as f64 / self.seconds.max(1e-9),
            device: "cpu".into(),
            instructions: options.instructions.name().into(),
            threads: options.threads as u64,
            lod: options.lod.to_string(),
            io_bytes_per_ray: ratio(self.read_bytes, self.rays),
            io_bytes_per_batch: ratio(self.read_bytes, self.batches),
            cache_hit_ratio: 1.0 - ratio(self.misses, self.requests),
            double_precision_ratio: ratio(walk.retests, walk.hits),
            nodes_per_ray: ratio(walk.nodes, self.rays),
            rays_per_node_visit: ratio(walk.node_rays, walk.nodes),
            leaves_per_ray: ratio(walk.leaves, self.rays),
            cut_bytes_per_batch: ratio(self.counts.cut_bytes, self.batches),
            select_seconds: self.counts.select_seconds,
            ..BakeReport::default()
        }
    }
}
