//! What people do to jobs.

use protocol::job::{JobPatch, ResubmitRequest, Submitted};
use protocol::{JobState, Role, WaitReason};
use serde_json::json;

use super::{SCENE, on_both};

fn refused<T: std::fmt::Debug>(result: worker::Result<T>, status: u16) -> String {
    let error = result.expect_err("refused");
    assert_eq!(error.status(), Some(status), "{error}");
    error.to_string()
}

/// Catches a repeated submission that bakes twice, and a key that stands for two requests.
#[test]
fn a_repeated_submission_makes_no_second_job() {
    on_both(|service, _| {
        let client = service.client(Role::Submitter);
        let request = service.request(&client);
        let first = client.submit(&request, "a key").unwrap();
        let again = client.submit(&request, "a key").unwrap();
        assert_eq!(again, Submitted { repeated: true, ..first.clone() });
        let mut other = request.clone();
        other.name = "another".into();
        refused(client.submit(&other, "a key"), 409);
        assert_ne!(client.submit(&request, "b").unwrap().jobs, first.jobs);
        assert_eq!(client.jobs("").unwrap().jobs.len(), 2);
    });
}

/// Catches a scene that is refused without its place, reaches outside, or names files that nobody uploaded; and a dry run
/// that leaves something behind.
#[test]
fn a_request_is_checked_before_anything_is_stored() {
    on_both(|service, folder| {
        let client = service.client(Role::Submitter);
        let good = service.request(&client);
        let estimate: protocol::job::Estimate =
            client.post("/v1/jobs/validate", &good, std::time::Duration::ZERO).unwrap();
        let names: Vec<&str> = estimate.sets.iter().map(|set| set.name.as_str()).collect();
        assert_eq!((names, estimate.input_bytes), (vec!["hill", "tent"], super::TENT.len() as u64));
        // 16 rays a point: 65,536 points a batch; what a file holds is not known before it is imported
        let known: Vec<_> = estimate.sets.iter().map(|set| (set.points, set.batches)).collect();
        assert_eq!(known, [(Some(22_755), Some(1)), (None, None)]);
        assert_eq!((estimate.batches, estimate.worker_seconds), (None, None));
        let refuse = |change: &dyn Fn(&mut protocol::job::JobRequest), status| {
            let mut request = good.clone();
            change(&mut request);
            refused(client.submit(&request, "key"), status)
        };
        let message =
            refuse(&|r| r.scene = SCENE.replace("procedural=\"terrain\"", "procedural=\"moon\""), 422);
        assert!(message.contains("scene.xml:7:") && !message.contains("/tmp"), "{message}");
        let message = refuse(&|r| r.scene = SCENE.replace("models/tent.obj", "../tent.obj"), 422);
        assert!(message.contains("leads out"), "{message}");
        refuse(&|r| r.scene = SCENE.replace("models/tent.obj", "/etc/passwd.obj"), 422);
        refuse(&|r| r.files.clear(), 422);
        refuse(&|r| drop(r.files.insert("b.obj".into(), "0".repeat(64))), 409);
        refuse(&|r| drop(r.files.insert("../b.obj".into(), "0".repeat(64))), 422);
        refuse(&|r| r.settings.lod = Some("none at all".into()), 422);
        refuse(&|r| r.priority = 101, 422);
        refuse(&|r| r.frames = Some((1, 1_000_000)), 422);
        refuse(&|r| r.depends_on = vec!["nobody".into()], 404);
        refuse(&|r| r.project = "nowhere".into(), 409);
        assert_eq!(client.jobs("").unwrap().jobs, []);
        let jobs = std::fs::read_dir(folder.join("storage/jobs")).map(Iterator::count).unwrap_or_default();
        assert_eq!(jobs, 0, "a refused submission leaves its scene behind");
    });
}

/// Catches a job that cannot be paused, changed or cancelled, one that comes back to life, and an edit that is lost.
#[test]
fn jobs_are_paused_changed_cancelled_and_submitted_again() {
    on_both(|service, _| {
        let client = service.client(Role::Submitter);
        let request = service.request(&client);
        let job = client.submit(&request, "1").unwrap().jobs.remove(0);
        assert!(client.act(&job, "pause").unwrap().paused);
        wait_until(|| client.job(&job).unwrap().waiting == WaitReason::Paused);
        let patch = JobPatch { priority: Some(9), ..JobPatch::default() };
        assert_eq!(client.change_job(&job, &patch).unwrap().priority, 9);
        assert!(!client.act(&job, "resume").unwrap().paused);
        wait_until(|| client.job(&job).unwrap().waiting == WaitReason::NoWorker);

        let mut after = request.clone();
        after.depends_on = vec![job.clone()];
        let blocked = client.submit(&after, "2").unwrap().jobs.remove(0);
        assert_eq!(client.job(&blocked).unwrap().summary.state, JobState::Blocked);

        client.act(&job, "cancel").unwrap();
        wait_until(|| client.job(&job).unwrap().summary.state == JobState::Cancelled);
        refused(client.act(&job, "cancel"), 409);
        refused(client.act(&job, "resume"), 409);
        refused(client.change_batches(&job, "retry", &Default::default()), 409);

        let edits = ResubmitRequest { name: Some("again".into()), ..Default::default() };
        let path = format!("/v1/jobs/{job}/resubmit");
        let again: Submitted = client.post_once(&path, &edits, "3").unwrap();
        let again = client.job(&again.jobs[0]).unwrap();
        assert_eq!((again.summary.name.as_str(), again.resubmit_of), ("again", Some(job)));
        assert_eq!(again.summary.priority, 9);
    });
}

/// Catches frames that are left out or doubled, and a page that repeats or skips jobs.
#[test]
fn a_range_of_frames_is_a_job_for_each() {
    on_both(|service, _| {
        let client = service.client(Role::Submitter);
        let mut request = service.request(&client);
        request.frames = Some((-1, 3));
        let submitted = client.submit(&request, "frames").unwrap();
        let frames: Vec<Option<i64>> =
            submitted.jobs.iter().map(|job| client.job(job).unwrap().summary.frame).collect();
        assert_eq!(frames, (-1..=3).map(Some).collect::<Vec<_>>());
        let (mut seen, mut query) = (Vec::new(), "?limit=2".to_string());
        while let Some(next) = {
            let page = client.jobs(&query).unwrap();
            seen.extend(page.jobs.into_iter().map(|job| job.id));
            page.next
        } {
            query = format!("?limit=2&after={next}");
        }
        seen.reverse();
        assert_eq!(seen, submitted.jobs);
        let (status, problem) = super::ask(
            &format!("{}/v1/jobs?state=tired", service.url),
            "GET",
            Some(&service.token(Role::Viewer, None)),
            None,
        );
        assert_eq!((status, &problem["code"]), (422, &json!("invalid")));
    });
}

/// Waits, up to ten seconds, until something is so.
pub fn wait_until(is_so: impl Fn() -> bool) {
    let start = std::time::Instant::now();
    while !is_so() {
        assert!(start.elapsed().as_secs() < 10, "it never comes to be");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}
