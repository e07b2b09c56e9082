//! Jobs: what their claims left that did not count, and what of them is past its retention.

use std::collections::BTreeSet;

use futures_util::TryStreamExt;
use protocol::gc::GcKind;
use protocol::{PassKind, keys};

use super::{Collector, is_log};
use crate::db::garbage::{Attempted, Marked};
use crate::db::retention::{DueJob, Life};
use crate::{Result, random};

/// Jobs, batches and marks of one query.
const PAGE: i64 = 200;

impl Collector<'_> {
    /// All jobs of which something is due.
    pub(super) async fn jobs(&mut self) -> Result<()> {
        let mut after = String::new();
        loop {
            let (coordinator, now) = (self.coordinator, self.coordinator.now());
            let retention = coordinator.settings.retention;
            let due = coordinator.store.due_jobs(&retention, now, &after, PAGE).await?;
            for job in &due {
                if !self.goes_on().await? {
                    return Ok(());
                }
                self.job(job).await?;
            }
            match due.last() {
                Some(last) => after.clone_from(&last.id),
                None => return Ok(()),
            }
        }
    }

    /// What is due of one job.
    pub(super) async fn job(&mut self, due: &DueJob) -> Result<()> {
        let store = &self.coordinator.store;
        if due.attempts && !due.work {
            self.mark_attempts(&due.id).await?;
        }
        // The manifest goes last: without it nobody would know what else is to go
        if due.outputs && self.begins(&due.id, Life::Outputs).await? {
            let kept = self.outputs(&due.id).await?;
            let (folder, manifest) = (keys::job(&due.id), keys::manifest(&due.id));
            let is_all = self.remove_below(&folder, GcKind::Output, |key| is_below(&kept, key)).await?
                && self.remove_below(&folder, GcKind::Output, |key| key == manifest).await?;
            self.ends(&due.id, Life::Outputs, is_all).await?;
        }
        if due.logs && self.begins(&due.id, Life::Logs).await? {
            let folder = format!("{}/logs", keys::job(&due.id));
            let mut is_all = self.remove_below(&folder, GcKind::Log, |_| true).await?;
            while is_all && !self.is_dry() {
                match store.remove_failures(&due.id).await? {
                    0 => break,
                    count => self.count(GcKind::Log, count.unsigned_abs(), 0),
                }
                is_all = self.goes_on().await?;
            }
            self.ends(&due.id, Life::Logs, is_all).await?;
        }
        if due.work && self.begins(&due.id, Life::Work).await? {
            let is_all = self.remove_rows(&due.id).await? && self.remove_work(&due.id).await?;
            self.ends(&due.id, Life::Work, is_all).await?;
        }
        if due.whole {
            if !self.is_dry() {
                store.remove_job(&due.id).await?;
            }
            self.count(GcKind::Job, 1, 0);
        }
        Ok(())
    }

    async fn begins(&self, job: &str, life: Life) -> Result<bool> {
        if self.is_dry() { Ok(true) } else { self.coordinator.store.begin_removal(job, life).await }
    }

    async fn ends(&self, job: &str, life: Life, is_all: bool) -> Result<()> {
        if is_all && !self.is_dry() {
            self.coordinator.store.end_removal(job, life).await?;
        }
        Ok(())
    }

    /// The rows of a job's batches; whether all of them went.
    async fn remove_rows(&mut self, job: &str) -> Result<bool> {
        let store = &self.coordinator.store;
        if self.is_dry() {
            let count = store.batch_rows(job).await?;
            self.count(GcKind::Batch, count.unsigned_abs(), 0);
            return Ok(true);
        }
        while let Some(removed) = store.remove_batches(job).await? {
            self.count(GcKind::Batch, removed.unsigned_abs(), 0);
            if !self.goes_on().await? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// All objects of a job but its logs and what it published; whether all of them went.
    async fn remove_work(&mut self, job: &str) -> Result<bool> {
        let kept = self.outputs(job).await?;
        let is_work = |key: &str| !is_log(job, key) && key != keys::manifest(job) && !is_below(&kept, key);
        self.remove_below(&keys::job(job), GcKind::Work, is_work).await
    }

    /// The folders of what a job has published: streams, and beside them what is for the eye.
    async fn outputs(&self, job: &str) -> Result<BTreeSet<String>> {
        let outputs =
            self.coordinator.manifest(job).await?.map(|manifest| manifest.outputs).unwrap_or_default();
        let folder = |key: &str| key.rsplit_once('/').map(|(folder, _)| folder.to_owned());
        Ok(outputs.iter().filter_map(|output| folder(&output.key)).collect())
    }

    /// Marks what claims of a job that has ended left and that did not count.
    async fn mark_attempts(&mut self, job: &str) -> Result<()> {
        let (store, now) = (&self.coordinator.store, self.coordinator.now());
        let mut after = (0, -1);
        loop {
            let page = store.attempted(job, after, PAGE).await?;
            for attempted in &page {
                let left = self.left_by(job, attempted).await?;
                if !self.is_dry() && !left.is_empty() {
                    store.mark(&left, now).await?;
                }
            }
            match page.last() {
                Some(last) => after = (last.pass, last.batch),
                None if self.is_dry() => return Ok(()),
                None => return store.attempts_marked(job).await,
            }
            if !self.goes_on().await? {
                return Ok(());
            }
        }
    }

    /// Objects of a batch's claims but those of the one that counted.
    async fn left_by(&self, job: &str, attempted: &Attempted) -> Result<Vec<Marked>> {
        let Attempted { pass, kind, batch, fence, ref sha256 } = *attempted;
        let (folder, counted) = match kind {
            PassKind::Bake => {
                let key = sha256.as_deref().map(|sha256| keys::part(job, pass, batch, fence, sha256));
                (format!("{}/p{pass}/b{batch:08}", keys::job(job)), key)
            }
            // Its claims write under the map's own key
            PassKind::Build => return Ok(Vec::new()),
            _ => (format!("{}/p{pass}", keys::job(job)), self.coordinator.store.result_key(pass).await?),
        };
        let is_counted = |key: &str| {
            let rest = counted.as_deref().and_then(|counted| key.strip_prefix(counted));
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        };
        let objects: Vec<_> = self.coordinator.storage.list(&folder).try_collect().await?;
        let marked = objects.into_iter().filter(|object| !is_counted(object.location.as_ref()));
        Ok(marked.map(|o| Marked { key: o.location.to_string(), bytes: o.size }).collect())
    }

    /// Removes what was marked long enough ago, if it still does not count.
    pub(super) async fn sweep_marked(&mut self) -> Result<()> {
        let mut after = String::new();
        loop {
            let (store, before) = (&self.coordinator.store, self.before());
            let page = store.marked(before, &after, PAGE).await?;
            for marked in &page {
                if !self.goes_on().await? {
                    return Ok(());
                }
                // An asset's mark keeps uploads of it away until it is gone
                let kind = if marked.key.starts_with("assets/") { GcKind::Asset } else { GcKind::Attempt };
                if kind == GcKind::Asset || self.is_garbage(&marked.key).await? {
                    self.remove(kind, vec![(marked.key.as_str().into(), marked.bytes)]).await?;
                }
                if !self.is_dry() {
                    store.unmark(&marked.key).await?;
                }
            }
            match page.last() {
                Some(last) => after.clone_from(&last.key),
                None => return Ok(()),
            }
        }
    }

    async fn is_garbage(&self, key: &str) -> Result<bool> {
        let store = &self.coordinator.store;
        match claim_of(key) {
            Some(Claim { pass, batch: Some(batch), fence, sha256_start }) => {
                store.is_superseded(pass, batch, fence, sha256_start).await
            }
            Some(Claim { pass, batch: None, fence, .. }) => {
                let counted = store.result_key(pass).await?;
                let is_counted = counted.is_some_and(|counted| key.starts_with(&format!("{counted}/")));
                // A pass of one batch: what it has no result for may still come
                Ok(!is_counted && store.is_superseded(pass, 0, fence, "-").await?)
            }
            None => Ok(false),
        }
    }

    /// Folders of jobs that were never queued, because their submission was cut off.
    pub(super) async fn orphan_jobs(&mut self) -> Result<()> {
        let coordinator = self.coordinator;
        let is_old = |id: &String| random::time_of(id).is_some_and(|at| at < self.before());
        let folders: Vec<String> =
            coordinator.storage.folders("jobs").await?.into_iter().filter(is_old).collect();
        for job in coordinator.store.unknown_jobs(&folders).await? {
            if !self.remove_below(&keys::job(&job), GcKind::Orphan, |_| true).await? {
                return Ok(());
            }
        }
        Ok(())
    }
}

/// Whether an object lies in one of the folders.
fn is_below(folders: &BTreeSet<String>, key: &str) -> bool {
    key.rsplit_once('/').is_some_and(|(folder, _)| folders.contains(folder))
}

/// What a key says of the claim that wrote the object.
#[derive(Debug, PartialEq, Eq)]
struct Claim<'a> {
    pass: i64,
    /// None where the pass has one batch.
    batch: Option<i64>,
    fence: i64,
    /// What the object's hash begins with.
    sha256_start: &'a str,
}

/// `jobs/J/p3/b00000007/f2-0a….part`, or `jobs/J/p3/f2/…`.
fn claim_of(key: &str) -> Option<Claim<'_>> {
    let mut parts = key.strip_prefix("jobs/")?.splitn(4, '/').skip(1);
    let pass = parts.next()?.strip_prefix('p')?.parse().ok()?;
    let (third, rest) = (parts.next()?, parts.next()?);
    if let Some(batch) = third.strip_prefix('b') {
        let (fence, hash) = rest.strip_suffix(".part")?.strip_prefix('f')?.split_once('-')?;
        let (batch, fence) = (batch.parse().ok()?, fence.parse().ok()?);
        return Some(Claim { pass, batch: Some(batch), fence, sha256_start: hash });
    }
    let fence = third.strip_prefix('f')?.parse().ok()?;
    Some(Claim { pass, batch: None, fence, sha256_start: "" })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a key that is read as another claim's, by which a result that counts would be removed.
    #[test]
    fn keys_say_their_claims() {
        let key = keys::part("j", 3, 7, 2, &"0a".repeat(32));
        let claim = Claim { pass: 3, batch: Some(7), fence: 2, sha256_start: "0a0a0a0a0a0a0a0a" };
        assert_eq!(claim_of(&key), Some(claim));
        let key = keys::index(&keys::result_folder("j", 3, 2));
        assert_eq!(claim_of(&key), Some(Claim { pass: 3, batch: None, fence: 2, sha256_start: "" }));
        for key in [keys::scene("j"), keys::manifest("j"), keys::log("j", 3, 7, 2), keys::asset("00")] {
            assert_eq!(claim_of(&key), None, "{key}");
        }
    }
}
