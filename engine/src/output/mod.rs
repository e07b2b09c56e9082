//! What comes out: from batch results to the output stream, and summaries, comparisons and exports of streams.
//!
//! A batch's result is a [`Part`]; a bake on one machine keeps its parts in a [`PartLog`]; [`merge`](merge()) joins the
//! parts into a copy of the bake set's stream.

mod buckets;
pub mod compare;
pub mod export;
pub mod inspect;
mod log;
mod merge;
mod part;
mod values;

#[cfg(test)]
mod tests;

pub use log::{PartLog, PartSource, Recovery};
pub use merge::{MergeOptions, MergeReport, merge};
pub use part::{Part, PartFormat, PartHeader};
