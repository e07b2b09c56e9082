//! The brick map: all occluders as one tree of bricks, built out of core (paper, section 4.1).
//!
//! Pass 1 ([`census`]) counts micropolygons in a sparse grid of cells ([`bucket`]) and gathers bounds and edge lengths, from
//! which the lattice follows. Pass 2 ([`fill`]) snaps every grid to the lattice and spills it to its partition ([`spill`]).
//! Then every partition on its own ([`partitions`]): full leaves ([`chunk`], [`patch`]), a tree over them ([`bvh`]), bricks
//! ([`pack`]), written in order ([`file`]); at last a tree over the partitions. [`map`] reads the result, [`farfield`] has
//! what stands in for what is not opened.
//!
//! The bytes depend on the occluders and the build parameters alone, not on threads or memory.

mod bucket;
mod bvh;
mod census;
mod chunk;
mod farfield;
mod file;
mod fill;
mod map;
mod pack;
mod partitions;
mod patch;
mod spill;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use census::Census;
pub use census::hash_occluders;
pub use farfield::FarField;
pub use file::{FORMAT_VERSION, Manifest, Segment};
use file::{MapWriter, SEGMENT_BYTES};
pub use map::BrickMap;
pub use pack::{ByteSplit, TreeStats};
use partitions::{Output, Sums};
use spill::Log;

use crate::brick::lattice;
use crate::stream::MicrogridStream;
use crate::{Error, ErrorKind, Result};

/// Other bytes for the same input make it higher: maps in caches then have another name.
const BUILDER_VERSION: u32 = 2;

/// The least memory to build in.
const MEMORY_BYTES_MIN: u64 = 256 << 20;

/// What bounds the parts of a build. The map's bytes depend on them, so they are constants except in tests.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Limits {
    /// Micropolygons of a partition at most. Larger ones would make a slightly better tree, smaller ones a much worse one; this
    /// size leaves two threads room in 256 MiB.
    partition_micropolygons: u64,
    /// Partitions of one pass, about: their buffers have 16 KiB at least. What is larger is cut again.
    partitions_max: u64,
    /// Cells of the counting grid.
    cells_max: usize,
    /// Bytes of a treelet.
    treelet_bytes: usize,
    /// Root bricks of a partition: the tree over the partitions starts below the partitions' own roots.
    roots_max: usize,
    /// Bytes of a segment.
    segment_bytes: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            partition_micropolygons: 1 << 19,
            partitions_max: 2048,
            cells_max: bucket::CELLS_MAX,
            treelet_bytes: pack::TREELET_BYTES,
            roots_max: 16,
            segment_bytes: SEGMENT_BYTES,
        }
    }
}

/// A stream of occluding microgrids, in the scene's units, instances expanded.
pub struct OccluderStream<'a> {
    /// The stream; it is read twice.
    pub stream: &'a mut dyn MicrogridStream,
}

/// How to build.
#[derive(Clone, Debug)]
pub struct BuildOptions {
    /// Memory to use, in bytes; less than 256 MiB counts as 256 MiB.
    pub memory_bytes: u64,
    /// Threads that build partitions.
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
    /// Vertices read.
    pub vertices: u64,
    /// Bricks.
    pub bricks: u32,
    /// Bytes of all bricks.
    pub bytes: u64,
    /// Where the bytes go.
    pub split: ByteSplit,
    /// The tree's counts and areas.
    pub tree: TreeStats,
    /// Nodes and leaves that a random line through the map's box visits.
    pub sah: [f64; 2],
    /// Partitions.
    pub partitions: usize,
    /// Scene units of a lattice step, and the lattice shift of each stream.
    pub lattice_step: f64,
    /// See above.
    pub shifts: Vec<u8>,
    /// Bytes of temporary data.
    pub spilled_bytes: u64,
    /// Seconds of the counting pass.
    pub count_seconds: f64,
    /// Seconds of the filling pass.
    pub fill_seconds: f64,
    /// Seconds of cutting partitions again that were too full.
    pub recut_seconds: f64,
    /// Seconds of building the partitions and the tree over them.
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
/// occluder streams, such as [`hash_occluders`] or one of the files that they come from.
pub fn content_key(inputs: u128, options: &BuildOptions) -> String {
    let mut hash = xxhash_rust::xxh3::Xxh3::new();
    hash.update(&inputs.to_le_bytes());
    let versions = (FORMAT_VERSION, BUILDER_VERSION, lattice::EDGE_BITS, options.far_field);
    hash.update(format!("{versions:?} {:?}", Limits::default()).as_bytes());
    format!("{:032x}", hash.digest128())
}

/// Builds the brick map of `occluders` at `target`, which appears when it is complete; a brick map that is there already is
/// replaced. `progress` is told the stage and the share of it that is done.
///
/// # Errors
/// When there is nothing to build, an input is broken, the disk is full, `target` is something else than a brick map, or
/// `cancel` is set. Nothing is left behind then.
pub fn build(
    occluders: &mut [OccluderStream<'_>],
    options: &BuildOptions,
    target: &Path,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<BuildReport> {
    build_within(occluders, options, &Limits::default(), target, progress, cancel)
}

/// [`build`] within given limits.
fn build_within(
    occluders: &mut [OccluderStream<'_>],
    options: &BuildOptions,
    limits: &Limits,
    target: &Path,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<BuildReport> {
    let mut report = BuildReport::default();
    let writer = MapWriter::create(target, limits.segment_bytes)?;
    // Buffers of pass 2 are gone when partitions are built
    let memory_bytes = options.memory_bytes.max(MEMORY_BYTES_MIN);
    let (buffer_bytes, building_bytes) = (memory_bytes / 4, memory_bytes / 4 * 3);

    // Pass 1: count
    let mut start = Instant::now();
    let mut lap = || std::mem::replace(&mut start, Instant::now()).elapsed().as_secs_f64();
    let mut census = Census::take(occluders, limits, progress, cancel)?;
    let lattice = census.lattice()?;
    let shifts = census.shifts(&lattice);
    let count = limits.partition_micropolygons.max(census.faces / limits.partitions_max);
    let partitions = census.cells.partition(count).len();
    report.count_seconds = lap();

    // Pass 2: fill
    let mut log = Log::create(&options.scratch)?;
    let partitions = fill::fill(
        occluders,
        &census,
        partitions,
        &lattice,
        &shifts,
        &mut log,
        buffer_bytes,
        progress,
        cancel,
    )?;
    let Census { grids, vertices, hash, .. } = census;
    drop(census);
    report.fill_seconds = lap();
    let partitions = partitions::recut(&mut log, partitions, limits, buffer_bytes, cancel)?;
    report.spilled_bytes = log.bytes();
    report.recut_seconds = lap();

    // Every partition on its own, then the tree over them
    let mut output = Output { writer, roots: Vec::new(), sums: Sums::default() };
    let resources = (options.threads, building_bytes);
    partitions::build_all(&log, &partitions, limits, resources, &mut output, progress, cancel)?;
    let root = output.write_top(limits)?;
    let Output { writer, sums: Sums { split, tree, skipped }, .. } = output;
    let manifest = writer.finish(Manifest {
        version: FORMAT_VERSION,
        lattice_exponent: lattice.exponent,
        lattice_origin: lattice.origin.to_array(),
        shifts: shifts.clone(),
        low: root.bounds.min.to_array(),
        high: root.bounds.max.to_array(),
        micropolygons: root.micropolygons,
        grids,
        far_field: options.far_field,
        split,
        tree,
        stream_hash: format!("{hash:032x}"),
        segment_bytes: limits.segment_bytes,
        ..Manifest::default()
    })?;
    report.build_seconds = lap();
    let area = pack::half_area(&root.bounds).max(1.0);
    Ok(BuildReport {
        micropolygons: manifest.micropolygons,
        grids,
        vertices,
        bricks: manifest.bricks,
        bytes: manifest.bytes,
        split: manifest.split,
        tree,
        sah: [tree.node_half_area / area, tree.leaf_half_area / area],
        partitions: partitions.len(),
        lattice_step: lattice.step(),
        shifts,
        degenerate: skipped.degenerate,
        no_radius: skipped.no_radius,
        transparent: skipped.transparent,
        ..report
    })
}

/// Fails if the build was told to stop.
fn check(cancel: &AtomicBool) -> Result<()> {
    if cancel.load(Ordering::Relaxed) {
        return Err(Error::new(ErrorKind::Cancelled, "the build was cancelled"));
    }
    Ok(())
}
