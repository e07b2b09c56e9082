//! The Pantaray bake engine.
//!
//! Read the modules in the order of the path of the data:
//! [`scene`] → [`import`] → [`dice`] → [`stream`] → [`brick`], [`brickmap`] → [`batch`] → [`cut`] → [`trace`] →
//! [`shade`] → [`output`] → [`relight`] → [`preview`]. [`bake`] is the only file that names them all.
//!
//! The engine knows no network, no async runtime and no database.

pub mod bake;
pub mod batch;
pub mod brick;
pub mod brickmap;
pub mod cut;
pub mod dice;
pub mod error;
pub mod import;
pub mod math;
pub mod output;
pub mod preview;
pub mod relight;
pub mod scene;
pub mod shade;
pub mod stats;
pub mod stream;
pub mod trace;

pub use error::{Error, ErrorKind, Result};
