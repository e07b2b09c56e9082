//! The coordinator's beginning and end.

use std::time::{Duration, Instant};

use protocol::Role;
use protocol::work::{ClaimRequest, RegisterRequest};
use serde_json::json;

use super::people::wait_until;
use super::{Service, ask};

/// Catches an end that waits for those who wait for work, a job that is lost by a restart, and a lease that is.
#[test]
fn an_end_is_quick_and_a_restart_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path(), None);
    let (people, client) = (service.client(Role::Submitter), service.client(Role::Worker));
    let request = service.request(&people);
    let job = people.submit(&request, "key").unwrap().jobs.remove(0);
    let (labels, memory_bytes, version) = (Vec::new(), 4 << 30, "test".into());
    let register = RegisterRequest { name: "w1".into(), labels, memory_bytes, version, protocol: 1 };
    let session = client.register(&register).unwrap().session;
    let wait = |wait_ms| ClaimRequest { session: session.clone(), max: 1, wait_ms, warm: Vec::new() };
    let claimed = client.claim(&wait(10_000)).unwrap().expect("the import");
    let (token, url) = (service.token(Role::Viewer, None), service.url.clone());
    assert_eq!(ask(&format!("{url}/readyz"), "GET", None, None).0, 200);

    // A claim and a listener wait when the end comes
    let waiting = std::thread::spawn({
        let (client, request) = (client.with_patience(Duration::ZERO), wait(50_000));
        move || client.claim(&request).is_err()
    });
    let listening = std::thread::spawn(move || {
        let reply = ureq::get(format!("{url}/v1/events")).header("authorization", format!("Bearer {token}"));
        reply.call().unwrap().into_body().read_to_string().unwrap()
    });
    std::thread::sleep(Duration::from_millis(500));
    let start = Instant::now();
    service.stop();
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
    assert!(waiting.join().unwrap(), "a claim was granted at the end");
    assert!(listening.join().unwrap().contains("event: bye"));
    drop(service);

    // The same folder again: the job is there, the session and the lease still hold
    let service = Service::start(folder.path(), None);
    let held = service.runtime.block_on(service.coordinator.store.held(&claimed.lease, &session)).unwrap();
    assert_eq!(held.expect("the lease").job, job);
    let admin = service.token(Role::Admin, None);
    let (status, found) = ask(&format!("{}/v1/jobs/{job}", service.url), "GET", Some(&admin), None);
    assert_eq!((status, &found["name"]), (200, &json!("camp")));
}

/// Catches figures that Prometheus cannot read, and a figure that the handbook does not know.
#[test]
fn figures_are_told_and_documented() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path(), None);
    let client = service.client(Role::Viewer);
    client.jobs("").unwrap();
    let told = || client.text("/metrics").unwrap();
    wait_until(|| told().matches("# TYPE ").count() >= 4);
    let (text, handbook) = (told(), include_str!("../../../docs/operations.md"));
    for line in text.lines().filter_map(|line| line.strip_prefix("# TYPE ")) {
        let name = line.split(' ').next().unwrap();
        assert!(name.starts_with("pantaray_"), "{name}");
        assert!(handbook.contains(&format!("`{name}")), "{name} is not in docs/operations.md");
    }
}

/// Catches a panel or an alert that asks for a figure that nobody tells; after work was done, so that all are told.
pub fn deployed_queries_are_answered(client: &worker::client::Client) {
    let asked = [
        include_str!("../../../deploy/grafana/pantaray.json"),
        include_str!("../../../deploy/prometheus/alerts.yml"),
        include_str!("../../../deploy/kubernetes/worker.yaml"),
    ];
    let told = client.text("/metrics").unwrap();
    let mut names = std::collections::BTreeSet::new();
    for text in asked {
        let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
        names.extend(words.filter(|word| word.starts_with("pantaray_")));
    }
    assert!(names.len() > 12, "{names:?}");
    for name in names {
        let is_told = |line: &str| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' ']));
        assert!(told.lines().any(is_told), "`{name}` is asked for in deploy/, and not told");
    }
}
