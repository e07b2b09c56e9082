//! A farm of real processes on loopback: what it publishes is, to the byte, what one quiet `pantaray bake` leaves,
//! whatever happens to workers and coordinator meanwhile.
#![cfg(unix)]

mod faults;
mod people;
mod processes;
mod proxy;
mod s3;
mod storage;

use std::time::Duration;

use processes::{Farm, json};

/// Catches a step that a farm takes otherwise than one process, a file that is not sent along, and results that are not
/// verified on their way down.
#[test]
fn a_submitted_scene_comes_back_as_one_process_bakes_it() {
    let mut farm = Farm::start();
    farm.worker("first");
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect(&job, 1);
    let failures = farm.command(&["logs", &job]);
    assert_eq!(failures["text"], "");
    // What is there and right is left alone; what is not is fetched again
    let (path, _) = farm.fetch(&job);
    std::fs::write(&path, b"something else").unwrap();
    farm.expect(&job, 1);
    // A second job on the same occluders builds no brick map
    let job = farm.submit(2);
    farm.wait(&job);
    farm.expect(&job, 2);
    let passes = farm.command(&["jobs", &job])["passes"].clone();
    let build = passes.as_array().unwrap().iter().find(|pass| pass["kind"] == "build").unwrap();
    assert_eq!(build["reused"], true, "{passes}");
}

/// Catches a batch that is lost with its worker, and a worker's part that is counted without having been put.
#[test]
fn a_killed_worker_costs_its_unfinished_batches_and_no_byte() {
    let mut farm = Farm::start();
    let victim = farm.worker("victim");
    let job = farm.submit(3);
    farm.until_baking(&job, 2);
    farm.kill(victim);
    farm.worker("other");
    farm.wait(&job);
    farm.expect(&job, 3);
}

/// Catches a worker that goes on with a lease that ran out while it was frozen, and a result of it that is believed.
#[test]
fn a_frozen_worker_wakes_to_find_its_batches_gone() {
    let mut farm = Farm::start();
    let frozen = farm.worker("frozen");
    let job = farm.submit(4);
    farm.until_baking(&job, 2);
    farm.signal(frozen, "STOP");
    farm.worker("other");
    std::thread::sleep(Duration::from_secs(7));
    farm.signal(frozen, "CONT");
    farm.wait(&job);
    farm.expect(&job, 4);
    // It is none the worse for it
    farm.end("other");
    let job = farm.submit(5);
    farm.wait(&job);
    farm.expect(&job, 5);
}

/// Catches a coordinator that forgets what it acknowledged, and workers that throw away what it could not take.
#[test]
fn a_coordinator_may_be_killed_and_started_again() {
    let mut farm = Farm::start();
    farm.worker("first");
    let job = farm.submit(6);
    farm.until_baking(&job, 1);
    farm.kill_coordinator();
    std::thread::sleep(Duration::from_secs(2));
    farm.start_coordinator();
    farm.wait(&job);
    farm.expect(&job, 6);
}

/// Catches a worker that keeps batches when it is stopped, or leaves with the wrong exit code.
#[test]
fn a_stopped_worker_gives_back_what_it_has_not_done() {
    let mut farm = Farm::start();
    let stopped = farm.worker("stopped");
    let job = farm.submit(7);
    farm.until_baking(&job, 2);
    farm.signal(stopped, "TERM");
    let summary = farm.join(stopped);
    assert!(summary["batches"].as_u64().unwrap() >= 4, "{summary}");
    // Nothing is leased any more, long before the lease would have run out
    let batches = farm.command(&["jobs", &job])["batches"].clone();
    assert_eq!(batches["leased"], 0, "{batches}");
    assert!(batches["ready"].as_i64().unwrap() > 0, "{batches}");
    farm.worker("other");
    farm.wait(&job);
    farm.expect(&job, 7);
}

/// Catches a cancelled job that goes on, a paused one that does, and exit codes that say otherwise.
#[test]
fn jobs_are_paused_resumed_and_cancelled() {
    let mut farm = Farm::start();
    let job = farm.submit_with(8, &["--paused"]);
    farm.worker("first");
    std::thread::sleep(Duration::from_millis(500));
    let shown = farm.command(&["jobs", &job]);
    assert_eq!((&shown["paused"], &shown["waiting"]), (&json!(true), &json!("paused")), "{shown}");
    farm.command(&["resume", &job]);
    farm.until_baking(&job, 1);
    farm.command(&["cancel", &job]);
    let (code, error) = farm.fails(&["watch", &job]);
    assert_eq!(code, 1);
    assert!(error.contains("cancelled"), "{error}");
    assert_eq!(farm.command(&["jobs", &job])["state"], "cancelled");
}
