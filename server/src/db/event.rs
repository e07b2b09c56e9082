//! What happened, for dashboards and scripts: transitions of jobs and workers, in the order of their commits.

use protocol::events::Event;

use super::{Store, Tx};
use crate::{Result, values};

/// An event to be.
pub(super) struct NewEvent<'a> {
    pub kind: &'a str,
    pub project: &'a str,
    pub job: Option<&'a str>,
    pub actor: &'a str,
    pub detail: &'a str,
}

impl Store {
    /// Adds an event to a transaction, which waits for others that do: ids rise in the order of commits, so whoever has
    /// read up to an id misses nothing.
    pub(super) async fn record(&self, tx: &mut Tx, now: i64, event: NewEvent<'_>) -> Result<()> {
        if let Some(sql) = self.dialect().serialise_events {
            tx.query(sql.into(), vec![]).await?;
        }
        let sql =
            "INSERT INTO event (at, kind, project, job_id, actor, payload) VALUES ($1, $2, $3, $4, $5, $6)";
        let NewEvent { kind, project, job, actor, detail } = event;
        tx.execute(sql.into(), values![now, kind, project, job, actor, detail]).await?;
        Ok(())
    }

    /// Events after `after`, up to `limit`, of one project where one is given.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn events(&self, after: i64, limit: i64, project: Option<&str>) -> Result<Vec<Event>> {
        let sql = "SELECT id, at, kind, project, job_id, actor, payload FROM event
            WHERE id > $1 AND ($3 = '' OR project = $3) ORDER BY id LIMIT $2";
        let rows = self.query(sql, values![after, limit, project.unwrap_or_default()]).await?;
        let event = |row: &super::Row| {
            Ok(Event {
                id: row.int(0)?,
                at: row.int(1)?,
                kind: row.text(2)?,
                project: row.text(3)?,
                job: row.text_or_null(4)?,
                actor: row.text(5)?,
                detail: row.text(6)?,
            })
        };
        rows.iter().map(event).collect()
    }

    /// The latest event's number, 0 if there is none.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn last_event(&self) -> Result<i64> {
        let row = self.query_one("SELECT COALESCE(MAX(id), 0) FROM event", vec![]).await?;
        row.map_or(Ok(0), |row| row.int(0))
    }
}
