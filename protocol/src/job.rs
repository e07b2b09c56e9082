//! What people and scripts say about jobs, and hear.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::overview::JobNow;
use crate::states::{BatchState, FailureClass, JobState, PassKind, PassState, WaitReason};
use crate::traced::Traced;
use crate::work::PassResult;

/// How to bake, as `pantaray bake` has it; words that only the engine understands are checked when a job is submitted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BakeSettings {
    /// How far bricks are opened: `off`, `paper`, or `footprint[:Q]`; the engine's default if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lod: Option<String>,
    /// What stands in for what is not opened; the engine's default if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub far_field: Option<String>,
    /// Turns every point's rays differently.
    #[serde(default)]
    pub seed: u64,
    /// Rays per point, instead of the shaders' own numbers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub samples: Option<u32>,
    /// Bake whole batches, evenly spaced, up to about this many points of each bake set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_points: Option<u64>,
    /// The frame that patterns in the scene's paths stand for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<i64>,
}

/// A job to be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct JobRequest {
    /// What to call it.
    pub name: String,
    /// The project that it is counted to.
    #[serde(default = "default_project")]
    pub project: String,
    /// The scene, XML. Its files are `files` below, or `root:NAME/path`.
    pub scene: String,
    /// Files beside the scene: relative path to SHA-256 of an uploaded asset.
    #[serde(default)]
    pub files: BTreeMap<String, String>,
    /// How to bake.
    #[serde(default)]
    pub settings: BakeSettings,
    /// From 0 to 100: a job of twice the priority gets twice the chance.
    #[serde(default = "default_priority")]
    pub priority: i64,
    /// Begin paused.
    #[serde(default)]
    pub paused: bool,
    /// Jobs that must have succeeded before.
    #[serde(default)]
    pub depends_on: Vec<String>,
    /// Labels that a worker must have.
    #[serde(default)]
    pub requires: Vec<String>,
    /// Batches to run at once at most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub running_max: Option<i64>,
    /// Batches that may fail before the job is given up.
    #[serde(default)]
    pub failed_max: i64,
    /// Publish what there is when batches have failed or were skipped, marked as incomplete.
    #[serde(default)]
    pub partial: bool,
    /// The show.
    #[serde(default)]
    pub show: String,
    /// The sequence.
    #[serde(default)]
    pub sequence: String,
    /// The shot.
    #[serde(default)]
    pub shot: String,
    /// For people.
    #[serde(default)]
    pub comment: String,
    /// First and last frame of a range: one job for each.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames: Option<(i64, i64)>,
}

fn default_project() -> String {
    "default".into()
}

fn default_priority() -> i64 {
    50
}

/// The jobs that a submission made: one, or one for each frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Submitted {
    /// Their ids.
    pub jobs: Vec<String>,
    /// Whether an earlier request with the same `Idempotency-Key` had made them.
    pub repeated: bool,
}

/// What a scene would ask of the farm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Estimate {
    /// Bake sets.
    pub sets: Vec<SetEstimate>,
    /// Bytes of the files that it reads.
    pub input_bytes: u64,
    /// About how many points of all bake sets, where the inputs say before they are read.
    pub points: Option<u64>,
    /// Batches of all bake sets, likewise.
    pub batches: Option<u64>,
    /// Bytes that are added to the streams, before compression, likewise.
    pub result_bytes: Option<u64>,
    /// Seconds of one worker for the batches, at the pace of the farm's latest bakes, where there were any.
    pub worker_seconds: Option<f64>,
}

/// What a bake set would ask of the farm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SetEstimate {
    /// Its name.
    pub name: String,
    /// About how many points, where known.
    pub points: Option<u64>,
    /// Batches, where known.
    pub batches: Option<u64>,
    /// Bytes that are added to the stream, before compression, where known.
    pub result_bytes: Option<u64>,
}

/// Counts of batches by state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Counts {
    /// Waiting.
    pub ready: i64,
    /// Running.
    pub leased: i64,
    /// Done.
    pub done: i64,
    /// Failed too often.
    pub failed: i64,
    /// Skipped or cancelled.
    pub skipped: i64,
}

impl Counts {
    /// All.
    pub fn total(&self) -> i64 {
        self.ready + self.leased + self.done + self.failed + self.skipped
    }

    /// Batches that have not come to an end.
    pub fn open(&self) -> i64 {
        self.ready + self.leased
    }
}

/// A job as lists have it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobSummary {
    /// Its id; later jobs have greater ids.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Its project.
    pub project: String,
    /// How far it is.
    pub state: JobState,
    /// Whether it is paused.
    pub paused: bool,
    /// Why it is paused, blocked, failed or cancelled.
    pub reason: String,
    /// Its priority.
    pub priority: i64,
    /// Who submitted it.
    pub submitted_by: String,
    /// Show, sequence and shot, with slashes.
    pub shot: String,
    /// The frame, where it is one of a range.
    pub frame: Option<i64>,
    /// For people.
    pub comment: String,
    /// Batches of its bake passes.
    pub batches: Counts,
    /// Milliseconds since 1970 when it was submitted.
    pub created_at: i64,
    /// When something was first claimed.
    pub started_at: Option<i64>,
    /// When it ended.
    pub ended_at: Option<i64>,
    /// Rises with every change.
    pub version: i64,
    /// Whether its batches, parts and scene are gone: it is past its retention, or was deleted.
    #[serde(default)]
    pub pruned: bool,
}

/// A page of jobs, latest first.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct JobPage {
    /// Jobs.
    pub jobs: Vec<JobSummary>,
    /// Jobs of all pages.
    #[serde(default)]
    pub total: i64,
    /// What those of the page do at this moment that have not ended.
    #[serde(default)]
    pub live: BTreeMap<String, JobNow>,
    /// The cursor of the next page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}

/// A job in full.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct JobDetail {
    /// As in lists.
    #[serde(flatten)]
    pub summary: JobSummary,
    /// How it is baked.
    pub settings: BakeSettings,
    /// Jobs that must have succeeded before.
    pub depends_on: Vec<String>,
    /// Labels that a worker must have.
    pub requires: Vec<String>,
    /// The job of which it is an edited copy.
    pub resubmit_of: Option<String>,
    /// Its passes so far.
    pub passes: Vec<PassDetail>,
    /// Why nothing more of it runs.
    pub waiting: WaitReason,
    /// Milliseconds that are left at the present pace, once there is one.
    pub left_ms: Option<i64>,
    /// Milliseconds of one worker for the batches that are left, at the job's pace or else that of the farm's latest bakes.
    pub left_worker_ms: Option<i64>,
}

/// A pass.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct PassDetail {
    /// Its id.
    pub id: i64,
    /// What it does.
    pub kind: PassKind,
    /// The bake set or brick map that it is about.
    pub name: String,
    /// How far it is.
    pub state: PassState,
    /// Its batches.
    pub batches: Counts,
    /// Whether another job's work was used.
    pub reused: bool,
    /// Mean milliseconds of a batch.
    pub batch_ms: i64,
    /// When it was made.
    pub created_at: i64,
    /// When it ended.
    pub ended_at: Option<i64>,
    /// What it found out, such as how many batches and points there are, and of how many bytes its result is.
    #[serde(default)]
    pub result: Option<PassResult>,
    /// What tracing its batches took, where any was traced.
    #[serde(default)]
    pub traced: Option<Traced>,
}

/// A segment of a pass.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct SegmentDetail {
    /// Its number along the curve.
    pub segment: i64,
    /// Its first batch.
    pub first: i64,
    /// One more than its last.
    pub end: i64,
    /// Its batches.
    pub batches: Counts,
    /// Who walks it.
    pub owner: Option<String>,
}

/// A batch.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchDetail {
    /// Its number.
    pub batch: i64,
    /// How far it is.
    pub state: BatchState,
    /// Claims so far.
    pub fence: i64,
    /// Claims that count against it.
    pub tries: i64,
    /// Who has it.
    pub worker: Option<String>,
    /// SHA-256 of its part.
    pub sha256: Option<String>,
}

/// A page of batches.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchPage {
    /// Batches.
    pub batches: Vec<BatchDetail>,
    /// The cursor of the next page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<i64>,
}

/// A failure of a batch on a worker.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct Failure {
    /// The pass.
    pub pass: i64,
    /// The batch.
    pub batch: i64,
    /// Under which claim, the latest.
    pub fence: i64,
    /// On which worker.
    pub worker: String,
    /// Why.
    pub class: FailureClass,
    /// How often.
    pub count: i64,
    /// For people.
    pub message: String,
    /// When.
    pub at: i64,
}

/// Batches to retry or skip.
#[derive(Clone, Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BatchSelection {
    /// The pass; none stands for all of the job.
    #[serde(default)]
    pub pass: Option<i64>,
    /// Batches of that pass; none stands for all that failed.
    #[serde(default)]
    pub batches: Vec<i64>,
}

/// How many batches were changed.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, ToSchema)]
pub struct Changed {
    /// How many.
    pub batches: i64,
}

/// Changes of a job.
#[derive(Clone, Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct JobPatch {
    /// From 0 to 100.
    #[serde(default)]
    pub priority: Option<i64>,
    /// For people.
    #[serde(default)]
    pub comment: Option<String>,
    /// Batches to run at once at most.
    #[serde(default)]
    pub running_max: Option<i64>,
}

/// Edits of a job that is submitted again; what is left out stays.
#[derive(Clone, Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ResubmitRequest {
    /// The name.
    #[serde(default)]
    pub name: Option<String>,
    /// How to bake.
    #[serde(default)]
    pub settings: Option<BakeSettings>,
    /// The priority.
    #[serde(default)]
    pub priority: Option<i64>,
    /// For people.
    #[serde(default)]
    pub comment: Option<String>,
}

/// What a job published: `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Manifest {
    /// The layout's version.
    pub version: u32,
    /// The job.
    pub job: String,
    /// Its name.
    pub name: String,
    /// Whether points lack a result.
    pub incomplete: bool,
    /// The decorated streams.
    pub outputs: Vec<Output>,
}

/// A decorated stream.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Output {
    /// Its file's name: the bake set and `.mgs`.
    pub name: String,
    /// Its key in storage.
    pub key: String,
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    /// Bytes.
    pub bytes: u64,
    /// Points.
    pub points: u64,
    /// Points with a result.
    pub baked: u64,
    /// Whether there is a preview, for the dashboard's viewer.
    #[serde(default)]
    pub preview: bool,
    /// Whether there is a picture.
    #[serde(default)]
    pub picture: bool,
}
