//! What may befall a farm befalls it: real coordinator processes are killed at every commit, the database crashes, clocks are
//! wrong, tokens are revoked, messages are lost, doubled and reordered. After each, every batch counts under one fence, counts
//! equal what they count, and no acknowledged submission is lost: `sim`'s stage compares all books at its end.

mod kills;
mod troubles;

use std::path::PathBuf;
use std::time::Duration;

use protocol::JobState;
use sim::load::Load;
use sim::process::Launch;
use sim::stage::{Job, Options, Stage};

/// Time for anything that a test waits for.
const PATIENCE: Duration = Duration::from_secs(90);

fn launch() -> Launch {
    Launch { program: PathBuf::from(env!("CARGO_BIN_EXE_coordinator")), arguments: Vec::new() }
}

/// A stage whose leases last two seconds.
fn set(postgres: Option<&str>, coordinators: usize) -> Stage {
    let postgres = postgres.map(str::to_owned);
    let options = Options { launch: launch(), postgres, seed: 1, coordinators, lease_s: 2 };
    Stage::set(&options).expect("the stage is set")
}

/// The URL of a real PostgreSQL; says so where there is none.
fn postgres() -> Option<String> {
    let url = tests::postgres::shared_database();
    if url.is_none() {
        eprintln!("skipped: PostgreSQL is not installed");
    }
    url
}

fn load(batches: i64) -> Load {
    Load::new(batches, 5.0, 10_000)
}

/// Waits for a job's success.
fn succeeds(stage: &Stage, job: &Job) {
    let detail = stage.finish(job, PATIENCE).expect("it ends");
    assert_eq!(detail.summary.state, JobState::Succeeded, "{detail:?}");
}

/// Ends the stage, and compares all books.
fn end(stage: Stage, what: &str) {
    let problems = stage.end().expect("the books can be read");
    assert!(problems.is_empty(), "{what}: {problems:#?}");
}
