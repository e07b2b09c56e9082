//! From batch results to the output stream: parts, their log in the bake folder, and the merge.

mod buckets;
mod log;
mod merge;
mod part;

pub use log::{PartLog, PartSource, Recovery};
pub use merge::{MergeOptions, MergeReport, merge};
pub use part::{Part, PartFormat, PartHeader};
