//! Jobs, passes, batches and workers as people see them: bounded pages, no transaction.

use protocol::admin::WorkerDetail;
use protocol::job::{BatchDetail, BatchPage, Counts, Failure, JobSummary, PassDetail, SegmentDetail};
use protocol::{BatchState, FailureClass, JobState, PassKind, PassState};

use super::{Row, Store, graph};
use crate::scheduler::farm::WORKER_LOST_MS;
use crate::{Error, Result, values};

/// A job's columns; its batches are those of its bake passes.
pub(super) const SUMMARY: &str =
    "SELECT j.id, j.name, j.project, j.state, j.paused, j.reason, j.priority, j.submitted_by, j.shot,
    j.frame, j.comment, j.created_at, j.started_at, j.ended_at, j.version,
    COALESCE(c.r, 0), COALESCE(c.l, 0), COALESCE(c.d, 0), COALESCE(c.f, 0), COALESCE(c.k, 0), j.work_gone";

/// The counts of the bake passes of the jobs in a list.
pub(super) const COUNTS: &str = "LEFT JOIN (SELECT p.job_id AS job, CAST(SUM(COALESCE(s.r, 0)) AS BIGINT) AS r,
        CAST(SUM(COALESCE(s.l, 0)) AS BIGINT) AS l, CAST(SUM(p.kept_done + COALESCE(s.d, 0)) AS BIGINT) AS d,
        CAST(SUM(p.kept_failed + COALESCE(s.f, 0)) AS BIGINT) AS f,
        CAST(SUM(p.kept_skipped + COALESCE(s.k, 0)) AS BIGINT) AS k
    FROM pass p LEFT JOIN (SELECT pass_id, SUM(n_ready) AS r, SUM(n_leased) AS l, SUM(n_done) AS d, SUM(n_failed) AS f,
            SUM(n_skipped) AS k
        FROM segment WHERE pass_id IN (SELECT id FROM pass WHERE kind = 3 AND job_id IN (SELECT id FROM page))
        GROUP BY pass_id) AS s ON s.pass_id = p.id
    WHERE p.kind = 3 AND p.job_id IN (SELECT id FROM page) GROUP BY p.job_id) AS c ON c.job = j.id";

pub(super) fn summary(row: &Row) -> Result<JobSummary> {
    Ok(JobSummary {
        id: row.text(0)?,
        name: row.text(1)?,
        project: row.text(2)?,
        state: row.word(3, JobState::from_code)?,
        paused: row.flag(4)?,
        reason: row.text(5)?,
        priority: row.int(6)?,
        submitted_by: row.text(7)?,
        shot: row.text(8)?,
        frame: row.int_or_null(9)?,
        comment: row.text(10)?,
        created_at: row.int(11)?,
        started_at: row.int_or_null(12)?,
        ended_at: row.int_or_null(13)?,
        version: row.int(14)?,
        batches: counts(row, 15)?,
        pruned: row.flag(20)?,
    })
}

pub(super) fn counts(row: &Row, first: usize) -> Result<Counts> {
    Ok(Counts {
        ready: row.int(first)?,
        leased: row.int(first + 1)?,
        done: row.int(first + 2)?,
        failed: row.int(first + 3)?,
        skipped: row.int(first + 4)?,
    })
}

impl Store {
    /// A job.
    ///
    /// # Errors
    /// [`NotFound`](crate::error::Kind::NotFound).
    pub async fn job(&self, job: &str) -> Result<JobSummary> {
        let sql = format!(
            "WITH page AS (SELECT id FROM job WHERE id = $1 AND deleted = 0) {SUMMARY} FROM page JOIN job j ON j.id = page.id {COUNTS}"
        );
        let row = self.query_one(sql, values![job]).await?;
        summary(&row.ok_or_else(|| Error::not_found("job", job))?)
    }

    /// The job of which this one is an edited copy.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn resubmitted(&self, job: &str) -> Result<Option<String>> {
        let row = self.query_one("SELECT resubmit_of FROM job WHERE id = $1", values![job]).await?;
        row.map_or(Ok(None), |row| row.text_or_null(0))
    }

    /// A job's passes.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn pass_details(&self, job: &str) -> Result<Vec<PassDetail>> {
        let sql = "SELECT p.id, p.kind, p.name, p.state, p.reused, p.created_at, p.ended_at, p.result,
                CAST(COALESCE(SUM(s.n_ready), 0) AS BIGINT), CAST(COALESCE(SUM(s.n_leased), 0) AS BIGINT),
                CAST(p.kept_done + COALESCE(SUM(s.n_done), 0) AS BIGINT),
                CAST(p.kept_failed + COALESCE(SUM(s.n_failed), 0) AS BIGINT),
                CAST(p.kept_skipped + COALESCE(SUM(s.n_skipped), 0) AS BIGINT),
                CAST(COALESCE(SUM(s.ewma_ms * s.n_done) / NULLIF(SUM(CASE WHEN s.ewma_ms > 0 THEN s.n_done ELSE 0 END), 0), 0) AS BIGINT)
            FROM pass p LEFT JOIN segment s ON s.pass_id = p.id WHERE p.job_id = $1
            GROUP BY p.id, p.kind, p.name, p.state, p.reused, p.created_at, p.ended_at, p.result, p.kept_done, p.kept_failed,
                p.kept_skipped ORDER BY p.id";
        let mut traced = self.traced_of(job).await?;
        let mut pass = |row: &Row| {
            let id = row.int(0)?;
            Ok(PassDetail {
                id,
                traced: traced.remove(&id),
                kind: row.word(1, PassKind::from_code)?,
                name: row.text(2)?,
                state: row.word(3, PassState::from_code)?,
                reused: row.flag(4)?,
                created_at: row.int(5)?,
                ended_at: row.int_or_null(6)?,
                result: row.text_or_null(7)?.as_deref().map(graph::found_out).transpose()?,
                batches: counts(row, 8)?,
                batch_ms: row.int(13)?,
            })
        };
        self.query(sql, values![job]).await?.iter().map(&mut pass).collect()
    }

    /// Mean milliseconds of a batch of the latest bakes; none where there was no bake.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn recent_batch_ms(&self) -> Result<Option<f64>> {
        let sql =
            "SELECT CAST(SUM(s.ewma_ms * s.n_done) AS BIGINT), CAST(SUM(s.n_done) AS BIGINT) FROM segment s
            JOIN (SELECT id FROM pass WHERE kind = 3 ORDER BY id DESC LIMIT 20) AS p ON p.id = s.pass_id
            WHERE s.ewma_ms > 0 AND s.n_done > 0";
        let Some(row) = self.query_one(sql, vec![]).await? else { return Ok(None) };
        let (work, done) = (row.int_or_null(0)?, row.int_or_null(1)?);
        Ok(work.zip(done).map(|(work, done)| work as f64 / done as f64))
    }

    /// Ready batches of a job that must wait after a failure.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn backing_off(&self, job: &str, now: i64) -> Result<i64> {
        let sql = "SELECT COUNT(*) FROM batch_fault f JOIN batch b ON b.pass_id = f.pass_id AND b.seq = f.seq
            WHERE f.pass_id IN (SELECT id FROM pass WHERE job_id = $1) AND f.class = 1 AND b.state = 0 AND b.not_before > $2";
        self.query_one(sql, values![job, now]).await?.map_or(Ok(0), |row| row.int(0))
    }

    /// A pass's segments, from segment `first` on.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn segments(&self, job: &str, pass: i64, first: i64, limit: i64) -> Result<Vec<SegmentDetail>> {
        let sql =
            "SELECT s.seg, s.lo, s.hi, s.n_ready, s.n_leased, s.n_done, s.n_failed, s.n_skipped, s.owner
            FROM segment s JOIN pass p ON p.id = s.pass_id
            WHERE s.pass_id = $1 AND p.job_id = $2 AND s.seg >= $3 ORDER BY s.seg LIMIT $4";
        let segment = |row: &Row| {
            Ok(SegmentDetail {
                segment: row.int(0)?,
                first: row.int(1)?,
                end: row.int(2)?,
                batches: counts(row, 3)?,
                owner: row.text_or_null(8)?,
            })
        };
        self.query(sql, values![pass, job, first, limit]).await?.iter().map(segment).collect()
    }

    /// A pass's batches after batch `after`, in one state where given.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn batches(
        &self,
        job: &str,
        pass: i64,
        state: Option<BatchState>,
        after: i64,
        limit: i64,
    ) -> Result<BatchPage> {
        let sql = "SELECT b.seq, b.state, b.fence, b.tries, COALESCE(l.worker, b.worker), b.sha256 FROM batch b JOIN pass p ON p.id = b.pass_id
            LEFT JOIN lease l ON l.id = b.lease_id
            WHERE b.pass_id = $1 AND p.job_id = $2 AND b.seq > $3 AND ($4 = -1 OR b.state = $4) ORDER BY b.seq LIMIT $5";
        let batch = |row: &Row| {
            Ok(BatchDetail {
                batch: row.int(0)?,
                state: row.word(1, BatchState::from_code)?,
                fence: row.int(2)?,
                tries: row.int(3)?,
                worker: row.text_or_null(4)?,
                sha256: row.text_or_null(5)?,
            })
        };
        let values = values![pass, job, after, state.map_or(-1, BatchState::code), limit];
        let rows = self.query(sql, values).await?;
        let batches = rows.iter().map(batch).collect::<Result<Vec<_>>>()?;
        let next = if batches.len() as i64 == limit { batches.last().map(|batch| batch.batch) } else { None };
        Ok(BatchPage { batches, next })
    }

    /// A job's failures, latest first.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn failures(&self, job: &str, limit: i64) -> Result<Vec<Failure>> {
        let sql =
            "SELECT f.pass_id, f.seq, f.fence, f.worker, f.class, f.n, f.message, f.at FROM batch_fault f
            WHERE f.pass_id IN (SELECT id FROM pass WHERE job_id = $1) AND f.class <> $3 ORDER BY f.at DESC, f.seq LIMIT $2";
        let failure = |row: &Row| {
            Ok(Failure {
                pass: row.int(0)?,
                batch: row.int(1)?,
                fence: row.int(2)?,
                worker: row.text(3)?,
                class: row.word(4, FailureClass::from_code)?,
                count: row.int(5)?,
                message: row.text(6)?,
                at: row.int(7)?,
            })
        };
        self.query(sql, values![job, limit, super::opinion::OPINION]).await?.iter().map(failure).collect()
    }

    /// All workers, by name.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn workers(&self, now: i64) -> Result<Vec<WorkerDetail>> {
        let sql = "SELECT w.name, w.labels, w.memory_bytes, w.version, w.locked, w.draining, w.sick_until, w.last_seen,
                CAST(COALESCE((SELECT SUM(l.n) FROM lease l WHERE l.worker = w.name), 0) AS BIGINT),
                (SELECT COUNT(*) FROM batch_fault f WHERE f.worker = w.name AND f.class IN (3, 7) AND f.at > $1),
                w.reason
            FROM worker w ORDER BY w.name LIMIT 10000";
        let rows = self.query(sql, values![now - crate::scheduler::failure::SICK_MS]).await?;
        let mut latest = self.latest_traced().await?;
        let mut worker = |row: &Row| {
            let name = row.text(0)?;
            let (device, traced) = latest.remove(&name).map(|work| (work.device, work.traced)).unzip();
            let (leased, last_seen) = (row.int(8)?, row.int(7)?);
            let state = match () {
                () if now - last_seen >= WORKER_LOST_MS => "lost",
                () if row.flag(4)? => "locked",
                () if row.int(6)? > now => "sick",
                () if row.flag(5)? => "draining",
                () if leased > 0 => "busy",
                () => "idle",
            };
            Ok(WorkerDetail {
                name,
                device: device.unwrap_or_default(),
                traced,
                state: state.into(),
                labels: serde_json::from_str(&row.text(1)?)?,
                memory_bytes: row.int(2)?,
                version: row.text(3)?,
                leased,
                errors: row.int(9)?,
                reason: row.text(10)?,
                last_seen,
            })
        };
        rows.iter().map(&mut worker).collect()
    }
}
