//! The queue in one file: SQLite, one connection that writes, several that read.
//!
//! Write-ahead log with `synchronous = NORMAL`: a crash of the process loses nothing, a power cut may take the last
//! commits, and neither damages the file.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use sqlx::sqlite::{
    SqliteArguments, SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool,
    SqlitePoolOptions, SqliteRow, SqliteSynchronous,
};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Row as _, Sqlite, TypeInfo, ValueRef};
use tokio::sync::{Mutex, OwnedMutexGuard};

use super::driver::{Dialect, Driver, Row, Sql, Transaction, Value};
use crate::error::Kind;
use crate::{Error, Result};

const READERS: u32 = 4;
/// How long a transaction waits for its turn, and a query for a connection.
const TURN: Duration = Duration::from_secs(30);

/// A SQLite file.
pub struct SqliteDriver {
    writer: Arc<Mutex<Writer>>,
    readers: SqlitePool,
    /// Forbids a second coordinator on the same file.
    _lock: File,
}

impl SqliteDriver {
    /// Opens or makes the file at `path`.
    ///
    /// # Errors
    /// [`Kind::Conflict`] when another coordinator has it.
    pub async fn open(path: &Path) -> Result<Self> {
        let lock_path = path.with_extension("lock");
        let lock = File::options().create(true).truncate(false).write(true).open(&lock_path)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(Error::new(
                    Kind::Conflict,
                    format!("another coordinator uses `{}`", path.display()),
                )
                .hint("several coordinators share a PostgreSQL database, not a SQLite file"));
            }
            Err(TryLockError::Error(error)) => return Err(error.into()),
        }
        let options = SqliteConnectOptions::from_str("sqlite:")?
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Normal)
            .foreign_keys(true)
            .busy_timeout(Duration::from_secs(5))
            .pragma("wal_autocheckpoint", "4000")
            .pragma("journal_size_limit", "268435456")
            .statement_cache_capacity(256);
        let writer = Writer { connection: Some(options.connect().await?), is_open: false };
        // A file's connections do not break: nobody needs to ask them
        let readers = SqlitePoolOptions::new().max_connections(READERS).acquire_timeout(TURN);
        let readers = readers.test_before_acquire(false).connect_with(options.read_only(true)).await?;
        Ok(Self { writer: Arc::new(Mutex::new(writer)), readers, _lock: lock })
    }

    /// The connection that writes, when it is our turn.
    async fn turn(&self) -> Result<OwnedMutexGuard<Writer>> {
        let turn = tokio::time::timeout(TURN, self.writer.clone().lock_owned()).await;
        Ok(turn.map_err(|_| sqlx::Error::PoolTimedOut)?)
    }
}

/// The one connection that writes. A pool would ask before and after each transaction whether it is still there.
struct Writer {
    /// None when all is over.
    connection: Option<SqliteConnection>,
    /// Whether a transaction was begun and has not ended, as far as we have heard.
    is_open: bool,
}

impl Writer {
    fn connection(&mut self) -> Result<&mut SqliteConnection> {
        Ok(self.connection.as_mut().ok_or(sqlx::Error::PoolClosed)?)
    }

    /// Begins a transaction, after whatever was left open by somebody who has gone.
    async fn begin(&mut self) -> Result<()> {
        if self.is_open {
            let ended = self.end("ROLLBACK").await;
            ended.unwrap_or_else(|error| tracing::debug!(%error, "nothing was left open"));
        }
        self.is_open = true;
        sqlx::query("BEGIN IMMEDIATE").execute(self.connection()?).await?;
        Ok(())
    }

    async fn end(&mut self, how: &'static str) -> Result<()> {
        sqlx::query(how).execute(self.connection()?).await?;
        self.is_open = false;
        Ok(())
    }
}

fn arguments(values: Vec<Value>) -> Result<SqliteArguments> {
    use sqlx::Arguments;
    let mut arguments = SqliteArguments::default();
    for value in values {
        let added = match value {
            Value::Int(value) => arguments.add(value),
            Value::Text(value) => arguments.add(value),
        };
        added.map_err(sqlx::Error::Encode)?;
    }
    Ok(arguments)
}

fn row(row: &SqliteRow) -> Result<Row> {
    let value = |column: usize| -> Result<Value> {
        let raw = row.try_get_raw(column)?;
        Ok(match raw.type_info().name() {
            "TEXT" => Value::Text(row.try_get_unchecked(column)?),
            _ if raw.is_null() => Value::Int(None),
            _ => Value::Int(row.try_get_unchecked(column)?),
        })
    };
    (0..row.len()).map(value).collect::<Result<_>>().map(Row)
}

#[async_trait]
impl Driver for SqliteDriver {
    fn dialect(&self) -> Dialect {
        // A transaction that writes has the file to itself
        Dialect { name: "sqlite", lock: "", lock_s_skip: "", serialise_events: None, serialise_assets: None }
    }

    async fn begin(&self) -> Result<Box<dyn Transaction>> {
        let mut writer = self.turn().await?;
        writer.begin().await?;
        Ok(Box::new(SqliteTransaction(writer)))
    }

    async fn query(&self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>> {
        let query = sqlx::query_with::<Sqlite, _>(AssertSqlSafe(sql), arguments(values)?);
        query.fetch_all(&self.readers).await?.iter().map(row).collect()
    }

    async fn script(&self, sql: &'static str) -> Result<()> {
        sqlx::raw_sql(sql).execute(self.turn().await?.connection()?).await?;
        Ok(())
    }

    async fn now_ms(&self) -> Result<Option<i64>> {
        Ok(None)
    }

    async fn close(&self) {
        self.readers.close().await;
        if let Some(connection) = self.writer.lock().await.connection.take()
            && let Err(error) = connection.close().await
        {
            tracing::warn!(%error, "the database was not closed properly");
        }
    }
}

/// What the connection that writes does for somebody; undone, when dropped, before anything else is begun.
struct SqliteTransaction(OwnedMutexGuard<Writer>);

#[async_trait]
impl Transaction for SqliteTransaction {
    async fn execute(&mut self, sql: Sql, values: Vec<Value>) -> Result<u64> {
        let query = sqlx::query_with::<Sqlite, _>(AssertSqlSafe(sql), arguments(values)?);
        Ok(query.execute(self.0.connection()?).await?.rows_affected())
    }

    async fn query(&mut self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>> {
        let query = sqlx::query_with::<Sqlite, _>(AssertSqlSafe(sql), arguments(values)?);
        query.fetch_all(self.0.connection()?).await?.iter().map(row).collect()
    }

    async fn commit(mut self: Box<Self>) -> Result<()> {
        self.0.end("COMMIT").await
    }

    async fn rollback(mut self: Box<Self>) -> Result<()> {
        self.0.end("ROLLBACK").await
    }
}
