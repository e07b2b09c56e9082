//! Dispatches of bounded time: new rays piece by piece, rays that go on until none is left, then the projection.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use wgpu::{BindGroup, Buffer, BufferUsages, ComputePipeline};

use super::device::Gpu;
use super::kernels::Kernels;
use super::mirror::Mirror;
use super::pace::Pace;
use super::points::{LANES, PointRecords, tables};
use super::records::{BatchRecord, COVERAGE_WORDS, ITEMS_HEADER_BYTES, ItemRecord};
use crate::shade::sample::Sampler;
use crate::{Error, ErrorKind, Result};

/// Children that a ray visits in one dispatch. A deep ray takes a few hundred; past this one lane would hold up all.
const STEPS_MAX: u32 = 1 << 14;
/// Items that there is room for at least.
const ITEMS_MIN: u64 = 1 << 16;

/// What a run gave.
#[derive(Debug, Default)]
pub struct Outcome {
    /// bands² a point.
    pub coefficients: Vec<f32>,
    /// Bit i of word i / 32: point i is complete.
    pub coverage: Vec<u32>,
    /// Nodes whose children rays were tested against.
    pub nodes: u64,
    /// Rays tested at leaves.
    pub leaf_rays: u64,
    /// Items that were resumed.
    pub resumed: u64,
    /// Seconds of dispatches.
    pub seconds: f64,
    /// Bytes sent for points.
    pub sent_bytes: u64,
}

impl Outcome {
    /// Adds what the head of a list counted.
    fn count(&mut self, header: &[u32]) {
        self.nodes += u64::from(header[2]);
        self.leaf_rays += u64::from(header[3]);
    }

    /// Whether every one of `points` points is complete.
    pub fn is_complete(&self, points: usize) -> bool {
        (0..points)
            .all(|point| self.coverage.get(point / 32).is_some_and(|word| word >> (point % 32) & 1 != 0))
    }
}

/// The device's memory for a batch, and what runs there.
#[derive(Debug)]
pub struct Runner {
    kernels: Kernels,
    memory: Option<Arc<Memory>>,
    trace_pace: Pace,
    resume_pace: Pace,
    /// Children that a ray visits in one dispatch.
    pub steps_max: u32,
    /// Whether neighbouring lanes trace neighbouring directions; set before the first run.
    pub is_coherent: bool,
    /// Items that there is room for, instead of as many as rays.
    pub items_max: Option<u64>,
}

/// Buffers that fit batches up to some size.
#[derive(Debug)]
struct Memory {
    points: u64,
    rays: u64,
    values: u64,
    items: u64,
    samples: u32,
    record: Buffer,
    point_records: Buffer,
    group_records: Buffer,
    tables: Buffer,
    ray_results: Buffer,
    lists: [Buffer; 2],
    results: Buffer,
    readback: Buffer,
    /// The arena, and the batch with list 0 or 1 as the one that is written.
    bound: [BindGroup; 3],
}

/// Brings bricks that rays wait for; called with the list of waiting items.
pub type Refill<'a> = dyn FnMut(&Gpu, &mut Mirror, &[ItemRecord]) -> Result<()> + 'a;

/// What a run is about.
pub struct Run<'a> {
    /// The batch's numbers.
    pub record: BatchRecord,
    /// Its points.
    pub points: &'a PointRecords,
    /// Makes its rays.
    pub sampler: &'a Sampler,
    /// Points that are begun before those that wait are brought on; all if every brick of the cut is there.
    pub points_at_once: u32,
    /// Ends the run.
    pub cancel: &'a AtomicBool,
}

impl Runner {
    /// Compiles the kernels for a mirror's pages.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the driver refuses.
    pub fn new(gpu: &Gpu, mirror: &Mirror) -> Result<Self> {
        Ok(Self {
            kernels: Kernels::new(gpu, mirror.pages)?,
            memory: None,
            trace_pace: Pace::default(),
            resume_pace: Pace::default(),
            steps_max: STEPS_MAX,
            is_coherent: true,
            items_max: None,
        })
    }

    /// Traces and projects the points. `meanwhile` is called once, when the first dispatch is on its way.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the device fails, [`ErrorKind::Cancelled`] when `run.cancel` is set, what `refill` returns.
    pub fn run(
        &mut self,
        gpu: &Gpu,
        mirror: &mut Mirror,
        run: &Run<'_>,
        refill: &mut Refill<'_>,
        meanwhile: &mut dyn FnMut(),
    ) -> Result<Outcome> {
        let mut outcome = Outcome::default();
        let mut record = run.record;
        self.prepare(gpu, mirror, run, &mut outcome)?;
        let memory = self.memory.clone().expect("just prepared");
        (record.capacity, record.budget) = (memory.items as u32, self.steps_max);

        // New rays, as many at a time as the time allows, and between stops what is left of them
        let all = run.points.points.len() as u32 * record.slices;
        let stop = run.points_at_once.saturating_mul(record.slices).min(all);
        let (mut first, mut started, mut is_told) = (0, Instant::now(), false);
        let mut workgroups = 0;
        while first < all {
            workgroups = self.trace_pace.workgroups().min(stop - first % stop).min(all - first);
            record.first = first;
            started = Instant::now();
            memory.submit(gpu, &self.kernels.trace, &record, workgroups, 0);
            let mut told = started;
            if !std::mem::replace(&mut is_told, true) {
                meanwhile();
                told = Instant::now();
            }
            first += workgroups;
            if first == all {
                break;
            }
            gpu.wait()?;
            outcome.seconds += started.elapsed().as_secs_f64();
            // If the device was done before the other work was, its time is not known
            if told == started || told.elapsed().as_secs_f64() > 1e-3 {
                self.trace_pace.learn(workgroups, started.elapsed());
            }
            check(run.cancel)?;
            if first % stop == 0 {
                self.drain(gpu, mirror, run, refill, &mut record, &mut outcome)?;
            }
        }

        // The projection; again if rays were left
        let mut header = self.project(gpu, run, &mut record, &mut outcome)?;
        outcome.seconds += started.elapsed().as_secs_f64();
        self.trace_pace.learn(workgroups, started.elapsed());
        check(run.cancel)?;
        if header[0] > 0 {
            self.drain(gpu, mirror, run, refill, &mut record, &mut outcome)?;
            header = self.project(gpu, run, &mut record, &mut outcome)?;
        }
        outcome.count(&header);
        Ok(outcome)
    }

    /// Projects all points and fetches the coefficients. Returns the head of the list of items.
    fn project(
        &self,
        gpu: &Gpu,
        run: &Run<'_>,
        record: &mut BatchRecord,
        outcome: &mut Outcome,
    ) -> Result<Vec<u32>> {
        let memory = self.memory.clone().expect("a run has memory");
        memory.clear(gpu, &memory.results, 4 * COVERAGE_WORDS as u64);
        let points = run.points.points.len() as u32;
        for first in (0..points).step_by(32_768) {
            record.first = first;
            memory.submit(gpu, &self.kernels.project, record, (points - first).min(32_768), 0);
        }
        let values = u64::from(points) * u64::from(record.bands * record.bands);
        let result_bytes = 4 * (COVERAGE_WORDS as u64 + values);
        let parts = [(&memory.lists[0], ITEMS_HEADER_BYTES), (&memory.results, result_bytes)];
        let mut header = memory.fetch(gpu, &parts)?;
        let mut words = header.split_off(ITEMS_HEADER_BYTES as usize / 4);
        outcome.coefficients = bytemuck::cast_vec(words.split_off(COVERAGE_WORDS));
        outcome.coverage = words;
        Ok(header)
    }

    /// Resumes what is left of rays until nothing is. New rays leave their items on list 0.
    fn drain(
        &mut self,
        gpu: &Gpu,
        mirror: &mut Mirror,
        run: &Run<'_>,
        refill: &mut Refill<'_>,
        record: &mut BatchRecord,
        outcome: &mut Outcome,
    ) -> Result<()> {
        let memory = self.memory.clone().expect("a run has memory");
        let mut full = 0;
        loop {
            let header = memory.fetch(gpu, &[(&memory.lists[full], ITEMS_HEADER_BYTES)])?;
            outcome.count(&header);
            // Items that found no room are lost; their rays stay incomplete, and so does the batch
            let count = header[0].min(record.capacity);
            if count > 0 && header[1] >= count {
                let bytes = ITEMS_HEADER_BYTES + u64::from(count) * size_of::<ItemRecord>() as u64;
                let words = memory.fetch(gpu, &[(&memory.lists[full], bytes)])?;
                refill(gpu, mirror, bytemuck::cast_slice(&words[ITEMS_HEADER_BYTES as usize / 4..]))?;
            }
            record.items = count;
            let (all, mut first) = (count.div_ceil(LANES), 0);
            while first < all {
                let workgroups = self.resume_pace.workgroups().min(all - first);
                record.first = first;
                let start = Instant::now();
                memory.submit(gpu, &self.kernels.resume, record, workgroups, 1 - full);
                gpu.wait()?;
                self.resume_pace.learn(workgroups, start.elapsed());
                outcome.seconds += start.elapsed().as_secs_f64();
                check(run.cancel)?;
                first += workgroups;
            }
            memory.clear(gpu, &memory.lists[full], ITEMS_HEADER_BYTES);
            if count == 0 {
                return Ok(());
            }
            outcome.resumed += u64::from(count);
            full = 1 - full;
        }
    }

    /// Extinction and limit of every ray of the last run, in the order of points and samples. For tests.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the device fails.
    pub fn extinctions(&self, gpu: &Gpu, rays: u64) -> Result<Vec<u32>> {
        let Some(memory) = &self.memory else { return Ok(Vec::new()) };
        let readback = gpu.readback(8 * rays)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&memory.ray_results, 0, &readback, 0, 8 * rays);
        gpu.queue.submit([encoder.finish()]);
        Ok(gpu.read(&readback, 8 * rays)?.chunks_exact(2).map(|ray| ray[0]).collect())
    }

    /// Sends the points and clears the results; makes memory for them if there is too little.
    fn prepare(&mut self, gpu: &Gpu, mirror: &Mirror, run: &Run<'_>, outcome: &mut Outcome) -> Result<()> {
        let points = run.points.points.len() as u64;
        let rays = points * u64::from(run.record.samples);
        let values = points * u64::from(run.record.bands * run.record.bands);
        let fits = |memory: &Memory| {
            memory.points >= points
                && memory.rays >= rays
                && memory.values >= values
                && memory.samples == run.record.samples
        };
        if !self.memory.as_ref().is_some_and(|memory| fits(memory)) {
            // What there is goes first, so that both need not fit
            let old = self.memory.take().map_or([0; 3], |memory| [memory.points, memory.rays, memory.values]);
            let sizes = [points.max(old[0]), rays.max(old[1]), values.max(old[2])];
            let items = self.items_max.unwrap_or(sizes[1].max(ITEMS_MIN));
            let memory =
                Memory::new(gpu, mirror, &self.kernels, sizes, items, run.sampler, self.is_coherent)?;
            outcome.sent_bytes += memory.tables.size();
            self.memory = Some(Arc::new(memory));
        }
        let memory = self.memory.as_ref().expect("just made");
        let (points, groups): (&[u8], &[u8]) =
            (bytemuck::cast_slice(&run.points.points), bytemuck::cast_slice(&run.points.groups));
        gpu.queue.write_buffer(&memory.point_records, 0, points);
        gpu.queue.write_buffer(&memory.group_records, 0, groups);
        outcome.sent_bytes += (points.len() + groups.len()) as u64;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(&memory.ray_results, 0, Some(8 * rays));
        encoder.clear_buffer(&memory.lists[0], 0, Some(ITEMS_HEADER_BYTES));
        encoder.clear_buffer(&memory.lists[1], 0, Some(ITEMS_HEADER_BYTES));
        gpu.queue.submit([encoder.finish()]);
        Ok(())
    }
}

fn check(cancel: &AtomicBool) -> Result<()> {
    if cancel.load(Ordering::Relaxed) {
        return Err(Error::new(ErrorKind::Cancelled, "the bake was cancelled"));
    }
    Ok(())
}

impl Memory {
    fn new(
        gpu: &Gpu,
        mirror: &Mirror,
        kernels: &Kernels,
        [points, rays, values]: [u64; 3],
        items: u64,
        sampler: &Sampler,
        is_coherent: bool,
    ) -> Result<Self> {
        let storage = |label: &str, bytes: u64| gpu.buffer(label, bytes, BufferUsages::STORAGE);
        let list_bytes = ITEMS_HEADER_BYTES + items * size_of::<ItemRecord>() as u64;
        let result_bytes = 4 * (COVERAGE_WORDS as u64 + values);
        let record = gpu.buffer("record", size_of::<BatchRecord>() as u64, BufferUsages::UNIFORM)?;
        let (point_records, group_records) =
            (storage("points", 48 * points)?, storage("groups", 48 * points)?);
        let words = tables(sampler, is_coherent);
        let tables = storage("tables", 4 * words.len() as u64)?;
        gpu.queue.write_buffer(&tables, 0, bytemuck::cast_slice(&words));
        let ray_results = storage("rays", 8 * rays)?;
        let lists = [storage("items", list_bytes)?, storage("items", list_bytes)?];
        let results = storage("results", result_bytes)?;
        let readback = gpu.readback((ITEMS_HEADER_BYTES + result_bytes).max(list_bytes))?;
        let bind = |written: usize| {
            let list = [&lists[1 - written], &lists[written]];
            kernels.bind_batch(
                gpu,
                &[
                    &record,
                    &mirror.places,
                    &point_records,
                    &group_records,
                    &tables,
                    &ray_results,
                    list[0],
                    list[1],
                    &results,
                ],
            )
        };
        let bound = [kernels.bind_arena(gpu, mirror)?, bind(0)?, bind(1)?];
        let samples = sampler.samples();
        Ok(Self {
            points,
            rays,
            values,
            items,
            samples,
            record,
            point_records,
            group_records,
            tables,
            ray_results,
            lists,
            results,
            readback,
            bound,
        })
    }

    /// Runs a kernel; items go to list `written`.
    fn submit(
        &self,
        gpu: &Gpu,
        pipeline: &ComputePipeline,
        record: &BatchRecord,
        workgroups: u32,
        written: usize,
    ) {
        gpu.queue.write_buffer(&self.record, 0, bytemuck::bytes_of(record));
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &self.bound[0], &[]);
        pass.set_bind_group(1, &self.bound[1 + written], &[]);
        pass.dispatch_workgroups(workgroups, 1, 1);
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
    }

    fn clear(&self, gpu: &Gpu, buffer: &Buffer, bytes: u64) {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(buffer, 0, Some(bytes));
        gpu.queue.submit([encoder.finish()]);
    }

    /// Reads the first bytes of buffers, one after the other, when all work is done.
    fn fetch(&self, gpu: &Gpu, parts: &[(&Buffer, u64)]) -> Result<Vec<u32>> {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut at = 0;
        for &(from, bytes) in parts {
            encoder.copy_buffer_to_buffer(from, 0, &self.readback, at, bytes);
            at += bytes;
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.read(&self.readback, at)
    }
}
