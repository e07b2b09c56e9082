//! From partitions to bricks: partitions that are too full are cut again, then each is built on its own, by any thread, and
//! written in order.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::sync::{Condvar, Mutex};

use super::bucket::Cells;
use super::bvh::WideTree;
use super::chunk::{Chunk, Skipped};
use super::file::MapWriter;
use super::pack::{self, Content, Cut, Packed, Primitive};
use super::spill::{Log, Partition, Quantised, Scatter};
use super::{Limits, check};
use crate::brick::renumber;
use crate::{Error, Result};

/// Times that a partition is cut again by place; then it is cut by number.
const RECUT_DEPTH_MAX: u32 = 8;

/// Root bricks of all partitions together, about.
const ROOTS_MAX: usize = 1 << 18;

/// Memory that building one partition takes, per micropolygon: faces in the pool 84, order 16, leaves and bricks 45, trees 35.
const BYTES_PER_MICROPOLYGON: u64 = 180;

/// Cuts partitions that hold too many micropolygons on finer cells, until all fit. Keeps their order.
///
/// # Errors
/// When the disk is full or fails, or `cancel` is set.
pub fn recut(
    log: &mut Log,
    partitions: Vec<Partition>,
    limits: &Limits,
    buffer_bytes: u64,
    cancel: &AtomicBool,
) -> Result<Vec<Partition>> {
    let mut done = Vec::with_capacity(partitions.len());
    let mut stack: Vec<(Partition, u32)> = partitions.into_iter().rev().map(|p| (p, 0)).collect();
    while let Some((partition, depth)) = stack.pop() {
        if partition.micropolygons <= limits.partition_micropolygons {
            if partition.micropolygons > 0 {
                done.push(partition);
            }
            continue;
        }
        let pieces = recut_one(log, &partition, depth, limits, buffer_bytes, cancel)?;
        // Pieces by number may be over by one grid, which is no reason to go on
        match pieces {
            Pieces::ByPlace(pieces) => stack.extend(pieces.into_iter().rev().map(|p| (p, depth + 1))),
            Pieces::ByNumber(pieces) => done.extend(pieces),
        }
    }
    Ok(done)
}

enum Pieces {
    ByPlace(Vec<Partition>),
    ByNumber(Vec<Partition>),
}

fn recut_one(
    log: &mut Log,
    partition: &Partition,
    depth: u32,
    limits: &Limits,
    buffer_bytes: u64,
    cancel: &AtomicBool,
) -> Result<Pieces> {
    let middle = |grid: &Quantised| grid.vertices[grid.vertices.len() / 2].as_dvec3();
    let mut cells = Cells::new(0, limits.cells_max);
    log.read(partition, |grid| {
        cells.add(middle(grid), grid.arities.len() as u64);
    })?;
    check(cancel)?;
    let counts =
        cells.partition(limits.partition_micropolygons.max(partition.micropolygons / limits.partitions_max));
    let by_number = counts.len() == 1 || depth >= RECUT_DEPTH_MAX;
    let pieces = if by_number {
        partition.micropolygons.div_ceil(limits.partition_micropolygons) as usize
    } else {
        counts.len()
    };
    let mut scatter = Scatter::new(pieces, buffer_bytes);
    let mut seen = 0;
    let mut piece_of = |grid: &Quantised| {
        let piece = if by_number {
            (seen / limits.partition_micropolygons) as usize
        } else {
            cells.partition_of(middle(grid)).expect("counted above")
        };
        seen += grid.arities.len() as u64;
        piece.min(pieces - 1)
    };
    // The log is read and written in turns: its blocks stay where they are
    let (mut grid, mut bytes) = (Quantised::default(), Vec::new());
    for block in 0..partition.block_count() {
        check(cancel)?;
        log.read_block(partition, block, &mut bytes)?;
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            rest = grid.decode(rest);
            scatter.push(log, piece_of(&grid), &grid)?;
        }
    }
    let pieces = scatter.finish(log)?;
    Ok(if by_number { Pieces::ByNumber(pieces) } else { Pieces::ByPlace(pieces) })
}

/// Where partitions go as they are done.
#[derive(Debug)]
pub struct Output {
    /// The map.
    pub writer: MapWriter,
    /// Root bricks of the partitions.
    pub roots: Vec<Primitive>,
    /// What all bricks together are.
    pub sums: Sums,
}

/// Sums over bricks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sums {
    /// Bytes.
    pub split: pack::ByteSplit,
    /// Trees.
    pub tree: pack::TreeStats,
    /// What was left out.
    pub skipped: Skipped,
}

/// A partition that is done, its bricks numbered from 0.
struct Built {
    packed: Packed,
    roots: Vec<Primitive>,
    skipped: Skipped,
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
        self.write_packed(&built.packed)?;
        self.sums.skipped += built.skipped;
        self.roots.extend(built.roots.into_iter().map(|mut root| {
            if let Content::Brick(number) = &mut root.content {
                *number += base;
            }
            root
        }));
        Ok(())
    }

    fn write_packed(&mut self, packed: &Packed) -> Result<()> {
        self.writer.write(&packed.bytes, &packed.lengths)?;
        self.sums.split += packed.split;
        self.sums.tree += packed.tree;
        Ok(())
    }

    /// Writes the tree over the partitions and returns its root; the root's brick is the map's last.
    ///
    /// # Errors
    /// When every micropolygon was left out, or the disk is full.
    pub fn write_top(&mut self, limits: &Limits) -> Result<Primitive> {
        if self.roots.len() <= 1 {
            return self.roots.first().copied().ok_or_else(|| {
                Error::invalid("no occluder geometry: no face with an area, no point or line with a radius")
            });
        }
        let mut tree = WideTree::default();
        tree.build(self.roots.iter().map(|root| root.bounds));
        let mut packed = Packed::default();
        let cut =
            Cut { first_number: self.writer.bricks(), treelet_bytes: limits.treelet_bytes, roots_max: 1 };
        let roots = pack::pack(&tree, &self.roots, &[], cut, &mut packed);
        self.write_packed(&packed)?;
        Ok(roots[0])
    }
}

/// Who builds what, and whose turn it is to write.
struct Queue<'a> {
    /// The next partition to be claimed, and to be written.
    claimed: usize,
    written: usize,
    ready: BTreeMap<usize, Built>,
    failed: Option<Error>,
    output: &'a mut Output,
}

/// Builds all partitions and writes them in order. `memory_bytes` bounds how many are built at a time.
///
/// # Errors
/// When the disk is full or fails, or `cancel` is set.
pub fn build_all(
    log: &Log,
    partitions: &[Partition],
    limits: &Limits,
    (threads, memory_bytes): (usize, u64),
    output: &mut Output,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<()> {
    let largest = partitions.iter().map(|partition| partition.micropolygons).max().unwrap_or(0);
    let room = memory_bytes / (largest * BYTES_PER_MICROPOLYGON).max(1);
    let threads = threads.min(partitions.len()).min(room as usize).max(1);
    let queue = Queue { claimed: 0, written: 0, ready: BTreeMap::new(), failed: None, output };
    let (queue, moved) = (Mutex::new(queue), Condvar::new());
    // A lone partition is the whole tree; with very many, the tree over them shall not outgrow one of them
    let roots_max =
        if partitions.len() == 1 { 1 } else { (ROOTS_MAX / partitions.len()).clamp(1, limits.roots_max) };
    let work = || {
        let mut builder = Builder { chunk: Chunk::default(), tree: WideTree::default(), limits, roots_max };
        loop {
            // Claim a partition, but not too far ahead of the one that is written next
            let mut turn = queue.lock().expect("no thread panics");
            while turn.failed.is_none()
                && turn.claimed < partitions.len()
                && turn.claimed >= turn.written + threads + threads.div_ceil(2)
            {
                turn = moved.wait(turn).expect("no thread panics");
            }
            if turn.failed.is_some() || turn.claimed >= partitions.len() {
                return;
            }
            let claimed = turn.claimed;
            turn.claimed += 1;
            drop(turn);

            let built = builder.build(log, &partitions[claimed], cancel);

            let mut turn = queue.lock().expect("no thread panics");
            let stored = built.map(|built| turn.ready.insert(claimed, built));
            let result = stored.and_then(|_| {
                while let Some(built) = {
                    let next = turn.written;
                    turn.ready.remove(&next)
                } {
                    turn.output.write(built)?;
                    turn.written += 1;
                    progress("build", turn.written as f64 / partitions.len() as f64);
                }
                Ok(())
            });
            if let Err(error) = result {
                turn.failed.get_or_insert(error);
            }
            drop(turn);
            moved.notify_all();
        }
    };
    std::thread::scope(|scope| {
        let handles: Vec<_> = (1..threads).map(|_| scope.spawn(work)).collect();
        work();
        handles.into_iter().for_each(|handle| handle.join().expect("a building thread panicked"));
    });
    queue.into_inner().expect("no thread panics").failed.map_or(Ok(()), Err)
}

/// One thread's memory.
struct Builder<'a> {
    chunk: Chunk,
    tree: WideTree,
    limits: &'a Limits,
    roots_max: usize,
}

impl Builder<'_> {
    /// Builds one partition.
    fn build(&mut self, log: &Log, partition: &Partition, cancel: &AtomicBool) -> Result<Built> {
        let Self { chunk, tree, .. } = self;
        chunk.clear();
        log.read(partition, |grid| {
            chunk.add(grid);
        })?;
        check(cancel)?;
        chunk.finish();
        let mut packed = Packed::default();
        let mut roots = Vec::new();
        if !chunk.clusters.is_empty() {
            packed.bytes.reserve(chunk.leaves.len() + chunk.leaves.len() / 3);
            tree.build(chunk.clusters.iter().map(|cluster| cluster.bounds));
            let Limits { treelet_bytes, .. } = *self.limits;
            let cut = Cut { first_number: 0, treelet_bytes, roots_max: self.roots_max };
            roots = pack::pack(tree, &chunk.clusters, &chunk.leaves, cut, &mut packed);
        }
        check(cancel)?;
        Ok(Built { packed, roots, skipped: chunk.skipped })
    }
}
