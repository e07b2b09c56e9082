//! The cut: which bricks a batch needs, and the memory that holds them (paper, section 4.4).
//!
//! [`select`] walks the brick map from its root and opens what the batch sees at a finer angle than its rays can
//! tell apart; [`arena`] is the one allocation that bricks are loaded into. The cut depends on the batch alone, never on
//! what the arena happens to hold.

pub mod arena;
pub mod select;

pub use arena::Arena;
pub use select::{Cut, Lod};
