//! One fake worker: registers, claims, sleeps where a real one bakes, reports. It has a speed, habits and a wire of its own.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use protocol::limits::CLAIM_MAX;
use protocol::storage::FolderFile;
use protocol::work::{
    Claim, ClaimRequest, CompleteItem, CompleteRequest, HeartbeatRequest, LeaseProgress, Outcome,
    PROTOCOL_VERSION, PassResult, RegisterReply, RegisterRequest, ReleaseRequest, SetMap, Warm,
};
use protocol::{FailureClass, PassKind, keys};
use worker::depot::Depot;
use worker::digest;
use worker::remote::LeaseDepot;

use crate::ledger::{Beat, Ledger, Near, Spent};
use crate::load::{Load, Loads};
use crate::random::Random;
use crate::wire::{Line, Wire};

/// Claims whose segments a worker has in memory.
const MEMORY: usize = 8;
/// The bake set of every job.
pub const SET: &str = "hill";
/// Memory that a worker says it may use.
const MEMORY_BYTES: u64 = 4 << 30;
/// What stands where a stream would.
const CONTENT: &[u8] = b"a stream\n";

/// What the workers of a stage share.
#[derive(Debug, Default)]
pub struct Shared {
    /// What jobs cost.
    pub loads: Loads,
    /// What was seen.
    pub ledger: Ledger,
    /// Set when all is to end.
    pub stop: AtomicBool,
    /// Workers that are at a batch of a bake.
    pub busy: AtomicUsize,
    /// Workers that have registered and not been let go.
    pub registered: AtomicUsize,
}

/// What a worker is like.
#[derive(Clone, Copy, Debug)]
pub struct Temper {
    /// How many times longer than others it takes.
    pub slowness: f64,
    /// What its messages suffer.
    pub wire: Wire,
    /// It spoils every batch, and says that this is its own fault.
    pub is_broken: bool,
    /// It sleeps so long through its first bake, without a sign of life, and reports all the same.
    pub freezes: Option<Duration>,
    /// It gives bakes back: it is there to bring jobs up to them.
    pub is_shy: bool,
    /// How long a claim waits.
    pub wait: Duration,
}

impl Default for Temper {
    fn default() -> Self {
        let (wire, is_broken, freezes, is_shy) = Default::default();
        Self { slowness: 1.0, wire, is_broken, freezes, is_shy, wait: Duration::from_secs(10) }
    }
}

/// A fake worker.
pub struct Fake {
    /// Its number on the stage.
    pub number: usize,
    /// Its name.
    pub name: String,
    /// What it is like.
    pub temper: Temper,
    /// Its way to the coordinators.
    pub line: Line,
    /// Its random numbers.
    pub random: Random,
    /// What all share.
    pub shared: Arc<Shared>,
    /// Set when it is to leave.
    pub leave: Arc<AtomicBool>,
}

/// What a worker keeps for as long as the coordinator knows it.
struct Session {
    id: String,
    interval: Duration,
    next_beat: Instant,
    leases: Vec<String>,
    warm: Vec<(i64, i64)>,
    /// A report that is late.
    held: Option<(Claim, Vec<CompleteItem>)>,
    /// The heartbeat before, which may come late.
    stale: Option<HeartbeatRequest>,
    is_over: bool,
}

impl Fake {
    /// Works until it is to leave.
    pub fn run(mut self) {
        while !self.leaves() {
            let Some(reply) = self.register() else { return };
            self.shared.registered.fetch_add(1, Ordering::Relaxed);
            let interval = Duration::from_millis(reply.heartbeat_ms);
            let (leases, warm, held, stale) = Default::default();
            let (id, next_beat, is_over) = (reply.session, Instant::now() + interval, false);
            let mut session = Session { id, interval, next_beat, leases, warm, held, stale, is_over };
            while !self.leaves() && !session.is_over {
                self.turn(&mut session);
            }
            self.shared.registered.fetch_sub(1, Ordering::Relaxed);
            if session.is_over && !self.leaves() {
                self.shared.ledger.seen().sessions_lost += 1;
            }
        }
    }

    fn leaves(&self) -> bool {
        self.leave.load(Ordering::Relaxed) || self.shared.stop.load(Ordering::Relaxed)
    }

    fn register(&mut self) -> Option<RegisterReply> {
        let request = RegisterRequest {
            name: self.name.clone(),
            labels: Vec::new(),
            memory_bytes: MEMORY_BYTES,
            version: env!("CARGO_PKG_VERSION").into(),
            protocol: PROTOCOL_VERSION,
        };
        while !self.leaves() {
            match self.line.ask(|client| client.register(&request)) {
                Ok(reply) => return Some(reply),
                Err(_) => std::thread::sleep(Duration::from_millis(50 + self.random.below(200))),
            }
        }
        None
    }

    /// Asks for work, and does it.
    fn turn(&mut self, session: &mut Session) {
        let warm = session.warm.iter().map(|&(pass, segment)| Warm { pass, segment }).collect();
        let wait_ms = self.temper.wait.as_millis() as u64;
        let request = ClaimRequest { session: session.id.clone(), max: CLAIM_MAX, wait_ms, warm };
        match self.line.ask(|client| client.claim(&request)) {
            Ok(Some(claim)) => self.execute(session, &claim),
            Ok(None) => self.send_held(session),
            Err(error) if error.status().is_some() => session.is_over = true,
            Err(_) => std::thread::sleep(Duration::from_millis(20 + self.random.below(180))),
        }
    }

    fn execute(&mut self, session: &mut Session, claim: &Claim) {
        let near = remember(&mut session.warm, claim);
        if self.temper.is_shy && claim.task.kind == PassKind::Bake {
            let request = ReleaseRequest { session: session.id.clone(), batches: Vec::new() };
            // An answer that is lost is an expiry that comes
            let _ = self.line.ask(|client| client.release(&claim.lease, &request));
            std::thread::sleep(Duration::from_millis(20));
            return;
        }
        self.shared.ledger.claimed(self.number, claim, near);
        session.leases.push(claim.lease.clone());
        match claim.task.kind {
            PassKind::Bake => {
                self.shared.busy.fetch_add(1, Ordering::Relaxed);
                self.bake(session, claim);
                self.shared.busy.fetch_sub(1, Ordering::Relaxed);
            }
            _ => self.do_pass(session, claim),
        }
        session.leases.retain(|lease| *lease != claim.lease);
    }

    /// Sleeps through the batches of a claim and reports them, some at a time.
    fn bake(&mut self, session: &mut Session, claim: &Claim) {
        let Some(load) = self.shared.loads.get(claim.task.settings.seed) else { return };
        let frozen = self.temper.freezes.take();
        if let Some(freeze) = frozen {
            std::thread::sleep(freeze);
            session.next_beat = Instant::now();
        }
        for group in claim.batches.chunks(load.group.max(1)) {
            let from = self.shared.ledger.now();
            for _ in group {
                let share = 0.75 + 0.5 * self.random.unit();
                let time = Duration::from_secs_f64(load.batch_ms * self.temper.slowness * share / 1e3);
                self.sleep(session, time);
            }
            while load.gate.as_ref().is_some_and(|gate| !gate.wait(session.until_beat())) && !self.leaves() {
                self.sleep(session, Duration::ZERO);
            }
            let spent = Spent {
                from,
                to: self.shared.ledger.now(),
                worker: self.number,
                load: claim.task.settings.seed,
            };
            self.shared.ledger.seen().spent.push(spent);
            // Who was frozen does not know better than to report
            let is_live = frozen.is_some() || session.leases.contains(&claim.lease);
            if self.leaves() || session.is_over || !is_live {
                return;
            }
            let items = group.iter().map(|batch| CompleteItem {
                batch: batch.batch,
                fence: batch.fence,
                elapsed_ms: (load.told_ms as f64 * self.temper.slowness) as i64,
                traced: None,
                outcome: self.outcome(&load, claim.pass, batch.batch),
            });
            self.report(session, claim, items.collect());
        }
    }

    /// What comes of a batch: the same bytes whoever bakes it.
    fn outcome(&self, load: &Load, pass: i64, batch: i64) -> Outcome {
        let failed =
            |class, message: &str| Outcome::Failed { class, message: message.into(), bad_parts: Vec::new() };
        if self.temper.is_broken {
            return failed(FailureClass::WorkerFault, "the disk is full");
        }
        if load.poison.contains(&batch) {
            return failed(FailureClass::Crash, "it crashed");
        }
        let sha256 = digest::of_bytes(format!("{pass}/{batch}").as_bytes()).sha256;
        Outcome::Done { sha256, bytes: 0, result: None }
    }

    /// Does a pass of one batch: puts something where its result is looked for, and says what it found out.
    fn do_pass(&mut self, session: &mut Session, claim: &Claim) {
        let (task, Some(batch)) = (&claim.task, claim.batches.first()) else { return };
        let Some(load) = self.shared.loads.get(task.settings.seed) else { return };
        let folder = keys::result_folder(&task.job, claim.pass, batch.fence);
        let map = digest::of_bytes(task.job.as_bytes()).sha256;
        let content = digest::of_bytes(CONTENT);
        let (points, bytes) = (load.batches as u64, content.bytes);
        let (key, result) = match task.kind {
            PassKind::Import => {
                let sets = vec![SetMap { set: SET.into(), map }];
                (keys::index(&folder), PassResult::Import { sets })
            }
            PassKind::Build => {
                let built = PassResult::Build { bricks: 1, bytes, micropolygons: 1 };
                (keys::index(&keys::brick_map(task.map.as_deref().unwrap_or(&map))), built)
            }
            PassKind::Plan => (keys::index(&folder), PassResult::Plan { batches: load.batches, points }),
            _ => (
                format!("{folder}/{SET}.mgs"),
                PassResult::Merge { points, baked: points, bytes, preview: false, picture: false },
            ),
        };
        if self.put(session, claim, &key, &content).is_err() {
            return;
        }
        let outcome =
            Outcome::Done { sha256: content.sha256, bytes: content.bytes as i64, result: Some(result) };
        let item =
            CompleteItem { batch: batch.batch, fence: batch.fence, elapsed_ms: 10, traced: None, outcome };
        self.report(session, claim, vec![item]);
    }

    fn put(
        &mut self,
        session: &Session,
        claim: &Claim,
        key: &str,
        content: &FolderFile,
    ) -> worker::Result<()> {
        let file = tempfile::NamedTempFile::new()
            .and_then(|file| std::fs::write(file.path(), CONTENT).map(|()| file));
        let file = file.map_err(|error| engine::Error::io("write", Path::new(key), error))?;
        let (stop, path) = (self.leave.clone(), file.path());
        let depot = |client: &worker::client::Client| LeaseDepot {
            client: client.clone(),
            session: session.id.clone(),
            lease: claim.lease.clone(),
        };
        self.line.insist(&mut self.random, &stop, |client| depot(client).write(key, path, content))
    }

    /// Reports results over the worker's wire.
    fn report(&mut self, session: &mut Session, claim: &Claim, items: Vec<CompleteItem>) {
        let wire = self.temper.wire;
        if self.random.happens(wire.late) && session.held.is_none() {
            session.held = Some((claim.clone(), items));
            return;
        }
        let request =
            CompleteRequest { session: session.id.clone(), pass: claim.pass, device: String::new(), items };
        if self.random.happens(wire.lost) {
            std::thread::sleep(Duration::from_millis(30));
        }
        if self.random.happens(wire.unanswered) {
            // Whether it arrived, this worker does not know
            let _ = self.line.client().complete(&claim.lease, &request);
        }
        if self.random.happens(wire.doubled) {
            let twin = self.line.client().clone();
            let answer = std::thread::scope(|scope| {
                let second = scope.spawn(|| twin.complete(&claim.lease, &request));
                self.send(session, claim, &request);
                second.join()
            });
            if let Ok(Ok(reply)) = answer {
                self.shared.ledger.judged(self.number, claim, &request.items, &reply.verdicts);
            }
        } else {
            self.send(session, claim, &request);
        }
        self.send_held(session);
    }

    fn send(&mut self, session: &mut Session, claim: &Claim, request: &CompleteRequest) {
        let stop = self.leave.clone();
        let start = Instant::now();
        match self.line.insist(&mut self.random, &stop, |client| client.complete(&claim.lease, request)) {
            Ok(reply) => {
                self.shared.ledger.seen().complete_s.push(start.elapsed().as_secs_f64());
                self.shared.ledger.judged(self.number, claim, &request.items, &reply.verdicts);
            }
            Err(error) => session.is_over |= error.status().is_some(),
        }
    }

    /// Sends a report that was late.
    fn send_held(&mut self, session: &mut Session) {
        if let Some((claim, items)) = session.held.take() {
            let request = CompleteRequest {
                session: session.id.clone(),
                pass: claim.pass,
                device: String::new(),
                items,
            };
            self.send(session, &claim, &request);
        }
    }

    /// Sleeps, with a heartbeat whenever one is due.
    fn sleep(&mut self, session: &mut Session, time: Duration) {
        let end = Instant::now() + time;
        loop {
            if session.until_beat().is_zero() {
                self.beat(session);
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || self.leaves() || session.is_over {
                return;
            }
            std::thread::sleep(left.min(session.until_beat()).min(Duration::from_millis(250)));
        }
    }

    fn beat(&mut self, session: &mut Session) {
        session.next_beat = Instant::now() + session.interval;
        let wire = self.temper.wire;
        if self.random.happens(wire.lost) {
            return;
        }
        let held = session.held.iter().map(|(claim, _)| &claim.lease);
        let leases: Vec<&String> = session.leases.iter().chain(held).collect();
        let progress = |lease: &&String| LeaseProgress { lease: (*lease).clone(), progress: 0.5 };
        let request =
            HeartbeatRequest { session: session.id.clone(), leases: leases.iter().map(progress).collect() };
        let times = if self.random.happens(wire.doubled) { 2 } else { 1 };
        for _ in 0..times {
            let start = Instant::now();
            match self.line.ask(|client| client.heartbeat(&request)) {
                Ok(reply) => {
                    let (at, seconds) = (self.shared.ledger.now(), start.elapsed().as_secs_f64());
                    let mut seen = self.shared.ledger.seen();
                    seen.beats.push(Beat { at, worker: self.number, seconds });
                    let ended = session.leases.iter().filter(|lease| reply.ended.contains(lease)).count();
                    seen.leases_lost += ended as u64;
                    session.leases.retain(|lease| !reply.ended.contains(lease));
                }
                Err(error) if error.status().is_some() => session.is_over = true,
                Err(_) => session.next_beat = Instant::now() + Duration::from_millis(200),
            }
        }
        if let Some(stale) = session.stale.replace(request).filter(|_| self.random.happens(wire.late)) {
            // An old sign of life must do no harm; its answer is nobody's
            let _ = self.line.ask(|client| client.heartbeat(&stale));
        }
    }
}

impl Session {
    fn until_beat(&self) -> Duration {
        self.next_beat.saturating_duration_since(Instant::now())
    }
}

/// Notes what a claim brings into memory, and how near it was to what is there.
fn remember(warm: &mut Vec<(i64, i64)>, claim: &Claim) -> Near {
    let here = (claim.pass, claim.segment);
    let next = |&(pass, segment): &(i64, i64)| pass == here.0 && (segment - here.1).abs() == 1;
    let near = match () {
        () if warm.contains(&here) => Near::Warm,
        () if warm.iter().any(next) => Near::Adjacent,
        () => Near::Cold,
    };
    warm.retain(|other| *other != here);
    warm.insert(0, here);
    warm.truncate(MEMORY);
    near
}
