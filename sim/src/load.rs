//! What jobs cost, and where they fail. A job names its load by the seed of its settings, which every claim carries.

use std::collections::BTreeSet;
use std::sync::{Arc, Condvar, Mutex, PoisonError, RwLock};
use std::time::Duration;

/// What a job's batches cost.
#[derive(Clone, Debug)]
pub struct Load {
    /// Batches of its bake.
    pub batches: i64,
    /// Milliseconds that a worker of speed 1 sleeps for one.
    pub batch_ms: f64,
    /// Milliseconds that it says it took.
    pub told_ms: i64,
    /// Batches that are reported together.
    pub group: usize,
    /// Batches at which every worker crashes.
    pub poison: BTreeSet<i64>,
    /// Results wait here, where there is a gate.
    pub gate: Option<Arc<Gate>>,
}

impl Load {
    /// Batches that each take a worker `batch_ms`, while it says `told_ms`.
    pub fn new(batches: i64, batch_ms: f64, told_ms: i64) -> Self {
        Self { batches, batch_ms, told_ms, group: 4, poison: BTreeSet::new(), gate: None }
    }
}

/// The loads of a stage.
#[derive(Debug, Default)]
pub struct Loads(RwLock<Vec<Arc<Load>>>);

impl Loads {
    /// Adds a load; its number.
    pub fn add(&self, load: Load) -> u64 {
        let mut loads = self.0.write().unwrap_or_else(PoisonError::into_inner);
        loads.push(Arc::new(load));
        loads.len() as u64 - 1
    }

    /// The load of a number; none for a job that is not of this stage.
    pub fn get(&self, number: u64) -> Option<Arc<Load>> {
        let loads = self.0.read().unwrap_or_else(PoisonError::into_inner);
        loads.get(usize::try_from(number).ok()?).cloned()
    }
}

/// A gate that is shut until it is opened, once.
#[derive(Debug, Default)]
pub struct Gate(Mutex<bool>, Condvar);

impl Gate {
    /// Opens it.
    pub fn open(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.1.notify_all();
    }

    /// Waits up to `time`; whether it is open.
    pub fn wait(&self, time: Duration) -> bool {
        let shut = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.1.wait_timeout_while(shut, time, |open| !*open);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }
}
