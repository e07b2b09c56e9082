//! The coordinator: ties the queue, storage and the scheduler's view of the farm together, and runs the loops.
//!
//! Every coordinator runs every loop: what they do are conditional statements, so two that do the same are merely
//! wasteful, and none needs to be the leader when another dies.

pub mod bytes;
mod estimate;
pub mod gc;
pub mod pace;
mod provisional;
mod publish;
pub mod submit;
mod tick;
mod validate;
mod verify;
mod work;

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use protocol::events::Event;
use protocol::overview::JobProgress;
use protocol::work::Task;
use tokio::sync::{Notify, Semaphore, broadcast};

use crate::clock::Clock;
use crate::config::Settings;
use crate::db::Store;
use crate::db::worker::Session;
use crate::scheduler::failure::Around;
use crate::scheduler::farm::Farm;
use crate::storage::Storage;
use crate::{Result, random};

/// Events that wait for a slow listener at most.
const EVENTS_MAX: usize = 1024;

/// A coordinator.
pub struct Coordinator {
    /// How it is set up.
    pub settings: Settings,
    /// What is true.
    pub store: Store,
    /// Where objects are.
    pub storage: Storage,
    /// What time it is.
    pub clock: Clock,
    /// The farm as it was a moment ago.
    farm: RwLock<Farm>,
    /// Workers that wait for work.
    waiting: AtomicUsize,
    /// Turns to choose and to claim: whoever chooses sees what those before have taken.
    turns: Semaphore,
    wake: Notify,
    /// Jobs that may have a step to take.
    pending: Mutex<BTreeSet<String>>,
    tick: Notify,
    /// The farm has changed in a way that only the database knows.
    dirty: AtomicBool,
    /// Workers that were heard of since that was last written down.
    seen: Mutex<HashSet<String>>,
    sessions: Mutex<HashMap<String, (Session, i64)>>,
    tasks: Mutex<HashMap<i64, Arc<Task>>>,
    /// The assets that a job's scene refers to, of the jobs that were asked for lately.
    assets: Mutex<HashMap<String, Arc<HashSet<String>>>>,
    /// How fast jobs go.
    pub pace: pace::Pace,
    /// What there is to see of bakes that are under way.
    provisionals: provisional::Provisionals,
    /// What happens, for listeners.
    pub events: broadcast::Sender<Event>,
    /// How far jobs are, likewise.
    pub progress: broadcast::Sender<JobProgress>,
    last_event: AtomicI64,
    stopping: AtomicBool,
    /// Wakes what waits for the end.
    pub stopped: Notify,
}

impl Coordinator {
    /// Opens database and storage, and gives every lease its full time: nobody was listening.
    ///
    /// # Errors
    /// When database or storage cannot be opened.
    pub async fn open(settings: Settings) -> Result<Arc<Self>> {
        let storage = Storage::open(&settings.storage, &settings.storage_options)?;
        storage.probe().await?;
        let store = Store::open(&settings.database, settings.connections).await?;
        store.migrate().await?;
        let clock = Clock::default();
        if let Some(now) = store.driver().now_ms().await? {
            clock.set_ms(now);
        }
        store.forgive(settings.lease_ttl_ms, clock.now_ms()).await?;
        let farm = RwLock::new(store.load_farm(clock.now_ms()).await?);
        let last_event = AtomicI64::new(store.last_event().await?);
        let coordinator = Self {
            settings,
            store,
            storage,
            clock,
            farm,
            waiting: AtomicUsize::new(0),
            turns: Semaphore::new(work::CLAIMS_AT_ONCE),
            wake: Notify::new(),
            pending: Mutex::default(),
            tick: Notify::new(),
            dirty: AtomicBool::new(false),
            seen: Mutex::default(),
            sessions: Mutex::default(),
            tasks: Mutex::default(),
            assets: Mutex::default(),
            pace: pace::Pace::default(),
            provisionals: provisional::Provisionals::default(),
            events: broadcast::channel(EVENTS_MAX).0,
            progress: broadcast::channel(EVENTS_MAX).0,
            last_event,
            stopping: AtomicBool::new(false),
            stopped: Notify::new(),
        };
        coordinator.pend(coordinator.store.live_jobs().await?);
        Ok(Arc::new(coordinator))
    }

    /// The time.
    pub fn now(&self) -> i64 {
        self.clock.now_ms()
    }

    /// Takes no more claims, and ends all waiting.
    pub fn stop(&self) {
        self.stopping.store(true, Ordering::SeqCst);
        self.wake.notify_waiters();
        self.stopped.notify_waiters();
        self.tick.notify_one();
    }

    /// Whether it is about to end.
    pub fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::SeqCst)
    }

    /// Something of a job has changed: its next step may be due.
    pub fn changed(&self, jobs: impl IntoIterator<Item = String>) {
        self.pend(jobs);
        self.dirty.store(true, Ordering::SeqCst);
        self.tick.notify_one();
    }

    fn pend(&self, jobs: impl IntoIterator<Item = String>) {
        lock(&self.pending).extend(jobs);
    }

    /// Reads the farm.
    pub fn read_farm<T>(&self, read: impl FnOnce(&Farm) -> T) -> T {
        read(&self.farm.read().unwrap_or_else(PoisonError::into_inner))
    }

    fn write_farm<T>(&self, write: impl FnOnce(&mut Farm) -> T) -> T {
        write(&mut self.farm.write().unwrap_or_else(PoisonError::into_inner))
    }

    /// What a ruling on a failure needs to know.
    fn around(&self, worker: &str) -> Around {
        let now = self.now();
        let (workers_alive, worker_memory) = self.read_farm(|farm| {
            let memory = farm.workers.get(worker).map_or(0, |worker| worker.memory_bytes);
            (farm.alive(now), memory)
        });
        Around { now, workers_alive, worker_memory, random: random::bits() }
    }

    /// Workers that wait for work.
    pub fn waiting_workers(&self) -> usize {
        self.waiting.load(Ordering::Relaxed)
    }
}

/// A mutex's content, also after a panic.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What the mutexes guard is whole between any two statements
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
