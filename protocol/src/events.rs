//! What happened, as `GET /v1/events` tells it.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Something that happened.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Event {
    /// Its number; later events have greater ones.
    pub id: i64,
    /// Milliseconds since 1970.
    pub at: i64,
    /// What: `job.submitted`, `job.running`, `job.succeeded`, …
    pub kind: String,
    /// In which project.
    pub project: String,
    /// To which job.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub job: Option<String>,
    /// By whom.
    pub actor: String,
    /// Why, or to what.
    pub detail: String,
}
