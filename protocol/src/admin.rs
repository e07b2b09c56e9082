//! What administrators say, and hear: workers, tokens, tickets, projects, the audit, storage.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::states::Role;
use crate::traced::Traced;

/// A worker as lists have it.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct WorkerDetail {
    /// Its name.
    pub name: String,
    /// `busy`, `idle`, `draining`, `locked`, `sick` or `lost`.
    pub state: String,
    /// What it is and has.
    pub labels: Vec<String>,
    /// Memory that it may use.
    pub memory_bytes: i64,
    /// The program's version.
    pub version: String,
    /// Batches that it has.
    pub leased: i64,
    /// Batches of which it was to blame for the failure, lately.
    pub errors: i64,
    /// Why the coordinator has locked it, where it has.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
    /// What traced the batches that it reported last: `cpu`, or the names of adapters; empty where it has traced none.
    #[serde(default)]
    pub device: String,
    /// What tracing its batches of that pass took.
    #[serde(default)]
    pub traced: Option<Traced>,
    /// Milliseconds since 1970 when it was last heard of.
    pub last_seen: i64,
}

/// Which hashes are not in storage, or not known to belong to the project.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct MissingRequest {
    /// The project.
    pub project: String,
    /// SHA-256 in hexadecimal, up to 65,536.
    pub sha256: Vec<String>,
}

/// The hashes to upload.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct MissingReply {
    /// Those that are missing.
    pub missing: Vec<String>,
}

/// A token to be.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct TokenRequest {
    /// What it may do.
    pub role: Role,
    /// The only project that it may see and change.
    #[serde(default)]
    pub project: Option<String>,
    /// Whose it is.
    pub label: String,
    /// Seconds until it expires.
    #[serde(default)]
    pub expires_s: Option<i64>,
}

/// A secret, shown this once.
#[derive(Clone, Serialize, Deserialize, ToSchema)]
pub struct Secret {
    /// Its id, which is no secret.
    pub id: String,
    /// The secret.
    pub secret: String,
}

/// A token as lists have it.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct TokenDetail {
    /// Its id.
    pub id: String,
    /// What it may do.
    pub role: Role,
    /// The only project that it may see and change.
    pub project: Option<String>,
    /// Whose it is.
    pub label: String,
    /// When it was made.
    pub created_at: i64,
    /// When it expires.
    pub expires_at: Option<i64>,
    /// When it was revoked.
    pub revoked_at: Option<i64>,
    /// When it was last used, to the minute.
    pub last_used_at: Option<i64>,
}

/// A ticket by which workers enrol.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct TicketRequest {
    /// Workers that may enrol with it.
    pub uses: i64,
    /// Seconds until it expires.
    pub expires_s: i64,
    /// Labels that every such worker gets.
    #[serde(default)]
    pub labels: Vec<String>,
}

/// A worker trades a ticket for a token of its own.
#[derive(Clone, Serialize, Deserialize, ToSchema)]
pub struct EnrolRequest {
    /// The ticket's secret.
    pub ticket: String,
    /// The worker's name: the token works for this name only.
    pub name: String,
}

/// A project.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct Project {
    /// Its name.
    pub name: String,
    /// Its share of the farm, against those of others.
    pub share: i64,
    /// Batches that run at once at most, over all of its jobs.
    #[serde(default)]
    pub running_max: Option<i64>,
    /// Days after a job's end that its batches, parts and scene are kept: 14 unless something is said; a change that says
    /// nothing leaves it as it is.
    #[serde(default)]
    pub retention_days: Option<i64>,
    /// Days after a job's end that what it published is kept: for ever unless something is said; likewise.
    #[serde(default)]
    pub outputs_days: Option<i64>,
}

/// A change, and who made it.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct AuditEntry {
    /// Its number.
    pub id: i64,
    /// Milliseconds since 1970.
    pub at: i64,
    /// The token's label.
    pub actor: String,
    /// The token's id; none for anonymous requests.
    pub token: Option<String>,
    /// The caller's address.
    pub address: String,
    /// Method and path.
    pub action: String,
    /// HTTP status of the answer.
    pub status: i64,
}

/// A page of the audit, latest first.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct AuditPage {
    /// Entries.
    pub entries: Vec<AuditEntry>,
    /// The cursor of the next page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<i64>,
}

/// A browser signs in with a token.
#[derive(Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SignInRequest {
    /// The token's secret.
    pub token: String,
}

/// Who a browser is signed in as.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct SessionDetail {
    /// The token's label.
    pub name: String,
    /// What it may do.
    pub role: Role,
    /// The only project that it may see and change.
    pub project: Option<String>,
    /// When it ends; none where everybody may do everything without a token.
    pub expires_at: Option<i64>,
    /// What every change must send in the header `X-Pantaray-CSRF`.
    pub csrf: String,
    /// The coordinator's version.
    pub version: String,
    /// Milliseconds since 1970 by the coordinator's clock.
    pub now: i64,
}
