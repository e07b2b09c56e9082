//! What the queue needs of a database, and no more: statements with numbered parameters, rows of plain values,
//! transactions. [`super::sqlite`] and [`super::postgres`] are the two implementations; the SQL above them is one.
//!
//! Both understand `$1`, `RETURNING`, `UPDATE … FROM (VALUES …)` (columns `column1`, `column2`, …), recursive queries and
//! partial indexes. What differs is in [`Dialect`].

use std::borrow::Cow;

use async_trait::async_trait;

use crate::{Error, Result};

/// A value of a row, or of a parameter. Nothing has a type, too: PostgreSQL asks for it.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A whole number, or nothing.
    Int(Option<i64>),
    /// Text, or nothing.
    Text(Option<String>),
}

impl From<i64> for Value {
    fn from(value: i64) -> Self {
        Self::Int(Some(value))
    }
}

impl From<Option<i64>> for Value {
    fn from(value: Option<i64>) -> Self {
        Self::Int(value)
    }
}

impl From<bool> for Value {
    fn from(value: bool) -> Self {
        Self::Int(Some(i64::from(value)))
    }
}

impl From<&str> for Value {
    fn from(value: &str) -> Self {
        Self::Text(Some(value.into()))
    }
}

impl From<&String> for Value {
    fn from(value: &String) -> Self {
        Self::Text(Some(value.clone()))
    }
}

impl From<String> for Value {
    fn from(value: String) -> Self {
        Self::Text(Some(value))
    }
}

impl From<Option<String>> for Value {
    fn from(value: Option<String>) -> Self {
        Self::Text(value)
    }
}

impl From<Option<&str>> for Value {
    fn from(value: Option<&str>) -> Self {
        Self::Text(value.map(Into::into))
    }
}

/// Parameters of a statement.
#[macro_export]
macro_rules! values {
    ($($value:expr),* $(,)?) => { vec![$($crate::db::Value::from($value)),*] };
}

/// A row of a result.
#[derive(Clone, Debug)]
pub struct Row(pub Vec<Value>);

impl Row {
    fn wrong(&self, column: usize) -> Error {
        tracing::error!(column, row = ?self.0, "a column of the database has another type");
        Error::new(crate::error::Kind::Internal, "a record cannot be read")
    }

    /// A number or nothing.
    pub fn int_or_null(&self, column: usize) -> Result<Option<i64>> {
        match self.0.get(column) {
            Some(Value::Int(value)) => Ok(*value),
            Some(Value::Text(None)) => Ok(None),
            _ => Err(self.wrong(column)),
        }
    }

    /// A number.
    pub fn int(&self, column: usize) -> Result<i64> {
        self.int_or_null(column)?.ok_or_else(|| self.wrong(column))
    }

    /// A number that says yes or no.
    pub fn flag(&self, column: usize) -> Result<bool> {
        self.int(column).map(|value| value != 0)
    }

    /// Text or nothing.
    pub fn text_or_null(&self, column: usize) -> Result<Option<String>> {
        match self.0.get(column) {
            Some(Value::Text(value)) => Ok(value.clone()),
            Some(Value::Int(None)) => Ok(None),
            _ => Err(self.wrong(column)),
        }
    }

    /// Text.
    pub fn text(&self, column: usize) -> Result<String> {
        self.text_or_null(column)?.ok_or_else(|| self.wrong(column))
    }

    /// A number that stands for a state.
    pub fn word<T>(&self, column: usize, from_code: impl Fn(i64) -> Option<T>) -> Result<T> {
        from_code(self.int(column)?).ok_or_else(|| self.wrong(column))
    }
}

/// Where the two databases differ.
#[derive(Clone, Copy, Debug)]
pub struct Dialect {
    /// Its name.
    pub name: &'static str,
    /// Ends a query of rows that will be changed: they are locked until the transaction ends.
    pub lock: &'static str,
    /// Ends a query of the table `s` likewise; rows that others have locked are left out.
    pub lock_s_skip: &'static str,
    /// Makes the transaction wait until no other writes events, so that their ids rise in the order of commits.
    pub serialise_events: Option<&'static str>,
    /// Makes the transaction wait until no other adds assets or removes some.
    pub serialise_assets: Option<&'static str>,
}

/// SQL: written here, or put together here from such; never from what came over the wire.
pub type Sql = Cow<'static, str>;

/// A database.
#[async_trait]
pub trait Driver: Send + Sync {
    /// Where it differs.
    fn dialect(&self) -> Dialect;

    /// Begins a transaction that will write.
    async fn begin(&self) -> Result<Box<dyn Transaction>>;

    /// A query outside of any transaction.
    async fn query(&self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>>;

    /// Runs a script of several statements.
    async fn script(&self, sql: &'static str) -> Result<()>;

    /// Milliseconds since 1970 by the database's clock; none where it has no clock of its own.
    async fn now_ms(&self) -> Result<Option<i64>>;

    /// Ends all connections.
    async fn close(&self);
}

/// A transaction; dropped without a commit, it changes nothing, but its locks stay for a moment after.
#[async_trait]
pub trait Transaction: Send {
    /// Runs a statement and says how many rows it changed.
    async fn execute(&mut self, sql: Sql, values: Vec<Value>) -> Result<u64>;

    /// Runs a query, or a statement that returns rows.
    async fn query(&mut self, sql: Sql, values: Vec<Value>) -> Result<Vec<Row>>;

    /// Commits. When this returns, the changes outlive the process; with PostgreSQL, the machine as well.
    async fn commit(self: Box<Self>) -> Result<()>;

    /// Changes nothing; when this returns, the locks are gone.
    async fn rollback(self: Box<Self>) -> Result<()>;
}
