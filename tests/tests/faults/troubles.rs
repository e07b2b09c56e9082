//! Troubles that are not the coordinator's own: its database, its clock, its workers' tokens.

use std::time::{Duration, Instant};

use sim::fake::Temper;
use sim::load::Load;
use tests::postgres::Postgres;

use crate::{PATIENCE, end, load, postgres, set, succeeds};

/// Milliseconds of five minutes.
const OFF_MS: i64 = 300_000;

/// Catches a coordinator that ends, or forgets, when its database crashes under it.
#[test]
fn a_database_may_crash_and_come_back() {
    let Some(mut server) = Postgres::start() else {
        eprintln!("skipped: PostgreSQL is not installed");
        return;
    };
    let mut stage = set(Some(&server.url("postgres")), 2);
    let job = stage.submit(load(300), |_| {}).expect("submitted");
    stage.hire(&[Temper::default(); 4]).expect("hired");
    until_accepted(&stage, 40);
    server.crash_and_restart();
    let more = stage.submit(load(20), |_| {}).expect("submitted");
    succeeds(&stage, &job);
    succeeds(&stage, &more);
    end(stage, "a database that crashed");
}

/// Catches coordinators of one database that each go by their own machine's clock: one that is five minutes ahead would end
/// the leases that the other gives.
#[test]
fn a_clock_that_is_ahead_ends_no_lease() {
    let Some(url) = postgres() else { return };
    let mut stage = set(Some(&url), 2);
    stage.kill(1);
    stage.restart(1, &[("PANTARAY_CLOCK_OFF_MS", OFF_MS.to_string())]).expect("it starts");
    let job = stage.submit(Load { group: 1, ..Load::new(12, 800.0, 10_000) }, |_| {}).expect("submitted");
    stage.hire(&[Temper::default(); 6]).expect("hired");
    succeeds(&stage, &job);
    let (claimed, lost) = {
        let seen = stage.shared.ledger.seen();
        (seen.claims.iter().map(|claim| claim.batches).sum::<usize>(), seen.leases_lost)
    };
    assert_eq!((claimed, lost), (12, 0), "every batch is claimed once");
    end(stage, "a clock that is ahead");
}

/// Catches leases that last five minutes longer because the clock was put back by as much: those of a worker that is gone
/// would keep its batches so long.
#[test]
fn a_clock_that_is_put_back_delays_nothing() {
    let mut stage = set(None, 1);
    stage.kill(0);
    stage.restart(0, &[("PANTARAY_CLOCK_OFF_MS", OFF_MS.to_string())]).expect("it starts");
    let job = stage.submit(load(12), |_| {}).expect("submitted");
    stage.prepare(&[&job]).expect("up to the bake");
    // It claims, and sleeps for longer than the test takes
    stage.hire(&[Temper { freezes: Some(Duration::from_secs(12)), ..Temper::default() }]).expect("hired");
    stage
        .until("a batch is claimed", PATIENCE, || Ok(!stage.shared.ledger.seen().claims.is_empty()))
        .expect("claimed");
    stage.kill(0);
    stage.restart(0, &[]).expect("it starts");
    let start = Instant::now();
    stage.hire(&[Temper::default(); 2]).expect("hired");
    succeeds(&stage, &job);
    assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
    end(stage, "a clock that was put back");
}

/// Catches a token that works on after it was revoked, and batches that are lost with their worker's token.
#[test]
fn a_token_may_be_revoked_in_the_midst_of_a_lease() {
    let mut stage = set(None, 1);
    let job = stage.submit(Load { group: 1, ..Load::new(60, 50.0, 10_000) }, |_| {}).expect("submitted");
    stage.prepare(&[&job]).expect("up to the bake");
    let token = stage.worker_token("to be revoked").expect("a token");
    stage.hire_with(&token.secret, &[Temper::default(); 3]).expect("hired");
    until_accepted(&stage, 6);
    stage.client().revoke_token(&token.id).expect("revoked");
    // What was under way has come to its end
    std::thread::sleep(Duration::from_millis(300));
    let accepted = |stage: &sim::stage::Stage| {
        stage.shared.ledger.seen().accepted.iter().map(|accepted| accepted.batches).sum::<usize>()
    };
    let before = accepted(&stage);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(accepted(&stage), before, "a revoked token's results count");
    stage.hire(&[Temper::default(); 3]).expect("hired");
    succeeds(&stage, &job);
    end(stage, "a revoked token");
}

fn until_accepted(stage: &sim::stage::Stage, batches: usize) {
    let accepted = || {
        let seen = stage.shared.ledger.seen();
        Ok(seen.accepted.iter().map(|accepted| accepted.batches).sum::<usize>() >= batches)
    };
    stage.until("batches were accepted", PATIENCE, accepted).expect("accepted");
}
