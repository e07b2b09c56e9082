//! The simulator's scenarios at a size that fits a test. Their full size is `pantaray sim --verify`.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use sim::process::Launch;
use sim::scenario::{ALL, Scenario, Size, named, run};

/// Scenarios have figures: one at a time has the machine.
static MACHINE: Mutex<()> = Mutex::new(());

const SIZE: Size = Size { workers: 12, window_s: 2.0 };
/// Those that PostgreSQL does otherwise than SQLite: several coordinators, rows that are locked one by one.
const ON_POSTGRES: [&str; 4] = ["double", "wire", "failover", "reconnect"];

/// For what comes of many choices by chance: twelve workers make too few in two seconds to tell an order of ten.
const MANY: Size = Size { workers: 64, window_s: 5.0 };
/// Those.
const BY_CHANCE: [&str; 1] = ["priority"];

fn verify(scenario: &Scenario, postgres: Option<&str>) {
    let size = if BY_CHANCE.contains(&scenario.name) { &MANY } else { &SIZE };
    let launch = Launch { program: PathBuf::from(env!("CARGO_BIN_EXE_coordinator")), arguments: Vec::new() };
    let _alone = MACHINE.lock().unwrap_or_else(PoisonError::into_inner);
    let outcome = run(scenario, &launch, postgres, 1, size).expect("the stage is set");
    assert!(outcome.passed, "{}", outcome.text());
    println!("{}", outcome.text());
}

/// Catches whatever its scenario watches for, on SQLite.
#[test]
fn every_scenario_passes_on_sqlite() {
    ALL.iter().chain(named("million")).for_each(|scenario| verify(scenario, None));
}

/// Catches the same on PostgreSQL, with two coordinators where one is killed.
#[test]
fn scenarios_pass_on_postgres() {
    let Some(url) = tests::postgres::shared_database() else {
        eprintln!("skipped: PostgreSQL is not installed");
        return;
    };
    ALL.iter().filter(|s| ON_POSTGRES.contains(&s.name)).for_each(|scenario| verify(scenario, Some(&url)));
}
