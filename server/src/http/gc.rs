//! What is removed: garbage, on request, and jobs that nobody wants any more.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::StatusCode;
use protocol::gc::{DeletePreview, GcReport, GcRequest};

use super::Api;
use super::access::Caller;
use super::admin::confined;
use super::extract::{Json, Path};
use crate::Result;

/// The longest that one request collects.
const TIME: Duration = Duration::from_secs(15);

/// Collects garbage now, or says what there is. Where there was no time for all, the report says `more`.
#[utoipa::path(post, path = "/v1/gc", tag = "admin", security(("token" = ["admin"])),
    request_body = GcRequest, responses((status = 200, body = GcReport)))]
pub async fn collect(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<GcRequest>,
) -> Result<Json<GcReport>> {
    confined(&caller)?;
    api.coordinator.collect(request.dry_run, true, TIME).await.map(Json)
}

/// What would go if the job were deleted.
#[utoipa::path(get, path = "/v1/jobs/{id}/delete-preview", tag = "jobs", security(("token" = ["viewer"])),
    params(("id" = String, Path)), responses((status = 200, body = DeletePreview)))]
pub async fn preview(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Json<DeletePreview>> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.delete_preview(&job.id, TIME).await.map(Json)
}

/// Deletes a job that has ended: it is not shown any more, and the next collection removes all of it.
#[utoipa::path(delete, path = "/v1/jobs/{id}", tag = "jobs", security(("token" = ["submitter"])),
    params(("id" = String, Path)), responses((status = 204)))]
pub async fn delete_job(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<StatusCode> {
    let job = api.job(&caller, &id).await?;
    api.coordinator.store.delete_job(&job.id, caller.name(), api.coordinator.now()).await?;
    api.coordinator.changed([]);
    Ok(StatusCode::NO_CONTENT)
}
