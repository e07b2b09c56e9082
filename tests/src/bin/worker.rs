//! A worker for the tests that kill it: as `pantaray worker`, with what it needs in the environment.

use std::sync::atomic::AtomicBool;
use std::time::Duration;

use engine::bake::BakeOptions;
use worker::client::Client;
use worker::run::{Options, run};

fn main() {
    let given = |name: &str| std::env::var(name).expect("it is set");
    let client = Client::new(&given("PANTARAY_URL"), Some(&given("PANTARAY_TOKEN")), Duration::from_secs(5));
    let options = Options {
        client: client.expect("a client"),
        name: given("PANTARAY_WORKER"),
        labels: Vec::new(),
        cache: given("PANTARAY_CACHE").into(),
        cache_bytes: 1 << 30,
        spool_bytes: 64 << 20,
        roots: Default::default(),
        machine: BakeOptions { memory_bytes: 256 << 20, threads: 1, ..BakeOptions::default() },
        grace: Duration::from_secs(1),
    };
    run(&options, &AtomicBool::new(false)).expect("it works");
}
