//! `pantaray logs`: why batches failed, and what workers said about one.

use std::sync::atomic::Ordering;
use std::time::Duration;

use clap::Args;
use engine::Result;
use serde_json::json;

use super::Connection;
use crate::console::{Answer, Console};
use crate::signals;

/// How often a log that is followed is read again.
const INTERVAL: Duration = Duration::from_secs(1);

/// Show why a job's batches failed, or the log of one batch
#[derive(Debug, Args)]
pub struct Arguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
    /// The batch's pass
    #[arg(long, value_name = "ID", requires = "batch")]
    pass: Option<i64>,
    /// The batch
    #[arg(long, value_name = "N", requires = "pass")]
    batch: Option<i64>,
    /// The claim, by its fence [default: the latest]
    #[arg(long, value_name = "N", requires = "batch")]
    fence: Option<i64>,
    /// Show more as it comes, until the job ends
    #[arg(short, long)]
    follow: bool,
}

/// Shows failures or a log.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    let read = || -> Result<String> {
        let (Some(pass), Some(batch)) = (arguments.pass, arguments.batch) else {
            let line = |f: &protocol::job::Failure| {
                let (message, count) = (f.message.replace(['\n', '\r', '\x1b'], " "), f.count);
                format!(
                    "pass {} batch {} on {}: {} ({count}x): {message}\n",
                    f.pass, f.batch, f.worker, f.class
                )
            };
            return Ok(client.failures(&arguments.job)?.iter().map(line).collect());
        };
        let fence = arguments.fence.map_or(String::new(), |fence| format!("?fence={fence}"));
        Ok(client.text(&format!("/v1/jobs/{}/passes/{pass}/batches/{batch}/log{fence}", arguments.job))?)
    };
    let mut text = read()?;
    if arguments.follow {
        let mut shown = 0;
        loop {
            let is_over = client.job(&arguments.job)?.summary.state.is_final();
            text = read()?;
            console.print_more(text.get(shown.min(text.len())..).unwrap_or(&text))?;
            shown = text.len();
            if is_over || signals::cancel_flag().load(Ordering::Relaxed) {
                return Ok(Answer::said());
            }
            std::thread::sleep(INTERVAL);
        }
    }
    Answer::new(&json!({ "text": text }), text.clone())
}
