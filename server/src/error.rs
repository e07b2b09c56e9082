//! One error for the whole coordinator: its kind decides the HTTP status, its details are for whoever asked.

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use protocol::Problem;

/// The coordinator's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What sort of failure this is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The request says something that is wrong.
    Invalid,
    /// No token, or none that is known.
    Unauthorized,
    /// The token may not do this.
    Forbidden,
    /// What was named is not there, or not for this token.
    NotFound,
    /// The operation has no such method.
    Method,
    /// It contradicts what is there.
    Conflict,
    /// The session or lease is over.
    Gone,
    /// A stated limit was reached.
    TooLarge,
    /// The object has no such range of bytes.
    Range,
    /// Too many requests of this sort.
    TooMany,
    /// Not now: try again.
    Unavailable,
    /// A fault of the coordinator; what it was is logged and not told.
    Internal,
}

/// An error.
#[derive(Debug)]
pub struct Error {
    /// What sort.
    pub kind: Kind,
    /// This case.
    pub detail: String,
    /// What to do about it.
    pub hint: Option<String>,
}

impl Error {
    /// An error; the detail is lower case, has no full stop and puts values in backticks.
    pub fn new(kind: Kind, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into(), hint: None }
    }

    /// Shorthand for [`Kind::Invalid`].
    pub fn invalid(detail: impl Into<String>) -> Self {
        Self::new(Kind::Invalid, detail)
    }

    /// Shorthand for [`Kind::NotFound`].
    pub fn not_found(what: &str, name: impl std::fmt::Display) -> Self {
        Self::new(Kind::NotFound, format!("there is no {what} `{name}`"))
    }

    /// Adds what to do about it.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    fn parts(&self) -> (StatusCode, &'static str, &'static str) {
        match self.kind {
            Kind::Invalid => (StatusCode::UNPROCESSABLE_ENTITY, "invalid", "The request is wrong"),
            Kind::Unauthorized => (StatusCode::UNAUTHORIZED, "unauthorized", "A token is needed"),
            Kind::Forbidden => (StatusCode::FORBIDDEN, "forbidden", "The token may not do this"),
            Kind::NotFound => (StatusCode::NOT_FOUND, "not_found", "Not there"),
            Kind::Method => (StatusCode::METHOD_NOT_ALLOWED, "method", "No such method"),
            Kind::Conflict => (StatusCode::CONFLICT, "conflict", "The state does not allow this"),
            Kind::Gone => (StatusCode::GONE, "gone", "It is over"),
            Kind::TooLarge => (StatusCode::PAYLOAD_TOO_LARGE, "too_large", "A limit was reached"),
            Kind::Range => (StatusCode::RANGE_NOT_SATISFIABLE, "range", "No such range"),
            Kind::TooMany => (StatusCode::TOO_MANY_REQUESTS, "too_many", "Too many requests"),
            Kind::Unavailable => (StatusCode::SERVICE_UNAVAILABLE, "unavailable", "Not now"),
            Kind::Internal => (StatusCode::INTERNAL_SERVER_ERROR, "internal", "The coordinator failed"),
        }
    }

    /// The error on the wire.
    pub fn problem(&self) -> Problem {
        let (status, code, title) = self.parts();
        Problem {
            kind: format!("/problems/{code}"),
            title: title.into(),
            status: status.as_u16(),
            code: code.into(),
            detail: self.detail.clone(),
            hint: self.hint.clone(),
        }
    }
}

impl std::fmt::Display for Error {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.detail)
    }
}

impl std::error::Error for Error {}

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        let (status, ..) = self.parts();
        let mut response = (status, axum::Json(self.problem())).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        match self.kind {
            Kind::Unavailable | Kind::TooMany => {
                headers.insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
            }
            Kind::Unauthorized => {
                headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
            }
            _ => {}
        }
        response
    }
}

/// Contention and lost connections pass: the caller tries again. Everything else is a fault, logged here, once.
impl From<sqlx::Error> for Error {
    fn from(error: sqlx::Error) -> Self {
        use sqlx::Error::{Io, PoolClosed, PoolTimedOut, WorkerCrashed};
        let code = error.as_database_error().and_then(|error| error.code().map(|code| code.into_owned()));
        // PostgreSQL: serialisation, deadlock, shutdown, start-up, no connection left; SQLite: busy, locked
        let passing = ["40001", "40P01", "57P01", "57P02", "57P03", "53300", "5", "6", "261", "517"];
        if code.as_deref().is_some_and(|code| passing.contains(&code) || code.starts_with("08"))
            || matches!(error, Io(_) | PoolTimedOut | PoolClosed | WorkerCrashed)
        {
            tracing::warn!(%error, "the database is busy or away");
            return Self::new(Kind::Unavailable, "the database is busy or away");
        }
        tracing::error!(%error, "database");
        Self::new(Kind::Internal, "the database refused")
    }
}

impl From<std::io::Error> for Error {
    fn from(error: std::io::Error) -> Self {
        tracing::error!(%error, "storage");
        Self::new(Kind::Internal, "storage refused")
    }
}

impl From<object_store::Error> for Error {
    fn from(error: object_store::Error) -> Self {
        tracing::error!(%error, "storage");
        Self::new(Kind::Unavailable, "storage is away")
    }
}

impl From<serde_json::Error> for Error {
    fn from(error: serde_json::Error) -> Self {
        tracing::error!(%error, "a record in the database cannot be read");
        Self::new(Kind::Internal, "a record cannot be read")
    }
}
