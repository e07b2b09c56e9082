//! What tracing took: sums of each worker's batches of a pass, kept with the results that they are of.

use std::collections::HashMap;

use protocol::limits::{DEVICE_BYTES_MAX, cut};
use protocol::traced::{PassWork, Traced};

use super::{Row, Store, Tx};
use crate::{Result, values};

/// The sums' columns, in the order of [`Traced`]'s fields.
const SUMS: [&str; 9] = [
    "batches",
    "points",
    "rays",
    "trace_us",
    "brick_requests",
    "brick_misses",
    "read_bytes",
    "device_bytes",
    "device_us",
];

fn sums(row: &Row, first: usize) -> Result<Traced> {
    let mut numbers = [0; SUMS.len()];
    for (at, number) in numbers.iter_mut().enumerate() {
        *number = row.int(first + at)?;
    }
    Ok(Traced::from_array(numbers))
}

fn work(row: &Row) -> Result<PassWork> {
    let (pass, name, worker) = (row.int(0)?, row.text(1)?, row.text(2)?);
    Ok(PassWork { pass, name, worker, device: row.text(3)?, at: row.int(4)?, traced: sums(row, 5)? })
}

impl Store {
    /// Adds what accepted results took to the sums of their pass and worker.
    pub(super) async fn add_traced(
        &self,
        tx: &mut Tx,
        (pass, worker): (i64, &str),
        device: &str,
        traced: Traced,
        now: i64,
    ) -> Result<()> {
        let add: Vec<String> =
            SUMS.iter().enumerate().map(|(at, sum)| format!("{sum} = traced.{sum} + ${}", at + 5)).collect();
        let sql = format!(
            "INSERT INTO traced (pass_id, worker, device, at, {}) VALUES ({})
            ON CONFLICT (pass_id, worker) DO UPDATE SET device = $3, at = $4, {}",
            SUMS.join(", "),
            super::placeholders(1, SUMS.len() + 4),
            add.join(", ")
        );
        let mut values = values![pass, worker, cut(device, DEVICE_BYTES_MAX), now];
        values.extend(traced.to_array().map(super::Value::from));
        tx.execute(sql.into(), values).await?;
        Ok(())
    }

    /// Who traced how much of a job, those that reported last first.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn work(&self, job: &str, limit: i64) -> Result<Vec<PassWork>> {
        let sql = format!(
            "SELECT t.pass_id, p.name, t.worker, t.device, t.at, {} FROM traced t JOIN pass p ON p.id = t.pass_id
            WHERE p.job_id = $1 ORDER BY t.at DESC, t.worker LIMIT $2",
            SUMS.map(|sum| format!("t.{sum}")).join(", ")
        );
        self.query(sql, values![job, limit]).await?.iter().map(work).collect()
    }

    /// What tracing took for each pass of a job that traced.
    pub(super) async fn traced_of(&self, job: &str) -> Result<HashMap<i64, Traced>> {
        let sql = format!(
            "SELECT t.pass_id, {} FROM traced t JOIN pass p ON p.id = t.pass_id WHERE p.job_id = $1 GROUP BY t.pass_id",
            SUMS.map(|sum| format!("CAST(SUM(t.{sum}) AS BIGINT)")).join(", ")
        );
        let rows = self.query(sql, values![job]).await?;
        rows.iter().map(|row| Ok((row.int(0)?, sums(row, 1)?))).collect()
    }

    /// For each worker that traced, what its batches of the pass took of which it reported last.
    pub(super) async fn latest_traced(&self) -> Result<HashMap<String, PassWork>> {
        let sql = format!(
            "SELECT t.pass_id, p.name, t.worker, t.device, t.at, {} FROM worker w
            JOIN traced t ON t.worker = w.name AND t.at = (SELECT MAX(at) FROM traced WHERE worker = w.name)
            JOIN pass p ON p.id = t.pass_id ORDER BY t.pass_id LIMIT 20000",
            SUMS.map(|sum| format!("t.{sum}")).join(", ")
        );
        let rows = self.query(sql, vec![]).await?;
        rows.iter().map(work).map(|work| work.map(|work| (work.worker.clone(), work))).collect()
    }
}
