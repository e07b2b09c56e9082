//! The farm at a glance, as people look at it: what waits and why, what runs and since when, how fast it goes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::job::Counts;
use crate::states::{PassKind, WaitReason};

/// What a live job does at this moment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobNow {
    /// Why nothing more of it runs.
    pub waiting: WaitReason,
    /// Batches of its bake passes that ended within a minute, where that is known.
    pub per_minute: Option<f64>,
    /// Milliseconds until they have all ended, at that pace.
    pub left_ms: Option<i64>,
}

/// How far a live job is: what listeners of events hear twice a second at most, as an event `progress` without a number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobProgress {
    /// The job.
    pub job: String,
    /// Its project.
    pub project: String,
    /// Batches of its bake passes.
    pub batches: Counts,
    /// What it does.
    pub now: JobNow,
}

/// The farm at a glance.
#[derive(Clone, Debug, Default, Serialize, Deserialize, ToSchema)]
pub struct FarmDetail {
    /// Workers by state.
    pub workers: BTreeMap<String, i64>,
    /// Jobs that have something to run, or wait for others.
    pub jobs: i64,
    /// Those jobs by the one reason why nothing more of them runs.
    pub waiting: BTreeMap<String, i64>,
    /// Batches that run.
    pub running: i64,
    /// Batches that wait.
    pub ready: i64,
    /// Projects with what they use.
    pub projects: Vec<ProjectUse>,
}

/// A project with what it uses.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct ProjectUse {
    /// Its name.
    pub name: String,
    /// Its share of the farm, against those of others.
    pub share: i64,
    /// Batches that run at once at most.
    pub running_max: Option<i64>,
    /// Batches that run.
    pub running: i64,
    /// Batches that wait.
    pub ready: i64,
    /// Jobs with something to run.
    pub jobs: i64,
}

/// A lease: batches of one segment that a worker has.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct LeaseDetail {
    /// The job.
    pub job: String,
    /// Its name.
    pub job_name: String,
    /// Its project.
    pub project: String,
    /// The pass.
    pub pass: i64,
    /// What it does.
    pub kind: PassKind,
    /// The bake set or brick map that it is about.
    pub name: String,
    /// The segment.
    pub segment: i64,
    /// Who has it.
    pub worker: String,
    /// Batches that are still to be reported.
    pub batches: i64,
    /// Milliseconds since 1970 when it was claimed.
    pub granted_at: i64,
    /// When it runs out unless its worker is heard of.
    pub expires_at: i64,
    /// Mean milliseconds of a batch of this segment, or else of the pass; 0 where none has ended.
    pub batch_ms: i64,
}

/// What there is to see of a bake pass that is under way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Provisional {
    /// The file's name that the result will have: the bake set and `.mgs`.
    pub name: String,
    /// The pass.
    pub pass: i64,
    /// Batches done.
    pub done: i64,
    /// Batches of the pass.
    pub batches: i64,
    /// Points in the preview, at most those of the batches that are done.
    pub points: u64,
    /// Milliseconds since 1970 when the preview was made; it names the preview.
    pub made_at: i64,
}

/// How many batches of a job's bake passes were done at a moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PaceSample {
    /// Milliseconds since 1970.
    pub at: i64,
    /// Batches done.
    pub done: i64,
}
