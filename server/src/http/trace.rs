//! Requests get a name, by which log lines about one are found: the caller's own, or a new one, said in every answer.

use std::time::Instant;

use axum::extract::Request;
use axum::http::HeaderValue;
use axum::middleware::Next;
use axum::response::Response;
use tracing::Instrument;

use crate::random;

/// The header that holds a request's id.
const HEADER: &str = "x-request-id";
/// Bytes of an id that a caller may choose at most.
const ID_BYTES_MAX: usize = 64;

/// Runs a request within a span that has its id, and says the id in the answer.
pub async fn name(request: Request, next: Next) -> Response {
    let start = Instant::now();
    let given = request.headers().get(HEADER).filter(|value| is_id(value.as_bytes())).cloned();
    // Sixteen hexadecimal digits are a header's value
    let new = || HeaderValue::from_str(&format!("{:016x}", random::bits()));
    let id = given.or_else(|| new().ok()).unwrap_or(HeaderValue::from_static("none"));
    let text = id.to_str().unwrap_or_default();
    let (method, path) = (request.method().as_str(), request.uri().path());
    let span = tracing::error_span!("request", request_id = text, method, path);
    let mut response = async {
        let response = next.run(request).await;
        let (status, ms) = (response.status().as_u16(), start.elapsed().as_secs_f64() * 1e3);
        tracing::debug!(status, ms, "answered");
        response
    }
    .instrument(span)
    .await;
    response.headers_mut().insert(HEADER, id);
    response
}

fn is_id(bytes: &[u8]) -> bool {
    let is_plain = |byte: &u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_');
    (1..=ID_BYTES_MAX).contains(&bytes.len()) && bytes.iter().all(is_plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches an id by which a caller would write into the log what it likes.
    #[test]
    fn callers_ids_are_plain_words() {
        assert!(is_id(b"build-17_a"));
        for bytes in [&b""[..], b"a b", b"a\"b", "\u{e9}".as_bytes(), &[b'a'; 65]] {
            assert!(!is_id(bytes), "{bytes:?}");
        }
    }
}
