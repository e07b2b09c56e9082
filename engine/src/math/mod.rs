//! Boxes, hashing and the few functions whose bits must be the same everywhere.

pub mod bounds;
pub mod hash;
pub mod trig;

pub use bounds::Bounds;
