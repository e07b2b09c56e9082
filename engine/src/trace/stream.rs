//! The spherical tracer on the CPU: every ray of a batch through the batch's cut, projected as it ends.
//!
//! A batch's points are cut into bundles of a few neighbours ([`crate::brick::bundle`]); threads take bundles from a
//! common queue and walk them through the bricks in the arena with no further I/O. Only when the cut is larger than the
//! arena do rays stop at a brick that is not in memory: they wait, the arena is filled with what most of them wait for next in
//! brick order, and they go on. Neither the number of threads nor the size of the arena changes any bit of the result.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use super::setup::{Piece, Prepared, Setup, Shading};
use crate::batch::Point;
use crate::brick::bundle::{Bundle, RAYS_MAX};
use crate::brick::lanes::InstructionSet;
use crate::brick::walk::{Bricks, Counts, Scratch, Start, Waiting, walk};
use crate::cut::arena::ArenaCounts;
use crate::cut::{Arena, Lod};
use crate::shade::sh_occlusion::{project, project_halves};
use crate::{Error, ErrorKind, Result};

/// Bytes of waiting rays after which no new bundles are begun.
const WAITING_BYTES_MAX: usize = 32 << 20;

/// How to trace.
#[derive(Clone, Copy, Debug)]
pub struct TraceOptions {
    /// How far to open the brick map.
    pub lod: Lod,
    /// Same seed, same rays.
    pub seed: u64,
    /// Worker threads, at least 1.
    pub threads: usize,
    /// The inner loops to use.
    pub instructions: InstructionSet,
}

/// What tracing a batch took.
#[derive(Clone, Copy, Debug, Default)]
pub struct BatchCounts {
    /// Rays traced.
    pub rays: u64,
    /// What the walks counted.
    pub walk: Counts,
    /// Bricks in the cut; 0 when everything is.
    pub cut_bricks: u64,
    /// Bytes of the cut.
    pub cut_bytes: u64,
    /// Times that the arena was filled again because the cut did not fit.
    pub refills: u64,
    /// Seconds of selection and loading.
    pub select_seconds: f64,
    /// Seconds of tracing and projection.
    pub trace_seconds: f64,
    /// Whether a device traced it, not the CPU.
    pub is_device: bool,
    /// Bytes sent to devices.
    pub device_bytes: u64,
    /// Seconds that the busiest device worked.
    pub device_seconds: f64,
    /// Times that a ray went on in a later dispatch.
    pub resumed: u64,
}

/// Rays of a piece that wait for bricks.
#[derive(Debug)]
struct Suspended {
    piece: usize,
    /// Extinction of every ray so far.
    extinction: Vec<u32>,
    waiting: Vec<Waiting>,
    rays: Vec<u16>,
}

/// What came of a piece.
enum Outcome {
    /// Coefficients of its points, one after the other.
    Done(Vec<f32>),
    /// Some rays wait.
    Waits(Suspended),
}

/// Memory of a worker thread.
#[derive(Debug, Default)]
struct Worker {
    bundle: Bundle,
    scratch: Scratch,
}

/// The spherical tracer: an arena and the threads' memory.
#[derive(Debug)]
pub struct SphericalTracer {
    arena: Arena,
    options: TraceOptions,
    workers: Vec<Worker>,
    meters_per_unit: f64,
}

impl SphericalTracer {
    /// A tracer over the bricks in `arena`.
    pub fn new(arena: Arena, options: TraceOptions, meters_per_unit: f64) -> Self {
        let workers = (0..options.threads.max(1)).map(|_| Worker::default()).collect();
        Self { arena, options, workers, meters_per_unit }
    }

    /// What the arena counted so far.
    pub fn arena_counts(&self) -> ArenaCounts {
        self.arena.counts
    }

    /// The arena.
    #[cfg(feature = "gpu")]
    pub(super) fn arena_mut(&mut self) -> &mut Arena {
        &mut self.arena
    }

    /// Selects and loads the cut of a batch.
    ///
    /// # Errors
    /// When bricks cannot be read.
    pub(super) fn prepare(&mut self, points: &[Point], shading: &Shading) -> Result<Prepared> {
        Prepared::new(points, shading, &mut self.arena, &self.options, self.meters_per_unit)
    }

    /// Traces a batch and writes `shading.values()` numbers per point to `out`, in the points' order.
    ///
    /// # Errors
    /// When bricks cannot be read, or [`ErrorKind::Cancelled`] as soon as `cancel` is set.
    pub fn trace(
        &mut self,
        points: &[Point],
        shading: &Shading,
        cancel: &AtomicBool,
        out: &mut [f32],
    ) -> Result<BatchCounts> {
        let start = std::time::Instant::now();
        let Prepared { setup, cut, is_resident, seconds, .. } = self.prepare(points, shading)?;
        let mut counts = BatchCounts {
            rays: points.len() as u64 * u64::from(shading.shader.samples),
            cut_bricks: cut.bricks.len() as u64,
            cut_bytes: cut.bytes,
            select_seconds: seconds,
            ..BatchCounts::default()
        };
        let root = Start { brick: self.arena.map().root(), entrance: None };
        let job = Job { points, shading, setup, root, instructions: self.options.instructions, cancel };
        self.run(&job, is_resident, &mut counts, out)?;
        counts.trace_seconds = start.elapsed().as_secs_f64() - counts.select_seconds;
        Ok(counts)
    }

    /// Walks all pieces to their ends, in as many rounds as the arena's size asks for.
    fn run(
        &mut self,
        job: &Job<'_>,
        resident: bool,
        counts: &mut BatchCounts,
        out: &mut [f32],
    ) -> Result<()> {
        let values_each = job.shading.values();
        out.fill(0.0);
        // Parts of one point are added up in their order at the end
        let mut partial: Vec<(usize, Vec<f32>)> = Vec::new();
        let mut suspended: Vec<Suspended> = Vec::new();
        let mut fresh = 0..job.setup.pieces.len();
        while !fresh.is_empty() || !suspended.is_empty() {
            let waiting: usize = suspended.iter().map(|s| 2 * s.rays.len() + 4 * s.extinction.len()).sum();
            let admitted = match (resident, waiting < WAITING_BYTES_MAX) {
                (true, _) => fresh.len(),
                (false, true) => fresh.len().min(16 * self.workers.len()),
                (false, false) => 0,
            };
            let begun = fresh.start..fresh.start + admitted;
            fresh.start = begun.end;
            let old = std::mem::take(&mut suspended);
            for outcome in self.round(job, old, begun)? {
                match outcome {
                    (piece, Outcome::Done(values)) => {
                        let Piece { points, samples } = &job.setup.pieces[piece];
                        if samples.len() == job.shading.shader.samples as usize {
                            out[points.start * values_each..points.end * values_each]
                                .copy_from_slice(&values);
                        } else {
                            partial.push((piece, values));
                        }
                    }
                    (_, Outcome::Waits(piece)) => suspended.push(piece),
                }
            }
            if !suspended.is_empty() {
                self.refill(&suspended)?;
                counts.refills += 1;
            }
        }
        partial.sort_unstable_by_key(|(piece, _)| *piece);
        for (piece, values) in partial {
            let at = job.setup.pieces[piece].points.start * values_each;
            out[at..at + values_each].iter_mut().zip(values).for_each(|(out, value)| *out += value);
        }
        for worker in &mut self.workers {
            counts.walk += std::mem::take(&mut worker.scratch.counts);
        }
        Ok(())
    }

    /// One pass of all threads over suspended and new pieces.
    fn round(
        &mut self,
        job: &Job<'_>,
        suspended: Vec<Suspended>,
        fresh: Range<usize>,
    ) -> Result<Vec<(usize, Outcome)>> {
        let next = AtomicUsize::new(0);
        let total = suspended.len() + fresh.len();
        let suspended: Vec<_> = suspended.into_iter().map(|s| std::sync::Mutex::new(Some(s))).collect();
        let arena = &self.arena;
        let work = |worker: &mut Worker| {
            let mut outcomes = Vec::new();
            while !job.cancel.load(Ordering::Relaxed) {
                let item = next.fetch_add(1, Ordering::Relaxed);
                if item >= total {
                    break;
                }
                let old = suspended.get(item).and_then(|s| s.lock().ok()?.take());
                let piece = old.as_ref().map_or_else(|| fresh.start + item - suspended.len(), |s| s.piece);
                outcomes.push((piece, job.advance(piece, old, arena, worker)));
            }
            outcomes
        };
        let outcomes = if self.workers.len() == 1 {
            work(&mut self.workers[0])
        } else {
            std::thread::scope(|scope| {
                let handles: Vec<_> =
                    self.workers.iter_mut().map(|worker| scope.spawn(|| work(worker))).collect();
                handles
                    .into_iter()
                    .flat_map(|handle| handle.join().expect("a tracing thread panicked"))
                    .collect()
            })
        };
        if job.cancel.load(Ordering::Relaxed) {
            return Err(Error::new(ErrorKind::Cancelled, "the bake was cancelled"));
        }
        Ok(outcomes)
    }

    /// Fills the arena with bricks that rays wait for, in brick order as far as they fit.
    fn refill(&mut self, suspended: &[Suspended]) -> Result<()> {
        load_waiting(&mut self.arena, suspended.iter().flat_map(|s| s.waiting.iter().map(|w| w.start.brick)))
    }
}

/// Fills the arena with bricks that rays wait for, in brick order as far as they fit; at least one.
///
/// # Errors
/// [`ErrorKind::Limit`] when not even one fits; when bricks cannot be read.
pub(super) fn load_waiting(arena: &mut Arena, bricks: impl Iterator<Item = u32>) -> Result<()> {
    let mut wanted: Vec<u32> = bricks.collect();
    wanted.sort_unstable();
    wanted.dedup();
    arena.release();
    if arena.load(&wanted)? == 0 {
        return Err(
            Error::new(ErrorKind::Limit, "the arena cannot hold a single brick").hint("raise `--memory`")
        );
    }
    Ok(())
}

/// A batch being traced: what all threads read.
struct Job<'a> {
    points: &'a [Point],
    shading: &'a Shading,
    setup: Setup,
    root: Start,
    instructions: InstructionSet,
    cancel: &'a AtomicBool,
}

impl Job<'_> {
    /// Walks a piece on until all its rays have ended, left, or wait.
    fn advance(&self, piece: usize, old: Option<Suspended>, arena: &Arena, worker: &mut Worker) -> Outcome {
        let Worker { bundle, scratch } = worker;
        self.make_rays(&self.setup.pieces[piece], bundle);
        scratch.waiting.clear();
        scratch.waiting_rays.clear();
        match old {
            None => {
                let rays: [u16; RAYS_MAX] = std::array::from_fn(|ray| ray as u16);
                let rays = &rays[..bundle.len()];
                walk(arena, &self.root, rays, self.setup.open2, bundle, scratch, self.instructions);
            }
            Some(old) => {
                for (ray, &extinction) in old.extinction.iter().enumerate() {
                    bundle.extinguish(ray as u16, extinction);
                }
                for Waiting { start, first, count } in old.waiting {
                    let rays = &old.rays[first as usize..(first + count) as usize];
                    walk(arena, &start, rays, self.setup.open2, bundle, scratch, self.instructions);
                }
            }
        }
        if scratch.waiting.is_empty() {
            return Outcome::Done(self.project(&self.setup.pieces[piece], bundle));
        }
        Outcome::Waits(Suspended {
            piece,
            extinction: bundle.extinction.clone(),
            waiting: scratch.waiting.clone(),
            rays: scratch.waiting_rays.clone(),
        })
    }

    /// Fills the bundle with a piece's rays.
    fn make_rays(&self, piece: &Piece, bundle: &mut Bundle) {
        bundle.clear(self.setup.reach, self.setup.near);
        for point in piece.points.clone() {
            let Point { index, normal, .. } = self.points[point];
            bundle.push_rounded_origin(self.setup.origins[point], self.setup.exact[point]);
            let (normal, spread) = self.shading.spread(normal);
            self.shading.sampler.push_rays(index, normal, spread, piece.samples.clone(), bundle);
        }
    }

    /// The numbers of a piece's points.
    fn project(&self, piece: &Piece, bundle: &Bundle) -> Vec<f32> {
        let mut values = vec![0.0; piece.points.len() * self.shading.values()];
        let each = piece.samples.len();
        for (i, out) in values.chunks_exact_mut(self.shading.values()).enumerate() {
            let (_, spread) = self.shading.spread(self.points[piece.points.start + i].normal);
            let bands = self.shading.shader.bands as usize;
            let (out, halves) = out.split_at_mut(self.shading.coefficients());
            let (rays, sampler) = (i * each..(i + 1) * each, &self.shading.sampler);
            project(bundle, rays.clone(), sampler, spread, bands, out);
            if self.shading.has_halves {
                project_halves(bundle, rays, sampler, spread, bands, halves);
            }
        }
        values
    }
}

// Threads share the arena while it is not changed
const _: fn() = || {
    fn shared<T: Sync>() {}
    shared::<Arena>();
    fn bricks<T: Bricks>() {}
    bricks::<Arena>();
};
