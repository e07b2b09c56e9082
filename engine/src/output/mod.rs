//! What comes out: summaries, comparisons and exports of streams.

pub mod compare;
pub mod export;
pub mod inspect;
mod values;

#[cfg(test)]
mod tests;
