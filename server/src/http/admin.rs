//! What administrators ask: workers, tokens, tickets, projects, the audit; and enrolment, for which a ticket is enough.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::extract::{ConnectInfo, State};
use axum::http::StatusCode;
use protocol::admin::{
    AuditEntry, AuditPage, EnrolRequest, Project, Secret, TicketRequest, TokenDetail, TokenRequest,
    WorkerDetail,
};
use protocol::{Role, limits};
use serde::Deserialize;
use utoipa::IntoParams;

use super::Api;
use super::access::{Caller, new_secret, token_id};
use super::extract::{Json, Path, Query};
use crate::coordinator::lock;
use crate::db::Store;
use crate::db::access::Token;
use crate::db::worker::WorkerAction;
use crate::error::Kind;
use crate::storage::sha256;
use crate::{Error, Result};

/// Enrolments that may fail within a minute before all have to wait.
const FAILED_ENROLMENTS_MAX: u32 = 30;
/// The longest life of a ticket or token, in seconds: ten years.
const EXPIRES_S_MAX: i64 = 315_360_000;

/// A page of the audit.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct AuditQuery {
    /// The cursor: `next` of the page before.
    after: Option<i64>,
    /// Entries at most.
    limit: Option<i64>,
}

/// All workers, by name.
#[utoipa::path(get, path = "/v1/workers", tag = "admin", security(("token" = ["viewer"])),
    responses((status = 200, body = Vec<WorkerDetail>)))]
pub async fn workers(State(api): State<Arc<Api>>) -> Result<Json<Vec<WorkerDetail>>> {
    api.coordinator.store.workers(api.coordinator.now()).await.map(Json)
}

/// Locks, unlocks or drains a worker.
#[utoipa::path(post, path = "/v1/workers/{name}/{action}", tag = "admin", security(("token" = ["admin"])),
    params(("name" = String, Path), ("action" = String, Path, description = "`lock`, `unlock` or `drain`")),
    responses((status = 204)))]
pub async fn act_on_worker(
    State(api): State<Arc<Api>>,
    Path((name, action)): Path<(String, String)>,
) -> Result<StatusCode> {
    let action = match action.as_str() {
        "lock" => WorkerAction::Lock,
        "unlock" => WorkerAction::Unlock,
        "drain" => WorkerAction::Drain,
        other => return Err(Error::not_found("action", other).hint("`lock`, `unlock` or `drain`")),
    };
    api.coordinator.store.act_on_worker(&name, action).await?;
    api.coordinator.forget_sessions(&name);
    api.coordinator.changed([]);
    Ok(StatusCode::NO_CONTENT)
}

/// Makes a token; its secret is shown this once.
#[utoipa::path(post, path = "/v1/tokens", tag = "admin", security(("token" = ["admin"])),
    request_body = TokenRequest, responses((status = 200, body = Secret)))]
pub async fn create_token(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<TokenRequest>,
) -> Result<Json<Secret>> {
    confined(&caller)?;
    make_token(&api.coordinator.store, &request, api.coordinator.now()).await.map(Json)
}

/// Adds a token to a database.
///
/// # Errors
/// [`Kind::Invalid`] for a label or time that is not possible, [`Kind::NotFound`] for an unknown project.
pub async fn make_token(store: &Store, request: &TokenRequest, now: i64) -> Result<Secret> {
    if request.label.trim().is_empty() || request.label.len() > limits::NAME_BYTES_MAX {
        return Err(Error::invalid(format!("a label has 1 to {} bytes", limits::NAME_BYTES_MAX)));
    }
    if let Some(project) = &request.project
        && !store.projects().await?.iter().any(|known| known.name == *project)
    {
        return Err(Error::not_found("project", project));
    }
    let expires_at = request.expires_s.map(|seconds| expiry(seconds, now)).transpose()?;
    let (id, secret) = new_secret(now);
    let detail = TokenDetail {
        id: id.clone(),
        role: request.role,
        project: request.project.clone(),
        label: request.label.clone(),
        created_at: now,
        expires_at,
        revoked_at: None,
        last_used_at: None,
    };
    let sha256 = sha256(secret.as_bytes());
    store.add_token(&Token { detail, sha256, worker: None, labels: Vec::new(), parent: None }).await?;
    Ok(Secret { id, secret })
}

fn expiry(seconds: i64, now: i64) -> Result<i64> {
    match seconds {
        1..=EXPIRES_S_MAX => Ok(now + 1_000 * seconds),
        _ => Err(Error::invalid(format!("`{seconds}` seconds, 1 to {EXPIRES_S_MAX} are possible"))),
    }
}

/// An administrator of one project has no say over tokens, tickets and projects.
pub fn confined(caller: &Caller) -> Result<()> {
    match caller.project() {
        None => Ok(()),
        Some(project) => {
            Err(Error::new(Kind::Forbidden, format!("the token is for the project `{project}` only")))
        }
    }
}

/// All tokens, latest first, without their secrets.
#[utoipa::path(get, path = "/v1/tokens", tag = "admin", security(("token" = ["admin"])),
    responses((status = 200, body = Vec<TokenDetail>)))]
pub async fn tokens(State(api): State<Arc<Api>>, caller: Caller) -> Result<Json<Vec<TokenDetail>>> {
    confined(&caller)?;
    api.coordinator.store.tokens().await.map(Json)
}

/// Revokes a token: here at once, at other coordinators within ten seconds.
#[utoipa::path(post, path = "/v1/tokens/{id}/revoke", tag = "admin", security(("token" = ["admin"])),
    params(("id" = String, Path)), responses((status = 204)))]
pub async fn revoke_token(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<StatusCode> {
    confined(&caller)?;
    api.coordinator.store.revoke_token(&id, api.coordinator.now()).await?;
    api.tokens.forget(&id);
    Ok(StatusCode::NO_CONTENT)
}

/// Makes a ticket by which workers enrol; its secret is shown this once.
#[utoipa::path(post, path = "/v1/tickets", tag = "admin", security(("token" = ["admin"])),
    request_body = TicketRequest, responses((status = 200, body = Secret)))]
pub async fn create_ticket(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Json(request): Json<TicketRequest>,
) -> Result<Json<Secret>> {
    confined(&caller)?;
    let named = request.labels.iter().all(|label| limits::is_name(label));
    if !(1..=100_000).contains(&request.uses) || request.labels.len() > limits::LABELS_MAX || !named {
        return Err(Error::invalid(
            "a ticket has 1 to 100000 uses, and labels of letters, digits, `-`, `_`, `.`, `=`",
        ));
    }
    let now = api.coordinator.now();
    let (id, secret) = new_secret(now);
    let (hash, expires_at) = (sha256(secret.as_bytes()), expiry(request.expires_s, now)?);
    api.coordinator.store.add_ticket(&id, &hash, request.uses, &request.labels, expires_at).await?;
    Ok(Json(Secret { id, secret }))
}

/// Trades a ticket for a token of the worker's own. What is wrong with a ticket is not told.
#[utoipa::path(post, path = "/v1/enrol", tag = "admin", security(()),
    request_body = EnrolRequest, responses((status = 200, body = Secret)))]
pub async fn enrol(
    State(api): State<Arc<Api>>,
    address: Option<axum::Extension<ConnectInfo<SocketAddr>>>,
    Json(request): Json<EnrolRequest>,
) -> Result<Json<Secret>> {
    if !limits::is_name(&request.name) {
        return Err(Error::invalid("a worker's name has letters, digits, `-`, `_`, `.` and `=`, up to 100"));
    }
    let now = api.coordinator.now();
    let minute = now / 60_000;
    {
        let mut failed = lock(&api.failed_enrolments);
        if failed.0 != minute {
            *failed = (minute, 0);
        }
        if failed.1 >= FAILED_ENROLMENTS_MAX {
            return Err(Error::new(Kind::TooMany, "too many enrolments have failed within a minute"));
        }
    }
    let store = &api.coordinator.store;
    let used = match token_id(&request.ticket) {
        Some(id) => store.use_ticket(id, &sha256(request.ticket.as_bytes()), now).await,
        None => Err(Error::new(Kind::Unauthorized, "the ticket is not valid")),
    };
    let labels = used.inspect_err(|_| lock(&api.failed_enrolments).1 += 1)?;
    let (id, secret) = new_secret(now);
    let detail = TokenDetail {
        id: id.clone(),
        role: Role::Worker,
        project: None,
        label: format!("worker {}", request.name),
        created_at: now,
        expires_at: None,
        revoked_at: None,
        last_used_at: None,
    };
    let sha256 = sha256(secret.as_bytes());
    let entry = AuditEntry {
        id: 0,
        at: now,
        actor: detail.label.clone(),
        token: Some(id.clone()),
        address: address.map_or_else(String::new, |address| address.0.0.ip().to_string()),
        action: "POST /v1/enrol".into(),
        status: 200,
    };
    store.add_token(&Token { detail, sha256, worker: Some(request.name), labels, parent: None }).await?;
    store.add_audit(&entry).await?;
    Ok(Json(Secret { id, secret }))
}

/// All projects that the caller may see, by name.
#[utoipa::path(get, path = "/v1/projects", tag = "admin", security(("token" = ["viewer"])),
    responses((status = 200, body = Vec<Project>)))]
pub async fn projects(State(api): State<Arc<Api>>, caller: Caller) -> Result<Json<Vec<Project>>> {
    let mut projects = api.coordinator.store.projects().await?;
    projects.retain(|project| caller.sees(&project.name));
    Ok(Json(projects))
}

/// Makes or changes a project.
#[utoipa::path(put, path = "/v1/projects/{name}", tag = "admin", security(("token" = ["admin"])),
    params(("name" = String, Path)), request_body = Project, responses((status = 200, body = Project)))]
pub async fn put_project(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Path(name): Path<String>,
    Json(project): Json<Project>,
) -> Result<Json<Project>> {
    confined(&caller)?;
    let possible = (1..=1_000_000).contains(&project.share)
        && project.running_max.is_none_or(|max| max >= 0)
        && [project.retention_days, project.outputs_days]
            .iter()
            .flatten()
            .all(|days| (0..=36_500).contains(days));
    if name != project.name || !limits::is_name(&name) || !possible {
        return Err(Error::invalid(
            "a project has the name of its path, a share from 1 to 1000000, `running_max` 0 or more, and days up to 36500",
        ));
    }
    api.coordinator.store.put_project(&project).await?;
    api.coordinator.changed([]);
    Ok(Json(project))
}

/// Changes and who made them, latest first.
#[utoipa::path(get, path = "/v1/audit", tag = "admin", security(("token" = ["admin"])), params(AuditQuery),
    responses((status = 200, body = AuditPage)))]
pub async fn audit(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Query(query): Query<AuditQuery>,
) -> Result<Json<AuditPage>> {
    confined(&caller)?;
    let limit = query.limit.unwrap_or(100).clamp(1, limits::PAGE_MAX);
    api.coordinator.store.audit(query.after.unwrap_or(i64::MAX), limit).await.map(Json)
}
