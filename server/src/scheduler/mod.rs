//! What to do next, as pure functions of state, event and time: no database, no clock, no network.
//!
//! [`choose`] picks the segments from which a worker may claim. [`failure`] rules on a batch that came back without a
//! result. [`graph`] says which pass of a job comes next. [`opinion`] says whose result is believed. [`waiting`] says why something waits. [`transition`] is the life
//! of a batch. What these decide takes effect only by conditional statements of [`crate::db`]: a stale view costs an empty
//! claim, never a wrong one.

pub mod choose;
pub mod failure;
pub mod farm;
pub mod graph;
pub mod opinion;
pub mod transition;
pub mod waiting;
