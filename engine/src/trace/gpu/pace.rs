//! How much work a dispatch gets, so that none runs much beyond a tenth of a second on any adapter.

use std::time::Duration;

/// Seconds that a dispatch should take: a driver's watchdog waits for some, a cancel for one at most.
const TARGET_SECONDS: f64 = 0.08;
/// Workgroups of a dispatch at most.
const WORKGROUPS_MAX: f64 = 65_535.0;
/// Workgroups of the first dispatch.
const WORKGROUPS_FIRST: f64 = 32.0;

/// Sizes dispatches by the time that earlier ones took.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    workgroups: f64,
}

impl Default for Pace {
    fn default() -> Self {
        Self { workgroups: WORKGROUPS_FIRST }
    }
}

impl Pace {
    /// Workgroups of the next dispatch.
    pub fn workgroups(&self) -> u32 {
        self.workgroups as u32
    }

    /// Learns that `workgroups` took `time`.
    pub fn learn(&mut self, workgroups: u32, time: Duration) {
        let seconds = time.as_secs_f64().max(1e-6);
        // The short last dispatch of a batch is mostly overhead
        if 2 * workgroups < self.workgroups() && seconds < TARGET_SECONDS {
            return;
        }
        let right = f64::from(workgroups) * TARGET_SECONDS / seconds;
        // Grow step by step, since a small dispatch says little about a large one; shrink at once
        let most = if workgroups >= self.workgroups() { 4.0 * self.workgroups } else { self.workgroups };
        self.workgroups = right.min(most).clamp(1.0, WORKGROUPS_MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches dispatches that never grow on a fast adapter, or stay too long on a slow one or after a change of scene.
    #[test]
    fn dispatches_come_to_take_the_right_time() {
        for workgroups_per_second in [10.0, 3e3, 1e8] {
            let mut pace = Pace::default();
            for round in 0..30 {
                let workgroups = pace.workgroups();
                let seconds = f64::from(workgroups) / workgroups_per_second;
                let is_least = workgroups == 1;
                assert!(round < 3 || seconds <= 0.1 || is_least, "{seconds} s in round {round}");
                pace.learn(workgroups, Duration::from_secs_f64(seconds));
            }
            let right = (workgroups_per_second * TARGET_SECONDS).clamp(1.0, WORKGROUPS_MAX);
            assert!(f64::from(pace.workgroups()) >= (0.9 * right).floor(), "{pace:?}");
        }
    }

    /// Catches a short last dispatch of a batch that makes the next ones large.
    #[test]
    fn a_small_dispatch_does_not_raise_the_size() {
        let mut pace = Pace::default();
        (0..10).for_each(|_| pace.learn(pace.workgroups(), Duration::from_millis(80)));
        let before = pace.workgroups();
        pace.learn(1, Duration::from_micros(50));
        pace.learn(1, Duration::from_millis(5));
        assert_eq!(pace.workgroups(), before);
    }
}
