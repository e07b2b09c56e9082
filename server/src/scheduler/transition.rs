//! The life of a batch: which event leads from which state to which.

use protocol::BatchState;

/// What can happen to a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// A worker takes it; its fence rises.
    Claim,
    /// Its result under the current fence arrives.
    Accept,
    /// It failed, was lost or given back, and is tried again.
    Retry,
    /// It failed too often.
    GiveUp,
    /// A merge found its part damaged.
    Reject,
    /// A person wants it tried again.
    Revive,
    /// A person does without it.
    Skip,
    /// Its job was cancelled.
    Cancel,
}

/// The state after `event`, or none where it cannot happen.
pub fn next(state: BatchState, event: Event) -> Option<BatchState> {
    use BatchState::{Cancelled, Done, Failed, Leased, Ready, Skipped};
    Some(match (state, event) {
        (Ready, Event::Claim) => Leased,
        (Leased, Event::Accept) => Done,
        (Leased, Event::Retry) => Ready,
        (Leased, Event::GiveUp) => Failed,
        (Done, Event::Reject) => Ready,
        (Failed | Skipped, Event::Revive) => Ready,
        (Ready | Failed, Event::Skip) => Skipped,
        (Ready | Leased, Event::Cancel) => Cancelled,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a second acceptance, a claim of what is claimed, and a cancelled batch that comes back to life.
    #[test]
    fn results_count_once_and_the_cancelled_stay_so() {
        for &state in BatchState::ALL {
            assert_eq!(next(state, Event::Accept).is_some(), state == BatchState::Leased);
            assert_eq!(next(state, Event::Claim).is_some(), state == BatchState::Ready);
        }
        let events = [Event::Claim, Event::Accept, Event::Retry, Event::Reject, Event::Revive, Event::Skip];
        assert!(events.iter().all(|&event| next(BatchState::Cancelled, event).is_none()));
    }
}
