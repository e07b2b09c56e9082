//! Events as they happen: server-sent events, with what was missed sent again.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::sse::{self, Sse};
use futures_util::Stream;
use protocol::events::Event;
use protocol::limits::EVENT_REPLAY_MAX;
use protocol::overview::JobProgress;
use serde::Deserialize;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::Instant;
use utoipa::IntoParams;

use super::Api;
use super::access::Caller;
use super::extract::Query;
use crate::Result;

/// Between two comments that keep a silent connection open; the token is looked at again as often.
const BEAT: Duration = Duration::from_secs(15);
/// Events that are read from the database at once.
const PAGE: i64 = 500;

/// Which events.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct EventsQuery {
    /// Of one project.
    project: Option<String>,
    /// Of one job.
    job: Option<String>,
    /// Those after this event, as the header `Last-Event-ID`.
    after: Option<i64>,
    /// How far live jobs are, too.
    #[serde(default)]
    progress: bool,
}

/// Events as they happen (`text/event-stream`; the data of each is an `Event`). Those after `Last-Event-ID` come first; if
/// there are too many, an event `reset` says so. With `progress=true`, an event `progress`, which has no number and is not
/// sent again, says how far a live job is: its data is a `JobProgress`, twice a second at most. An event `bye` says that this coordinator ends.
#[utoipa::path(get, path = "/v1/events", tag = "jobs", security(("token" = ["viewer"])), params(EventsQuery),
    responses((status = 200, body = Event, content_type = "text/event-stream")))]
pub async fn events(
    State(api): State<Arc<Api>>,
    caller: Caller,
    Query(query): Query<EventsQuery>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<sse::Event, Infallible>>>> {
    let project = caller.project_or(query.project.as_deref())?.map(str::to_owned);
    // Listen first, then look back: nothing falls between
    let receiver = api.coordinator.events.subscribe();
    let progress = query.progress.then(|| api.coordinator.progress.subscribe());
    let latest = api.coordinator.store.last_event().await?;
    let header = headers.get("last-event-id").and_then(|id| id.to_str().ok()?.parse().ok());
    let after = header.or(query.after);
    let mut waiting = VecDeque::new();
    let last = match after {
        Some(after) if latest - after > EVENT_REPLAY_MAX => {
            waiting.push_back(sse::Event::default().id(latest.to_string()).event("reset").data("{}"));
            latest
        }
        Some(after) => after.min(latest),
        None => latest,
    };
    let listener = Listener {
        api,
        caller,
        project,
        job: query.job,
        receiver,
        progress,
        last,
        waiting,
        beat_at: Instant::now() + BEAT,
        behind: last < latest,
        ended: false,
    };
    Ok(Sse::new(futures_util::stream::unfold(listener, Listener::next)))
}

/// The next frame for those who asked for frames; never for others.
async fn next_frame(progress: &mut Option<Receiver<JobProgress>>) -> Result<JobProgress, RecvError> {
    match progress {
        Some(progress) => progress.recv().await,
        None => std::future::pending().await,
    }
}

/// Somebody who listens.
struct Listener {
    api: Arc<Api>,
    caller: Caller,
    project: Option<String>,
    job: Option<String>,
    receiver: Receiver<Event>,
    progress: Option<Receiver<JobProgress>>,
    /// The last event that was looked at.
    last: i64,
    waiting: VecDeque<sse::Event>,
    /// When the next comment is due, however much is told until then.
    beat_at: Instant,
    /// Whether there are events that only the database has.
    behind: bool,
    ended: bool,
}

impl Listener {
    async fn next(mut self) -> Option<(Result<sse::Event, Infallible>, Self)> {
        loop {
            if let Some(event) = self.waiting.pop_front() {
                return Some((Ok(event), self));
            }
            if self.ended {
                return None;
            }
            if self.behind {
                self.catch_up().await;
                continue;
            }
            let coordinator = self.api.coordinator.clone();
            let stopped = coordinator.stopped.notified();
            if coordinator.is_stopping() {
                self.bye();
                continue;
            }
            tokio::select! {
                event = self.receiver.recv() => match event {
                    Ok(event) => self.take(&event),
                    Err(RecvError::Lagged(_)) => self.behind = true,
                    Err(RecvError::Closed) => self.ended = true,
                },
                frame = next_frame(&mut self.progress) => match frame {
                    Ok(frame) => self.take_progress(&frame),
                    // The next frame says what the one that is lost did
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => self.ended = true,
                },
                () = stopped => self.bye(),
                () = tokio::time::sleep_until(self.beat_at) => self.beat().await,
            }
        }
    }

    fn bye(&mut self) {
        self.waiting.push_back(sse::Event::default().event("bye").data("{}"));
        self.ended = true;
    }

    /// Sends a comment, unless the token is over.
    async fn beat(&mut self) {
        self.beat_at = Instant::now() + BEAT;
        if let Some(token) = &self.caller.token {
            let found = self.api.coordinator.store.token(&token.detail.id).await;
            let now = self.api.coordinator.now();
            let over = |end: Option<i64>| end.is_some_and(|end| end <= now);
            let live =
                |detail: &protocol::admin::TokenDetail| !over(detail.revoked_at) && !over(detail.expires_at);
            match found {
                Ok(found) => self.ended = !found.is_some_and(|token| live(&token.detail)),
                Err(error) => tracing::debug!(%error, "a listener's token cannot be looked up"),
            }
        }
        if !self.ended {
            self.waiting.push_back(sse::Event::default().comment(""));
        }
    }

    async fn catch_up(&mut self) {
        match self.api.coordinator.store.events(self.last, PAGE, self.project.as_deref()).await {
            Ok(events) => {
                self.behind = events.len() as i64 == PAGE;
                events.iter().for_each(|event| self.take(event));
            }
            Err(error) => {
                tracing::warn!(%error, "events cannot be read");
                // The listener comes back with the number of the last event that it has
                self.ended = true;
            }
        }
    }

    /// Whether what happens to a job of a project is to be told.
    fn wants(&self, project: &str, job: Option<&String>) -> bool {
        self.project.as_ref().is_none_or(|wanted| wanted == project)
            && self.job.as_ref().is_none_or(|wanted| job == Some(wanted))
    }

    fn take_progress(&mut self, frame: &JobProgress) {
        if self.wants(&frame.project, Some(&frame.job))
            && let Ok(data) = serde_json::to_string(frame)
        {
            self.waiting.push_back(sse::Event::default().event("progress").data(data));
        }
    }

    fn take(&mut self, event: &Event) {
        let wanted = self.wants(&event.project, event.job.as_ref());
        if event.id <= self.last {
            return;
        }
        self.last = event.id;
        if wanted && let Ok(data) = serde_json::to_string(event) {
            let sent = sse::Event::default().id(event.id.to_string()).event(&event.kind).data(data);
            self.waiting.push_back(sent);
        }
    }
}
