//! The queue in PostgreSQL, for farms: several coordinators may share it, and any of them may die.

use std::str::FromStr;
use std::time::Duration;

use async_trait::async_trait;
use sqlx::postgres::{PgArguments, PgConnectOptions, PgPool, PgPoolOptions, PgRow};
use sqlx::{AssertSqlSafe, Column, Connection, Postgres, Row as _, TypeInfo};

use super::driver::{Dialect, Driver, Row, Sql, Transaction, Value};
use crate::Result;

/// A connection that has rested for so long is asked whether it is still there before it is used.
const RESTED: Duration = Duration::from_secs(1);

/// A PostgreSQL database.
pub struct PostgresDriver {
    pool: PgPool,
}

impl PostgresDriver {
    /// Connects with up to `connections` connections.
    ///
    /// # Errors
    /// When the URL is wrong or the server cannot be reached.
    pub async fn connect(url: &str, connections: u32) -> Result<Self> {
        let options = PgConnectOptions::from_str(url)?
            .application_name("pantaray")
            .options([("idle_in_transaction_session_timeout", "30s"), ("statement_timeout", "60s")])
            .statement_cache_capacity(256);
        // One that was used a moment ago is not asked whether it is still there
        let pool = PgPoolOptions::new()
            .max_connections(connections)
            .acquire_timeout(Duration::from_secs(10))
            .test_before_acquire(false)
            .before_acquire(|connection, known| {
                Box::pin(async move {
                    if known.idle_for >= RESTED {
                        connection.ping().await?;
                    }
                    Ok(true)
                })
            });
        Ok(Self { pool: pool.connect_with(options).await? })
    }
}

fn arguments(values: Vec<Value>) -> Result<PgArguments> {
    use sqlx::Arguments;
    let mut arguments = PgArguments::default();
    for value in values {
        let added = match value {
            Value::Int(value) => arguments.add(value),
            Value::Text(value) => arguments.add(value),
        };
        added.map_err(sqlx::Error::Encode)?;
    }
    Ok(arguments)
}

fn row(row: &PgRow) -> Result<Row> {
    let value = |column: usize| -> Result<Value> {
        Ok(match row.columns()[column].type_info().name() {
            "TEXT" => Value::Text(row.try_get(column)?),
            "INT4" => Value::Int(row.try_get::<Option<i32>, _>(column)?.map(Into::into)),
            _ => Value::Int(row.try_get(column)?),
        })
    };
    (0..row.len()).map(value).collect::<Result<_>>().map(Row)
}

#[async_trait]
impl Driver for PostgresDriver {
    fn dialect(&self) -> Dialect {
        Dialect {
            name: "postgres",
            lock: " FOR UPDATE",
            lock_s_skip: " FOR UPDATE OF s SKIP LOCKED",
            serialise_events: Some("SELECT CAST(COUNT(pg_advisory_xact_lock(1886544240)) AS BIGINT)"),
            serialise_assets: Some("SELECT CAST(COUNT(pg_advisory_xact_lock(1886544241)) AS BIGINT)"),
        }
    }

    async fn begin(&self) -> Result<Box<dyn Transaction>> {
        Ok(Box::new(PostgresTransaction(self.pool.begin().await?)))
    }

    async fn query(&self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>> {
        let query = sqlx::query_with::<Postgres, _>(AssertSqlSafe(sql), arguments(values)?);
        query.fetch_all(&self.pool).await?.iter().map(row).collect()
    }

    async fn script(&self, sql: &'static str) -> Result<()> {
        sqlx::raw_sql(sql).execute(&self.pool).await?;
        Ok(())
    }

    async fn now_ms(&self) -> Result<Option<i64>> {
        let sql = "SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT)";
        let rows = self.query(sql.into(), vec![]).await?;
        rows.first().map(|row| row.int(0)).transpose()
    }

    async fn close(&self) {
        self.pool.close().await;
    }
}

struct PostgresTransaction(sqlx::Transaction<'static, Postgres>);

#[async_trait]
impl Transaction for PostgresTransaction {
    async fn execute(&mut self, sql: Sql, values: Vec<Value>) -> Result<u64> {
        let query = sqlx::query_with::<Postgres, _>(AssertSqlSafe(sql), arguments(values)?);
        Ok(query.execute(&mut *self.0).await?.rows_affected())
    }

    async fn query(&mut self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>> {
        let query = sqlx::query_with::<Postgres, _>(AssertSqlSafe(sql), arguments(values)?);
        query.fetch_all(&mut *self.0).await?.iter().map(row).collect()
    }

    async fn commit(self: Box<Self>) -> Result<()> {
        Ok(self.0.commit().await?)
    }

    async fn rollback(self: Box<Self>) -> Result<()> {
        Ok(self.0.rollback().await?)
    }
}
