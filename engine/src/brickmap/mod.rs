//! The brick map: all occluders as one tree of bricks, built out of core (paper, section 4.1).
//!
//! Pass 1 ([`census`]) counts micropolygons in a sparse grid of cells ([`bucket`]) and gathers bounds and edge lengths, from
//! which the lattice follows. Pass 2 ([`fill`]) snaps every grid to the lattice and spills it ([`spill`]) to its partition in
//! a log ([`log`]). Then every partition ([`partition`]) on its own, as many at a time as memory allows ([`budget`]): full
//! leaves ([`chunk`]), a tree over them ([`bvh`]), bricks ([`pack`]), written in order ([`output`], [`writer`]) and noted
//! ([`journal`]), so that an interrupted build continues; at last a tree over the partitions. [`mod@file`] is the result on
//! disk, [`farfield`] what stands in for what is not opened.
//!
//! All threads share both passes and the partitions. The bytes depend on the occluders and the build parameters alone, not
//! on threads, memory or interruptions.

mod block;
pub mod bucket;
mod budget;
pub mod bvh;
mod census;
pub mod chunk;
mod cluster;
pub mod farfield;
pub mod file;
mod fill;
mod journal;
pub mod leaves;
mod log;
mod output;
pub mod pack;
mod partition;
mod parts;
mod sah;
mod shared;
pub mod spill;
mod tiling;
mod writer;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use census::Census;
pub use farfield::FarField;
pub use file::{BrickMap, FORMAT_VERSION, Manifest, SegmentSource};
use log::Spill;
use output::Output;
use pack::ByteSplit;
use parts::{geometries_of, unite_shifts};
use shared::Prototype;
pub use writer::{is_unfinished, unfinished_path};

use crate::brick::lattice::{self, Lattice};
use crate::stream::MicrogridStream;
use crate::stream::adapt::{Instance, MatrixSource};
use crate::{Error, ErrorKind, Result};

/// Micropolygons of a partition at most. Larger ones would make a slightly better tree, smaller ones a much worse one; this
/// size leaves two threads room in 256 MiB.
const PARTITION_MICROPOLYGONS: u64 = 1 << 19;

/// A stream of occluding microgrids in the scene's units, or of a prototype and where its copies stand.
pub struct OccluderStream<'a> {
    /// The stream; it is read twice.
    pub stream: &'a mut dyn MicrogridStream,
    /// World from object for every copy; none where the stream stands once, as it is. Whether copies share bricks is decided by
    /// a rule ([`shared`]).
    pub instances: Option<&'a mut dyn MatrixSource>,
    /// Whether it is one more part of the geometry that the stream before it belongs to.
    pub continues: bool,
}

impl<'a> OccluderStream<'a> {
    /// A geometry that stands once, as it is.
    pub fn once(stream: &'a mut dyn MicrogridStream) -> Self {
        Self { stream, instances: None, continues: false }
    }
}

/// How to build.
#[derive(Clone, Debug)]
pub struct BuildOptions {
    /// Memory to use, from 256 MiB up.
    pub memory_bytes: u64,
    /// Threads; all of them read, spill and build.
    pub threads: usize,
    /// A folder on a fast local disk for temporary data: about 20 bytes for every micropolygon.
    pub scratch: PathBuf,
    /// What stands in for what is not opened.
    pub far_field: FarField,
}

/// What a build did.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct BuildReport {
    /// Micropolygons in the map.
    pub micropolygons: u64,
    /// Microgrids read.
    pub grids: u64,
    /// Bricks.
    pub bricks: u32,
    /// Bytes of all bricks.
    pub bytes: u64,
    /// Where the bytes go.
    pub split: ByteSplit,
    /// Leaves.
    pub leaves: u64,
    /// Nodes.
    pub nodes: u64,
    /// Partitions.
    pub partitions: usize,
    /// Copies that share bricks, and what they are copies of.
    pub instances: u64,
    /// Prototypes.
    pub prototypes: u64,
    /// Partitions that an interrupted build had written.
    pub continued_partitions: usize,
    /// Bytes of temporary data.
    pub spilled_bytes: u64,
    /// Seconds of the counting pass.
    pub count_seconds: f64,
    /// Seconds of the filling pass.
    pub fill_seconds: f64,
    /// Seconds of building the partitions.
    pub build_seconds: f64,
    /// Faces without area.
    pub degenerate: u64,
    /// Points and lines without a radius.
    pub no_radius: u64,
    /// Fully transparent faces.
    pub transparent: u64,
}

impl BuildReport {
    /// What was left out, with its count, for people.
    pub fn skipped(&self) -> Vec<(String, u64)> {
        [
            ("occluding faces without area", self.degenerate),
            ("occluding points and lines without a radius", self.no_radius),
            ("fully transparent occluding faces", self.transparent),
        ]
        .into_iter()
        .filter(|&(_, count)| count > 0)
        .map(|(reason, count)| (reason.into(), count))
        .collect()
    }
}

/// The name under which a brick map is kept: a hash of everything that its bytes depend on. `inputs` is a hash of the
/// occluder streams.
pub fn content_key(inputs: u128, options: &BuildOptions) -> String {
    let mut hash = xxhash_rust::xxh3::Xxh3::new();
    hash.update(&inputs.to_le_bytes());
    hash.update(parameters(options).as_bytes());
    format!("{:032x}", hash.digest128())
}

/// Everything that a map's bytes depend on besides its occluders.
fn parameters(options: &BuildOptions) -> String {
    format!("{:?}", (FORMAT_VERSION, PARTITION_MICROPOLYGONS, lattice::EDGE_BITS, options.far_field))
}

/// Builds the brick map of `occluders` at `target`, which appears when it is complete. `progress` is told the stage and
/// the share of it that is done.
///
/// # Errors
/// When there is nothing to build, an input is broken, the disk is full, or `cancel` is set. Nothing is left behind then,
/// except that a build that is cancelled leaves its finished partitions in [`unfinished_path`], and so does one that is
/// killed: the next build of the same content continues there.
pub fn build(
    occluders: &mut [OccluderStream<'_>],
    options: &BuildOptions,
    target: &Path,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<BuildReport> {
    let job = Job { options, progress, cancel };
    let mut report = BuildReport::default();

    // What shares bricks; pass 1: count what is expanded. What does not fit the lattice is expanded too
    let start = Instant::now();
    let occluder_geometries = geometries_of(occluders);
    let mut prototypes = find_prototypes(occluders, &job)?;
    let (mut census, lattice) = loop {
        let census = census::count(&mut Parted::new(occluders, &prototypes)?.flat(), &job)?;
        let lattice = map_lattice(&census, &prototypes)?;
        let before = prototypes.len();
        prototypes.retain(|prototype| prototype.fits(&lattice));
        if prototypes.len() == before {
            break (census, lattice);
        }
    };
    let mut parted = Parted::new(occluders, &prototypes)?;
    report.grids = census.grids + prototypes.iter().map(|prototype| prototype.grids).sum::<u64>();
    let shares: Vec<usize> = prototypes.iter().map(|prototype| prototype.occluder).collect();
    let mut shifts = census.shifts(&lattice);
    let geometry_shifts = unite_shifts(&mut shifts, &parted.numbers, &shares, occluder_geometries);
    let partitions = census.cells.partition(PARTITION_MICROPOLYGONS).len();
    report.count_seconds = start.elapsed().as_secs_f64();

    // What an interrupted build has left
    let mut content = xxhash_rust::xxh3::Xxh3::new();
    content.update(&census.content.to_le_bytes());
    prototypes.iter().for_each(|prototype| content.update(&prototype.content.to_le_bytes()));
    content.update(bytemuck::cast_slice(&shifts));
    content.update(parameters(options).as_bytes());
    let mut output = Output::open(target, content.digest128())?;
    report.continued_partitions = output.partitions;

    // The prototypes, pass 2 and the partitions, the tree over all
    let done = (|| {
        let mut first = 0;
        for (prototype, stream) in prototypes.iter_mut().zip(std::mem::take(&mut parted.shared)) {
            first = build_prototype(prototype, stream, first, &mut output, &job, &mut report)?;
        }
        let whole = (first, partitions);
        let mut flat = parted.flat();
        fill_and_build(&mut flat, census, (&lattice, &shifts), whole, &mut output, &job, &mut report)?;
        report.partitions = first - prototypes.len() + output.roots.len();
        let (mut placed, mut copies) = (Vec::new(), Vec::new());
        for (number, prototype) in prototypes.iter().enumerate() {
            if let Some(root) = output.prototypes[number].root {
                prototype.place(number as u32, &root, &lattice, &mut placed, &mut copies);
            }
        }
        report.instances = copies.len() as u64;
        report.prototypes = prototypes.len() as u64;
        output.write_top(&copies, &placed)
    })();
    let root = match done {
        Ok(root) => root,
        Err(error) => {
            if error.kind() == ErrorKind::Cancelled {
                output.writer.suspend();
            }
            return Err(error);
        }
    };

    // The manifest
    let Output { writer, split, skipped, leaves, .. } = output;
    let manifest = Manifest {
        version: FORMAT_VERSION,
        lattice_exponent: lattice.exponent,
        lattice_origin: lattice.origin.to_array(),
        shifts: geometry_shifts,
        low: root.bounds.min.to_array(),
        high: root.bounds.max.to_array(),
        bricks: writer.bricks(),
        bytes: split.nodes + split.far_field + split.leaves + split.headers,
        directory_hash: String::new(),
        micropolygons: root.micropolygons,
        grids: report.grids,
        far_field: options.far_field,
        instances: report.instances,
        prototypes: report.prototypes,
        split,
        leaves,
        nodes: split.far_field / 48,
    };
    let manifest = writer.finish(manifest)?;
    Ok(BuildReport {
        micropolygons: manifest.micropolygons,
        bricks: manifest.bricks,
        bytes: manifest.bytes,
        split: manifest.split,
        leaves: manifest.leaves,
        nodes: manifest.nodes,
        degenerate: skipped.degenerate,
        no_radius: skipped.no_radius,
        transparent: skipped.transparent,
        ..report
    })
}

/// The occluders, parted into what is expanded and what shares bricks.
struct Parted<'a> {
    /// Places among the occluders of what is expanded.
    numbers: Vec<usize>,
    expanded: Vec<Box<dyn MicrogridStream + 'a>>,
    shared: Vec<&'a mut dyn MicrogridStream>,
}

impl<'a> Parted<'a> {
    fn new(occluders: &'a mut [OccluderStream<'_>], prototypes: &[Prototype]) -> Result<Self> {
        let mut parted = Self { numbers: Vec::new(), expanded: Vec::new(), shared: Vec::new() };
        for (number, occluder) in occluders.iter_mut().enumerate() {
            if prototypes.iter().any(|prototype| prototype.occluder == number) {
                parted.shared.push(&mut *occluder.stream);
                continue;
            }
            parted.numbers.push(number);
            parted.expanded.push(match &mut occluder.instances {
                None => Box::new(&mut *occluder.stream),
                Some(source) => Box::new(Instance::new(&mut *occluder.stream, &mut **source)?),
            });
        }
        Ok(parted)
    }

    /// What is expanded, as streams that stand once.
    fn flat(&mut self) -> Vec<OccluderStream<'_>> {
        self.expanded.iter_mut().map(|stream| OccluderStream::once(stream.as_mut())).collect()
    }
}

/// The geometries whose copies share bricks, in their order.
fn find_prototypes(occluders: &mut [OccluderStream<'_>], job: &Job<'_>) -> Result<Vec<Prototype>> {
    let (mut prototypes, mut taken) = (Vec::new(), 0);
    let mut memory_bytes = job.options.memory_bytes / 16;
    for occluder in occluders.iter_mut().enumerate() {
        if let Some(mut prototype) = Prototype::judge(occluder, taken, job)? {
            taken += prototype.copies();
            memory_bytes = prototype.keep_census(memory_bytes);
            prototypes.push(prototype);
        }
    }
    Ok(prototypes)
}

/// The lattice for what is expanded and for the boxes of what is not.
fn map_lattice(census: &Census, prototypes: &[Prototype]) -> Result<Lattice> {
    let bounds = prototypes.iter().fold(census.bounds, |all, prototype| all.union(&prototype.world_bounds()));
    let exponents = census.exponent().into_iter().chain(prototypes.iter().map(Prototype::world_exponent));
    Lattice::new(exponents.min().unwrap_or(0), &bounds)
}

/// Builds a prototype whose partitions are numbered from `first` on, as far as it is not written yet. Returns the number that
/// comes after it.
fn build_prototype(
    prototype: &mut Prototype,
    stream: &mut dyn MicrogridStream,
    first: usize,
    output: &mut Output,
    job: &Job<'_>,
    report: &mut BuildReport,
) -> Result<usize> {
    let mut census = prototype.take_census(stream, job)?;
    let mut own = [OccluderStream::once(stream)];
    let (lattice, partitions) = (census.lattice()?, census.cells.partition(PARTITION_MICROPOLYGONS).len());
    let top = first + partitions;
    if output.partitions <= top {
        fill_and_build(&mut own, census, (&lattice, &[0]), (first, partitions), output, job, report)?;
        output.write_prototype(top)?;
    }
    Ok(top + 1)
}

/// Pass 2 and those of the partitions from `first` on that are not written yet.
fn fill_and_build(
    occluders: &mut [OccluderStream<'_>],
    census: Census,
    on_lattice: (&Lattice, &[u8]),
    (first, partitions): (usize, usize),
    output: &mut Output,
    job: &Job<'_>,
    report: &mut BuildReport,
) -> Result<()> {
    let done = output.partitions.saturating_sub(first);
    if done < partitions {
        let start = Instant::now();
        let mut spill = Spill::create(&job.options.scratch, partitions, job.options.memory_bytes / 4)?;
        fill::fill(occluders, &census, on_lattice, done, &mut spill, job)?;
        drop(census);
        let (spilled, bytes) = spill.finish()?;
        report.fill_seconds += start.elapsed().as_secs_f64();
        let start = Instant::now();
        report.spilled_bytes += bytes + partition::build_all(spilled, (first, done), output, job)?;
        report.build_seconds += start.elapsed().as_secs_f64();
    }
    Ok(())
}

/// What every step of a build needs to know.
struct Job<'a> {
    options: &'a BuildOptions,
    progress: &'a (dyn Fn(&str, f64) + Sync),
    cancel: &'a AtomicBool,
}

impl Job<'_> {
    /// Tells how far a stage is, and looks whether to stop.
    fn tell(&self, stage: &str, done: f64) -> Result<()> {
        (self.progress)(stage, done);
        self.check()
    }

    /// Looks whether to stop.
    fn check(&self) -> Result<()> {
        match self.cancel.load(Ordering::Relaxed) {
            true => Err(Error::new(ErrorKind::Cancelled, "the build was cancelled")),
            false => Ok(()),
        }
    }
}
