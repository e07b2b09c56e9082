//! `pantaray watch`: how far a job is, until it ends.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::Args;
use engine::{Error, ErrorKind, Result};
use protocol::job::JobDetail;
use protocol::{JobState, PassState, WaitReason};
use worker::client::Client;

use super::{Connection, left};
use crate::console::{Answer, Console};
use crate::{figures, signals};

/// How often the coordinator is asked.
const INTERVAL: Duration = Duration::from_millis(500);

/// Show how far a job is until it ends; exit code 1 if it fails
#[derive(Debug, Args)]
pub struct Arguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
}

/// Waits for the job's end.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    let job = until_done(&client, &arguments.job, console, signals::cancel_flag(), || left(&arguments.job))?;
    judge(&[job])
}

/// Shows a job's progress until it ends.
///
/// # Errors
/// `stopped` once `stop` is set, and what the coordinator says.
pub fn until_done(
    client: &Client,
    id: &str,
    console: &Console,
    stop: &AtomicBool,
    stopped: impl Fn() -> Error,
) -> Result<JobDetail> {
    let progress = console.control().progress;
    loop {
        let job = client.job(id)?;
        if job.summary.state.is_final() {
            return Ok(job);
        }
        let (stage, done, detail) = stage(&job);
        progress.update(&stage, done, &detail);
        let until = std::time::Instant::now() + INTERVAL;
        while std::time::Instant::now() < until {
            if stop.load(Ordering::Relaxed) {
                return Err(stopped());
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// What a job is at, which share of it is done, and more for people.
fn stage(job: &JobDetail) -> (String, f64, String) {
    let open = |state| job.passes.iter().filter(move |pass| pass.state == state);
    let Some(pass) = open(PassState::Open).max_by_key(|pass| pass.batches.total()) else {
        return (job.summary.state.to_string(), 0.0, waits(job));
    };
    let name = format!("{} {}", pass.kind, pass.name);
    let (done, total) = (pass.batches.total() - pass.batches.open(), pass.batches.total());
    let mut detail = format!("{done} of {total} batches, {} running", pass.batches.leased);
    if let Some(left) = job.left_ms {
        detail.push_str(&format!(", about {} left", figures::seconds(left as f64 / 1e3)));
    }
    let waits = waits(job);
    if !waits.is_empty() && pass.batches.leased == 0 {
        detail = waits;
    }
    (name.trim_end().into(), done as f64 / total.max(1) as f64, detail)
}

fn waits(job: &JobDetail) -> String {
    match job.waiting {
        WaitReason::Flowing => String::new(),
        reason => format!("waits: {reason}"),
    }
}

/// The answer about jobs that have ended.
///
/// # Errors
/// When one of them has not succeeded.
pub fn judge(jobs: &[JobDetail]) -> Result<Answer> {
    if let Some(job) = jobs.iter().find(|job| job.summary.state != JobState::Succeeded) {
        let summary = &job.summary;
        let message = format!("job `{}` has ended as `{}`: {}", summary.id, summary.state, summary.reason);
        return Err(Error::new(ErrorKind::Invalid, message)
            .hint(format!("`pantaray logs {}` shows which batches failed, and why", summary.id)));
    }
    let line = |job: &JobDetail| {
        let note =
            if job.summary.reason.is_empty() { String::new() } else { format!(" ({})", job.summary.reason) };
        format!("{} succeeded{note}; `pantaray fetch {} -o DIR` brings it", job.summary.id, job.summary.id)
    };
    Answer::new(&jobs, jobs.iter().map(line).collect::<Vec<_>>().join("\n"))
}
