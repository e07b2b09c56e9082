//! What a lease lets its worker reach, and what is made of its reports.

use std::time::Duration;

use protocol::storage::{ObjectRequest, UrlsRequest};
use protocol::work::{
    Claim, ClaimRequest, CompleteItem, CompleteRequest, LogRequest, Outcome, RegisterRequest, ReleaseRequest,
};
use protocol::{BatchState, Role, keys};
use worker::client::Client;
use worker::digest;

use super::on_both;
use super::people::wait_until;

fn register(client: &Client, name: &str) -> String {
    let (labels, memory_bytes, version) = (Vec::new(), 4 << 30, "test".into());
    let request = RegisterRequest { name: name.into(), labels, memory_bytes, version, protocol: 1 };
    client.register(&request).expect("registered").session
}

fn claim(client: &Client, session: &str) -> Claim {
    let request = ClaimRequest { session: session.into(), max: 1, wait_ms: 10_000, warm: Vec::new() };
    client.claim(&request).expect("an answer").expect("work")
}

fn url(
    client: &Client,
    claim: &Claim,
    session: &str,
    item: ObjectRequest,
) -> Result<protocol::storage::ObjectUrl, u16> {
    let request = UrlsRequest { session: session.into(), items: vec![item] };
    let reply = client.urls(&claim.lease, &request);
    reply.map(|mut reply| reply.urls.remove(0)).map_err(|error| error.status().expect("definite"))
}

/// Catches a lease that reaches what is not its own, bytes that are not what was announced, and a result that counts
/// though its object is not there.
#[test]
fn a_lease_reaches_its_own_objects_only() {
    on_both(|service, folder| {
        let people = service.client(Role::Submitter);
        let job = people.submit(&service.request(&people), "key").unwrap().jobs.remove(0);
        let (client, other) = (service.client(Role::Worker), service.client(Role::Worker));
        let (session, strange) = (register(&client, "w1"), register(&other, "w2"));
        let claimed = claim(&client, &session);
        let batch = claimed.batches[0];
        let put = |key: &str, bytes: &[u8]| {
            let content = digest::of_bytes(bytes);
            ObjectRequest::Put { key: key.into(), sha256: content.sha256, bytes: content.bytes }
        };
        let own = keys::result_folder(&job, claimed.pass, batch.fence);
        let get = |key: &str| ObjectRequest::Get { key: key.into() };

        // Only the lease's own keys, for reading and for writing, and only by its worker
        let scene = client.lease_scene(&claimed.lease, &session).unwrap();
        assert_eq!(scene.scene, super::SCENE);
        let asset = keys::asset(&scene.files["models/tent.obj"]);
        assert!(url(&client, &claimed, &session, get(&asset)).is_ok());
        assert_eq!(url(&client, &claimed, &session, get(&keys::asset(&"0".repeat(64)))), Err(403));
        assert_eq!(url(&client, &claimed, &session, get("pantaray.db")), Err(403));
        assert_eq!(url(&client, &claimed, &session, put(&asset, b"x")), Err(403));
        assert_eq!(url(&client, &claimed, &session, put(&format!("{own}/../../x"), b"x")), Err(403));
        let next = keys::result_folder(&job, claimed.pass, batch.fence + 1);
        assert_eq!(url(&client, &claimed, &session, put(&format!("{next}/x"), b"x")), Err(403));
        assert_eq!(url(&other, &claimed, &strange, get(&asset)), Err(410));
        assert_eq!(url(&other, &claimed, &session, get(&asset)), Err(410));

        // Bytes are what was announced, or nothing is there
        let key = format!("{own}/a b");
        let place = url(&client, &claimed, &session, put(&key, b"right")).unwrap();
        let file = folder.join("upload");
        std::fs::write(&file, b"wrong").unwrap();
        assert_eq!(client.upload(&place, &file).unwrap_err().status(), Some(422));
        assert!(!folder.join("storage").join(&key).exists());
        std::fs::write(&file, b"right").unwrap();
        client.upload(&place, &file).unwrap();
        assert_eq!(std::fs::read(folder.join("storage").join(&key)).unwrap(), b"right");

        // The log is kept, and a result without its object is a failure
        let (text, fence) = ("a line".into(), batch.fence);
        let log = LogRequest { session: session.clone(), batch: batch.batch, fence, text };
        client.add_log(&claimed.lease, &log).unwrap();
        let path = format!("/v1/jobs/{job}/passes/{}/batches/{}/log", claimed.pass, batch.batch);
        assert_eq!(people.text(&path).unwrap(), "a line\n");
        let outcome = Outcome::Done { sha256: "0".repeat(64), bytes: 5, result: None };
        let item = CompleteItem { batch: batch.batch, fence, elapsed_ms: 1, traced: None, outcome };
        let report = CompleteRequest {
            session: session.clone(),
            pass: claimed.pass,
            device: String::new(),
            items: vec![item],
        };
        assert!(!client.complete(&claimed.lease, &report).unwrap().lease_live);
        let failures = people.failures(&job).unwrap();
        assert_eq!(failures.len(), 1);
        assert!(failures[0].message.contains("index.json") && failures[0].message.contains("is not there"));
        assert_eq!(url(&client, &claimed, &session, get(&asset)), Err(410));

        // Given back, it goes to whoever asks next, under another fence
        let claimed = claim(&other, &strange);
        assert_eq!(claimed.batches[0].fence, fence + 1);
        let release = ReleaseRequest { session: strange.clone(), batches: Vec::new() };
        other.release(&claimed.lease, &release).unwrap();
        let state = || {
            let path = format!("/v1/jobs/{job}/passes/{}/batches", claimed.pass);
            let page: protocol::job::BatchPage = people.get(&path).unwrap();
            page.batches[0].state
        };
        assert_eq!(state(), BatchState::Ready);

        // A process that registers again has no leases any more
        let claimed = claim(&other, &strange);
        let renewed = register(&other, "w2");
        let request = ClaimRequest { session: strange.clone(), max: 1, wait_ms: 0, warm: Vec::new() };
        wait_until(|| other.claim(&request).is_err_and(|error| error.status() == Some(410)));
        assert_eq!(url(&other, &claimed, &renewed, get(&asset)), Err(410));
        assert_eq!(state(), BatchState::Ready);
    });
}

/// Catches a claim that does not wait, or that is not woken when work comes.
#[test]
fn a_claim_waits_for_work() {
    on_both(|service, _| {
        let (people, client) = (service.client(Role::Submitter), service.client(Role::Worker));
        let session = register(&client, "w1");
        let request = service.request(&people);
        let start = std::time::Instant::now();
        let waiting = std::thread::spawn(move || {
            claim(&client, &session);
            start.elapsed()
        });
        std::thread::sleep(Duration::from_millis(600));
        people.submit(&request, "key").unwrap();
        let waited = waiting.join().expect("a claim");
        assert!((500..5_000).contains(&waited.as_millis()), "{waited:?}");
    });
}
