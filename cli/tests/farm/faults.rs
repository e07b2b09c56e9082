//! Workers and their disks at the worst moments; what is published stays the same to the byte.

use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crate::processes::Farm;
use crate::proxy::{Fault, Proxy, Rule};

/// Kills a worker while the request that the last of `rules` is about is held; another one ends the job.
fn killed_at(rules: &[Rule]) {
    let mut farm = Farm::start();
    let proxy = Proxy::start(farm.port, None);
    proxy.set(rules);
    let job = farm.submit(1);
    let victim = farm.worker_at("victim", &format!("http://127.0.0.1:{}", proxy.port), &[]);
    proxy.held();
    farm.kill(victim);
    farm.worker("other");
    farm.wait(&job);
    farm.expect_same(&job);
}

/// Catches a batch that is lost when its worker dies with the part that it was about to put.
#[test]
fn a_worker_dies_before_it_puts() {
    killed_at(&[Rule::new("PUT /v1/leases/", ".part", Fault::Hold, 1)]);
}

/// Catches a part that counts because it lies in storage though nobody reported it.
#[test]
fn a_worker_dies_between_putting_and_reporting() {
    // Import, plan and build report first
    let passes = Rule::new("POST /v1/leases/", "/complete", Fault::Dawdle, 3);
    killed_at(&[passes, Rule::new("POST /v1/leases/", "/complete", Fault::Hold, 1)]);
}

/// Catches a batch that is done twice, or not at all, because its worker died before it heard that it counted; and one
/// that is counted twice because a worker that lives reports again.
#[test]
fn a_worker_dies_before_it_hears_the_answer() {
    let passes = Rule::new("POST /v1/leases/", "/complete", Fault::Dawdle, 3);
    let mut farm = Farm::start();
    let proxy = Proxy::start(farm.port, None);
    proxy.set(&[passes, Rule::new("POST /v1/leases/", "/complete", Fault::HoldAnswer, 1)]);
    let job = farm.submit(1);
    let url = format!("http://127.0.0.1:{}", proxy.port);
    let victim = farm.worker_at("victim", &url, &[]);
    proxy.held();
    farm.kill(victim);
    // The other one's answers break off now and then
    proxy.set(&[Rule::new("POST /v1/leases/", "/complete", Fault::CutAnswer, 2)]);
    farm.worker_at("other", &url, &[]);
    farm.wait(&job);
    farm.expect_same(&job);
}

/// Catches a worker without room that takes a job down with it, and half a file that it leaves and believes.
#[test]
fn a_full_disk_costs_its_worker_only() {
    let mut farm = Farm::start();
    farm.cramped_worker("cramped", 256);
    let job = farm.submit(1);
    farm.until_said("cramped", "File too large");
    farm.worker("other");
    farm.wait_through_pause(&job);
    farm.expect_same(&job);
}

/// Catches bytes of the local disk that are believed because they were right once.
#[test]
fn a_damaged_brick_in_a_cache_is_fetched_again() {
    let mut farm = Farm::start();
    farm.worker("first");
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect_same(&job);
    farm.end("first");
    damage(&PathBuf::from(farm.at("first")).join("objects"));
    farm.worker("first");
    let job = farm.submit(1);
    farm.wait(&job);
    farm.expect_same(&job);
    assert!(farm.log("first").contains("damaged"), "the worker did not notice");
}

/// Flips a bit of every 4 KiB of every object that is large enough to be more than a head.
fn damage(objects: &Path) {
    for folder in std::fs::read_dir(objects).unwrap().map(|entry| entry.unwrap().path()) {
        for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            let mut file = std::fs::File::options().read(true).write(true).open(&path).unwrap();
            let bytes = file.metadata().unwrap().len();
            for at in (2048..bytes).step_by(4096) {
                let mut byte = [0];
                file.seek(SeekFrom::Start(at)).unwrap();
                file.read_exact(&mut byte).unwrap();
                byte[0] ^= 1;
                file.seek(SeekFrom::Start(at)).unwrap();
                file.write_all(&byte).unwrap();
            }
        }
    }
}

/// Catches a worker that goes on with a token that was taken from it, and batches that stay with it.
#[test]
fn a_token_is_revoked_while_its_worker_bakes() {
    let mut farm = Farm::start_with(&[], Vec::new());
    let token = |label: &str| {
        let file = farm.at(&format!("{label}.token"));
        let made = farm.command(&["token", "create", "--role", "worker", "--label", label, "-o", &file]);
        (made["id"].as_str().unwrap().to_owned(), file)
    };
    let ((id, revoked), (_, good)) = (token("revoked"), token("good"));
    let url = format!("http://127.0.0.1:{}", farm.port);
    let worker = farm.worker_at("revoked", &url, &["--token-file", &revoked]);
    let job = farm.submit(1);
    farm.until_baking(&job, 2);
    farm.command(&["token", "revoke", &id]);
    assert_eq!(farm.join_failed(worker), Some(1));
    farm.worker_at("good", &url, &["--token-file", &good]);
    farm.wait(&job);
    farm.expect_same(&job);
}
