//! Random operations against a model of a few lines: the transition table and a map of fences.

use std::collections::HashMap;

use protocol::work::Verdict;
use protocol::{BatchState, FailureClass};
use server::db::claim::Granted;
use server::scheduler::transition::{Event, next};

use crate::{Queue, TTL, done, failed, on_both};

on_both! {
    /// Catches any state that a sequence of claims, results (early, late, twice), failures, losses and returns leads to and
    /// the transition table does not allow.
    random_operations_follow_the_transition_table
}

/// What the model knows of a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Batch {
    state: BatchState,
    fence: i64,
}

async fn random_operations_follow_the_transition_table(mut queue: Queue) {
    const BATCHES: i64 = 100;
    let bake = queue.baking("j", BATCHES).await;
    let mut model = vec![Batch { state: BatchState::Ready, fence: 0 }; BATCHES as usize];
    let mut leases: Vec<(String, Granted)> = Vec::new();
    let mut owners: HashMap<i64, String> = HashMap::new();
    let mut seed = 20260127_u64;
    let mut random = |below: usize| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as usize % below
    };
    for _ in 0..400 {
        let step = random(30);
        if step < 12 || leases.is_empty() {
            let worker = format!("w{}", random(5));
            let segment = random(bake.segments as usize) as i64;
            let Some(granted) = queue.claim(&worker, bake.pass, segment, 1 + random(6) as i64).await else {
                continue;
            };
            for batch in &granted.batches {
                let known = &mut model[batch.batch as usize];
                known.state = next(known.state, Event::Claim).expect("only ready batches are claimed");
                assert_eq!(batch.fence, known.fence + 1, "fences rise by one");
                known.fence = batch.fence;
                owners.insert(batch.batch, granted.lease.clone());
            }
            leases.push((worker, granted));
        } else if step < 27 {
            // A result or a failure, of a lease that may be long over
            let (worker, granted) = leases[random(leases.len())].clone();
            let i = random(granted.batches.len());
            let batch = granted.batches[i];
            let fails = random(8) == 0;
            let item = if fails { failed(&granted, i, FailureClass::Lost) } else { done(&granted, i, "ab") };
            let before = model[batch.batch as usize];
            let current = before.state == BatchState::Leased
                && before.fence == batch.fence
                && owners.get(&batch.batch) == Some(&granted.lease);
            let verdict = queue.complete(&worker, bake.pass, &granted, &[item]).await.verdicts[0];
            let expected = match () {
                () if current => Verdict::Accepted,
                () if !fails && before.state == BatchState::Done && before.fence == batch.fence => {
                    Verdict::AlreadyDone
                }
                () => Verdict::Superseded,
            };
            assert_eq!(verdict, expected, "{before:?} {batch:?}");
            if current {
                let page = queue.store.batches("j", bake.pass, None, batch.batch - 1, 1).await.unwrap();
                let events = if fails { [Event::Retry, Event::GiveUp] } else { [Event::Accept; 2] };
                let allowed = events.map(|event| next(before.state, event));
                assert!(allowed.contains(&Some(page.batches[0].state)));
                model[batch.batch as usize].state = page.batches[0].state;
            }
        } else if step < 29 {
            let (worker, granted) = leases.swap_remove(random(leases.len()));
            queue.store.release(&granted.lease, &worker, &[], &queue.around(5)).await.unwrap();
            give_back(&mut model, &granted, &owners);
        } else {
            queue.now += TTL + 1;
            queue.store.expire(&queue.around(5)).await.unwrap();
            let page = queue.store.batches("j", bake.pass, None, -1, BATCHES).await.unwrap();
            for (known, actual) in model.iter_mut().zip(&page.batches) {
                if known.state == BatchState::Leased {
                    let allowed = [Event::Retry, Event::GiveUp].map(|event| next(known.state, event));
                    assert!(allowed.contains(&Some(actual.state)), "no lease is left");
                    known.state = actual.state;
                }
            }
        }
        check(&queue, bake.pass, &model).await;
    }
    assert!(
        model.iter().filter(|batch| batch.state == BatchState::Done).count() > 10,
        "the test does something"
    );
}

fn give_back(model: &mut [Batch], granted: &Granted, owners: &HashMap<i64, String>) {
    for batch in &granted.batches {
        let known = &mut model[batch.batch as usize];
        let current = known.fence == batch.fence && owners.get(&batch.batch) == Some(&granted.lease);
        if current && let Some(state) = next(known.state, Event::Retry) {
            known.state = state;
        }
    }
}

async fn check(queue: &Queue, pass: i64, model: &[Batch]) {
    let page = queue.store.batches("j", pass, None, -1, 1000).await.unwrap();
    let actual: Vec<Batch> =
        page.batches.iter().map(|batch| Batch { state: batch.state, fence: batch.fence }).collect();
    assert_eq!(actual, model);
}
