//! The worker's life: register, claim, execute, report, until it is asked to stop.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use engine::bake::{BakeOptions, Control};
use engine::scene::Roots;
use protocol::limits::is_name;
use protocol::work::{ClaimedBatch, CompleteItem, Outcome, PROTOCOL_VERSION, RegisterReply, RegisterRequest};
use serde::Serialize;

use crate::cache::Cache;
use crate::claims::{Claimed, Claims, release};
use crate::client::{Client, jitter};
use crate::deliver::{deliver, failed, report};
use crate::depot::Depot;
use crate::execute::{Baked, Executor, PartSink, Work};
use crate::heartbeat::Pulse;
use crate::remote::LeaseDepot;
use crate::spool::Spool;
use crate::{Error, Result};

/// Patience with inputs, and with a coordinator that is being started again.
const PATIENCE: Duration = Duration::from_secs(30);
/// How often a waiting worker looks whether it is to stop.
const LOOK: Duration = Duration::from_millis(100);

/// Batches of a claim that are left when the next one is asked for.
const AHEAD: usize = 2;
/// How long the last batch of a claim waits to know what comes after it: an answer that is on its way.
const GLANCE: Duration = Duration::from_millis(20);

/// What a worker is and may use.
#[derive(Clone, Debug)]
pub struct Options {
    /// The coordinator.
    pub client: Client,
    /// The worker's name, unique on the farm.
    pub name: String,
    /// What it is and has.
    pub labels: Vec<String>,
    /// The folder of its cache, spool and work in progress.
    pub cache: PathBuf,
    /// Bytes of objects that the cache keeps.
    pub cache_bytes: u64,
    /// Bytes of finished parts that wait for the coordinator.
    pub spool_bytes: u64,
    /// Asset roots by name, for paths such as `root:NAME/file`.
    pub roots: Roots,
    /// Memory, threads and device.
    pub machine: BakeOptions,
    /// Time for the batch at hand when the worker is asked to stop; what is not done then is given back.
    pub grace: Duration,
}

/// What a worker did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Summary {
    /// Claims.
    pub claims: u64,
    /// Batches that were finished.
    pub batches: u64,
    /// Batches that failed.
    pub failed: u64,
    /// Batches that were given back.
    pub given_back: u64,
    /// Bytes of objects that were fetched.
    pub received_bytes: u64,
}

/// Works until `stop` is set, or the coordinator refuses the worker.
///
/// # Errors
/// When the cache cannot be opened or the coordinator refuses the worker. A coordinator that does not answer is waited for.
pub fn run(options: &Options, stop: &AtomicBool) -> Result<Summary> {
    if !is_name(&options.name) {
        let message = format!("`{}` cannot be the name of a worker", options.name);
        return Err(engine::Error::invalid(message)
            .hint("letters, digits, `-`, `_`, `.` and `=`, up to 100")
            .into());
    }
    let cache = Arc::new(Cache::open(&options.cache, options.cache_bytes)?);
    let mut executor = Executor::new(cache.clone(), options.machine.clone(), options.roots.clone());
    let mut summary = Summary::default();
    while let Some(registered) = register(options, stop)? {
        let pulse = Arc::new(Pulse::new(&registered));
        let spool = Spool::new(cache.scratch()?, options.spool_bytes);
        let mut session =
            Session { options, pulse, spool, executor: &mut executor, summary: &mut summary, stop };
        session.serve();
        match session.pulse.take_end() {
            // The coordinator has forgotten this process, or another one took its name for a while
            Some(error) if matches!(error.status(), Some(404 | 409 | 410)) => tracing::warn!("{error}"),
            Some(error) => return Err(error),
            None => break,
        }
    }
    summary.received_bytes = options.client.received_bytes();
    Ok(summary)
}

/// Introduces the worker, however long that takes; none when it is to stop.
fn register(options: &Options, stop: &AtomicBool) -> Result<Option<RegisterReply>> {
    let request = RegisterRequest {
        name: options.name.clone(),
        labels: options.labels.clone(),
        memory_bytes: options.machine.memory_bytes,
        version: env!("CARGO_PKG_VERSION").into(),
        protocol: PROTOCOL_VERSION,
    };
    let client = options.client.with_patience(Duration::ZERO);
    let mut has_said = false;
    while !stop.load(Ordering::Relaxed) {
        match client.register(&request) {
            Ok(reply) => {
                tracing::info!(worker = options.name, session = reply.session, "registered");
                return Ok(Some(reply));
            }
            Err(Error::Unreachable(message)) => {
                if !has_said {
                    tracing::warn!("waiting for the coordinator: {message}");
                    has_said = true;
                }
                std::thread::sleep(jitter(Duration::from_secs(1)));
            }
            Err(error) => return Err(error),
        }
    }
    Ok(None)
}

/// A process's time with a coordinator that knows it.
struct Session<'a> {
    options: &'a Options,
    pulse: Arc<Pulse>,
    spool: Spool,
    executor: &'a mut Executor,
    summary: &'a mut Summary,
    stop: &'a AtomicBool,
}

impl Session<'_> {
    /// Works until it is to stop or the session is over; nothing is left to be done then.
    fn serve(&mut self) {
        let (client, stop, grace) = (&self.options.client, self.stop, self.options.grace);
        let pulse = self.pulse.clone();
        let is_done = AtomicBool::new(false);
        let spool = &self.spool;
        let (executor, summary, options) = (&mut *self.executor, &mut *self.summary, self.options);
        std::thread::scope(|scope| {
            scope.spawn(|| pulse.beat(client));
            let delivery = scope.spawn(|| deliver(client, &pulse, spool));
            scope.spawn(|| end_in_time(&pulse, stop, grace, &is_done));
            let mut desk = Desk { options, pulse: &pulse, spool, executor, summary, stop };
            desk.work(Claims::new(client.clone(), pulse.clone()));
            spool.close();
            // Heartbeats go on until the last part is acknowledged
            let _ = delivery.join();
            is_done.store(true, Ordering::Relaxed);
            pulse.stop();
        });
    }
}

/// Ends what is not done in time after the worker was asked to stop.
fn end_in_time(pulse: &Pulse, stop: &AtomicBool, grace: Duration, is_done: &AtomicBool) {
    let mut since: Option<Instant> = None;
    while !is_done.load(Ordering::Relaxed) {
        if stop.load(Ordering::Relaxed) && since.get_or_insert_with(Instant::now).elapsed() >= grace {
            pulse.cancel_all();
        }
        std::thread::sleep(LOOK);
    }
}

/// Where claims are worked on, one after the other.
struct Desk<'a> {
    options: &'a Options,
    pulse: &'a Arc<Pulse>,
    spool: &'a Spool,
    executor: &'a mut Executor,
    summary: &'a mut Summary,
    stop: &'a AtomicBool,
}

impl Desk<'_> {
    fn work(&mut self, mut claims: Claims) {
        while !self.stop.load(Ordering::Relaxed) && !self.pulse.is_over() {
            if !self.pulse.drain.load(Ordering::Relaxed) {
                claims.ask();
            }
            if let Some(claimed) = claims.wait(LOOK) {
                self.execute(&claimed, &mut claims);
            }
        }
        // A claim that came ahead is another worker's now
        while let Some(claimed) = claims.wait(Duration::ZERO) {
            self.give_back(&claimed, &claimed.claim.batches);
        }
    }

    /// Executes a claim and reports what came of it.
    fn execute(&mut self, claimed: &Claimed, claims: &mut Claims) {
        let Claimed { claim, lease } = claimed;
        let task = &claim.task;
        let span = tracing::error_span!("claim", job = task.job, pass = claim.pass, kind = %task.kind, lease = lease.id);
        let _span = span.entered();
        tracing::info!(batches = claim.batches.len(), "claimed");
        self.summary.claims += 1;
        let client = self.options.client.with_patience(PATIENCE);
        let (session, id) = (self.pulse.session.clone(), lease.id.clone());
        let depot: Arc<dyn Depot> = Arc::new(LeaseDepot { client, session, lease: id });
        let control = Control { progress: &**lease, cancel: &lease.cancel };
        let work = Work { claim, depot: &depot, control };
        let mut sink =
            ToSpool { spool: self.spool, claimed, given: 0, claims, stop: self.stop, pulse: self.pulse };
        let start = Instant::now();
        let result = self.executor.execute(work, &mut sink);
        let given = sink.given;
        self.summary.batches += given as u64;
        let rest = &claim.batches[given..];
        let outcome = match result {
            Ok(Some(finished)) => {
                self.summary.batches += 1;
                let (sha256, bytes) = (finished.content.sha256, finished.content.bytes as i64);
                Outcome::Done { sha256, bytes, result: Some(finished.result) }
            }
            Ok(None) if rest.is_empty() => return,
            Ok(None) => return self.give_back(claimed, rest),
            Err(error) if error.is_cancelled() => return self.give_back(claimed, rest),
            Err(error) => {
                let batch = rest.first();
                let (batch, fence) = (batch.map(|batch| batch.batch), batch.map(|batch| batch.fence));
                tracing::error!(batch, fence, class = %error.class(), "{error}");
                self.summary.failed += 1;
                failed(error)
            }
        };
        let Some((&batch, rest)) = rest.split_first() else { return };
        self.settle(claimed, batch, start.elapsed(), outcome);
        if rest.is_empty() { self.pulse.remove(lease) } else { self.give_back(claimed, rest) }
    }

    /// Reports one batch.
    fn settle(&self, claimed: &Claimed, batch: ClaimedBatch, elapsed: Duration, outcome: Outcome) {
        self.spool.flush(&claimed.lease);
        let elapsed_ms = i64::try_from(elapsed.as_millis()).unwrap_or(i64::MAX);
        let item = CompleteItem { batch: batch.batch, fence: batch.fence, elapsed_ms, traced: None, outcome };
        let client = &self.options.client;
        match report(client, self.pulse, &claimed.lease, (claimed.claim.pass, ""), vec![item]) {
            Ok(reply) => tracing::info!(verdicts = ?reply.verdicts, "reported"),
            Err(error) => tracing::warn!("a result could not be reported: {error}"),
        }
    }

    /// Gives batches back that were not begun, or not finished.
    fn give_back(&mut self, claimed: &Claimed, batches: &[ClaimedBatch]) {
        self.spool.flush(&claimed.lease);
        self.summary.given_back += batches.len() as u64;
        let batches = batches.iter().map(|batch| batch.batch).collect();
        release(&self.options.client, self.pulse, claimed, batches);
    }
}

/// Parts on their way to the spool.
struct ToSpool<'a> {
    spool: &'a Spool,
    claimed: &'a Claimed,
    given: usize,
    claims: &'a mut Claims,
    stop: &'a AtomicBool,
    pulse: &'a Pulse,
}

impl PartSink for ToSpool<'_> {
    fn part(&mut self, batch: ClaimedBatch, baked: Baked<'_>) -> Result<bool> {
        let Claimed { claim, lease } = self.claimed;
        self.spool.push(lease, (claim.pass, &claim.task.job), batch, baked)?;
        self.given += 1;
        Ok(!self.stop.load(Ordering::Relaxed) && lease.is_live())
    }

    /// The next claim is on its way before the last batch of this one begins, so that its first bricks are known then.
    fn begins(&mut self, left: usize) {
        let is_wanted = !self.stop.load(Ordering::Relaxed) && self.claimed.lease.is_live();
        if left <= AHEAD && is_wanted && !self.pulse.drain.load(Ordering::Relaxed) {
            self.claims.ask();
        }
    }

    fn upcoming(&mut self, pass: i64) -> Option<ClaimedBatch> {
        let next = self.claims.peek(GLANCE)?;
        next.claim.batches.first().copied().filter(|_| next.claim.pass == pass)
    }
}
