//! The farm's worker: it claims batches of the coordinator, takes the engine's steps for them, and puts the results.
//!
//! [`run`] is the loop: register, claim, execute, spool, complete, with heartbeats beside it. [`execute`] takes a claim's
//! step with the same functions of the engine as `pantaray bake`. [`depot`] is where bytes come from and go to, [`cache`]
//! what is kept of them on the local disk. [`client`] talks to the coordinator, for the worker and for people.

mod api;
pub mod cache;
mod claims;
pub mod client;
mod deliver;
pub mod depot;
pub mod digest;
mod error;
pub mod execute;
mod heartbeat;
pub mod remote;
pub mod run;
pub mod settings;
mod spool;

pub use error::{Error, Result};
