//! `pantaray cancel`, `pause`, `resume`, `retry`, `reprioritise` and `resubmit`: jobs are changed.

use clap::Args;
use engine::Result;
use protocol::job::{BakeSettings, BatchSelection, JobPatch, ResubmitRequest};

use super::{Connection, random_key};
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

/// Change a job's priority, comment or limit
#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("change").required(true).multiple(true))]
pub struct ReprioritiseArguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
    /// From 0 to 100: twice the priority, twice the chance
    #[arg(long, value_name = "N", group = "change", value_parser = clap::value_parser!(i64).range(0..=100))]
    priority: Option<i64>,
    /// Batches to run at once at most
    #[arg(long, value_name = "N", group = "change", value_parser = clap::value_parser!(i64).range(1..))]
    running_max: Option<i64>,
    /// For people
    #[arg(long, group = "change")]
    comment: Option<String>,
}

/// Submit a job again, with edits; what is not named stays
#[derive(Debug, Args)]
pub struct ResubmitArguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
    /// What to call the new job
    #[arg(long)]
    name: Option<String>,
    /// From 0 to 100
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..=100))]
    priority: Option<i64>,
    /// For people
    #[arg(long)]
    comment: Option<String>,
    /// How to bake, all of it, as JSON: `{"samples": 256, "seed": 1}`
    #[arg(long, value_name = "JSON", value_parser = settings)]
    settings: Option<BakeSettings>,
    /// A key by which the coordinator knows a repeated submission [default: a random one]
    #[arg(long)]
    key: Option<String>,
}

fn settings(text: &str) -> Result<BakeSettings, String> {
    serde_json::from_str(text).map_err(|error| error.to_string())
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

/// Changes what a job is about to get.
pub fn run_reprioritise(arguments: ReprioritiseArguments) -> Result<Answer> {
    let ReprioritiseArguments { job, connection, priority, running_max, comment } = arguments;
    let job = connection.client()?.change_job(&job, &JobPatch { priority, comment, running_max })?;
    Answer::new(&job, format!("{} has priority {}", job.id, job.priority))
}

/// Submits a job again.
pub fn run_resubmit(arguments: ResubmitArguments) -> Result<Answer> {
    let ResubmitArguments { job, connection, name, priority, comment, settings, key } = arguments;
    let edits = ResubmitRequest { name, settings, priority, comment };
    let key = key.unwrap_or_else(random_key);
    let submitted = connection.client()?.resubmit(&job, &edits, &key)?;
    Answer::new(&submitted, submitted.jobs.join("\n"))
}
