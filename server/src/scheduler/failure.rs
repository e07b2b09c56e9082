//! What becomes of a batch that came back without a result: each class of failure has its own rule.

use protocol::FailureClass;

/// Distinct workers that fail at a batch before it is given up.
pub const WORKERS_MAX: i64 = 3;
/// Tries before a batch is given up where fewer workers exist.
pub const TRIES_MAX: i64 = 5;
/// Leases of a batch that may run out.
pub const LOST_MAX: i64 = 5;
/// Milliseconds for which storage and network may fail.
pub const TRANSIENT_MS_MAX: i64 = 24 * 3_600_000;
/// The longest pause after a passing failure, in milliseconds.
const BACKOFF_MS_MAX: i64 = 300_000;
/// Failures of one job on one worker that are the worker's fault, before it gets no more of that job.
pub const BLOCK_AFTER: i64 = 3;
/// Distinct batches that failed by the worker's fault within [`SICK_MS`], before it gets no work at all.
pub const SICK_AFTER: i64 = 5;
/// Milliseconds that a sick worker rests.
pub const SICK_MS: i64 = 30 * 60_000;
/// Failures of one class among the first batches of a pass that pause its job.
pub const STORM_FAILURES: i64 = 20;
/// How many batches count as a pass's first.
pub const STORM_BATCHES: i64 = 100;

/// What is known of a batch's failures, this one included.
#[derive(Clone, Copy, Debug, Default)]
pub struct History {
    /// Tries before this one that count against the batch.
    pub tries: i64,
    /// Leases that ran out before this one.
    pub lost: i64,
    /// Distinct workers that have failed at it in a way that counts.
    pub workers: i64,
    /// Distinct workers that call its input wrong.
    pub input_workers: i64,
    /// Passing failures.
    pub transient: i64,
    /// When the first passing failure was.
    pub transient_since: i64,
    /// Memory that it is known to need.
    pub memory_min: i64,
}

/// Around the failure.
#[derive(Clone, Copy, Debug)]
pub struct Around {
    /// The time.
    pub now: i64,
    /// Workers that are alive.
    pub workers_alive: i64,
    /// Memory of the worker that failed.
    pub worker_memory: i64,
    /// A random number, for the length of pauses.
    pub random: u64,
}

/// What becomes of the batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ruling {
    /// It is given up.
    pub fails: bool,
    /// Otherwise it is not claimed before this time.
    pub not_before: i64,
    /// Added to its tries.
    pub tries: i64,
    /// Added to its lost leases.
    pub lost: i64,
    /// Memory that a worker must have from now on.
    pub memory_min: i64,
    /// Whether the worker is to blame.
    pub blames_worker: bool,
}

/// Whether failures of this class count the worker towards [`WORKERS_MAX`].
pub fn counts_worker(class: FailureClass) -> bool {
    use FailureClass::{Crash, Memory, Timeout, Verify, WorkerFault};
    matches!(class, Crash | Memory | Timeout | Verify | WorkerFault)
}

/// Rules on a failure.
pub fn rule(class: FailureClass, history: &History, around: &Around) -> Ruling {
    use FailureClass::{Crash, Input, Interrupted, Lost, Memory, Timeout, TransientIo, Verify, WorkerFault};
    let mut ruling = Ruling {
        fails: false,
        not_before: 0,
        tries: 0,
        lost: 0,
        memory_min: history.memory_min,
        blames_worker: false,
    };
    let given_up = |tries: i64| history.tries + tries >= TRIES_MAX || history.workers >= WORKERS_MAX;
    match class {
        Input => ruling.fails = history.input_workers >= around.workers_alive.clamp(1, 2),
        TransientIo => {
            ruling.fails = around.now - history.transient_since > TRANSIENT_MS_MAX;
            ruling.not_before = around.now + backoff_ms(history.transient, around.random);
        }
        Memory => {
            (ruling.tries, ruling.fails) = (1, given_up(1));
            ruling.memory_min = history.memory_min.max(around.worker_memory) / 2 * 3;
        }
        WorkerFault => (ruling.blames_worker, ruling.fails) = (true, given_up(0)),
        Verify => (ruling.tries, ruling.blames_worker, ruling.fails) = (1, true, given_up(1)),
        Crash => (ruling.tries, ruling.fails) = (1, given_up(1)),
        Timeout => (ruling.tries, ruling.fails) = (1, history.tries >= 1),
        Lost => (ruling.lost, ruling.fails) = (1, history.lost + 1 >= LOST_MAX),
        Interrupted => {}
    }
    ruling
}

/// A random time up to a bound that doubles with every failure, so that those who failed together do not return together.
fn backoff_ms(failures: i64, random: u64) -> i64 {
    let bound = (1_000_i64 << failures.clamp(0, 10)).min(BACKOFF_MS_MAX);
    1 + (random % bound as u64) as i64
}

#[cfg(test)]
mod tests {
    use super::*;

    const AROUND: Around =
        Around { now: 1_000_000, workers_alive: 9, worker_memory: 4 << 30, random: 77_777 };

    /// Catches a class that burns tries it should not, or is retried for ever.
    #[test]
    fn every_class_ends() {
        for &class in FailureClass::ALL {
            if class == FailureClass::Interrupted {
                continue;
            }
            let (mut history, mut around) =
                (History { transient_since: AROUND.now, ..History::default() }, AROUND);
            let rulings = (1..1000).map(|round| {
                history.workers = if counts_worker(class) { round } else { 0 };
                history.input_workers = round;
                history.transient = round;
                let ruling = rule(class, &history, &around);
                history.tries += ruling.tries;
                history.lost += ruling.lost;
                around.now += 300_000;
                ruling
            });
            let rounds = rulings.take_while(|ruling| !ruling.fails).count() + 1;
            let expected = match class {
                FailureClass::Input | FailureClass::Timeout => 2,
                FailureClass::TransientIo => 290,
                FailureClass::Lost => 5,
                _ => 3,
            };
            assert_eq!(rounds, expected, "{class}");
        }
    }

    /// Catches a farm of one worker that never gives up, or gives up at once.
    #[test]
    fn one_worker_has_five_tries() {
        let history = |tries| History { tries, workers: 1, ..History::default() };
        assert!(!rule(FailureClass::Crash, &history(3), &AROUND).fails);
        assert!(rule(FailureClass::Crash, &history(4), &AROUND).fails);
        assert!(!rule(FailureClass::TransientIo, &history(4), &AROUND).fails);
    }

    /// Catches pauses that do not grow, or grow without end.
    #[test]
    fn pauses_grow_to_five_minutes() {
        let longest = |failures| (0..10_000).map(|i| backoff_ms(failures, i * 7919)).max().unwrap();
        assert!(longest(0) <= 1_000 && longest(3) > 4_000 && longest(60) <= BACKOFF_MS_MAX);
    }
}
