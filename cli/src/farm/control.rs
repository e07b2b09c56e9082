//! `pantaray cancel`, `pause`, `resume` and `retry`: jobs are changed.

use clap::Args;
use engine::Result;
use protocol::job::BatchSelection;

use super::Connection;
use crate::console::{Answer, Console};

/// A job to change.
#[derive(Debug, Args)]
pub struct JobArguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
}

/// Try the failed batches of a job again, or those that are named
#[derive(Debug, Args)]
pub struct RetryArguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
    /// Batches of this pass only
    #[arg(long, value_name = "ID")]
    pass: Option<i64>,
    /// This batch of the pass
    #[arg(long, value_name = "N", requires = "pass")]
    batch: Vec<i64>,
    /// Do without them instead
    #[arg(long)]
    skip: bool,
}

/// Cancels, pauses or resumes, as `action` says.
pub fn run(arguments: JobArguments, action: &str, _console: &Console) -> Result<Answer> {
    let job = arguments.connection.client()?.act(&arguments.job, action)?;
    let paused = if job.paused { ", paused" } else { "" };
    Answer::new(&job, format!("{} is {}{paused}", job.id, job.state))
}

/// Tries batches again, or does without them.
pub fn run_retry(arguments: RetryArguments, _console: &Console) -> Result<Answer> {
    let RetryArguments { job, connection, pass, batch: batches, skip } = arguments;
    let action = if skip { "skip" } else { "retry" };
    let changed = connection.client()?.change_batches(&job, action, &BatchSelection { pass, batches })?;
    let what = if skip { "skipped" } else { "to be tried again" };
    Answer::new(&changed, format!("{} batches {what}", changed.batches))
}
