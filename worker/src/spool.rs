//! Finished parts on the local disk until the coordinator has acknowledged them, within a quota.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use protocol::storage::FolderFile;
use protocol::traced::Traced;
use protocol::work::ClaimedBatch;

use crate::cache::Scratch;
use crate::execute::Baked;
use crate::heartbeat::Lease;
use crate::{Result, digest};

/// A finished part.
#[derive(Debug)]
pub struct Spooled {
    /// The lease under which it was baked.
    pub lease: Arc<Lease>,
    /// The pass.
    pub pass: i64,
    /// The job.
    pub job: String,
    /// Batch and fence.
    pub batch: ClaimedBatch,
    /// The part.
    pub path: PathBuf,
    /// Its hash and length.
    pub content: FolderFile,
    /// How long it took.
    pub elapsed: Duration,
    /// What there is to say about it.
    pub log: String,
    /// What traced.
    pub device: String,
    /// What tracing took.
    pub traced: Traced,
}

/// Finished parts, first in, first out.
#[derive(Debug)]
pub struct Spool {
    folder: Scratch,
    bytes_max: u64,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Spooled>,
    /// Of all parts that are not acknowledged.
    bytes: u64,
    /// Parts that are being put.
    busy: usize,
    closed: bool,
}

impl Spool {
    /// An empty spool in `folder`.
    pub fn new(folder: Scratch, bytes_max: u64) -> Self {
        Self { folder, bytes_max, state: Mutex::default(), changed: Condvar::new() }
    }

    /// Keeps a part; waits for room as long as its lease is live.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn push(
        &self,
        lease: &Arc<Lease>,
        (pass, job): (i64, &str),
        batch: ClaimedBatch,
        baked: Baked<'_>,
    ) -> Result<()> {
        let Baked { bytes, elapsed, traced, .. } = baked;
        let path = self.folder.path().join(format!("{pass}-{}-{}.part", batch.batch, batch.fence));
        std::fs::write(&path, bytes).map_err(|error| engine::Error::io("write", &path, error))?;
        let content = digest::of_bytes(bytes);
        let mut state = self.state();
        while state.bytes > 0 && state.bytes + content.bytes > self.bytes_max && lease.is_live() {
            let waited = self.changed.wait_timeout(state, Duration::from_millis(200));
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        state.bytes += content.bytes;
        let (lease, job) = (lease.clone(), job.to_owned());
        let (log, device) = (baked.log.to_owned(), baked.device.to_owned());
        let part = Spooled { lease, pass, job, batch, path, content, elapsed, log, device, traced };
        state.waiting.push_back(part);
        self.changed.notify_all();
        Ok(())
    }

    /// Takes the next parts, up to `count` and of one lease; none when the spool is closed and empty.
    pub fn take(&self, count: usize) -> Vec<Spooled> {
        let mut state = self.state();
        while state.waiting.is_empty() && !state.closed {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        let mut taken: Vec<Spooled> = Vec::new();
        while taken.len() < count
            && state
                .waiting
                .front()
                .is_some_and(|next| taken.first().is_none_or(|one| one.lease.id == next.lease.id))
        {
            taken.extend(state.waiting.pop_front());
        }
        state.busy = taken.len();
        taken
    }

    /// These parts are acknowledged, or nobody wants them.
    pub fn forget(&self, parts: &[Spooled]) {
        for part in parts {
            if let Err(error) = std::fs::remove_file(&part.path) {
                tracing::warn!("cannot remove {}: {error}", part.path.display());
            }
        }
        let mut state = self.state();
        state.bytes -= parts.iter().map(|part| part.content.bytes).sum::<u64>();
        state.busy = 0;
        self.changed.notify_all();
    }

    /// Waits until nothing is left of `lease`.
    pub fn flush(&self, lease: &Lease) {
        let mut state = self.state();
        while state.busy > 0 || state.waiting.iter().any(|part| part.lease.id == lease.id) {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Nothing more will come.
    pub fn close(&self) {
        self.state().closed = true;
        self.changed.notify_all();
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
