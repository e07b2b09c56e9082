//! The spherical tracer on the CPU: every ray of a batch through the batch's cut, projected as it ends.
//!
//! A batch's points are cut into bundles of a few neighbours ([`crate::brick::bundle`]); threads take bundles from a
//! common queue and walk them through the bricks in the arena with no further I/O. Only when the cut is larger than the
//! arena do rays stop at a brick that is not in memory: they wait, the arena is filled with what most of them wait for next in
//! brick order, and they go on. Neither the number of threads nor the size of the arena changes any bit of the result.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use glam::{IVec3, Vec3};

use crate::batch::Point;
use crate::brick::LatticeBox;
use crate::brick::bundle::{Bundle, POINTS_MAX, RAYS_MAX};
use crate::brick::lanes::InstructionSet;
use crate::brick::walk::{Bricks, Counts, Scratch, Waiting, walk};
use crate::cut::arena::ArenaCounts;
use crate::cut::{Arena, Cut, Lod, select};
use crate::scene::ShOcclusion;
use crate::shade::sample::{Sampler, Spread};
use crate::shade::sh_occlusion::project;
use crate::{Error, ErrorKind, Result};

/// Points of a bundle, unless their rays are too many or they lie too far apart.
const BUNDLE_POINTS: usize = 4;
const _: () = assert!(BUNDLE_POINTS <= POINTS_MAX);

/// Hits nearer than this are tested again in double precision (paper, section 5).
const NEAR_METERS: f64 = 0.001;

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

/// What to compute at a batch's points.
#[derive(Debug)]
pub struct Shading {
    /// The shader's parameters.
    pub shader: ShOcclusion,
    /// Makes the rays.
    sampler: Sampler,
    /// Lattice shift of the geometry that the points lie on.
    shift: u8,
}

impl Shading {
    /// Prepares a shader for the bake set with the given name, whose points lie on a geometry of lattice shift `shift`
    /// (0 if it is no occluder).
    pub fn new(shader: &ShOcclusion, seed: u64, bake_set: &str, shift: u8) -> Self {
        let sampler = Sampler::new(shader.samples, seed, bake_set_hash(bake_set));
        Self { shader: shader.clone(), sampler, shift }
    }

    /// Coefficients of a point.
    pub fn coefficients(&self) -> usize {
        (self.shader.bands * self.shader.bands) as usize
    }
}

/// The hash of a bake set's name that its rays' rotations start from: the low 32 bits of its xxh3.
pub fn bake_set_hash(name: &str) -> u32 {
    xxhash_rust::xxh3::xxh3_64(name.as_bytes()) as u32
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
}

/// A few neighbouring points, or a part of one point's rays.
#[derive(Clone, Debug)]
struct Piece {
    /// Points of the batch.
    points: Range<usize>,
    /// Samples of each point.
    samples: Range<u32>,
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
    cut: Cut,
    meters_per_unit: f64,
}

impl SphericalTracer {
    /// A tracer over the bricks in `arena`.
    pub fn new(arena: Arena, options: TraceOptions, meters_per_unit: f64) -> Self {
        let workers = (0..options.threads.max(1)).map(|_| Worker::default()).collect();
        Self { arena, options, workers, cut: Cut::default(), meters_per_unit }
    }

    /// What the arena counted so far.
    pub fn arena_counts(&self) -> ArenaCounts {
        self.arena.counts
    }

    /// Traces a batch and writes `shading.coefficients()` numbers per point to `out`, in the points' order.
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
        let lattice = self.arena.map().lattice();
        let origins: Vec<IVec3> =
            points.iter().map(|point| lattice.snap(point.position, shading.shift)).collect();
        let mut bounds = LatticeBox::EMPTY;
        origins.iter().for_each(|&origin| bounds.add(origin));
        // A point without a normal samples the sphere with as many rays: its footprint is larger, the cut is the finer one's
        let solid_angle = Spread::new(&shading.shader, points.iter().any(|p| p.normal != Vec3::ZERO))
            .measure(shading.shader.samples);
        let resident =
            select::select(&mut self.arena, &bounds, self.options.lod, solid_angle, &mut self.cut)?;
        let mut counts = BatchCounts {
            rays: points.len() as u64 * u64::from(shading.shader.samples),
            cut_bricks: self.cut.bricks.len() as u64,
            cut_bytes: self.cut.bytes,
            select_seconds: start.elapsed().as_secs_f64(),
            ..BatchCounts::default()
        };
        let job = Job {
            points,
            origins: &origins,
            shading,
            lod_open2: self.options.lod.node_open2(solid_angle),
            pieces: pieces(&origins, &bounds, shading.shader.samples),
            near: (NEAR_METERS / (self.meters_per_unit * lattice.step())) as f32,
            reach: shading.shader.max_distance.map_or(f32::INFINITY, |d| (d / lattice.step()) as f32),
            root: self.arena.map().root(),
            instructions: self.options.instructions,
            cancel,
        };
        self.run(&job, resident, &mut counts, out)?;
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
        let coefficients = job.shading.coefficients();
        out.fill(0.0);
        // Parts of one point are added up in their order at the end
        let mut partial: Vec<(usize, Vec<f32>)> = Vec::new();
        let mut suspended: Vec<Suspended> = Vec::new();
        let mut fresh = 0..job.pieces.len();
        while !fresh.is_empty() || !suspended.is_empty() {
            let waiting: usize = suspended.iter().map(|s| 2 * s.rays.len() + 4 * s.extinction.len()).sum();
            let admitted = match (resident, waiting < WAITING_BYTES_MAX) {
                (true, _) => fresh.len(),
                (false, true) => fresh.len().min(64 * self.workers.len()),
                (false, false) => 0,
            };
            let begun = fresh.start..fresh.start + admitted;
            fresh.start = begun.end;
            let old = std::mem::take(&mut suspended);
            for outcome in self.round(job, old, begun)? {
                match outcome {
                    (piece, Outcome::Done(values)) => {
                        let Piece { points, samples } = &job.pieces[piece];
                        if samples.len() == job.shading.shader.samples as usize {
                            out[points.start * coefficients..points.end * coefficients]
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
            let at = job.pieces[piece].points.start * coefficients;
            out[at..at + coefficients].iter_mut().zip(values).for_each(|(out, value)| *out += value);
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
        let mut wanted: Vec<u32> = suspended.iter().flat_map(|s| s.waiting.iter().map(|w| w.brick)).collect();
        wanted.sort_unstable();
        wanted.dedup();
        self.arena.release();
        if self.arena.load(&wanted)? == 0 {
            return Err(
                Error::new(ErrorKind::Limit, "the arena cannot hold a single brick").hint("raise `--memory`")
            );
        }
        Ok(())
    }
}

/// A batch being traced: what all threads read.
struct Job<'a> {
    points: &'a [Point],
    origins: &'a [IVec3],
    shading: &'a Shading,
    lod_open2: f32,
    pieces: Vec<Piece>,
    near: f32,
    reach: f32,
    root: u32,
    instructions: InstructionSet,
    cancel: &'a AtomicBool,
}

impl Job<'_> {
    /// Walks a piece on until all its rays have ended, left, or wait.
    fn advance(&self, piece: usize, old: Option<Suspended>, arena: &Arena, worker: &mut Worker) -> Outcome {
        let Worker { bundle, scratch } = worker;
        self.make_rays(&self.pieces[piece], bundle);
        scratch.waiting.clear();
        scratch.waiting_rays.clear();
        match old {
            None => {
                let rays: [u16; RAYS_MAX] = std::array::from_fn(|ray| ray as u16);
                let rays = &rays[..bundle.len()];
                walk(arena, self.root, rays, self.lod_open2, bundle, scratch, self.instructions);
            }
            Some(old) => {
                for (ray, &extinction) in old.extinction.iter().enumerate() {
                    bundle.extinguish(ray as u16, extinction);
                }
                for Waiting { brick, first, count } in old.waiting {
                    let rays = &old.rays[first as usize..(first + count) as usize];
                    walk(arena, brick, rays, self.lod_open2, bundle, scratch, self.instructions);
                }
            }
        }
        if scratch.waiting.is_empty() {
            return Outcome::Done(self.project(&self.pieces[piece], bundle));
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
        bundle.clear(self.reach, self.near);
        for point in piece.points.clone() {
            let Point { index, normal, .. } = self.points[point];
            bundle.push_origin(self.origins[point]);
            let (normal, spread) = self.spread(normal);
            self.shading.sampler.push_rays(index, normal, spread, piece.samples.clone(), bundle);
        }
    }

    /// The coefficients of a piece's points.
    fn project(&self, piece: &Piece, bundle: &Bundle) -> Vec<f32> {
        let coefficients = self.shading.coefficients();
        let mut values = vec![0.0; piece.points.len() * coefficients];
        let each = piece.samples.len();
        for (i, out) in values.chunks_exact_mut(coefficients).enumerate() {
            let (_, spread) = self.spread(self.points[piece.points.start + i].normal);
            let bands = self.shading.shader.bands as usize;
            project(bundle, i * each..(i + 1) * each, &self.shading.sampler, spread, bands, out);
        }
        values
    }

    /// The unit normal and the spread of directions of a point.
    fn spread(&self, normal: Vec3) -> (Vec3, Spread) {
        let unit = normal.as_dvec3().normalize_or_zero().as_vec3();
        let has_normal = unit != Vec3::ZERO;
        (if has_normal { unit } else { Vec3::Z }, Spread::new(&self.shading.shader, has_normal))
    }
}

/// Cuts a batch into bundles: neighbours on the curve, as long as they lie close together.
fn pieces(origins: &[IVec3], bounds: &LatticeBox, samples: u32) -> Vec<Piece> {
    let mut pieces = Vec::new();
    if samples as usize > RAYS_MAX {
        for point in 0..origins.len() {
            for first in (0..samples).step_by(RAYS_MAX) {
                let samples = first..samples.min(first + RAYS_MAX as u32);
                pieces.push(Piece { points: point..point + 1, samples });
            }
        }
        return pieces;
    }
    // On a surface, neighbours are about this far apart
    let diagonal = (bounds.max - bounds.min).as_dvec3().length();
    let spacing = diagonal / (origins.len() as f64).sqrt();
    let near2 = (4.0 * spacing) * (4.0 * spacing);
    let points_max = BUNDLE_POINTS.min(RAYS_MAX / samples as usize);
    let mut start = 0;
    for point in 1..=origins.len() {
        let full = point == origins.len() || point - start == points_max || {
            let apart = (origins[point] - origins[start]).as_dvec3();
            apart.length_squared() > near2
        };
        if full {
            pieces.push(Piece { points: start..point, samples: 0..samples });
            start = point;
        }
    }
    pieces
}

// Threads share the arena while it is not changed
const _: fn() = || {
    fn shared<T: Sync>() {}
    shared::<Arena>();
    fn bricks<T: Bricks>() {}
    bricks::<Arena>();
};
