//! Scenes in, decorated streams out, by real workers.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use engine::bake::{BakeOptions, Control, Quiet, bake};
use engine::preview::Preview;
use protocol::overview::Provisional;
use protocol::{JobState, PassKind, Role};
use worker::client::Client;
use worker::run::{Options, run};

use super::people::wait_until;
use super::{SCENE, TENT, on_both};

fn machine() -> BakeOptions {
    BakeOptions { memory_bytes: 256 << 20, threads: 1, ..BakeOptions::default() }
}

pub fn options(client: Client, name: &str, folder: &Path) -> Options {
    Options {
        client,
        name: name.into(),
        labels: Vec::new(),
        cache: folder.join(name),
        cache_bytes: 1 << 30,
        spool_bytes: 64 << 20,
        roots: Default::default(),
        machine: machine(),
        grace: Duration::from_secs(1),
    }
}

/// What one process makes of the scene.
pub fn quiet_bake(folder: &Path) {
    quiet_bake_of(folder, SCENE);
}

/// What one process makes of a scene.
pub fn quiet_bake_of(folder: &Path, scene: &str) {
    std::fs::create_dir_all(folder.join("models")).unwrap();
    std::fs::write(folder.join("scene.xml"), scene).unwrap();
    std::fs::write(folder.join("models/tent.obj"), TENT).unwrap();
    let scene = engine::scene::load(&folder.join("scene.xml")).unwrap();
    let control = Control { progress: &Quiet, cancel: &AtomicBool::new(false) };
    bake(&scene, &machine(), &folder.join("baked"), control).unwrap();
}

/// Catches a farm whose result is not that of one process, a brick map that two racing jobs build twice, a result that
/// cannot be had in part, and events that are lost or come again.
#[test]
fn a_farm_bakes_what_one_process_bakes() {
    on_both(|service, folder| {
        quiet_bake(folder);
        let people = service.client(Role::Submitter);
        let request = service.request(&people);
        let stop = AtomicBool::new(false);
        let jobs = std::thread::scope(|scope| {
            let workers: Vec<_> = ["w1", "w2"]
                .map(|name| options(service.client(Role::Worker), name, folder))
                .into_iter()
                .map(|options| scope.spawn(|| run(&{ options }, &stop)))
                .collect();
            let jobs = ["one", "two"].map(|key| people.submit(&request, key).unwrap().jobs.remove(0));
            wait_for(&people, &jobs);
            stop.store(true, Ordering::SeqCst);
            for worker in workers {
                worker.join().unwrap().unwrap();
            }
            jobs
        });

        // Each map is built once, and both jobs have the bytes of one process
        let mut built = 0;
        for job in &jobs {
            let detail = people.job(job).unwrap();
            assert_eq!(detail.summary.state, JobState::Succeeded, "{detail:?}");
            built += detail.passes.iter().filter(|p| p.kind == PassKind::Build && !p.reused).count();
            let manifest = people.manifest(job).unwrap();
            assert_eq!(manifest.outputs.len(), 2);
            for output in &manifest.outputs {
                let wanted = std::fs::read(folder.join("baked").join(&output.name)).unwrap();
                let path = folder.join("fetched");
                let url = people.own(&format!("/v1/jobs/{job}/outputs/{}", output.name));
                let fetched = people.download(&url, &path, 1 << 30).unwrap();
                assert_eq!(fetched.sha256, output.sha256);
                assert!(std::fs::read(&path).unwrap() == wanted, "{} differs", output.name);
                let mut part = url.clone();
                part.headers.insert("range".into(), "bytes=10-29".into());
                people.download(&part, &path, 1 << 30).unwrap();
                assert_eq!(std::fs::read(&path).unwrap(), wanted[10..30]);
                see(&people, job, output, &path);
            }
        }
        assert_eq!(built, 2, "two maps, each built once");

        // Events come in order, each once, and again from where a listener left off
        let all = events(service, &jobs[0], 0);
        let kinds: Vec<&str> = all.iter().map(|(_, kind)| kind.as_str()).collect();
        assert_eq!(kinds, ["job.submitted", "job.running", "job.succeeded"]);
        assert_eq!(events(service, &jobs[0], all[1].0), all[2..]);
        super::life::deployed_queries_are_answered(&people);
        service.runtime.block_on(async {
            assert_eq!(service.coordinator.store.drift().await.unwrap(), []);
            assert_eq!(service.coordinator.store.orphans().await.unwrap(), 0);
        });
    });
}

/// Catches a result without preview or picture, and a preview that is not of all its points.
fn see(people: &Client, job: &str, output: &protocol::job::Output, path: &Path) {
    assert!(output.preview && output.picture, "{output:?}");
    let url = |what: &str| people.own(&format!("/v1/jobs/{job}/outputs/{}/{what}", output.name));
    people.download(&url("preview"), path, 1 << 30).unwrap();
    let mut preview = Preview::open(path).unwrap();
    assert_eq!((preview.header.points, preview.header.baked), (output.baked, output.baked));
    let mut bytes = Vec::new();
    (0..preview.nodes.len()).for_each(|node| preview.read(node, &mut bytes).unwrap());
    for url in [url("picture"), people.own(&format!("/v1/jobs/{job}/picture"))] {
        people.download(&url, path, 1 << 30).unwrap();
        assert_eq!(std::fs::read(path).unwrap()[..4], *b"\x89PNG");
    }
}

pub fn wait_for(client: &Client, jobs: &[String]) {
    // A minute and a half is many times what it takes
    for _ in 0..450 {
        let is_over = |job: &String| client.job(job).unwrap().summary.state.is_final();
        if jobs.iter().all(is_over) {
            return;
        }
        std::thread::sleep(Duration::from_millis(200));
    }
    panic!("the jobs have no end: {:?}", jobs.iter().map(|job| client.job(job)).collect::<Vec<_>>());
}

/// The events of a job after an event: number and kind, until the job's last.
fn events(service: &super::Service, job: &str, after: i64) -> Vec<(i64, String)> {
    use std::io::BufRead;
    let token = service.token(Role::Viewer, None);
    let reply = ureq::get(format!("{}/v1/events?job={job}", service.url))
        .header("authorization", format!("Bearer {token}"))
        .header("last-event-id", after.to_string())
        .call()
        .unwrap();
    let (mut found, mut id) = (Vec::new(), 0);
    for line in std::io::BufReader::new(reply.into_body().into_reader()).lines() {
        let line = line.unwrap();
        if let Some(number) = line.strip_prefix("id: ") {
            id = number.parse().unwrap();
        }
        if let Some(data) = line.strip_prefix("data: ") {
            let event: protocol::events::Event = serde_json::from_str(data).unwrap();
            assert!(id == 0 || event.id >= id, "{event:?}");
            found.push((event.id, event.kind.clone()));
            if event.kind == "job.succeeded" {
                break;
            }
        }
    }
    found
}

/// Catches a bake that is seen otherwise while it is under way than when it is done: other points, numbers in another order,
/// parts that are matched with the points of other batches.
#[test]
fn a_bake_is_seen_before_it_is_merged() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let service = super::Service::start(folder, None);
    let people = service.client(Role::Submitter);
    let mut request = service.request(&people);
    // Batches of 4,096 points, of which some are left out
    request.settings.samples = Some(256);
    request.settings.max_points = Some(9_000);
    let job = people.submit(&request, "one").unwrap().jobs.remove(0);
    let sofar = || -> Vec<Provisional> {
        serde_json::from_str(&people.text(&format!("/v1/jobs/{job}/provisional")).unwrap()).unwrap()
    };
    assert_eq!(sofar(), [], "nothing is baked yet");
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let options = options(service.client(Role::Worker), "w1", folder);
        let worker = scope.spawn(|| run(&{ options }, &stop));
        wait_for(&people, std::slice::from_ref(&job));
        stop.store(true, Ordering::SeqCst);
        worker.join().unwrap().unwrap();
    });
    let found = sofar();
    assert_eq!(found.len(), 2, "{found:?}");
    for Provisional { name, pass, done, batches, points, made_at } in found {
        assert_eq!((done, points > 0), (batches, true), "{name}");
        let preview = |query: &str| {
            let path = folder.join("fetched.preview");
            let url = people.own(&format!("/v1/jobs/{job}/outputs/{name}/preview{query}"));
            people.download(&url, &path, 1 << 30).unwrap();
            let mut preview = Preview::open(&path).unwrap();
            let mut root = Vec::new();
            preview.read(0, &mut root).unwrap();
            (preview.header, root)
        };
        let (before, first) = preview(&format!("?pass={pass}&made={made_at}"));
        let (after, second) = preview("");
        assert_eq!((before.points, before.points), (points, after.points), "{name}");
        assert_eq!((before.bands, before.weight, before.domain), (after.bands, after.weight, after.domain));
        // The same points in the same order; positions are rounded from another corner, and a plan knows no albedo
        let numbers = |root: &[u8]| -> Vec<Vec<u8>> {
            root.chunks_exact(before.record_bytes())
                .map(|record| [&record[6..10], &record[14..]].concat())
                .collect()
        };
        assert_eq!(numbers(&first), numbers(&second), "{name}");
        assert!((before.corner - after.corner).length() < 1e-4 * after.edge, "{before:?} {after:?}");
    }
}

/// Catches a job that waits for ever after the job before it is done.
#[test]
fn a_job_follows_the_one_that_it_needs() {
    on_both(|service, folder| {
        let people = service.client(Role::Submitter);
        let request = service.request(&people);
        let first = people.submit(&request, "1").unwrap().jobs.remove(0);
        let mut after = request.clone();
        after.depends_on = vec![first.clone()];
        let second = people.submit(&after, "2").unwrap().jobs.remove(0);
        let stop = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let options = options(service.client(Role::Worker), "w", folder);
            let worker = scope.spawn(|| run(&{ options }, &stop));
            wait_for(&people, &[first.clone(), second.clone()]);
            stop.store(true, Ordering::SeqCst);
            worker.join().unwrap().unwrap();
        });
        let ends = [&first, &second].map(|job| people.job(job).unwrap().summary.ended_at);
        assert!(ends[0] < ends[1], "{ends:?}");
        wait_until(|| people.job(&second).unwrap().summary.state == JobState::Succeeded);
    });
}
