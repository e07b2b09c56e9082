//! What people do to jobs: pause, resume, cancel, retry, skip, change.

use protocol::job::{BatchSelection, JobPatch};
use protocol::{JobState, PassState};

use super::{Store, Tx, Value};
use crate::error::Kind;
use crate::{Error, Result, values};

/// Ready batches of cancelled passes that one transaction ends: about one segment.
const CANCEL_MAX: i64 = 5_000;

impl Store {
    /// Pauses a job, or resumes it.
    ///
    /// # Errors
    /// [`Kind::NotFound`], [`Kind::Conflict`] when the job is at its end.
    pub async fn set_paused(&self, job: &str, paused: bool, actor: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        self.lock_live(&mut tx, job).await?;
        let reason = if paused { format!("paused by {actor}") } else { String::new() };
        let sql = "UPDATE job SET paused = $2, reason = $3, version = version + 1 WHERE id = $1";
        tx.execute(sql.into(), values![job, paused, &reason]).await?;
        let kind = if paused { "job.paused" } else { "job.resumed" };
        self.record_job(&mut tx, job, kind, actor, "", now).await?;
        self.commit("pause", tx).await
    }

    /// Begins to cancel a job: nothing more of it is claimed from now on. A job that is being cancelled already stays so.
    ///
    /// # Errors
    /// [`Kind::NotFound`], [`Kind::Conflict`] when the job is at its end.
    pub async fn cancel(&self, job: &str, actor: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        let state = self.lock_live(&mut tx, job).await?;
        if state == JobState::Cancelling {
            return Ok(());
        }
        let sql = "UPDATE job SET state = $2, reason = $3, version = version + 1 WHERE id = $1";
        let reason = format!("cancelled by {actor}");
        tx.execute(sql.into(), values![job, JobState::Cancelling.code(), &reason]).await?;
        self.close_passes(&mut tx, job, now).await?;
        self.record_job(&mut tx, job, "job.cancelling", actor, "", now).await?;
        self.commit("cancel", tx).await
    }

    /// Ends ready batches of cancelled passes, one segment after the other; whether there were any.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn sweep_cancelled(&self) -> Result<bool> {
        let sql = "SELECT s.pass_id, s.seg, s.lo, s.hi FROM segment s JOIN pass p ON p.id = s.pass_id
            WHERE p.state = $1 AND s.n_ready > 0 ORDER BY s.pass_id, s.seg LIMIT 8";
        let segments = self.query(sql, values![PassState::Cancelled.code()]).await?;
        let mut swept = 0;
        for row in &segments {
            let (pass, segment) = (row.int(0)?, row.int(1)?);
            let mut tx = self.begin().await?;
            let sql =
                "UPDATE batch SET state = 5 WHERE pass_id = $1 AND seq >= $2 AND seq < $3 AND state = 0";
            let count = tx.execute(sql.into(), values![pass, row.int(2)?, row.int(3)?]).await? as i64;
            let sql = "UPDATE segment SET n_ready = n_ready - $3, n_skipped = n_skipped + $3 WHERE pass_id = $1 AND seg = $2";
            tx.execute(sql.into(), values![pass, segment, count]).await?;
            self.commit("sweep", tx).await?;
            swept += count;
            if swept > CANCEL_MAX {
                break;
            }
        }
        Ok(!segments.is_empty())
    }

    /// Tries failed batches again, with a clean slate; a job that has failed runs again.
    ///
    /// # Errors
    /// [`Kind::NotFound`], [`Kind::Conflict`] when the job has succeeded or was cancelled.
    pub async fn retry(&self, job: &str, selection: &BatchSelection, actor: &str, now: i64) -> Result<i64> {
        let mut tx = self.begin().await?;
        let state = self.lock_whole(&mut tx, job).await?;
        if matches!(state, JobState::Succeeded | JobState::Cancelled | JobState::Cancelling) {
            let message = format!("the job has {state}: its batches cannot be tried again");
            return Err(Error::new(Kind::Conflict, message).hint("submit it again"));
        }
        let change = Change { from: "state IN (3, 4)", to: 0, column: "n_ready" };
        let count = self.change_batches(&mut tx, job, selection, &change).await?;
        tx.execute("DELETE FROM worker_block WHERE job_id = $1".into(), values![job]).await?;
        if state == JobState::Failed {
            self.reopen(&mut tx, job).await?;
        }
        self.record_job(&mut tx, job, "job.retried", actor, &format!("{count} batches"), now).await?;
        self.commit("retry", tx).await?;
        Ok(count)
    }

    /// Brings a failed job back: passes of which batches are to run are open again, later ones wait again.
    async fn reopen(&self, tx: &mut Tx, job: &str) -> Result<()> {
        let sql = "UPDATE job SET state = $2, reason = '', ended_at = NULL, attempts_marked = 0, version = version + 1 WHERE id = $1";
        tx.execute(sql.into(), values![job, JobState::Running.code()]).await?;
        // A pass that was closed while its batches were being created goes on being created
        let sql = "UPDATE pass SET ended_at = NULL, state = CASE
                WHEN created_count < batch_count AND reused = 0 THEN 0
                WHEN kind = 3 AND state = 5 AND NOT EXISTS (SELECT 1 FROM segment s WHERE s.pass_id = pass.id
                    AND s.n_leased + s.n_done + s.n_failed + s.n_skipped > 0) THEN 1 ELSE 2 END
            WHERE job_id = $1 AND state IN (4, 5)";
        tx.execute(sql.into(), values![job]).await?;
        // Batches that were closed with their job are as they were before
        let sql = "UPDATE segment SET n_ready = n_ready + moved.n, n_skipped = n_skipped - moved.n FROM (
                SELECT b.pass_id AS p, b.seg AS s, COUNT(*) AS n FROM batch b JOIN pass ON pass.id = b.pass_id
                WHERE pass.job_id = $1 AND b.state = 5 GROUP BY b.pass_id, b.seg) AS moved
            WHERE segment.pass_id = moved.p AND segment.seg = moved.s";
        tx.execute(sql.into(), values![job]).await?;
        let sql = "UPDATE batch SET state = 0 WHERE state = 5 AND pass_id IN (SELECT id FROM pass WHERE job_id = $1)";
        tx.execute(sql.into(), values![job]).await?;
        Ok(())
    }

    /// Does without batches: those that failed, or chosen ones. The job's result is then marked as incomplete.
    ///
    /// # Errors
    /// [`Kind::NotFound`], [`Kind::Conflict`] when the job is at its end and has not failed.
    pub async fn skip(&self, job: &str, selection: &BatchSelection, actor: &str, now: i64) -> Result<i64> {
        let mut tx = self.begin().await?;
        let state = self.lock_whole(&mut tx, job).await?;
        if state.is_final() && state != JobState::Failed {
            let message = format!("the job has {state}: nothing of it can be skipped");
            return Err(Error::new(Kind::Conflict, message));
        }
        let from = if selection.batches.is_empty() { "state = 3" } else { "state IN (0, 3)" };
        let change = Change { from, to: 4, column: "n_skipped" };
        let count = self.change_batches(&mut tx, job, selection, &change).await?;
        if count > 0 {
            tx.execute("UPDATE job SET partial = 1 WHERE id = $1".into(), values![job]).await?;
        }
        if state == JobState::Failed {
            self.reopen(&mut tx, job).await?;
        }
        self.record_job(&mut tx, job, "job.skipped", actor, &format!("{count} batches"), now).await?;
        self.commit("skip", tx).await?;
        Ok(count)
    }

    /// Changes the state of chosen batches, and the counts of their segments.
    async fn change_batches(
        &self,
        tx: &mut Tx,
        job: &str,
        selection: &BatchSelection,
        change: &Change,
    ) -> Result<i64> {
        let mut values: Vec<Value> = values![job, selection.pass.unwrap_or(-1)];
        let mut chosen = String::new();
        if !selection.batches.is_empty() {
            chosen = format!(" AND seq IN ({})", super::placeholders(3, selection.batches.len()));
            values.extend(selection.batches.iter().map(|&batch| Value::from(batch)));
        }
        let Change { from, to, column } = change;
        // Only bake batches can be done without
        let kinds = if *to == 4 { " AND kind = 3" } else { "" };
        let wanted = format!(
            "{from} AND pass_id IN (SELECT id FROM pass WHERE job_id = $1 AND (id = $2 OR $2 = -1){kinds}){chosen}"
        );
        let sql = format!(
            "SELECT pass_id, seq, seg, state FROM batch WHERE {wanted} ORDER BY pass_id, seq{}",
            self.dialect().lock
        );
        let rows = tx.query(sql.into(), values.clone()).await?;
        for row in &rows {
            let before = match row.int(3)? {
                0 => "n_ready",
                3 => "n_failed",
                _ => "n_skipped",
            };
            let sql = format!(
                "UPDATE segment SET {before} = {before} - 1, {column} = {column} + 1 WHERE pass_id = $1 AND seg = $2"
            );
            tx.execute(sql.into(), values![row.int(0)?, row.int(2)?]).await?;
            let sql = "DELETE FROM batch_fault WHERE pass_id = $1 AND seq = $2";
            tx.execute(sql.into(), values![row.int(0)?, row.int(1)?]).await?;
        }
        let sql =
            format!("UPDATE batch SET state = {to}, tries = 0, lost = 0, not_before = 0 WHERE {wanted}");
        tx.execute(sql.into(), values).await?;
        Ok(rows.len() as i64)
    }

    /// Changes a job.
    ///
    /// # Errors
    /// [`Kind::NotFound`], [`Kind::Conflict`] when the job is at its end.
    pub async fn patch(&self, job: &str, patch: &JobPatch, actor: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        self.lock_live(&mut tx, job).await?;
        let sql = "UPDATE job SET priority = COALESCE($2, priority), comment = COALESCE($3, comment),
            running_max = COALESCE($4, running_max), version = version + 1 WHERE id = $1";
        let values = values![job, patch.priority, patch.comment.clone(), patch.running_max];
        tx.execute(sql.into(), values).await?;
        self.record_job(&mut tx, job, "job.changed", actor, "", now).await?;
        self.commit("patch", tx).await
    }

    /// Locks a job whose batches are all there.
    async fn lock_whole(&self, tx: &mut Tx, job: &str) -> Result<JobState> {
        let state = self.lock_job(tx, job).await?;
        let gone = tx.query("SELECT 1 FROM job WHERE id = $1 AND work_gone > 0".into(), values![job]).await?;
        if !gone.is_empty() {
            return Err(Error::new(Kind::Conflict, "the job is past its retention: its batches are gone")
                .hint("submit its scene anew"));
        }
        Ok(state)
    }

    pub(super) async fn lock_job(&self, tx: &mut Tx, job: &str) -> Result<JobState> {
        let sql = format!("SELECT state FROM job WHERE id = $1 AND deleted = 0{}", self.dialect().lock);
        let rows = tx.query(sql.into(), values![job]).await?;
        rows.first().ok_or_else(|| Error::not_found("job", job))?.word(0, JobState::from_code)
    }

    async fn lock_live(&self, tx: &mut Tx, job: &str) -> Result<JobState> {
        let state = self.lock_job(tx, job).await?;
        if state.is_final() {
            return Err(Error::new(Kind::Conflict, format!("the job has {state}")));
        }
        Ok(state)
    }
}

/// A change of batches.
struct Change {
    /// Which may be changed, SQL.
    from: &'static str,
    /// The state's number.
    to: i64,
    /// The segment's count of that state.
    column: &'static str,
}
