//! The farm at a glance, and what of a bake is for the eye: pictures, previews, skies.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use engine::relight::{Environment, Sky, Window};
use glam::DMat3;
use protocol::job::{JobSummary, Output};
use protocol::overview::{FarmDetail, JobNow, LeaseDetail, PaceSample, ProjectUse, Provisional};
use protocol::traced::PassWork;
use protocol::{JobState, WaitReason, keys, limits};
use serde::Deserialize;
use utoipa::IntoParams;

use super::Api;
use super::access::Caller;
use super::bytes::outgoing;
use super::extract::{Json, Path, Query, range};
use crate::coordinator::Coordinator;
use crate::coordinator::pace::doing;
use crate::error::Kind;
use crate::scheduler::farm::Farm;
use crate::scheduler::waiting::{Question, reason};
use crate::{Error, Result};

/// Bands of the skies' light.
const SKY_BANDS: usize = 6;

/// What jobs of a page do at this moment; those that have ended do nothing.
pub fn live(coordinator: &Coordinator, jobs: &[JobSummary]) -> BTreeMap<String, JobNow> {
    let now = coordinator.now();
    let one = |farm: &Farm, job: &JobSummary| {
        let question = Question { job: &job.id, state: job.state, backing_off: 0 };
        let waiting = reason(farm, &question, now);
        (job.id.clone(), doing(&coordinator.pace, &job.id, &job.batches, waiting))
    };
    coordinator
        .read_farm(|farm| jobs.iter().filter(|job| !job.state.is_final()).map(|job| one(farm, job)).collect())
}

/// The farm at a glance.
#[utoipa::path(get, path = "/v1/farm", tag = "jobs", security(("token" = ["viewer"])),
    responses((status = 200, body = FarmDetail)))]
pub async fn farm(State(api): State<Arc<Api>>, caller: Caller) -> Result<Json<FarmDetail>> {
    let (coordinator, now) = (&api.coordinator, api.coordinator.now());
    let blocked = coordinator.store.count_jobs(caller.project(), JobState::Blocked).await?;
    let mut detail = coordinator.read_farm(|farm| overview(farm, &caller, now));
    for worker in coordinator.store.workers(now).await? {
        *detail.workers.entry(worker.state).or_default() += 1;
    }
    if blocked > 0 {
        detail.jobs += blocked;
        *detail.waiting.entry(WaitReason::Dependency.word().into()).or_default() += blocked;
    }
    Ok(Json(detail))
}

/// What the memory of the farm says about the projects that a caller may see.
fn overview(farm: &Farm, caller: &Caller, now: i64) -> FarmDetail {
    let mut detail = FarmDetail::default();
    let mut projects: BTreeMap<&str, ProjectUse> = BTreeMap::new();
    for (name, project) in farm.projects.iter().filter(|(name, _)| caller.sees(name)) {
        let (share, running_max, running) = (project.share, project.running_max, project.running);
        let project = ProjectUse { name: name.clone(), share, running_max, running, ready: 0, jobs: 0 };
        projects.insert(name, project);
    }
    for (id, job) in farm.jobs.iter().filter(|(_, job)| caller.sees(&job.project)) {
        let question = Question { job: id, state: JobState::Running, backing_off: 0 };
        *detail.waiting.entry(reason(farm, &question, now).word().into()).or_default() += 1;
        let segments = job.passes.iter().filter_map(|pass| farm.passes.get(pass));
        let ready: i64 = segments.flat_map(|pass| pass.segments.values()).map(|segment| segment.ready).sum();
        detail.jobs += 1;
        detail.running += job.running;
        detail.ready += ready;
        if let Some(project) = projects.get_mut(job.project.as_str()) {
            project.ready += ready;
            project.jobs += 1;
        }
    }
    detail.projects = projects.into_values().collect();
    detail
}

/// Leases, those first that were claimed first: what runs, where, and since when.
#[utoipa::path(get, path = "/v1/leases", tag = "jobs", security(("token" = ["viewer"])),
    responses((status = 200, body = Vec<LeaseDetail>)))]
pub async fn leases(State(api): State<Arc<Api>>, caller: Caller) -> Result<Json<Vec<LeaseDetail>>> {
    api.coordinator.store.leases(caller.project(), limits::PAGE_MAX).await.map(Json)
}

/// How many batches of a job were done when, as this coordinator saw it since it was started.
#[utoipa::path(get, path = "/v1/jobs/{id}/pace", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = Vec<PaceSample>)))]
pub async fn pace(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<Vec<PaceSample>>> {
    let job = api.job(&caller, &id).await?;
    let mut samples = api.coordinator.pace.of(&id);
    let at = job.ended_at.unwrap_or_else(|| api.coordinator.now());
    if samples.last().is_some_and(|last| last.at < at && last.done < job.batches.done) {
        samples.push(PaceSample { at, done: job.batches.done });
    }
    Ok(Json(samples))
}

/// Who traced how much of a job, and what that took; those that reported last come first, a thousand at most.
#[utoipa::path(get, path = "/v1/jobs/{id}/work", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = Vec<PassWork>)))]
pub async fn work(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<Vec<PassWork>>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.store.work(&job.id, limits::PAGE_MAX).await.map(Json)
}

/// A picture of a decorated stream, PNG.
#[utoipa::path(get, path = "/v1/jobs/{id}/outputs/{name}/picture", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path), ("name" = String, Path)),
    responses((status = 200, content_type = "image/png")))]
pub async fn picture(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path((job, name)): Path<(String, String)>,
    headers: HeaderMap,
) -> Result<Response> {
    let output = api.published(&caller, &job, Some(&name)).await?;
    send_picture(&api, &output, &headers).await
}

/// The picture of a job's first decorated stream, PNG.
#[utoipa::path(get, path = "/v1/jobs/{id}/picture", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, content_type = "image/png")))]
pub async fn job_picture(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(job): Path<String>,
    headers: HeaderMap,
) -> Result<Response> {
    let output = api.published(&caller, &job, None).await?;
    send_picture(&api, &output, &headers).await
}

/// What there is to see of a bake that is under way: previews of the parts that are committed, at most half a minute old.
/// `made_at` of one is the `made` of its preview.
#[utoipa::path(get, path = "/v1/jobs/{id}/provisional", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = Vec<Provisional>)))]
pub async fn provisional(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<Vec<Provisional>>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.provisional(&job).await.map(Json)
}

/// Which preview.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct PreviewQuery {
    /// Of a bake that is under way: the pass, and when the preview was made, as `provisional` says.
    pass: Option<i64>,
    /// See `pass`.
    made: Option<i64>,
}

/// The preview of a decorated stream (`docs/formats-preview.md`), or the range of it that the header `Range` asks for.
#[utoipa::path(get, path = "/v1/jobs/{id}/outputs/{name}/preview", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path), ("name" = String, Path), PreviewQuery),
    responses((status = 200, content_type = "application/octet-stream"), (status = 206)))]
pub async fn preview(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path((job, name)): Path<(String, String)>,
    Query(query): Query<PreviewQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let key = match query.pass.zip(query.made) {
        Some((pass, made)) => keys::provisional(&api.job(&caller, &job).await?.id, pass, made),
        None => {
            let output = api.published(&caller, &job, Some(&name)).await?;
            if !output.preview {
                return Err(Error::not_found("preview of output", &name));
            }
            beside(&output, "preview")
        }
    };
    let range = range(&headers);
    let is_part = range.is_some();
    let sent = api.coordinator.storage.send(&key, range).await?;
    Ok(outgoing(sent, is_part, None))
}

/// The built-in skies in spherical harmonics, as `pantaray relight` projects them: `bands` of each colour, in the frame of
/// the map (+y up), with nothing that tapers them. JSON.
#[utoipa::path(get, path = "/v1/skies", tag = "jobs", security(("token" = ["viewer"])),
    responses((status = 200, body = str, content_type = "application/json")))]
pub async fn skies() -> Result<Response> {
    static SKIES: OnceLock<String> = OnceLock::new();
    if SKIES.get().is_none() {
        let made = tokio::task::spawn_blocking(make_skies).await;
        let made = made.map_err(|error| Error::new(Kind::Internal, error.to_string()))??;
        // Another request may have been first, with the same text
        let _ = SKIES.set(made);
    }
    let text = SKIES.get().cloned().unwrap_or_default();
    Ok(([(header::CONTENT_TYPE, "application/json")], text).into_response())
}

fn make_skies() -> Result<String> {
    let mut skies = Vec::new();
    for (name, sky) in Sky::ALL {
        let unlikely = |error: engine::Error| Error::new(Kind::Internal, error.to_string());
        let environment = Environment::sky(sky, None).map_err(unlikely)?;
        let light = environment.project(SKY_BANDS, DMat3::IDENTITY, Window::None);
        let light: Vec<&[f64]> = light.iter().map(|color| &color[..]).collect();
        skies.push(serde_json::json!({ "name": name, "sun": environment.sun().is_some(), "bands": SKY_BANDS, "light": light }));
    }
    Ok(serde_json::to_string(&skies)?)
}

impl Api {
    /// An output that a job has published, or its first.
    async fn published(&self, caller: &Caller, job: &str, name: Option<&str>) -> Result<Output> {
        let job = self.job(caller, job).await?;
        let manifest = self.coordinator.manifest(&job.id).await?;
        let mut outputs = manifest.map(|manifest| manifest.outputs).unwrap_or_default().into_iter();
        let found = outputs.find(|output| name.is_none_or(|name| output.name == name));
        found.ok_or_else(|| Error::not_found("output", name.unwrap_or(&job.name)))
    }
}

/// The key of what lies beside an output under another ending.
fn beside(output: &Output, ending: &str) -> String {
    format!("{}.{ending}", output.key.strip_suffix(".mgs").unwrap_or(&output.key))
}

/// Sends a picture, unless the browser has it: it never changes.
async fn send_picture(api: &Api, output: &Output, asked: &HeaderMap) -> Result<Response> {
    if !output.picture {
        return Err(Error::not_found("picture of output", &output.name));
    }
    let key = beside(output, "png");
    let etag = format!("\"{}\"", output.sha256);
    if asked.get(header::IF_NONE_MATCH).is_some_and(|tag| tag.as_bytes() == etag.as_bytes()) {
        return Ok(axum::http::StatusCode::NOT_MODIFIED.into_response());
    }
    let png = api.coordinator.storage.get(&key).await?.ok_or_else(|| Error::not_found("object", &key))?;
    let mut response = png.into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("image/png"));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=86400"));
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        headers.insert(header::ETAG, etag);
    }
    Ok(response)
}
