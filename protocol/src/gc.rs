//! What garbage collection is asked, and tells.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// An administrator wants garbage collected now: `POST /v1/gc`.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct GcRequest {
    /// Say what would go, and remove nothing.
    #[serde(default)]
    pub dry_run: bool,
}

/// What was removed, or would be.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct GcReport {
    /// Whether nothing was removed.
    pub dry_run: bool,
    /// Whether there was no time for all: ask again.
    pub more: bool,
    /// Kind by kind, in the order in which it goes.
    pub items: Vec<GcItem>,
}

/// Garbage of one kind.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct GcItem {
    /// What it is.
    pub kind: GcKind,
    /// How many objects or rows.
    pub count: u64,
    /// Bytes of the objects.
    pub bytes: u64,
}

/// A kind of garbage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum GcKind {
    /// Objects of claims that did not count.
    Attempt,
    /// Rows of batches of jobs that are past their retention.
    Batch,
    /// Parts, imports, plans and scenes of such jobs.
    Work,
    /// Logs, and rows of failures.
    Log,
    /// Published streams.
    Output,
    /// Jobs that were deleted.
    Job,
    /// Objects of brick maps that no job refers to.
    BrickMap,
    /// Uploads that no job refers to.
    Asset,
    /// Objects of jobs that were never queued.
    Orphan,
    /// Events.
    Event,
    /// Entries of the audit.
    Audit,
    /// Tickets that have run out, and workers that were not heard of for a month.
    Absent,
}

impl GcKind {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::Attempt,
        Self::Batch,
        Self::Work,
        Self::Log,
        Self::Output,
        Self::Job,
        Self::BrickMap,
        Self::Asset,
        Self::Orphan,
        Self::Event,
        Self::Audit,
        Self::Absent,
    ];

    /// A word for metrics and tables.
    pub fn word(self) -> &'static str {
        match self {
            Self::Attempt => "attempt",
            Self::Batch => "batch",
            Self::Work => "work",
            Self::Log => "log",
            Self::Output => "output",
            Self::Job => "job",
            Self::BrickMap => "brick_map",
            Self::Asset => "asset",
            Self::Orphan => "orphan",
            Self::Event => "event",
            Self::Audit => "audit",
            Self::Absent => "absent",
        }
    }
}

impl GcReport {
    /// Adds `count` of a kind, with `bytes`.
    pub fn add(&mut self, kind: GcKind, count: u64, bytes: u64) {
        if count == 0 {
            return;
        }
        match self.items.binary_search_by_key(&kind, |item| item.kind) {
            Ok(place) => {
                self.items[place].count += count;
                self.items[place].bytes += bytes;
            }
            Err(place) => self.items.insert(place, GcItem { kind, count, bytes }),
        }
    }

    /// How many of a kind.
    pub fn count(&self, kind: GcKind) -> u64 {
        self.items.iter().find(|item| item.kind == kind).map_or(0, |item| item.count)
    }
}

/// What would go with a job if it were deleted: `GET /v1/jobs/{id}/delete-preview`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct DeletePreview {
    /// The job.
    pub job: String,
    /// Why it cannot be deleted now, where that is so.
    pub refused: Option<String>,
    /// What would go at once.
    pub report: GcReport,
    /// Streams that it published, which would go, too.
    pub outputs: Vec<String>,
    /// Brick maps that would go at the next collection, since no other job refers to them.
    pub brick_maps: Vec<String>,
}
