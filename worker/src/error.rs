//! Why work ended without a result, and which class of failure that is.

use std::fmt;

use engine::ErrorKind;
use protocol::work::ClaimedBatch;
use protocol::{FailureClass, Problem};

/// The worker's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why work ended without a result.
#[derive(Debug)]
pub enum Error {
    /// The engine, or this machine, says so.
    Engine(engine::Error),
    /// The coordinator's definite answer: asking again changes nothing.
    Refused(Box<Problem>),
    /// No definite answer, however often it was asked.
    Unreachable(String),
    /// Bytes that came are not those that were announced.
    Damaged(String),
    /// A merge found these parts damaged.
    BadParts(Vec<ClaimedBatch>),
    /// The engine panicked, with these words.
    Crashed(String),
}

impl Error {
    /// The class of this failure.
    pub fn class(&self) -> FailureClass {
        match self {
            Self::Engine(error) => match error.kind() {
                ErrorKind::Limit => FailureClass::Memory,
                ErrorKind::Io | ErrorKind::Device => FailureClass::WorkerFault,
                ErrorKind::Busy => FailureClass::TransientIo,
                ErrorKind::Cancelled => FailureClass::Interrupted,
                _ => FailureClass::Input,
            },
            // An object that is not there yet, or not any more: storage lags, or somebody cleaned up
            Self::Refused(problem) if problem.status == 404 => FailureClass::TransientIo,
            Self::Refused(_) => FailureClass::WorkerFault,
            Self::Unreachable(_) | Self::Damaged(_) => FailureClass::TransientIo,
            Self::BadParts(_) => FailureClass::Verify,
            Self::Crashed(_) => FailureClass::Crash,
        }
    }

    /// The status of a definite answer.
    pub fn status(&self) -> Option<u16> {
        match self {
            Self::Refused(problem) => Some(problem.status),
            _ => None,
        }
    }

    /// The same failure for another of several things that failed together.
    pub fn repeated(&self) -> Self {
        match self {
            Self::Refused(problem) => Self::Refused(problem.clone()),
            other => Self::Unreachable(other.to_string()),
        }
    }

    /// Whether the work was asked to stop.
    pub fn is_cancelled(&self) -> bool {
        matches!(self, Self::Engine(error) if error.kind() == ErrorKind::Cancelled)
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Engine(error) => {
                write!(f, "{error}")?;
                let mut cause = std::error::Error::source(error);
                while let Some(source) = cause {
                    write!(f, ": {source}")?;
                    cause = source.source();
                }
                Ok(())
            }
            Self::Refused(problem) => write!(f, "{} ({})", problem.detail, problem.status),
            Self::Unreachable(message) | Self::Damaged(message) => f.write_str(message),
            Self::BadParts(parts) => write!(f, "{} parts are damaged", parts.len()),
            Self::Crashed(words) => write!(f, "the engine panicked: {words}"),
        }
    }
}

impl std::error::Error for Error {}

impl From<engine::Error> for Error {
    fn from(error: engine::Error) -> Self {
        Self::Engine(error)
    }
}

impl From<Error> for engine::Error {
    fn from(error: Error) -> Self {
        match error {
            Error::Engine(error) => error,
            Error::Refused(problem) => {
                let kind = if problem.status == 404 { ErrorKind::NotFound } else { ErrorKind::Invalid };
                let error = Self::new(kind, problem.detail);
                problem.hint.into_iter().fold(error, Self::hint)
            }
            Error::Damaged(message) => Self::new(ErrorKind::Corrupt, message),
            other => Self::new(ErrorKind::Io, other.to_string()),
        }
    }
}
