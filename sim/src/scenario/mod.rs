//! The scenarios: what a crew does to coordinators, and what must come of it; `docs/simulator.md` says why.

mod absence;
mod flow;
mod order;
mod scale;
mod trust;

use std::collections::HashMap;
use std::time::Instant;

use engine::Result;

use crate::fake::Temper;
use crate::process::Launch;
use crate::report::{Figure, Outcome};
use crate::stage::{Options, Stage};

/// How large a scenario is.
#[derive(Clone, Copy, Debug)]
pub struct Size {
    /// Workers.
    pub workers: usize,
    /// Seconds that are looked at where something goes on and on.
    pub window_s: f64,
}

impl Size {
    /// A crew of equal workers.
    fn crew(&self) -> Vec<Temper> {
        vec![Temper::default(); self.workers]
    }

    /// Batches, so many for each worker.
    fn batches(&self, each: i64) -> i64 {
        self.workers as i64 * each
    }
}

/// A scenario.
#[derive(Clone, Copy, Debug)]
pub struct Scenario {
    /// Its name.
    pub name: &'static str,
    /// What it tries.
    pub about: &'static str,
    /// Coordinators where the database allows several.
    coordinators: usize,
    run: fn(&mut Stage, &Size) -> Result<Vec<Figure>>,
}

/// Seconds that leases last on stage.
const LEASE_S: u32 = 5;

/// All scenarios.
pub const ALL: &[Scenario] = &[
    Scenario {
        name: "fill",
        about: "a farm that waits is filled by one submission",
        coordinators: 1,
        run: flow::fill,
    },
    Scenario {
        name: "priority",
        about: "jobs get workers by their priority, none starves, and a late job gets its part soon",
        coordinators: 1,
        run: order::priority,
    },
    Scenario {
        name: "fairness",
        about: "projects get the workers' time by their shares, however long their batches are",
        coordinators: 1,
        run: order::fairness,
    },
    Scenario {
        name: "locality",
        about: "workers stay near what they have in memory",
        coordinators: 1,
        run: flow::locality,
    },
    Scenario {
        name: "stragglers",
        about: "the end of a job does not wait at a slow worker's segment",
        coordinators: 1,
        run: flow::stragglers,
    },
    Scenario {
        name: "storm",
        about: "all workers complete at the same moment",
        coordinators: 1,
        run: flow::storm,
    },
    Scenario {
        name: "poison",
        about: "batches that always crash are given up, a broken worker is kept away, neither costs more",
        coordinators: 1,
        run: trust::poison,
    },
    Scenario {
        name: "double",
        about: "every result comes twice, and some from leases that are long over",
        coordinators: 1,
        run: trust::double,
    },
    Scenario {
        name: "wire",
        about: "messages are lost, doubled and reordered, and a coordinator is killed meanwhile",
        coordinators: 2,
        run: trust::wire,
    },
    Scenario {
        name: "failover",
        about: "a coordinator is killed: another goes on, or itself when started again",
        coordinators: 2,
        run: absence::failover,
    },
    Scenario {
        name: "reconnect",
        about: "all workers come back at once to a coordinator that was away",
        coordinators: 1,
        run: absence::reconnect,
    },
];

/// Scenarios of a large farm's size: they take minutes, and are run by name.
pub const LARGE: &[Scenario] = &[
    Scenario {
        name: "million",
        about: "a million batches are made, looked at and found again; all workers wait",
        coordinators: 1,
        run: scale::million,
    },
    Scenario { name: "list", about: "the list of ten thousand jobs", coordinators: 1, run: scale::list },
    Scenario {
        name: "idle",
        about: "workers with nothing to do cost nothing",
        coordinators: 1,
        run: scale::idle,
    },
];

/// The scenario of this name.
pub fn named(name: &str) -> Option<&'static Scenario> {
    ALL.iter().chain(LARGE).find(|scenario| scenario.name == name)
}

/// Runs a scenario on a stage of its own.
///
/// # Errors
/// When the stage cannot be set or its books cannot be read; what goes wrong in between is the outcome's.
pub fn run(
    scenario: &Scenario,
    launch: &Launch,
    postgres: Option<&str>,
    seed: u64,
    size: &Size,
) -> Result<Outcome> {
    let start = Instant::now();
    let options = Options {
        launch: launch.clone(),
        postgres: postgres.map(str::to_owned),
        seed,
        coordinators: scenario.coordinators,
        lease_s: LEASE_S,
    };
    let mut stage = Stage::set(&options)?;
    let mut problems = Vec::new();
    let figures = (scenario.run)(&mut stage, size).unwrap_or_else(|error| {
        problems.push(error.to_string());
        Vec::new()
    });
    problems.extend(stage.end()?);
    Ok(Outcome::new(scenario.name, start.elapsed().as_secs_f64(), figures, problems))
}

/// Batches of each load that were accepted from `from` to `to`, seconds since the stage was set.
fn accepted(stage: &Stage, from: f64, to: f64) -> HashMap<u64, f64> {
    let mut sums = HashMap::new();
    for accepted in stage.shared.ledger.seen().accepted.iter().filter(|a| (from..to).contains(&a.at)) {
        *sums.entry(accepted.load).or_default() += accepted.batches as f64;
    }
    sums
}

/// Seconds that workers spent on each load from `from` to `to`.
fn spent(stage: &Stage, from: f64, to: f64) -> HashMap<u64, f64> {
    let mut sums = HashMap::new();
    for spent in &stage.shared.ledger.seen().spent {
        *sums.entry(spent.load).or_default() += (spent.to.min(to) - spent.from.max(from)).max(0.0);
    }
    sums
}
