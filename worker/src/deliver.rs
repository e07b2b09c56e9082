//! Finished work to the coordinator: parts are put, then reported, again and again until there is a definite answer.

use std::time::Duration;

use protocol::keys;
use protocol::limits::{CLAIM_MAX, MESSAGE_BYTES_MAX, cut};
use protocol::storage::FolderFile;
use protocol::work::{CompleteItem, CompleteReply, CompleteRequest, LogRequest, Outcome, Verdict};

use crate::client::Client;
use crate::depot::Depot;
use crate::heartbeat::{Lease, Pulse};
use crate::remote::LeaseDepot;
use crate::spool::{Spool, Spooled};
use crate::{Error, Result};

/// Patience with one request; requests are repeated as long as somebody may want their result.
const PATIENCE: Duration = Duration::from_secs(10);

/// Delivers parts until the spool is closed and empty.
pub fn deliver(client: &Client, pulse: &Pulse, spool: &Spool) {
    loop {
        let parts = spool.take(CLAIM_MAX as usize);
        let Some(first) = parts.first() else { return };
        let (lease, pass) = (first.lease.clone(), first.pass);
        let items = parts.iter().map(|part| item(client, pulse, part)).collect();
        let reply = report(client, pulse, &lease, (pass, &first.device), items);
        match &reply {
            Ok(reply) if reply.lease_live => {}
            Ok(reply) => {
                let unused =
                    reply.verdicts.iter().filter(|v| !matches!(v, Verdict::Accepted | Verdict::AlreadyDone));
                let unused = unused.count();
                if unused > 0 {
                    tracing::warn!("{unused} results came too late or for a cancelled job");
                }
                pulse.remove(&lease);
            }
            Err(error) => {
                tracing::warn!("{} results could not be reported: {error}", parts.len());
                pulse.remove(&lease);
            }
        }
        spool.forget(&parts);
    }
}

/// Puts a part, and says what became of its batch.
fn item(client: &Client, pulse: &Pulse, part: &Spooled) -> CompleteItem {
    let (batch, fence) = (part.batch.batch, part.batch.fence);
    let span = tracing::error_span!("delivery", job = part.job, pass = part.pass, batch, fence);
    let _span = span.entered();
    let depot = LeaseDepot {
        client: client.with_patience(PATIENCE),
        session: pulse.session.clone(),
        lease: part.lease.id.clone(),
    };
    let FolderFile { sha256, bytes } = &part.content;
    let key = keys::part(&part.job, part.pass, batch, fence, sha256);
    let put = match bytes {
        0 => Ok(()),
        _ => insist(pulse, &part.lease, || depot.write(&key, &part.path, &part.content)),
    };
    let log = LogRequest { session: pulse.session.clone(), batch, fence, text: part.log.clone() };
    // A log line is not worth a second try
    if let Err(error) = client.with_patience(Duration::ZERO).add_log(&part.lease.id, &log) {
        tracing::debug!("a log line is lost: {error}");
    }
    let outcome = match put {
        Ok(()) => Outcome::Done { sha256: sha256.clone(), bytes: *bytes as i64, result: None },
        Err(error) => failed(error),
    };
    let elapsed_ms = i64::try_from(part.elapsed.as_millis()).unwrap_or(i64::MAX);
    CompleteItem { batch, fence, elapsed_ms, traced: Some(part.traced), outcome }
}

/// A failure as an outcome.
pub fn failed(error: Error) -> Outcome {
    let (class, message) = (error.class(), error.to_string());
    let bad_parts = if let Error::BadParts(parts) = error { parts } else { Vec::new() };
    Outcome::Failed { class, message: cut(&message, MESSAGE_BYTES_MAX).into(), bad_parts }
}

/// Reports what became of batches of `pass`, which `device` traced.
///
/// # Errors
/// When the coordinator refuses, or nobody wants the result any more.
pub fn report(
    client: &Client,
    pulse: &Pulse,
    lease: &Lease,
    (pass, device): (i64, &str),
    items: Vec<CompleteItem>,
) -> Result<CompleteReply> {
    let request = CompleteRequest { session: pulse.session.clone(), pass, device: device.into(), items };
    let client = client.with_patience(PATIENCE);
    insist(pulse, lease, || client.complete(&lease.id, &request))
}

/// Repeats until there is a definite answer; once where the lease is known to be over.
fn insist<T>(pulse: &Pulse, lease: &Lease, mut ask: impl FnMut() -> Result<T>) -> Result<T> {
    loop {
        match ask() {
            Err(Error::Unreachable(message)) if !lease.is_cancelled() && !pulse.is_over() => {
                tracing::warn!("a result waits: {message}");
            }
            answer => return answer,
        }
    }
}
