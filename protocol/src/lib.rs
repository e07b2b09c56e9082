//! The words that coordinator, workers and command line share: states, requests, answers, keys, limits. No input or
//! output, no clock.
//!
//! A *job* is what a person submitted; a *pass* is a step of it; a *batch* is a pass's unit of work; a *segment* is a
//! contiguous range of batches along the Hilbert curve. A *lease* is a worker's claim of some batches of one segment. A
//! *fence* is a number per batch that rises at every claim: results under an older fence are refused.

pub mod admin;
pub mod events;
pub mod gc;
pub mod job;
pub mod keys;
pub mod limits;
pub mod overview;
pub mod problem;
pub mod states;
pub mod storage;
pub mod traced;
pub mod work;

pub use problem::Problem;
pub use states::{BatchState, FailureClass, JobState, PassKind, PassState, Role, WaitReason};
