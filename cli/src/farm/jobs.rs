//! `pantaray jobs` and `pantaray workers`: what is on the farm.

use clap::Args;
use engine::Result;
use protocol::admin::WorkerDetail;
use protocol::job::{JobDetail, JobSummary};

use super::Connection;
use crate::console::{Answer, Console};
use crate::figures;

/// List the farm's jobs, latest first, or show one
#[derive(Debug, Args)]
pub struct Arguments {
    /// Show this job and its passes
    job: Option<String>,
    #[command(flatten)]
    connection: Connection,
    /// Jobs to list at most
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..=1000))]
    limit: u16,
}

/// List the farm's workers, or change one
#[derive(Debug, Args)]
pub struct WorkersArguments {
    /// The worker to change
    #[arg(requires = "action")]
    worker: Option<String>,
    #[command(flatten)]
    connection: Connection,
    #[command(flatten)]
    action: WorkerAction,
}

/// What to do with a worker.
#[derive(Debug, Args)]
#[group(id = "action", multiple = false, requires = "worker")]
struct WorkerAction {
    /// Give it no more work
    #[arg(long)]
    lock: bool,
    /// Give it work again, also where it was put to rest
    #[arg(long)]
    unlock: bool,
    /// Let it finish what it has and take no more, until it is started again or unlocked
    #[arg(long)]
    drain: bool,
}

/// Lists jobs, or shows one.
pub fn run(arguments: Arguments, _console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    if let Some(job) = &arguments.job {
        let job = client.job(job)?;
        return Answer::new(&job, describe(&job));
    }
    let page = client.jobs(&format!("?limit={}", arguments.limit))?;
    let mut rows = vec![["JOB", "STATE", "DONE", "RUNNING", "FAILED", "PRIORITY", "NAME"].map(String::from)];
    rows.extend(page.jobs.iter().map(row));
    Answer::new(&page, table(&rows))
}

/// Lists workers, or changes one.
pub fn run_workers(arguments: WorkersArguments, _console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    if let Some(worker) = &arguments.worker {
        let (action, done) = match arguments.action {
            WorkerAction { lock: true, .. } => ("lock", "locked"),
            WorkerAction { unlock: true, .. } => ("unlock", "unlocked"),
            WorkerAction { .. } => ("drain", "drained"),
        };
        client.act_on_worker(worker, action)?;
        return Answer::new(&serde_json::json!({ done: worker }), format!("{worker} is {done}"));
    }
    let workers = client.workers()?;
    let mut rows = vec![
        ["WORKER", "STATE", "BATCHES", "MEMORY", "ERRORS", "VERSION", "LABELS, WHY LOCKED"].map(String::from),
    ];
    rows.extend(workers.iter().map(worker_row));
    Answer::new(&workers, table(&rows))
}

fn row(job: &JobSummary) -> [String; 7] {
    let batches = &job.batches;
    let state = if job.paused { format!("{} (paused)", job.state) } else { job.state.to_string() };
    [
        job.id.clone(),
        state,
        format!("{}/{}", batches.done, batches.total()),
        batches.leased.to_string(),
        batches.failed.to_string(),
        job.priority.to_string(),
        printable(&job.name),
    ]
}

fn worker_row(worker: &WorkerDetail) -> [String; 7] {
    [
        worker.name.clone(),
        worker.state.clone(),
        worker.leased.to_string(),
        figures::bytes(worker.memory_bytes.max(0).unsigned_abs()),
        worker.errors.to_string(),
        worker.version.clone(),
        printable(&[&worker.labels[..], std::slice::from_ref(&worker.reason)].concat().join(" ")),
    ]
}

fn describe(job: &JobDetail) -> String {
    let summary = &job.summary;
    let mut lines = vec![format!("{} {}: {}", summary.id, printable(&summary.name), summary.state)];
    if !summary.reason.is_empty() {
        lines.push(printable(&summary.reason));
    }
    if !summary.state.is_final() {
        lines.push(format!("waits: {}", job.waiting));
    }
    let mut rows = vec![["PASS", "KIND", "STATE", "DONE", "RUNNING", "FAILED", "ABOUT"].map(String::from)];
    for pass in &job.passes {
        let batches = &pass.batches;
        rows.push([
            pass.id.to_string(),
            pass.kind.to_string(),
            pass.state.to_string(),
            format!("{}/{}", batches.done, batches.total()),
            batches.leased.to_string(),
            batches.failed.to_string(),
            printable(&pass.name),
        ]);
    }
    lines.push(table(&rows));
    lines.join("\n")
}

/// Columns side by side, the last one as it is.
pub(super) fn table<const N: usize>(rows: &[[String; N]]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..N).map(width).collect();
    let line = |row: &[String; N]| {
        let cells = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}"));
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// What somebody else wrote, without what would move the cursor.
pub(super) fn printable(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { '?' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a column that runs into the next, and a job's name that moves the terminal's cursor.
    #[test]
    fn tables_line_up_and_names_are_text() {
        let row = |cells: [&str; 7]| cells.map(String::from);
        let text = table(&[row(["a", "bb", "", "", "", "", "z"]), row(["aaa", "b", "1", "", "", "", ""])]);
        assert_eq!(text, "a    bb           z\naaa  b   1");
        assert_eq!(printable("a\x1b[2Jb\n"), "a?[2Jb?");
    }
}
