//! The states of jobs, passes and batches, the classes of failure, the reasons for waiting and the roles.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// An enumeration that is a word on the wire and a small number in the database; numbers are never used again.
macro_rules! words {
    ($(#[$about:meta])* $name:ident { $($(#[$doc:meta])* $variant:ident = $code:literal $word:literal,)* }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
        pub enum $name { $($(#[$doc])* #[serde(rename = $word)] $variant,)* }

        impl $name {
            /// All of them.
            pub const ALL: &[Self] = &[$(Self::$variant,)*];

            /// The number in the database.
            pub const fn code(self) -> i64 {
                match self { $(Self::$variant => $code,)* }
            }

            /// The one with this number in the database.
            pub fn from_code(code: i64) -> Option<Self> {
                Self::ALL.iter().copied().find(|one| one.code() == code)
            }

            /// The word on the wire.
            pub const fn word(self) -> &'static str {
                match self { $(Self::$variant => $word,)* }
            }
        }

        impl std::str::FromStr for $name {
            type Err = String;

            fn from_str(word: &str) -> Result<Self, String> {
                let known = Self::ALL.iter().copied().find(|one| one.word() == word);
                known.ok_or_else(|| {
                    let words: Vec<_> = Self::ALL.iter().map(|one| one.word()).collect();
                    format!("expected one of {}", words.join(", "))
                })
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.word())
            }
        }
    };
}

words! {
    /// How far a job is. Paused jobs keep their state.
    JobState {
        /// Another job must end first.
        Blocked = 0 "blocked",
        /// Nothing of it was claimed yet.
        Ready = 1 "ready",
        /// Some of it was claimed.
        Running = 2 "running",
        /// Its leases are being taken back.
        Cancelling = 3 "cancelling",
        /// Everything is published.
        Succeeded = 4 "succeeded",
        /// It published nothing.
        Failed = 5 "failed",
        /// A person ended it.
        Cancelled = 6 "cancelled",
    }
}

impl JobState {
    /// Whether the job can only be changed by retrying or submitting it again.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

words! {
    /// What a pass does.
    PassKind {
        /// Files become microgrid streams.
        Import = 0 "import",
        /// Occluders become a brick map.
        Build = 1 "build",
        /// Points of a bake set become batches.
        Plan = 2 "plan",
        /// Batches become parts.
        Bake = 3 "bake",
        /// Parts become the decorated stream.
        Merge = 4 "merge",
    }
}

words! {
    /// How far a pass is.
    PassState {
        /// Its batches are being created.
        Creating = 0 "creating",
        /// What it needs is not there yet.
        Waiting = 1 "waiting",
        /// Its batches can be claimed.
        Open = 2 "open",
        /// All batches are done or skipped.
        Done = 3 "done",
        /// It ended with batches that failed.
        Failed = 4 "failed",
        /// Its job was cancelled or has failed.
        Cancelled = 5 "cancelled",
    }
}

words! {
    /// How far a batch is.
    BatchState {
        /// Waits for a worker.
        Ready = 0 "ready",
        /// A worker has it.
        Leased = 1 "leased",
        /// Its result is accepted.
        Done = 2 "done",
        /// It failed too often.
        Failed = 3 "failed",
        /// A person skipped it.
        Skipped = 4 "skipped",
        /// Its job was cancelled.
        Cancelled = 5 "cancelled",
    }
}

words! {
    /// Why a batch came back without a result; each class has its own rule of retry.
    FailureClass {
        /// The input is wrong: no worker will do better.
        Input = 0 "input",
        /// Storage or network failed for a while.
        TransientIo = 1 "transient_io",
        /// It needs more memory than the worker may use.
        Memory = 2 "memory",
        /// The worker is broken: disk full, damaged files.
        WorkerFault = 3 "worker_fault",
        /// The worker's code panicked or was killed by a signal.
        Crash = 4 "crash",
        /// The lease ran out: the worker was not heard of.
        Lost = 5 "lost",
        /// It took longer than it may.
        Timeout = 6 "timeout",
        /// The result does not pass its checks.
        Verify = 7 "verify",
        /// The worker gave it back: drained, pre-empted, never begun.
        Interrupted = 8 "interrupted",
    }
}

words! {
    /// Why what could run does not: exactly one reason at a time.
    WaitReason {
        /// It does not wait: batches are running, or will be within a second.
        Flowing = 0 "flowing",
        /// Nobody works here.
        NoWorker = 1 "no_worker",
        /// No worker has the labels that it asks for.
        NoMatch = 2 "no_match",
        /// Every worker that matches is busy.
        Capacity = 3 "capacity",
        /// The job runs as many batches at once as it may.
        Limit = 4 "limit",
        /// Its project has its share, or as many workers as it may.
        Quota = 5 "quota",
        /// A person or an error storm paused it.
        Paused = 6 "paused",
        /// Another job or pass must end first.
        Dependency = 7 "dependency",
        /// It failed a moment ago and is tried again later.
        Backoff = 8 "backoff",
        /// Every worker that matches has failed at it too often.
        AllWorkersBlocked = 9 "all_workers_blocked",
    }
}

words! {
    /// What a token may do.
    Role {
        /// Reads.
        Viewer = 0 "viewer",
        /// Reads, submits and controls jobs.
        Submitter = 1 "submitter",
        /// Registers as a worker, claims and completes; neither reads nor submits jobs.
        Worker = 2 "worker",
        /// Everything but a worker's work.
        Admin = 3 "admin",
    }
}

impl Role {
    /// Whether this role may do what `needed` may. Workers stand apart: they do their own work and nothing else.
    pub fn may(self, needed: Self) -> bool {
        match (self, needed) {
            (Self::Worker, needed) => needed == Self::Worker,
            (_, Self::Worker) => false,
            (has, needed) => has >= needed,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a role that may do more, or less, than it says.
    #[test]
    fn roles_may_what_they_say() {
        let may = |role: Role| Role::ALL.iter().map(|&needed| role.may(needed)).collect::<Vec<_>>();
        assert_eq!(may(Role::Viewer), [true, false, false, false]);
        assert_eq!(may(Role::Submitter), [true, true, false, false]);
        assert_eq!(may(Role::Worker), [false, false, true, false]);
        assert_eq!(may(Role::Admin), [true, true, false, true]);
    }

    /// Catches two states under one number, which a database would confuse, or one under two words.
    #[test]
    fn numbers_and_words_are_unique() {
        for &state in BatchState::ALL {
            assert_eq!(BatchState::from_code(state.code()), Some(state));
            assert_eq!(state.word().parse(), Ok(state));
        }
        for &class in FailureClass::ALL {
            assert_eq!(FailureClass::from_code(class.code()), Some(class));
            assert_eq!(class.word().parse(), Ok(class));
        }
        assert!("tired".parse::<JobState>().unwrap_err().contains("ready, running"));
    }
}
