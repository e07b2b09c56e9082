//! The loops: leases that run out, batches to create or to end, jobs to advance, the farm to look at anew. They run when
//! something has changed; otherwise one question every two seconds asks whether another coordinator changed something.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::{Coordinator, lock};
use crate::Result;
use crate::scheduler::farm::WORKER_LOST_MS;

/// Between two rounds at least.
const ROUND: Duration = Duration::from_millis(100);
/// Between two questions whether something has changed.
const PROBE: Duration = Duration::from_secs(2);
/// Between two looks at the farm while something runs.
const REFRESH: Duration = Duration::from_secs(1);
/// Between two looks for leases that have run out.
const EXPIRE: Duration = Duration::from_secs(1);
/// Between two times that signs of life are written down.
const SEEN: Duration = Duration::from_secs(30);
/// Between two looks for jobs whose step nobody took.
const SWEEP: Duration = Duration::from_secs(30);
/// Jobs that one round advances at most.
const ADVANCE_MAX: usize = 64;

/// When each of the loops was last run.
struct Times {
    refreshed: Instant,
    expired: Instant,
    seen: Instant,
    swept: Instant,
    probed: Instant,
    /// Whether the last round has made batches, after which there may be more to make.
    is_creating: bool,
}

impl Coordinator {
    /// Runs until the coordinator stops.
    pub async fn run(self: Arc<Self>) {
        let now = Instant::now();
        let mut times =
            Times { refreshed: now, expired: now, seen: now, swept: now, probed: now, is_creating: false };
        self.dirty.store(true, Ordering::SeqCst);
        while !self.is_stopping() {
            let more = match self.round(&mut times).await {
                Ok(more) => more,
                Err(error) => {
                    tracing::warn!(%error, "a round of the loops failed; the next follows in a second");
                    tokio::time::sleep(Duration::from_secs(1)).await;
                    true
                }
            };
            let pause = if more { ROUND / 10 } else { ROUND };
            tokio::time::sleep(pause).await;
            if !more {
                let busy = self.read_farm(|farm| !farm.passes.is_empty());
                let rest = if busy { REFRESH - ROUND } else { PROBE - ROUND };
                tokio::select! { () = self.tick.notified() => {}, () = tokio::time::sleep(rest) => {} }
            }
        }
    }

    /// One round; whether more is to be done at once.
    async fn round(&self, times: &mut Times) -> Result<bool> {
        let mut more = false;
        if times.probed.elapsed() >= PROBE {
            times.probed = Instant::now();
            let last = self.store.last_event().await?;
            if self.last_event.swap(last, Ordering::SeqCst) != last {
                self.dirty.store(true, Ordering::SeqCst);
            }
        }
        let dirty = self.dirty.swap(false, Ordering::SeqCst);
        let busy = self.read_farm(|farm| !farm.passes.is_empty());
        if (busy && times.expired.elapsed() >= EXPIRE) || times.expired.elapsed() >= 5 * PROBE {
            times.expired = Instant::now();
            more |= self.expire().await?;
        }
        if times.swept.elapsed() >= SWEEP {
            times.swept = Instant::now();
            self.pend(self.store.live_jobs().await?);
        }
        more |= self.advance_pending().await?;
        if dirty || more || times.is_creating {
            times.is_creating = self.create_and_sweep().await?;
        }
        if dirty || more || (busy && times.refreshed.elapsed() >= REFRESH) {
            times.refreshed = Instant::now();
            self.refresh().await?;
        }
        if times.seen.elapsed() >= SEEN {
            times.seen = Instant::now();
            let seen: Vec<String> = lock(&self.seen).drain().collect();
            self.renew_sessions(self.store.seen(&seen, self.now()).await?);
        }
        Ok(more || times.is_creating)
    }

    async fn expire(&self) -> Result<bool> {
        let ended = self.store.expire(&self.around("")).await?;
        ended.iter().for_each(|completion| self.settled(completion));
        for worker in ended.iter().filter_map(|completion| completion.lost_worker.as_ref()) {
            tracing::warn!(worker, "a worker is lost: its lease ran out");
            lock(&self.seen).remove(worker);
            let last_seen = self.now() - WORKER_LOST_MS;
            self.write_farm(|farm| {
                if let Some(worker) = farm.workers.get_mut(worker) {
                    worker.last_seen = last_seen;
                }
            });
        }
        Ok(!ended.is_empty())
    }

    /// Takes the steps of some jobs that may have one to take.
    async fn advance_pending(&self) -> Result<bool> {
        let jobs: Vec<String> = {
            let mut pending = lock(&self.pending);
            let some: Vec<String> = pending.iter().take(ADVANCE_MAX).cloned().collect();
            pending.retain(|job| !some.contains(job));
            some
        };
        let mut changed = false;
        for job in jobs {
            match self.advance(&job).await {
                Ok(one) => changed |= one,
                Err(error) => {
                    self.pend([job]);
                    return Err(error);
                }
            }
        }
        if changed {
            self.dirty.store(true, Ordering::SeqCst);
        }
        Ok(changed || !lock(&self.pending).is_empty())
    }

    /// Takes the steps of a job, and publishes it when all is there.
    async fn advance(&self, job: &str) -> Result<bool> {
        let mut advance = self.store.advance(job, self.now()).await?;
        if let Some(publication) = advance.publish.take() {
            self.publish(&publication).await?;
            let published = self.store.published(&publication, self.now()).await?;
            self.pend(published.others);
            advance.changed = true;
        }
        self.pend(advance.others);
        Ok(advance.changed)
    }

    async fn create_and_sweep(&self) -> Result<bool> {
        let created = self.store.create_some().await?;
        let more = created.is_some();
        self.pend(created);
        Ok(self.store.sweep_cancelled().await? || more)
    }

    /// Looks at the farm anew, and wakes those for whom there is work.
    pub async fn refresh(&self) -> Result<()> {
        let now = self.now();
        let mut farm = self.store.load_farm(now).await?;
        self.write_farm(|old| {
            // Signs of life and empty claims are known here before the database knows of them
            for (name, worker) in &mut farm.workers {
                if let Some(old) = old.workers.get(name) {
                    worker.last_seen = worker.last_seen.max(old.last_seen);
                }
            }
            for (id, pass) in &mut farm.passes {
                let Some(old) = old.passes.get(id) else { continue };
                for (number, segment) in &mut pass.segments {
                    if let Some(old) = old.segments.get(number).filter(|old| old.not_before > now) {
                        segment.not_before = segment.not_before.max(old.not_before);
                    }
                }
            }
            *old = farm;
        });
        let (claimable, alive) = self.read_farm(|farm| (farm.claimable(now), farm.alive(now)));
        metrics::gauge!("pantaray_workers_alive").set(alive as f64);
        metrics::gauge!("pantaray_claimable_batches").set(claimable as f64);
        metrics::gauge!("pantaray_waiting_workers").set(self.waiting_workers() as f64);
        self.wake_workers(claimable);
        Ok(())
    }

    /// Passes events on to listeners, while there are any.
    pub async fn pass_events_on(self: Arc<Self>) {
        let mut last = self.last_event.load(Ordering::SeqCst);
        while !self.is_stopping() {
            tokio::time::sleep(Duration::from_millis(250)).await;
            if self.events.receiver_count() == 0 {
                last = last.max(self.last_event.load(Ordering::SeqCst));
                continue;
            }
            match self.store.events(last, 500, None).await {
                Ok(events) => {
                    for event in events {
                        last = event.id;
                        // Nobody listening any more is no failure
                        let _ = self.events.send(event);
                    }
                }
                Err(error) => tracing::warn!(%error, "events cannot be read"),
            }
        }
    }
}
