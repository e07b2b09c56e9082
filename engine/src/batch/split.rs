//! From a stream of microgrids to batches: an out-of-core median-split k-d tree (paper, section 4.2).
//!
//! A node of n points in L = ⌈n / m⌉ batches of at most m is split along the longest axis of its box, ⌈L / 2⌉·m
//! points to the left: so every batch is full but one. Nodes too large for the memory are split on disk, the others
//! in it by selection on all cores; both split at exactly the same point of a total order, so the batches depend on
//! neither memory nor threads.

use std::path::PathBuf;

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use xxhash_rust::xxh3::xxh3_64;

use super::hilbert::HilbertCurve;
use super::plan::{BatchPlan, Header, PlanWriter, Record};
use super::scratch::{PointFile, PointWriter, sweep};
use super::spill::{compare, longest_axis, split_on_disk};
use super::{Point, PointFilter, RAYS_PER_BATCH_MAX};
use crate::math::Bounds;
use crate::stream::schema::names;
use crate::stream::{Microgrid, MicrogridStream};
use crate::{Error, ErrorKind, Result};

/// How to split.
#[derive(Clone, Debug)]
pub struct SplitOptions {
    /// Name of the bake set, for errors.
    pub bake_set: String,
    /// Points of a batch at most: 2^20 over the rays per point, 1 to 2^20.
    pub points_per_batch_max: u32,
    /// An existing folder for the plan and, while splitting, for temporary files of up to twice the plan's size. Each
    /// bake set has its own.
    pub scratch: PathBuf,
    /// Memory for points and buffers, at least 16 MiB. The plan is the same for any.
    pub memory_bytes: u64,
}

/// Less memory than this is refused: buffers and counters take a third of it.
const MEMORY_BYTES_MIN: u64 = 16 << 20;

/// Points split in memory at most (1.5 GiB): more would save little, and a cancelled split should end within seconds.
const IN_MEMORY_POINTS_MAX: u64 = 1 << 25;

/// Nodes below this size are split by one thread: dividing them further costs more than it saves.
const PARALLEL_POINTS_MIN: usize = 1 << 14;

/// Points sorted and encoded in one go, to keep memory bounded and progress moving.
const GROUP_POINTS: usize = 1 << 17;

/// The part of the work that reading the stream is taken for, in what progress reports.
const GATHER_SHARE: f64 = 0.4;

/// What a split calls now and then with the share of the work that is done, from 0 to 1; an error stops the work and
/// is passed on.
pub type Progress<'a> = &'a mut dyn FnMut(f64) -> Result<()>;

/// Splits the vertices of `stream` that `filter` keeps into batches, and writes them to the folder `options.scratch`.
///
/// Batches are ordered along the Hilbert curve through their centroids, points of a batch along the Hilbert curve
/// through its box: what is near on the curve is near in space, for the cache of bricks and for the tracer that takes
/// a few consecutive points together. An older plan in the folder is removed first.
///
/// # Errors
/// [`ErrorKind::Invalid`] when no point is left or a vertex is not finite, [`ErrorKind::Limit`] when the memory is too
/// small for a batch, and what stream, disk and `progress` report. No plan is left behind then.
pub fn split(
    stream: &mut dyn MicrogridStream,
    filter: &mut dyn PointFilter,
    options: &SplitOptions,
    progress: Progress,
) -> Result<BatchPlan> {
    // Half of the memory holds points: the growing vector may have twice the room it needs.
    let in_memory = (options.memory_bytes / 2 / size_of::<Point>() as u64).min(IN_MEMORY_POINTS_MAX);
    let needed =
        MEMORY_BYTES_MIN.max(u64::from(options.points_per_batch_max) * 2 * size_of::<Point>() as u64);
    if options.memory_bytes < needed {
        let message =
            format!("splitting into batches needs {needed} bytes of memory, {} given", options.memory_bytes);
        return Err(Error::new(ErrorKind::Limit, message));
    }
    if !(1..=RAYS_PER_BATCH_MAX).contains(&options.points_per_batch_max) {
        let given = options.points_per_batch_max;
        return Err(Error::invalid(format!(
            "`{given}` points per batch, 1 to {RAYS_PER_BATCH_MAX} are possible"
        )));
    }
    split_with(stream, filter, options, in_memory as usize, progress)
}

/// [`split`] with the number of points that are split in memory given.
fn split_with(
    stream: &mut dyn MicrogridStream,
    filter: &mut dyn PointFilter,
    options: &SplitOptions,
    in_memory: usize,
    progress: Progress,
) -> Result<BatchPlan> {
    sweep(&options.scratch, "split-", ".tmp")?;
    let mut splitter = Splitter {
        folder: options.scratch.clone(),
        per_batch: options.points_per_batch_max as usize,
        in_memory,
        files: 0,
        writer: PlanWriter::create(&options.scratch)?,
        curve: HilbertCurve::new(&Bounds::EMPTY),
        leaves: Vec::new(),
        points_total: 0,
        points_done: 0,
        progress,
    };
    let (stream_points, root) = splitter.gather(stream, filter)?;
    if root.points() == 0 {
        let message = format!("bake set `{}` has no points", options.bake_set);
        return Err(match stream_points {
            0 => Error::invalid(message).hint("its streams have no vertices"),
            _ => Error::invalid(message).hint(format!("its filter dropped all {stream_points} vertices")),
        });
    }
    splitter.points_total = root.points();
    splitter.curve = HilbertCurve::new(&root.bounds());
    splitter.split_root(root)?;
    splitter.finish(stream_points)
}

/// Points of a node, where they are.
enum Node {
    Memory(Vec<Point>),
    Disk(PointFile),
}

impl Node {
    fn points(&self) -> u64 {
        match self {
            Self::Memory(points) => points.len() as u64,
            Self::Disk(file) => file.points,
        }
    }

    fn bounds(&self) -> Bounds {
        match self {
            Self::Memory(points) => bounds_of(points),
            Self::Disk(file) => file.bounds,
        }
    }
}

/// A finished batch, and what orders it among the others.
struct Leaf {
    record: Record,
    centroid_key: u64,
    first_index: u64,
}

/// The state of a split.
struct Splitter<'a> {
    folder: PathBuf,
    per_batch: usize,
    in_memory: usize,
    /// Temporary files made so far: their names.
    files: u64,
    writer: PlanWriter,
    /// Orders the batches.
    curve: HilbertCurve,
    leaves: Vec<Leaf>,
    points_total: u64,
    points_done: u64,
    progress: Progress<'a>,
}

impl Splitter<'_> {
    /// Reads the stream once. Points stay in memory as long as they fit. Returns the stream's vertices and the root.
    fn gather(
        &mut self,
        stream: &mut dyn MicrogridStream,
        filter: &mut dyn PointFilter,
    ) -> Result<(u64, Node)> {
        stream.rewind()?;
        let normals = stream.schema().find(names::NORMAL);
        let (mut grid, mut grid_number, mut index) = (Microgrid::default(), 0, 0);
        let mut memory = Vec::new();
        let mut spilled: Option<PointWriter> = None;
        while stream.next(&mut grid)? {
            for vertex in 0..grid.vertex_count() {
                if filter.keep(grid_number, &grid, vertex) {
                    let normal = match normals {
                        Some(column) => grid.vec3(stream.schema(), column, vertex),
                        None => Vec3::ZERO,
                    };
                    let point = Point { index, position: grid.position(vertex), normal };
                    let point = checked(point, grid_number, vertex)?;
                    match &mut spilled {
                        Some(writer) => writer.push(&point)?,
                        None => memory.push(point),
                    }
                }
                index += 1;
            }
            if memory.len() > self.in_memory {
                let mut writer = self.new_file()?;
                memory.iter().try_for_each(|point| writer.push(point))?;
                memory = Vec::new();
                spilled = Some(writer);
            }
            grid_number += 1;
            if grid_number % 256 == 0 {
                (self.progress)(GATHER_SHARE * stream.progress().clamp(0.0, 1.0))?;
            }
        }
        match spilled {
            Some(writer) => Ok((index, Node::Disk(writer.finish()?))),
            None => Ok((index, Node::Memory(memory))),
        }
    }

    fn new_file(&mut self) -> Result<PointWriter> {
        self.files += 1;
        PointWriter::create(self.folder.join(format!("split-{}.tmp", self.files)))
    }

    /// Splits down to batches, left before right. At most as many files wait as the tree is deep.
    fn split_root(&mut self, root: Node) -> Result<()> {
        let mut memory = Vec::new();
        let mut waiting = match root {
            Node::Memory(points) => {
                memory = points;
                return self.split_in_memory(&mut memory);
            }
            Node::Disk(file) => vec![file],
        };
        while let Some(mut node) = waiting.pop() {
            self.report()?;
            if node.points <= self.in_memory as u64 {
                memory.reserve_exact(node.points as usize);
                node.for_each(|point| {
                    memory.push(*point);
                    Ok(())
                })?;
                drop(node);
                self.split_in_memory(&mut memory)?;
                memory.clear();
            } else {
                let rank = left_points(node.points, self.per_batch as u64);
                let (left, right) = (self.new_file()?, self.new_file()?);
                let (left, right) = split_on_disk(node, rank, &mut memory, self.in_memory, left, right)?;
                waiting.extend([right, left]);
            }
        }
        Ok(())
    }

    /// Splits points in memory, and writes their batches.
    fn split_in_memory(&mut self, points: &mut [Point]) -> Result<()> {
        select_batches(points, self.per_batch);
        // All batches but the last of the whole tree are full, so they are simply equal pieces now.
        let batches_per_group = (GROUP_POINTS / self.per_batch).max(1);
        for group in points.chunks(batches_per_group * self.per_batch) {
            let curve = &self.curve;
            let finished: Vec<(Leaf, Vec<u8>)> =
                group.par_chunks(self.per_batch).map(|batch| finish_batch(batch, curve)).collect();
            for (mut leaf, bytes) in finished {
                leaf.record.leaf = u32::try_from(self.leaves.len())
                    .map_err(|_| Error::new(ErrorKind::Limit, "more than 2^32 batches"))?;
                self.writer.append(&bytes)?;
                self.leaves.push(leaf);
            }
            self.points_done += group.len() as u64;
            self.report()?;
        }
        Ok(())
    }

    fn report(&mut self) -> Result<()> {
        let share = self.points_done as f64 / self.points_total as f64;
        (self.progress)(GATHER_SHARE + (1.0 - GATHER_SHARE) * share)
    }

    /// Orders the batches and writes the table.
    fn finish(mut self, stream_points: u64) -> Result<BatchPlan> {
        self.leaves.par_sort_unstable_by_key(|leaf| (leaf.centroid_key, leaf.first_index));
        let table: Vec<Record> = self.leaves.into_iter().map(|leaf| leaf.record).collect();
        let header =
            Header { points_per_batch_max: self.per_batch as u32, points: self.points_total, stream_points };
        self.writer.finish(header, &table)
    }
}

/// The point if it can be baked.
fn checked(mut point: Point, grid_number: u64, vertex: usize) -> Result<Point> {
    let what = match (point.position.is_finite(), point.normal.is_finite()) {
        (true, true) => {
            // Negative zeros become zeros: the order of numbers is a total one then.
            point.position += DVec3::ZERO;
            return Ok(point);
        }
        (false, _) => "position",
        _ => "normal",
    };
    let message = format!("the {what} of vertex `{vertex}` of grid `{grid_number}` is not a finite number");
    Err(Error::invalid(message))
}

/// Of a node's points, how many go to the left: whole batches, half of them or one more than half.
fn left_points(points: u64, per_batch: u64) -> u64 {
    points.div_ceil(per_batch).div_ceil(2) * per_batch
}

/// Reorders points so that consecutive pieces of `per_batch` are the leaves of the k-d tree.
fn select_batches(points: &mut [Point], per_batch: usize) {
    if points.len() <= per_batch {
        return;
    }
    let axis = longest_axis(&bounds_of(points));
    let rank = left_points(points.len() as u64, per_batch as u64) as usize;
    points.select_nth_unstable_by(rank, |a, b| compare(a, b, axis));
    let both_large = points.len() >= PARALLEL_POINTS_MIN;
    let (left, right) = points.split_at_mut(rank);
    if both_large {
        rayon::join(|| select_batches(left, per_batch), || select_batches(right, per_batch));
    } else {
        select_batches(left, per_batch);
        select_batches(right, per_batch);
    }
}

fn bounds_of(points: &[Point]) -> Bounds {
    points.iter().fold(Bounds::EMPTY, |mut bounds, point| {
        bounds.add(point.position);
        bounds
    })
}

/// Orders a batch along its own Hilbert curve and encodes it. The order does not depend on that of `points`, nor does
/// any sum: it is taken in the final order.
fn finish_batch(points: &[Point], curve: &HilbertCurve) -> (Leaf, Vec<u8>) {
    let bounds = bounds_of(points);
    let inner = HilbertCurve::new(&bounds);
    let mut order: Vec<(u64, u32)> =
        (0..).zip(points).map(|(place, point)| (inner.key(point.position), place)).collect();
    let index = |place: u32| points[place as usize].index;
    order.sort_unstable_by(|a, b| a.0.cmp(&b.0).then_with(|| index(a.1).cmp(&index(b.1))));

    let mut bytes = Vec::with_capacity(points.len() * Point::BYTES);
    let (mut sum, mut first_index) = (DVec3::ZERO, u64::MAX);
    for &(_, place) in &order {
        let point = &points[place as usize];
        bytes.extend_from_slice(&point.to_bytes());
        sum += point.position - bounds.min;
        first_index = first_index.min(point.index);
    }
    let centroid = bounds.min + sum / points.len() as f64;
    let record = Record { leaf: 0, count: points.len() as u32, hash: xxh3_64(&bytes), bounds };
    (Leaf { record, centroid_key: curve.key(centroid), first_index }, bytes)
}

#[cfg(test)]
#[path = "split_tests.rs"]
mod tests;
