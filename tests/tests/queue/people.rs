//! What people do to jobs, and see of them.

use protocol::job::{BatchSelection, JobPatch};
use protocol::{FailureClass, JobState, PassState};
use server::db::list::{JobList, JobSort};

use crate::{Queue, all_done, on_both};

on_both! {
    /// Catches a job that cannot be brought back after its failures were mended.
    failed_jobs_run_again
    /// Catches a skipped batch that is baked, or a result with holes that is not called so.
    skipped_batches_leave_a_marked_hole
    /// Catches claims of a paused job.
    paused_jobs_wait
    /// Catches pages that miss a job or show it twice.
    pages_hold_every_job_once
    /// Catches an order that is not the one asked for, pages that overlap in it, a search that finds too much or too
    /// little, and a total that counts the page.
    lists_are_sorted_searched_and_counted
    /// Catches changes of what is over.
    what_is_over_stays_so
}

/// A job of six batches of which batch 0 has failed for good.
async fn with_a_failure(queue: &Queue) -> i64 {
    let bake = queue.baking("j", 6).await;
    for worker in ["w1", "w2", "w3"] {
        let granted = queue.claim(worker, bake.pass, 0, 1).await.unwrap();
        queue.fail(worker, bake.pass, &granted, FailureClass::Crash).await;
    }
    while let Some(granted) = queue.claim("w1", bake.pass, 0, 9).await {
        queue.complete("w1", bake.pass, &granted, &all_done(&granted)).await;
    }
    queue.advance("j").await;
    assert_eq!(queue.store.job("j").await.unwrap().state, JobState::Failed);
    bake.pass
}

async fn failed_jobs_run_again(queue: Queue) {
    let pass = with_a_failure(&queue).await;
    assert_eq!(queue.store.failures("j", 10).await.unwrap().len(), 3);
    let count = queue.store.retry("j", &BatchSelection::default(), "tester", queue.now).await.unwrap();
    assert_eq!(count, 1);
    assert_eq!(queue.store.job("j").await.unwrap().state, JobState::Running);
    let granted = queue.claim("w1", pass, 0, 9).await.expect("w1's failures are forgotten");
    assert_eq!((granted.batches.len(), granted.batches[0].fence), (1, 4));
    queue.complete("w1", pass, &granted, &all_done(&granted)).await;
    queue.advance("j").await;
    let passes = queue.store.pass_details("j").await.unwrap();
    assert_eq!(passes.last().unwrap().kind, protocol::PassKind::Merge);
}

async fn skipped_batches_leave_a_marked_hole(queue: Queue) {
    let pass = with_a_failure(&queue).await;
    let selection = BatchSelection { pass: Some(pass), batches: vec![0, 1] };
    let count = queue.store.skip("j", &selection, "tester", queue.now).await.unwrap();
    assert_eq!(count, 1, "batch 1 is done: nothing to skip");
    queue.advance("j").await;
    let passes = queue.store.pass_details("j").await.unwrap();
    assert_eq!((passes[3].state, passes[3].batches.skipped), (PassState::Done, 1));
    assert!(queue.store.task(passes[4].id).await.unwrap().partial, "the merge may leave holes");
}

async fn paused_jobs_wait(queue: Queue) {
    let bake = queue.baking("j", 6).await;
    queue.store.set_paused("j", true, "tester", queue.now).await.unwrap();
    assert!(queue.claim("w1", bake.pass, 0, 1).await.is_none());
    assert!(queue.store.load_farm(queue.now).await.unwrap().jobs["j"].paused);
    queue.store.set_paused("j", false, "tester", queue.now).await.unwrap();
    assert!(queue.claim("w1", bake.pass, 0, 1).await.is_some());
}

async fn pages_hold_every_job_once(queue: Queue) {
    for number in 0..23 {
        queue.submit(&format!("j{number:02}")).await;
    }
    let (mut seen, mut before) = (Vec::new(), None::<String>);
    loop {
        let page = queue.store.jobs(&JobList { before: before.as_deref(), ..list("default") }).await.unwrap();
        seen.extend(page.jobs.into_iter().map(|job| job.id));
        before = page.next;
        if before.is_none() {
            break;
        }
    }
    assert_eq!(seen, (0..23).rev().map(|number| format!("j{number:02}")).collect::<Vec<_>>());
    assert!(queue.store.jobs(&list("other")).await.unwrap().jobs.is_empty());
}

fn list(project: &str) -> JobList<'_> {
    JobList { project: Some(project), state: Some(JobState::Ready), limit: 5, ..JobList::default() }
}

async fn lists_are_sorted_searched_and_counted(queue: Queue) {
    for number in 0..12 {
        queue.submit(&format!("j{number:02}")).await;
        let patch = JobPatch { priority: Some(number % 4), ..JobPatch::default() };
        queue.store.patch(&format!("j{number:02}"), &patch, "tester", queue.now).await.unwrap();
    }
    let sorted = JobList { sort: JobSort::Priority, ascending: true, ..list("default") };
    let mut seen = Vec::new();
    for offset in [0, 5, 10, 15] {
        let page = queue.store.jobs(&JobList { offset, ..sorted.clone() }).await.unwrap();
        assert_eq!((page.total, page.next), (12, None));
        seen.extend(page.jobs.into_iter().map(|job| (job.priority, job.id)));
    }
    let mut wanted: Vec<(i64, String)> = (0..12).map(|n| (n % 4, format!("j{n:02}"))).collect();
    wanted.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.cmp(&a.1)));
    assert_eq!(seen, wanted);
    let found = queue.store.jobs(&JobList { search: "J1", ..list("default") }).await.unwrap();
    let found: Vec<&str> = found.jobs.iter().map(|job| job.id.as_str()).collect();
    assert_eq!(found, ["j11", "j10"]);
    assert_eq!(queue.store.jobs(&JobList { search: "j%1", ..list("default") }).await.unwrap().total, 0);
}

async fn what_is_over_stays_so(queue: Queue) {
    queue.submit("j").await;
    queue.advance("j").await;
    let patch = JobPatch { priority: Some(70), ..JobPatch::default() };
    queue.store.patch("j", &patch, "tester", queue.now).await.unwrap();
    assert_eq!(queue.store.job("j").await.unwrap().priority, 70);
    queue.store.cancel("j", "tester", queue.now).await.unwrap();
    queue.store.cancel("j", "tester", queue.now).await.expect("twice is as good as once");
    queue.advance("j").await;
    assert_eq!(queue.store.job("j").await.unwrap().state, JobState::Cancelled);
    while queue.store.sweep_cancelled().await.unwrap() {}
    assert!(queue.store.cancel("j", "tester", queue.now).await.is_err());
    assert!(queue.store.patch("j", &patch, "tester", queue.now).await.is_err());
    assert!(queue.store.set_paused("j", true, "tester", queue.now).await.is_err());
    assert!(queue.store.retry("j", &BatchSelection::default(), "tester", queue.now).await.is_err());
    assert!(queue.store.job("k").await.is_err());
}
