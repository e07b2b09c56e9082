//! Ctrl-C and its kin: the first asks the work to end cleanly, the second ends the process at once.

use std::sync::atomic::{AtomicBool, Ordering};

use engine::{Error, ErrorKind, Result};

use crate::console::LogFormat;

static CANCELLED: AtomicBool = AtomicBool::new(false);

/// Listens to SIGINT, SIGTERM and SIGHUP, or what stands for them on other systems.
pub fn install(log_format: LogFormat) -> Result<()> {
    ctrlc::set_handler(move || {
        if CANCELLED.swap(true, Ordering::SeqCst) {
            std::process::exit(1);
        }
        log_format.tell("stopping; once more ends it at once");
    })
    .map_err(|error| Error::new(ErrorKind::Io, "cannot listen to signals").caused_by(error))
}

/// Set once the user asked to stop.
pub fn cancel_flag() -> &'static AtomicBool {
    &CANCELLED
}
