//! Submissions: a request becomes one job, or one for each frame; its scene is in storage before the job is in the queue.

use std::sync::Arc;

use axum::body::Bytes;
use futures_util::stream::{self, StreamExt, TryStreamExt};
use protocol::job::{JobRequest, ResubmitRequest, Submitted};
use protocol::keys;

use super::Coordinator;
use crate::db::job::NewJob;
use crate::error::Kind;
use crate::storage::sha256;
use crate::{Error, Result, random};

/// Who submits, and how.
#[derive(Clone, Copy, Debug)]
pub struct Submitter<'a> {
    /// The token's label.
    pub name: &'a str,
    /// The `Idempotency-Key`.
    pub key: Option<&'a str>,
}

/// Scenes that are put into storage at once.
const SCENES_AT_ONCE: usize = 32;
/// Bytes of an `Idempotency-Key` at most.
const KEY_BYTES_MAX: usize = 255;

impl Coordinator {
    /// Makes the jobs of a request, or finds those that it has made before.
    ///
    /// # Errors
    /// [`Kind::Invalid`] for a request or scene that is wrong, [`Kind::Conflict`] where files are missing or the key was
    /// used for another request.
    pub async fn submit(&self, request: &JobRequest, submitter: Submitter<'_>) -> Result<Submitted> {
        self.submit_as(request, submitter, None).await
    }

    /// Submits a job again, with edits.
    ///
    /// # Errors
    /// As [`submit`](Self::submit); [`Kind::NotFound`].
    pub async fn resubmit(
        &self,
        job: &str,
        edits: &ResubmitRequest,
        submitter: Submitter<'_>,
    ) -> Result<Submitted> {
        let (summary, mut request) = (self.store.job(job).await?, self.store.job_request(job).await?);
        if summary.pruned {
            return Err(Error::new(Kind::Conflict, "the job is past its retention: its scene is gone")
                .hint("submit its scene anew"));
        }
        request.scene = self.scene(job).await?;
        request.settings = edits.settings.clone().unwrap_or(request.settings);
        request.settings.frame = summary.frame.or(request.settings.frame);
        request.name = edits.name.clone().unwrap_or(request.name);
        request.priority = edits.priority.unwrap_or(summary.priority);
        request.comment = edits.comment.clone().unwrap_or(summary.comment);
        // One frame of a range is one job; and whoever submits a job again wants it to run
        (request.frames, request.paused) = (None, false);
        self.submit_as(&request, submitter, Some(job)).await
    }

    async fn submit_as(
        &self,
        request: &JobRequest,
        submitter: Submitter<'_>,
        resubmit_of: Option<&str>,
    ) -> Result<Submitted> {
        if submitter.key.is_some_and(|key| key.is_empty() || key.len() > KEY_BYTES_MAX) {
            return Err(Error::invalid(format!("an idempotency key has 1 to {KEY_BYTES_MAX} bytes")));
        }
        let request_sha256 = sha256(&serde_json::to_vec(&(request, resubmit_of))?);
        if let Some(key) = submitter.key
            && let Some(jobs) = self.store.find_idempotent(&request.project, key, &request_sha256).await?
        {
            return Ok(Submitted { jobs, repeated: true });
        }
        let frames = self.check(request).await?;
        let without_scene = Arc::new(JobRequest { scene: String::new(), ..request.clone() });
        let new = |frame: &Option<i64>| NewJob {
            id: random::id(self.now()),
            request: without_scene.clone(),
            request_sha256: request_sha256.clone(),
            idempotency_key: submitter.key.map(str::to_owned),
            frame: *frame,
            submitted_by: submitter.name.into(),
            resubmit_of: resubmit_of.map(str::to_owned),
        };
        let mut jobs: Vec<NewJob> = frames.iter().map(new).collect();
        jobs.sort_by(|a, b| a.id.cmp(&b.id));
        jobs.iter_mut().zip(frames).for_each(|(job, frame)| job.frame = frame);
        self.store_and_queue(&jobs, &request.scene).await
    }

    async fn store_and_queue(&self, jobs: &[NewJob], scene: &str) -> Result<Submitted> {
        let scene = Bytes::copy_from_slice(scene.as_bytes());
        let put = |job: &NewJob| {
            let (key, scene) = (keys::scene(&job.id), scene.clone());
            async move { self.storage.put(&key, scene).await }
        };
        // A disk is told to keep many files sooner at once than one after the other
        let puts = stream::iter(jobs.iter().map(put)).buffer_unordered(SCENES_AT_ONCE);
        puts.try_collect::<()>().await?;
        let made = self.store.submit(jobs, self.now()).await;
        let repeated = made.as_ref().is_ok_and(|made| made.first() != jobs.first().map(|job| &job.id));
        if repeated || made.as_ref().is_err_and(|error| error.kind != Kind::Unavailable) {
            // Nobody will ask for these scenes
            for job in jobs {
                self.storage.remove(&keys::scene(&job.id).into()).await?;
            }
        }
        let jobs = made?;
        self.changed(jobs.iter().cloned());
        Ok(Submitted { jobs, repeated })
    }
}
