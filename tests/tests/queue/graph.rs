//! A job's way from submission to publication.

use std::sync::Arc;

use protocol::work::PassResult;
use protocol::{JobState, PassKind, PassState};
use server::db::list::JobList;

use crate::{Queue, all_done, built, import, new_job, on_both};

on_both! {
    /// Catches a job that does not come to its end, or publishes something else than its merges found.
    a_job_comes_to_its_end
    /// Catches a brick map that two racing jobs both build.
    racing_jobs_share_a_brick_map
    /// Catches a job that waits for ever for a brick map whose builder was cancelled.
    an_heir_builds_what_a_cancelled_job_has_not
    /// Catches a submission that is carried out twice because its answer was lost.
    the_same_request_makes_one_job
    /// Catches a job that runs before what it depends on.
    dependencies_hold_jobs_back
    /// Catches a large pass whose batches are missing, doubled, or claimable before all of them are there.
    large_passes_are_created_in_pieces
}

async fn a_job_comes_to_its_end(queue: Queue) {
    let bake = queue.baking("j", 5).await;
    assert_eq!(queue.store.job("j").await.unwrap().state, JobState::Running);
    while let Some(granted) = queue.claim("w1", bake.pass, 0, 2).await {
        queue.complete("w1", bake.pass, &granted, &all_done(&granted)).await;
    }
    queue.advance("j").await;
    let result = PassResult::Merge { points: 50, baked: 50, bytes: 1234, preview: false, picture: false };
    let merge = queue.pass("j", PassKind::Merge).await;
    let granted = queue.claim("w1", merge, 0, 1).await.unwrap();
    let mut items = all_done(&granted);
    if let protocol::work::Outcome::Done { result: r, .. } = &mut items[0].outcome {
        *r = Some(result.clone());
    }
    assert!(queue.complete("w1", merge, &granted, &items).await.advances);
    let publication = queue.advance("j").await.expect("to publish");
    let key = protocol::keys::result_folder("j", merge, 1);
    assert_eq!(publication.merges, [("set".into(), key, "ab".repeat(32), result)]);
    assert!(!publication.incomplete);
    queue.store.published(&publication, queue.now).await.unwrap();
    let job = queue.store.job("j").await.unwrap();
    assert_eq!((job.state, job.batches.done), (JobState::Succeeded, 5));
    let kinds: Vec<String> =
        queue.store.events(0, 100, None).await.unwrap().into_iter().map(|event| event.kind).collect();
    assert_eq!(kinds, ["job.submitted", "job.running", "job.succeeded"]);
}

async fn racing_jobs_share_a_brick_map(queue: Queue) {
    for job in ["a", "b"] {
        queue.submit(job).await;
        queue.advance(job).await;
        queue.do_pass(job, PassKind::Import, Some(import(&["set"], "map"))).await;
    }
    let second = queue.pass("b", PassKind::Build).await;
    assert!(queue.claim("w1", second, 0, 1).await.is_none(), "the first job builds it");
    queue.do_pass("a", PassKind::Build, Some(built())).await;
    let state = |job| {
        let store = queue.store.clone();
        async move {
            let passes = store.pass_details(job).await.unwrap();
            let build = passes.into_iter().find(|pass| pass.kind == PassKind::Build).unwrap();
            (build.state, build.reused)
        }
    };
    assert_eq!(state("a").await, (PassState::Done, false));
    assert_eq!(state("b").await, (PassState::Done, true));
    queue.submit("c").await;
    queue.advance("c").await;
    queue.do_pass("c", PassKind::Import, Some(import(&["set"], "map"))).await;
    assert_eq!(state("c").await, (PassState::Done, true), "it is there already");
}

async fn an_heir_builds_what_a_cancelled_job_has_not(queue: Queue) {
    for job in ["a", "b"] {
        queue.submit(job).await;
        queue.advance(job).await;
        queue.do_pass(job, PassKind::Import, Some(import(&["set"], "map"))).await;
    }
    queue.store.cancel("a", "tester", queue.now).await.unwrap();
    queue.advance("a").await;
    assert_eq!(queue.store.job("a").await.unwrap().state, JobState::Cancelled);
    queue.do_pass("b", PassKind::Build, Some(built())).await;
    while queue.store.sweep_cancelled().await.unwrap() {}
}

async fn the_same_request_makes_one_job(queue: Queue) {
    let submits = ["a", "b", "c", "d"].map(|id| {
        let store = queue.store.clone();
        tokio::spawn(async move { store.submit(&[new_job(id, Some("key"))], 5).await.unwrap() })
    });
    let mut made = Vec::new();
    for submit in submits {
        made.push(submit.await.unwrap());
    }
    assert!(made.windows(2).all(|pair| pair[0] == pair[1]), "{made:?}");
    let mut other = new_job("e", Some("key"));
    other.request_sha256 = "another".into();
    assert!(queue.store.submit(&[other], 5).await.is_err());
    assert_eq!(queue.store.jobs(&JobList { limit: 10, ..JobList::default() }).await.unwrap().jobs.len(), 1);
}

async fn dependencies_hold_jobs_back(queue: Queue) {
    queue.submit("a").await;
    let mut job = new_job("b", None);
    Arc::make_mut(&mut job.request).depends_on = vec!["a".into()];
    queue.store.submit(&[job.clone()], queue.now).await.unwrap();
    queue.advance("b").await;
    assert_eq!(queue.store.pass_details("b").await.unwrap().len(), 0);
    let publication = server::db::graph::Publication {
        job: "a".into(),
        name: "a".into(),
        incomplete: false,
        merges: vec![],
    };
    let advance = queue.store.published(&publication, queue.now).await.unwrap();
    assert_eq!(advance.others, ["b"]);
    queue.advance("b").await;
    assert_eq!(queue.store.pass_details("b").await.unwrap().len(), 1);
    job.id = "c".into();
    Arc::make_mut(&mut job.request).depends_on = vec!["nowhere".into()];
    assert!(queue.store.submit(&[job], queue.now).await.is_err());
}

async fn large_passes_are_created_in_pieces(queue: Queue) {
    let bake = queue.baking("j", 50_001).await;
    assert_eq!(bake.segments, 98);
    let job = queue.store.job("j").await.unwrap();
    assert_eq!(job.batches.ready, 50_001);
    let last = queue.claim("w1", bake.pass, 97, 600).await.unwrap();
    assert_eq!(last.batches.last().unwrap().batch, 50_000);
    queue.store.cancel("j", "tester", queue.now).await.unwrap();
    while queue.store.sweep_cancelled().await.unwrap() {}
    queue.advance("j").await;
    assert_eq!(queue.store.job("j").await.unwrap().state, JobState::Cancelling, "some are leased");
    let completion = queue.complete("w1", bake.pass, &last, &all_done(&last)[..60]).await;
    assert_eq!(completion.verdicts[0], protocol::work::Verdict::Cancelled);
    queue.store.release(&last.lease, "w1", &[], &queue.around(1)).await.unwrap();
    queue.advance("j").await;
    assert_eq!(queue.store.job("j").await.unwrap().state, JobState::Cancelled);
}
