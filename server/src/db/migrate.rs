//! The schema's versions, embedded in the program: one script each, for each database.

use super::Store;
use crate::error::Kind;
use crate::{Error, Result, values};

/// For each version, from 1: SQLite's script and PostgreSQL's.
const MIGRATIONS: [(&str, &str); 6] = [
    (
        include_str!("../../../migrations/sqlite/0001_queue.sql"),
        include_str!("../../../migrations/postgres/0001_queue.sql"),
    ),
    (
        include_str!("../../../migrations/sqlite/0002_session.sql"),
        include_str!("../../../migrations/postgres/0002_session.sql"),
    ),
    (
        include_str!("../../../migrations/sqlite/0003_work.sql"),
        include_str!("../../../migrations/postgres/0003_work.sql"),
    ),
    (
        include_str!("../../../migrations/sqlite/0004_retention.sql"),
        include_str!("../../../migrations/postgres/0004_retention.sql"),
    ),
    (
        include_str!("../../../migrations/sqlite/0005_trust.sql"),
        include_str!("../../../migrations/postgres/0005_trust.sql"),
    ),
    (
        include_str!("../../../migrations/sqlite/0006_traced.sql"),
        include_str!("../../../migrations/postgres/0006_traced.sql"),
    ),
];

/// The version that this program wants.
pub(super) const LATEST: i64 = MIGRATIONS.len() as i64;

/// The version that the database has; none where it has no schema.
pub(super) async fn version(store: &Store) -> Result<Option<i64>> {
    let is_there = match store.dialect().name {
        "postgres" => "SELECT 1 WHERE to_regclass('schema_meta') IS NOT NULL",
        _ => "SELECT 1 FROM sqlite_master WHERE name = 'schema_meta'",
    };
    if store.query_one(is_there, vec![]).await?.is_none() {
        return Ok(None);
    }
    let row = store.query_one("SELECT version FROM schema_meta", vec![]).await?;
    row.map(|row| row.int(0)).transpose()
}

/// Takes the steps that are missing, each in one transaction.
pub(super) async fn run(store: &Store) -> Result<()> {
    store.driver().script("CREATE TABLE IF NOT EXISTS schema_meta (version BIGINT NOT NULL)").await?;
    let postgres = store.dialect().name == "postgres";
    for (number, (for_sqlite, for_postgres)) in MIGRATIONS.into_iter().enumerate() {
        let mut tx = store.begin().await?;
        if postgres {
            // Two coordinators may start at once
            tx.execute("LOCK TABLE schema_meta IN EXCLUSIVE MODE".into(), vec![]).await?;
        }
        let found = tx.query("SELECT version FROM schema_meta".into(), vec![]).await?;
        let found = found.first().map(|row| row.int(0)).transpose()?;
        if found.unwrap_or(0) > LATEST {
            let message =
                format!("the database has schema version `{}`, `{LATEST}` wanted", found.unwrap_or(0));
            return Err(Error::new(Kind::Conflict, message).hint("use the newer program"));
        }
        let version = number as i64 + 1;
        if found.unwrap_or(0) >= version {
            continue;
        }
        let script = if postgres { for_postgres } else { for_sqlite };
        for statement in statements(script) {
            tx.execute(statement.into(), vec![]).await?;
        }
        let sql = match found {
            None => "INSERT INTO schema_meta (version) VALUES ($1)",
            Some(_) => "UPDATE schema_meta SET version = $1",
        };
        tx.execute(sql.into(), values![version]).await?;
        tx.commit().await?;
    }
    Ok(())
}

/// The statements of a script. Our scripts have no semicolon but at the end of a statement, and comments on lines of
/// their own.
fn statements(script: &'static str) -> Vec<String> {
    let lines = script.lines().filter(|line| !line.trim_start().starts_with("--"));
    let text = lines.collect::<Vec<_>>().join("\n");
    text.split(';').map(str::trim).filter(|s| !s.is_empty()).map(str::to_owned).collect()
}
