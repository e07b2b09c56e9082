//! The coordinator: submissions, queue, leases and bytes over HTTP.
//!
//! [`db`] holds what is true, [`scheduler`] decides what comes next, [`coordinator`] ties them to [`storage`] and runs the
//! loops, [`http`] is the way in: its router shows every operation. [`dashboard`] carries the pages for people. Reading order: `migrations/sqlite/0001_queue.sql`,
//! [`scheduler`], [`db::claim`], [`db::complete`], [`db::graph`], [`coordinator`], [`http`].

pub mod clock;
pub mod config;
pub mod coordinator;
pub mod dashboard;
pub mod db;
pub mod error;
pub mod faults;
pub mod http;
pub mod random;
pub mod scheduler;
pub mod storage;

pub use error::{Error, Result};
