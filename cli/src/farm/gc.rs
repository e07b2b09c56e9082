//! `pantaray gc` and `delete`: what nobody needs any more goes.

use std::sync::atomic::Ordering;

use clap::Args;
use engine::{Error, ErrorKind, Result};
use protocol::gc::{GcReport, GcRequest};

use super::Connection;
use super::jobs::table;
use crate::console::{Answer, Console};
use crate::{figures, signals};

/// Requests for one collection at most: some hours.
const REQUESTS_MAX: usize = 1_000;

/// Remove what is past its retention, and what no job refers to; the coordinator does this by itself, too
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    connection: Connection,
    /// Say what would go, and remove nothing
    #[arg(long)]
    dry_run: bool,
}

/// Delete a job that has ended, with all that it published
#[derive(Debug, Args)]
pub struct DeleteArguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
    /// Say what would go, and delete nothing
    #[arg(long)]
    dry_run: bool,
}

/// Collects until there is no more.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    let request = GcRequest { dry_run: arguments.dry_run };
    let mut report = GcReport { dry_run: arguments.dry_run, ..GcReport::default() };
    for round in 0..REQUESTS_MAX {
        let part = client.collect_garbage(&request)?;
        part.items.iter().for_each(|item| report.add(item.kind, item.count, item.bytes));
        report.more = part.more;
        // A look begins at the front every time
        if !report.more || request.dry_run {
            break;
        }
        if signals::cancel_flag().load(Ordering::Relaxed) {
            return Err(Error::new(ErrorKind::Cancelled, "garbage is left: the next collection goes on"));
        }
        console.control().progress.update("gc", 0.0, &format!("round {}", round + 2));
    }
    Answer::new(&report, describe(&report))
}

/// Deletes, or says what would go.
pub fn run_delete(arguments: DeleteArguments, _console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    if !arguments.dry_run {
        client.delete_job(&arguments.job)?;
        let text = format!("{} is deleted; its bytes go with the next collection", arguments.job);
        return Answer::new(&serde_json::json!({ "deleted": arguments.job }), text);
    }
    let preview = client.delete_preview(&arguments.job)?;
    let mut lines = vec![describe(&preview.report)];
    lines.extend(preview.outputs.iter().map(|name| format!("published: {name}")));
    lines.extend(preview.brick_maps.iter().map(|map| format!("no other job refers to the brick map {map}")));
    lines.extend(preview.refused.iter().map(|reason| format!("not now: {reason}")));
    Answer::new(&preview, lines.join("\n"))
}

fn describe(report: &GcReport) -> String {
    if report.items.is_empty() {
        return "there is nothing to remove".into();
    }
    let mut rows = vec![["KIND", "COUNT", "BYTES"].map(String::from)];
    rows.extend(
        report
            .items
            .iter()
            .map(|item| [item.kind.word().into(), figures::count(item.count), figures::bytes(item.bytes)]),
    );
    let more = if report.more { "\nand more, for which there was no time" } else { "" };
    format!("{}{more}", table(&rows))
}
