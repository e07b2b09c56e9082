//! Ctrl-C and its kin: the first asks the work to end cleanly, the second ends the process at once.

use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};

use engine::{Error, ErrorKind, Result};

static CANCELLED: AtomicBool = AtomicBool::new(false);

/// Listens to SIGINT, SIGTERM and SIGHUP, or what stands for them on other systems.
pub fn install() -> Result<()> {
    ctrlc::set_handler(|| {
        if CANCELLED.swap(true, Ordering::SeqCst) {
            std::process::exit(1);
        }
        let _ = std::io::stderr().write_all(b"stopping; once more ends it at once\n");
    })
    .map_err(|error| Error::new(ErrorKind::Io, "cannot listen to signals").caused_by(error))
}

/// Set once the user asked to stop.
pub fn cancel_flag() -> &'static AtomicBool {
    &CANCELLED
}
