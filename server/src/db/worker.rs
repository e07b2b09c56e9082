//! Workers: who they are, when they were last heard of, and what keeps them from work.

use protocol::work::RegisterRequest;

use super::{Row, Store};
use crate::error::Kind;
use crate::scheduler::farm::WORKER_LOST_MS;
use crate::{Error, Result, values};

/// A worker's process, as a request names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Session {
    /// The worker.
    pub worker: String,
    /// The token that registered it; none without tokens.
    pub token: Option<String>,
    /// Memory that it may use.
    pub memory_bytes: i64,
    /// Whether it should finish what it has and claim nothing more.
    pub draining: bool,
}

/// A session's columns.
const SESSION: &str = "name, token_id, memory_bytes, draining";

fn session(row: &Row) -> Result<Session> {
    Ok(Session {
        worker: row.text(0)?,
        token: row.text_or_null(1)?,
        memory_bytes: row.int(2)?,
        draining: row.flag(3)?,
    })
}

/// What an administrator does to a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WorkerAction {
    /// Keep it from work until it is unlocked.
    Lock,
    /// Let it work again, from sickness and draining, too.
    Unlock,
    /// Let it finish what it has.
    Drain,
}

impl Store {
    /// Makes a process the one of its worker's name.
    ///
    /// # Errors
    /// [`Kind::Conflict`] when a live process of another token has the name.
    pub async fn register(
        &self,
        request: &RegisterRequest,
        labels: &[String],
        token: Option<&str>,
        session: &str,
        now: i64,
    ) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = format!("SELECT token_id, last_seen FROM worker WHERE name = $1{}", self.dialect().lock);
        let rows = tx.query(sql.into(), values![&request.name]).await?;
        if let Some(row) = rows.first() {
            let other = row.text_or_null(0)?.as_deref() != token;
            if other && now - row.int(1)? < WORKER_LOST_MS {
                let message = format!("a live worker of another token is called `{}`", request.name);
                return Err(Error::new(Kind::Conflict, message).hint("give the worker another name"));
            }
        }
        let sql = "INSERT INTO worker (name, session, token_id, labels, memory_bytes, version, last_seen)
            VALUES ($1, $2, $3, $4, $5, $6, $7)
            ON CONFLICT (name) DO UPDATE SET session = $2, token_id = $3, labels = $4, memory_bytes = $5, version = $6,
                draining = 0, last_seen = $7";
        let memory = i64::try_from(request.memory_bytes).unwrap_or(i64::MAX);
        let labels = serde_json::to_string(labels)?;
        let token = token.map(str::to_owned);
        let values = values![&request.name, session, token, labels, memory, &request.version, now];
        tx.execute(sql.into(), values).await?;
        self.commit("register", tx).await
    }

    /// The process of a session.
    ///
    /// # Errors
    /// [`Kind::Gone`] when it is over: the worker must register again and drop what it has.
    pub async fn session(&self, session: &str) -> Result<Session> {
        let sql = format!("SELECT {SESSION} FROM worker WHERE session = $1");
        let row = self.query_one(sql, values![session]).await?;
        let row = row.ok_or_else(|| Error::new(Kind::Gone, "the session is over").hint("register again"))?;
        self::session(&row)
    }

    /// Notes that workers were heard of; the processes that have their names now.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn seen(&self, workers: &[String], now: i64) -> Result<Vec<(String, Session)>> {
        let mut sessions = Vec::with_capacity(workers.len());
        for workers in workers.chunks(500) {
            let mut tx = self.begin().await?;
            let list = super::placeholders(2, workers.len());
            let sql = format!(
                "UPDATE worker SET last_seen = $1 WHERE name IN ({list}) RETURNING {SESSION}, session"
            );
            let mut values = values![now];
            values.extend(workers.iter().map(Into::into));
            for row in tx.query(sql.into(), values).await? {
                sessions.push((row.text(4)?, session(&row)?));
            }
            self.commit("seen", tx).await?;
        }
        Ok(sessions)
    }

    /// Does something to a worker.
    ///
    /// # Errors
    /// [`Kind::NotFound`].
    pub async fn act_on_worker(&self, name: &str, action: WorkerAction) -> Result<()> {
        let sql = match action {
            WorkerAction::Lock => "UPDATE worker SET locked = 1 WHERE name = $1",
            WorkerAction::Unlock => {
                "UPDATE worker SET locked = 0, reason = '', draining = 0, sick_until = 0 WHERE name = $1"
            }
            WorkerAction::Drain => "UPDATE worker SET draining = 1 WHERE name = $1",
        };
        let mut tx = self.begin().await?;
        if tx.execute(sql.into(), values![name]).await? == 0 {
            return Err(Error::not_found("worker", name));
        }
        if action == WorkerAction::Unlock {
            tx.execute("DELETE FROM worker_block WHERE worker = $1".into(), values![name]).await?;
        }
        self.commit("worker", tx).await
    }
}
