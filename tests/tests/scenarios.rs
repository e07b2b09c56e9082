//! The simulator's scenarios at a size that fits a test. Their full size is `pantaray sim --verify`.

use sim::scenario::{ALL, Scenario, Size, run};

use crate::{launch, postgres};

const SIZE: Size = Size { workers: 12, window_s: 2.0 };
/// Those that PostgreSQL does otherwise than SQLite: several coordinators, rows that are locked one by one.
const ON_POSTGRES: [&str; 4] = ["double", "wire", "failover", "reconnect"];

/// How often figures that were missed are measured again: the machine may have been busy. What contradicts itself never passes.
const TRIES: u64 = 3;

/// They take minutes, and want a machine for themselves.
fn are_wanted() -> bool {
    let wanted = std::env::var_os("PANTARAY_SCENARIOS").is_some();
    if !wanted {
        eprintln!("skipped: PANTARAY_SCENARIOS=1 runs the simulator's scenarios");
    }
    wanted
}

fn verify(scenario: &Scenario, postgres: Option<&str>) {
    for seed in 1..=TRIES {
        let outcome = run(scenario, &launch(), postgres, seed, &SIZE).expect("the stage is set");
        println!("{}", outcome.text());
        assert!(outcome.problems.is_empty(), "{}", outcome.text());
        if outcome.passed {
            return;
        }
        assert!(seed < TRIES, "{}", outcome.text());
    }
}

/// Catches whatever its scenario watches for, on SQLite.
#[test]
fn every_scenario_passes_on_sqlite() {
    if are_wanted() {
        ALL.iter().for_each(|scenario| verify(scenario, None));
    }
}

/// Catches the same on PostgreSQL, with two coordinators where one is killed.
#[test]
fn scenarios_pass_on_postgres() {
    let Some(url) = postgres().filter(|_| are_wanted()) else { return };
    ALL.iter().filter(|s| ON_POSTGRES.contains(&s.name)).for_each(|scenario| verify(scenario, Some(&url)));
}
