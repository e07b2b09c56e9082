//! What jobs share: brick maps and uploads, removed when no job refers to them. Each is fenced off in the database first, so
//! that whoever needs it from then on waits, or is told to send it again.

use futures_util::{StreamExt, TryStreamExt};
use object_store::ObjectMeta;
use protocol::gc::GcKind;
use protocol::keys;

use super::Collector;
use crate::Result;
use crate::db::garbage::UnusedAsset;

/// Maps and assets of one query.
const PAGE: i64 = 200;

impl Collector<'_> {
    /// Brick maps that no job refers to.
    pub(super) async fn maps(&mut self) -> Result<()> {
        let mut after = String::new();
        loop {
            let unused = self.coordinator.store.unused_maps(self.before(), &after, PAGE).await?;
            for key in &unused {
                if !self.goes_on().await? {
                    return Ok(());
                }
                if self.is_dry() || self.coordinator.store.fence_map(key).await? {
                    self.remove_map(key).await?;
                }
            }
            match unused.last() {
                Some(last) => after.clone_from(last),
                None => return Ok(()),
            }
        }
    }

    /// Removes a brick map that is fenced off; its index first, without which it is none.
    async fn remove_map(&mut self, key: &str) -> Result<()> {
        let folder = keys::brick_map(key);
        let index = keys::index(&folder);
        if !self.is_dry() {
            self.coordinator.storage.remove(&index.as_str().into()).await?;
        }
        let is_all = self.remove_below(&folder, GcKind::BrickMap, |_| true).await?;
        if is_all && !self.is_dry() {
            let heir = self.coordinator.store.map_gone(key).await?;
            self.coordinator.changed(heir);
        }
        Ok(())
    }

    /// Uploads that no job of their project refers to.
    pub(super) async fn assets(&mut self) -> Result<()> {
        let (store, before) = (&self.coordinator.store, self.before());
        let mut after = (String::new(), String::new());
        loop {
            let unused = store.unused_assets(before, (&after.0, &after.1), PAGE).await?;
            for asset in &unused {
                if !self.goes_on().await? {
                    return Ok(());
                }
                if self.is_dry() {
                    self.count(GcKind::Asset, 1, asset.bytes.unsigned_abs());
                } else if store.drop_asset(asset, before, self.coordinator.now()).await? {
                    self.remove_asset(asset).await?;
                }
            }
            match unused.last() {
                Some(last) => after = (last.project.clone(), last.sha256.clone()),
                None => return Ok(()),
            }
        }
    }

    async fn remove_asset(&mut self, asset: &UnusedAsset) -> Result<()> {
        let key = keys::asset(&asset.sha256);
        self.remove(GcKind::Asset, vec![(key.as_str().into(), asset.bytes.unsigned_abs())]).await?;
        self.coordinator.store.unmark(&key).await
    }

    /// Objects of which the database has never heard: of submissions, uploads and builds that were cut off.
    pub(super) async fn orphans(&mut self) -> Result<()> {
        self.orphan_jobs().await?;
        let coordinator = self.coordinator;
        let maps = coordinator.storage.folders("brickmaps").await?;
        for key in coordinator.store.unknown_maps(&maps).await? {
            let now = coordinator.now();
            if self.is_dry() || coordinator.store.fence_orphan_map(&key, now).await? {
                self.remove_map(&key).await?;
            }
            if !self.goes_on().await? {
                return Ok(());
            }
        }
        let mut objects = coordinator.storage.list("assets").try_chunks(500);
        while let Some(objects) = objects.next().await {
            self.orphan_assets(&objects.map_err(|error| error.1)?).await?;
            if !self.goes_on().await? {
                return Ok(());
            }
        }
        Ok(())
    }

    async fn orphan_assets(&mut self, objects: &[ObjectMeta]) -> Result<()> {
        let (store, now, before) = (&self.coordinator.store, self.coordinator.now(), self.before());
        let old: Vec<&ObjectMeta> =
            objects.iter().filter(|object| object.last_modified.timestamp_millis() < before).collect();
        let name = |object: &ObjectMeta| object.location.filename().unwrap_or_default().to_owned();
        let hashes: Vec<String> = old.iter().map(|&object| name(object)).collect();
        let unknown = store.unknown_assets(&hashes).await?;
        for object in old.into_iter().filter(|&object| unknown.contains(&name(object))) {
            let (sha256, bytes) = (name(object), object.size as i64);
            if !keys::is_sha256(&sha256) {
                continue;
            }
            let asset = UnusedAsset { project: String::new(), sha256, bytes };
            if self.is_dry() {
                self.count(GcKind::Asset, 1, object.size);
            } else if store.drop_orphan_asset(&asset.sha256, bytes, now).await? {
                self.remove_asset(&asset).await?;
            }
        }
        Ok(())
    }
}
