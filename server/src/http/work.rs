//! What workers ask.

use std::sync::Arc;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use protocol::storage::{SceneFiles, UrlsReply, UrlsRequest};
use protocol::work::{
    Claim, ClaimRequest, CompleteReply, CompleteRequest, HeartbeatReply, HeartbeatRequest, LogRequest,
    PartPage, RegisterReply, RegisterRequest, ReleaseRequest,
};
use serde::Deserialize;
use utoipa::IntoParams;

use super::Api;
use super::access::Caller;
use super::bytes::outgoing;
use super::extract::{Json, Path, Query, range};
use crate::coordinator::bytes::Holder;
use crate::error::Kind;
use crate::{Error, Result};

/// The worker's process.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct SessionQuery {
    /// The session.
    session: String,
    /// The last batch of the page before.
    after: Option<i64>,
}

/// An object of a lease.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ObjectQuery {
    /// The session.
    session: String,
    /// The object's key.
    key: String,
    /// SHA-256 of its bytes, to write it.
    sha256: Option<String>,
    /// How many bytes, to write it.
    bytes: Option<u64>,
}

/// Introduces a worker's process.
#[utoipa::path(post, path = "/v1/workers", tag = "work", security(("token" = ["worker"])),
    request_body = RegisterRequest, responses((status = 200, body = RegisterReply)))]
pub async fn register(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<RegisterRequest>,
) -> Result<Json<RegisterReply>> {
    let bound = caller.token.as_ref().and_then(|token| token.worker.as_deref());
    if bound.is_some_and(|name| name != request.name) {
        return Err(Error::new(Kind::Forbidden, format!("the token is not for a worker `{}`", request.name)));
    }
    let labels = caller.token.as_ref().map_or(&[][..], |token| &token.labels);
    api.coordinator.register(&request, caller.token_id(), labels).await.map(Json)
}

/// Asks for work, and waits for it as long as the request says. 204: there is none.
#[utoipa::path(post, path = "/v1/claims", tag = "work", security(("token" = ["worker"])),
    request_body = ClaimRequest, responses((status = 200, body = Claim), (status = 204)))]
pub async fn claim(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<ClaimRequest>,
) -> Result<Response> {
    Ok(match api.coordinator.claim(&request, caller.token_id()).await? {
        Some(claim) => {
            let Claim { lease, pass, segment, batches, task, .. } = &claim;
            tracing::debug!(job = task.job, pass, segment, lease, ?batches, "granted");
            Json(claim).into_response()
        }
        None => StatusCode::NO_CONTENT.into_response(),
    })
}

/// Gives a sign of life and keeps leases.
#[utoipa::path(post, path = "/v1/heartbeats", tag = "work", security(("token" = ["worker"])),
    request_body = HeartbeatRequest, responses((status = 200, body = HeartbeatReply)))]
pub async fn heartbeat(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<HeartbeatRequest>,
) -> Result<Json<HeartbeatReply>> {
    api.coordinator.heartbeat(&request, caller.token_id()).await.map(Json)
}

/// Says what became of batches.
#[utoipa::path(post, path = "/v1/leases/{id}/complete", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path)), request_body = CompleteRequest, responses((status = 200, body = CompleteReply)))]
pub async fn complete(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Json(request): Json<CompleteRequest>,
) -> Result<Json<CompleteReply>> {
    api.coordinator.complete(&lease, &request, caller.token_id()).await.map(Json)
}

/// Gives batches back untried.
#[utoipa::path(post, path = "/v1/leases/{id}/release", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path)), request_body = ReleaseRequest, responses((status = 204)))]
pub async fn release(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Json(request): Json<ReleaseRequest>,
) -> Result<StatusCode> {
    api.coordinator.release(&lease, &request, caller.token_id()).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Adds lines to the log of a claim of a batch.
#[utoipa::path(post, path = "/v1/leases/{id}/log", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path)), request_body = LogRequest, responses((status = 204)))]
pub async fn add_log(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Json(request): Json<LogRequest>,
) -> Result<StatusCode> {
    api.coordinator.add_log(&lease, &request, caller.token_id()).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Says where objects are read and written. A URL that begins with `/` is the coordinator's own.
#[utoipa::path(post, path = "/v1/leases/{id}/urls", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path)), request_body = UrlsRequest, responses((status = 200, body = UrlsReply)))]
pub async fn urls(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Json(request): Json<UrlsRequest>,
) -> Result<Json<UrlsReply>> {
    api.coordinator.urls(&lease, &request, caller.token_id()).await.map(Json)
}

/// The scene of the lease's job, as it was submitted.
#[utoipa::path(get, path = "/v1/leases/{id}/scene", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path), SessionQuery), responses((status = 200, body = SceneFiles)))]
pub async fn lease_scene(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Query(query): Query<SessionQuery>,
) -> Result<Json<SceneFiles>> {
    let holder = Holder { lease: &lease, session: &query.session, token: caller.token_id() };
    api.coordinator.lease_scene(holder).await.map(Json)
}

/// The parts that the lease's task merges, by batch.
#[utoipa::path(get, path = "/v1/leases/{id}/parts", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path), SessionQuery), responses((status = 200, body = PartPage)))]
pub async fn lease_parts(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Query(query): Query<SessionQuery>,
) -> Result<Json<PartPage>> {
    let holder = Holder { lease: &lease, session: &query.session, token: caller.token_id() };
    api.coordinator.lease_parts(holder, query.after).await.map(Json)
}

/// An object of the lease, or the range of it that the header `Range` asks for.
#[utoipa::path(get, path = "/v1/leases/{id}/objects", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path), ObjectQuery),
    responses((status = 200, content_type = "application/octet-stream"), (status = 206)))]
pub async fn read_object(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Query(query): Query<ObjectQuery>,
    headers: HeaderMap,
) -> Result<Response> {
    let holder = Holder { lease: &lease, session: &query.session, token: caller.token_id() };
    let range = range(&headers);
    let is_part = range.is_some();
    Ok(outgoing(api.coordinator.read_object(holder, &query.key, range).await?, is_part, None))
}

/// Takes an object of the lease.
#[utoipa::path(put, path = "/v1/leases/{id}/objects", tag = "work", security(("token" = ["worker"])),
    params(("id" = String, Path), ObjectQuery),
    request_body(content_type = "application/octet-stream"), responses((status = 204)))]
pub async fn write_object(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(lease): Path<String>,
    Query(query): Query<ObjectQuery>,
    body: axum::body::Body,
) -> Result<StatusCode> {
    let (Some(sha256), Some(bytes)) = (&query.sha256, query.bytes) else {
        return Err(Error::invalid("`sha256` and `bytes` must be said to write an object"));
    };
    let holder = Holder { lease: &lease, session: &query.session, token: caller.token_id() };
    api.coordinator.write_object(holder, &query.key, sha256, bytes, body).await?;
    Ok(StatusCode::NO_CONTENT)
}
