//! The queue in a database: what is true about jobs, passes, batches and leases. Each operation is one transaction of
//! conditional statements: a state changes only from the state that the operation expects.
//!
//! Locks are taken in the order job → lease → batch → segment, so that no two operations wait for each other. Commits are
//! the only points at which anything becomes true; [`Store::commit`] names them, and the fault tests kill there.

pub mod access;
pub mod asset;
pub mod claim;
pub mod complete;
pub mod control;
pub mod driver;
pub mod event;
pub mod farm;
pub mod garbage;
pub mod graph;
pub mod job;
pub mod lease;
pub mod list;
mod migrate;
pub mod opinion;
#[cfg(test)]
mod plans;
pub mod postgres;
pub mod retention;
pub mod sqlite;
pub mod traced;
pub mod truth;
pub mod view;
pub mod worker;

use std::path::Path;
use std::sync::Arc;

pub use driver::{Dialect, Driver, Row, Sql, Transaction, Value};

use crate::error::Kind;
use crate::{Error, Result};

/// The queue.
#[derive(Clone)]
pub struct Store {
    driver: Arc<dyn Driver>,
}

/// A transaction of the queue.
pub type Tx = Box<dyn Transaction>;

impl Store {
    /// The schema's version that this program wants.
    pub const SCHEMA_VERSION: i64 = migrate::LATEST;

    /// Opens the database at `url`: `sqlite:PATH` or `postgres://…`, of up to `connections` connections.
    ///
    /// # Errors
    /// When the URL is wrong, or the database cannot be reached.
    pub async fn open(url: &str, connections: u32) -> Result<Self> {
        let driver: Arc<dyn Driver> = match url.split_once(':') {
            Some(("sqlite", path)) => {
                Arc::new(sqlite::SqliteDriver::open(Path::new(path.trim_start_matches("//"))).await?)
            }
            Some(("postgres" | "postgresql", _)) => {
                Arc::new(postgres::PostgresDriver::connect(url, connections).await?)
            }
            _ => {
                let error = Error::invalid(format!("`{url}` is not the URL of a database"));
                return Err(error.hint("give `sqlite:PATH` or `postgres://USER@HOST/NAME`"));
            }
        };
        Ok(Self { driver })
    }

    /// Brings the schema up to this version; refuses one that is newer.
    ///
    /// # Errors
    /// When the schema is newer, or the database refuses.
    pub async fn migrate(&self) -> Result<()> {
        migrate::run(self).await
    }

    /// The schema's version in the database; none where there is no schema yet.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn schema_version(&self) -> Result<Option<i64>> {
        migrate::version(self).await
    }

    /// Where the database differs from others.
    pub fn dialect(&self) -> Dialect {
        self.driver.dialect()
    }

    /// The database.
    pub fn driver(&self) -> &dyn Driver {
        &*self.driver
    }

    async fn begin(&self) -> Result<Tx> {
        metrics::counter!("pantaray_db_operations_total", "kind" => "transaction").increment(1);
        self.driver.begin().await
    }

    /// Commits the operation called `name`.
    async fn commit(&self, name: &'static str, transaction: Tx) -> Result<()> {
        crate::faults::point(name, "before");
        transaction.commit().await?;
        crate::faults::point(name, "after");
        Ok(())
    }

    async fn query(&self, sql: impl Into<Sql> + Send, values: Vec<Value>) -> Result<Vec<Row>> {
        metrics::counter!("pantaray_db_operations_total", "kind" => "query").increment(1);
        self.driver.query(sql.into(), values).await
    }

    async fn query_one(&self, sql: impl Into<Sql> + Send, values: Vec<Value>) -> Result<Option<Row>> {
        Ok(self.query(sql, values).await?.into_iter().next())
    }

    /// Whether a transaction can write: what `/readyz` asks.
    ///
    /// # Errors
    /// When it cannot.
    pub async fn probe(&self) -> Result<()> {
        let mut tx = self.begin().await?;
        tx.execute("UPDATE schema_meta SET version = version".into(), vec![]).await?;
        tx.commit().await
    }
}

/// A word for the values of an `IN` list or the rows of `VALUES`: `$first, $first+1, …`.
fn placeholders(first: usize, count: usize) -> String {
    (first..first + count).map(|number| format!("${number}")).collect::<Vec<_>>().join(", ")
}

/// The first row of a result that must have one.
fn one(rows: Vec<Row>) -> Result<Row> {
    rows.into_iter().next().ok_or_else(|| Error::new(Kind::Internal, "the database returned no row"))
}
