//! Claims, results, leases that run out.

use protocol::traced::Traced;
use protocol::work::{CompleteItem, Verdict};
use protocol::{BatchState, FailureClass};

use server::db::claim::Granted;

use crate::{Queue, TTL, all_done, done, on_both};

on_both! {
    /// Catches a batch that two workers have at once, one that nobody gets, and one whose fence does not rise.
    racing_claims_never_overlap
    /// Catches a result of a lease that ran out, one that counts twice, and an answer that makes a worker repeat itself.
    results_count_once_and_only_under_the_current_fence
    /// Catches a lease that outlives its time, ends before it, or ends while its worker is heard of; and a worker that is
    /// taken for idle when its lease ran out.
    leases_last_as_long_as_heartbeats_come
    /// Catches leases that run out while the coordinator was away.
    a_restart_forgives
    /// Catches a batch that kills worker after worker, and one that is given up because workers die.
    poison_is_given_up_after_three_workers
    /// Catches a drained worker whose batches are held against them.
    what_is_given_back_counts_for_nothing
    /// Catches a worker that gets a batch again at which it has just failed.
    a_worker_does_not_get_what_it_failed_at
    /// Catches a batch that stands still since every worker of a small farm has failed at it once.
    what_all_have_failed_at_is_tried_again
    /// Catches a batch of an earlier process that stays leased until its time is over.
    a_new_process_ends_the_leases_of_the_old
    /// Catches a merge that published a damaged part.
    damaged_parts_are_baked_again
    /// Catches figures of a result that did not count, or that counted twice, and sums that are mixed up between workers,
    /// passes and jobs.
    what_tracing_took_is_summed_once
    /// Catches a broken worker, and a broken job, that burn the farm.
    broken_workers_rest_and_storms_pause
}

async fn racing_claims_never_overlap(queue: Queue) {
    let bake = queue.baking("j", 1000).await;
    let claimers = (0..8).map(|number| {
        let queue = queue.clone();
        tokio::spawn(async move {
            let worker = format!("w{number}");
            let mut got = Vec::new();
            // A locked segment answers nothing: several rounds reach everything
            for round in 0..400 {
                let segment = (round + number * 7) % bake.segments;
                if let Some(granted) = queue.claim(&worker, bake.pass, segment, 5).await {
                    got.extend(granted.batches.iter().map(|batch| (batch.batch, batch.fence)));
                    let items = all_done(&granted);
                    let completion = queue.complete(&worker, bake.pass, &granted, &items).await;
                    assert!(completion.verdicts.iter().all(|&verdict| verdict == Verdict::Accepted));
                }
            }
            got
        })
    });
    let mut all = Vec::new();
    for claimer in claimers.collect::<Vec<_>>() {
        all.extend(claimer.await.expect("no panic"));
    }
    all.sort_unstable();
    assert_eq!(all, (0..1000).map(|batch| (batch, 1)).collect::<Vec<_>>());
}

async fn results_count_once_and_only_under_the_current_fence(mut queue: Queue) {
    let bake = queue.baking("j", 10).await;
    let first = queue.claim("w1", bake.pass, 0, 2).await.unwrap();
    queue.now += TTL + 1;
    assert_eq!(queue.store.expire(&queue.around(9)).await.unwrap().len(), 1);
    let second = queue.claim("w2", bake.pass, 0, 2).await.unwrap();
    assert_eq!(second.batches[0].batch, first.batches[0].batch);
    assert_eq!((first.batches[0].fence, second.batches[0].fence), (1, 2));

    let late = queue.complete("w1", bake.pass, &first, &[done(&first, 0, "ab")]).await;
    assert_eq!((late.verdicts, late.ended), (vec![Verdict::Superseded], 0));
    let stolen = queue.complete("w1", bake.pass, &second, &[done(&second, 0, "ab")]).await;
    assert_eq!(stolen.verdicts, [Verdict::Superseded], "another session's lease");
    let current = queue.complete("w2", bake.pass, &second, &[done(&second, 0, "ab")]).await;
    assert_eq!((current.verdicts, current.lease_live), (vec![Verdict::Accepted], true));
    let again = queue.complete("w2", bake.pass, &second, &[done(&second, 0, "ab")]).await;
    assert_eq!((again.verdicts, again.ended), (vec![Verdict::AlreadyDone], 0));
    let last = queue.complete("w2", bake.pass, &second, &[done(&second, 1, "ab")]).await;
    assert_eq!((last.verdicts, last.lease_live), (vec![Verdict::Accepted], false));
    let after_the_end = queue.complete("w2", bake.pass, &second, &all_done(&second)).await;
    assert_eq!(after_the_end.verdicts, [Verdict::AlreadyDone; 2]);
    let differs = queue.complete("w1", bake.pass, &first, &[done(&first, 0, "cd")]).await;
    assert!(differs.diverged, "two results of one batch differ");
}

async fn leases_last_as_long_as_heartbeats_come(mut queue: Queue) {
    let bake = queue.baking("j", 10).await;
    queue.register("w1").await;
    queue.register("w2").await;
    let kept = queue.claim("w1", bake.pass, 0, 1).await.unwrap().lease;
    let silent = queue.claim("w2", bake.pass, 0, 1).await.unwrap().lease;
    queue.now += TTL - 1;
    let both = [kept.clone(), silent.clone()];
    let (extended, ended) = queue.store.extend("w1", &both, TTL, queue.now).await.unwrap();
    assert_eq!((extended, ended), (vec![kept.clone()], vec![silent]), "w2's lease is not w1's to extend");
    assert!(queue.store.expire(&queue.around(9)).await.unwrap().is_empty());
    queue.now += 2;
    let ended = queue.store.expire(&queue.around(9)).await.unwrap();
    assert_eq!(ended.iter().map(|ended| ended.lost_worker.as_deref()).collect::<Vec<_>>(), [Some("w2")]);
    let workers = queue.store.workers(queue.now).await.unwrap();
    let states: Vec<_> = workers.iter().map(|worker| (&*worker.name, &*worker.state)).collect();
    assert_eq!(states, [("w1", "busy"), ("w2", "lost")], "who is silent is lost at once");
    queue.now += TTL;
    assert_eq!(queue.store.expire(&queue.around(9)).await.unwrap().len(), 1);
    let (extended, ended) =
        queue.store.extend("w1", std::slice::from_ref(&kept), TTL, queue.now).await.unwrap();
    assert_eq!((extended, ended), (vec![], vec![kept]));
}

async fn a_restart_forgives(mut queue: Queue) {
    let bake = queue.baking("j", 10).await;
    let granted = queue.claim("w1", bake.pass, 0, 4).await.unwrap();
    queue.now += 10 * TTL;
    queue.store.forgive(TTL, queue.now).await.unwrap();
    assert!(queue.store.expire(&queue.around(9)).await.unwrap().is_empty());
    let completion = queue.complete("w1", bake.pass, &granted, &all_done(&granted)).await;
    assert_eq!(completion.verdicts, [Verdict::Accepted; 4]);
}

async fn poison_is_given_up_after_three_workers(mut queue: Queue) {
    let bake = queue.baking("j", 2).await;
    for worker in ["w1", "w2", "w3"] {
        let granted = queue.claim(worker, bake.pass, 0, 1).await.unwrap();
        assert_eq!(granted.batches[0].batch, 0);
        queue.fail(worker, bake.pass, &granted, FailureClass::Crash).await;
    }
    let page = queue.store.batches("j", bake.pass, Some(BatchState::Failed), -1, 9).await.unwrap();
    assert_eq!((page.batches[0].batch, page.batches[0].fence, page.batches[0].tries), (0, 3, 3));
    // Leases that run out do not make poison before the fifth
    for round in 1..=5 {
        let granted = queue.claim(&format!("v{round}"), bake.pass, 0, 1).await.unwrap();
        assert_eq!((granted.batches[0].batch, granted.batches[0].fence), (1, round));
        queue.now += TTL + 1;
        queue.store.expire(&queue.around(9)).await.unwrap();
    }
    let page = queue.store.batches("j", bake.pass, Some(BatchState::Failed), -1, 9).await.unwrap();
    assert_eq!(page.batches.len(), 2);
}

async fn what_is_given_back_counts_for_nothing(queue: Queue) {
    let bake = queue.baking("j", 10).await;
    for _ in 0..20 {
        let granted = queue.claim("w1", bake.pass, 0, 3).await.unwrap();
        let some = [granted.batches[0].batch];
        let back = queue.store.release(&granted.lease, "w1", &some, &queue.around(1)).await.unwrap().unwrap();
        assert_eq!((back.ended, back.ready, back.lease_live), (1, 1, true));
        let back = queue.store.release(&granted.lease, "w1", &[], &queue.around(1)).await.unwrap().unwrap();
        assert_eq!((back.ended, back.lease_live), (2, false));
    }
    let page = queue.store.batches("j", bake.pass, None, -1, 1).await.unwrap();
    assert_eq!((page.batches[0].fence, page.batches[0].tries), (20, 0));
}

async fn a_worker_does_not_get_what_it_failed_at(mut queue: Queue) {
    let bake = queue.baking("j", 3).await;
    let granted = queue.claim("w1", bake.pass, 0, 1).await.unwrap();
    queue.fail("w1", bake.pass, &granted, FailureClass::Crash).await;
    assert_eq!(queue.claim("w1", bake.pass, 0, 9).await.unwrap().batches.len(), 2);
    assert_eq!(queue.claim("w2", bake.pass, 0, 9).await.unwrap().batches.len(), 1);
    // Passing failures pause the batch for everybody
    let bake = queue.baking("k", 1).await;
    let granted = queue.claim("w1", bake.pass, 0, 1).await.unwrap();
    queue.fail("w1", bake.pass, &granted, FailureClass::TransientIo).await;
    assert!(queue.claim("w2", bake.pass, 0, 9).await.is_none());
    queue.now += 2_001;
    assert!(queue.claim("w2", bake.pass, 0, 9).await.is_some());
    // Memory is asked for that the failed worker did not have
    let bake = queue.baking("l", 1).await;
    let granted = queue.claim("w1", bake.pass, 0, 1).await.unwrap();
    queue.fail("w1", bake.pass, &granted, FailureClass::Memory).await;
    assert!(queue.claim("w2", bake.pass, 0, 9).await.is_none(), "w2 has as little");
}

async fn what_all_have_failed_at_is_tried_again(mut queue: Queue) {
    let bake = queue.baking("j", 1).await;
    for worker in ["w1", "w2"] {
        let granted = queue.claim_among(2, worker, bake.pass, 0, 1).await.unwrap();
        queue.fail(worker, bake.pass, &granted, FailureClass::Crash).await;
        queue.now += 600_000;
        if worker == "w1" {
            assert!(queue.claim_among(2, "w1", bake.pass, 0, 1).await.is_none(), "w2 is there");
        }
    }
    assert!(queue.claim_among(3, "w1", bake.pass, 0, 1).await.is_none(), "w3 is there");
    assert!(queue.claim_among(2, "w1", bake.pass, 0, 1).await.is_some());
}

async fn a_new_process_ends_the_leases_of_the_old(queue: Queue) {
    let bake = queue.baking("j", 10).await;
    queue.claim("w1", bake.pass, 0, 4).await.unwrap();
    queue.claim("w2", bake.pass, 0, 4).await.unwrap();
    let ended = queue.store.end_leases_of("w1", "a new session", &queue.around(9)).await.unwrap();
    assert_eq!((ended.len(), ended[0].ready), (1, 4));
}

async fn damaged_parts_are_baked_again(queue: Queue) {
    let bake = queue.baking("j", 20).await;
    for segment in 0..bake.segments {
        while let Some(granted) = queue.claim("w1", bake.pass, segment, 9).await {
            queue.complete("w1", bake.pass, &granted, &all_done(&granted)).await;
        }
    }
    queue.advance("j").await;
    let merge = queue.pass("j", protocol::PassKind::Merge).await;
    let granted = queue.claim("w2", merge, 0, 1).await.unwrap();
    let mut item = crate::failed(&granted, 0, FailureClass::Verify);
    if let protocol::work::Outcome::Failed { bad_parts, .. } = &mut item.outcome {
        *bad_parts = [3, 17].map(|batch| protocol::work::ClaimedBatch { batch, fence: 1 }).to_vec();
    }
    assert!(queue.complete("w2", merge, &granted, &[item]).await.advances);
    queue.advance("j").await;
    assert!(queue.claim("w3", merge, 0, 1).await.is_none(), "the merge waits");
    for (segment, batch) in [(0, 3), (1, 17)] {
        let granted = queue.claim("w1", bake.pass, segment, 9).await.unwrap();
        assert_eq!(granted.batches.iter().map(|b| (b.batch, b.fence)).collect::<Vec<_>>(), [(batch, 2)]);
        queue.complete("w1", bake.pass, &granted, &all_done(&granted)).await;
    }
    queue.advance("j").await;
    assert!(queue.claim("w3", merge, 0, 1).await.is_some(), "the merge goes on");
}

async fn broken_workers_rest_and_storms_pause(queue: Queue) {
    let bake = queue.baking("j", 200).await;
    queue.register("w1").await;
    let granted = queue.claim("w1", bake.pass, 0, 2).await.unwrap();
    queue.fail("w1", bake.pass, &granted, FailureClass::WorkerFault).await;
    let farm = queue.store.load_farm(queue.now).await.unwrap();
    assert!(!farm.workers["w1"].withheld && farm.blocks.is_empty());
    let granted = queue.claim("w1", bake.pass, 1, 3).await.unwrap();
    queue.fail("w1", bake.pass, &granted, FailureClass::WorkerFault).await;
    let farm = queue.store.load_farm(queue.now).await.unwrap();
    assert!(farm.workers["w1"].withheld, "sick after five batches");
    assert!(farm.blocks["w1"].contains("j"), "and blocked for the job after three");

    let mut storms = Vec::new();
    for round in 0..20 {
        let worker = format!("v{round}");
        let Some(granted) = queue.claim(&worker, bake.pass, 2 + round % 5, 1).await else { break };
        storms.extend(queue.fail(&worker, bake.pass, &granted, FailureClass::Crash).await.storm);
    }
    assert_eq!(storms, ["20 failures of class `crash` among its first batches"]);
    assert!(queue.store.job("j").await.unwrap().paused);
    assert!(queue.claim("w9", bake.pass, 7, 1).await.is_none(), "a paused job is not claimed from");
}

async fn what_tracing_took_is_summed_once(mut queue: Queue) {
    let (one, other) = (queue.baking("j", 4).await, queue.baking("k", 2).await);
    let figures = |number: i64| Traced::from_array(std::array::from_fn(|at| number * (at as i64 + 1)));
    let traced = |granted: &Granted, i, number| CompleteItem {
        traced: Some(figures(number)),
        ..done(granted, i, "ab")
    };
    let first = queue.claim("w1", one.pass, 0, 2).await.unwrap();
    let items = [traced(&first, 0, 10), traced(&first, 1, 20)];
    queue.complete("w1", one.pass, &first, &items).await;
    // The same again, a failure, and a result that comes too late
    queue.complete("w1", one.pass, &first, &items).await;
    let late = queue.claim("w1", one.pass, 0, 1).await.unwrap();
    queue.now += TTL + 1;
    queue.store.expire(&queue.around(9)).await.unwrap();
    queue.complete("w1", one.pass, &late, &[traced(&late, 0, 1_000)]).await;
    let second = queue.claim("w2", one.pass, 0, 1).await.unwrap();
    queue.complete("w2", one.pass, &second, &[traced(&second, 0, 100)]).await;
    let third = queue.claim("w2", other.pass, 0, 1).await.unwrap();
    queue.now += 1;
    queue.complete("w2", other.pass, &third, &[traced(&third, 0, 3)]).await;

    let sum = |batches, number| Traced { batches, ..figures(number) };
    let work = queue.store.work("j", 9).await.unwrap();
    let found: Vec<_> = work.iter().map(|work| (&*work.worker, &*work.device, work.traced)).collect();
    assert_eq!(found, [("w2", "cpu", sum(1, 100)), ("w1", "cpu", sum(2, 30))]);
    let passes = queue.store.pass_details("j").await.unwrap();
    let bake = passes.iter().find(|pass| pass.id == one.pass).unwrap();
    assert_eq!(bake.traced, Some(sum(3, 130)));
    assert!(passes.iter().filter(|pass| pass.id != one.pass).all(|pass| pass.traced.is_none()));
    // A worker's figures are those of the pass that it was at last
    queue.register("w1").await;
    queue.register("w2").await;
    let workers = queue.store.workers(queue.now).await.unwrap();
    let found: Vec<_> = workers.iter().map(|worker| (&*worker.name, worker.traced)).collect();
    assert_eq!(found, [("w1", Some(sum(2, 30))), ("w2", Some(sum(1, 3)))]);
}
