//! The coordinator's clock: milliseconds since 1970 that never run backwards, in step with the database's clock where it
//! has one. Tests wind it on.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// A clock; clones are the same clock.
#[derive(Clone, Debug)]
pub struct Clock {
    start: Instant,
    /// What it said at `start`.
    offset_ms: Arc<AtomicI64>,
}

impl Default for Clock {
    fn default() -> Self {
        Self { start: Instant::now(), offset_ms: Arc::new(AtomicI64::new(system_ms())) }
    }
}

fn system_ms() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |time| time.as_millis() as i64)
        + crate::faults::clock_off_ms()
}

impl Clock {
    /// Milliseconds since 1970.
    pub fn now_ms(&self) -> i64 {
        self.offset_ms.load(Ordering::Relaxed) + self.start.elapsed().as_millis() as i64
    }

    /// Sets it to what another clock says now.
    pub fn set_ms(&self, now: i64) {
        self.offset_ms.store(now - self.start.elapsed().as_millis() as i64, Ordering::Relaxed);
    }

    /// Winds it on.
    pub fn advance_ms(&self, ms: i64) {
        self.offset_ms.fetch_add(ms, Ordering::Relaxed);
    }
}
