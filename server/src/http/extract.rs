//! What handlers take from a request; whatever is wrong with it is a problem as every other.

use axum::extract::rejection::{JsonRejection, PathRejection, QueryRejection};
use axum::extract::{FromRequest, FromRequestParts};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use object_store::GetRange;
use serde::Serialize;

use crate::Error;
use crate::error::Kind;

/// A JSON body, of a request or an answer.
#[derive(FromRequest)]
#[from_request(via(axum::Json), rejection(Error))]
pub struct Json<T>(pub T);

impl<T: Serialize> IntoResponse for Json<T> {
    fn into_response(self) -> Response {
        axum::Json(self.0).into_response()
    }
}

/// The query.
#[derive(FromRequestParts)]
#[from_request(via(axum::extract::Query), rejection(Error))]
pub struct Query<T>(pub T);

/// The parts of the path.
#[derive(FromRequestParts)]
#[from_request(via(axum::extract::Path), rejection(Error))]
pub struct Path<T>(pub T);

impl From<JsonRejection> for Error {
    fn from(rejection: JsonRejection) -> Self {
        match rejection.status() {
            StatusCode::PAYLOAD_TOO_LARGE => Self::new(Kind::TooLarge, rejection.body_text()),
            _ => Self::invalid(rejection.body_text()),
        }
    }
}

impl From<QueryRejection> for Error {
    fn from(rejection: QueryRejection) -> Self {
        Self::invalid(rejection.body_text())
    }
}

impl From<PathRejection> for Error {
    fn from(rejection: PathRejection) -> Self {
        Self::invalid(rejection.body_text())
    }
}

/// The range of bytes that a request asks for, where it asks for one. Several ranges are answered with the whole.
pub fn range(headers: &HeaderMap) -> Option<GetRange> {
    let text = headers.get(header::RANGE)?.to_str().ok()?.strip_prefix("bytes=")?;
    let (first, last) = text.split_once('-')?;
    match (first.parse::<u64>(), last.parse::<u64>()) {
        (Ok(first), Ok(last)) if first <= last => Some(GetRange::Bounded(first..last.checked_add(1)?)),
        (Ok(first), Err(_)) if last.is_empty() => Some(GetRange::Offset(first)),
        (Err(_), Ok(count)) if first.is_empty() => Some(GetRange::Suffix(count)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a range that is read as another, and one of several that is answered as if it were alone.
    #[test]
    fn ranges_are_read_as_they_are_written() {
        let read = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::RANGE, text.parse().unwrap());
            range(&headers)
        };
        assert_eq!(read("bytes=2-4"), Some(GetRange::Bounded(2..5)));
        assert_eq!(read("bytes=7-"), Some(GetRange::Offset(7)));
        assert_eq!(read("bytes=-3"), Some(GetRange::Suffix(3)));
        for text in ["bytes=4-2", "bytes=1-2,4-5", "lines=1-2", "bytes=-", "bytes=0-18446744073709551615"] {
            assert_eq!(read(text), None, "{text}");
        }
    }
}
