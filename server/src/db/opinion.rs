//! Results that another worker is to confirm before they count, and workers that are not believed any more.
//!
//! An opinion is a row among the failures of its batch, of a class of its own, so that whoever has one is offered the batch to
//! nobody but others.

use protocol::limits::{MESSAGE_BYTES_MAX, cut};
use protocol::work::{CompleteItem, Outcome, Verdict};
use protocol::{BatchState, FailureClass, PassKind, PassState};

use super::complete::{Completion, Context, Reporter, Tally};
use super::{Store, Tx};
use crate::scheduler::failure::{BLOCK_AFTER, TRIES_MAX};
use crate::scheduler::farm::WORKER_LOST_MS;
use crate::scheduler::opinion::{Judgement, Opinion, device, is_chosen, judge};
use crate::{Result, values};

/// Beside the codes of [`FailureClass`]: not a failure, but what a worker says the result is.
pub(super) const OPINION: i64 = 9;

/// A worker that is not believed any more.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Distrusted {
    /// Its name.
    pub worker: String,
    /// The batch that it got wrong.
    pub batch: i64,
    /// Why.
    pub reason: String,
}

/// One result that may have to be confirmed.
struct Questioned<'a> {
    context: &'a Context,
    batch: i64,
    fence: i64,
    own: Opinion,
    now: i64,
}

/// What becomes of it.
struct Ruling {
    /// A word for metrics.
    outcome: &'static str,
    /// Whether its batch is given up, where it does not count.
    held: Option<bool>,
    /// Who is not believed any more.
    distrusted: Vec<Distrusted>,
}

impl Questioned<'_> {
    fn distrust(&self, workers: Vec<String>, what: &str) -> Vec<Distrusted> {
        let reason = format!("batch {} of pass {}: {what}", self.batch, self.context.pass);
        let distrusted = |worker| Distrusted { worker, batch: self.batch, reason: reason.clone() };
        workers.into_iter().map(distrusted).collect()
    }
}

impl Store {
    /// Keeps back the results that another worker is to confirm; the batches that do not count yet.
    pub(super) async fn question(
        &self,
        tx: &mut Tx,
        reporter: &Reporter<'_>,
        context: &Context,
        items: &[CompleteItem],
        completion: &mut Completion,
        tally: &mut Tally,
    ) -> Result<Vec<i64>> {
        let mut held = Vec::new();
        if context.kind != PassKind::Bake {
            return Ok(held);
        }
        for (item, verdict) in items.iter().zip(&mut completion.verdicts) {
            let Outcome::Done { sha256, bytes: 1.., .. } = &item.outcome else { continue };
            if !is_chosen(context.pass, item.batch, reporter.opinion_every) {
                continue;
            }
            let Some(ruling) = self.rule_on(tx, reporter, context, item, sha256).await? else { continue };
            metrics::counter!("pantaray_second_opinions_total", "outcome" => ruling.outcome).increment(1);
            completion.diverged |= ruling.outcome == "split";
            completion.distrusted.extend(ruling.distrusted);
            if let Some(fails) = ruling.held {
                tally.count(fails);
                *verdict = Verdict::Accepted;
                held.push(item.batch);
            }
        }
        Ok(held)
    }

    /// Locks workers; what they hold is over, and what they did in bakes that go on is baked again by others. After the report
    /// in which that came out was taken in: it may be one of theirs.
    pub(super) async fn distrust(
        &self,
        tx: &mut Tx,
        context: &Context,
        completion: &Completion,
        now: i64,
    ) -> Result<()> {
        // Leases first, as everywhere. From this commit on no report on them counts, whoever ends them, and when
        for Distrusted { worker, .. } in &completion.distrusted {
            let sql = "UPDATE lease SET session = 'over', expires_at = 0 WHERE worker = $1";
            tx.execute(sql.into(), values![worker]).await?;
        }
        for distrusted in &completion.distrusted {
            self.lock_and_redo(tx, context, distrusted, now).await?;
        }
        Ok(())
    }

    /// What becomes of one result beside what others said of its batch; none if the batch is not the lease's any more.
    async fn rule_on(
        &self,
        tx: &mut Tx,
        reporter: &Reporter<'_>,
        context: &Context,
        item: &CompleteItem,
        sha256: &str,
    ) -> Result<Option<Ruling>> {
        let sql = format!(
            "SELECT tries FROM batch WHERE pass_id = $1 AND seq = $2 AND fence = $3 AND state = 1 AND lease_id = $4{}",
            self.dialect().lock
        );
        let (batch, fence, now) = (item.batch, item.fence, reporter.around.now);
        let rows = tx.query(sql.into(), values![context.pass, batch, fence, &context.lease]).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        let is_last_try = row.int(0)? + 1 >= TRIES_MAX;
        let (device, has_peer) = self.peers(tx, &context.job, reporter.worker, now).await?;
        let own = Opinion { worker: reporter.worker.into(), sha256: sha256.into(), device };
        let questioned = Questioned { context, batch, fence, own, now };
        let known = self.opinions(tx, context.pass, batch).await?;
        let ruling = match judge(&known, &questioned.own, fence == 1, has_peer) {
            Judgement::Counts => Ruling { outcome: "counted", held: None, distrusted: Vec::new() },
            Judgement::Ask => Ruling { outcome: "asked", held: Some(false), distrusted: Vec::new() },
            Judgement::Agreed(wrong) => {
                let distrusted = questioned.distrust(wrong, "others agree on another result");
                Ruling { outcome: "agreed", held: None, distrusted }
            }
            Judgement::Split if is_last_try => {
                let mut all: Vec<String> = known.iter().map(|known| known.worker.clone()).collect();
                all.push(questioned.own.worker.clone());
                all.sort_unstable();
                all.dedup();
                let distrusted = questioned.distrust(all, "no two workers agree on its result");
                Ruling { outcome: "split", held: Some(true), distrusted }
            }
            Judgement::Split => Ruling { outcome: "split", held: Some(false), distrusted: Vec::new() },
        };
        if ruling.held != Some(false) {
            self.forget_opinions(tx, context.pass, batch).await?;
        }
        if let Some(fails) = ruling.held {
            self.hold(tx, &questioned, fails).await?;
        }
        Ok(Some(ruling))
    }

    /// The device of a worker, and whether another one of the same could take a batch of the job.
    async fn peers(&self, tx: &mut Tx, job: &str, worker: &str, now: i64) -> Result<(Option<String>, bool)> {
        let rows = tx.query("SELECT request FROM job WHERE id = $1".into(), values![job]).await?;
        let request: serde_json::Value = serde_json::from_str(&super::one(rows)?.text(0)?)?;
        let requires = request["requires"].as_array().map_or(&[][..], Vec::as_slice);
        let sql =
            "SELECT w.name, w.labels FROM worker w WHERE w.name = $1 OR (w.locked = 0 AND w.draining = 0
                AND w.sick_until <= $2 AND w.last_seen > $3 AND NOT EXISTS (
                    SELECT 1 FROM worker_block k WHERE k.worker = w.name AND k.job_id = $4 AND k.n >= $5))
            ORDER BY w.name LIMIT 10000";
        let rows = tx.query(sql.into(), values![worker, now, now - WORKER_LOST_MS, job, BLOCK_AFTER]).await?;
        let (mut own, mut others) = (None, Vec::new());
        for row in rows {
            let labels: Vec<String> = serde_json::from_str(&row.text(1)?)?;
            if row.text(0)? == worker {
                own = device(&labels);
            } else if requires.iter().all(|wanted| labels.iter().any(|label| wanted == label)) {
                others.push(device(&labels));
            }
        }
        let has_peer = others.contains(&own);
        Ok((own, has_peer))
    }

    /// What workers have said about a batch.
    async fn opinions(&self, tx: &mut Tx, pass: i64, batch: i64) -> Result<Vec<Opinion>> {
        let sql =
            "SELECT f.worker, f.message, w.labels FROM batch_fault f LEFT JOIN worker w ON w.name = f.worker
            WHERE f.pass_id = $1 AND f.seq = $2 AND f.class = $3 ORDER BY f.worker";
        let mut opinions = Vec::new();
        for row in tx.query(sql.into(), values![pass, batch, OPINION]).await? {
            let labels = row.text_or_null(2)?.map(|labels| serde_json::from_str(&labels)).transpose()?;
            let labels: Vec<String> = labels.unwrap_or_default();
            opinions.push(Opinion { worker: row.text(0)?, sha256: row.text(1)?, device: device(&labels) });
        }
        Ok(opinions)
    }

    async fn forget_opinions(&self, tx: &mut Tx, pass: i64, batch: i64) -> Result<()> {
        let sql = "DELETE FROM batch_fault WHERE pass_id = $1 AND seq = $2 AND class = $3";
        tx.execute(sql.into(), values![pass, batch, OPINION]).await?;
        Ok(())
    }

    /// Writes an opinion down and offers the batch to others; or gives it up.
    async fn hold(&self, tx: &mut Tx, questioned: &Questioned<'_>, fails: bool) -> Result<()> {
        let Questioned { context, batch, fence, ref own, now } = *questioned;
        if !fails {
            let sql = "INSERT INTO batch_fault (pass_id, seq, worker, class, n, fence, message, first_at, at)
                VALUES ($1, $2, $3, $4, 1, $5, $6, $7, $7)
                ON CONFLICT (pass_id, seq, worker, class) DO UPDATE SET n = batch_fault.n + 1, fence = $5, message = $6, at = $7";
            let values = values![context.pass, batch, &own.worker, OPINION, fence, &own.sha256, now];
            tx.execute(sql.into(), values).await?;
        }
        let state = if fails { BatchState::Failed } else { BatchState::Ready };
        let sql =
            "UPDATE batch SET state = $3, lease_id = NULL, tries = tries + 1 WHERE pass_id = $1 AND seq = $2";
        tx.execute(sql.into(), values![context.pass, batch, state.code()]).await?;
        Ok(())
    }

    /// Locks a worker, and opens its batches of bakes that go on.
    async fn lock_and_redo(
        &self,
        tx: &mut Tx,
        context: &Context,
        distrusted: &Distrusted,
        now: i64,
    ) -> Result<()> {
        let Distrusted { worker, batch, reason } = distrusted;
        let reason = cut(reason, MESSAGE_BYTES_MAX);
        let sql = "INSERT INTO batch_fault (pass_id, seq, worker, class, n, fence, message, first_at, at)
            VALUES ($1, $2, $3, $4, 1, 0, $5, $6, $6) ON CONFLICT DO NOTHING";
        let class = FailureClass::Verify.code();
        tx.execute(sql.into(), values![context.pass, *batch, worker, class, reason, now]).await?;
        let sql = "UPDATE worker SET locked = 1, reason = $2 WHERE name = $1";
        tx.execute(sql.into(), values![worker, reason]).await?;
        self.record_job(tx, &context.job, "worker.distrusted", worker, reason, now).await?;
        let sql = "SELECT id FROM pass WHERE kind = $1 AND state = $2 AND state <= 2 ORDER BY id";
        let values = values![PassKind::Bake.code(), PassState::Open.code()];
        for row in tx.query(sql.into(), values).await? {
            let pass = row.int(0)?;
            let sql = "SELECT seg, COUNT(*) FROM batch WHERE pass_id = $1 AND state = 2 AND worker = $2 GROUP BY seg ORDER BY seg";
            let segments = tx.query(sql.into(), values![pass, worker]).await?;
            let sql = "UPDATE batch SET state = 0, sha256 = NULL, worker = NULL WHERE pass_id = $1 AND state = 2 AND worker = $2";
            tx.execute(sql.into(), values![pass, worker]).await?;
            for row in segments {
                let sql = "UPDATE segment SET n_done = n_done - $3, n_ready = n_ready + $3 WHERE pass_id = $1 AND seg = $2";
                tx.execute(sql.into(), values![pass, row.int(0)?, row.int(1)?]).await?;
            }
        }
        Ok(())
    }
}
