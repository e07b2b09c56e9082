//! Points at which a test kills the process, and a system clock that is wrong. Without the feature `faults` they are nothing.

/// Kills the process here if `PANTARAY_FAULT` is `NAME:WHEN:COUNT` and this is the point's `COUNT`th passing.
#[cfg(feature = "faults")]
pub fn point(name: &str, when: &str) {
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU64, Ordering};
    static WANTED: OnceLock<Option<(String, u64)>> = OnceLock::new();
    static PASSED: AtomicU64 = AtomicU64::new(0);
    let wanted = WANTED.get_or_init(|| {
        let text = std::env::var("PANTARAY_FAULT").ok()?;
        let (point, count) = text.rsplit_once(':')?;
        Some((point.to_string(), count.parse().ok()?))
    });
    if let Some((point, count)) = wanted
        && *point == format!("{name}:{when}")
        && PASSED.fetch_add(1, Ordering::SeqCst) + 1 == *count
    {
        // As SIGKILL: nothing is flushed, nobody is told
        std::process::abort();
    }
}

/// Nothing.
#[cfg(not(feature = "faults"))]
#[inline]
pub fn point(_name: &str, _when: &str) {}

/// Milliseconds by which the system's clock is wrong, as `PANTARAY_CLOCK_OFF_MS` says.
#[cfg(feature = "faults")]
pub fn clock_off_ms() -> i64 {
    std::env::var("PANTARAY_CLOCK_OFF_MS").ok().and_then(|text| text.parse().ok()).unwrap_or(0)
}

/// None.
#[cfg(not(feature = "faults"))]
#[inline]
pub fn clock_off_ms() -> i64 {
    0
}
