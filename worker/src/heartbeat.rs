//! Signs of life, and what they bring: leases that go on, leases that are over, the wish that the worker drain.
//!
//! A lease that was not extended for as long as it lasts, less a margin, by this machine's monotonic clock, is taken to be
//! over: no batch of it is begun. What was finished is offered all the same; the coordinator decides.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use engine::bake::Progress;
use protocol::work::{HeartbeatRequest, LeaseProgress, RegisterReply};

use crate::Error;
use crate::client::{Client, jitter};

/// Wait after a heartbeat that failed.
const RETRY: Duration = Duration::from_secs(1);

/// A lease that is being worked on.
#[derive(Debug)]
pub struct Lease {
    /// Its id.
    pub id: String,
    /// Set when its work is to end.
    pub cancel: AtomicBool,
    /// When it was surely alive, and how long it lasts from there.
    alive: Mutex<Instant>,
    lasts: Duration,
    /// The bits of a share from 0 to 1.
    progress: AtomicU64,
}

impl Lease {
    /// A lease that was asked for at `asked`.
    pub fn new(id: &str, ttl_ms: i64, asked: Instant) -> Arc<Self> {
        let ttl = Duration::from_millis(ttl_ms.max(0).unsigned_abs());
        let lasts = ttl - (ttl / 4).min(Duration::from_secs(10));
        let (cancel, progress) = Default::default();
        Arc::new(Self { id: id.into(), cancel, alive: Mutex::new(asked), lasts, progress })
    }

    /// Whether its work is to end.
    pub fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// Whether a batch of it may be begun.
    pub fn is_live(&self) -> bool {
        !self.is_cancelled() && lock(&self.alive).elapsed() < self.lasts
    }
}

impl Progress for Lease {
    fn update(&self, _stage: &str, done: f64, _detail: &str) {
        self.progress.store(done.to_bits(), Ordering::Relaxed);
    }
}

/// What the worker's threads share.
#[derive(Debug)]
pub struct Pulse {
    /// The process's session.
    pub session: String,
    interval: Duration,
    leases: Mutex<Vec<Arc<Lease>>>,
    /// The coordinator wants the worker to finish what it has and claim nothing more.
    pub drain: AtomicBool,
    /// Why the session is over.
    end: Mutex<Option<Error>>,
    is_over: AtomicBool,
    stopped: (Mutex<bool>, Condvar),
}

impl Pulse {
    /// The pulse of a session that has just begun.
    pub fn new(reply: &RegisterReply) -> Self {
        let interval = Duration::from_millis(reply.heartbeat_ms.clamp(10, 60_000));
        let (leases, drain, end, is_over, stopped) = Default::default();
        Self { session: reply.session.clone(), interval, leases, drain, end, is_over, stopped }
    }

    /// Keeps a lease alive from now on.
    pub fn add(&self, lease: Arc<Lease>) {
        lock(&self.leases).push(lease);
    }

    /// Lets a lease be.
    pub fn remove(&self, lease: &Lease) {
        lock(&self.leases).retain(|other| other.id != lease.id);
    }

    /// Whether the coordinator does not know the session any more, or refuses it.
    pub fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    /// Why it is over.
    pub fn take_end(&self) -> Option<Error> {
        lock(&self.end).take()
    }

    /// The session is over: all of its work ends.
    pub fn end(&self, error: Error) {
        lock(&self.end).get_or_insert(error);
        self.is_over.store(true, Ordering::Relaxed);
        self.cancel_all();
    }

    /// Ends the work of every lease.
    pub fn cancel_all(&self) {
        lock(&self.leases).iter().for_each(|lease| lease.cancel.store(true, Ordering::Relaxed));
    }

    /// Ends [`beat`](Self::beat).
    pub fn stop(&self) {
        *lock(&self.stopped.0) = true;
        self.stopped.1.notify_all();
    }

    /// Gives signs of life until it is stopped or the session is over.
    pub fn beat(&self, client: &Client) {
        let client = client.with_patience(Duration::ZERO);
        let mut pause = self.interval;
        while !self.is_over() && !self.pause(pause) {
            pause = match self.beat_once(&client) {
                Ok(()) => self.interval,
                Err(error) if error.status().is_some() => {
                    self.end(error);
                    return;
                }
                Err(error) => {
                    tracing::warn!("no answer to a heartbeat: {error}");
                    jitter(RETRY.min(self.interval))
                }
            };
        }
    }

    fn beat_once(&self, client: &Client) -> crate::Result<()> {
        let leases = lock(&self.leases).clone();
        let progress = |lease: &Arc<Lease>| LeaseProgress {
            lease: lease.id.clone(),
            progress: f64::from_bits(lease.progress.load(Ordering::Relaxed)),
        };
        let request =
            HeartbeatRequest { session: self.session.clone(), leases: leases.iter().map(progress).collect() };
        let sent = Instant::now();
        let reply = client.heartbeat(&request)?;
        for lease in &leases {
            if reply.extended.contains(&lease.id) {
                *lock(&lease.alive) = sent;
            } else if reply.ended.contains(&lease.id) {
                lease.cancel.store(true, Ordering::Relaxed);
            }
        }
        self.drain.store(reply.drain, Ordering::Relaxed);
        Ok(())
    }

    /// Waits; whether it was stopped.
    fn pause(&self, pause: Duration) -> bool {
        let (stopped, woken) = &self.stopped;
        let waited = woken.wait_timeout_while(lock(stopped), pause, |stopped| !*stopped);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a worker that begins a batch when its lease may have run out already.
    #[test]
    fn leases_fence_themselves_before_they_run_out() {
        let ago = |seconds| Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
        assert!(Lease::new("a", 60_000, ago(49)).is_live());
        assert!(!Lease::new("a", 60_000, ago(50)).is_live());
        assert!(Lease::new("a", 4_000, ago(2)).is_live());
        assert!(!Lease::new("a", 4_000, ago(3)).is_live());
        let lease = Lease::new("a", 60_000, ago(0));
        lease.cancel.store(true, Ordering::Relaxed);
        assert!(!lease.is_live());
    }
}
