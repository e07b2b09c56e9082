//! The simulator's scenarios at a size that fits a test. Their full size is `pantaray sim --verify`.

use sim::scenario::{ALL, Scenario, Size, run};

use crate::{launch, postgres};

const SIZE: Size = Size { workers: 12, window_s: 2.0 };
/// Those that PostgreSQL does otherwise than SQLite: several coordinators, rows that are locked one by one.
const ON_POSTGRES: [&str; 4] = ["double", "wire", "failover", "reconnect"];

fn verify(scenario: &Scenario, postgres: Option<&str>) {
    let outcome = run(scenario, &launch(), postgres, 1, &SIZE).expect("the stage is set");
    assert!(outcome.passed, "{}", outcome.text());
    println!("{}", outcome.text());
}

/// Catches whatever its scenario watches for, on SQLite.
#[test]
fn every_scenario_passes_on_sqlite() {
    ALL.iter().for_each(|scenario| verify(scenario, None));
}

/// Catches the same on PostgreSQL, with two coordinators where one is killed.
#[test]
fn scenarios_pass_on_postgres() {
    let Some(url) = postgres() else { return };
    ALL.iter().filter(|s| ON_POSTGRES.contains(&s.name)).for_each(|scenario| verify(scenario, Some(&url)));
}
