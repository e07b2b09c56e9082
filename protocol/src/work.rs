//! What workers and coordinator say to each other. Leases are durations: the clocks of the two sides never meet.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::job::BakeSettings;
use crate::states::{FailureClass, PassKind};
use crate::traced::Traced;

/// The version of this protocol; a coordinator accepts workers of its own and of the version before.
pub const PROTOCOL_VERSION: u32 = 1;

/// A worker process introduces itself. Leases of an earlier process of the same name end at once.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct RegisterRequest {
    /// The worker's name, unique on the farm.
    pub name: String,
    /// What it is and has, such as `gpu=none` or `room=3`.
    #[serde(default)]
    pub labels: Vec<String>,
    /// Memory that it may use.
    #[serde(default)]
    pub memory_bytes: u64,
    /// The program's version.
    #[serde(default)]
    pub version: String,
    /// The protocol's version.
    pub protocol: u32,
}

/// The worker is known.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct RegisterReply {
    /// Names this process; goes with every request.
    pub session: String,
    /// Milliseconds between heartbeats.
    pub heartbeat_ms: u64,
    /// Milliseconds that a lease lasts without one.
    pub lease_ttl_ms: i64,
}

/// Batches that a worker still has in memory what they need for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Warm {
    /// The pass.
    pub pass: i64,
    /// The segment.
    pub segment: i64,
}

/// A worker asks for work.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct ClaimRequest {
    /// The process.
    pub session: String,
    /// Batches to take at most.
    #[serde(default = "one")]
    pub max: i64,
    /// Milliseconds to wait if there is nothing.
    #[serde(default)]
    pub wait_ms: u64,
    /// What it has in memory, latest first; 8 are looked at.
    #[serde(default)]
    pub warm: Vec<Warm>,
}

fn one() -> i64 {
    1
}

/// A batch and the number under which its result will be accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ClaimedBatch {
    /// The batch's number in the pass.
    pub batch: i64,
    /// Rises at every claim.
    pub fence: i64,
}

/// Work.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct Claim {
    /// The lease.
    pub lease: String,
    /// Milliseconds that it lasts without a heartbeat.
    pub ttl_ms: i64,
    /// The pass.
    pub pass: i64,
    /// What to do.
    pub task: Task,
    /// The segment.
    pub segment: i64,
    /// Which batches.
    pub batches: Vec<ClaimedBatch>,
}

/// What a pass does, the same for all of its batches. Keys are those of [`crate::keys`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Task {
    /// What.
    pub kind: PassKind,
    /// The job.
    pub job: String,
    /// How.
    pub settings: BakeSettings,
    /// The bake set; none for import and build.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set: Option<String>,
    /// The brick map's content key; none for import and plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map: Option<String>,
    /// Where the imported streams are; none for import.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inputs: Option<String>,
    /// Where the plan is; none before bake.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<String>,
    /// The pass whose parts are merged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parts: Option<i64>,
    /// Whether points may lack a result.
    #[serde(default)]
    pub partial: bool,
}

/// Sign of life.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct HeartbeatRequest {
    /// The process.
    pub session: String,
    /// Leases that it works on.
    #[serde(default)]
    pub leases: Vec<LeaseProgress>,
}

/// How far a lease is.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct LeaseProgress {
    /// The lease.
    pub lease: String,
    /// The share of the batch at hand that is done, from 0 to 1.
    #[serde(default)]
    pub progress: f64,
}

/// What the coordinator wants of a worker.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct HeartbeatReply {
    /// Leases that go on, for [`RegisterReply::lease_ttl_ms`] from when the request was sent.
    pub extended: Vec<String>,
    /// Leases that are over: their job was cancelled, or they ran out.
    pub ended: Vec<String>,
    /// Finish what is leased and claim nothing more.
    pub drain: bool,
}

/// Results.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct CompleteRequest {
    /// The process.
    pub session: String,
    /// The pass.
    pub pass: i64,
    /// What traced: `cpu`, or the names of adapters; empty where nothing was traced.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub device: String,
    /// One for each batch, up to 64.
    pub items: Vec<CompleteItem>,
}

/// What became of a batch.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct CompleteItem {
    /// The batch.
    pub batch: i64,
    /// The fence under which it was claimed.
    pub fence: i64,
    /// Milliseconds of work.
    #[serde(default)]
    pub elapsed_ms: i64,
    /// What tracing took, where it was traced.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub traced: Option<Traced>,
    /// What became of it.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// What became of a batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum Outcome {
    /// There is a result.
    Done {
        /// SHA-256 of a part, or of a pass's result, in hexadecimal.
        sha256: String,
        /// Bytes of the part.
        #[serde(default)]
        bytes: i64,
        /// What a pass of one batch found out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        result: Option<PassResult>,
    },
    /// There is none.
    Failed {
        /// Why: decides what happens next.
        class: FailureClass,
        /// For people.
        message: String,
        /// Parts that a merge found damaged: their batches are baked again.
        #[serde(default)]
        bad_parts: Vec<ClaimedBatch>,
    },
}

/// What a pass of one batch found out, and the coordinator needs to go on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "pass", rename_all = "snake_case")]
pub enum PassResult {
    /// The scene is imported.
    Import {
        /// Its bake sets and the brick maps that they need.
        sets: Vec<SetMap>,
    },
    /// The brick map is there.
    Build {
        /// Bricks.
        bricks: u64,
        /// Bytes.
        bytes: u64,
        /// Micropolygons.
        micropolygons: u64,
    },
    /// The batches are planned.
    Plan {
        /// How many.
        batches: i64,
        /// Their points.
        points: u64,
    },
    /// The decorated stream is there.
    Merge {
        /// Points of the stream.
        points: u64,
        /// Points with a result.
        baked: u64,
        /// Bytes of the file.
        bytes: u64,
        /// Whether a preview lies beside it.
        #[serde(default)]
        preview: bool,
        /// Whether a picture lies beside it.
        #[serde(default)]
        picture: bool,
    },
}

/// A bake set and the content key of the brick map that it needs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SetMap {
    /// The bake set.
    pub set: String,
    /// The brick map.
    pub map: String,
}

/// What the coordinator made of a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// It counts.
    Accepted,
    /// It counted before: the answer to the first request was lost.
    AlreadyDone,
    /// The batch was claimed again since, or its lease ran out: the result is not used.
    Superseded,
    /// The job was cancelled.
    Cancelled,
    /// The result cannot be one of this batch.
    Rejected,
}

/// Verdicts, in the order of the items.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CompleteReply {
    /// One for each item.
    pub verdicts: Vec<Verdict>,
    /// Whether the lease goes on.
    pub lease_live: bool,
}

/// Batches given back without having been tried; this does not count against them.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct ReleaseRequest {
    /// The process.
    pub session: String,
    /// Batches; none stands for all.
    #[serde(default)]
    pub batches: Vec<i64>,
}

/// Lines of the log of one claim of a batch.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct LogRequest {
    /// The process.
    pub session: String,
    /// The batch.
    pub batch: i64,
    /// The fence under which it was claimed.
    pub fence: i64,
    /// Whole lines.
    pub text: String,
}

/// A committed part of a pass.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PartEntry {
    /// The batch.
    pub batch: i64,
    /// The fence under which its result was accepted.
    pub fence: i64,
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    /// Bytes.
    pub bytes: i64,
}

/// A page of committed parts, by batch.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct PartPage {
    /// Parts.
    pub parts: Vec<PartEntry>,
    /// The cursor of the next page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<i64>,
}
