//! The farm as the coordinator remembers it: jobs with open passes, their segments, the workers. Rebuilt from the
//! database, and kept up to date in between by what this coordinator itself does.

use std::collections::{BTreeMap, HashMap, HashSet};

/// Everything that matters to the next claim.
#[derive(Clone, Debug, Default)]
pub struct Farm {
    /// Jobs with open passes, by id.
    pub jobs: BTreeMap<String, Job>,
    /// Open passes, by id.
    pub passes: BTreeMap<i64, Pass>,
    /// Projects, by name.
    pub projects: HashMap<String, Project>,
    /// Workers, by name.
    pub workers: HashMap<String, Worker>,
    /// The jobs that do not want a worker any more, by worker.
    pub blocks: HashMap<String, HashSet<String>>,
}

/// A project's right to the farm.
#[derive(Clone, Debug)]
pub struct Project {
    /// Its share against those of others.
    pub share: i64,
    /// Batches that it may run at once.
    pub running_max: Option<i64>,
    /// Batches that it runs.
    pub running: i64,
    /// Workers that it has, by their leases.
    pub leases: i64,
}

/// A job with open passes.
#[derive(Clone, Debug)]
pub struct Job {
    /// Its project.
    pub project: String,
    /// From 0 to 100.
    pub priority: i64,
    /// No claims now.
    pub paused: bool,
    /// Batches that it may run at once.
    pub running_max: Option<i64>,
    /// Batches that it runs.
    pub running: i64,
    /// Workers that it has, by their leases.
    pub leases: i64,
    /// Labels that a worker must have.
    pub requires: Vec<String>,
    /// Its open passes.
    pub passes: Vec<i64>,
}

/// An open pass.
#[derive(Clone, Debug)]
pub struct Pass {
    /// Its job.
    pub job: String,
    /// Segments with batches that are ready or leased, by number.
    pub segments: BTreeMap<i64, Segment>,
}

/// A segment with batches that are ready or leased.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Segment {
    /// Batches that can be claimed.
    pub ready: i64,
    /// Who walks it.
    pub owner: Option<String>,
    /// Until when.
    pub owner_until: i64,
    /// Milliseconds of a batch, lately; 0 where none has ended.
    pub batch_ms: i64,
    /// A claim came back empty, or it waits after a failure: not before this time.
    pub not_before: i64,
}

impl Segment {
    /// Whether a claim may find something.
    pub fn is_claimable(&self, now: i64) -> bool {
        self.ready > 0 && self.not_before <= now
    }

    /// Whether somebody else walks it.
    pub fn is_foreign(&self, worker: &str, now: i64) -> bool {
        self.owner_until > now && self.owner.as_deref().is_some_and(|owner| owner != worker)
    }
}

/// A worker.
#[derive(Clone, Debug, Default)]
pub struct Worker {
    /// What it is and has.
    pub labels: Vec<String>,
    /// Memory that it may use.
    pub memory_bytes: i64,
    /// An administrator keeps it from work, or it is sick or draining.
    pub withheld: bool,
    /// When it was last heard of.
    pub last_seen: i64,
}

/// Milliseconds without a sign after which a worker counts as lost.
pub const WORKER_LOST_MS: i64 = 120_000;

impl Worker {
    /// Whether it can work.
    pub fn is_alive(&self, now: i64) -> bool {
        !self.withheld && now - self.last_seen < WORKER_LOST_MS
    }

    /// Whether it has all that a job asks for.
    pub fn has(&self, requires: &[String]) -> bool {
        requires.iter().all(|label| self.labels.contains(label))
    }
}

impl Farm {
    /// Workers that can work.
    pub fn alive(&self, now: i64) -> i64 {
        self.workers.values().filter(|worker| worker.is_alive(now)).count() as i64
    }

    /// Batches that could be claimed, up to a few thousand.
    pub fn claimable(&self, now: i64) -> i64 {
        let segments = self.passes.values().flat_map(|pass| pass.segments.values());
        segments.filter(|segment| segment.is_claimable(now)).map(|segment| segment.ready).take(4096).sum()
    }

    /// A worker has claimed `count` batches; from the head of the segment, it walks it until the time given.
    pub fn claimed(&mut self, pass: i64, segment: i64, owner: Option<(&str, i64)>, count: i64) {
        self.change(pass, segment, -count, count, 1);
        if let (Some((worker, until)), Some(segment)) = (owner, self.segment(pass, segment)) {
            segment.owner = Some(worker.into());
            segment.owner_until = until;
        }
    }

    /// `ended` batches are not leased any more, `ready` of them can be claimed again; their lease may be over.
    pub fn returned(&mut self, pass: i64, segment: i64, ended: i64, ready: i64, is_over: bool) {
        self.change(pass, segment, ready, -ended, -i64::from(is_over));
    }

    /// A claim came back empty.
    pub fn was_empty(&mut self, pass: i64, segment: i64, not_before: i64) {
        if let Some(segment) = self.segment(pass, segment) {
            segment.not_before = segment.not_before.max(not_before);
        }
    }

    fn segment(&mut self, pass: i64, segment: i64) -> Option<&mut Segment> {
        self.passes.get_mut(&pass)?.segments.get_mut(&segment)
    }

    fn change(&mut self, pass: i64, segment: i64, ready: i64, running: i64, leases: i64) {
        if let Some(segment) = self.segment(pass, segment) {
            segment.ready = (segment.ready + ready).max(0);
        }
        let Some(job) = self.passes.get(&pass).and_then(|pass| self.jobs.get_mut(&pass.job)) else { return };
        job.running = (job.running + running).max(0);
        job.leases = (job.leases + leases).max(0);
        if let Some(project) = self.projects.get_mut(&job.project) {
            project.running = (project.running + running).max(0);
            project.leases = (project.leases + leases).max(0);
        }
    }
}
