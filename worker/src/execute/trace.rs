//! The bake pass: batches become parts, one after the other, with one tracer for all claims of a pass.

use std::sync::Arc;
use std::time::Instant;

use engine::bake::tracer::BatchTracer;
use engine::bake::work::BakeWork;
use engine::batch::BatchPlan;
use engine::cut::arena::ArenaCounts;
use engine::output::Part;
use protocol::traced::Traced;
use protocol::work::ClaimedBatch;

use super::bricks::RemoteBricks;
use super::inputs::Reads;
use super::{Baked, Executor, PartSink, Work, need};
use crate::Result;
use crate::cache::{Entry, Folder};

/// What traces the batches of a pass, and what it has loaded.
pub(super) struct Bench {
    pass: i64,
    tracer: BatchTracer,
    /// The plan's batches by number of the pass's batch.
    batches: Vec<u32>,
    /// Where bricks come from that are not all on the local disk.
    bricks: Option<Arc<RemoteBricks>>,
    /// Holds the files.
    _folders: [Arc<Folder>; 2],
    used: Vec<(String, Vec<Entry>)>,
}

impl Executor {
    /// Traces the claim's batches, in order, until `sink` has enough.
    pub(super) fn bake(&mut self, work: Work<'_>, sink: &mut dyn PartSink) -> Result<()> {
        let mut bench = match self.bench.take() {
            Some(bench) if bench.pass == work.claim.pass => bench,
            _ => self.set_up(work)?,
        };
        self.used.clone_from(&bench.used);
        if let Some(bricks) = &bench.bricks {
            bricks.ask(work.depot);
            self.blocks = Some(bricks.prefix().into());
        }
        let (mut part, mut bytes) = (Part::default(), Vec::new());
        let claimed = &work.claim.batches;
        for (number, &batch) in claimed.iter().enumerate() {
            let span = tracing::error_span!("batch", batch = batch.batch, fence = batch.fence).entered();
            sink.begins(claimed.len() - number);
            let start = Instant::now();
            bytes.clear();
            let mut totals = BakeWork::default();
            let arena = bench.tracer.arena_counts();
            if let Some(planned) = bench.planned(batch) {
                let next = claimed.get(number + 1).copied();
                let next = next.or_else(|| sink.upcoming(work.claim.pass));
                let next = next.and_then(|next| bench.planned(next));
                bench.tracer.expect(next)?;
                bench.tracer.trace(planned, &mut part, &mut totals, work.control.cancel)?;
                part.encode(bench.tracer.format(), &mut bytes)?;
            }
            let rate = totals.rays as f64 / totals.seconds.max(1e-9) / 1e6;
            let log = format!("traced {} rays in {:.3} s, {rate:.1} M rays/s\n", totals.rays, totals.seconds);
            tracing::debug!("{}", log.trim_end());
            drop(span);
            work.control.progress.update("trace", (number + 1) as f64 / claimed.len() as f64, "");
            let points = if bytes.is_empty() { 0 } else { part.indices.len() };
            let traced = traced(&totals, points, [arena, bench.tracer.arena_counts()]);
            let (elapsed, device) = (start.elapsed(), bench.tracer.device());
            if !sink.part(batch, Baked { bytes: &bytes, elapsed, log: &log, device, traced })? {
                break;
            }
        }
        self.bench = Some(bench);
        Ok(())
    }

    /// Gets everything that the batches of a pass need.
    fn set_up(&mut self, work: Work<'_>) -> Result<Bench> {
        let task = &work.claim.task;
        let prepared = self.prepare(work, Reads::Nothing)?;
        let plan_folder = self.fetch_folder(&**work.depot, need(&task.plan, "plan")?)?;
        let plan = Arc::new(BatchPlan::open(plan_folder.path())?);
        let (map, map_folder, bricks) = self.map(work.depot, need(&task.map, "brick map")?)?;
        let map = Arc::new(map);
        let set = prepared.set(task)?;
        let batches = set.batches(&plan);
        let tracer = set.tracer(plan, map)?;
        let folders = [plan_folder, map_folder];
        let (pass, used) = (work.claim.pass, self.used.clone());
        Ok(Bench { pass, tracer, batches, bricks, _folders: folders, used })
    }
}

/// What tracing one batch took; `arena` is what the arena had done before it and after it.
fn traced(totals: &BakeWork, points: usize, [before, after]: [ArenaCounts; 2]) -> Traced {
    let whole = |count: u64| i64::try_from(count).unwrap_or(i64::MAX);
    // An arena that is made anew begins to count anew
    let added = |of: fn(&ArenaCounts) -> u64| whole(of(&after).saturating_sub(of(&before)));
    let microseconds = |seconds: f64| (1e6 * seconds).round() as i64;
    Traced {
        batches: 1,
        points: whole(points as u64),
        rays: whole(totals.rays),
        trace_us: microseconds(totals.seconds),
        brick_requests: added(|counts| counts.requests),
        brick_misses: added(|counts| counts.misses),
        read_bytes: added(|counts| counts.read_bytes),
        device_bytes: whole(totals.device_bytes()),
        device_us: microseconds(totals.device_seconds()),
    }
}

impl Bench {
    fn planned(&self, batch: ClaimedBatch) -> Option<u32> {
        usize::try_from(batch.batch).ok().and_then(|number| self.batches.get(number).copied())
    }
}
