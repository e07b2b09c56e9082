//! The bytes of a lease: which objects its worker may read and write, where, and for how long.
//!
//! With S3 and its like a worker gets signed URLs and we see none of its bytes. With a local folder the URLs are our own;
//! each is bound to the lease and asked with the worker's token, so it holds exactly as long as the lease.

use std::collections::HashSet;
use std::fmt::Write;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use object_store::GetRange;
use protocol::limits::{LOG_BYTES_MAX, URL_TTL_MS, URLS_MAX, cut};
use protocol::storage::{ObjectRequest, ObjectUrl, SceneFiles, UrlsReply, UrlsRequest};
use protocol::work::{LogRequest, PartPage, Task};
use protocol::{PassKind, keys};

use super::{Coordinator, lock};
use crate::db::lease::Held;
use crate::error::Kind;
use crate::storage::{Expected, Outgoing};
use crate::{Error, Result};

/// Jobs whose assets are remembered.
const JOBS_MAX: usize = 64;
/// Parts of a page.
const PARTS_PAGE: i64 = 1_000;

/// A worker's request about a lease.
#[derive(Clone, Copy, Debug)]
pub struct Holder<'a> {
    /// The lease.
    pub lease: &'a str,
    /// The process.
    pub session: &'a str,
    /// Its token; none without tokens.
    pub token: Option<&'a str>,
}

impl Coordinator {
    /// What a lease is of, if it is this worker's and live.
    async fn held(&self, holder: Holder<'_>) -> Result<(Held, Arc<Task>)> {
        self.session(holder.session, holder.token).await?;
        let held = self.store.held(holder.lease, holder.session).await?;
        let held = held.ok_or_else(|| Error::new(Kind::Gone, "the lease is over"))?;
        let task = self.task(held.pass).await?;
        Ok((held, task))
    }

    /// Where a lease's worker reads and writes objects.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the lease is over, [`Kind::Forbidden`] for an object that is not the lease's.
    pub async fn urls(&self, lease: &str, request: &UrlsRequest, token: Option<&str>) -> Result<UrlsReply> {
        if request.items.len() > URLS_MAX {
            let message = format!("`{}` objects, {URLS_MAX} are possible", request.items.len());
            return Err(Error::new(Kind::TooLarge, message));
        }
        let (held, task) = self.held(Holder { lease, session: &request.session, token }).await?;
        let mut urls = Vec::with_capacity(request.items.len());
        for item in &request.items {
            urls.push(self.url(lease, &request.session, &held, &task, item).await?);
        }
        Ok(UrlsReply { urls })
    }

    async fn url(
        &self,
        lease: &str,
        session: &str,
        held: &Held,
        task: &Task,
        item: &ObjectRequest,
    ) -> Result<ObjectUrl> {
        let ttl = Duration::from_millis(URL_TTL_MS);
        let (key, query, signed) = match item {
            ObjectRequest::Get { key } => {
                self.may_read(held, task, key).await?;
                (key, String::new(), self.storage.get_url(key, ttl).await?)
            }
            ObjectRequest::Put { key, sha256, bytes } => {
                may_write(held, task, key)?;
                let bytes_max = self.settings.asset_bytes_max;
                if !keys::is_sha256(sha256) || *bytes > bytes_max {
                    return Err(Error::invalid(format!("`{key}` cannot have this hash and `{bytes}` bytes")));
                }
                let expected = Expected { sha256, bytes: Some(*bytes), bytes_max };
                let query = format!("&sha256={sha256}&bytes={bytes}");
                (key, query, self.storage.put_url(key, expected, ttl).await?)
            }
        };
        let own = || format!("/v1/leases/{lease}/objects?session={session}&key={}{query}", escaped(key));
        Ok(signed.unwrap_or_else(|| ObjectUrl { url: own(), headers: Default::default() }))
    }

    /// An object of a lease, or a range of it.
    ///
    /// # Errors
    /// As [`urls`](Self::urls); [`Kind::NotFound`].
    pub async fn read_object(
        &self,
        holder: Holder<'_>,
        key: &str,
        range: Option<GetRange>,
    ) -> Result<Outgoing> {
        let (held, task) = self.held(holder).await?;
        self.may_read(&held, &task, key).await?;
        self.storage.send(key, range).await
    }

    /// Takes an object of a lease.
    ///
    /// # Errors
    /// As [`urls`](Self::urls); [`Kind::Invalid`] where the bytes are not those of the hash.
    pub async fn write_object(
        &self,
        holder: Holder<'_>,
        key: &str,
        sha256: &str,
        bytes: u64,
        body: Body,
    ) -> Result<()> {
        let (held, task) = self.held(holder).await?;
        may_write(&held, &task, key)?;
        let bytes_max = self.settings.asset_bytes_max;
        self.storage.receive(key, body, Expected { sha256, bytes: Some(bytes), bytes_max }).await?;
        Ok(())
    }

    /// The scene of a lease's job.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the lease is over.
    pub async fn lease_scene(&self, holder: Holder<'_>) -> Result<SceneFiles> {
        let (held, _) = self.held(holder).await?;
        Ok(SceneFiles {
            scene: self.scene(&held.job).await?,
            files: self.store.job_request(&held.job).await?.files,
        })
    }

    /// The parts that a lease's task merges, those after batch `after`.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the lease is over, [`Kind::Conflict`] where its task merges nothing.
    pub async fn lease_parts(&self, holder: Holder<'_>, after: Option<i64>) -> Result<PartPage> {
        let (_, task) = self.held(holder).await?;
        let parts =
            task.parts.ok_or_else(|| Error::new(Kind::Conflict, "the lease's task merges nothing"))?;
        self.store.parts(parts, after.unwrap_or(-1), PARTS_PAGE).await
    }

    /// Adds lines to the log of a claim of a batch.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the lease is over or the batch not its own, [`Kind::TooLarge`] when the log is full.
    pub async fn add_log(&self, lease: &str, request: &LogRequest, token: Option<&str>) -> Result<()> {
        let (held, _) = self.held(Holder { lease, session: &request.session, token }).await?;
        let is_held = |batch: &protocol::work::ClaimedBatch| {
            (batch.batch, batch.fence) == (request.batch, request.fence)
        };
        if !held.batches.iter().any(is_held) {
            return Err(Error::new(Kind::Gone, format!("batch `{}` is not leased to you", request.batch)));
        }
        let key = keys::log(&held.job, held.pass, request.batch, request.fence);
        // Only the holder writes this object, and one line after the other
        let mut log = self.storage.get(&key).await?.map_or_else(Vec::new, Vec::from);
        if log.len() as u64 + request.text.len() as u64 > LOG_BYTES_MAX {
            return Err(Error::new(Kind::TooLarge, format!("the log has {LOG_BYTES_MAX} bytes at most")));
        }
        log.extend_from_slice(request.text.as_bytes());
        if !request.text.ends_with('\n') {
            log.push(b'\n');
        }
        self.storage.put(&key, log).await
    }

    /// A job's scene, XML.
    ///
    /// # Errors
    /// When it is not there, or is not text.
    pub(super) async fn scene(&self, job: &str) -> Result<String> {
        let key = keys::scene(job);
        let scene = self.storage.get(&key).await?.ok_or_else(|| Error::not_found("object", &key))?;
        String::from_utf8(scene.into()).map_err(|_| Error::new(Kind::Internal, "a scene is not text"))
    }

    async fn may_read(&self, held: &Held, task: &Task, key: &str) -> Result<()> {
        let below = |folder: &str| key.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/'));
        let folders = [
            task.inputs.clone(),
            task.plan.clone(),
            task.map.as_deref().map(keys::brick_map),
            task.parts.map(|pass| format!("{}/p{pass}", keys::job(&held.job))),
        ];
        let is_asset = || key.strip_prefix("assets/").and_then(|rest| rest.split('/').nth(1));
        let allowed = folders.iter().flatten().any(|folder| below(folder))
            || match is_asset() {
                Some(sha256) => self.assets_of(&held.job).await?.contains(sha256),
                None => false,
            };
        if allowed && keys::is_relative(key) { Ok(()) } else { Err(not_yours(key)) }
    }

    /// The hashes of the assets that a job's scene refers to; they never change.
    async fn assets_of(&self, job: &str) -> Result<Arc<HashSet<String>>> {
        if let Some(assets) = lock(&self.assets).get(job) {
            return Ok(assets.clone());
        }
        let files = self.store.job_request(job).await?.files;
        let found: Arc<HashSet<String>> = Arc::new(files.into_values().collect());
        let mut assets = lock(&self.assets);
        if assets.len() >= JOBS_MAX {
            assets.clear();
        }
        assets.insert(job.into(), found.clone());
        Ok(found)
    }
}

/// Whether a lease's worker may write this object: its key must hold the fence of a batch that is still leased, or be of
/// the brick map that it builds.
fn may_write(held: &Held, task: &Task, key: &str) -> Result<()> {
    let job = keys::job(&held.job);
    let allowed = held.batches.iter().any(|batch| match (task.kind, &task.map) {
        (PassKind::Bake, _) => {
            let part = format!("{job}/p{}/b{:08}/f{}-", held.pass, batch.batch, batch.fence);
            key.starts_with(&part) && !key[part.len()..].contains('/')
        }
        (PassKind::Build, Some(map)) => key.starts_with(&format!("{}/", keys::brick_map(map))),
        _ => key.starts_with(&format!("{}/", keys::result_folder(&held.job, held.pass, batch.fence))),
    });
    if allowed && keys::is_relative(key) { Ok(()) } else { Err(not_yours(key)) }
}

fn not_yours(key: &str) -> Error {
    Error::new(Kind::Forbidden, format!("the object `{}` is not this lease's", cut(key, 200)))
}

/// A key as a value in a query.
fn escaped(key: &str) -> String {
    let mut text = String::with_capacity(key.len());
    for byte in key.bytes() {
        if byte.is_ascii_alphanumeric() || b"-_./".contains(&byte) {
            text.push(char::from(byte));
        } else {
            // Writing to a string does not fail
            let _ = write!(text, "%{byte:02X}");
        }
    }
    text
}
