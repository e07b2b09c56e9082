//! A job's steps, taken: passes are made, opened and ended as [`crate::scheduler::graph`] says, under the job's lock.

use protocol::job::JobRequest;
use protocol::work::{PassResult, Task};
use protocol::{JobState, PassKind, PassState, limits};
use serde::Deserialize;

use super::event::NewEvent;
use super::{Store, Tx};
use crate::scheduler::graph::{Job, Pass, Step, next_steps};
use crate::{Error, Result, values};

/// Batches that one transaction creates at most: a writer of SQLite is held for some milliseconds.
const CREATE_MAX: i64 = 16_384;
/// Batches of a segment at most, and at least where there are so many.
const SEGMENT: (i64, i64) = (16, 512);

/// What a job is asked to publish.
#[derive(Clone, Debug)]
pub struct Publication {
    /// The job.
    pub job: String,
    /// Its name.
    pub name: String,
    /// Whether points lack a result.
    pub incomplete: bool,
    /// Its merges: bake set, where the result is, its hash, and what was found out.
    pub merges: Vec<(String, String, String, PassResult)>,
}

/// What an advance came to.
#[derive(Clone, Debug, Default)]
pub struct Advance {
    /// All is there: publish, then call [`Store::published`].
    pub publish: Option<Publication>,
    /// Other jobs that may have come to their next step.
    pub others: Vec<String>,
    /// Whether anything changed.
    pub changed: bool,
}

/// A pass's result as the database has it.
#[derive(Deserialize)]
struct Saved {
    result: PassResult,
    key: String,
}

/// What a pass found out, from the text that the database has.
///
/// # Errors
/// When the text is no result.
pub(super) fn found_out(saved: &str) -> Result<PassResult> {
    Ok(serde_json::from_str::<Saved>(saved)?.result)
}

/// What is known of a job besides its graph.
struct Head {
    id: String,
    project: String,
    name: String,
    state: JobState,
}

impl Store {
    /// Takes the steps of a job that can be taken.
    ///
    /// # Errors
    /// When the database refuses; the steps that were taken stay.
    pub async fn advance(&self, job: &str, now: i64) -> Result<Advance> {
        let mut advance = Advance::default();
        let mut tx = self.begin().await?;
        let sql = format!(
            "SELECT project, name, state, partial, failed_max, request, frame FROM job WHERE id = $1{}",
            self.dialect().lock
        );
        let rows = tx.query(sql.into(), values![job]).await?;
        let row = rows.first().ok_or_else(|| Error::not_found("job", job))?;
        let head = Head {
            id: job.into(),
            project: row.text(0)?,
            name: row.text(1)?,
            state: row.word(2, JobState::from_code)?,
        };
        if head.state == JobState::Cancelling {
            self.finish_cancelling(&mut tx, &head, now, &mut advance).await?;
        } else if !head.state.is_final() && head.state != JobState::Blocked {
            let request: JobRequest = serde_json::from_str(&row.text(5)?)?;
            let task = base_task(job, &request, row.int_or_null(6)?);
            let graph = Job { task, partial: row.flag(3)?, failed_max: row.int(4)?, passes: Vec::new() };
            self.take_steps(&mut tx, &head, graph, now, &mut advance).await?;
        }
        self.commit("advance", tx).await?;
        Ok(advance)
    }

    async fn take_steps(
        &self,
        tx: &mut Tx,
        head: &Head,
        mut graph: Job,
        now: i64,
        advance: &mut Advance,
    ) -> Result<()> {
        // The graph has a bounded number of passes, so this ends
        loop {
            graph.passes = self.passes(tx, &head.id).await?;
            let steps = next_steps(&graph);
            if steps.is_empty() {
                return Ok(());
            }
            advance.changed = true;
            for step in steps {
                match step {
                    Step::Create { kind, name, task, batches, open } => {
                        self.create_pass(tx, head, kind, &name, &task, batches, open, now).await?;
                    }
                    Step::Open(pass) => self.set_pass_state(tx, pass, PassState::Open, None).await?,
                    Step::End(pass, state) => {
                        self.set_pass_state(tx, pass, state, Some(now)).await?;
                        let ended = graph.passes.iter().find(|p| p.id == pass && p.kind == PassKind::Build);
                        if let Some(build) = ended {
                            self.artifact_ended(tx, build, state, now, advance).await?;
                        }
                    }
                    Step::Succeed { incomplete } => {
                        let mut merges = Vec::new();
                        for pass in graph.passes.iter().filter(|pass| pass.kind == PassKind::Merge) {
                            let sql = "SELECT sha256 FROM batch WHERE pass_id = $1 AND seq = 0";
                            let row = super::one(tx.query(sql.into(), values![pass.id]).await?)?;
                            let (Some(key), Some(result)) = (&pass.result_key, &pass.result) else {
                                continue;
                            };
                            merges.push((pass.name.clone(), key.clone(), row.text(0)?, result.clone()));
                        }
                        let (job, name) = (head.id.clone(), head.name.clone());
                        advance.publish = Some(Publication { job, name, incomplete, merges });
                        return Ok(());
                    }
                    Step::Fail(reason) => {
                        self.hand_over_artifacts(tx, &graph.passes, now, advance).await?;
                        self.close_passes(tx, &head.id, now).await?;
                        self.end_job(tx, head, JobState::Failed, &reason, now, advance).await?;
                        return Ok(());
                    }
                }
            }
        }
    }

    /// A job's passes as its graph sees them.
    async fn passes(&self, tx: &mut Tx, job: &str) -> Result<Vec<Pass>> {
        let sql = "SELECT p.id, p.kind, p.name, p.state, p.task, p.result,
                CAST(COALESCE(SUM(s.n_ready + s.n_leased), 0) AS BIGINT), CAST(COALESCE(SUM(s.n_failed), 0) AS BIGINT),
                CAST(COALESCE(SUM(s.n_skipped), 0) AS BIGINT)
            FROM pass p LEFT JOIN segment s ON s.pass_id = p.id WHERE p.job_id = $1
            GROUP BY p.id, p.kind, p.name, p.state, p.task, p.result ORDER BY p.id";
        let rows = tx.query(sql.into(), values![job]).await?;
        let pass = |row: &super::Row| -> Result<Pass> {
            let saved = row.text_or_null(5)?.map(|json| serde_json::from_str::<Saved>(&json)).transpose()?;
            let (result, result_key) = saved.map_or((None, None), |s| (Some(s.result), Some(s.key)));
            Ok(Pass {
                id: row.int(0)?,
                kind: row.word(1, PassKind::from_code)?,
                name: row.text(2)?,
                state: row.word(3, PassState::from_code)?,
                task: serde_json::from_str(&row.text(4)?)?,
                result,
                result_key,
                open: row.int(6)?,
                failed: row.int(7)?,
                skipped: row.int(8)?,
            })
        };
        rows.iter().map(pass).collect()
    }

    #[expect(clippy::too_many_arguments, reason = "the columns of a row")]
    async fn create_pass(
        &self,
        tx: &mut Tx,
        head: &Head,
        kind: PassKind,
        name: &str,
        task: &Task,
        batches: i64,
        open: bool,
        now: i64,
    ) -> Result<()> {
        let batches = batches.clamp(1, limits::BATCHES_MAX);
        let size = (batches / 64).clamp(SEGMENT.0, SEGMENT.1);
        let state = match (batches > size, open) {
            (true, _) => PassState::Creating,
            (false, true) => PassState::Open,
            (false, false) => PassState::Waiting,
        };
        let sql = "INSERT INTO pass (job_id, kind, name, state, task, batch_count, segment_size, created_at)
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8) RETURNING id";
        let task = serde_json::to_string(task)?;
        let values = values![&head.id, kind.code(), name, state.code(), task, batches, size, now];
        let pass = super::one(tx.query(sql.into(), values).await?)?.int(0)?;
        if kind == PassKind::Build && !self.claim_artifact(tx, name, pass, now).await? {
            return Ok(());
        }
        if batches <= size {
            self.create_batches(tx, pass, 0, batches, size).await?;
        }
        Ok(())
    }

    /// Whether this pass is to build the artifact: not where it is there, or another pass is at it.
    async fn claim_artifact(&self, tx: &mut Tx, key: &str, pass: i64, now: i64) -> Result<bool> {
        let sql = "INSERT INTO artifact (key, pass_id, created_at) VALUES ($1, $2, $3) ON CONFLICT (key) DO NOTHING";
        if tx.execute(sql.into(), values![key, pass, now]).await? == 1 {
            return Ok(true);
        }
        let sql = format!("SELECT ready FROM artifact WHERE key = $1{}", self.dialect().lock);
        let ready = super::one(tx.query(sql.into(), values![key]).await?)?.flag(0)?;
        let (state, ended) = if ready { (PassState::Done, Some(now)) } else { (PassState::Waiting, None) };
        self.set_pass_state(tx, pass, state, ended).await?;
        tx.execute("UPDATE pass SET reused = 1 WHERE id = $1".into(), values![pass]).await?;
        Ok(false)
    }

    /// Tells those who wait for an artifact; one of them builds it if its builder has failed.
    async fn artifact_ended(
        &self,
        tx: &mut Tx,
        build: &Pass,
        state: PassState,
        now: i64,
        advance: &mut Advance,
    ) -> Result<()> {
        let sql = format!("SELECT pass_id FROM artifact WHERE key = $1{}", self.dialect().lock);
        let rows = tx.query(sql.into(), values![&build.name]).await?;
        let builder = rows.first().map(|row| row.int(0)).transpose()?;
        if builder != Some(build.id) {
            return Ok(());
        }
        let sql = "SELECT id, job_id FROM pass WHERE kind = $1 AND name = $2 AND state = $3 AND state <= 2 ORDER BY id";
        let values = values![PassKind::Build.code(), &build.name, PassState::Waiting.code()];
        let waiting = tx.query(sql.into(), values).await?;
        if state == PassState::Done {
            tx.execute("UPDATE artifact SET ready = 1 WHERE key = $1".into(), values![&build.name]).await?;
            for row in &waiting {
                self.set_pass_state(tx, row.int(0)?, PassState::Done, Some(now)).await?;
                advance.others.push(row.text(1)?);
            }
        } else {
            let heir = waiting.first().map(|row| row.int(0)).transpose()?;
            self.bequeath(tx, &build.name, heir).await?;
        }
        Ok(())
    }

    /// Lets a pass build an artifact that nobody builds any more; where there is none, the artifact is forgotten.
    pub(super) async fn bequeath(&self, tx: &mut Tx, key: &str, heir: Option<i64>) -> Result<()> {
        let Some(heir) = heir else {
            tx.execute("DELETE FROM artifact WHERE key = $1".into(), values![key]).await?;
            return Ok(());
        };
        let sql = "UPDATE artifact SET pass_id = $2 WHERE key = $1";
        tx.execute(sql.into(), values![key, heir]).await?;
        self.create_batches(tx, heir, 0, 1, SEGMENT.0).await?;
        let sql = "UPDATE pass SET state = $2, reused = 0 WHERE id = $1";
        tx.execute(sql.into(), values![heir, PassState::Open.code()]).await?;
        Ok(())
    }

    async fn set_pass_state(
        &self,
        tx: &mut Tx,
        pass: i64,
        state: PassState,
        ended_at: Option<i64>,
    ) -> Result<()> {
        let sql = "UPDATE pass SET state = $2, ended_at = $3 WHERE id = $1";
        tx.execute(sql.into(), values![pass, state.code(), ended_at]).await?;
        Ok(())
    }

    /// Segments and batches from `lo` to `hi`; `lo` is the first batch of a segment.
    async fn create_batches(&self, tx: &mut Tx, pass: i64, lo: i64, hi: i64, size: i64) -> Result<()> {
        let sql = "INSERT INTO segment (pass_id, seg, lo, hi, n_ready)
            WITH RECURSIVE n(i) AS (SELECT CAST($2 AS BIGINT) UNION ALL SELECT i + $4 FROM n WHERE i + $4 < $3)
            SELECT $1, i / $4, i, CASE WHEN i + $4 < $3 THEN i + $4 ELSE $3 END, CASE WHEN i + $4 < $3 THEN $4 ELSE $3 - i END
            FROM n";
        tx.execute(sql.into(), values![pass, lo, hi, size]).await?;
        let sql = "INSERT INTO batch (pass_id, seq, seg)
            WITH RECURSIVE n(i) AS (SELECT CAST($2 AS BIGINT) UNION ALL SELECT i + 1 FROM n WHERE i + 1 < $3)
            SELECT $1, i, i / $4 FROM n";
        tx.execute(sql.into(), values![pass, lo, hi, size]).await?;
        let sql = "UPDATE pass SET created_count = $2 WHERE id = $1";
        tx.execute(sql.into(), values![pass, hi]).await?;
        Ok(())
    }

    /// Creates the next batches of one pass that has not all of its own; the job to advance, or none if there is none.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn create_some(&self) -> Result<Option<String>> {
        let sql = "SELECT id, job_id FROM pass WHERE state = 0 AND state <= 2 ORDER BY id LIMIT 1";
        let Some(row) = self.query_one(sql, vec![]).await? else { return Ok(None) };
        let (pass, job) = (row.int(0)?, row.text(1)?);
        let mut tx = self.begin().await?;
        let sql = format!(
            "SELECT batch_count, created_count, segment_size FROM pass WHERE id = $1 AND state = 0{}",
            self.dialect().lock
        );
        let rows = tx.query(sql.into(), values![pass]).await?;
        let Some(row) = rows.first() else { return Ok(Some(job)) };
        let (count, created, size) = (row.int(0)?, row.int(1)?, row.int(2)?);
        let hi = count.min(created + CREATE_MAX / size * size);
        self.create_batches(&mut tx, pass, created, hi, size).await?;
        if hi == count {
            self.set_pass_state(&mut tx, pass, PassState::Waiting, None).await?;
        }
        self.commit("create", tx).await?;
        Ok(Some(job))
    }

    /// What was published is in storage: the job has succeeded.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn published(&self, publication: &Publication, now: i64) -> Result<Advance> {
        let mut advance = Advance::default();
        let mut tx = self.begin().await?;
        let sql = format!("SELECT project, state FROM job WHERE id = $1{}", self.dialect().lock);
        let row = super::one(tx.query(sql.into(), values![&publication.job]).await?)?;
        let state = row.word(1, JobState::from_code)?;
        if !state.is_final() && state != JobState::Cancelling {
            let head = Head {
                id: publication.job.clone(),
                project: row.text(0)?,
                name: publication.name.clone(),
                state,
            };
            let reason = if publication.incomplete { "incomplete: some points have no result" } else { "" };
            self.end_job(&mut tx, &head, JobState::Succeeded, reason, now, &mut advance).await?;
        }
        self.commit("publish", tx).await?;
        Ok(advance)
    }

    /// Ends a job and tells the jobs that depend on it.
    async fn end_job(
        &self,
        tx: &mut Tx,
        head: &Head,
        state: JobState,
        reason: &str,
        now: i64,
        advance: &mut Advance,
    ) -> Result<()> {
        advance.changed = true;
        let sql =
            "UPDATE job SET state = $2, reason = $3, ended_at = $4, version = version + 1 WHERE id = $1";
        tx.execute(sql.into(), values![&head.id, state.code(), reason, now]).await?;
        let kind = format!("job.{state}");
        let event = NewEvent {
            kind: &kind,
            project: &head.project,
            job: Some(&head.id),
            actor: "coordinator",
            detail: reason,
        };
        self.record(tx, now, event).await?;
        if state == JobState::Succeeded {
            let sql = "UPDATE job SET state = $2, reason = '', version = version + 1 WHERE state = $3 AND id IN (
                    SELECT d.job_id FROM dependency d WHERE d.needs = $1) AND NOT EXISTS (
                    SELECT 1 FROM dependency d JOIN job n ON n.id = d.needs WHERE d.job_id = job.id AND n.state <> $4)
                RETURNING id";
            let (ready, blocked) = (JobState::Ready.code(), JobState::Blocked.code());
            let values = values![&head.id, ready, blocked, JobState::Succeeded.code()];
            for row in tx.query(sql.into(), values).await? {
                advance.others.push(row.text(0)?);
            }
        }
        Ok(())
    }

    /// Closes all passes of a job that are not at their end: nothing more of them is claimed.
    pub(super) async fn close_passes(&self, tx: &mut Tx, job: &str, now: i64) -> Result<()> {
        let sql = "UPDATE pass SET state = $2, ended_at = $3 WHERE job_id = $1 AND state <= 2";
        tx.execute(sql.into(), values![job, PassState::Cancelled.code(), now]).await?;
        Ok(())
    }

    /// Lets others build what these passes have not.
    async fn hand_over_artifacts(
        &self,
        tx: &mut Tx,
        passes: &[Pass],
        now: i64,
        advance: &mut Advance,
    ) -> Result<()> {
        for pass in passes.iter().filter(|pass| pass.kind == PassKind::Build && pass.state != PassState::Done)
        {
            self.artifact_ended(tx, pass, PassState::Cancelled, now, advance).await?;
        }
        Ok(())
    }

    /// A cancelled job is at its end when no batch of it is leased; then its artifacts are for others to build.
    async fn finish_cancelling(
        &self,
        tx: &mut Tx,
        head: &Head,
        now: i64,
        advance: &mut Advance,
    ) -> Result<()> {
        let sql = "SELECT COUNT(*) FROM lease WHERE pass_id IN (SELECT id FROM pass WHERE job_id = $1)";
        if super::one(tx.query(sql.into(), values![&head.id]).await?)?.int(0)? > 0 {
            return Ok(());
        }
        let passes = self.passes(tx, &head.id).await?;
        self.hand_over_artifacts(tx, &passes, now, advance).await?;
        self.end_job(tx, head, JobState::Cancelled, "cancelled", now, advance).await
    }

    /// Adds an event about a job.
    pub(super) async fn record_job(
        &self,
        tx: &mut Tx,
        job: &str,
        kind: &str,
        actor: &str,
        detail: &str,
        now: i64,
    ) -> Result<()> {
        let row = super::one(tx.query("SELECT project FROM job WHERE id = $1".into(), values![job]).await?)?;
        let project = row.text(0)?;
        self.record(tx, now, NewEvent { kind, project: &project, job: Some(job), actor, detail }).await
    }

    /// Something of a job was claimed for the first time.
    pub(super) async fn job_started(&self, job: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE job SET state = $2, started_at = $3, version = version + 1
            WHERE id = $1 AND started_at IS NULL AND state = $4";
        let values = values![job, JobState::Running.code(), now, JobState::Ready.code()];
        if tx.execute(sql.into(), values).await? == 1 {
            self.record_job(&mut tx, job, "job.running", "coordinator", "", now).await?;
            self.commit("start", tx).await?;
        }
        Ok(())
    }

    /// Jobs that may have a step to take, which nobody took because a coordinator died: all that are live.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn live_jobs(&self) -> Result<Vec<String>> {
        let sql = "SELECT id FROM job WHERE state IN ($1, $2, $3) ORDER BY id";
        let states = values![JobState::Ready.code(), JobState::Running.code(), JobState::Cancelling.code()];
        self.query(sql, states).await?.iter().map(|row| row.text(0)).collect()
    }
}

/// What every pass of a job is asked in common.
fn base_task(job: &str, request: &JobRequest, frame: Option<i64>) -> Task {
    let mut settings = request.settings.clone();
    settings.frame = frame.or(settings.frame);
    Task {
        kind: PassKind::Import,
        job: job.into(),
        settings,
        set: None,
        map: None,
        inputs: None,
        plan: None,
        parts: None,
        partial: request.partial,
    }
}
