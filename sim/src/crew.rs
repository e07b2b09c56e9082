//! Fake workers on threads of their own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use engine::{Error, ErrorKind, Result};
use worker::client::Client;

use crate::fake::{Fake, Shared, Temper};
use crate::random::Random;
use crate::wire::Line;

/// Bytes of a worker's stack.
const STACK_BYTES: usize = 256 << 10;

/// Some workers.
#[derive(Debug)]
pub struct Crew {
    threads: Vec<JoinHandle<()>>,
    leave: Arc<AtomicBool>,
}

/// Where workers go.
#[derive(Clone, Debug)]
pub struct Way<'a> {
    /// The coordinators' URLs.
    pub urls: &'a [String],
    /// The workers' token.
    pub token: &'a str,
    /// The stage's seed.
    pub seed: u64,
}

impl Crew {
    /// Starts a worker for each temper, numbered from `first` on. Each has a connection of its own to every coordinator.
    ///
    /// # Errors
    /// When no thread can be had.
    pub fn start(shared: &Arc<Shared>, way: &Way<'_>, first: usize, tempers: &[Temper]) -> Result<Self> {
        let mut crew = Self { threads: Vec::new(), leave: Arc::default() };
        for (number, &temper) in (first..).zip(tempers) {
            let client = |url: &String| Client::new(url, Some(way.token), Duration::ZERO);
            let clients = way.urls.iter().map(client).collect::<Result<_>>()?;
            let fake = Fake {
                number,
                name: format!("fake-{number:04}"),
                temper,
                line: Line::new(clients, number),
                random: Random::new(way.seed, number as u64),
                shared: shared.clone(),
                leave: crew.leave.clone(),
            };
            let thread = std::thread::Builder::new().stack_size(STACK_BYTES).spawn(move || fake.run());
            let no_thread = |error| Error::new(ErrorKind::Io, "no thread can be had").caused_by(error);
            crew.threads.push(thread.map_err(no_thread)?);
        }
        Ok(crew)
    }

    /// Workers of this crew.
    pub fn len(&self) -> usize {
        self.threads.len()
    }

    /// Whether nobody is in it.
    pub fn is_empty(&self) -> bool {
        self.threads.is_empty()
    }

    /// Lets the workers go: they end what they are at, and ask for no more.
    pub fn dismiss(&self) {
        self.leave.store(true, Ordering::Relaxed);
    }

    /// Waits until all have left.
    ///
    /// # Errors
    /// When one panicked.
    pub fn join(self) -> Result<()> {
        self.dismiss();
        let ends: Vec<_> = self.threads.into_iter().map(JoinHandle::join).collect();
        let panicked = ends.iter().filter(|end| end.is_err()).count();
        if panicked == 0 {
            return Ok(());
        }
        Err(Error::new(ErrorKind::Io, format!("{panicked} fake workers panicked")))
    }
}
