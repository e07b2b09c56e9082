//! Garbage collection: what is past its retention, and what nobody refers to. One coordinator does it at a time, in small
//! slices; each removal is decided by the database at the moment it happens, and one that was cut off is taken up again.

mod jobs;
mod shared;

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::{StreamExt, TryStreamExt};
use object_store::path::Path;
use protocol::gc::{DeletePreview, GcKind, GcReport};
use protocol::{PassKind, keys};

use super::Coordinator;
use crate::db::retention::{Aged, DAY_MS, DueJob};
use crate::error::Kind;
use crate::{Error, Result, random};

/// Between two rounds.
const ROUND: Duration = Duration::from_secs(600);
/// Rounds between two that also look for what was never in the database.
const ORPHAN_ROUNDS: u32 = 144;
/// The longest that one round works.
const ROUND_MAX: Duration = Duration::from_secs(60);
/// Milliseconds for which the one who collects is the only one.
const LEAD_MS: i64 = 60_000;
/// Between two times that this is made sure.
const LEAD_EVERY: Duration = Duration::from_secs(10);
/// A pause after every slice, in which others use database and storage.
const BREATH: Duration = Duration::from_millis(5);
/// Objects that are removed at once.
const REMOVALS: usize = 16;
/// Milliseconds for which what is not referred to may still be read, or come to be referred to.
const GRACE_MS: i64 = 24 * 3_600_000;
/// Days after which a worker that was not heard of is forgotten.
const ABSENT_DAYS: i64 = 30;
/// What the leader does.
const NAME: &str = "gc";

impl Coordinator {
    /// Collects garbage every few minutes until the coordinator stops.
    pub async fn collect_garbage(self: Arc<Self>) {
        let mut round = 0_u32;
        loop {
            let stopped = self.stopped.notified();
            if self.is_stopping() {
                return;
            }
            tokio::select! { () = stopped => return, () = tokio::time::sleep(ROUND) => {} }
            let with_orphans = round.is_multiple_of(ORPHAN_ROUNDS);
            match self.collect(false, with_orphans, ROUND_MAX).await {
                Ok(report) if report.items.is_empty() => {}
                Ok(report) => {
                    tracing::info!(items = ?report.items, more = report.more, "garbage was collected")
                }
                // Another coordinator is at it
                Err(error) if error.kind == Kind::Conflict => {}
                Err(error) => tracing::warn!(%error, "garbage could not be collected"),
            }
            round = round.wrapping_add(1);
        }
    }

    /// Collects garbage, or says what there is, for as long as `time` at most.
    ///
    /// # Errors
    /// [`Kind::Conflict`] while another coordinator collects.
    pub async fn collect(&self, dry_run: bool, with_orphans: bool, time: Duration) -> Result<GcReport> {
        let start = Instant::now();
        let mut collector = Collector::new(self, dry_run, start + time);
        if !dry_run {
            collector.lead().await?;
        }
        let result = collector.all(with_orphans).await;
        if !dry_run {
            self.store.step_down(NAME, &collector.holder).await?;
            metrics::histogram!("pantaray_gc_seconds").record(start.elapsed().as_secs_f64());
        }
        result.map(|()| collector.report)
    }

    /// What would go with a job.
    ///
    /// # Errors
    /// [`Kind::NotFound`].
    pub async fn delete_preview(&self, job: &str, time: Duration) -> Result<DeletePreview> {
        let summary = self.store.job(job).await?;
        let waits = self.store.waits_for(job).await?;
        let refused = match waits.first() {
            _ if !summary.state.is_final() => Some("the job has not ended".to_owned()),
            Some(waits) => Some(format!("the job `{waits}` waits for this one")),
            None => None,
        };
        let mut collector = Collector::new(self, true, Instant::now() + time);
        let all = DueJob {
            id: job.into(),
            work: true,
            logs: true,
            outputs: true,
            whole: true,
            ..DueJob::default()
        };
        collector.job(&all).await?;
        let outputs = self.manifest(job).await?.map(|manifest| manifest.outputs).unwrap_or_default();
        let mut brick_maps = Vec::new();
        for pass in self.store.pass_details(job).await?.iter().filter(|pass| pass.kind == PassKind::Build) {
            if !self.store.has_other_jobs(&pass.name, job).await? {
                brick_maps.push(pass.name.clone());
            }
        }
        let outputs = outputs.into_iter().map(|output| output.name).collect();
        Ok(DeletePreview { job: job.into(), refused, report: collector.report, outputs, brick_maps })
    }
}

/// One collection, or a look at what there is to collect.
struct Collector<'a> {
    coordinator: &'a Coordinator,
    report: GcReport,
    until: Instant,
    /// Who this is among the coordinators.
    holder: String,
    led: Instant,
}

impl<'a> Collector<'a> {
    fn new(coordinator: &'a Coordinator, dry_run: bool, until: Instant) -> Self {
        let report = GcReport { dry_run, ..GcReport::default() };
        let holder = random::id(coordinator.now());
        Self { coordinator, report, until, holder, led: Instant::now() }
    }

    fn is_dry(&self) -> bool {
        self.report.dry_run
    }

    /// Before this time nothing that is unreferred to now was needed.
    fn before(&self) -> i64 {
        self.coordinator.now() - GRACE_MS.max(10 * self.coordinator.settings.lease_ttl_ms)
    }

    /// Is the only one who collects, or stays so.
    async fn lead(&mut self) -> Result<()> {
        self.led = Instant::now();
        let (store, now) = (&self.coordinator.store, self.coordinator.now());
        let is_leader = store.lead(NAME, &self.holder, LEAD_MS, now).await?;
        metrics::gauge!("pantaray_leader", "name" => NAME).set(if is_leader { 1.0 } else { 0.0 });
        match is_leader {
            true => Ok(()),
            false => Err(Error::new(Kind::Conflict, "another coordinator collects garbage now")
                .hint("ask again in a minute")),
        }
    }

    /// Lets others have a moment, and makes sure that there is time left; whether there is.
    async fn goes_on(&mut self) -> Result<bool> {
        if Instant::now() >= self.until || self.coordinator.is_stopping() {
            self.report.more = true;
            return Ok(false);
        }
        if !self.is_dry() {
            tokio::time::sleep(BREATH).await;
            if self.led.elapsed() >= LEAD_EVERY {
                self.lead().await?;
            }
        }
        Ok(true)
    }

    async fn all(&mut self, with_orphans: bool) -> Result<()> {
        self.jobs().await?;
        self.sweep_marked().await?;
        self.maps().await?;
        self.assets().await?;
        if with_orphans || self.is_dry() {
            self.orphans().await?;
        }
        self.old_rows().await
    }

    /// Events, the audit, tickets and workers, by age.
    async fn old_rows(&mut self) -> Result<()> {
        let (store, now) = (&self.coordinator.store, self.coordinator.now());
        let retention = self.coordinator.settings.retention;
        let aged = [
            (Aged::Event, GcKind::Event, retention.event_days),
            (Aged::Audit, GcKind::Audit, retention.audit_days),
        ];
        for (table, kind, days) in aged {
            while self.goes_on().await? {
                let removed = store.remove_aged(table, now - days * DAY_MS, self.is_dry()).await?;
                self.count(kind, removed.unsigned_abs(), 0);
                if removed == 0 || self.is_dry() {
                    break;
                }
            }
        }
        let absent = store.remove_absent(now, now - ABSENT_DAYS * DAY_MS, self.is_dry()).await?;
        self.count(GcKind::Absent, absent.unsigned_abs(), 0);
        Ok(())
    }

    /// Removes the objects below a folder that are to go; whether all of them went before the time was over.
    async fn remove_below(
        &mut self,
        folder: &str,
        kind: GcKind,
        is_to_go: impl Fn(&str) -> bool,
    ) -> Result<bool> {
        let mut objects = self.coordinator.storage.list(folder).try_chunks(256);
        while let Some(objects) = objects.next().await {
            let objects = objects.map_err(|error| error.1)?;
            let going: Vec<(Path, u64)> = objects
                .into_iter()
                .map(|object| (object.location, object.size))
                .filter(|(key, _)| is_to_go(key.as_ref()))
                .collect();
            self.remove(kind, going).await?;
            if !self.goes_on().await? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Removes objects.
    async fn remove(&mut self, kind: GcKind, objects: Vec<(Path, u64)>) -> Result<()> {
        let (count, bytes) = (objects.len() as u64, objects.iter().map(|(_, bytes)| bytes).sum());
        if !self.is_dry() {
            let storage = &self.coordinator.storage;
            let removals = futures_util::stream::iter(objects);
            let removals = removals.map(|(key, _)| async move { storage.remove(&key).await });
            removals.buffer_unordered(REMOVALS).try_collect::<()>().await?;
        }
        self.count(kind, count, bytes);
        Ok(())
    }

    fn count(&mut self, kind: GcKind, count: u64, bytes: u64) {
        self.report.add(kind, count, bytes);
        if !self.is_dry() && count > 0 {
            metrics::counter!("pantaray_gc_deleted_total", "kind" => kind.word()).increment(count);
            metrics::counter!("pantaray_gc_deleted_bytes_total", "kind" => kind.word()).increment(bytes);
        }
    }
}

/// What of a job's folder an object's key is of.
fn is_log(job: &str, key: &str) -> bool {
    key.strip_prefix(&keys::job(job)).is_some_and(|rest| rest.starts_with("/logs/"))
}
