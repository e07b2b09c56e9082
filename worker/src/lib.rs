//! The farm's worker: it claims batches of the coordinator, takes the engine's steps for them, and puts the results.
//!
//! [`execute`] takes a claim's step with the same functions of the engine as `pantaray bake`. [`depot`] is where bytes
//! come from and go to, [`cache`] what is kept of them on the local disk. [`client`] talks to the coordinator, for the
//! worker and for people.

pub mod cache;
pub mod client;
pub mod depot;
pub mod digest;
mod error;
pub mod execute;
pub mod settings;

pub use error::{Error, Result};
