//! What is kept how long: jobs that are past their retention lose batches, parts and scene, later their logs, and what they
//! published where their project says so. The job and the counts of its passes stay, unless a person deleted it.
//!
//! Rows go segment by segment: a segment's counts move to its pass in the transaction that removes its batches, so
//! the counts are right at every moment.

use protocol::JobState;

use super::{Store, Tx, one};
use crate::error::Kind;
use crate::{Error, Result, values};

/// Rows that one transaction removes at most, about.
const ROWS_MAX: i64 = 5_000;
/// Milliseconds of a day.
pub const DAY_MS: i64 = 86_400_000;

/// How long things are kept that no project decides about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retention {
    /// Days after a job's end that its logs and failures are kept.
    pub log_days: i64,
    /// Days that events are kept.
    pub event_days: i64,
    /// Days that the audit is kept.
    pub audit_days: i64,
}

impl Default for Retention {
    fn default() -> Self {
        Self { log_days: 30, event_days: 7, audit_days: 365 }
    }
}

/// A job of which something is to go.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DueJob {
    /// The job.
    pub id: String,
    /// Objects of claims that did not count are to be marked.
    pub attempts: bool,
    /// Batches, parts and scene are to go.
    pub work: bool,
    /// Logs and failures are to go.
    pub logs: bool,
    /// What it published is to go.
    pub outputs: bool,
    /// The job itself is to go.
    pub whole: bool,
}

/// What lives of a job may have ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Life {
    /// Batches, parts and scene.
    Work,
    /// Logs and failures.
    Logs,
    /// What it published.
    Outputs,
}

impl Life {
    fn column(self) -> &'static str {
        match self {
            Self::Work => "work_gone",
            Self::Logs => "logs_gone",
            Self::Outputs => "outputs_gone",
        }
    }
}

/// Tables whose rows go by age.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Aged {
    /// What happened.
    Event,
    /// Who changed what.
    Audit,
}

impl Aged {
    /// The table.
    pub fn table(self) -> &'static str {
        match self {
            Self::Event => "event",
            Self::Audit => "audit",
        }
    }
}

impl Store {
    /// Jobs after the job `after` of which something is to go.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn due_jobs(
        &self,
        retention: &Retention,
        now: i64,
        after: &str,
        limit: i64,
    ) -> Result<Vec<DueJob>> {
        let sql = "SELECT id, attempts, work, logs, outputs, deleted FROM (
                SELECT j.id, j.deleted,
                    CASE WHEN j.attempts_marked = 0 AND j.work_gone = 0 AND j.deleted = 0 THEN 1 ELSE 0 END AS attempts,
                    CASE WHEN j.work_gone < 2 AND (j.work_gone = 1 OR j.deleted = 1
                        OR j.ended_at < $2 - p.retention_days * 86400000) THEN 1 ELSE 0 END AS work,
                    CASE WHEN j.logs_gone < 2 AND (j.logs_gone = 1 OR j.deleted = 1 OR j.ended_at < $3) THEN 1 ELSE 0 END AS logs,
                    CASE WHEN j.outputs_gone < 2 AND (j.outputs_gone = 1 OR j.deleted = 1
                        OR j.ended_at < $2 - p.outputs_days * 86400000) THEN 1 ELSE 0 END AS outputs
                FROM job j JOIN project p ON p.name = j.project WHERE j.id > $1 AND j.ended_at IS NOT NULL) AS due
            WHERE attempts + work + logs + outputs + deleted > 0 ORDER BY id LIMIT $4";
        let rows = self.query(sql, values![after, now, now - retention.log_days * DAY_MS, limit]).await?;
        let due = |row: &super::Row| {
            Ok(DueJob {
                id: row.text(0)?,
                attempts: row.flag(1)?,
                work: row.flag(2)?,
                logs: row.flag(3)?,
                outputs: row.flag(4)?,
                whole: row.flag(5)?,
            })
        };
        rows.iter().map(due).collect()
    }

    /// One life of a job is over, from now on for good; whether it is: a job that was tried again lives on.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn begin_removal(&self, job: &str, life: Life) -> Result<bool> {
        let column = life.column();
        let mut tx = self.begin().await?;
        let sql = format!(
            "UPDATE job SET {column} = CASE WHEN {column} = 0 THEN 1 ELSE {column} END, version = version + 1
            WHERE id = $1 AND ended_at IS NOT NULL"
        );
        let is_over = tx.execute(sql.into(), values![job]).await? == 1;
        self.commit("removal", tx).await?;
        Ok(is_over)
    }

    /// All of one life of a job is gone.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn end_removal(&self, job: &str, life: Life) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = format!("UPDATE job SET {} = 2 WHERE id = $1", life.column());
        tx.execute(sql.into(), values![job]).await?;
        if life == Life::Work {
            tx.execute("DELETE FROM worker_block WHERE job_id = $1".into(), values![job]).await?;
            self.leave_files(&mut tx, job).await?;
        }
        self.commit("removal", tx).await
    }

    /// A job refers to no files any more; the set that nobody refers to is forgotten.
    async fn leave_files(&self, tx: &mut Tx, job: &str) -> Result<()> {
        self.serialise_assets(tx).await?;
        let sql = "SELECT file_set FROM job WHERE id = $1 AND file_set IS NOT NULL";
        let rows = tx.query(sql.into(), values![job]).await?;
        let Some(row) = rows.first() else { return Ok(()) };
        tx.execute("UPDATE job SET file_set = NULL WHERE id = $1".into(), values![job]).await?;
        let sql = "DELETE FROM file_set WHERE id = $1 AND NOT EXISTS (SELECT 1 FROM job WHERE file_set = $1)";
        tx.execute(sql.into(), values![row.text(0)?]).await?;
        Ok(())
    }

    /// Batches of a job that have rows.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn batch_rows(&self, job: &str) -> Result<i64> {
        let sql = "SELECT CAST(COALESCE(SUM(s.n_ready + s.n_leased + s.n_done + s.n_failed + s.n_skipped), 0) AS BIGINT)
            FROM segment s JOIN pass p ON p.id = s.pass_id WHERE p.job_id = $1";
        self.query_one(sql, values![job]).await?.map_or(Ok(0), |row| row.int(0))
    }

    /// Removes the batches of some segments of a job whose work is over; their number, none where no segment is left.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn remove_batches(&self, job: &str) -> Result<Option<i64>> {
        let sql = "SELECT s.pass_id, s.seg, s.hi - s.lo FROM pass p JOIN segment s ON s.pass_id = p.id
            WHERE p.job_id = $1 ORDER BY s.pass_id, s.seg LIMIT 256";
        let segments = self.query(sql, values![job]).await?;
        if segments.is_empty() {
            return Ok(None);
        }
        let mut tx = self.begin().await?;
        // Whoever tries the job again holds this lock
        let sql = format!("SELECT work_gone FROM job WHERE id = $1{}", self.dialect().lock);
        if !one(tx.query(sql.into(), values![job]).await?)?.flag(0)? {
            return Err(Error::new(Kind::Conflict, "the job's work is not over"));
        }
        let (mut removed, mut looked_at) = (0, 0);
        for row in &segments {
            if looked_at >= ROWS_MAX {
                break;
            }
            looked_at += row.int(2)?;
            let segment = || Ok::<_, Error>(values![row.int(0)?, row.int(1)?]);
            let sql =
                "UPDATE pass SET kept_done = kept_done + s.n_done, kept_failed = kept_failed + s.n_failed,
                    kept_skipped = kept_skipped + s.n_skipped + s.n_ready
                FROM segment s WHERE s.pass_id = $1 AND s.seg = $2 AND pass.id = s.pass_id";
            tx.execute(sql.into(), segment()?).await?;
            let sql = "DELETE FROM batch WHERE pass_id = $1 AND seg = $2 AND seq >= (SELECT lo FROM segment WHERE pass_id = $1 AND seg = $2)
                AND seq < (SELECT hi FROM segment WHERE pass_id = $1 AND seg = $2)";
            removed += tx.execute(sql.into(), segment()?).await? as i64;
            tx.execute("DELETE FROM segment WHERE pass_id = $1 AND seg = $2".into(), segment()?).await?;
        }
        self.commit("prune", tx).await?;
        Ok(Some(removed))
    }

    /// Removes some of a job's failures; how many, at most a few thousand.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn remove_failures(&self, job: &str) -> Result<i64> {
        let sql =
            "SELECT pass_id, seq FROM batch_fault WHERE pass_id IN (SELECT id FROM pass WHERE job_id = $1)
            ORDER BY pass_id, seq LIMIT 1000";
        let rows = self.query(sql, values![job]).await?;
        let mut tx = self.begin().await?;
        let mut removed = 0;
        for row in &rows {
            let sql = "DELETE FROM batch_fault WHERE pass_id = $1 AND seq = $2";
            removed += tx.execute(sql.into(), values![row.int(0)?, row.int(1)?]).await? as i64;
        }
        self.commit("prune", tx).await?;
        Ok(removed)
    }

    /// Hides a job that has ended, and lets all of it go.
    ///
    /// # Errors
    /// [`Kind::NotFound`]; [`Kind::Conflict`] while it has not ended, or another job waits for it.
    pub async fn delete_job(&self, job: &str, actor: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        if !self.lock_job(&mut tx, job).await?.is_final() {
            let error = Error::new(Kind::Conflict, "the job has not ended");
            return Err(error.hint("cancel it first"));
        }
        if let Some(waits) = self.waits_for(job).await?.first() {
            let message = format!("the job `{waits}` waits for this one");
            return Err(Error::new(Kind::Conflict, message).hint("cancel that one first"));
        }
        self.record_job(&mut tx, job, "job.deleted", actor, "", now).await?;
        let sql = "UPDATE job SET deleted = 1, version = version + 1 WHERE id = $1";
        tx.execute(sql.into(), values![job]).await?;
        self.commit("delete", tx).await
    }

    /// Jobs that wait for this one to succeed.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn waits_for(&self, job: &str) -> Result<Vec<String>> {
        let sql = "SELECT d.job_id FROM dependency d JOIN job j ON j.id = d.job_id
            WHERE d.needs = $1 AND j.state = $2 ORDER BY d.job_id LIMIT 100";
        self.query(sql, values![job, JobState::Blocked.code()]).await?.iter().map(|row| row.text(0)).collect()
    }

    /// Removes the last rows of a job that was deleted; its batches and failures must be gone.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn remove_job(&self, job: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        let own = "SELECT id FROM job WHERE id = $1 AND deleted = 1 AND work_gone = 2 AND logs_gone = 2 AND outputs_gone = 2";
        for sql in [
            format!("DELETE FROM dependency WHERE job_id IN ({own}) OR needs IN ({own})"),
            format!("DELETE FROM traced WHERE pass_id IN (SELECT id FROM pass WHERE job_id IN ({own}))"),
            format!("DELETE FROM pass WHERE job_id IN ({own})"),
            format!("DELETE FROM job WHERE id IN ({own})"),
        ] {
            tx.execute(sql.into(), values![job]).await?;
        }
        self.commit("delete", tx).await
    }

    /// Removes some of the oldest rows from before `before`, or counts them; the latest row stays: numbers go on from it.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn remove_aged(&self, aged: Aged, before: i64, dry_run: bool) -> Result<i64> {
        let table = aged.table();
        if dry_run {
            let sql = format!("SELECT COUNT(*) FROM {table} WHERE at < $1");
            return self.query_one(sql, values![before]).await?.map_or(Ok(0), |row| row.int(0));
        }
        // Rows stand in the order of time: nothing behind the first ones needs to be looked at
        let sql = format!("SELECT id, at FROM {table} ORDER BY id LIMIT $1");
        let rows = self.query(sql, values![ROWS_MAX]).await?;
        let mut last = None;
        for row in &rows {
            if row.int(1)? >= before {
                break;
            }
            last = Some(row.int(0)?);
        }
        let Some(last) = last else { return Ok(0) };
        let mut tx = self.begin().await?;
        let sql = format!("DELETE FROM {table} WHERE id <= $1 AND id < (SELECT MAX(id) FROM {table})");
        let removed = tx.execute(sql.into(), values![last]).await?;
        self.commit("prune", tx).await?;
        Ok(removed as i64)
    }

    /// Removes tickets that have run out, and workers that were not heard of since `before`, or counts them.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn remove_absent(&self, now: i64, before: i64, dry_run: bool) -> Result<i64> {
        let ticket = "FROM ticket WHERE expires_at < $1";
        let worker = "FROM worker WHERE last_seen < $1 AND locked = 0
            AND NOT EXISTS (SELECT 1 FROM lease l WHERE l.worker = worker.name)";
        let mut count = 0;
        for (rows, end) in [(ticket, now), (worker, before)] {
            if dry_run {
                let sql = format!("SELECT COUNT(*) {rows}");
                count += self.query_one(sql, values![end]).await?.map_or(Ok(0), |row| row.int(0))?;
            } else {
                let mut tx = self.begin().await?;
                count += tx.execute(format!("DELETE {rows}").into(), values![end]).await? as i64;
                self.commit("prune", tx).await?;
            }
        }
        Ok(count)
    }
}
