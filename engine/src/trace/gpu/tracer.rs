//! A batch from its cut to its coefficients on one or more devices, and on the CPU where they fail.
//!
//! While a device traces one batch, the next one's cut is selected and loaded into the arena: the device reads its own copy,
//! which is brought up to date between batches.

use std::ops::Range;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use super::adapter::PAGE_BYTES_MAX;
use super::device::Gpu;
use super::mirror::Mirror;
use super::points::{PointRecords, batch_record};
use super::records::ItemRecord;
use super::runner::{Outcome, Run, Runner};
use crate::batch::Point;
use crate::cut::Arena;
use crate::cut::arena::{ArenaCounts, Changes};
use crate::scene::ShOcclusion;
use crate::trace::setup::{Prepared, Setup, Shading};
use crate::trace::stream::{BatchCounts, SphericalTracer, load_waiting};
use crate::{Error, ErrorKind, Result};

/// Points that are begun at once when the cut is larger than the arena.
const POINTS_AT_ONCE: u32 = 256;

/// A device with its copy of the arena.
#[derive(Debug)]
struct Lane {
    gpu: Gpu,
    mirror: Mirror,
    runner: Runner,
    /// What the arena has changed and the mirror has not.
    changes: Changes,
}

impl Lane {
    fn new(gpu: Gpu, arena: &mut Arena, page_bytes_max: u64) -> Result<Self> {
        let mirror = Mirror::new(&gpu, arena, page_bytes_max)?;
        let runner = Runner::new(&gpu, &mirror)?;
        arena.track_changes();
        Ok(Self { gpu, mirror, runner, changes: arena.take_changes() })
    }

    /// Keeps changes until the mirror is brought up to date.
    fn note(&mut self, changes: &Changes) {
        self.changes.lines.extend_from_slice(&changes.lines);
        self.changes.places.extend_from_slice(&changes.places);
    }
}

/// A batch selected and loaded before its turn.
#[derive(Debug)]
struct Ahead {
    batch: BatchIdentity,
    prepared: Prepared,
}

/// Enough to know a batch again: the index of its first point, its points, its shader.
#[derive(Debug, PartialEq)]
struct BatchIdentity {
    first: Option<u64>,
    points: usize,
    shader: ShOcclusion,
}

impl BatchIdentity {
    fn new(points: &[Point], shading: &Shading) -> Self {
        let first = points.first().map(|point| point.index);
        Self { first, points: points.len(), shader: shading.shader.clone() }
    }
}

/// The spherical tracer on GPUs.
#[derive(Debug)]
pub struct GpuTracer {
    /// Owns the arena, and traces what devices cannot.
    cpu: SphericalTracer,
    lanes: Vec<Lane>,
    wide: bool,
    page_bytes_max: u64,
    prepared: Option<Ahead>,
    /// Why batches were traced by the CPU or again, the last of each kind.
    pub troubles: Vec<String>,
}

impl GpuTracer {
    /// A tracer on opened devices, which share every batch. `cpu` has the arena.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when a device has too little memory or its driver refuses.
    pub fn new(cpu: SphericalTracer, gpus: Vec<Gpu>) -> Result<Self> {
        Self::with_pages(cpu, gpus, PAGE_BYTES_MAX)
    }

    /// [`new`](Self::new) with arena pages of at most so many bytes, a power of two of at least 64 KiB.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn with_pages(mut cpu: SphericalTracer, gpus: Vec<Gpu>, page_bytes_max: u64) -> Result<Self> {
        let wide = gpus.iter().all(|gpu| gpu.dialect.wide);
        let lanes: Vec<Lane> = gpus
            .into_iter()
            .map(|gpu| Lane::new(gpu, cpu.arena_mut(), page_bytes_max))
            .collect::<Result<_>>()?;
        Ok(Self { cpu, lanes, wide, page_bytes_max, prepared: None, troubles: Vec::new() })
    }

    /// What the arena counted so far.
    pub fn arena_counts(&self) -> ArenaCounts {
        self.cpu.arena_counts()
    }

    /// The devices' names.
    pub fn name(&self) -> String {
        self.lanes.iter().map(|lane| lane.gpu.adapter.name.as_str()).collect::<Vec<_>>().join(" + ")
    }

    /// The first device. For tests.
    pub fn gpu(&self) -> Option<&Gpu> {
        self.lanes.first().map(|lane| &lane.gpu)
    }

    /// What runs on the first device. For tests.
    pub fn runner(&mut self) -> Option<&mut Runner> {
        self.lanes.first_mut().map(|lane| &mut lane.runner)
    }

    /// Extinctions of the last batch's rays on the first device. For tests.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the device fails.
    pub fn extinctions(&self, rays: u64) -> Result<Vec<u32>> {
        self.lanes.first().map_or(Ok(Vec::new()), |lane| lane.runner.extinctions(&lane.gpu, rays))
    }

    /// Traces a batch as [`SphericalTracer::trace`] does; `next` is the batch that comes after it, whose cut is loaded
    /// meanwhile. A device that fails is opened anew once; then the CPU traces. No batch is accepted that is not complete.
    ///
    /// # Errors
    /// As [`SphericalTracer::trace`].
    pub fn trace(
        &mut self,
        points: &[Point],
        shading: &Shading,
        next: Option<(&[Point], &Shading)>,
        cancel: &AtomicBool,
        out: &mut [f32],
    ) -> Result<BatchCounts> {
        for is_second in [false, true] {
            // Devices do not project halves
            if self.lanes.is_empty() || shading.has_halves {
                break;
            }
            match self.attempt(points, shading, next, cancel, out) {
                Ok(Some(counts)) => return Ok(counts),
                Ok(None) => {
                    self.note("a batch came back incomplete and was traced by the CPU".into());
                    break;
                }
                Err(error) if error.kind() == ErrorKind::Device => {
                    self.note(format!("{error}; its batch was traced again"));
                    self.prepared = None;
                    self.reopen(is_second);
                }
                Err(error) => return Err(error),
            }
        }
        self.prepared = None;
        self.cpu.trace(points, shading, cancel, out)
    }

    fn note(&mut self, trouble: String) {
        tracing::warn!("{trouble}");
        if !self.troubles.contains(&trouble) && self.troubles.len() < 16 {
            self.troubles.push(trouble);
        }
    }

    /// Opens the devices anew; gives those up that cannot be, and all if `is_hopeless`.
    fn reopen(&mut self, is_hopeless: bool) {
        let mut troubles = Vec::new();
        for lane in std::mem::take(&mut self.lanes) {
            let adapter = lane.gpu.adapter.clone();
            // Its memory goes before new memory is asked for
            drop(lane);
            if is_hopeless {
                troubles.push(format!("`{}` was given up", adapter.name));
                continue;
            }
            let opened = Gpu::open(&adapter, self.wide)
                .and_then(|gpu| Lane::new(gpu, self.cpu.arena_mut(), self.page_bytes_max));
            match opened {
                Ok(lane) => self.lanes.push(lane),
                Err(error) => troubles.push(format!("{error}: given up")),
            }
        }
        if self.lanes.is_empty() {
            self.cpu.arena_mut().forget_changes();
        }
        troubles.into_iter().for_each(|trouble| self.note(trouble));
    }

    /// Traces a batch on the devices; none if it is not complete.
    fn attempt(
        &mut self,
        points: &[Point],
        shading: &Shading,
        next: Option<(&[Point], &Shading)>,
        cancel: &AtomicBool,
        out: &mut [f32],
    ) -> Result<Option<BatchCounts>> {
        let start = Instant::now();
        let prepared = match self.prepared.take() {
            Some(ahead) if ahead.batch == BatchIdentity::new(points, shading) => ahead.prepared,
            _ => self.cpu.prepare(points, shading)?,
        };
        let sent_before: u64 = self.lanes.iter().map(|lane| lane.mirror.sent_bytes).sum();
        self.update();
        let Prepared { setup, cut, is_resident, seconds: select_seconds, .. } = prepared;
        let root = self.cpu.arena_mut().map().root();
        let mut following = None;
        let outcomes = if is_resident {
            let prepare = || {
                following = next.map(|(points, shading)| {
                    let batch = BatchIdentity::new(points, shading);
                    Ok(Ahead { batch, prepared: self.cpu.prepare(points, shading)? })
                });
            };
            share(&mut self.lanes, points, shading, &setup, root, cancel, prepare)?
        } else {
            // Rays wait for bricks: one device, since what is loaded for it is not there for others
            vec![(0..points.len(), self.run_with_refills(points, shading, &setup, root, cancel)?)]
        };
        self.prepared = following.transpose()?;

        // Accept what is complete
        let coefficients = shading.coefficients();
        let mut counts = BatchCounts {
            rays: points.len() as u64 * u64::from(shading.shader.samples),
            cut_bricks: cut.bricks.len() as u64,
            cut_bytes: cut.bytes,
            select_seconds,
            is_device: true,
            ..BatchCounts::default()
        };
        for (range, outcome) in &outcomes {
            if !outcome.is_complete(range.len()) {
                return Ok(None);
            }
            out[range.start * coefficients..range.end * coefficients].copy_from_slice(&outcome.coefficients);
            counts.walk.nodes += outcome.nodes;
            counts.walk.leaves += outcome.leaf_rays;
            counts.device_bytes += outcome.sent_bytes;
            counts.device_seconds = counts.device_seconds.max(outcome.seconds);
            counts.resumed += outcome.resumed;
        }
        (counts.walk.node_rays, counts.walk.leaf_rays) = (counts.walk.nodes, counts.walk.leaves);
        let sent: u64 = self.lanes.iter().map(|lane| lane.mirror.sent_bytes).sum();
        counts.device_bytes += sent - sent_before;
        counts.trace_seconds = start.elapsed().as_secs_f64();
        Ok(Some(counts))
    }

    /// Traces a batch whose cut is larger than the arena on the first device.
    fn run_with_refills(
        &mut self,
        points: &[Point],
        shading: &Shading,
        setup: &Setup,
        root: u32,
        cancel: &AtomicBool,
    ) -> Result<Outcome> {
        let Self { cpu, lanes, .. } = self;
        let Some((Lane { gpu, mirror, runner, .. }, others)) = lanes.split_first_mut() else {
            return Ok(Outcome::default());
        };
        let records = PointRecords::new(points, shading, setup, 0..setup.pieces.len());
        let run = Run {
            record: batch_record(shading, setup, root, points.len() as u32),
            points: &records,
            sampler: &shading.sampler,
            points_at_once: POINTS_AT_ONCE,
            cancel,
        };
        let arena = cpu.arena_mut();
        let mut refill = |gpu: &Gpu, mirror: &mut Mirror, items: &[ItemRecord]| {
            load_waiting(arena, items.iter().map(|item| item.line))?;
            let changes = arena.take_changes();
            mirror.update(gpu, arena, &changes);
            others.iter_mut().for_each(|lane| lane.note(&changes));
            Ok(())
        };
        runner.run(gpu, mirror, &run, &mut refill, &mut || {})
    }

    /// Brings the devices' copies up to date.
    fn update(&mut self) {
        let arena = self.cpu.arena_mut();
        let changes = arena.take_changes();
        for lane in &mut self.lanes {
            lane.note(&changes);
            lane.mirror.update(&lane.gpu, arena, &std::mem::take(&mut lane.changes));
        }
    }
}

/// Traces a batch whose cut is in memory on all devices, each its share of the points.
fn share(
    lanes: &mut [Lane],
    points: &[Point],
    shading: &Shading,
    setup: &Setup,
    root: u32,
    cancel: &AtomicBool,
    mut meanwhile: impl FnMut() + Send,
) -> Result<Vec<(Range<usize>, Outcome)>> {
    let work = |lane: &mut Lane, pieces: Range<usize>, meanwhile: &mut dyn FnMut()| {
        let range = setup.pieces[pieces.start].points.start..setup.pieces[pieces.end - 1].points.end;
        let records = PointRecords::new(points, shading, setup, pieces);
        let run = Run {
            record: batch_record(shading, setup, root, range.len() as u32),
            points: &records,
            sampler: &shading.sampler,
            points_at_once: u32::MAX,
            cancel,
        };
        let mut refill = |_: &Gpu, _: &mut Mirror, _: &[ItemRecord]| {
            Err(Error::new(ErrorKind::Device, "a device lost track of the bricks in its memory"))
        };
        let outcome = lane.runner.run(&lane.gpu, &mut lane.mirror, &run, &mut refill, meanwhile)?;
        Ok((range, outcome))
    };
    let parts = halves(setup, lanes.len());
    if let ([lane], [all]) = (&mut *lanes, &parts[..]) {
        return Ok(vec![work(lane, all.clone(), &mut meanwhile)?]);
    }
    std::thread::scope(|scope| {
        let work = &work;
        let handles: Vec<_> = lanes
            .iter_mut()
            .zip(parts)
            .map(|(lane, part)| scope.spawn(move || work(lane, part, &mut || {})))
            .collect();
        meanwhile();
        handles.into_iter().map(|handle| handle.join().expect("a thread of a device panicked")).collect()
    })
}

/// Cuts the pieces of a batch in half again and again, until there is a part for each of `count` devices or nothing more to
/// cut. Points are in the order of a Hilbert curve, so each part lies together, as by a median split.
fn halves(setup: &Setup, count: usize) -> Vec<Range<usize>> {
    let pieces = &setup.pieces;
    // All pieces of one point stay together
    let whole =
        |piece: usize| (piece..pieces.len()).find(|&p| pieces[p].samples.start == 0).unwrap_or(pieces.len());
    let mut parts = vec![0..pieces.len()];
    while parts.len() < count {
        let (largest, part) =
            parts.iter().cloned().enumerate().max_by_key(|(_, part)| part.len()).expect("there is a part");
        let middle = whole(part.start + part.len() / 2);
        if middle <= part.start || middle >= part.end {
            break;
        }
        parts.splice(largest..=largest, [part.start..middle, middle..part.end]);
    }
    parts
}
