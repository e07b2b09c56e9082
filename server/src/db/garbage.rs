//! What nobody refers to: objects of claims that did not count, brick maps and assets of jobs that are gone. It is
//! marked or fenced off first, so that nothing comes to refer to it while it is being removed.

use protocol::{PassKind, PassState, keys};

use super::{Store, one, placeholders};
use crate::{Result, values};

/// A batch of which claims may have left objects that did not count.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attempted {
    /// The pass.
    pub pass: i64,
    /// Its kind.
    pub kind: PassKind,
    /// The batch.
    pub batch: i64,
    /// Its latest claim.
    pub fence: i64,
    /// The hash of its result, if it has one.
    pub sha256: Option<String>,
}

/// An object that is marked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Marked {
    /// Its key.
    pub key: String,
    /// Its bytes.
    pub bytes: u64,
}

/// An asset that no job of its project refers to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnusedAsset {
    /// The project.
    pub project: String,
    /// Its hash.
    pub sha256: String,
    /// Its bytes.
    pub bytes: i64,
}

impl Store {
    /// Becomes the one who does `name` for `ttl_ms`, or stays so; whether it is.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn lead(&self, name: &str, holder: &str, ttl_ms: i64, now: i64) -> Result<bool> {
        let mut tx = self.begin().await?;
        let sql = "INSERT INTO leader (name, holder, expires_at) VALUES ($1, $2, $3)
            ON CONFLICT (name) DO UPDATE SET holder = $2, expires_at = $3 WHERE leader.holder = $2 OR leader.expires_at < $4";
        let is_leader = tx.execute(sql.into(), values![name, holder, now + ttl_ms, now]).await? == 1;
        self.commit("lead", tx).await?;
        Ok(is_leader)
    }

    /// Lets another do `name`.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn step_down(&self, name: &str, holder: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "DELETE FROM leader WHERE name = $1 AND holder = $2";
        tx.execute(sql.into(), values![name, holder]).await?;
        self.commit("lead", tx).await
    }

    /// Batches of a job that has ended, after a batch, of which earlier or failed claims may have left objects.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn attempted(&self, job: &str, after: (i64, i64), limit: i64) -> Result<Vec<Attempted>> {
        let sql = "SELECT id, kind FROM pass WHERE job_id = $1 AND id >= $2 ORDER BY id";
        let mut found = Vec::new();
        for row in self.query(sql, values![job, after.0]).await? {
            let (pass, kind) = (row.int(0)?, row.word(1, PassKind::from_code)?);
            let left = limit - found.len() as i64;
            if left == 0 {
                break;
            }
            // Pass by pass, so that every page begins where the last one ended
            let sql = "SELECT seq, fence, CASE WHEN state = 2 THEN sha256 END FROM batch
                WHERE pass_id = $1 AND seq > $2 AND (fence > 1 OR (fence = 1 AND state <> 2)) ORDER BY seq LIMIT $3";
            let last = if pass == after.0 { after.1 } else { -1 };
            for row in self.query(sql, values![pass, last, left]).await? {
                let (batch, fence, sha256) = (row.int(0)?, row.int(1)?, row.text_or_null(2)?);
                found.push(Attempted { pass, kind, batch, fence, sha256 });
            }
        }
        Ok(found)
    }

    /// Marks objects.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn mark(&self, objects: &[Marked], now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        for object in objects {
            let sql =
                "INSERT INTO garbage (key, bytes, marked_at) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING";
            tx.execute(sql.into(), values![&object.key, object.bytes as i64, now]).await?;
        }
        self.commit("mark", tx).await
    }

    /// All attempts of a job that did not count are marked.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn attempts_marked(&self, job: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE job SET attempts_marked = 1 WHERE id = $1 AND ended_at IS NOT NULL";
        tx.execute(sql.into(), values![job]).await?;
        self.commit("mark", tx).await
    }

    /// Objects after the key `after` that were marked before `before`.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn marked(&self, before: i64, after: &str, limit: i64) -> Result<Vec<Marked>> {
        let sql = "SELECT key, bytes FROM garbage WHERE marked_at < $1 AND key > $2 ORDER BY key LIMIT $3";
        let rows = self.query(sql, values![before, after, limit]).await?;
        let marked = |row: &super::Row| Ok(Marked { key: row.text(0)?, bytes: row.int(1)?.unsigned_abs() });
        rows.iter().map(marked).collect()
    }

    /// Forgets a mark: the object is gone, or is kept.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn unmark(&self, key: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        tx.execute("DELETE FROM garbage WHERE key = $1".into(), values![key]).await?;
        self.commit("unmark", tx).await
    }

    /// Whether nothing can come to refer to what a claim of a batch left: the batch has another result, or none for good.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn is_superseded(&self, pass: i64, batch: i64, fence: i64, sha256_start: &str) -> Result<bool> {
        let sql = "SELECT b.state, b.fence, COALESCE(b.sha256, '') FROM batch b WHERE b.pass_id = $1 AND b.seq = $2";
        // A batch whose row is gone is of a job that is past its retention
        let Some(row) = self.query_one(sql, values![pass, batch]).await? else { return Ok(true) };
        let (is_done, is_over) = (row.int(0)? == 2, row.int(0)? >= 2);
        let counts = is_done && row.int(1)? == fence && row.text(2)?.starts_with(sha256_start);
        Ok(is_over && !counts)
    }

    /// The key under which a pass of one batch has its result.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn result_key(&self, pass: i64) -> Result<Option<String>> {
        let row = self.query_one("SELECT result FROM pass WHERE id = $1", values![pass]).await?;
        let Some(json) = row.and_then(|row| row.text_or_null(0).transpose()).transpose()? else {
            return Ok(None);
        };
        let saved: serde_json::Value = serde_json::from_str(&json)?;
        Ok(saved["key"].as_str().map(str::to_owned))
    }

    /// Brick maps after the map `after` that no job refers to, or whose removal was begun.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn unused_maps(&self, before: i64, after: &str, limit: i64) -> Result<Vec<String>> {
        let sql = "SELECT key FROM artifact WHERE key > $1 AND (pass_id = 0 OR (ready = 1 AND created_at < $2 AND NOT EXISTS (
                SELECT 1 FROM pass p JOIN job j ON j.id = p.job_id
                WHERE p.kind = 1 AND p.name = artifact.key AND j.work_gone = 0)))
            ORDER BY key LIMIT $3";
        self.query(sql, values![after, before, limit]).await?.iter().map(|row| row.text(0)).collect()
    }

    /// Whether a job other than `job` that is within its retention refers to a brick map.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn has_other_jobs(&self, map: &str, job: &str) -> Result<bool> {
        let sql = "SELECT 1 FROM pass p JOIN job j ON j.id = p.job_id
            WHERE p.kind = 1 AND p.name = $1 AND j.id <> $2 AND j.work_gone = 0 LIMIT 1";
        Ok(self.query_one(sql, values![map, job]).await?.is_some())
    }

    /// Fences a brick map off, if no job refers to it: whoever needs it from now on waits and builds it anew.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn fence_map(&self, key: &str) -> Result<bool> {
        let mut tx = self.begin().await?;
        let sql = format!("SELECT pass_id, ready FROM artifact WHERE key = $1{}", self.dialect().lock);
        let rows = tx.query(sql.into(), values![key]).await?;
        let Some(row) = rows.first() else { return Ok(false) };
        if row.int(0)? == 0 {
            return Ok(true);
        }
        let sql = "UPDATE artifact SET ready = 0, pass_id = 0 WHERE key = $1 AND ready = 1 AND NOT EXISTS (
                SELECT 1 FROM pass p JOIN job j ON j.id = p.job_id
                WHERE p.kind = 1 AND p.name = $1 AND j.work_gone = 0)";
        let is_fenced = tx.execute(sql.into(), values![key]).await? == 1;
        self.commit("fence", tx).await?;
        Ok(is_fenced)
    }

    /// Fences off a folder of brick maps that nobody has built: what a builder that died has left.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn fence_orphan_map(&self, key: &str, now: i64) -> Result<bool> {
        let mut tx = self.begin().await?;
        let sql = "INSERT INTO artifact (key, ready, pass_id, created_at) VALUES ($1, 0, 0, $2) ON CONFLICT DO NOTHING";
        let is_fenced = tx.execute(sql.into(), values![key, now]).await? == 1;
        self.commit("fence", tx).await?;
        Ok(is_fenced)
    }

    /// The objects of a brick map are gone: a pass that waits for it builds it; the job of that one.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn map_gone(&self, key: &str) -> Result<Option<String>> {
        let mut tx = self.begin().await?;
        let sql = format!("SELECT pass_id FROM artifact WHERE key = $1{}", self.dialect().lock);
        if one(tx.query(sql.into(), values![key]).await?)?.int(0)? != 0 {
            return Ok(None);
        }
        let sql =
            "SELECT id, job_id FROM pass WHERE kind = $1 AND name = $2 AND state = $3 ORDER BY id LIMIT 1";
        let waiting = values![PassKind::Build.code(), key, PassState::Waiting.code()];
        let rows = tx.query(sql.into(), waiting).await?;
        let heir = rows.first().map(|row| Ok::<_, crate::Error>((row.int(0)?, row.text(1)?))).transpose()?;
        self.bequeath(&mut tx, key, heir.as_ref().map(|(pass, _)| *pass)).await?;
        self.commit("fence", tx).await?;
        Ok(heir.map(|(_, job)| job))
    }

    /// Assets after an asset that nobody has used since `before` and no job of their project refers to.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn unused_assets(
        &self,
        before: i64,
        after: (&str, &str),
        limit: i64,
    ) -> Result<Vec<UnusedAsset>> {
        let sql = "SELECT project, sha256, bytes FROM asset
            WHERE (project > $1 OR (project = $1 AND sha256 > $2)) AND used_at < $3 AND NOT EXISTS (
                SELECT 1 FROM file_set f JOIN job j ON j.file_set = f.id
                WHERE f.sha256 = asset.sha256 AND j.project = asset.project)
            ORDER BY project, sha256 LIMIT $4";
        let rows = self.query(sql, values![after.0, after.1, before, limit]).await?;
        let asset = |row: &super::Row| {
            Ok(UnusedAsset { project: row.text(0)?, sha256: row.text(1)?, bytes: row.int(2)? })
        };
        rows.iter().map(asset).collect()
    }

    /// Takes an asset from its project if that is still so; whether no project has it any more: then its object is
    /// fenced off, and is to be removed.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn drop_asset(&self, asset: &UnusedAsset, before: i64, now: i64) -> Result<bool> {
        let mut tx = self.begin().await?;
        self.serialise_assets(&mut tx).await?;
        let sql = "DELETE FROM asset WHERE project = $1 AND sha256 = $2 AND used_at < $3 AND NOT EXISTS (
            SELECT 1 FROM file_set f JOIN job j ON j.file_set = f.id WHERE f.sha256 = $2 AND j.project = $1)";
        let values = values![&asset.project, &asset.sha256, before];
        let is_dropped = tx.execute(sql.into(), values).await? == 1;
        let sql = "SELECT 1 FROM asset WHERE sha256 = $1 LIMIT 1";
        let is_last = is_dropped && tx.query(sql.into(), values![&asset.sha256]).await?.is_empty();
        if is_last {
            self.fence_asset(&mut tx, &asset.sha256, asset.bytes, now).await?;
        }
        self.commit("drop_asset", tx).await?;
        Ok(is_last)
    }

    /// Fences off an object that no project has uploaded; whether it did.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn drop_orphan_asset(&self, sha256: &str, bytes: i64, now: i64) -> Result<bool> {
        let mut tx = self.begin().await?;
        self.serialise_assets(&mut tx).await?;
        let known = tx.query("SELECT 1 FROM asset WHERE sha256 = $1 LIMIT 1".into(), values![sha256]).await?;
        if !known.is_empty() {
            return Ok(false);
        }
        self.fence_asset(&mut tx, sha256, bytes, now).await?;
        self.commit("drop_asset", tx).await?;
        Ok(true)
    }

    async fn fence_asset(&self, tx: &mut super::Tx, sha256: &str, bytes: i64, now: i64) -> Result<()> {
        let sql = "INSERT INTO garbage (key, bytes, marked_at) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING";
        tx.execute(sql.into(), values![keys::asset(sha256), bytes, now]).await?;
        Ok(())
    }

    /// The names among `names` that no row of a table has as `column`.
    async fn unknown(&self, table: &str, column: &str, names: &[String]) -> Result<Vec<String>> {
        let mut unknown = Vec::new();
        for chunk in names.chunks(500) {
            let list = placeholders(1, chunk.len());
            let sql = format!("SELECT {column} FROM {table} WHERE {column} IN ({list})");
            let rows = self.query(sql, chunk.iter().map(Into::into).collect()).await?;
            let known = rows.iter().map(|row| row.text(0)).collect::<Result<Vec<_>>>()?;
            unknown.extend(chunk.iter().filter(|name| !known.contains(name)).cloned());
        }
        Ok(unknown)
    }

    /// The ids among `ids` that are no job's.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn unknown_jobs(&self, ids: &[String]) -> Result<Vec<String>> {
        self.unknown("job", "id", ids).await
    }

    /// The keys among `keys` that are no brick map's.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn unknown_maps(&self, keys: &[String]) -> Result<Vec<String>> {
        self.unknown("artifact", "key", keys).await
    }

    /// The hashes among `hashes` that no project has uploaded.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn unknown_assets(&self, hashes: &[String]) -> Result<Vec<String>> {
        self.unknown("asset", "sha256", hashes).await
    }
}
