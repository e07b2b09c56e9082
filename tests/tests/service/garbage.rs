//! What is removed, when, and what is not.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use protocol::gc::{DeletePreview, GcKind, GcReport};
use protocol::work::{Claim, ClaimRequest, RegisterRequest, ReleaseRequest};
use protocol::{JobState, PassKind, Role, keys};
use serde_json::json;
use worker::client::Client;
use worker::run::run;

use super::bakes::{options, wait_for};
use super::{Service, ask, on_both};

const HOUR_MS: i64 = 3_600_000;
const DAY_MS: i64 = 24 * HOUR_MS;

fn files(folder: &Path) -> BTreeSet<String> {
    let (mut found, mut folders) = (BTreeSet::new(), vec![folder.join("storage")]);
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).into_iter().flatten() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.strip_prefix(folder.join("storage")).unwrap().to_str().unwrap().to_owned());
            }
        }
    }
    found
}

fn collect(client: &Client, dry_run: bool) -> GcReport {
    let report: GcReport = client.post("/v1/gc", &json!({ "dry_run": dry_run }), Duration::ZERO).unwrap();
    assert!(!report.more, "{report:?}");
    report
}

/// Claims as a worker that gives back what it got.
fn claim_and_give_back(client: &Client) -> Claim {
    let (labels, memory_bytes, version) = (Vec::new(), 4 << 30, "test".into());
    let register = RegisterRequest { name: "faint".into(), labels, memory_bytes, version, protocol: 1 };
    let session = client.register(&register).unwrap().session;
    let request = ClaimRequest { session: session.clone(), max: 1, wait_ms: 10_000, warm: Vec::new() };
    let claim = client.claim(&request).unwrap().expect("work");
    client.release(&claim.lease, &ReleaseRequest { session, batches: Vec::new() }).unwrap();
    claim
}

fn work_until(service: &Service, people: &Client, folder: &Path, jobs: &[String]) {
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let options = options(service.client(Role::Worker), "w", folder);
        let worker = scope.spawn(|| run(&{ options }, &stop));
        wait_for(people, jobs);
        stop.store(true, Ordering::SeqCst);
        worker.join().unwrap().unwrap();
    });
}

/// Catches a collection that takes what counts, or what a person may still need, or leaves what nobody needs; a preview
/// that removes or says something else than what then happens.
#[test]
fn what_ends_goes_in_its_time() {
    on_both(|service, folder| {
        let (people, admin) = (service.client(Role::Submitter), service.client(Role::Admin));
        let request = service.request(&people);
        let job = people.submit(&request, "key").unwrap().jobs.remove(0);
        let faint = claim_and_give_back(&service.client(Role::Worker));
        // What the faint worker left of its claim
        let left = format!("{}/half", keys::result_folder(&job, faint.pass, faint.batches[0].fence));
        let path = folder.join("storage").join(&left);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, b"half").unwrap();
        work_until(service, &people, folder, std::slice::from_ref(&job));
        let summary = people.job(&job).unwrap().summary;
        assert_eq!(summary.state, JobState::Succeeded);
        let manifest = people.manifest(&job).unwrap();
        let whole = files(folder);
        let wind = |ms| service.coordinator.clock.advance_ms(ms);
        let counts = |report: &GcReport, kind| report.count(kind);

        // Marked, then removed after a day; what counts stays
        assert_eq!(collect(&admin, false).items, []);
        assert_eq!(files(folder), whole);
        wind(25 * HOUR_MS);
        let preview = collect(&admin, true);
        assert_eq!((counts(&preview, GcKind::Attempt), files(folder) == whole), (1, true));
        assert_eq!(collect(&admin, false).items, preview.items);
        let expected: BTreeSet<String> = whole.iter().filter(|key| **key != left).cloned().collect();
        assert_eq!(files(folder), expected);

        // After its retention a job has its outputs, logs and counts; the map and the upload go with the last job on them
        wind(14 * DAY_MS);
        let preview = collect(&admin, true);
        assert_eq!(files(folder), expected);
        let done = collect(&admin, false);
        for kind in [GcKind::Batch, GcKind::Work] {
            assert_eq!(counts(&done, kind), counts(&preview, kind), "{kind:?}");
            assert!(counts(&done, kind) > 0, "{kind:?}");
        }
        assert!(counts(&done, GcKind::BrickMap) > 0 && counts(&done, GcKind::Asset) == 1, "{done:?}");
        let kept = files(folder);
        // Streams, and what of them is for the eye
        let folders = manifest.outputs.iter().map(|output| output.key.rsplit_once('/').unwrap().0);
        let folders: Vec<String> = folders.map(|folder| format!("{folder}/")).collect();
        let is_output = |key: &&String| folders.iter().any(|folder| key.starts_with(folder));
        let outputs: BTreeSet<String> = whole.iter().filter(is_output).cloned().collect();
        for output in &manifest.outputs {
            let beside = |ending: &str| outputs.contains(&output.key.replace(".mgs", ending));
            assert!(output.preview && output.picture && beside(".preview") && beside(".png"), "{outputs:?}");
        }
        let is_kept =
            |key: &String| outputs.contains(key) || key.contains("/logs/") || *key == keys::manifest(&job);
        assert!(kept.iter().all(is_kept) && outputs.is_subset(&kept), "{kept:?}");
        let now = people.job(&job).unwrap();
        assert_eq!((now.summary.batches, now.summary.pruned), (summary.batches, true));
        assert_eq!(now.passes.iter().map(|pass| pass.batches.done).min(), Some(1), "{:?}", now.passes);
        let url = people.own(&format!("/v1/jobs/{job}/outputs/hill.mgs"));
        people.download(&url, &folder.join("fetched"), 1 << 30).unwrap();
        for action in ["retry", "resubmit"] {
            let (url, token) =
                (format!("{}/v1/jobs/{job}/{action}", service.url), service.token(Role::Submitter, None));
            assert_eq!(ask(&url, "POST", Some(&token), Some(json!({}))).0, 409, "{action}");
        }

        // Logs after a month; outputs where the project says so
        wind(16 * DAY_MS);
        assert!(counts(&collect(&admin, false), GcKind::Log) > 0);
        assert!(files(folder).is_subset(&outputs.iter().cloned().chain([keys::manifest(&job)]).collect()));
        let project = json!({ "name": "default", "share": 100, "outputs_days": 40 });
        let (url, token) = (format!("{}/v1/projects/default", service.url), service.token(Role::Admin, None));
        assert_eq!(ask(&url, "PUT", Some(&token), Some(project)).0, 200);
        assert_eq!(counts(&collect(&admin, false), GcKind::Output), 0);
        wind(10 * DAY_MS);
        assert_eq!(counts(&collect(&admin, false), GcKind::Output), outputs.len() as u64 + 1);
        assert_eq!(files(folder), BTreeSet::new());
        assert_eq!(people.job(&job).unwrap().summary.batches, summary.batches);
        consistent(service);
    });
}

fn consistent(service: &Service) {
    service.runtime.block_on(async {
        assert_eq!(service.coordinator.store.drift().await.unwrap(), []);
        assert_eq!(service.coordinator.store.orphans().await.unwrap(), 0);
    });
}

/// Catches a map or upload that is taken from a job that needs it, what was cut off and stays for ever, and a job that is
/// deleted while others wait for it, or is not gone when it is.
#[test]
fn what_is_needed_stays_and_what_is_deleted_goes() {
    on_both(|service, folder| {
        let (people, admin) = (service.client(Role::Submitter), service.client(Role::Admin));
        let request = service.request(&people);
        let first = people.submit(&request, "1").unwrap().jobs.remove(0);
        work_until(service, &people, folder, std::slice::from_ref(&first));
        let mut after = request.clone();
        (after.paused, after.depends_on) = (true, vec![first.clone()]);
        let second = people.submit(&after, "2").unwrap().jobs.remove(0);
        // What cut-off submissions, builds and uploads leave
        let (asset, map) = (keys::asset(&"ab".repeat(32)), keys::brick_map(&"cd".repeat(16)));
        let scene = keys::scene("01hf0000000000000000000000");
        for key in [&asset, &format!("{map}/bricks"), &scene] {
            let path = folder.join("storage").join(key);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"cut off").unwrap();
        }

        // The second job refers to the upload, whose time is over otherwise; and to no map before it is imported
        service.coordinator.clock.advance_ms(15 * DAY_MS);
        let report = collect(&admin, false);
        assert_eq!(report.count(GcKind::Asset), 1, "only the one that nobody knows: {report:?}");
        assert_eq!(report.count(GcKind::Orphan), 1);
        let kept = files(folder);
        assert!(![&asset, &format!("{map}/bricks"), &scene].iter().any(|key| kept.contains(*key)));
        assert!(kept.contains(&keys::asset(&request.files["models/tent.obj"])));
        assert!(!kept.iter().any(|key| key.starts_with("brickmaps/")), "{kept:?}");

        // The second job builds anew what is gone
        people.act(&second, "resume").unwrap();
        work_until(service, &people, folder, std::slice::from_ref(&second));
        assert_eq!(people.job(&second).unwrap().summary.state, JobState::Succeeded);
        let built = |job: &str| {
            let passes = people.job(job).unwrap().passes;
            passes.iter().filter(|pass| pass.kind == PassKind::Build && !pass.reused).count()
        };
        assert_eq!(built(&second), 2);

        // Deleted: hidden at once, gone with the next collection
        let third = people.submit(&after, "3").unwrap().jobs.remove(0);
        let url = |path: &str| format!("{}/v1/jobs/{path}", service.url);
        let token = service.token(Role::Submitter, None);
        assert_eq!(ask(&url(&third), "DELETE", Some(&token), None).0, 409, "it has not ended");
        let preview: DeletePreview = people.get(&format!("/v1/jobs/{second}/delete-preview")).unwrap();
        assert_eq!((preview.refused, preview.outputs.len(), preview.brick_maps.len()), (None, 2, 2));
        assert_eq!(ask(&url(&second), "DELETE", Some(&token), None).0, 204);
        assert_eq!(ask(&url(&second), "GET", Some(&token), None).0, 404);
        let report = collect(&admin, false);
        for kind in [GcKind::Batch, GcKind::Work, GcKind::Output, GcKind::Job] {
            assert_eq!(report.count(kind), preview.report.count(kind), "{kind:?}");
        }
        assert!(!files(folder).iter().any(|key| key.starts_with(&keys::job(&second))));
        assert_eq!(ask(&url(&first), "DELETE", Some(&token), None).0, 204);
        collect(&admin, false);
        assert_eq!(people.jobs("").unwrap().jobs.iter().map(|job| &job.id).collect::<Vec<_>>(), [&third]);

        // An upload that is removed can be sent again
        assert_eq!(people.act(&third, "cancel").unwrap().id, third);
        wait_for(&people, std::slice::from_ref(&third));
        assert_eq!(ask(&url(&third), "DELETE", Some(&token), None).0, 204);
        service.coordinator.clock.advance_ms(2 * DAY_MS);
        collect(&admin, false);
        assert_eq!(files(folder), BTreeSet::new());
        people.submit(&service.request(&people), "4").unwrap();
        consistent(service);
    });
}
