//! A coordinator that is killed just before or just after each of its commits, as a supervisor would see it.

use std::time::{Duration, Instant};

use protocol::JobState;
use sim::fake::Temper;
use sim::stage::{Stage, submit};
use sim::wire::Wire;

use sim::load::Load;

use crate::{PATIENCE, end, postgres, set, succeeds};

/// Commits that a farm at work comes to, and which passing of each is the last.
const POINTS: &[(&str, u64)] = &[
    ("register", 3),
    ("submit", 2),
    ("advance", 4),
    ("create", 1),
    ("claim", 5),
    ("start", 1),
    ("complete", 6),
    ("heartbeat", 3),
    ("release", 2),
    ("expire", 1),
    ("publish", 1),
];
/// Batches long enough for some heartbeats.
fn load(batches: i64) -> Load {
    Load::new(batches, 60.0, 10_000)
}

/// Stages at once.
const AT_ONCE: usize = 6;

/// Catches a coordinator that does in two steps what must be one, or believes what it did not write down.
#[test]
fn a_kill_at_any_commit_loses_nothing_on_sqlite() {
    at_every_commit(None);
}

/// As above, where commits are another process's.
#[test]
fn a_kill_at_any_commit_loses_nothing_on_postgres() {
    if let Some(url) = postgres() {
        at_every_commit(Some(&url));
    }
}

fn at_every_commit(postgres: Option<&str>) {
    let kills: Vec<String> = POINTS
        .iter()
        .flat_map(|(name, count)| ["before", "after"].map(|when| format!("{name}:{when}:{count}")))
        .collect();
    for kills in kills.chunks(AT_ONCE) {
        std::thread::scope(|scope| {
            for kill in kills {
                scope.spawn(move || killed_at(kill, postgres));
            }
        });
    }
}

/// A farm at work whose coordinator ends itself at a commit, and is started again.
fn killed_at(kill: &str, postgres: Option<&str>) {
    let mut stage = set(postgres, 1);
    let first = stage.submit(load(40), |_| {}).expect("submitted");
    stage.kill(0);
    stage.restart(0, &[("PANTARAY_FAULT", kill.into())]).expect("it starts");
    let wire = Wire { unanswered: 0.1, doubled: 0.1, ..Wire::default() };
    let ordinary = Temper { wire, ..Temper::default() };
    // One lets a lease run out, one gives its batches back
    let sleeper = Temper { freezes: Some(Duration::from_secs(4)), ..ordinary };
    let shy = Temper { is_shy: true, wait: Duration::from_millis(200), ..ordinary };
    stage.hire(&[sleeper, ordinary, ordinary, shy]).expect("hired");

    // Jobs are submitted meanwhile, by somebody who insists
    let (client, shared) = (stage.people[0].clone(), stage.shared.clone());
    let later = std::thread::spawn(move || {
        [40, 5].map(|batches| submit(&shared, &client, load(batches), |_| {}).expect("acknowledged"))
    });
    let start = Instant::now();
    while stage.processes[0].as_mut().is_some_and(sim::process::Process::is_running) {
        assert!(start.elapsed() < PATIENCE, "{kill} was not come to");
        std::thread::sleep(Duration::from_millis(20));
    }
    stage.restart(0, &[]).expect("it starts again");
    let later = later.join().expect("no panic");
    for job in later.iter().chain([&first]) {
        succeeds(&stage, job);
    }
    all_are_there(&stage, 3, kill);
    end(stage, kill);
}

/// Every job once: a submission that was repeated made no second one.
fn all_are_there(stage: &Stage, count: usize, what: &str) {
    let page = stage.client().jobs("?limit=100").expect("jobs");
    assert_eq!(page.jobs.len(), count, "{what}");
    assert!(page.jobs.iter().all(|job| job.state == JobState::Succeeded), "{what}");
}

/// Catches a start that cannot be repeated when it was cut off.
#[test]
fn a_kill_while_it_starts_loses_nothing() {
    let mut stage = set(None, 1);
    let job = stage.submit(load(20), |_| {}).expect("submitted");
    for when in ["before", "after"] {
        stage.kill(0);
        let started = stage.restart(0, &[("PANTARAY_FAULT", format!("forgive:{when}:1"))]);
        assert!(started.is_err(), "{when}");
    }
    stage.restart(0, &[]).expect("it starts");
    stage.hire(&[Temper::default(); 2]).expect("hired");
    succeeds(&stage, &job);
    end(stage, "forgive");
}
