//! Bounds that both sides keep: what they protect is said with each.

/// What one batch may add to any sum of what tracing took.
pub const TRACED_MAX: i64 = 1 << 42;
/// Bytes of a device's name.
pub const DEVICE_BYTES_MAX: usize = 200;
/// Bytes of a JSON request.
pub const REQUEST_BYTES_MAX: usize = 16 << 20;
/// Bytes of one uploaded asset.
pub const ASSET_BYTES_MAX: u64 = 1 << 40;
/// Files of one job.
pub const FILES_MAX: usize = 65_536;
/// Frames of one submission.
pub const FRAMES_MAX: i64 = 4_096;
/// Batches of one pass.
pub const BATCHES_MAX: i64 = 16 << 20;
/// Batches of one claim.
pub const CLAIM_MAX: i64 = 64;
/// Milliseconds that a claim may wait for work.
pub const CLAIM_WAIT_MS_MAX: u64 = 60_000;
/// Milliseconds between two heartbeats.
pub const HEARTBEAT_MS: u64 = 10_000;
/// Milliseconds after which a lease that nobody extends runs out.
pub const LEASE_TTL_MS: i64 = 60_000;
/// Milliseconds that a URL of an object holds.
pub const URL_TTL_MS: u64 = 900_000;
/// Objects of one request for URLs.
pub const URLS_MAX: usize = 256;
/// Files of a folder in storage.
pub const FOLDER_FILES_MAX: usize = 65_536;
/// Entries of a page of a list.
pub const PAGE_MAX: i64 = 1_000;
/// Bytes of an error's message.
pub const MESSAGE_BYTES_MAX: usize = 2_048;
/// Bytes of the log of one claim of a batch.
pub const LOG_BYTES_MAX: u64 = 4 << 20;
/// Labels of a worker.
pub const LABELS_MAX: usize = 64;
/// Bytes of a name: projects, workers, labels.
pub const NAME_BYTES_MAX: usize = 100;
/// Events that are sent again to a listener that was away.
pub const EVENT_REPLAY_MAX: i64 = 10_000;

/// Whether `name` can name a project, a worker, a token or a label: letters, digits, `-`, `_`, `.` and `=`.
pub fn is_name(name: &str) -> bool {
    let fits = |c: char| c.is_ascii_alphanumeric() || "-_.=".contains(c);
    !name.is_empty() && name.len() <= NAME_BYTES_MAX && name.chars().all(fits) && !name.starts_with('.')
}

/// `text` cut to at most `bytes` bytes, at a character.
pub fn cut(text: &str, bytes: usize) -> &str {
    let mut end = text.len().min(bytes);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}
