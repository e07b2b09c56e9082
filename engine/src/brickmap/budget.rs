//! Memory that partitions under construction share.

use std::sync::{Condvar, Mutex};

/// A number of bytes that may be in use at a time.
#[derive(Debug)]
pub struct Budget {
    bytes_max: u64,
    in_use: Mutex<u64>,
    freed: Condvar,
}

/// Bytes in use; given back when dropped.
#[derive(Debug)]
pub struct Permit<'a> {
    budget: &'a Budget,
    bytes: u64,
}

impl Budget {
    /// A budget of `bytes_max`.
    pub fn new(bytes_max: u64) -> Self {
        Self { bytes_max, in_use: Mutex::new(0), freed: Condvar::new() }
    }

    /// Waits until there are `bytes`. Who wants more than there is gets it alone.
    pub fn take(&self, bytes: u64) -> Permit<'_> {
        let mut in_use = self.in_use.lock().expect("no thread panics");
        while *in_use > 0 && *in_use + bytes > self.bytes_max {
            in_use = self.freed.wait(in_use).expect("no thread panics");
        }
        *in_use += bytes;
        Permit { budget: self, bytes }
    }
}

impl Permit<'_> {
    /// Gives back all but `bytes`.
    pub fn shrink_to(&mut self, bytes: u64) {
        let given = self.bytes.saturating_sub(bytes);
        self.bytes -= given;
        *self.budget.in_use.lock().expect("no thread panics") -= given;
        self.budget.freed.notify_all();
    }
}

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        self.shrink_to(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU64, Ordering};

    /// Catches more in use than there is, and a wish beyond the budget that waits for ever.
    #[test]
    fn the_budget_is_kept() {
        let (budget, in_use) = (Budget::new(100), AtomicU64::new(0));
        std::thread::scope(|scope| {
            for thread in 0..4_u64 {
                let (budget, in_use) = (&budget, &in_use);
                scope.spawn(move || {
                    for i in 0..300 {
                        let bytes = if i == 150 { 1000 } else { 20 + (7 * i + thread) % 40 };
                        let mut permit = budget.take(bytes);
                        let now = in_use.fetch_add(bytes, Ordering::SeqCst) + bytes;
                        assert!(now <= 100 || now == 1000, "{now}");
                        in_use.fetch_sub(bytes - bytes / 2, Ordering::SeqCst);
                        permit.shrink_to(bytes / 2);
                        in_use.fetch_sub(bytes / 2, Ordering::SeqCst);
                    }
                });
            }
        });
        assert_eq!(*budget.in_use.lock().unwrap(), 0);
    }
}
