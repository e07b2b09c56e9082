//! The coordinator over HTTP: requests that are repeated until there is a definite answer, or patience ends.
//!
//! A definite answer is any but a server's trouble (5xx, 408, 429) or a connection's. Repetitions wait longer and longer, by
//! a random share, so that a thousand workers do not come back at once.

#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use protocol::Problem;
use protocol::storage::{FolderFile, ObjectUrl};
use serde::Serialize;
use serde::de::DeserializeOwned;
use ureq::http::{Request, Response};
use ureq::tls::{RootCerts, TlsConfig};
use ureq::{Agent, AsSendBody, Body};

use crate::digest::Hasher;
use crate::{Error, Result};

/// Time for a connection to be made.
const CONNECT: Duration = Duration::from_secs(5);
/// Time for an answer besides what the request asks the coordinator to wait.
const ANSWER: Duration = Duration::from_secs(30);
/// Bytes per second below which a transfer is given up, beyond [`ANSWER`].
const SLOWEST_BYTES: u64 = 256 << 10;
/// Bytes of an answer in JSON at most.
const REPLY_BYTES_MAX: u64 = 64 << 20;
/// Wait before the first repetition, and the longest.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// The longest wait that an answer's `Retry-After` gets.
const RETRY_AFTER_MAX: Duration = Duration::from_secs(30);

/// A coordinator.
#[derive(Clone, Debug)]
pub struct Client {
    agent: Agent,
    base: String,
    token: Option<String>,
    patience: Duration,
    /// Bytes of objects that came, over all clones.
    received: Arc<AtomicU64>,
}

/// A reply that is not the end.
struct Trouble {
    message: String,
    retry_after: Option<Duration>,
}

impl Client {
    /// The coordinator at `url`, to whom `token` speaks for the caller. Requests are repeated for as long as `patience`.
    ///
    /// # Errors
    /// [`engine::ErrorKind::Invalid`] for what is no URL of a coordinator.
    pub fn new(url: &str, token: Option<&str>, patience: Duration) -> engine::Result<Self> {
        if !["http://", "https://"].iter().any(|scheme| url.starts_with(scheme)) {
            let message = format!("`{url}` is not the URL of a coordinator");
            return Err(engine::Error::invalid(message).hint("begin with `http://` or `https://`"));
        }
        // Whom the machine trusts: a studio's own authority is among them
        let tls = TlsConfig::builder()
            .root_certs(RootCerts::PlatformVerifier)
            .unversioned_rustls_crypto_provider(Arc::new(rustls::crypto::ring::default_provider()))
            .build();
        let config = Agent::config_builder()
            .tls_config(tls)
            .http_status_as_error(false)
            .timeout_connect(Some(CONNECT))
            .max_redirects(0)
            .user_agent(concat!("pantaray/", env!("CARGO_PKG_VERSION")))
            .build();
        let (base, token) = (url.trim_end_matches('/').to_owned(), token.map(str::to_owned));
        Ok(Self { agent: config.into(), base, token, patience, received: Arc::default() })
    }

    /// The same coordinator with another patience.
    pub fn with_patience(&self, patience: Duration) -> Self {
        Self { patience, ..self.clone() }
    }

    /// The same coordinator for somebody else.
    pub fn with_token(&self, token: &str) -> Self {
        Self { token: Some(token.into()), ..self.clone() }
    }

    /// Bytes of objects that came so far.
    pub fn received_bytes(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }

    /// The coordinator's URL.
    pub fn url(&self) -> &str {
        &self.base
    }

    /// GETs `path` and its query.
    ///
    /// # Errors
    /// When there is no answer, or it is not the expected one.
    pub fn get<R: DeserializeOwned>(&self, path: &str) -> Result<R> {
        self.ask("GET", path, None, &[], Duration::ZERO)
    }

    /// POSTs `body` to `path`. `wait` is how long the coordinator may take before it begins to answer.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn post<R: DeserializeOwned>(&self, path: &str, body: &impl Serialize, wait: Duration) -> Result<R> {
        self.ask("POST", path, Some(encode(body)?), &[], wait)
    }

    /// As [`post`](Self::post) with a key by which the coordinator knows a repetition.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn post_once<R: DeserializeOwned>(&self, path: &str, body: &impl Serialize, key: &str) -> Result<R> {
        self.ask("POST", path, Some(encode(body)?), &[("idempotency-key", key)], Duration::ZERO)
    }

    /// PATCHes `path`.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn patch<R: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> Result<R> {
        self.ask("PATCH", path, Some(encode(body)?), &[], Duration::ZERO)
    }

    /// PUTs `body` at `path`.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn put<R: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> Result<R> {
        self.ask("PUT", path, Some(encode(body)?), &[], Duration::ZERO)
    }

    /// DELETEs `path`.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn delete<R: DeserializeOwned>(&self, path: &str) -> Result<R> {
        self.ask("DELETE", path, None, &[], Duration::ZERO)
    }

    /// A request whose answer is JSON, or empty, which reads as `null`.
    fn ask<R: DeserializeOwned>(
        &self,
        method: &str,
        path: &str,
        body: Option<Vec<u8>>,
        headers: &[(&str, &str)],
        wait: Duration,
    ) -> Result<R> {
        let url = self.own(path);
        let bytes = self.repeat(&url.url, |client| {
            let mut request = client.request(method, &url);
            for (name, value) in headers {
                request = request.header(*name, *value);
            }
            let reply = match &body {
                Some(body) => {
                    client.send(request.header("content-type", "application/json"), &body[..], wait + ANSWER)
                }
                None => client.send(request, (), wait + ANSWER),
            };
            client
                .judge(reply?)?
                .into_body()
                .into_with_config()
                .limit(REPLY_BYTES_MAX)
                .read_to_vec()
                .map_err(lost)
        })?;
        let text = if bytes.is_empty() { &b"null"[..] } else { &bytes };
        serde_json::from_slice(text).map_err(|error| {
            Error::Unreachable(format!(
                "{method} {path}: the answer is not what this version expects: {error}"
            ))
        })
    }

    /// GETs an object into the file `path`; its hash.
    ///
    /// # Errors
    /// As [`get`](Self::get); when the file cannot be written, or the object has more than `bytes_max` bytes.
    pub fn download(&self, url: &ObjectUrl, path: &Path, bytes_max: u64) -> Result<FolderFile> {
        let timeout = transfer_time(bytes_max.min(1 << 32));
        self.repeat(&url.url, |client| {
            let reply = client.send(client.request("GET", url), (), timeout)?;
            let reply = client.judge(reply).map_err(|failure| blame_storage(url, failure))?;
            let mut body = reply.into_body();
            let announced = body.content_length();
            let content = store(&mut body.with_config().limit(bytes_max).reader(), path)?;
            client.received.fetch_add(content.bytes, Ordering::Relaxed);
            match announced {
                Some(bytes) if bytes != content.bytes => Err(Failure::Trouble(Trouble {
                    message: format!("the transfer ended after {} of {bytes} bytes", content.bytes),
                    retry_after: None,
                })),
                _ => Ok(content),
            }
        })
    }

    /// GETs a range of an object: as many bytes from `offset` on as `out` has room for.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn download_range(&self, url: &ObjectUrl, offset: u64, out: &mut [u8]) -> Result<()> {
        let timeout = transfer_time(out.len() as u64);
        let range = format!("bytes={offset}-{}", offset + out.len() as u64 - 1);
        self.repeat(&url.url, |client| {
            let request = client.request("GET", url).header("range", &range);
            let reply = client.judge(client.send(request, (), timeout)?);
            let mut reply = reply.map_err(|failure| blame_storage(url, failure))?;
            if reply.status().as_u16() != 206 {
                return Err(Failure::End(Error::Unreachable("the storage does not know ranges".into())));
            }
            let broke_off = |error: std::io::Error| {
                Failure::Trouble(Trouble {
                    message: format!("the transfer broke off: {error}"),
                    retry_after: None,
                })
            };
            reply.body_mut().as_reader().read_exact(out).map_err(broke_off)?;
            client.received.fetch_add(out.len() as u64, Ordering::Relaxed);
            Ok(())
        })
    }

    /// GETs a text.
    ///
    /// # Errors
    /// As [`get`](Self::get).
    pub fn text(&self, path: &str) -> Result<String> {
        let url = self.own(path);
        let bytes = self.repeat(&url.url, |client| {
            let reply = client.send(client.request("GET", &url), (), ANSWER)?;
            client
                .judge(reply)?
                .into_body()
                .into_with_config()
                .limit(REPLY_BYTES_MAX)
                .read_to_vec()
                .map_err(lost)
        })?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }

    /// PUTs the file `path` as an object.
    ///
    /// # Errors
    /// As [`get`](Self::get); when the file cannot be read.
    pub fn upload(&self, url: &ObjectUrl, path: &Path) -> Result<()> {
        let open = || File::open(path).map_err(|error| engine::Error::io("open", path, error));
        let bytes = open()?.metadata().map_err(|error| engine::Error::io("read", path, error))?.len();
        let timeout = transfer_time(bytes);
        self.repeat(&url.url, |client| {
            let file = open().map_err(Error::from)?;
            let request = client.request("PUT", url).header("content-type", "application/octet-stream");
            let reply = client.send(request, &file, timeout)?;
            client.judge(reply).map_err(|failure| blame_storage(url, failure)).map(drop)
        })
    }

    /// The URL of a path on the coordinator.
    pub fn own(&self, path: &str) -> ObjectUrl {
        ObjectUrl { url: path.into(), headers: Default::default() }
    }

    /// A request to the coordinator, with the token, or to another host, without.
    fn request(&self, method: &str, url: &ObjectUrl) -> ureq::http::request::Builder {
        let is_own = url.url.starts_with('/');
        let uri = if is_own { format!("{}{}", self.base, url.url) } else { url.url.clone() };
        let mut request = Request::builder().method(method).uri(uri);
        if let Some(token) = self.token.as_ref().filter(|_| is_own) {
            request = request.header("authorization", format!("Bearer {token}"));
        }
        for (name, value) in &url.headers {
            request = request.header(name, value);
        }
        request
    }

    fn send(
        &self,
        request: ureq::http::request::Builder,
        body: impl AsSendBody,
        timeout: Duration,
    ) -> Result<Response<Body>, Failure> {
        let request = request.body(body).map_err(|error| {
            Failure::End(Error::Engine(engine::Error::invalid(format!("this cannot be asked for: {error}"))))
        })?;
        let request = self.agent.configure_request(request).timeout_global(Some(timeout)).build();
        self.agent.run(request).map_err(lost)
    }

    /// Sorts an answer: good, definite, or to be asked for again.
    fn judge(&self, mut reply: Response<Body>) -> Result<Response<Body>, Failure> {
        let status = reply.status().as_u16();
        if reply.status().is_success() {
            return Ok(reply);
        }
        let id = reply.headers().get("x-request-id").and_then(|value| value.to_str().ok());
        tracing::debug!(request_id = id, status, "refused");
        let seconds = reply.headers().get("retry-after").and_then(|value| value.to_str().ok()?.parse().ok());
        let bytes = reply.body_mut().with_config().limit(1 << 16).read_to_vec().unwrap_or_default();
        let problem = serde_json::from_slice(&bytes).unwrap_or_else(|_| {
            let detail = match String::from_utf8_lossy(&bytes).trim() {
                "" => format!("the answer was {}", reply.status()),
                text => protocol::limits::cut(text, 500).to_owned(),
            };
            let (kind, title) = ("about:blank".into(), reply.status().to_string());
            Problem { kind, title, status, code: "unknown".into(), detail, hint: None }
        });
        if status >= 500 || status == 408 || status == 429 {
            let message = format!("{} ({status})", problem.detail);
            return Err(Failure::Trouble(Trouble { message, retry_after: seconds.map(Duration::from_secs) }));
        }
        Err(Failure::End(Error::Refused(Box::new(problem))))
    }

    /// Tries until there is a definite answer or patience ends; tries once at least.
    fn repeat<T>(&self, url: &str, mut attempt: impl FnMut(&Self) -> Result<T, Failure>) -> Result<T> {
        let start = Instant::now();
        let mut wait = BACK_OFF.0;
        loop {
            let trouble = match attempt(self) {
                Ok(done) => return Ok(done),
                Err(Failure::End(error)) => return Err(error),
                Err(Failure::Trouble(trouble)) => trouble,
            };
            let pause = trouble.retry_after.map_or_else(|| jitter(wait), |after| after.min(RETRY_AFTER_MAX));
            if start.elapsed() + pause > self.patience {
                let host = if url.starts_with('/') { self.base.as_str() } else { "storage" };
                return Err(Error::Unreachable(format!("{host}: {}", trouble.message)));
            }
            tracing::debug!("{url}: {}; again in {pause:?}", trouble.message);
            std::thread::sleep(pause);
            wait = (wait * 2).min(BACK_OFF.1);
        }
    }
}

/// How an attempt failed.
enum Failure {
    End(Error),
    Trouble(Trouble),
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        Self::End(error)
    }
}

/// A signed URL that has run out is told from an object that is not there, and both from storage that will not do what it
/// must, which is no fault of the worker.
fn blame_storage(url: &ObjectUrl, failure: Failure) -> Failure {
    match failure {
        Failure::End(Error::Refused(problem)) if !url.url.starts_with('/') => {
            Failure::End(match problem.status {
                403 | 404 => Error::Refused(problem),
                _ => Error::Unreachable(format!("storage: {} ({})", problem.detail, problem.status)),
            })
        }
        failure => failure,
    }
}

fn lost(error: ureq::Error) -> Failure {
    Failure::Trouble(Trouble { message: error.to_string(), retry_after: None })
}

fn encode(body: &impl Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(body).map_err(|error| engine::Error::invalid(error.to_string()).into())
}

fn transfer_time(bytes: u64) -> Duration {
    ANSWER + Duration::from_secs(bytes / SLOWEST_BYTES)
}

/// Writes what comes into a file, hashing it on the way.
fn store(body: &mut dyn Read, path: &Path) -> Result<FolderFile, Failure> {
    let io = |error| Failure::End(engine::Error::io("write", path, error).into());
    let mut file = File::create(path).map_err(io)?;
    let mut hasher = Hasher::default();
    let mut buffer = vec![0; 1 << 18];
    loop {
        let count = body.read(&mut buffer).map_err(|error| {
            Failure::Trouble(Trouble {
                message: format!("the transfer broke off: {error}"),
                retry_after: None,
            })
        })?;
        if count == 0 {
            return Ok(hasher.finish());
        }
        hasher.update(&buffer[..count]);
        file.write_all(&buffer[..count]).map_err(io)?;
    }
}

/// From half of `wait` to all of it.
pub fn jitter(wait: Duration) -> Duration {
    let mut bytes = [0; 4];
    // Without randomness all wait the same, which is not wrong
    let _ = getrandom::fill(&mut bytes);
    wait / 2 + wait.mul_f64(0.5 * f64::from(u32::from_le_bytes(bytes)) / f64::from(u32::MAX))
}
