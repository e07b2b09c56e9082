//! Claims: some batches of one segment become one worker's for a while, under fences that have never been used.

use protocol::PassState;
use protocol::work::ClaimedBatch;

use super::Store;
use crate::scheduler::choose::Candidate;
use crate::scheduler::failure::BLOCK_AFTER;
use crate::{Result, values};

/// Who claims.
#[derive(Clone, Copy, Debug)]
pub struct Claimer<'a> {
    /// The worker's name.
    pub worker: &'a str,
    /// Its process.
    pub session: &'a str,
    /// Memory that it may use.
    pub memory_bytes: i64,
    /// Workers that are alive, this one among them: another one may take what this one has failed at.
    pub alive: i64,
}

/// What came of a claim.
#[derive(Clone, Debug)]
pub enum Taken {
    /// Batches.
    Granted(Granted),
    /// Another claim has the segment at this moment: there may be something in it.
    Busy,
    /// Nothing.
    Empty,
}

impl Taken {
    /// What was got, if anything.
    pub fn granted(self) -> Option<Granted> {
        match self {
            Self::Granted(granted) => Some(granted),
            Self::Busy | Self::Empty => None,
        }
    }
}

/// What a claim got.
#[derive(Clone, Debug)]
pub struct Granted {
    /// The lease.
    pub lease: String,
    /// The batches, in order.
    pub batches: Vec<ClaimedBatch>,
    /// Whether this is the first claim of the job.
    pub first_of_job: bool,
}

impl Store {
    /// Claims up to `candidate.count` batches of a segment; none where it is closed, empty, or being claimed from, or where the
    /// job does not want the worker.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn claim(
        &self,
        candidate: &Candidate,
        from_tail: bool,
        claimer: &Claimer<'_>,
        ttl_ms: i64,
        now: i64,
    ) -> Result<Taken> {
        let Candidate { pass, segment, count, .. } = *candidate;
        let mut tx = self.begin().await?;

        // Lock the segment, or leave it to whoever has it; a process whose name another has taken gets nothing
        let sql = "SELECT p.job_id, j.started_at, s.lo, s.hi FROM segment s JOIN pass p ON p.id = s.pass_id JOIN job j ON j.id = p.job_id
            WHERE s.pass_id = $1 AND s.seg = $2 AND s.n_ready > 0 AND p.state = $3 AND j.paused = 0
                AND NOT EXISTS (SELECT 1 FROM worker w WHERE w.name = $4 AND w.session <> $5)
                AND NOT EXISTS (SELECT 1 FROM worker_block k WHERE k.worker = $4 AND k.job_id = j.id AND k.n >= $6)";
        let (open, block) = (PassState::Open.code(), BLOCK_AFTER);
        let values = values![pass, segment, open, claimer.worker, claimer.session, block];
        let skip = self.dialect().lock_s_skip;
        let rows = tx.query(format!("{sql}{skip}").into(), values.clone()).await?;
        let Some(row) = rows.first() else {
            tx.rollback().await?;
            // Where rows are skipped, one that can be seen is one that somebody has
            let is_busy = !skip.is_empty() && self.query_one(sql, values).await?.is_some();
            return Ok(if is_busy { Taken::Busy } else { Taken::Empty });
        };
        let (job, first_of_job) = (row.text(0)?, row.int_or_null(1)?.is_none());
        let (lo, hi) = (row.int(2)?, row.int(3)?);

        // Take what this worker has not failed at, or what as many have failed at as there are
        let not_mine = match claimer.alive {
            alive @ 2.. => format!(
                "AND (b.tries + b.lost = 0 OR NOT EXISTS (SELECT 1 FROM batch_fault f
                    WHERE f.pass_id = b.pass_id AND f.seq = b.seq AND f.worker = $6 AND f.class <> 8)
                    OR {alive} <= (SELECT COUNT(DISTINCT f.worker) FROM batch_fault f
                    WHERE f.pass_id = b.pass_id AND f.seq = b.seq AND f.class <> 8))"
            ),
            _ => "AND $6 <> ''".into(),
        };
        let order = if from_tail { "DESC" } else { "ASC" };
        let sql = format!(
            "UPDATE batch SET state = 1, fence = fence + 1, lease_id = $5 WHERE pass_id = $1 AND state = 0 AND seq IN (
                SELECT b.seq FROM batch b WHERE b.pass_id = $1 AND b.seq >= $2 AND b.seq < $8 AND b.state = 0
                    AND b.not_before <= $3 AND b.memory_min <= $4 {not_mine} ORDER BY b.seq {order} LIMIT $7)
            RETURNING seq, fence"
        );
        let lease = crate::random::id(now);
        let memory = claimer.memory_bytes;
        let values = values![pass, lo, now, memory, &lease, claimer.worker, count, hi];
        let rows = tx.query(sql.into(), values).await?;
        let batch = |row: &super::Row| Ok(ClaimedBatch { batch: row.int(0)?, fence: row.int(1)? });
        let mut batches = rows.iter().map(batch).collect::<Result<Vec<_>>>()?;
        if batches.is_empty() {
            // Others skip a locked segment: it must be free before this claim says that it found nothing
            tx.rollback().await?;
            return Ok(Taken::Empty);
        }
        batches.sort_unstable_by_key(|batch| batch.batch);

        // Count, and write the lease down
        let n = batches.len() as i64;
        let mut sql = "UPDATE segment SET n_ready = n_ready - $3, n_leased = n_leased + $3".to_string();
        let mut values = values![pass, segment, n];
        if !from_tail {
            sql.push_str(", owner = $4, owner_until = $5");
            values.extend(values![claimer.worker, now + 2 * ttl_ms]);
        }
        sql.push_str(" WHERE pass_id = $1 AND seg = $2");
        tx.execute(sql.into(), values).await?;
        let sql = "INSERT INTO lease (id, pass_id, seg, worker, session, n, granted_at, expires_at)
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8)";
        let values = values![&lease, pass, segment, claimer.worker, claimer.session, n, now, now + ttl_ms];
        tx.execute(sql.into(), values).await?;
        self.commit("claim", tx).await?;
        if first_of_job {
            self.job_started(&job, now).await?;
        }
        Ok(Taken::Granted(Granted { lease, batches, first_of_job }))
    }
}
