//! Results: what a lease's worker says became of its batches. A result counts if its batch is still leased to this lease
//! under this fence, and counts once.

use std::collections::HashMap;

use protocol::limits::{MESSAGE_BYTES_MAX, cut};
use protocol::traced::Traced;
use protocol::work::{ClaimedBatch, CompleteItem, Outcome, Verdict};
use protocol::{BatchState, FailureClass, PassKind, PassState, keys};

use super::opinion::{Distrusted, OPINION};
use super::{Store, Tx, placeholders};
use crate::scheduler::failure::{self, Around, History, Ruling};
use crate::{Result, values};

/// Who reports, and around what.
#[derive(Clone, Copy, Debug)]
pub struct Reporter<'a> {
    /// The lease.
    pub lease: &'a str,
    /// The pass that the worker takes it to be of.
    pub pass: i64,
    /// The worker's process.
    pub session: &'a str,
    /// The worker.
    pub worker: &'a str,
    /// What traced.
    pub device: &'a str,
    /// The time and the farm.
    pub around: Around,
    /// One result in so many is to be confirmed by another worker; none where this is 0.
    pub opinion_every: u32,
}

/// What came of a report.
#[derive(Clone, Debug, Default)]
pub struct Completion {
    /// The pass; 0 where the lease is not known.
    pub pass: i64,
    /// The segment.
    pub segment: i64,
    /// The job.
    pub job: String,
    /// One for each item.
    pub verdicts: Vec<Verdict>,
    /// Batches that are not leased any more.
    pub ended: i64,
    /// Those of them that can be claimed again.
    pub ready: i64,
    /// Whether the lease goes on.
    pub lease_live: bool,
    /// Whether the job may have come to its next step.
    pub advances: bool,
    /// Whether a second result of a batch differs from the first.
    pub diverged: bool,
    /// What the pass does.
    pub kind: Option<PassKind>,
    /// Whether the worker is to blame for a failure.
    pub blames: bool,
    /// Why the job was paused, if it was.
    pub storm: Option<String>,
    /// Workers that are not believed any more.
    pub distrusted: Vec<Distrusted>,
    /// The worker that was not heard of for as long as the lease lasted.
    pub lost_worker: Option<String>,
    /// What tracing the batches took whose results count.
    pub traced: Traced,
}

/// The lease and pass that a report is about.
pub(super) struct Context {
    pub lease: String,
    pub pass: i64,
    pub segment: i64,
    pub job: String,
    pub kind: PassKind,
    pub state: PassState,
    pub n: i64,
}

impl Store {
    /// Takes results in.
    ///
    /// # Errors
    /// When the database refuses; then nothing was taken in.
    pub async fn complete(&self, reporter: &Reporter<'_>, items: &[CompleteItem]) -> Result<Completion> {
        let mut tx = self.begin().await?;
        let Some(context) = self.lock_lease(&mut tx, reporter.lease, Some(reporter.session)).await? else {
            tx.rollback().await?;
            return self.late(reporter, items).await;
        };
        let mut completion = Completion {
            pass: context.pass,
            segment: context.segment,
            job: context.job.clone(),
            kind: Some(context.kind),
            verdicts: vec![Verdict::Superseded; items.len()],
            ..Completion::default()
        };
        let mut tally = Tally::default();
        if context.state == PassState::Cancelled {
            self.complete_cancelled(&mut tx, &context, items, &mut completion, &mut tally).await?;
        } else {
            let held = self.question(&mut tx, reporter, &context, items, &mut completion, &mut tally).await?;
            let counting = (&context, reporter.worker, &held[..]);
            self.complete_done(&mut tx, counting, items, &mut completion, &mut tally).await?;
            self.complete_failed(&mut tx, reporter, &context, items, &mut completion, &mut tally).await?;
        }
        if !completion.distrusted.is_empty() {
            self.distrust(&mut tx, &context, &completion, reporter.around.now).await?;
            completion.advances = true;
        }
        if completion.traced.batches > 0 {
            let whose = (context.pass, reporter.worker);
            self.add_traced(&mut tx, whose, reporter.device, completion.traced, reporter.around.now).await?;
        }
        self.settle(&mut tx, &context, &tally, &mut completion).await?;
        self.commit("complete", tx).await?;
        self.look_back(&context, items, &mut completion).await?;
        Ok(completion)
    }

    /// Locks a lease and reads what it is of; none if it is over.
    pub(super) async fn lock_lease(
        &self,
        tx: &mut Tx,
        lease: &str,
        session: Option<&str>,
    ) -> Result<Option<Context>> {
        let sql = format!("SELECT pass_id, seg, n, session FROM lease WHERE id = $1{}", self.dialect().lock);
        let rows = tx.query(sql.into(), values![lease]).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        if session.is_some_and(|session| row.text(3).as_deref().ok() != Some(session)) {
            return Ok(None);
        }
        let (pass, segment, n) = (row.int(0)?, row.int(1)?, row.int(2)?);
        let rows =
            tx.query("SELECT job_id, kind, state FROM pass WHERE id = $1".into(), values![pass]).await?;
        let row = super::one(rows)?;
        Ok(Some(Context {
            lease: lease.into(),
            pass,
            segment,
            job: row.text(0)?,
            kind: row.word(1, PassKind::from_code)?,
            state: row.word(2, PassState::from_code)?,
            n,
        }))
    }

    /// Batches of a job that was cancelled end, whatever came of them.
    async fn complete_cancelled(
        &self,
        tx: &mut Tx,
        context: &Context,
        items: &[CompleteItem],
        completion: &mut Completion,
        tally: &mut Tally,
    ) -> Result<()> {
        for (item, verdict) in items.iter().zip(&mut completion.verdicts) {
            let sql =
                "UPDATE batch SET state = $4, lease_id = NULL WHERE pass_id = $1 AND seq = $2 AND fence = $3
                AND state = 1 AND lease_id = $5";
            let cancelled = BatchState::Cancelled.code();
            let values = values![context.pass, item.batch, item.fence, cancelled, &context.lease];
            if tx.execute(sql.into(), values).await? == 1 {
                tally.skipped += 1;
                *verdict = Verdict::Cancelled;
            }
        }
        Ok(())
    }

    /// Accepts results of a worker but those that are held back, all with one statement.
    async fn complete_done(
        &self,
        tx: &mut Tx,
        (context, worker, held): (&Context, &str, &[i64]),
        items: &[CompleteItem],
        completion: &mut Completion,
        tally: &mut Tally,
    ) -> Result<()> {
        let mut values = values![context.pass, &context.lease, worker];
        let mut rows = Vec::new();
        for item in items.iter().filter(|item| !held.contains(&item.batch)) {
            let Outcome::Done { sha256, bytes, .. } = &item.outcome else { continue };
            rows.push(format!("({})", placeholders(values.len() + 1, 4)));
            values.extend(values![item.batch, item.fence, sha256, *bytes]);
        }
        if rows.is_empty() {
            return Ok(());
        }
        let sql = format!(
            "UPDATE batch SET state = 2, sha256 = v.column3, bytes = v.column4, worker = $3, lease_id = NULL
            FROM (VALUES {}) AS v
            WHERE batch.pass_id = $1 AND batch.seq = v.column1 AND batch.fence = v.column2
                AND batch.state = 1 AND batch.lease_id = $2
            RETURNING seq",
            rows.join(", ")
        );
        let accepted = tx.query(sql.into(), values).await?;
        let accepted = accepted.iter().map(|row| row.int(0)).collect::<Result<Vec<_>>>()?;
        for (item, verdict) in items.iter().zip(&mut completion.verdicts) {
            let Outcome::Done { result, .. } = &item.outcome else { continue };
            // The same batch twice in one report counts once
            if *verdict != Verdict::Superseded || !accepted.contains(&item.batch) {
                continue;
            }
            *verdict = Verdict::Accepted;
            if let Some(traced) = item.traced {
                completion.traced.add_batch(Traced { batches: 1, ..traced });
            }
            tally.elapsed_ms += item.elapsed_ms.clamp(0, 7 * 86_400_000);
            if let Some(result) = result {
                let key = keys::result_folder(&context.job, context.pass, item.fence);
                let json = serde_json::json!({ "result": result, "key": key }).to_string();
                let sql = "UPDATE pass SET result = $2 WHERE id = $1";
                tx.execute(sql.into(), values![context.pass, json]).await?;
            }
        }
        tally.done += accepted.len() as i64;
        Ok(())
    }

    async fn complete_failed(
        &self,
        tx: &mut Tx,
        reporter: &Reporter<'_>,
        context: &Context,
        items: &[CompleteItem],
        completion: &mut Completion,
        tally: &mut Tally,
    ) -> Result<()> {
        for (number, item) in items.iter().enumerate() {
            let Outcome::Failed { class, message, bad_parts } = &item.outcome else { continue };
            let batch = ClaimedBatch { batch: item.batch, fence: item.fence };
            let failure = Failed { context, worker: reporter.worker, batch, class: *class, message };
            let Some(ruling) = self.fail(tx, &failure, &reporter.around).await? else { continue };
            completion.verdicts[number] = Verdict::Accepted;
            tally.count(ruling.fails);
            completion.blames |= ruling.blames_worker;
            if context.kind == PassKind::Merge && !bad_parts.is_empty() && !ruling.fails {
                self.take_parts_back(tx, context, bad_parts).await?;
                completion.advances = true;
            }
            if completion.storm.is_none() {
                completion.storm = self.storm(tx, context, *class, reporter.around.now).await?;
            }
        }
        Ok(())
    }

    /// One batch's failure: its record, and what becomes of the batch; none if it is not the lease's any more.
    pub(super) async fn fail(
        &self,
        tx: &mut Tx,
        failure: &Failed<'_>,
        around: &Around,
    ) -> Result<Option<Ruling>> {
        let Failed { context, worker, batch, class, message } = *failure;
        let sql = format!(
            "SELECT tries, lost, memory_min FROM batch
            WHERE pass_id = $1 AND seq = $2 AND fence = $3 AND state = 1 AND lease_id = $4{}",
            self.dialect().lock
        );
        let rows =
            tx.query(sql.into(), values![context.pass, batch.batch, batch.fence, &context.lease]).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        let (tries, lost, memory_min) = (row.int(0)?, row.int(1)?, row.int(2)?);

        let sql = "INSERT INTO batch_fault (pass_id, seq, worker, class, n, fence, message, first_at, at)
            VALUES ($1, $2, $3, $4, 1, $5, $6, $7, $7)
            ON CONFLICT (pass_id, seq, worker, class) DO UPDATE SET n = batch_fault.n + 1, fence = $5, message = $6, at = $7";
        let text = cut(message, MESSAGE_BYTES_MAX);
        let values = values![context.pass, batch.batch, worker, class.code(), batch.fence, text, around.now];
        tx.execute(sql.into(), values).await?;

        let mut history = self.history(tx, context.pass, batch.batch).await?;
        (history.tries, history.lost, history.memory_min) = (tries, lost, memory_min);
        let ruling = failure::rule(class, &history, around);
        let state = if ruling.fails { BatchState::Failed } else { BatchState::Ready };
        let sql = "UPDATE batch SET state = $3, lease_id = NULL, tries = tries + $4, lost = lost + $5,
            not_before = $6, memory_min = $7 WHERE pass_id = $1 AND seq = $2";
        let values = values![
            context.pass,
            batch.batch,
            state.code(),
            ruling.tries,
            ruling.lost,
            ruling.not_before,
            ruling.memory_min
        ];
        tx.execute(sql.into(), values).await?;
        if ruling.blames_worker {
            let sql = "INSERT INTO worker_block (worker, job_id, n) VALUES ($1, $2, 1)
                ON CONFLICT (worker, job_id) DO UPDATE SET n = worker_block.n + 1";
            tx.execute(sql.into(), values![worker, &context.job]).await?;
            self.judge_worker(tx, worker, around.now).await?;
        }
        metrics::counter!("pantaray_batch_failures_total", "class" => class.word()).increment(1);
        Ok(Some(ruling))
    }

    /// The failures of a batch so far.
    async fn history(&self, tx: &mut Tx, pass: i64, batch: i64) -> Result<History> {
        let sql = "SELECT worker, class, n, first_at FROM batch_fault WHERE pass_id = $1 AND seq = $2 AND class <> $3";
        let mut history = History::default();
        let mut workers: Vec<String> = Vec::new();
        for row in tx.query(sql.into(), values![pass, batch, OPINION]).await? {
            let class = row.word(1, FailureClass::from_code)?;
            let worker = row.text(0)?;
            match class {
                FailureClass::Input => history.input_workers += 1,
                FailureClass::TransientIo => {
                    history.transient += row.int(2)?;
                    let since = row.int(3)?;
                    let first = history.transient_since == 0 || since < history.transient_since;
                    history.transient_since = if first { since } else { history.transient_since };
                }
                class if failure::counts_worker(class) && !workers.contains(&worker) => workers.push(worker),
                _ => {}
            }
        }
        history.workers = workers.len() as i64;
        Ok(history)
    }

    /// Puts a worker to rest that is to blame for failures of several batches.
    async fn judge_worker(&self, tx: &mut Tx, worker: &str, now: i64) -> Result<()> {
        let sql = "SELECT COUNT(*) FROM (SELECT DISTINCT pass_id, seq FROM batch_fault
            WHERE worker = $1 AND at > $2 AND class IN (3, 7)) AS blamed";
        let rows = tx.query(sql.into(), values![worker, now - failure::SICK_MS]).await?;
        if super::one(rows)?.int(0)? >= failure::SICK_AFTER {
            let sql = "UPDATE worker SET sick_until = $2 WHERE name = $1 AND sick_until < $3";
            if tx.execute(sql.into(), values![worker, now + failure::SICK_MS, now]).await? == 1 {
                metrics::counter!("pantaray_worker_sick_total").increment(1);
            }
        }
        Ok(())
    }

    /// Pauses a job of which too many of a pass's first batches fail in the same way.
    async fn storm(
        &self,
        tx: &mut Tx,
        context: &Context,
        class: FailureClass,
        now: i64,
    ) -> Result<Option<String>> {
        if matches!(class, FailureClass::Interrupted | FailureClass::Lost) {
            return Ok(None);
        }
        let sql = "SELECT COUNT(*), CAST(COALESCE(SUM(n), 0) AS BIGINT) FROM batch_fault WHERE pass_id = $1 AND class = $2";
        let failures =
            super::one(tx.query(sql.into(), values![context.pass, class.code()]).await?)?.int(1)?;
        let sql = "SELECT CAST(SUM(n_done) AS BIGINT) FROM segment WHERE pass_id = $1";
        let done = super::one(tx.query(sql.into(), values![context.pass]).await?)?.int(0)?;
        if failures < failure::STORM_FAILURES || done + failures > failure::STORM_BATCHES {
            return Ok(None);
        }
        let reason = format!("{failures} failures of class `{class}` among its first batches");
        let sql =
            "UPDATE job SET paused = 1, reason = $2, version = version + 1 WHERE id = $1 AND paused = 0";
        if tx.execute(sql.into(), values![&context.job, &reason]).await? == 0 {
            return Ok(None);
        }
        self.record_job(tx, &context.job, "job.paused", "coordinator", &reason, now).await?;
        Ok(Some(reason))
    }

    /// Parts that a merge found damaged: their batches are baked again, and the merge waits.
    async fn take_parts_back(&self, tx: &mut Tx, context: &Context, parts: &[ClaimedBatch]) -> Result<()> {
        let sql = "SELECT id, segment_size FROM pass WHERE job_id = $1 AND kind = $2 AND name =
            (SELECT name FROM pass WHERE id = $3)";
        let values = values![&context.job, PassKind::Bake.code(), context.pass];
        let row = super::one(tx.query(sql.into(), values).await?)?;
        let (bake, size) = (row.int(0)?, row.int(1)?);
        let mut counts: HashMap<i64, i64> = HashMap::new();
        for part in parts {
            let sql = "UPDATE batch SET state = 0, sha256 = NULL, tries = tries + 1
                WHERE pass_id = $1 AND seq = $2 AND fence = $3 AND state = 2";
            let changed = tx.execute(sql.into(), values![bake, part.batch, part.fence]).await?;
            *counts.entry(part.batch / size).or_default() += changed as i64;
        }
        let mut counts: Vec<_> = counts.into_iter().filter(|&(_, count)| count > 0).collect();
        counts.sort_unstable();
        for (segment, count) in &counts {
            let sql = "UPDATE segment SET n_done = n_done - $3, n_ready = n_ready + $3 WHERE pass_id = $1 AND seg = $2";
            tx.execute(sql.into(), values![bake, *segment, *count]).await?;
        }
        if !counts.is_empty() {
            let sql = "UPDATE pass SET state = $2, ended_at = NULL WHERE id = $1";
            tx.execute(sql.into(), values![bake, PassState::Open.code()]).await?;
            tx.execute(sql.into(), values![context.pass, PassState::Waiting.code()]).await?;
        }
        Ok(())
    }

    /// Brings segment and lease up to date with what happened to the batches.
    pub(super) async fn settle(
        &self,
        tx: &mut Tx,
        context: &Context,
        tally: &Tally,
        completion: &mut Completion,
    ) -> Result<()> {
        let ended = tally.ended();
        completion.ended = ended;
        completion.ready = tally.ready;
        completion.lease_live = context.n > ended;
        if ended == 0 {
            return Ok(());
        }
        let sql = match completion.lease_live {
            true => "UPDATE lease SET n = n - $2 WHERE id = $1",
            false => "DELETE FROM lease WHERE id = $1 AND n <= $2",
        };
        tx.execute(sql.into(), values![&context.lease, ended]).await?;
        let sql = "UPDATE segment SET n_leased = n_leased - $3, n_ready = n_ready + $4, n_done = n_done + $5,
                n_failed = n_failed + $6, n_skipped = n_skipped + $7,
                ewma_ms = CASE WHEN $5 = 0 THEN ewma_ms WHEN ewma_ms = 0 THEN $8 ELSE (3 * ewma_ms + $8) / 4 END
            WHERE pass_id = $1 AND seg = $2 RETURNING n_ready + n_leased";
        let mean_ms = if tally.done > 0 { (tally.elapsed_ms / tally.done).max(1) } else { 0 };
        let values = values![
            context.pass,
            context.segment,
            ended,
            tally.ready,
            tally.done,
            tally.failed,
            tally.skipped,
            mean_ms
        ];
        let open = super::one(tx.query(sql.into(), values).await?)?.int(0)?;
        completion.advances |= open == 0 || tally.failed > 0;
        Ok(())
    }

    /// Tells results that were accepted before from those that came too late, and counts those that differ.
    async fn look_back(
        &self,
        context: &Context,
        items: &[CompleteItem],
        completion: &mut Completion,
    ) -> Result<()> {
        for (item, verdict) in items.iter().zip(&mut completion.verdicts) {
            if *verdict == Verdict::Superseded {
                let (known, diverged) = self.known(context.pass, context.kind, item).await?;
                *verdict = known;
                completion.diverged |= diverged;
            }
        }
        Ok(())
    }

    async fn known(&self, pass: i64, kind: PassKind, item: &CompleteItem) -> Result<(Verdict, bool)> {
        let Outcome::Done { sha256, .. } = &item.outcome else { return Ok((Verdict::Superseded, false)) };
        let sql = "SELECT state, fence, sha256 FROM batch WHERE pass_id = $1 AND seq = $2";
        let Some(row) = self.query_one(sql, values![pass, item.batch]).await? else {
            return Ok((Verdict::Rejected, false));
        };
        let accepted = row.text_or_null(2)?;
        let same = accepted.as_ref() == Some(sha256);
        let done = row.word(0, BatchState::from_code)? == BatchState::Done;
        if done && same && row.int(1)? == item.fence {
            return Ok((Verdict::AlreadyDone, false));
        }
        Ok((Verdict::Superseded, done && !same && kind == PassKind::Bake))
    }

    /// A report about a lease that is over.
    async fn late(&self, reporter: &Reporter<'_>, items: &[CompleteItem]) -> Result<Completion> {
        let mut completion =
            Completion { verdicts: vec![Verdict::Superseded; items.len()], ..Completion::default() };
        let row = self.query_one("SELECT kind FROM pass WHERE id = $1", values![reporter.pass]).await?;
        let Some(row) = row else { return Ok(completion) };
        let (pass, kind) = (reporter.pass, row.word(0, PassKind::from_code)?);
        for (item, verdict) in items.iter().zip(&mut completion.verdicts) {
            let (known, diverged) = self.known(pass, kind, item).await?;
            *verdict = known;
            completion.diverged |= diverged;
        }
        Ok(completion)
    }
}

/// A failure of a batch.
pub(super) struct Failed<'a> {
    pub context: &'a Context,
    pub worker: &'a str,
    pub batch: ClaimedBatch,
    pub class: FailureClass,
    pub message: &'a str,
}

/// What happened to the batches of one lease.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tally {
    pub done: i64,
    pub ready: i64,
    pub failed: i64,
    pub skipped: i64,
    pub elapsed_ms: i64,
}

impl Tally {
    pub fn count(&mut self, fails: bool) {
        if fails { self.failed += 1 } else { self.ready += 1 }
    }

    fn ended(&self) -> i64 {
        self.done + self.ready + self.failed + self.skipped
    }
}
