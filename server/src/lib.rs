//! The coordinator's queue: what is true about jobs, passes, batches and leases, and what comes next. HTTP comes later.
//!
//! [`db`] holds what is true, [`scheduler`] decides what comes next. Reading order: `migrations/sqlite/0001_queue.sql`,
//! [`scheduler`], [`db::claim`], [`db::complete`], [`db::graph`].

pub mod clock;
pub mod db;
pub mod error;
pub mod faults;
pub mod random;
pub mod scheduler;

pub use error::{Error, Result};
