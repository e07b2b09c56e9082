//! stub
use crate::console::{Answer, Console};
use clap::Args;
use engine::Result;
/// demo
#[derive(Debug, Args)]
pub struct Arguments {}
pub fn run(_a: Arguments, _c: &Console) -> Result<Answer> {
    Answer::new(&1, "")
}
