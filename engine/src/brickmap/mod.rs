//! The brick map: all occluders as one tree of bricks, built out of core (paper, section 4.1).
//!
//! Pass 1 counts micropolygons in a sparse grid of cells ([`bucket`]) and gathers bounds and edge lengths, from which the
//! lattice follows. Pass 2 snaps every grid to the lattice and spills it to its partition ([`spill`]). Then every
//! partition on its own: full leaves ([`chunk`]), a tree over them ([`bvh`]), bricks ([`pack`]), written in order; at last
//! a tree over the partitions. [`mod@file`] is the result on disk, [`farfield`] what stands in for what is not opened.
//!
//! The bytes depend on the occluders and the build parameters alone, not on threads or memory.

pub mod bucket;
pub mod bvh;
pub mod chunk;
pub mod farfield;
pub mod file;
pub mod pack;
pub mod spill;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex};
use std::time::Instant;

use bucket::Cells;
use chunk::{Chunk, Skipped};
pub use farfield::FarField;
use file::MapWriter;
pub use file::{BrickMap, FORMAT_VERSION, Manifest};
use glam::DVec3;
use pack::{ByteSplit, Packed, Primitive};
use spill::{Quantised, Spill, cancelled};

use crate::brick::lattice::{self, Lattice};
use crate::brick::leaf::{OPAQUE, extinction_from_opacity};
use crate::brick::{LatticeBox, renumber};
use crate::math::Bounds;
use crate::stream::schema::{Schema, names};
use crate::stream::{Microgrid, MicrogridStream};
use crate::{Error, Result};

/// Micropolygons of a partition at most. Larger ones would make a slightly better tree, smaller ones a much worse one; this
/// size leaves two threads room in 256 MiB.
const PARTITION_MICROPOLYGONS: u64 = 1 << 19;

/// Times that a partition is cut again because its cells were too full, at most.
const REPARTITION_DEPTH_MAX: u32 = 6;

/// A stream of occluding microgrids, in the scene's units, instances expanded.
pub struct OccluderStream<'a> {
    /// The stream; it is read twice.
    pub stream: &'a mut dyn MicrogridStream,
}

/// How to build.
#[derive(Clone, Debug)]
pub struct BuildOptions {
    /// Memory to use, from 256 MiB up.
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
    let parameters = (FORMAT_VERSION, PARTITION_MICROPOLYGONS, lattice::EDGE_BITS, options.far_field);
    hash.update(format!("{parameters:?}").as_bytes());
    format!("{:032x}", hash.digest128())
}

/// Builds the brick map of `occluders` at `target`, which appears when it is complete. `progress` is told the stage and
/// the share of it that is done.
///
/// # Errors
/// When there is nothing to build, an input is broken, the disk is full, or `cancel` is set. Nothing is left behind
/// then.
pub fn build(
    occluders: &mut [OccluderStream<'_>],
    options: &BuildOptions,
    target: &Path,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<BuildReport> {
    let mut report = BuildReport::default();

    // Pass 1: count
    let start = Instant::now();
    let mut census = count(occluders, progress, cancel)?;
    report.grids = census.grids;
    let lattice = Lattice::new(census.exponent(), &census.bounds)?;
    let shifts: Vec<u8> = census.edges.iter().map(|edges| shift(edges, &lattice)).collect();
    let partitions = census.cells.partition(PARTITION_MICROPOLYGONS);
    report.count_seconds = start.elapsed().as_secs_f64();

    // Pass 2: fill
    let start = Instant::now();
    let mut spill = Spill::create(&options.scratch, partitions.len(), options.memory_bytes / 4)?;
    fill(occluders, &census, &lattice, &shifts, &mut spill, progress, cancel)?;
    report.spilled_bytes = spill.bytes();
    report.fill_seconds = start.elapsed().as_secs_f64();

    // Every partition on its own, then the tree over them
    let start = Instant::now();
    let writer = MapWriter::create(target)?;
    let mut output = Output {
        writer,
        roots: Vec::new(),
        split: ByteSplit::default(),
        skipped: Skipped::default(),
        leaves: 0,
    };
    let job = PartitionJob { options, progress, cancel };
    job.build_all(&spill, &partitions, 0, &mut output)?;
    report.partitions = output.roots.len();
    let root = output.write_top()?;
    report.build_seconds = start.elapsed().as_secs_f64();

    let Output { writer, split, skipped, leaves, .. } = output;
    let bytes = split.nodes + split.far_field + split.leaves + split.headers;
    let manifest = writer.bricks();
    let manifest = Manifest {
        version: FORMAT_VERSION,
        lattice_exponent: lattice.exponent,
        lattice_origin: lattice.origin.to_array(),
        shifts,
        low: root.bounds.min.to_array(),
        high: root.bounds.max.to_array(),
        bricks: manifest,
        bytes,
        directory_hash: String::new(),
        micropolygons: root.micropolygons,
        grids: report.grids,
        far_field: options.far_field,
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

/// Micropolygons by the binary logarithm of their grid's mean edge, from 2^-64 to 2^63 scene units.
type Edges = [u64; 128];

/// What pass 1 finds.
struct Census {
    cells: Cells,
    bounds: Bounds,
    /// Per stream.
    edges: Vec<Edges>,
    grids: u64,
}

impl Census {
    /// The lattice exponent for the finest stream.
    fn exponent(&self) -> i32 {
        self.edges.iter().filter_map(typical_exponent).min().unwrap_or(0)
    }
}

/// The lattice exponent for edges of the first percentile.
fn typical_exponent(edges: &Edges) -> Option<i32> {
    let total: u64 = edges.iter().sum();
    let mut below = 0;
    for (bin, &count) in edges.iter().enumerate() {
        below += count;
        if below > 0 && below >= total.div_ceil(100) {
            return Some(bin as i32 - 64 - lattice::EDGE_BITS);
        }
    }
    None
}

fn shift(edges: &Edges, lattice: &Lattice) -> u8 {
    let exponent = typical_exponent(edges).unwrap_or(lattice.exponent);
    (exponent - lattice.exponent).clamp(0, i32::from(lattice::SHIFT_MAX)) as u8
}

/// The columns of a stream that matter to occlusion.
struct Columns {
    radius: Option<usize>,
    opacity: Option<usize>,
}

impl Columns {
    fn of(schema: &Schema) -> Self {
        Self { radius: schema.find(names::RADIUS), opacity: schema.find(names::OPACITY) }
    }
}

/// Pass 1.
fn count(
    occluders: &mut [OccluderStream<'_>],
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<Census> {
    let mut census = Census { cells: Cells::new(-30), bounds: Bounds::EMPTY, edges: Vec::new(), grids: 0 };
    let mut grid = Microgrid::default();
    let streams = occluders.len() as f64;
    for (number, OccluderStream { stream }) in occluders.iter_mut().enumerate() {
        stream.rewind()?;
        let columns = Columns::of(stream.schema());
        let mut edges = [0; 128];
        while stream.next(&mut grid)? {
            if grid.face_count() == 0 {
                continue;
            }
            let mut bounds = grid.bounds();
            if !(bounds.min.is_finite() && bounds.max.is_finite()) {
                return Err(Error::invalid(format!(
                    "a position in microgrid {} of occluder stream {number} is not a finite number",
                    census.grids
                )));
            }
            let (edge, radius) = edge_and_radius(&grid, stream.schema(), &columns)?;
            bounds.min -= radius;
            bounds.max += radius;
            census.bounds = census.bounds.union(&bounds);
            let bin = lattice::exponent_for_edge(edge) + lattice::EDGE_BITS + 64;
            edges[bin.clamp(0, 127) as usize] += grid.face_count() as u64;
            census.cells.add(middle(&grid), grid.face_count() as u64);
            census.grids += 1;
            if census.grids.is_multiple_of(1024) {
                progress("count", (number as f64 + stream.progress()) / streams);
                check(cancel)?;
            }
        }
        census.edges.push(edges);
    }
    if census.grids == 0 {
        return Err(Error::invalid("the occluders hold no geometry"));
    }
    Ok(census)
}

fn check(cancel: &AtomicBool) -> Result<()> {
    if cancel.load(Ordering::Relaxed) { Err(cancelled()) } else { Ok(()) }
}

/// Where a grid is filed.
fn middle(grid: &Microgrid) -> DVec3 {
    grid.position(grid.vertex_count() / 2)
}

/// The mean edge of a grid's faces, points counting their diameter, and the largest radius.
fn edge_and_radius(grid: &Microgrid, schema: &Schema, columns: &Columns) -> Result<(f64, f64)> {
    let (mut sum, mut largest) = (0.0_f64, 0.0_f64);
    for face in grid.faces() {
        let at = |i: usize| grid.positions[usize::from(face[i])];
        if face.len() <= 2 {
            let radius =
                columns.radius.map_or(0.0, |c| f64::from(grid.value(schema, c, usize::from(face[0]), 0)));
            if radius.is_nan() || radius.is_infinite() {
                return Err(Error::invalid("a radius is not a finite number"));
            }
            largest = largest.max(radius);
            sum += 2.0 * radius;
        } else {
            sum += 0.5 * f64::from(at(0).distance(at(1)) + at(1).distance(at(2)));
        }
    }
    // The second end of a line may be the thicker one
    if let Some(column) = columns.radius {
        let radii = (0..grid.vertex_count()).map(|v| f64::from(grid.value(schema, column, v, 0)));
        largest = radii.filter(|radius| radius.is_finite()).fold(largest, f64::max);
    }
    Ok((sum / grid.face_count() as f64, largest))
}

/// Pass 2.
fn fill(
    occluders: &mut [OccluderStream<'_>],
    census: &Census,
    lattice: &Lattice,
    shifts: &[u8],
    spill: &mut Spill,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<()> {
    let (mut grid, mut quantised) = (Microgrid::default(), Quantised::default());
    let streams = occluders.len() as f64;
    let mut grids = 0_u64;
    for (number, (OccluderStream { stream }, &shift)) in occluders.iter_mut().zip(shifts).enumerate() {
        stream.rewind()?;
        let columns = Columns::of(stream.schema());
        while stream.next(&mut grid)? {
            if grid.face_count() == 0 {
                continue;
            }
            quantise(&grid, stream.schema(), &columns, lattice, shift, &mut quantised);
            let Some(partition) = census.cells.partition_of(middle(&grid)) else {
                return Err(Error::invalid(format!("occluder stream {number} changed between two readings")));
            };
            spill.push(partition, &quantised)?;
            grids += 1;
            if grids.is_multiple_of(1024) {
                progress("fill", (number as f64 + stream.progress()) / streams);
                check(cancel)?;
            }
        }
    }
    spill.finish()
}

/// Puts a grid on the lattice.
fn quantise(
    grid: &Microgrid,
    schema: &Schema,
    columns: &Columns,
    lattice: &Lattice,
    shift: u8,
    out: &mut Quantised,
) {
    out.clear();
    out.shift = shift;
    out.vertices.extend((0..grid.vertex_count()).map(|vertex| lattice.snap(grid.position(vertex), shift)));
    out.arities.extend_from_slice(&grid.arities);
    out.indices.extend_from_slice(&grid.indices);
    out.find_columns();
    if let Some(column) = columns.radius
        && grid.arities.iter().any(|&arity| arity <= 2)
    {
        let radius = |vertex| {
            (f64::from(grid.value(schema, column, vertex, 0)) / lattice.step()).clamp(0.0, 5e8) as f32
        };
        out.radii.extend((0..grid.vertex_count()).map(radius));
    }
    if let Some(column) = columns.opacity {
        let mean = |face: &[u8]| {
            let sum: f32 = face.iter().map(|&v| grid.unit_value(schema, column, usize::from(v), 0)).sum();
            extinction_from_opacity(sum / face.len() as f32)
        };
        out.extinctions.extend(grid.faces().map(mean));
        if out.extinctions.iter().all(|&extinction| extinction == OPAQUE) {
            out.extinctions.clear();
        }
    }
}

/// Where partitions go as they are done.
struct Output {
    writer: MapWriter,
    /// Root bricks of the partitions.
    roots: Vec<Primitive>,
    split: ByteSplit,
    skipped: Skipped,
    leaves: u64,
}

/// A partition that is done, its bricks numbered from 0.
struct Built {
    packed: Packed,
    root: Option<Primitive>,
    skipped: Skipped,
    leaves: u64,
}

impl Output {
    /// Writes a partition after those before it.
    fn write(&mut self, mut built: Built) -> Result<()> {
        let base = self.writer.bricks();
        let mut at = 0;
        for &length in &built.packed.lengths {
            renumber(&mut built.packed.bytes[at..at + length as usize], base);
            at += length as usize;
        }
        self.writer.write(&built.packed.bytes, &built.packed.lengths)?;
        self.split += built.packed.split;
        self.leaves += built.leaves;
        self.skipped.degenerate += built.skipped.degenerate;
        self.skipped.no_radius += built.skipped.no_radius;
        self.skipped.transparent += built.skipped.transparent;
        self.roots.extend(built.root.map(|mut root| {
            if let pack::Content::Brick(number) = &mut root.content {
                *number += base;
            }
            root
        }));
        Ok(())
    }

    /// Writes the tree over the partitions; its root brick is the map's last.
    fn write_top(&mut self) -> Result<Primitive> {
        match self.roots.as_slice() {
            [] => {
                Err(Error::invalid("the occluders hold no face with an area, no point or line with a radius"))
            }
            [root] => Ok(*root),
            roots => {
                let boxes: Vec<LatticeBox> = roots.iter().map(|root| root.bounds).collect();
                let mut packed = Packed::default();
                let root = pack::pack(&bvh::build(&boxes), roots, &[], self.writer.bricks(), &mut packed);
                self.writer.write(&packed.bytes, &packed.lengths)?;
                self.split += packed.split;
                Ok(root)
            }
        }
    }
}

/// Builds partitions.
struct PartitionJob<'a> {
    options: &'a BuildOptions,
    progress: &'a (dyn Fn(&str, f64) + Sync),
    cancel: &'a AtomicBool,
}

/// Whose turn it is to write.
struct Turn<'a> {
    next: usize,
    failed: Option<Error>,
    output: &'a mut Output,
}

impl PartitionJob<'_> {
    /// Builds all partitions of a spill and writes them in order. Those with too many micropolygons are cut again.
    fn build_all(&self, spill: &Spill, counts: &[u64], depth: u32, output: &mut Output) -> Result<()> {
        let next = AtomicUsize::new(0);
        let turn = Mutex::new(Turn { next: 0, failed: None, output });
        let moved = Condvar::new();
        let work = || {
            loop {
                let partition = next.fetch_add(1, Ordering::Relaxed);
                if partition >= counts.len() {
                    return;
                }
                // A partition that must be cut again uses all the memory by itself: it is built when its turn comes
                let is_large =
                    counts[partition] > 2 * PARTITION_MICROPOLYGONS && depth < REPARTITION_DEPTH_MAX;
                let built = if is_large { None } else { Some(self.build(spill, partition)) };
                let mut turn = turn.lock().expect("no thread panics");
                while turn.next != partition && turn.failed.is_none() {
                    turn = moved.wait(turn).expect("no thread panics");
                }
                if turn.failed.is_none() {
                    let result = match built {
                        Some(built) => built.and_then(|built| turn.output.write(built)),
                        None => self.build_large(spill, partition, depth, turn.output),
                    };
                    turn.failed = result.err();
                    turn.next += 1;
                    if depth == 0 {
                        (self.progress)("build", turn.next as f64 / counts.len() as f64);
                    }
                }
                moved.notify_all();
                if turn.failed.is_some() {
                    return;
                }
            }
        };
        std::thread::scope(|scope| {
            let threads = self.options.threads.clamp(1, counts.len().max(1));
            let handles: Vec<_> = (1..threads).map(|_| scope.spawn(work)).collect();
            work();
            handles.into_iter().for_each(|handle| handle.join().expect("a building thread panicked"));
        });
        turn.into_inner().expect("no thread panics").failed.map_or(Ok(()), Err)
    }

    /// Builds one partition.
    fn build(&self, spill: &Spill, partition: usize) -> Result<Built> {
        let mut chunk = Chunk::default();
        spill.read(partition, |grid| {
            chunk.add(grid);
            Ok(())
        })?;
        check(self.cancel)?;
        chunk.finish();
        let Chunk { clusters, leaves, skipped, .. } = chunk;
        let mut packed = Packed::default();
        let root = (!clusters.is_empty()).then(|| {
            let boxes: Vec<LatticeBox> = clusters.iter().map(|cluster| cluster.bounds).collect();
            let tree = bvh::build(&boxes);
            drop(boxes);
            pack::pack(&tree, &clusters, &leaves, 0, &mut packed)
        });
        check(self.cancel)?;
        Ok(Built { packed, root, skipped, leaves: clusters.len() as u64 })
    }

    /// Cuts a partition with too many micropolygons again, on finer cells, and builds the pieces.
    fn build_large(&self, spill: &Spill, partition: usize, depth: u32, output: &mut Output) -> Result<()> {
        let middle = |grid: &Quantised| grid.vertices[grid.vertices.len() / 2].as_dvec3();
        let mut cells = Cells::new(0);
        let mut total = 0;
        spill.read(partition, |grid| {
            cells.add(middle(grid), grid.arities.len() as u64);
            total += grid.arities.len() as u64;
            Ok(())
        })?;
        let mut counts = cells.partition(PARTITION_MICROPOLYGONS);
        // All in one cell of one lattice step: by number
        let by_number = counts.len() == 1;
        if by_number {
            let pieces = total.div_ceil(PARTITION_MICROPOLYGONS);
            counts = vec![PARTITION_MICROPOLYGONS; pieces as usize];
        }
        let mut finer = Spill::create(&self.options.scratch, counts.len(), self.options.memory_bytes / 8)?;
        let mut seen = 0;
        spill.read(partition, |grid| {
            let piece = if by_number {
                (seen / PARTITION_MICROPOLYGONS) as usize
            } else {
                cells.partition_of(middle(grid)).expect("counted above")
            };
            seen += grid.arities.len() as u64;
            check(self.cancel)?;
            finer.push(piece.min(counts.len() - 1), grid)
        })?;
        finer.finish()?;
        drop(cells);
        self.build_all(&finer, &counts, if by_number { REPARTITION_DEPTH_MAX } else { depth + 1 }, output)
    }
}
