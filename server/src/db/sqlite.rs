//! The queue in one file: SQLite, one connection that writes, several that read.
//!
//! Write-ahead log with `synchronous = NORMAL`: a crash of the process loses nothing, a power cut may take the last
//! commits, and neither damages the file.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

use async_trait::async_trait;
use sqlx::sqlite::{
    SqliteArguments, SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteRow,
    SqliteSynchronous,
};
use sqlx::{AssertSqlSafe, Row as _, Sqlite, TypeInfo, ValueRef};

use super::driver::{Dialect, Driver, Row, Sql, Transaction, Value};
use crate::error::Kind;
use crate::{Error, Result};

const READERS: u32 = 4;

/// A SQLite file.
pub struct SqliteDriver {
    writer: SqlitePool,
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
        let writer = SqlitePoolOptions::new().max_connections(1).acquire_timeout(Duration::from_secs(30));
        let writer = writer.connect_with(options.clone()).await?;
        let readers =
            SqlitePoolOptions::new().max_connections(READERS).acquire_timeout(Duration::from_secs(30));
        let readers = readers.connect_with(options.read_only(true)).await?;
        Ok(Self { writer, readers, _lock: lock })
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
        Ok(Box::new(SqliteTransaction(self.writer.begin_with("BEGIN IMMEDIATE").await?)))
    }

    async fn query(&self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>> {
        let query = sqlx::query_with::<Sqlite, _>(AssertSqlSafe(sql), arguments(values)?);
        query.fetch_all(&self.readers).await?.iter().map(row).collect()
    }

    async fn script(&self, sql: &'static str) -> Result<()> {
        sqlx::raw_sql(sql).execute(&self.writer).await?;
        Ok(())
    }

    async fn now_ms(&self) -> Result<Option<i64>> {
        Ok(None)
    }

    async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }
}

struct SqliteTransaction(sqlx::Transaction<'static, Sqlite>);

#[async_trait]
impl Transaction for SqliteTransaction {
    async fn execute(&mut self, sql: Sql, values: Vec<Value>) -> Result<u64> {
        let query = sqlx::query_with::<Sqlite, _>(AssertSqlSafe(sql), arguments(values)?);
        Ok(query.execute(&mut *self.0).await?.rows_affected())
    }

    async fn query(&mut self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>> {
        let query = sqlx::query_with::<Sqlite, _>(AssertSqlSafe(sql), arguments(values)?);
        query.fetch_all(&mut *self.0).await?.iter().map(row).collect()
    }

    async fn commit(self: Box<Self>) -> Result<()> {
        Ok(self.0.commit().await?)
    }

    async fn rollback(self: Box<Self>) -> Result<()> {
        Ok(self.0.rollback().await?)
    }
}
