//! Asking for work on a thread of its own: a long poll neither delays an end nor the work at hand.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, TryRecvError, channel};
use std::time::{Duration, Instant};

use protocol::limits::CLAIM_MAX;
use protocol::work::{Claim, ClaimRequest, ReleaseRequest, Warm};

use crate::client::{Client, jitter};
use crate::heartbeat::{Lease, Pulse};

/// How long the coordinator may wait for work.
const WAIT_MS: u64 = 25_000;
/// Wait after a claim without an answer.
const RETRY: Duration = Duration::from_secs(2);
/// Claims whose segments are named as warm.
const WARM_MAX: usize = 8;

/// A claim, and the lease that heartbeats keep alive since it came.
pub struct Claimed {
    /// The claim.
    pub claim: Claim,
    /// Its lease.
    pub lease: Arc<Lease>,
}

/// What asks for work.
pub struct Claims {
    ask: Sender<Vec<Warm>>,
    come: Receiver<Claimed>,
    is_asked: bool,
    /// A claim that has come before its time.
    next: Option<Claimed>,
    warm: Vec<Warm>,
}

impl Claims {
    /// Starts the thread that asks. It ends when this is dropped, after its last answer.
    pub fn new(client: Client, pulse: Arc<Pulse>) -> Self {
        let (ask, asked) = channel::<Vec<Warm>>();
        let (give, come) = channel();
        std::thread::spawn(move || {
            while let Ok(warm) = asked.recv() {
                let Some(claimed) = claim(&client, &pulse, &warm, &asked) else { return };
                if let Err(unwanted) = give.send(claimed) {
                    release(&client, &pulse, &unwanted.0, Vec::new());
                }
            }
        });
        Self { ask, come, is_asked: false, next: None, warm: Vec::new() }
    }

    /// Asks for the next claim, if that has not been done and none has come.
    pub fn ask(&mut self) {
        if !self.is_asked && self.next.is_none() {
            self.is_asked = self.ask.send(self.warm.clone()).is_ok();
        }
    }

    /// The claim that was asked for, if it comes within `wait`.
    pub fn wait(&mut self, wait: Duration) -> Option<Claimed> {
        self.peek(wait);
        self.next.take()
    }

    /// Looks at the claim that was asked for, if it comes within `wait`.
    pub fn peek(&mut self, wait: Duration) -> Option<&Claimed> {
        if self.next.is_none() {
            self.next = self.receive(wait);
        }
        self.next.as_ref()
    }

    fn receive(&mut self, wait: Duration) -> Option<Claimed> {
        match self.come.recv_timeout(wait) {
            Ok(claimed) => {
                self.is_asked = false;
                let warm = Warm { pass: claimed.claim.pass, segment: claimed.claim.segment };
                self.warm.retain(|other| *other != warm);
                self.warm.insert(0, warm);
                self.warm.truncate(WARM_MAX);
                Some(claimed)
            }
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(wait);
                None
            }
        }
    }
}

/// Asks until there is work; none when the session is over or nobody listens any more.
fn claim(client: &Client, pulse: &Pulse, warm: &[Warm], asked: &Receiver<Vec<Warm>>) -> Option<Claimed> {
    let client = client.with_patience(Duration::ZERO);
    let request = ClaimRequest {
        session: pulse.session.clone(),
        max: CLAIM_MAX,
        wait_ms: WAIT_MS,
        warm: warm.to_vec(),
    };
    while !pulse.is_over() {
        let sent = Instant::now();
        match client.claim(&request) {
            Ok(Some(claim)) => {
                // The lease began when the coordinator answered, at the earliest when it was asked: a long poll may have
                // waited, and the first heartbeat says more
                let lease = Lease::new(&claim.lease, claim.ttl_ms, Instant::now());
                pulse.add(lease.clone());
                return Some(Claimed { claim, lease });
            }
            Ok(None) if sent.elapsed() < Duration::from_millis(100) => std::thread::sleep(jitter(RETRY / 4)),
            Ok(None) => {}
            Err(error) if error.status().is_some() => {
                pulse.end(error);
                return None;
            }
            Err(_) if is_unheard(asked) => return None,
            Err(error) => {
                tracing::warn!("no answer to a claim: {error}");
                std::thread::sleep(jitter(RETRY));
            }
        }
        if is_unheard(asked) {
            return None;
        }
    }
    None
}

/// Whether nobody waits for a claim any more.
fn is_unheard(asked: &Receiver<Vec<Warm>>) -> bool {
    matches!(asked.try_recv(), Err(TryRecvError::Disconnected))
}

/// Gives batches of a claim back untried, all of them where none is named.
pub fn release(client: &Client, pulse: &Pulse, claimed: &Claimed, batches: Vec<i64>) {
    let request = ReleaseRequest { session: pulse.session.clone(), batches };
    if let Err(error) = client.with_patience(Duration::from_secs(5)).release(&claimed.lease.id, &request) {
        tracing::warn!("batches could not be given back, their lease will run out: {error}");
    }
    pulse.remove(&claimed.lease);
}
