//! What fake workers were given and told, remembered by them all: the other side of the coordinator's books.

use std::collections::{HashMap, HashSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use protocol::PassKind;
use protocol::work::{Claim, CompleteItem, Outcome, Verdict};

/// Contradictions that are written down at most.
const PROBLEMS_MAX: usize = 20;

/// How near a claim was to what its worker had in memory, by the worker's own account.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Near {
    /// A segment that it has in memory.
    Warm,
    /// Next to one.
    Adjacent,
    /// Neither.
    Cold,
}

/// A claim of a bake.
#[derive(Clone, Debug)]
pub struct Claimed {
    /// Seconds since the stage was set.
    pub at: f64,
    /// The worker's number.
    pub worker: usize,
    /// The job's load.
    pub load: u64,
    /// Batches.
    pub batches: usize,
    /// How near it was.
    pub near: Near,
}

/// Time that a worker spent on a job.
#[derive(Clone, Copy, Debug)]
pub struct Spent {
    /// Seconds since the stage was set, when it began.
    pub from: f64,
    /// When it ended.
    pub to: f64,
    /// The worker's number.
    pub worker: usize,
    /// The job's load.
    pub load: u64,
}

/// A result that counts.
#[derive(Clone, Copy, Debug)]
pub struct Accepted {
    /// Seconds since the stage was set.
    pub at: f64,
    /// The job's load.
    pub load: u64,
    /// How many batches.
    pub batches: usize,
}

/// A heartbeat that was answered.
#[derive(Clone, Copy, Debug)]
pub struct Beat {
    /// Seconds since the stage was set, when the answer came.
    pub at: f64,
    /// The worker's number.
    pub worker: usize,
    /// How long it took.
    pub seconds: f64,
}

/// What was seen.
#[derive(Debug, Default)]
pub struct Seen {
    /// Claims of bakes.
    pub claims: Vec<Claimed>,
    /// Time spent on bakes.
    pub spent: Vec<Spent>,
    /// Results that count.
    pub accepted: Vec<Accepted>,
    /// How often each verdict came.
    pub verdicts: HashMap<Verdict, u64>,
    /// Failures that were reported of each batch: pass and batch to the workers.
    pub failures: HashMap<(i64, i64), Vec<usize>>,
    /// Seconds that each report took.
    pub complete_s: Vec<f64>,
    /// Heartbeats that were answered.
    pub beats: Vec<Beat>,
    /// Sessions that the coordinator did not know any more.
    pub sessions_lost: u64,
    /// Leases that were called over while they were worked on.
    pub leases_lost: u64,
    /// Contradictions.
    pub problems: Vec<String>,
    fences: HashSet<(i64, i64, i64)>,
    counted: HashMap<(i64, i64), (i64, bool)>,
}

/// What the workers of a stage remember.
#[derive(Debug)]
pub struct Ledger {
    start: Instant,
    seen: Mutex<Seen>,
}

impl Default for Ledger {
    fn default() -> Self {
        Self { start: Instant::now(), seen: Mutex::default() }
    }
}

impl Ledger {
    /// Seconds since the stage was set.
    pub fn now(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    /// What was seen.
    pub fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A claim has come.
    pub fn claimed(&self, worker: usize, claim: &Claim, near: Near) {
        let at = self.now();
        let mut seen = self.seen();
        for batch in &claim.batches {
            if !seen.fences.insert((claim.pass, batch.batch, batch.fence)) {
                let (pass, number, fence) = (claim.pass, batch.batch, batch.fence);
                seen.problem(format!(
                    "batch {number} of pass {pass} was given out twice under fence {fence}"
                ));
            }
        }
        if claim.task.kind == PassKind::Bake {
            let (load, batches) = (claim.task.settings.seed, claim.batches.len());
            seen.claims.push(Claimed { at, worker, load, batches, near });
        }
    }

    /// Verdicts have come.
    pub fn judged(&self, worker: usize, claim: &Claim, items: &[CompleteItem], verdicts: &[Verdict]) {
        let at = self.now();
        let mut seen = self.seen();
        if items.len() != verdicts.len() {
            seen.problem(format!("{} verdicts on {} results", verdicts.len(), items.len()));
        }
        let mut batches = 0;
        for (item, &verdict) in items.iter().zip(verdicts) {
            *seen.verdicts.entry(verdict).or_default() += 1;
            let is_done = matches!(item.outcome, Outcome::Done { .. });
            match verdict {
                Verdict::Accepted if is_done => {
                    batches += 1;
                    seen.counts(claim.pass, item, true);
                }
                Verdict::AlreadyDone => seen.counts(claim.pass, item, false),
                Verdict::Accepted => {
                    seen.failures.entry((claim.pass, item.batch)).or_default().push(worker);
                }
                _ => {}
            }
        }
        if batches > 0 && claim.task.kind == PassKind::Bake {
            seen.accepted.push(Accepted { at, load: claim.task.settings.seed, batches });
        }
    }

    /// Under which fence each result counts: pass and batch to the fence.
    pub fn counted(&self) -> HashMap<(i64, i64), i64> {
        self.seen().counted.iter().map(|(&batch, &(fence, _))| (batch, fence)).collect()
    }
}

impl Seen {
    /// Writes a contradiction down.
    pub fn problem(&mut self, problem: String) {
        if self.problems.len() < PROBLEMS_MAX {
            self.problems.push(problem);
        }
    }

    /// A result counts, now or since an earlier report.
    fn counts(&mut self, pass: i64, item: &CompleteItem, now: bool) {
        let (batch, fence) = (item.batch, item.fence);
        let known = self.counted.entry((pass, batch)).or_insert((fence, false));
        let (other, was_told) = *known;
        known.1 |= now;
        if other != fence {
            self.problem(format!("batch {batch} of pass {pass} counts under the fences {other} and {fence}"));
        } else if was_told && now {
            self.problem(format!("batch {batch} of pass {pass} was counted twice under fence {fence}"));
        }
    }
}
