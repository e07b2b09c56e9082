//! What workers ask: to be known, for work, to go on, to be rid of it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use protocol::keys;
use protocol::limits::{self, CLAIM_MAX};
use protocol::traced::Traced;
use protocol::work::{
    Claim, ClaimRequest, CompleteItem, CompleteReply, CompleteRequest, HeartbeatReply, HeartbeatRequest,
    Outcome, PROTOCOL_VERSION, RegisterReply, RegisterRequest, ReleaseRequest, Task, Verdict,
};

use super::{Coordinator, lock};
use crate::db::claim::{Claimer, Taken};
use crate::db::complete::{Completion, Reporter};
use crate::db::opinion::Distrusted;
use crate::db::worker::Session;
use crate::error::Kind;
use crate::scheduler::choose::{Asker, Candidate, Locality, choose};
use crate::{Error, Result, random};

/// Milliseconds for which a session is not asked of the database again. Those that go on are renewed together, sooner than
/// that; and a claim is the database's to refuse.
const SESSION_MS: i64 = 60_000;
/// Sessions and tasks that are remembered at most.
const REMEMBERED_MAX: usize = 65_536;
/// Milliseconds for which a segment that gave nothing is left alone.
const EMPTY_MS: i64 = 500;
/// Claims that choose a segment and ask the database for it at once. All that wait are woken together: if all chose at once, all
/// would choose the same.
pub(super) const CLAIMS_AT_ONCE: usize = 8;
/// The longest sleep of a claim that waits: a wake-up may have been another coordinator's to give.
const POLL: Duration = Duration::from_secs(5);

/// The first sleep of a claim that came while others had all that it could have; the next ones are longer.
const CROWDED: Duration = Duration::from_millis(10);

impl Coordinator {
    /// Makes a worker's process known; leases of its earlier processes end.
    ///
    /// # Errors
    /// [`Kind::Conflict`] when the name is another's, [`Kind::Invalid`] for another protocol or an impossible name.
    pub async fn register(
        &self,
        request: &RegisterRequest,
        token: Option<&str>,
        granted_labels: &[String],
    ) -> Result<RegisterReply> {
        if !(PROTOCOL_VERSION.saturating_sub(1).max(1)..=PROTOCOL_VERSION).contains(&request.protocol) {
            let message = format!("protocol version `{}`, `{PROTOCOL_VERSION}` wanted", request.protocol);
            return Err(Error::invalid(message).hint("use a worker of the coordinator's version"));
        }
        let mut labels = request.labels.clone();
        labels.extend(granted_labels.iter().filter(|label| !request.labels.contains(label)).cloned());
        let named = labels.iter().chain([&request.name]).all(|name| limits::is_name(name));
        if !named || labels.len() > limits::LABELS_MAX {
            return Err(Error::invalid("a worker's name or label is not possible")
                .hint("letters, digits, `-`, `_`, `.` and `=`, up to 100 of them"));
        }
        let session = random::id(self.now());
        self.store.register(request, &labels, token, &session, self.now()).await?;
        self.forget_sessions(&request.name);
        let around = self.around(&request.name);
        for completion in self.store.end_leases_of(&request.name, &session, &around).await? {
            self.settled(&completion);
        }
        self.changed([]);
        let heartbeat_ms = limits::HEARTBEAT_MS.min(self.settings.lease_ttl_ms as u64 / 6).max(50);
        Ok(RegisterReply { session, heartbeat_ms, lease_ttl_ms: self.settings.lease_ttl_ms })
    }

    /// The process of a session, if it is this token's.
    pub(super) async fn session(&self, id: &str, token: Option<&str>) -> Result<Session> {
        let now = self.now();
        let known = lock(&self.sessions).get(id).filter(|(_, at)| now - at < SESSION_MS).cloned();
        let session = match known {
            Some((session, _)) => session,
            None => {
                let session = self.store.session(id).await?;
                let mut sessions = lock(&self.sessions);
                if sessions.len() >= REMEMBERED_MAX {
                    sessions.clear();
                }
                sessions.insert(id.into(), (session.clone(), now));
                session
            }
        };
        if session.token.as_deref() != token {
            return Err(Error::new(Kind::Gone, "the session is over").hint("register again"));
        }
        lock(&self.seen).insert(session.worker.clone());
        self.write_farm(|farm| {
            if let Some(worker) = farm.workers.get_mut(&session.worker) {
                worker.last_seen = now;
            }
        });
        Ok(session)
    }

    /// Forgets what was known of a worker's processes.
    pub fn forget_sessions(&self, worker: &str) {
        lock(&self.sessions).retain(|_, (session, _)| session.worker != worker);
    }

    /// Remembers processes that the database has just named.
    pub(super) fn renew_sessions(&self, named: Vec<(String, Session)>) {
        let now = self.now();
        let mut sessions = lock(&self.sessions);
        for (id, session) in named {
            if let Some(known) = sessions.get_mut(&id) {
                *known = (session, now);
            }
        }
    }

    /// Claims work, waiting for it as long as the request allows.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the session is over, [`Kind::Unavailable`] when this coordinator is about to end.
    pub async fn claim(&self, request: &ClaimRequest, token: Option<&str>) -> Result<Option<Claim>> {
        let deadline = Instant::now() + Duration::from_millis(request.wait_ms.min(limits::CLAIM_WAIT_MS_MAX));
        self.waiting.fetch_add(1, Ordering::Relaxed);
        let _waits = Waiting(self);
        let mut crowded = 0;
        loop {
            if self.is_stopping() {
                return Err(stopping());
            }
            let mut woken = std::pin::pin!(self.wake.notified());
            woken.as_mut().enable();
            let session = self.session(&request.session, token).await?;
            let (claim, is_busy) = self.try_claim(request, &session).await?;
            if let Some(claim) = claim {
                metrics::counter!("pantaray_claims_total", "result" => "granted").increment(1);
                return Ok(Some(claim));
            }
            crowded = if is_busy { crowded + 1 } else { 0 };
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                metrics::counter!("pantaray_claims_total", "result" => "empty").increment(1);
                return Ok(None);
            }
            // Whoever is not woken looks again after a while, soon where others only were faster; a little apart from them
            let poll = match crowded {
                0 => POLL + Duration::from_millis(random::bits() % 1000),
                tries => CROWDED * (1 << tries.min(6)) + Duration::from_millis(random::bits() % 20),
            };
            tokio::select! { () = woken => {}, () = tokio::time::sleep(left.min(poll)) => {} }
        }
    }

    /// What there is for a worker; if nothing, whether there was something and others were faster.
    async fn try_claim(&self, request: &ClaimRequest, session: &Session) -> Result<(Option<Claim>, bool)> {
        let start = Instant::now();
        let _turn = self.turns.acquire().await.map_err(|_| stopping())?;
        let warm: Vec<(i64, i64)> = request.warm.iter().take(8).map(|w| (w.pass, w.segment)).collect();
        let (candidates, alive) = self
            .read_farm(|farm| {
                let now = self.now();
                let worker =
                    farm.workers.get(&session.worker).filter(|w| !w.withheld && !session.draining)?;
                let max = request.max.clamp(1, CLAIM_MAX);
                let asker = Asker { name: &session.worker, worker, warm: &warm, max };
                Some((choose(farm, &asker, now, random::bits()), farm.alive(now)))
            })
            .unwrap_or_default();
        let is_busy = !candidates.is_empty();
        for candidate in candidates {
            let claimer = Claimer {
                worker: &session.worker,
                session: &request.session,
                memory_bytes: session.memory_bytes,
                alive,
            };
            let from_tail = candidate.locality == Locality::Steal;
            let (ttl, now) = (self.settings.lease_ttl_ms, self.now());
            let granted = match self.store.claim(&candidate, from_tail, &claimer, ttl, now).await? {
                Taken::Granted(granted) => granted,
                Taken::Busy => continue,
                Taken::Empty => {
                    self.write_farm(|farm| {
                        farm.was_empty(candidate.pass, candidate.segment, now + EMPTY_MS);
                    });
                    continue;
                }
            };
            let Candidate { pass, segment, locality, .. } = candidate;
            let count = granted.batches.len() as i64;
            let owner = (!from_tail).then_some((session.worker.as_str(), now + 2 * ttl));
            self.write_farm(|farm| farm.claimed(pass, segment, owner, count));
            metrics::counter!("pantaray_claims_locality_total", "kind" => locality.word()).increment(1);
            metrics::histogram!("pantaray_claim_seconds").record(start.elapsed().as_secs_f64());
            let task = self.task(pass).await?;
            let task = (*task).clone();
            let claim =
                Claim { lease: granted.lease, ttl_ms: ttl, pass, task, segment, batches: granted.batches };
            return Ok((Some(claim), false));
        }
        Ok((None, is_busy))
    }

    /// What a pass does; that never changes.
    pub(super) async fn task(&self, pass: i64) -> Result<Arc<Task>> {
        if let Some(task) = lock(&self.tasks).get(&pass) {
            return Ok(task.clone());
        }
        let task = Arc::new(self.store.task(pass).await?);
        let mut tasks = lock(&self.tasks);
        if tasks.len() >= REMEMBERED_MAX {
            tasks.clear();
        }
        tasks.insert(pass, task.clone());
        Ok(task)
    }

    /// Extends leases, and says which are over.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the session is over.
    pub async fn heartbeat(&self, request: &HeartbeatRequest, token: Option<&str>) -> Result<HeartbeatReply> {
        let session = self.session(&request.session, token).await?;
        let leases: Vec<String> = request.leases.iter().take(256).map(|l| l.lease.clone()).collect();
        let ttl = self.settings.lease_ttl_ms;
        let (extended, ended) = self.store.extend(&request.session, &leases, ttl, self.now()).await?;
        Ok(HeartbeatReply { extended, ended, drain: session.draining || self.is_stopping() })
    }

    /// Takes results in.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the session is over, [`Kind::Invalid`] for results that cannot be any.
    pub async fn complete(
        &self,
        lease: &str,
        request: &CompleteRequest,
        token: Option<&str>,
    ) -> Result<CompleteReply> {
        check_items(request)?;
        let start = Instant::now();
        let session = self.session(&request.session, token).await?;
        let reporter = Reporter {
            lease,
            pass: request.pass,
            session: &request.session,
            worker: &session.worker,
            device: &request.device,
            around: self.around(&session.worker),
            opinion_every: self.settings.opinion_every,
        };
        let items = self.verified(request).await?;
        let completion = self.store.complete(&reporter, &items).await?;
        log(&completion, &session.worker, request.pass, &items);
        self.settled(&completion);
        self.distrust(&completion).await?;
        count_traced(&request.device, &completion.traced);
        metrics::histogram!("pantaray_complete_seconds").record(start.elapsed().as_secs_f64());
        for verdict in &completion.verdicts {
            let outcome = match verdict {
                Verdict::Accepted => "accepted",
                Verdict::AlreadyDone => "already_done",
                Verdict::Superseded => "superseded",
                Verdict::Cancelled => "cancelled",
                Verdict::Rejected => "rejected",
            };
            metrics::counter!("pantaray_completions_total", "outcome" => outcome).increment(1);
        }
        Ok(CompleteReply { verdicts: completion.verdicts, lease_live: completion.lease_live })
    }

    /// Ends what workers have that are not believed any more.
    async fn distrust(&self, completion: &Completion) -> Result<()> {
        for Distrusted { worker, reason, .. } in &completion.distrusted {
            tracing::error!(worker, job = completion.job, "a worker is locked: {reason}");
            metrics::counter!("pantaray_workers_distrusted_total").increment(1);
            self.forget_sessions(worker);
            for ended in self.store.end_leases_of(worker, "", &self.around(worker)).await? {
                self.settled(&ended);
            }
        }
        Ok(())
    }

    /// Takes batches back untried.
    ///
    /// # Errors
    /// [`Kind::Gone`] when the session or the lease is over.
    pub async fn release(&self, lease: &str, request: &ReleaseRequest, token: Option<&str>) -> Result<()> {
        let session = self.session(&request.session, token).await?;
        let around = self.around(&session.worker);
        let released = self.store.release(lease, &request.session, &request.batches, &around).await?;
        let released = released.ok_or_else(|| Error::new(Kind::Gone, "the lease is over"))?;
        self.settled(&released);
        Ok(())
    }

    /// Brings the view of the farm up to date with what happened to a lease's batches.
    pub(super) fn settled(&self, completion: &Completion) {
        let Completion { pass, segment, ended, ready, .. } = *completion;
        if ended > 0 {
            let is_over = !completion.lease_live;
            self.write_farm(|farm| farm.returned(pass, segment, ended, ready, is_over));
            self.wake_workers(ready);
        }
        if completion.diverged {
            tracing::error!(pass, segment, "two results of one batch differ");
            metrics::counter!("pantaray_output_divergence_total").increment(1);
        }
        if completion.advances || completion.storm.is_some() {
            self.changed([completion.job.clone()]);
        } else if completion.blames {
            // Whether the worker gets more of this job, or of any, is in the database
            self.changed([]);
        }
    }

    /// Wakes as many waiting workers as there is work for.
    pub(super) fn wake_workers(&self, batches: i64) {
        let waiting = self.waiting.load(Ordering::Relaxed) as i64;
        for _ in 0..batches.min(waiting) {
            self.wake.notify_one();
        }
    }
}

/// Logs what became of batches: failures for everybody, all of it for who wants to know.
fn log(completion: &Completion, worker: &str, pass: i64, items: &[CompleteItem]) {
    let job = completion.job.as_str();
    for (item, verdict) in items.iter().zip(&completion.verdicts) {
        let (batch, fence) = (item.batch, item.fence);
        match &item.outcome {
            Outcome::Failed { class, message, .. } => {
                tracing::warn!(job, pass, batch, fence, worker, %class, ?verdict, "a batch failed: {message}");
            }
            Outcome::Done { .. } => {
                tracing::debug!(job, pass, batch, fence, worker, ?verdict, "a batch is done");
            }
        }
    }
}

fn stopping() -> Error {
    Error::new(Kind::Unavailable, "this coordinator is about to end")
}

/// Counts a claim among those that wait for as long as it lives.
struct Waiting<'a>(&'a Coordinator);

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.waiting.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Adds what tracing took to this process's figures. Devices have too many names for a label: there are two kinds.
fn count_traced(device: &str, traced: &Traced) {
    if traced.batches == 0 {
        return;
    }
    let kind = if device == "cpu" { "cpu" } else { "gpu" };
    let count = |name: &'static str, value: i64| {
        metrics::counter!(name, "device" => kind).increment(value.max(0).unsigned_abs());
    };
    count("pantaray_traced_batches_total", traced.batches);
    count("pantaray_traced_points_total", traced.points);
    count("pantaray_traced_rays_total", traced.rays);
    count("pantaray_trace_microseconds_total", traced.trace_us);
    count("pantaray_brick_requests_total", traced.brick_requests);
    count("pantaray_brick_misses_total", traced.brick_misses);
    count("pantaray_read_bytes_total", traced.read_bytes);
    count("pantaray_device_bytes_total", traced.device_bytes);
    count("pantaray_device_microseconds_total", traced.device_us);
}

fn check_items(request: &CompleteRequest) -> Result<()> {
    if request.items.is_empty() || request.items.len() as i64 > CLAIM_MAX {
        return Err(Error::invalid(format!(
            "`{}` results, 1 to {CLAIM_MAX} are possible",
            request.items.len()
        )));
    }
    let mut batches: Vec<i64> = request.items.iter().map(|item| item.batch).collect();
    batches.sort_unstable();
    if batches.windows(2).any(|pair| pair[0] == pair[1]) {
        return Err(Error::invalid("a batch is named twice"));
    }
    let bad = |outcome: &Outcome| matches!(outcome, Outcome::Done { sha256, .. } if !keys::is_sha256(sha256));
    match request.items.iter().find(|item| bad(&item.outcome)) {
        Some(item) => Err(Error::invalid(format!("the hash of batch `{}` is no SHA-256", item.batch))),
        None => Ok(()),
    }
}
