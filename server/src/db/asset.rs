//! Which projects have uploaded which assets, and which parts a pass has committed.

use std::collections::BTreeSet;

use protocol::job::JobRequest;
use protocol::keys;
use protocol::work::{PartEntry, PartPage};

use super::{Store, Tx, placeholders};
use crate::error::Kind;
use crate::storage::sha256;
use crate::{Error, Result, values};

/// Hashes of one statement.
const ROWS: usize = 500;

impl Store {
    /// The hashes among `hashes` that the project has not uploaded.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn missing_assets(&self, project: &str, hashes: &[String]) -> Result<Vec<String>> {
        let mut missing = Vec::new();
        for chunk in hashes.chunks(ROWS) {
            let list = placeholders(2, chunk.len());
            let sql = format!("SELECT sha256 FROM asset WHERE project = $1 AND sha256 IN ({list})");
            let mut values = values![project];
            values.extend(chunk.iter().map(Into::into));
            let rows = self.query(sql, values).await?;
            let known = rows.iter().map(|row| row.text(0)).collect::<Result<Vec<_>>>()?;
            missing.extend(chunk.iter().filter(|hash| !known.contains(hash)).cloned());
        }
        Ok(missing)
    }

    /// The bytes of assets of a project, all together.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn asset_bytes(&self, project: &str, hashes: &[String]) -> Result<i64> {
        let mut bytes = 0;
        for chunk in hashes.chunks(ROWS) {
            let list = placeholders(2, chunk.len());
            let sql = format!(
                "SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM asset WHERE project = $1 AND sha256 IN ({list})"
            );
            let mut values = values![project];
            values.extend(chunk.iter().map(Into::into));
            bytes += self.query_one(sql, values).await?.map_or(Ok(0), |row| row.int(0))?;
        }
        Ok(bytes)
    }

    /// Notes that the project has uploaded an asset.
    ///
    /// # Errors
    /// [`Kind::Unavailable`] while the object is being removed because nobody referred to it: the upload must be repeated.
    pub async fn add_asset(&self, project: &str, sha256: &str, bytes: i64, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        self.serialise_assets(&mut tx).await?;
        let going =
            tx.query("SELECT 1 FROM garbage WHERE key = $1".into(), values![keys::asset(sha256)]).await?;
        if !going.is_empty() {
            return Err(Error::new(Kind::Unavailable, "the asset is being removed: send it again"));
        }
        let sql =
            "INSERT INTO asset (project, sha256, bytes, created_at, used_at) VALUES ($1, $2, $3, $4, $4)
            ON CONFLICT (project, sha256) DO UPDATE SET used_at = $4";
        tx.execute(sql.into(), values![project, sha256, bytes, now]).await?;
        self.commit("asset", tx).await
    }

    /// Takes back that the project has an asset.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn forget_asset(&self, project: &str, sha256: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "DELETE FROM asset WHERE project = $1 AND sha256 = $2";
        tx.execute(sql.into(), values![project, sha256]).await?;
        self.commit("asset", tx).await
    }

    /// Makes jobs to be of this request refer to its files; the set of them.
    pub(super) async fn refer_to_files(
        &self,
        tx: &mut Tx,
        request: &JobRequest,
        now: i64,
    ) -> Result<Option<String>> {
        let hashes: BTreeSet<&String> = request.files.values().collect();
        if hashes.is_empty() {
            return Ok(None);
        }
        self.serialise_assets(tx).await?;
        let hashes: Vec<&String> = hashes.into_iter().collect();
        let set = sha256(&serde_json::to_vec(&hashes)?);
        for chunk in hashes.chunks(ROWS) {
            let list = placeholders(3, chunk.len());
            let sql = format!("UPDATE asset SET used_at = $2 WHERE project = $1 AND sha256 IN ({list})");
            let mut values = values![&request.project, now];
            values.extend(chunk.iter().map(|&hash| hash.into()));
            // They were there when the request was checked; a removal may have come between
            if tx.execute(sql.into(), values).await? != chunk.len() as u64 {
                return Err(Error::new(Kind::Conflict, "files of the scene are not uploaded any more")
                    .hint("ask `POST /v1/assets/missing`, then `PUT /v1/assets/{sha256}`"));
            }
            let rows = (2..2 + chunk.len()).map(|number| format!("($1, ${number})")).collect::<Vec<_>>();
            let sql = format!(
                "INSERT INTO file_set (id, sha256) VALUES {} ON CONFLICT DO NOTHING",
                rows.join(", ")
            );
            let mut values = values![&set];
            values.extend(chunk.iter().map(|&hash| hash.into()));
            tx.execute(sql.into(), values).await?;
        }
        Ok(Some(set))
    }

    pub(super) async fn serialise_assets(&self, tx: &mut Tx) -> Result<()> {
        if let Some(sql) = self.dialect().serialise_assets {
            tx.query(sql.into(), vec![]).await?;
        }
        Ok(())
    }

    /// The committed parts of a pass after batch `after`, up to `limit`.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn parts(&self, pass: i64, after: i64, limit: i64) -> Result<PartPage> {
        let sql = "SELECT seq, fence, sha256, bytes FROM batch
            WHERE pass_id = $1 AND seq > $2 AND state = 2 ORDER BY seq LIMIT $3";
        let rows = self.query(sql, values![pass, after, limit]).await?;
        let part = |row: &super::Row| {
            Ok(PartEntry { batch: row.int(0)?, fence: row.int(1)?, sha256: row.text(2)?, bytes: row.int(3)? })
        };
        let parts = rows.iter().map(part).collect::<Result<Vec<_>>>()?;
        let next = if parts.len() as i64 == limit { parts.last().map(|part| part.batch) } else { None };
        Ok(PartPage { parts, next })
    }

    /// About `wanted` committed parts of a pass, spread over those that there are; and how many those are.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn some_parts(&self, pass: i64, wanted: i64) -> Result<(Vec<PartEntry>, i64)> {
        let sql = "SELECT CAST(COALESCE(SUM(n_done), 0) AS BIGINT) FROM segment WHERE pass_id = $1";
        let done = self.query_one(sql, values![pass]).await?.map_or(Ok(0), |row| row.int(0))?;
        let sql = "SELECT seq, fence, sha256, bytes FROM batch
            WHERE pass_id = $1 AND state = 2 AND bytes > 0 AND seq % $2 = 0 ORDER BY seq LIMIT $3";
        let rows = self.query(sql, values![pass, (done / wanted).max(1), 2 * wanted]).await?;
        let part = |row: &super::Row| {
            Ok(PartEntry { batch: row.int(0)?, fence: row.int(1)?, sha256: row.text(2)?, bytes: row.int(3)? })
        };
        Ok((rows.iter().map(part).collect::<Result<Vec<_>>>()?, done))
    }
}
