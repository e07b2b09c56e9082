//! The workers of `serve --embedded --workers N`: threads of the coordinator's process that are workers like any other, over
//! the same wire.

use std::net::SocketAddr;
use std::path::Path;
use std::thread::JoinHandle;
use std::time::Duration;

use engine::Result;
use engine::bake::BakeOptions;
use engine::scene::Roots;
use worker::client::Client;
use worker::run::{Options, Summary, run};

use crate::signals;

/// Patience with the coordinator of the same process.
const PATIENCE: Duration = Duration::from_secs(20);
/// Time for the batch at hand when the process is stopped.
const GRACE: Duration = Duration::from_secs(5);
/// Bytes that a worker's cache keeps, and that may wait in its spool.
const KEPT_BYTES: (u64, u64) = (20 << 30, 1 << 30);

/// What the workers of one process have in common.
#[derive(Clone, Debug)]
pub struct Crew {
    /// How many.
    pub count: u16,
    /// What tells their names from those of an earlier process.
    pub mark: String,
    /// Their token.
    pub token: Option<String>,
    /// Asset roots by name.
    pub roots: Roots,
}

/// Starts the workers, with their caches below `folder`. They end when the process is asked to stop.
///
/// # Errors
/// When the address is no coordinator's.
pub fn start(
    crew: &Crew,
    listen: SocketAddr,
    folder: &Path,
) -> Result<Vec<JoinHandle<worker::Result<Summary>>>> {
    let client = Client::new(&format!("http://{listen}"), crew.token.as_deref(), PATIENCE)?;
    let machine = BakeOptions::default();
    let threads = (machine.threads / usize::from(crew.count.max(1))).max(1);
    let options = |number: u16| Options {
        client: client.clone(),
        name: format!("embedded-{number}-{}", crew.mark),
        labels: Vec::new(),
        cache: folder.join(number.to_string()),
        cache_bytes: KEPT_BYTES.0,
        spool_bytes: KEPT_BYTES.1,
        roots: crew.roots.clone(),
        machine: BakeOptions { threads, ..machine.clone() },
        grace: GRACE,
    };
    let begin = |number| {
        let options = options(number);
        std::thread::spawn(move || run(&options, signals::cancel_flag()))
    };
    Ok((1..=crew.count).map(begin).collect())
}

/// Waits for the workers' end, and says why one ended badly.
pub fn join(workers: Vec<JoinHandle<worker::Result<Summary>>>) {
    for worker in workers {
        match worker.join() {
            Ok(Ok(_)) => {}
            Ok(Err(error)) => eprintln!("an embedded worker ended: {error}"),
            Err(_) => eprintln!("an embedded worker panicked"),
        }
    }
}
