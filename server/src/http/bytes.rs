//! Bytes of people: assets in, decorated streams and logs out.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use protocol::admin::{MissingReply, MissingRequest};
use protocol::{keys, limits};
use serde::Deserialize;
use utoipa::IntoParams;

use super::Api;
use super::access::Caller;
use super::extract::{Json, Path, Query, range};
use crate::error::Kind;
use crate::storage::{Expected, Outgoing};
use crate::{Error, Result};

/// Whose asset it is.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct AssetQuery {
    /// The project; `default` if left out.
    project: Option<String>,
}

/// A claim of a batch, and how much of its log.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct LogQuery {
    /// The fence of the claim; the latest claim's if left out.
    fence: Option<i64>,
    /// Bytes of the log to leave out at its beginning.
    #[serde(default)]
    offset: usize,
}

/// Says which hashes are to be uploaded.
#[utoipa::path(post, path = "/v1/assets/missing", tag = "assets", security(("token" = ["submitter"])),
    request_body = MissingRequest, responses((status = 200, body = MissingReply)))]
pub async fn missing_assets(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<MissingRequest>,
) -> Result<Json<MissingReply>> {
    caller.project_or(Some(&request.project))?;
    if request.sha256.len() > limits::FILES_MAX || !request.sha256.iter().all(|hash| keys::is_sha256(hash)) {
        return Err(Error::invalid(format!(
            "up to {} SHA-256 in lower case are possible",
            limits::FILES_MAX
        )));
    }
    let missing = api.coordinator.store.missing_assets(&request.project, &request.sha256).await?;
    Ok(Json(MissingReply { missing }))
}

/// Takes an asset: a file that scenes of the project may refer to by its hash.
#[utoipa::path(put, path = "/v1/assets/{sha256}", tag = "assets", security(("token" = ["submitter"])),
    params(("sha256" = String, Path), AssetQuery),
    request_body(content_type = "application/octet-stream"), responses((status = 204)))]
pub async fn put_asset(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(sha256): Path<String>,
    Query(query): Query<AssetQuery>,
    body: Body,
) -> Result<StatusCode> {
    let project = query.project.as_deref().unwrap_or("default");
    caller.project_or(Some(project))?;
    if !keys::is_sha256(&sha256) {
        return Err(Error::invalid(format!("`{}` is no SHA-256 in lower case", limits::cut(&sha256, 100))));
    }
    let coordinator = &api.coordinator;
    let bytes_max = coordinator.settings.asset_bytes_max;
    let expected = Expected { sha256: &sha256, bytes: None, bytes_max };
    let bytes = coordinator.storage.receive(&keys::asset(&sha256), body, expected).await?;
    coordinator.store.add_asset(project, &sha256, bytes as i64, coordinator.now()).await?;
    // A removal that was under way while the bytes came may have taken them, too
    if coordinator.storage.bytes(&keys::asset(&sha256)).await?.is_none() {
        coordinator.store.forget_asset(project, &sha256).await?;
        return Err(Error::new(Kind::Unavailable, "the asset is being removed: send it again"));
    }
    Ok(StatusCode::NO_CONTENT)
}

/// A decorated stream that a job published, or the range of it that the header `Range` asks for.
#[utoipa::path(get, path = "/v1/jobs/{id}/outputs/{name}", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path), ("name" = String, Path)),
    responses((status = 200, content_type = "application/octet-stream"), (status = 206)))]
pub async fn output(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path((job, name)): Path<(String, String)>,
    headers: HeaderMap,
) -> Result<Response> {
    let job = api.job(&caller, &job).await?;
    let manifest = api.coordinator.manifest(&job.id).await?;
    let outputs = manifest.map(|manifest| manifest.outputs).unwrap_or_default();
    let output = outputs.into_iter().find(|output| output.name == name);
    let output = output.ok_or_else(|| Error::not_found("output", &name))?;
    let range = range(&headers);
    let is_part = range.is_some();
    let sent = api.coordinator.storage.send(&output.key, range).await?;
    Ok(outgoing(sent, is_part, Some((&output.sha256, &output.name))))
}

/// The log of one claim of a batch; empty where the worker has said nothing.
#[utoipa::path(get, path = "/v1/jobs/{id}/passes/{pass}/batches/{batch}/log", tag = "jobs",
    security(("token" = ["viewer"])),
    params(("id" = String, Path), ("pass" = i64, Path), ("batch" = i64, Path), LogQuery),
    responses((status = 200, body = str, content_type = "text/plain")))]
pub async fn log(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path((job, pass, batch)): Path<(String, i64, i64)>,
    Query(query): Query<LogQuery>,
) -> Result<Response> {
    let job = api.job(&caller, &job).await?;
    let page = api.coordinator.store.batches(&job.id, pass, None, batch.saturating_sub(1), 1).await?;
    let found = page.batches.into_iter().find(|found| found.batch == batch);
    let found = found.ok_or_else(|| Error::not_found("batch", batch))?;
    let key = keys::log(&job.id, pass, batch, query.fence.unwrap_or(found.fence));
    let log = api.coordinator.storage.get(&key).await?.unwrap_or_default();
    let headers =
        [(header::CONTENT_TYPE, "text/plain; charset=utf-8"), (header::X_CONTENT_TYPE_OPTIONS, "nosniff")];
    Ok((headers, log.slice(query.offset.min(log.len())..)).into_response())
}

/// An object as an answer; `named` gives its hash, and the name under which a browser saves it.
pub fn outgoing(sent: Outgoing, is_part: bool, named: Option<(&str, &str)>) -> Response {
    let Outgoing { body, range, bytes } = sent;
    let mut response = Response::builder()
        .status(if is_part { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK })
        .header(header::CONTENT_TYPE, "application/octet-stream")
        .header(header::CONTENT_LENGTH, range.end - range.start)
        .header(header::ACCEPT_RANGES, "bytes")
        .header(header::X_CONTENT_TYPE_OPTIONS, "nosniff");
    if is_part {
        let last = range.end.saturating_sub(1);
        response = response.header(header::CONTENT_RANGE, format!("bytes {}-{last}/{bytes}", range.start));
    }
    if let Some((sha256, name)) = named {
        let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
        let name: String = name.chars().map(plain).collect();
        response = response
            .header(header::ETAG, format!("\"{sha256}\""))
            .header(header::CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\""));
    }
    let failed = |error| {
        tracing::error!(%error, "an answer cannot be put together");
        Error::new(crate::error::Kind::Internal, "the answer cannot be put together").into_response()
    };
    response.body(body).unwrap_or_else(failed)
}
