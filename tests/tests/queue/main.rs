//! The queue's conformance suite: every test runs on SQLite and on a real PostgreSQL.

mod access;
mod bench;
mod claims;
mod garbage;
mod graph;
mod model;
mod opinions;
mod people;

use std::sync::Arc;

use protocol::job::JobRequest;
use protocol::work::{CompleteItem, Outcome, PassResult, RegisterRequest, SetMap, Verdict};
use protocol::{FailureClass, PassKind};
use server::db::Store;
use server::db::claim::{Claimer, Granted};
use server::db::complete::{Completion, Reporter};
use server::db::graph::Publication;
use server::db::job::NewJob;
use server::scheduler::choose::{Candidate, Locality};
use server::scheduler::failure::Around;

/// When the tests begin, milliseconds since 1970.
pub(crate) const START: i64 = 1_700_000_000_000;
/// Milliseconds that leases last.
pub(crate) const TTL: i64 = 60_000;

/// Makes a test for each database of an async function that takes a [`Queue`].
#[macro_export]
macro_rules! on_both {
    ($($(#[$about:meta])* $name:ident)*) => { $(
        $(#[$about])*
        mod $name {
            #[test]
            fn sqlite() {
                $crate::run_on_sqlite(super::$name);
            }

            #[test]
            fn postgres() {
                $crate::run_on_postgres(super::$name);
            }
        }
    )* };
}

/// Runs a test on a new SQLite file.
pub(crate) fn run_on_sqlite<F: Future<Output = ()>>(test: impl FnOnce(Queue) -> F) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("sqlite:{}", folder.path().join("queue.db").display());
    run_on(&url, test);
}

/// Runs a test on a new PostgreSQL database.
pub(crate) fn run_on_postgres<F: Future<Output = ()>>(test: impl FnOnce(Queue) -> F) {
    match tests::postgres::shared_database() {
        Some(url) => run_on(&url, test),
        None => eprintln!("skipped: PostgreSQL is not installed"),
    }
}

fn run_on<F: Future<Output = ()>>(url: &str, test: impl FnOnce(Queue) -> F) {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    runtime.expect("a runtime").block_on(async {
        let store = Store::open(url, 16).await.expect("the database opens");
        store.migrate().await.expect("the schema is made");
        store.migrate().await.expect("and is there");
        let queue = Queue { store: store.clone(), now: START, opinion_every: 0 };
        test(queue).await;
        assert_eq!(store.drift().await.unwrap(), [], "counts differ from what they count");
        assert_eq!(store.orphans().await.unwrap(), 0, "leases and batches disagree");
        store.driver().close().await;
    });
}

/// The queue under test, at a time.
#[derive(Clone)]
pub(crate) struct Queue {
    pub store: Store,
    pub now: i64,
    /// One result in so many is to be confirmed.
    pub opinion_every: u32,
}

/// A pass with what a test needs to claim from it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BakePass {
    pub pass: i64,
    pub segments: i64,
}

impl Queue {
    pub(crate) fn around(&self, workers_alive: i64) -> Around {
        Around { now: self.now, workers_alive, worker_memory: 4 << 30, random: 12345 }
    }

    pub(crate) async fn submit(&self, id: &str) {
        let jobs = [new_job(id, None)];
        self.store.submit(&jobs, self.now).await.expect("submitted");
    }

    /// Advances a job, and everything that follows from it; what is to be published.
    pub(crate) async fn advance(&self, job: &str) -> Option<Publication> {
        let advance = self.store.advance(job, self.now).await.expect("advanced");
        for other in advance.others {
            self.store.advance(&other, self.now).await.expect("advanced");
        }
        advance.publish
    }

    /// A job whose bake pass of `batches` batches is open: import, build and plan are done.
    pub(crate) async fn baking(&self, id: &str, batches: i64) -> BakePass {
        self.submit(id).await;
        self.advance(id).await;
        self.do_pass(id, PassKind::Import, Some(import(&["set"], id))).await;
        self.do_pass(id, PassKind::Build, Some(built())).await;
        self.do_pass(id, PassKind::Plan, Some(PassResult::Plan { batches, points: 1 })).await;
        while self.store.create_some().await.unwrap().is_some() {}
        self.advance(id).await;
        let pass = self.pass(id, PassKind::Bake).await;
        let segments = self.store.segments(id, pass, 0, 1 << 20).await.unwrap().len() as i64;
        BakePass { pass, segments }
    }

    /// The id of a job's pass.
    pub(crate) async fn pass(&self, job: &str, kind: PassKind) -> i64 {
        let passes = self.store.pass_details(job).await.unwrap();
        passes.iter().find(|pass| pass.kind == kind).unwrap_or_else(|| panic!("no {kind} in {passes:?}")).id
    }

    /// Claims and completes a pass of one batch.
    pub(crate) async fn do_pass(&self, job: &str, kind: PassKind, result: Option<PassResult>) {
        let pass = self.pass(job, kind).await;
        let granted = self.claim("w0", pass, 0, 1).await.expect("a batch of the pass");
        let mut item = done(&granted, 0, "aa");
        if let Outcome::Done { result: r, .. } = &mut item.outcome {
            *r = result;
        }
        let completion = self.complete("w0", pass, &granted, &[item]).await;
        assert_eq!(completion.verdicts, [Verdict::Accepted]);
        self.advance(job).await;
    }

    pub(crate) async fn claim(&self, worker: &str, pass: i64, segment: i64, count: i64) -> Option<Granted> {
        self.claim_among(99, worker, pass, segment, count).await
    }

    /// Claims as one of `alive` workers.
    pub(crate) async fn claim_among(
        &self,
        alive: i64,
        worker: &str,
        pass: i64,
        segment: i64,
        count: i64,
    ) -> Option<Granted> {
        let claimer = Claimer { worker, session: worker, memory_bytes: 4 << 30, alive };
        let candidate = Candidate { pass, segment, locality: Locality::Cold, count };
        self.store.claim(&candidate, false, &claimer, TTL, self.now).await.expect("claimed").granted()
    }

    pub(crate) async fn complete(
        &self,
        worker: &str,
        pass: i64,
        granted: &Granted,
        items: &[CompleteItem],
    ) -> Completion {
        let reporter = Reporter {
            lease: &granted.lease,
            pass,
            session: worker,
            worker,
            device: "cpu",
            around: self.around(9),
            opinion_every: self.opinion_every,
        };
        self.store.complete(&reporter, items).await.expect("completed")
    }

    /// Fails all batches of a claim.
    pub(crate) async fn fail(
        &self,
        worker: &str,
        pass: i64,
        granted: &Granted,
        class: FailureClass,
    ) -> Completion {
        let items: Vec<_> = (0..granted.batches.len()).map(|i| failed(granted, i, class)).collect();
        self.complete(worker, pass, granted, &items).await
    }

    pub(crate) async fn register(&self, name: &str) {
        self.store.register(&registration(name), &[], None, name, self.now).await.expect("registered");
    }
}

pub(crate) fn registration(name: &str) -> RegisterRequest {
    RegisterRequest {
        name: name.into(),
        labels: vec![],
        memory_bytes: 4 << 30,
        version: "1".into(),
        protocol: 1,
    }
}

pub(crate) fn new_job(id: &str, key: Option<&str>) -> NewJob {
    let request: JobRequest =
        serde_json::from_value(serde_json::json!({ "name": "test", "scene": "<scene/>" }))
            .expect("a request");
    NewJob {
        id: id.into(),
        request: Arc::new(request),
        request_sha256: "hash".into(),
        idempotency_key: key.map(Into::into),
        frame: None,
        submitted_by: "tester".into(),
        resubmit_of: None,
    }
}

pub(crate) fn import(sets: &[&str], map: &str) -> PassResult {
    let sets = sets.iter().map(|set| SetMap { set: (*set).into(), map: map.into() });
    PassResult::Import { sets: sets.collect() }
}

pub(crate) fn built() -> PassResult {
    PassResult::Build { bricks: 1, bytes: 1, micropolygons: 1 }
}

pub(crate) fn done(granted: &Granted, i: usize, sha256: &str) -> CompleteItem {
    let outcome = Outcome::Done { sha256: sha256.repeat(32), bytes: 10, result: None };
    let batch = granted.batches[i];
    CompleteItem { batch: batch.batch, fence: batch.fence, elapsed_ms: 100, traced: None, outcome }
}

pub(crate) fn all_done(granted: &Granted) -> Vec<CompleteItem> {
    (0..granted.batches.len()).map(|i| done(granted, i, "ab")).collect()
}

pub(crate) fn failed(granted: &Granted, i: usize, class: FailureClass) -> CompleteItem {
    let outcome = Outcome::Failed { class, message: "it broke".into(), bad_parts: vec![] };
    CompleteItem { outcome, ..done(granted, i, "ab") }
}
