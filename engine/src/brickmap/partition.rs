//! The partitions: those that came out too large are cut again, then each is built on its own, as many at a time as
//! memory allows, and written in order.

use super::bucket::Cells;
use super::budget::{Budget, Permit};
use super::chunk::{Chunk, Skipped};
use super::log::{Batch, Spill, Spilled};
use super::output::{Built, Output};
use super::pack::{self, Far, Packed};
use super::spill::Quantised;
use super::{FarField, Job, PARTITION_MICROPOLYGONS, bvh};
use crate::Result;
use crate::brick::LatticeBox;
use crate::stream::piece::in_order;

/// Times that a partition is cut again by place because its cells were too full, at most; then it is cut by number.
const CUTS_MAX: u32 = 6;

/// Threads that count a partition again at most: each has a table of its own.
const TABLES_MAX: usize = 4;

/// Bytes that building a partition takes for every micropolygon at most, its bricks included: a face that lies in no rows
/// is gathered as a face of 60 bytes, an item and a reference of 32 each; the far
/// field keeps its sums beside them.
const BYTES_PER_MICROPOLYGON: u64 = 220;

/// Builds what was spilled and writes it. `done` partitions are written already; in the map they are numbered from `first` on.
///
/// # Errors
/// When the disk is full or fails, or the build is cancelled.
pub fn build_all(
    spilled: Vec<Spilled>,
    (first_number, done): (usize, usize),
    output: &mut Output,
    job: &Job<'_>,
) -> Result<u64> {
    let count = spilled.len();
    let bounds: Vec<LatticeBox> = spilled.iter().map(|spilled| spilled.bounds).collect();
    let (mut parts, mut spilled_bytes) = (Vec::new(), 0);
    for (partition, spilled) in spilled.into_iter().enumerate().skip(done) {
        let first = parts.len();
        cut_again(spilled, 0, partition, &mut parts, &mut spilled_bytes, job)?;
        if let Some(last) = parts[first..].last_mut() {
            last.is_last = true;
        }
        find_others(&mut parts[first..], &bounds);
    }
    let budget = Budget::new(job.options.memory_bytes / 4 * 3);
    let mut parts = parts.into_iter();
    let next = || {
        let Some(part) = parts.next() else { return Ok(None) };
        job.tell("build", part.partition as f64 / count as f64)?;
        let permit = budget.take(part.grids.micropolygons * BYTES_PER_MICROPOLYGON);
        Ok(Some((part, permit)))
    };
    let mut threads = vec![(); job.options.threads.max(1)];
    let work = |(): &mut (), (part, permit)| build_within(permit, &part, job);
    let write = |(mut built, _permit): (Built, Permit<'_>)| {
        built.partition += first_number;
        output.write(built)
    };
    in_order(&mut threads, next, work, write)?;
    Ok(spilled_bytes)
}

/// Builds one part and gives back the memory that its bricks do not take.
fn build_within<'a>(mut permit: Permit<'a>, part: &Part, job: &Job<'_>) -> Result<(Built, Permit<'a>)> {
    let built = build(part, job)?;
    permit.shrink_to(built.packed.bytes.capacity() as u64);
    Ok((built, permit))
}

/// What is built in one go: a partition, or a part of one that was too large.
struct Part {
    /// The partition.
    partition: usize,
    /// Whether it ends with this part.
    is_last: bool,
    grids: Spilled,
    /// Whether no other part has grids in the same blocks.
    is_alone: bool,
    /// Boxes of other partitions, and of other parts of the same one, that touch its own.
    others: Vec<LatticeBox>,
}

/// Sets the others of all parts of a partition; `bounds` are the boxes of the partitions.
fn find_others(parts: &mut [Part], bounds: &[LatticeBox]) {
    let siblings: Vec<LatticeBox> = parts.iter().map(|part| part.grids.bounds).collect();
    for (number, part) in parts.iter_mut().enumerate() {
        let own = part.grids.bounds;
        let others = bounds.iter().enumerate().filter(|&(partition, _)| partition != part.partition);
        let siblings = siblings.iter().enumerate().filter(|&(sibling, _)| sibling != number);
        part.others = others.chain(siblings).map(|(_, other)| *other).filter(|b| b.touches(&own)).collect();
    }
}

/// Adds a partition to `parts`, cut again on finer cells as long as it is more than twice as large as it should be.
fn cut_again(
    grids: Spilled,
    depth: u32,
    partition: usize,
    parts: &mut Vec<Part>,
    spilled_bytes: &mut u64,
    job: &Job<'_>,
) -> Result<()> {
    if grids.micropolygons <= 2 * PARTITION_MICROPOLYGONS {
        parts.push(Part { partition, is_last: false, grids, is_alone: true, others: Vec::new() });
        return Ok(());
    }

    let mut cells = count(&grids, job)?;
    let pieces = cells.partition(PARTITION_MICROPOLYGONS).len();
    if pieces == 1 || depth == CUTS_MAX {
        // It lies on one spot, or is nested too deep: by number
        let ranges = grids.ranges(PARTITION_MICROPOLYGONS).into_iter();
        parts.extend(ranges.map(|grids| Part {
            partition,
            is_last: false,
            grids,
            is_alone: false,
            others: Vec::new(),
        }));
        return Ok(());
    }
    let (pieces, bytes) = spill_again(&grids, &cells, pieces, job)?;
    *spilled_bytes += bytes;
    grids.release();
    drop((grids, cells));
    pieces.into_iter().try_for_each(|piece| cut_again(piece, depth + 1, partition, parts, spilled_bytes, job))
}

/// Counts a partition in cells of the lattice itself.
fn count(grids: &Spilled, job: &Job<'_>) -> Result<Cells> {
    let mut tables: Vec<Cells> =
        (0..job.options.threads.clamp(1, TABLES_MAX)).map(|_| Cells::new(0)).collect();
    let mut blocks = grids.blocks();
    let next = || {
        job.check()?;
        Ok(blocks.next())
    };
    let count = |cells: &mut Cells, block: Spilled| {
        block.read(|grid| {
            cells.add(middle(grid), grid.arities.len() as u64);
            Ok(())
        })
    };
    in_order(&mut tables, next, count, Ok)?;
    let mut cells = tables.pop().expect("one at least");
    tables.into_iter().for_each(|table| cells.merge(table));
    Ok(cells)
}

/// Spills a partition again, to finer ones. Returns them and the bytes of their log.
fn spill_again(grids: &Spilled, cells: &Cells, pieces: usize, job: &Job<'_>) -> Result<(Vec<Spilled>, u64)> {
    let mut spill = Spill::create(&job.options.scratch, pieces, job.options.memory_bytes / 4)?;
    let mut blocks = grids.blocks();
    let next = || {
        job.check()?;
        Ok(blocks.next())
    };
    let fill = |(): &mut (), block: Spilled| {
        let mut batch = Batch::default();
        block.read(|grid| {
            let piece = cells.partition_of(middle(grid)).expect("counted before");
            batch.push(piece, grid);
            Ok(())
        })?;
        Ok(batch)
    };
    let mut threads = vec![(); job.options.threads.max(1)];
    in_order(&mut threads, next, fill, |batch| spill.add(&batch))?;
    spill.finish()
}

fn middle(grid: &Quantised) -> glam::DVec3 {
    grid.vertices[grid.vertices.len() / 2].as_dvec3()
}

/// Builds one part.
fn build(part: &Part, job: &Job<'_>) -> Result<Built> {
    let mut chunk = Chunk::default();
    part.grids.read(|grid| {
        chunk.add(grid);
        Ok(())
    })?;
    if part.is_alone {
        part.grids.release();
    }
    job.check()?;
    chunk.finish();
    let Chunk { clusters, leaves, skipped, .. } = chunk;
    let mut packed = Packed::default();
    let root = (!clusters.is_empty()).then(|| {
        let boxes: Vec<LatticeBox> = clusters.iter().map(|cluster| cluster.bounds).collect();
        let tree = bvh::build(&boxes);
        drop(boxes);
        let far = match job.options.far_field {
            FarField::Paper => Far::Paper,
            FarField::Directional => Far::Directional(&part.others),
        };
        pack::pack(&tree, &clusters, &leaves, 0, far, &mut packed)
    });
    job.check()?;
    let skipped: Skipped = skipped;
    let (partition, is_last, leaves) = (part.partition, part.is_last, clusters.len() as u64);
    Ok(Built { partition, is_last, packed, root, skipped, leaves })
}
