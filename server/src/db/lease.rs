//! Leases: extended by heartbeats, given back, run out.

use protocol::work::ClaimedBatch;
use protocol::{FailureClass, PassState};

use super::complete::{Completion, Context, Failed, Tally};
use super::{Store, Tx, placeholders};
use crate::scheduler::failure::Around;
use crate::scheduler::farm::WORKER_LOST_MS;
use crate::{Result, values};

/// Leases that end in one round at most; the next round follows at once.
const EXPIRE_MAX: i64 = 200;

/// What a live lease is of.
#[derive(Clone, Debug)]
pub struct Held {
    /// The pass.
    pub pass: i64,
    /// The job.
    pub job: String,
    /// The batches that are still to be reported.
    pub batches: Vec<ClaimedBatch>,
}

impl Store {
    /// What a live lease of a session is of; none where it is over, or another's.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn held(&self, lease: &str, session: &str) -> Result<Option<Held>> {
        let sql = "SELECT l.pass_id, p.job_id FROM lease l JOIN pass p ON p.id = l.pass_id
            WHERE l.id = $1 AND l.session = $2";
        let Some(row) = self.query_one(sql, values![lease, session]).await? else { return Ok(None) };
        let sql = "SELECT seq, fence FROM batch WHERE lease_id = $1 AND state = 1 ORDER BY seq";
        let rows = self.query(sql, values![lease]).await?;
        let batch = |row: &super::Row| Ok(ClaimedBatch { batch: row.int(0)?, fence: row.int(1)? });
        let batches = rows.iter().map(batch).collect::<Result<_>>()?;
        Ok(Some(Held { pass: row.int(0)?, job: row.text(1)?, batches }))
    }

    /// Extends leases of a session and says which are over: run out, or of a job that was cancelled.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn extend(
        &self,
        session: &str,
        leases: &[String],
        ttl_ms: i64,
        now: i64,
    ) -> Result<(Vec<String>, Vec<String>)> {
        if leases.is_empty() {
            return Ok(Default::default());
        }
        let mut tx = self.begin().await?;
        let sql = format!(
            "UPDATE lease SET expires_at = $2 WHERE session = $1 AND id IN ({})
            AND pass_id NOT IN (SELECT id FROM pass WHERE pass.id = lease.pass_id AND state = $3) RETURNING id",
            placeholders(4, leases.len())
        );
        let mut values = values![session, now + ttl_ms, PassState::Cancelled.code()];
        values.extend(leases.iter().map(Into::into));
        let rows = tx.query(sql.into(), values).await?;
        let extended = rows.iter().map(|row| row.text(0)).collect::<Result<Vec<_>>>()?;
        self.commit("heartbeat", tx).await?;
        let ended = leases.iter().filter(|lease| !extended.contains(lease)).cloned().collect();
        Ok((extended, ended))
    }

    /// Gives batches of a lease back untried; all of them where none is named.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn release(
        &self,
        lease: &str,
        session: &str,
        batches: &[i64],
        around: &Around,
    ) -> Result<Option<Completion>> {
        let mut tx = self.begin().await?;
        let Some(context) = self.lock_lease(&mut tx, lease, Some(session)).await? else { return Ok(None) };
        let mut leased = self.leased(&mut tx, lease).await?;
        leased.retain(|batch| batches.is_empty() || batches.contains(&batch.batch));
        let given_back = Back { class: FailureClass::Interrupted, worker: "", message: "given back" };
        let completion = self.take_back(&mut tx, &context, &leased, &given_back, around).await?;
        self.commit("release", tx).await?;
        Ok(Some(completion))
    }

    /// Ends leases that have run out, up to a bound; there are more if it ended that many.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn expire(&self, around: &Around) -> Result<Vec<Completion>> {
        let sql = "SELECT id, worker FROM lease WHERE expires_at < $1 ORDER BY expires_at LIMIT $2";
        let rows = self.query(sql, values![around.now, EXPIRE_MAX]).await?;
        let mut ended = Vec::new();
        for row in rows {
            let (lease, worker) = (row.text(0)?, row.text(1)?);
            let message = "the lease ran out: its worker was not heard of";
            let ended_one = self.end_lease(&lease, &worker, Some(around.now), message, around).await?;
            ended.extend(ended_one.map(|completion| Completion { lost_worker: Some(worker), ..completion }));
        }
        Ok(ended)
    }

    /// Ends the leases of earlier processes of a worker: they will not be heard of again.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn end_leases_of(
        &self,
        worker: &str,
        session: &str,
        around: &Around,
    ) -> Result<Vec<Completion>> {
        let sql = "SELECT id FROM lease WHERE worker = $1 AND session <> $2";
        let rows = self.query(sql, values![worker, session]).await?;
        let mut ended = Vec::new();
        for row in rows {
            let message = "the worker was started again";
            ended.extend(self.end_lease(&row.text(0)?, worker, None, message, around).await?);
        }
        Ok(ended)
    }

    async fn end_lease(
        &self,
        lease: &str,
        worker: &str,
        expired_at: Option<i64>,
        message: &str,
        around: &Around,
    ) -> Result<Option<Completion>> {
        let mut tx = self.begin().await?;
        let Some(context) = self.lock_lease(&mut tx, lease, None).await? else { return Ok(None) };
        // A heartbeat may have come between
        let sql = "SELECT 1 FROM lease WHERE id = $1 AND expires_at < $2";
        let over = match expired_at {
            Some(now) => !tx.query(sql.into(), values![lease, now]).await?.is_empty(),
            None => true,
        };
        if !over {
            return Ok(None);
        }
        let leased = self.leased(&mut tx, lease).await?;
        let lost = Back { class: FailureClass::Lost, worker, message };
        let completion = self.take_back(&mut tx, &context, &leased, &lost, around).await?;
        if expired_at.is_some() {
            // It did not go on with what it had: it counts as lost until it is heard of again
            let sql = "UPDATE worker SET last_seen = $2 WHERE name = $1 AND last_seen > $2";
            tx.execute(sql.into(), values![worker, around.now - WORKER_LOST_MS]).await?;
        }
        self.commit("expire", tx).await?;
        metrics::counter!("pantaray_leases_expired_total").increment(1);
        Ok(Some(completion))
    }

    /// The batches of a lease.
    async fn leased(&self, tx: &mut Tx, lease: &str) -> Result<Vec<ClaimedBatch>> {
        let sql = "SELECT seq, fence FROM batch WHERE lease_id = $1 AND state = 1 ORDER BY seq";
        let rows = tx.query(sql.into(), values![lease]).await?;
        rows.iter().map(|row| Ok(ClaimedBatch { batch: row.int(0)?, fence: row.int(1)? })).collect()
    }

    async fn take_back(
        &self,
        tx: &mut Tx,
        context: &Context,
        batches: &[ClaimedBatch],
        back: &Back<'_>,
        around: &Around,
    ) -> Result<Completion> {
        let mut completion = Completion {
            pass: context.pass,
            segment: context.segment,
            job: context.job.clone(),
            kind: Some(context.kind),
            ..Completion::default()
        };
        let mut tally = Tally::default();
        for &batch in batches {
            if context.state == PassState::Cancelled {
                let sql = "UPDATE batch SET state = 5, lease_id = NULL WHERE pass_id = $1 AND seq = $2 AND state = 1";
                tally.skipped += tx.execute(sql.into(), values![context.pass, batch.batch]).await? as i64;
            } else if back.class == FailureClass::Interrupted {
                let sql = "UPDATE batch SET state = 0, lease_id = NULL WHERE pass_id = $1 AND seq = $2 AND state = 1";
                tally.ready += tx.execute(sql.into(), values![context.pass, batch.batch]).await? as i64;
            } else {
                let Back { class, worker, message } = *back;
                let failure = Failed { context, worker, batch, class, message };
                if let Some(ruling) = self.fail(tx, &failure, around).await? {
                    tally.count(ruling.fails);
                }
            }
        }
        self.settle(tx, context, &tally, &mut completion).await?;
        if batches.is_empty() && context.n <= 0 {
            tx.execute("DELETE FROM lease WHERE id = $1".into(), values![&context.lease]).await?;
        }
        Ok(completion)
    }

    /// Gives every lease its full time from now on, and no more: a coordinator that was away has heard no heartbeats, and its
    /// clock may have been put back meanwhile.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn forgive(&self, ttl_ms: i64, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE lease SET expires_at = $1";
        tx.execute(sql.into(), values![now + ttl_ms]).await?;
        self.commit("forgive", tx).await
    }
}

/// How batches come back.
struct Back<'a> {
    class: FailureClass,
    worker: &'a str,
    message: &'a str,
}
