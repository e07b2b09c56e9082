//! What people ask about jobs.

use std::sync::Arc;

use axum::extract::State;
use axum::http::HeaderMap;
use protocol::job::{
    BatchPage, BatchSelection, Changed, Estimate, Failure, JobDetail, JobPage, JobPatch, JobRequest,
    JobSummary, Manifest, PassDetail, ResubmitRequest, SegmentDetail, Submitted,
};
use protocol::{BatchState, JobState, PassKind, limits};
use serde::Deserialize;
use utoipa::IntoParams;

use super::Api;
use super::access::Caller;
use super::extract::{Json, Path, Query};
use super::overview::live;
use crate::coordinator::pace::doing;
use crate::coordinator::submit::Submitter;
use crate::db::list::{JobList, JobSort};
use crate::scheduler::waiting::{Question, reason};
use crate::{Error, Result};

/// Failures of one answer.
const FAILURES_MAX: i64 = 1_000;

/// Which jobs, and which page of them.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct JobsQuery {
    /// Of one project.
    project: Option<String>,
    /// In one state.
    state: Option<JobState>,
    /// Whose name, owner, shot, comment or id holds this.
    #[serde(default)]
    search: String,
    /// What to sort by: `created` unless said otherwise.
    #[serde(default)]
    #[param(inline)]
    sort: JobSort,
    /// `asc`: least first. Otherwise the greatest, or latest.
    order: Option<String>,
    /// Entries to leave out before the page.
    #[serde(default)]
    offset: i64,
    /// The cursor: `next` of the page before.
    after: Option<String>,
    /// Entries at most.
    limit: Option<i64>,
}

/// Which batches, and which page of them.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct BatchesQuery {
    /// In one state.
    state: Option<BatchState>,
    /// The cursor: `next` of the page before; the first number for segments.
    after: Option<i64>,
    /// Entries at most.
    limit: Option<i64>,
}

fn page(limit: Option<i64>) -> i64 {
    limit.unwrap_or(100).clamp(1, limits::PAGE_MAX)
}

impl Api {
    /// A job that the caller may see.
    pub async fn job(&self, caller: &Caller, id: &str) -> Result<JobSummary> {
        let job = self.coordinator.store.job(id).await?;
        // Whether others have such a job is not told
        if caller.sees(&job.project) { Ok(job) } else { Err(Error::not_found("job", id)) }
    }

    /// Something was done to a job: what it is now.
    async fn changed(&self, job: &str) -> Result<Json<JobSummary>> {
        self.coordinator.changed([job.to_owned()]);
        self.coordinator.store.job(job).await.map(Json)
    }
}

fn submitter<'a>(caller: &'a Caller, headers: &'a HeaderMap) -> Result<Submitter<'a>> {
    let key = headers.get("idempotency-key").map(|key| key.to_str());
    let key = key.transpose().map_err(|_| Error::invalid("the idempotency key is not plain text"))?;
    Ok(Submitter { name: caller.name(), key })
}

/// Submits a job, or one for each frame. The header `Idempotency-Key` makes a repetition harmless.
#[utoipa::path(post, path = "/v1/jobs", tag = "jobs", security(("token" = ["submitter"])),
    request_body = JobRequest, responses((status = 200, body = Submitted)))]
pub async fn submit(
    State(api): State<Arc<Api>>,
    caller: Caller,
    headers: HeaderMap,
    Json(request): Json<JobRequest>,
) -> Result<Json<Submitted>> {
    caller.project_or(Some(&request.project))?;
    api.coordinator.submit(&request, submitter(&caller, &headers)?).await.map(Json)
}

/// Checks a request as a submission would, and says what it would ask of the farm. Nothing is stored.
#[utoipa::path(post, path = "/v1/jobs/validate", tag = "jobs", security(("token" = ["submitter"])),
    request_body = JobRequest, responses((status = 200, body = Estimate)))]
pub async fn validate(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<JobRequest>,
) -> Result<Json<Estimate>> {
    caller.project_or(Some(&request.project))?;
    api.coordinator.estimate(&request).await.map(Json)
}

/// Jobs, latest first unless another order is asked for.
#[utoipa::path(get, path = "/v1/jobs", tag = "jobs", security(("token" = ["viewer"])), params(JobsQuery),
    responses((status = 200, body = JobPage)))]
pub async fn jobs(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Query(query): Query<JobsQuery>,
) -> Result<Json<JobPage>> {
    let project = caller.project_or(query.project.as_deref())?;
    let list = JobList {
        project,
        state: query.state,
        search: limits::cut(query.search.trim(), limits::NAME_BYTES_MAX),
        sort: query.sort,
        ascending: query.order.as_deref() == Some("asc"),
        before: query.after.as_deref(),
        offset: query.offset.max(0),
        limit: page(query.limit),
    };
    let mut page = api.coordinator.store.jobs(&list).await?;
    page.live = live(&api.coordinator, &page.jobs);
    Ok(Json(page))
}

/// A job in full: its passes, why it waits, the time left.
#[utoipa::path(get, path = "/v1/jobs/{id}", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = JobDetail)))]
pub async fn job(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<JobDetail>> {
    let summary = api.job(&caller, &id).await?;
    let (coordinator, now) = (&api.coordinator, api.coordinator.now());
    let request = coordinator.store.job_request(&id).await?;
    let passes = coordinator.store.pass_details(&id).await?;
    let backing_off = coordinator.store.backing_off(&id, now).await?;
    let question = Question { job: &id, state: summary.state, backing_off };
    let (waiting, workers) = coordinator
        .read_farm(|farm| (reason(farm, &question, now), farm.jobs.get(&id).map_or(0, |job| job.leases)));
    let at_pace = doing(&coordinator.pace, &id, &summary.batches, waiting).left_ms;
    let recent_ms = coordinator.store.recent_batch_ms().await?;
    Ok(Json(JobDetail {
        left_ms: at_pace.or_else(|| left_ms(&passes, workers)),
        left_worker_ms: left_worker_ms(&passes, recent_ms),
        settings: request.settings,
        depends_on: request.depends_on,
        requires: request.requires,
        resubmit_of: coordinator.store.resubmitted(&id).await?,
        summary,
        passes,
        waiting,
    }))
}

/// Milliseconds until so many workers are done with the bake passes, by what their batches took; none where none has ended.
fn left_ms(passes: &[PassDetail], workers: i64) -> Option<i64> {
    let bakes = || passes.iter().filter(|pass| pass.kind == PassKind::Bake);
    let known = bakes().any(|pass| pass.batch_ms > 0);
    let work: i64 = bakes().map(|pass| pass.batches.open().saturating_mul(pass.batch_ms)).sum();
    // A worker has several batches and bakes one at a time
    (known && workers > 0).then(|| work / workers)
}

/// Milliseconds of one worker for the batches that are left; none before they are counted, or where no pace is known.
fn left_worker_ms(passes: &[PassDetail], recent_ms: Option<f64>) -> Option<i64> {
    let bakes: Vec<&PassDetail> = passes.iter().filter(|pass| pass.kind == PassKind::Bake).collect();
    if bakes.is_empty() {
        return None;
    }
    let left = |pass: &&PassDetail| {
        let own = (pass.batch_ms > 0).then_some(pass.batch_ms as f64);
        let batch_ms = own.or(recent_ms)?;
        Some((pass.batches.open() as f64 * batch_ms) as i64)
    };
    bakes.iter().map(left).sum()
}

/// Changes a job's priority, comment or limits.
#[utoipa::path(patch, path = "/v1/jobs/{id}", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), request_body = JobPatch, responses((status = 200, body = JobSummary)))]
pub async fn patch(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
    Json(patch): Json<JobPatch>,
) -> Result<Json<JobSummary>> {
    let job = api.job(&caller, &id).await?;
    if patch.priority.is_some_and(|priority| !(0..=100).contains(&priority))
        || patch.running_max.is_some_and(|max| max < 1)
        || patch.comment.as_ref().is_some_and(|text| text.len() > 1_000 || text.chars().any(char::is_control))
    {
        return Err(Error::invalid(
            "priority is from 0 to 100, `running_max` 1 or more, a comment up to 1000 bytes",
        ));
    }
    api.coordinator.store.patch(&job.id, &patch, caller.name(), api.coordinator.now()).await?;
    api.changed(&job.id).await
}

/// Cancels a job: nothing more of it is claimed; what runs ends within a heartbeat.
#[utoipa::path(post, path = "/v1/jobs/{id}/cancel", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), responses((status = 200, body = JobSummary)))]
pub async fn cancel(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<JobSummary>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.store.cancel(&job.id, caller.name(), api.coordinator.now()).await?;
    api.changed(&job.id).await
}

/// Pauses a job: nothing more of it is claimed; what runs goes on.
#[utoipa::path(post, path = "/v1/jobs/{id}/pause", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), responses((status = 200, body = JobSummary)))]
pub async fn pause(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<JobSummary>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.store.set_paused(&job.id, true, caller.name(), api.coordinator.now()).await?;
    api.changed(&job.id).await
}

/// Resumes a job.
#[utoipa::path(post, path = "/v1/jobs/{id}/resume", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), responses((status = 200, body = JobSummary)))]
pub async fn resume(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<JobSummary>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.store.set_paused(&job.id, false, caller.name(), api.coordinator.now()).await?;
    api.changed(&job.id).await
}

/// Tries failed or skipped batches again; a job that has failed runs again.
#[utoipa::path(post, path = "/v1/jobs/{id}/retry", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), request_body = BatchSelection, responses((status = 200, body = Changed)))]
pub async fn retry(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
    Json(selection): Json<BatchSelection>,
) -> Result<Json<Changed>> {
    let job = selected(&api, &caller, &id, &selection).await?;
    let now = api.coordinator.now();
    let batches = api.coordinator.store.retry(&job.id, &selection, caller.name(), now).await?;
    api.coordinator.changed([job.id]);
    Ok(Json(Changed { batches }))
}

/// Does without batches; the job's result is then marked as incomplete.
#[utoipa::path(post, path = "/v1/jobs/{id}/skip", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), request_body = BatchSelection, responses((status = 200, body = Changed)))]
pub async fn skip(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
    Json(selection): Json<BatchSelection>,
) -> Result<Json<Changed>> {
    let job = selected(&api, &caller, &id, &selection).await?;
    let now = api.coordinator.now();
    let batches = api.coordinator.store.skip(&job.id, &selection, caller.name(), now).await?;
    api.coordinator.changed([job.id]);
    Ok(Json(Changed { batches }))
}

async fn selected(api: &Api, caller: &Caller, id: &str, selection: &BatchSelection) -> Result<JobSummary> {
    if selection.batches.len() > limits::PAGE_MAX as usize {
        return Err(Error::invalid(format!("more than {} batches are named", limits::PAGE_MAX)));
    }
    if !selection.batches.is_empty() && selection.pass.is_none() {
        return Err(Error::invalid("batches are numbered by pass: `pass` must be said"));
    }
    api.job(caller, id).await
}

/// Submits a job again, with edits.
#[utoipa::path(post, path = "/v1/jobs/{id}/resubmit", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), request_body = ResubmitRequest, responses((status = 200, body = Submitted)))]
pub async fn resubmit(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    Json(edits): Json<ResubmitRequest>,
) -> Result<Json<Submitted>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.resubmit(&job.id, &edits, submitter(&caller, &headers)?).await.map(Json)
}

/// The segments of a pass, in order.
#[utoipa::path(get, path = "/v1/jobs/{id}/passes/{pass}/segments", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path), ("pass" = i64, Path), BatchesQuery),
    responses((status = 200, body = Vec<SegmentDetail>)))]
pub async fn segments(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path((id, pass)): Path<(String, i64)>,
    Query(query): Query<BatchesQuery>,
) -> Result<Json<Vec<SegmentDetail>>> {
    let job = api.job(&caller, &id).await?;
    let first = query.after.map_or(0, |after| after.saturating_add(1));
    api.coordinator.store.segments(&job.id, pass, first, page(query.limit)).await.map(Json)
}

/// The batches of a pass, in order.
#[utoipa::path(get, path = "/v1/jobs/{id}/passes/{pass}/batches", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path), ("pass" = i64, Path), BatchesQuery), responses((status = 200, body = BatchPage)))]
pub async fn batches(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path((id, pass)): Path<(String, i64)>,
    Query(query): Query<BatchesQuery>,
) -> Result<Json<BatchPage>> {
    let job = api.job(&caller, &id).await?;
    let (after, limit) = (query.after.unwrap_or(-1), page(query.limit));
    api.coordinator.store.batches(&job.id, pass, query.state, after, limit).await.map(Json)
}

/// The failures of a job's batches, latest first.
#[utoipa::path(get, path = "/v1/jobs/{id}/failures", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = Vec<Failure>)))]
pub async fn failures(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<Vec<Failure>>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.store.failures(&job.id, FAILURES_MAX).await.map(Json)
}

/// What a job has published.
#[utoipa::path(get, path = "/v1/jobs/{id}/manifest", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = Manifest)))]
pub async fn manifest(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<Manifest>> {
    let job = api.job(&caller, &id).await?;
    let manifest = api.coordinator.manifest(&job.id).await?;
    manifest.map(Json).ok_or_else(|| {
        Error::not_found("manifest of job", &id).hint("it is there when the job has succeeded")
    })
}
