//! Requests of a fake worker: to whichever coordinator answers, and over a wire that loses, doubles and delays.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use worker::Error;
use worker::client::Client;

use crate::random::Random;

/// The longest that a request is repeated for a definite answer.
const PATIENCE: Duration = Duration::from_secs(60);

/// How likely a message suffers what.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wire {
    /// A request does not arrive; it is sent again.
    pub lost: f64,
    /// The answer does not arrive; the request is sent again.
    pub unanswered: f64,
    /// The request arrives twice, at the same time.
    pub doubled: f64,
    /// The request arrives after the one that follows it.
    pub late: f64,
}

/// A worker's way to its coordinators.
#[derive(Debug)]
pub struct Line {
    clients: Vec<Client>,
    at: usize,
}

impl Line {
    /// A line to the first of `clients` that answers, beginning with number `first`.
    pub fn new(clients: Vec<Client>, first: usize) -> Self {
        let at = first % clients.len().max(1);
        Self { clients, at }
    }

    /// The coordinator that answered last.
    pub fn client(&self) -> &Client {
        &self.clients[self.at]
    }

    /// Asks once; the next coordinator is asked next if this one does not answer.
    pub fn ask<T>(&mut self, request: impl Fn(&Client) -> worker::Result<T>) -> worker::Result<T> {
        let answer = request(self.client());
        if matches!(answer, Err(Error::Unreachable(_))) {
            self.at = (self.at + 1) % self.clients.len();
        }
        answer
    }

    /// Asks until there is a definite answer, `stop` is set, or patience ends.
    pub fn insist<T>(
        &mut self,
        random: &mut Random,
        stop: &AtomicBool,
        request: impl Fn(&Client) -> worker::Result<T>,
    ) -> worker::Result<T> {
        let start = Instant::now();
        loop {
            let answer = self.ask(&request);
            let is_open = matches!(answer, Err(Error::Unreachable(_)));
            if !is_open || stop.load(Ordering::Relaxed) || start.elapsed() > PATIENCE {
                return answer;
            }
            std::thread::sleep(Duration::from_millis(20 + random.below(180)));
        }
    }
}
