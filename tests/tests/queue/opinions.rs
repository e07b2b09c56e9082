//! Second opinions: what is baked twice before it counts, and who is not believed any more.

use protocol::work::{CompleteItem, Outcome, Verdict};
use protocol::{BatchState, FailureClass, PassState};
use server::db::claim::Granted;
use server::db::complete::Completion;

use crate::{Queue, done, on_both, registration};

on_both! {
    /// Catches a result that counts before another worker got the same, or is asked of the one who gave it.
    a_result_is_confirmed_by_another_worker
    /// Catches a worker that computes wrongly and goes on, results of it that are published, and an honest one that pays for it.
    who_is_outvoted_is_locked_and_redone
    /// Catches two workers that contradict each other for ever, or one of which is believed.
    a_disagreement_of_two_ends
    /// Catches a batch that waits for a second worker where there is none of its kind.
    nobody_to_ask_is_no_obstacle
}

impl Queue {
    async fn opinionated(mut self, workers: &[(&str, &str)]) -> Self {
        self.opinion_every = 1;
        for (name, device) in workers {
            let labels = [format!("device={device}")];
            self.store.register(&registration(name), &labels, None, name, self.now).await.unwrap();
        }
        self
    }

    /// Claims one batch as one of `alive`, and says that its result has this hash.
    async fn say(&self, alive: i64, worker: &str, pass: i64, hash: &str) -> (Granted, Completion) {
        let granted = self
            .claim_among(alive, worker, pass, 0, 1)
            .await
            .unwrap_or_else(|| panic!("{worker} gets nothing"));
        let completion = self.complete(worker, pass, &granted, &[done(&granted, 0, hash)]).await;
        (granted, completion)
    }

    async fn states(&self, job: &str, pass: i64) -> Vec<BatchState> {
        let page = self.store.batches(job, pass, None, -1, 99).await.unwrap();
        page.batches.iter().map(|batch| batch.state).collect()
    }

    async fn locked(&self) -> Vec<String> {
        let workers = self.store.workers(self.now).await.unwrap();
        workers
            .into_iter()
            .filter(|worker| worker.state == "locked" && !worker.reason.is_empty())
            .map(|w| w.name)
            .collect()
    }
}

async fn a_result_is_confirmed_by_another_worker(queue: Queue) {
    let queue = queue.opinionated(&[("w1", "cpu"), ("w2", "cpu")]).await;
    let bake = queue.baking("j", 1).await;
    let (first, said) = queue.say(2, "w1", bake.pass, "aa").await;
    assert_eq!((said.ready, said.lease_live), (1, false));
    assert_eq!(queue.states("j", bake.pass).await, [BatchState::Ready]);
    assert!(queue.claim_among(2, "w1", bake.pass, 0, 1).await.is_none(), "it has said what it thinks");
    assert!(queue.store.failures("j", 9).await.unwrap().is_empty(), "an opinion is no failure");
    let (second, _) = queue.say(2, "w2", bake.pass, "aa").await;
    assert!(second.batches[0].fence > first.batches[0].fence);
    assert_eq!(queue.states("j", bake.pass).await, [BatchState::Done]);
    assert_eq!(queue.locked().await, Vec::<String>::new());
    queue.advance("j").await;
    assert_eq!(queue.store.pass_details("j").await.unwrap()[3].state, PassState::Done);
}

async fn who_is_outvoted_is_locked_and_redone(queue: Queue) {
    let mut queue = queue.opinionated(&[("w1", "cpu"), ("w2", "cpu"), ("w3", "cpu")]).await;
    let bake = queue.baking("j", 3).await;
    // What the wrong one did before anybody looked
    queue.opinion_every = 0;
    queue.say(3, "w2", bake.pass, "bb").await;
    queue.opinion_every = 1;
    queue.say(3, "w1", bake.pass, "aa").await;
    let (_, split) = queue.say(3, "w2", bake.pass, "bb").await;
    assert!(split.diverged && split.distrusted.is_empty());
    assert_eq!(queue.states("j", bake.pass).await, [BatchState::Done, BatchState::Ready, BatchState::Ready]);
    // What the wrong one is at when that comes out does not count, whatever it says
    let other = queue.baking("k", 2).await;
    let held = queue.claim_among(3, "w2", other.pass, 0, 1).await.unwrap();
    let (_, decided) = queue.say(3, "w3", bake.pass, "aa").await;
    let late = queue.complete("w2", other.pass, &held, &[done(&held, 0, "bb")]).await;
    assert_eq!(late.verdicts, [Verdict::Superseded]);
    queue.store.end_leases_of("w2", "", &queue.around(9)).await.unwrap();
    assert_eq!(queue.states("k", other.pass).await, [BatchState::Ready; 2]);
    assert!(queue.store.drift().await.unwrap().is_empty());
    assert_eq!(decided.distrusted.iter().map(|d| d.worker.as_str()).collect::<Vec<_>>(), ["w2"]);
    assert_eq!(queue.states("j", bake.pass).await, [BatchState::Ready, BatchState::Done, BatchState::Ready]);
    assert_eq!(queue.locked().await, ["w2"]);
    let failures = queue.store.failures("j", 9).await.unwrap();
    assert!(
        failures.len() == 1 && failures[0].worker == "w2" && failures[0].class == FailureClass::Verify,
        "{failures:?}"
    );
    queue.store.act_on_worker("w2", server::db::worker::WorkerAction::Unlock).await.unwrap();
    assert_eq!(queue.locked().await, Vec::<String>::new());
}

async fn a_disagreement_of_two_ends(queue: Queue) {
    let queue = queue.opinionated(&[("w1", "cpu"), ("w2", "cpu")]).await;
    let bake = queue.baking("j", 1).await;
    let mut last = Completion::default();
    for round in 0..5 {
        let (worker, hash) = if round % 2 == 0 { ("w1", "aa") } else { ("w2", "bb") };
        assert!(last.distrusted.is_empty(), "after {round} rounds");
        (_, last) = queue.say(2, worker, bake.pass, hash).await;
    }
    assert_eq!(queue.states("j", bake.pass).await, [BatchState::Failed]);
    assert_eq!(queue.locked().await, ["w1", "w2"]);
    assert!(queue.store.drift().await.unwrap().is_empty());
}

async fn nobody_to_ask_is_no_obstacle(queue: Queue) {
    let queue = queue.opinionated(&[("w1", "cpu"), ("g1", "gpu"), ("w9", "cpu")]).await;
    queue.store.act_on_worker("w9", server::db::worker::WorkerAction::Lock).await.unwrap();
    let bake = queue.baking("j", 3).await;
    queue.say(3, "w1", bake.pass, "aa").await;
    assert_eq!(queue.states("j", bake.pass).await[0], BatchState::Done, "the other one is locked");
    queue.store.act_on_worker("w9", server::db::worker::WorkerAction::Unlock).await.unwrap();
    queue.say(3, "w1", bake.pass, "aa").await;
    assert_eq!(queue.states("j", bake.pass).await[1], BatchState::Ready);
    // Another device comes first: that its result differs says nothing
    let (_, other) = queue.say(3, "g1", bake.pass, "bb").await;
    assert!(!other.diverged && other.distrusted.is_empty());
    assert_eq!(queue.states("j", bake.pass).await[1], BatchState::Done);
    // A batch that comes back is asked for once: who takes it then is believed
    let granted = queue.claim_among(3, "w1", bake.pass, 0, 1).await.unwrap();
    let failed = CompleteItem {
        outcome: Outcome::Failed {
            class: FailureClass::Interrupted,
            message: String::new(),
            bad_parts: vec![],
        },
        ..done(&granted, 0, "aa")
    };
    queue.complete("w1", bake.pass, &granted, &[failed]).await;
    queue.say(3, "w1", bake.pass, "aa").await;
    assert_eq!(queue.states("j", bake.pass).await[2], BatchState::Done);
}
