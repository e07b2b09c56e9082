//! The coordinator's operations as functions: the only place on this side that spells their paths.

use std::time::Duration;

use protocol::admin::{
    AuditPage, EnrolRequest, MissingReply, MissingRequest, Project, Secret, TicketRequest, TokenDetail,
    TokenRequest, WorkerDetail,
};
use protocol::gc::{DeletePreview, GcReport, GcRequest};
use protocol::job::{
    BatchSelection, Changed, Estimate, Failure, JobDetail, JobPage, JobPatch, JobRequest, JobSummary,
    Manifest, ResubmitRequest, Submitted,
};
use protocol::overview::FarmDetail;
use protocol::storage::{SceneFiles, UrlsReply, UrlsRequest};
use protocol::work::{
    Claim, ClaimRequest, CompleteReply, CompleteRequest, HeartbeatReply, HeartbeatRequest, LogRequest,
    PartPage, RegisterReply, RegisterRequest, ReleaseRequest,
};
use serde_json::{Value, json};

use crate::Result;
use crate::client::Client;

/// What workers ask. Errors are those of [`Client::get`].
#[expect(clippy::missing_errors_doc, reason = "said once, above")]
impl Client {
    /// Trades a ticket for a token of the worker's own.
    pub fn enrol(&self, request: &EnrolRequest) -> Result<Secret> {
        self.post("/v1/enrol", request, Duration::ZERO)
    }

    /// Introduces a worker's process.
    pub fn register(&self, request: &RegisterRequest) -> Result<RegisterReply> {
        self.post("/v1/workers", request, Duration::ZERO)
    }

    /// Asks for work, and waits for it as long as the request says.
    pub fn claim(&self, request: &ClaimRequest) -> Result<Option<Claim>> {
        self.post("/v1/claims", request, Duration::from_millis(request.wait_ms))
    }

    /// Gives a sign of life.
    pub fn heartbeat(&self, request: &HeartbeatRequest) -> Result<HeartbeatReply> {
        self.post("/v1/heartbeats", request, Duration::ZERO)
    }

    /// Says what became of batches.
    pub fn complete(&self, lease: &str, request: &CompleteRequest) -> Result<CompleteReply> {
        self.post(&format!("/v1/leases/{lease}/complete"), request, Duration::ZERO)
    }

    /// Gives batches back untried.
    pub fn release(&self, lease: &str, request: &ReleaseRequest) -> Result<Value> {
        self.post(&format!("/v1/leases/{lease}/release"), request, Duration::ZERO)
    }

    /// Asks where objects are read and written.
    pub fn urls(&self, lease: &str, request: &UrlsRequest) -> Result<UrlsReply> {
        self.post(&format!("/v1/leases/{lease}/urls"), request, Duration::ZERO)
    }

    /// The scene of the job that a lease is of.
    pub fn lease_scene(&self, lease: &str, session: &str) -> Result<SceneFiles> {
        self.get(&format!("/v1/leases/{lease}/scene?session={session}"))
    }

    /// The parts that a lease's task merges, those after batch `after`.
    pub fn lease_parts(&self, lease: &str, session: &str, after: Option<i64>) -> Result<PartPage> {
        let after = after.map_or(String::new(), |after| format!("&after={after}"));
        self.get(&format!("/v1/leases/{lease}/parts?session={session}{after}"))
    }

    /// Adds lines to the log of a claim of a batch.
    pub fn add_log(&self, lease: &str, request: &LogRequest) -> Result<Value> {
        self.post(&format!("/v1/leases/{lease}/log"), request, Duration::ZERO)
    }
}

/// What people and scripts ask. Errors are those of [`Client::get`].
#[expect(clippy::missing_errors_doc, reason = "said once, above")]
impl Client {
    /// Which hashes are to be uploaded.
    pub fn missing_assets(&self, request: &MissingRequest) -> Result<MissingReply> {
        self.post("/v1/assets/missing", request, Duration::ZERO)
    }

    /// Submits; a repetition with the same `key` makes no second job.
    pub fn submit(&self, request: &JobRequest, key: &str) -> Result<Submitted> {
        self.post_once("/v1/jobs", request, key)
    }

    /// Checks a submission, and says what it would ask of the farm.
    pub fn validate(&self, request: &JobRequest) -> Result<Estimate> {
        self.post("/v1/jobs/validate", request, Duration::ZERO)
    }

    /// Submits a job again, with edits; a repetition with the same `key` makes no second job.
    pub fn resubmit(&self, job: &str, edits: &ResubmitRequest, key: &str) -> Result<Submitted> {
        self.post_once(&format!("/v1/jobs/{job}/resubmit"), edits, key)
    }

    /// A page of jobs, latest first. `query` goes as it is.
    pub fn jobs(&self, query: &str) -> Result<JobPage> {
        self.get(&format!("/v1/jobs{query}"))
    }

    /// A job in full.
    pub fn job(&self, job: &str) -> Result<JobDetail> {
        self.get(&format!("/v1/jobs/{job}"))
    }

    /// Cancels, pauses or resumes a job.
    pub fn act(&self, job: &str, action: &str) -> Result<JobSummary> {
        self.post(&format!("/v1/jobs/{job}/{action}"), &json!({}), Duration::ZERO)
    }

    /// Tries batches again, or does without them: `retry` or `skip`.
    pub fn change_batches(&self, job: &str, action: &str, selection: &BatchSelection) -> Result<Changed> {
        self.post(&format!("/v1/jobs/{job}/{action}"), selection, Duration::ZERO)
    }

    /// Changes a job's priority, comment or limits.
    pub fn change_job(&self, job: &str, patch: &JobPatch) -> Result<JobSummary> {
        self.patch(&format!("/v1/jobs/{job}"), patch)
    }

    /// The failures of a job's batches.
    pub fn failures(&self, job: &str) -> Result<Vec<Failure>> {
        self.get(&format!("/v1/jobs/{job}/failures"))
    }

    /// What a job published.
    pub fn manifest(&self, job: &str) -> Result<Manifest> {
        self.get(&format!("/v1/jobs/{job}/manifest"))
    }

    /// What would go with a job if it were deleted.
    pub fn delete_preview(&self, job: &str) -> Result<DeletePreview> {
        self.get(&format!("/v1/jobs/{job}/delete-preview"))
    }

    /// Deletes a job that has ended.
    pub fn delete_job(&self, job: &str) -> Result<Value> {
        self.delete(&format!("/v1/jobs/{job}"))
    }

    /// The farm's workers.
    pub fn workers(&self) -> Result<Vec<WorkerDetail>> {
        self.get("/v1/workers")
    }

    /// The farm at a glance.
    pub fn farm(&self) -> Result<FarmDetail> {
        self.get("/v1/farm")
    }

    /// The projects that the caller may see.
    pub fn projects(&self) -> Result<Vec<Project>> {
        self.get("/v1/projects")
    }
}

/// What administrators ask. Errors are those of [`Client::get`].
#[expect(clippy::missing_errors_doc, reason = "said once, above")]
impl Client {
    /// Collects garbage for some seconds, or says what there is.
    pub fn collect_garbage(&self, request: &GcRequest) -> Result<GcReport> {
        self.post("/v1/gc", request, Duration::from_secs(20))
    }

    /// Makes a token.
    pub fn create_token(&self, request: &TokenRequest) -> Result<Secret> {
        self.post("/v1/tokens", request, Duration::ZERO)
    }

    /// All tokens, latest first.
    pub fn tokens(&self) -> Result<Vec<TokenDetail>> {
        self.get("/v1/tokens")
    }

    /// Locks, unlocks or drains a worker.
    pub fn act_on_worker(&self, worker: &str, action: &str) -> Result<Value> {
        self.post(&format!("/v1/workers/{worker}/{action}"), &json!({}), Duration::ZERO)
    }

    /// Makes a ticket, by which workers enrol.
    pub fn create_ticket(&self, request: &TicketRequest) -> Result<Secret> {
        self.post("/v1/tickets", request, Duration::ZERO)
    }

    /// A page of the audit, latest first. `query` goes as it is.
    pub fn audit(&self, query: &str) -> Result<AuditPage> {
        self.get(&format!("/v1/audit{query}"))
    }

    /// Makes a project, or changes its share.
    pub fn put_project(&self, project: &Project) -> Result<Value> {
        self.put(&format!("/v1/projects/{}", project.name), project)
    }

    /// Revokes a token.
    pub fn revoke_token(&self, id: &str) -> Result<Value> {
        self.post(&format!("/v1/tokens/{id}/revoke"), &json!({}), Duration::ZERO)
    }
}
