//! Sessions of browsers: a person signs in with a token, and a cookie that no script can read stands for it from then on.
//!
//! A session is a token of its own that is made from another one: it ends after a week, when its person signs out, or
//! with the token it was made from. A change also needs a header that only our own pages know.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use axum::extract::{ConnectInfo, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use protocol::Role;
use protocol::admin::{AuditEntry, SessionDetail, SignInRequest, TokenDetail};

use super::Api;
use super::access::{Caller, new_secret};
use super::extract::Json;
use crate::coordinator::lock;
use crate::db::access::Token;
use crate::error::Kind;
use crate::storage::sha256;
use crate::{Error, Result};

/// The cookie.
const COOKIE: &str = "pantaray_session";
/// What a change by a session has to send.
pub const CSRF_HEADER: &str = "x-pantaray-csrf";
/// Seconds that a session lasts: a week.
const SESSION_S: i64 = 604_800;
/// Attempts to sign in that may fail within a minute from one address, and from all.
const FAILED_MAX: (u32, u32) = (10, 100);

/// Attempts to sign in that have failed within a minute.
#[derive(Debug, Default)]
pub struct SignIns(Mutex<Failed>);

#[derive(Debug, Default)]
struct Failed {
    minute: i64,
    all: u32,
    by_address: HashMap<String, u32>,
}

impl SignIns {
    /// Whether this address may try.
    fn check(&self, address: &str, now: i64) -> Result<()> {
        let mut failed = lock(&self.0);
        if failed.minute != now / 60_000 {
            *failed = Failed { minute: now / 60_000, ..Failed::default() };
        }
        let own = failed.by_address.get(address).copied().unwrap_or(0);
        if own >= FAILED_MAX.0 || failed.all >= FAILED_MAX.1 {
            let message = "too many attempts to sign in have failed within a minute";
            return Err(Error::new(Kind::TooMany, message).hint("wait a minute"));
        }
        Ok(())
    }

    fn failed(&self, address: &str) {
        let mut failed = lock(&self.0);
        failed.all += 1;
        // Bounded by `FAILED_MAX.1` addresses a minute
        *failed.by_address.entry(address.into()).or_default() += 1;
    }
}

/// Signs a browser in: its token becomes a session, held by a cookie that no script can read.
#[utoipa::path(post, path = "/v1/session", tag = "session", security(()),
    request_body = SignInRequest, responses((status = 200, body = SessionDetail)))]
pub async fn sign_in(
    State(api): State<Arc<Api>>,
    address: Option<axum::Extension<ConnectInfo<SocketAddr>>>,
    headers: HeaderMap,
    Json(request): Json<SignInRequest>,
) -> Result<Response> {
    let now = api.coordinator.now();
    let address = address.map_or_else(String::new, |address| address.0.0.ip().to_string());
    api.sign_ins.check(&address, now)?;
    let refused = |error: &Error| {
        if error.kind == Kind::Unauthorized {
            api.sign_ins.failed(&address);
        }
    };
    let token = api.token(request.token.trim()).await.inspect_err(refused)?;
    if token.detail.role == Role::Worker || token.parent.is_some() {
        return Err(Error::new(Kind::Forbidden, "a worker's token is for workers only")
            .hint("ask an administrator for a token of role `viewer` or `submitter`"));
    }
    let (secret, session) = begin(&api, &token, now).await?;
    let entry = AuditEntry {
        id: 0,
        at: now,
        actor: token.detail.label.clone(),
        token: Some(token.detail.id.clone()),
        address,
        action: "POST /v1/session".into(),
        status: 200,
    };
    api.coordinator.store.add_audit(&entry).await?;
    let cookie = set_cookie(&headers, &secret, SESSION_S);
    Ok(([(header::SET_COOKIE, cookie)], Json(describe(&api, &session.detail, csrf(&secret)))).into_response())
}

/// Makes the session of a token.
async fn begin(api: &Api, token: &Token, now: i64) -> Result<(String, Token)> {
    let store = &api.coordinator.store;
    store.forget_sessions(now).await?;
    let (id, secret) = new_secret(now);
    let end = now + 1_000 * SESSION_S;
    let detail = TokenDetail {
        id,
        created_at: now,
        expires_at: Some(token.detail.expires_at.map_or(end, |expires| expires.min(end))),
        revoked_at: None,
        last_used_at: None,
        ..token.detail.clone()
    };
    let (sha256, parent) = (sha256(secret.as_bytes()), Some(token.detail.id.clone()));
    let session = Token { detail, sha256, worker: None, labels: Vec::new(), parent };
    store.add_token(&session).await?;
    Ok((secret, session))
}

/// Who is signed in, and what a change has to send.
#[utoipa::path(get, path = "/v1/session", tag = "session", security(("token" = ["viewer"])),
    responses((status = 200, body = SessionDetail)))]
pub async fn session(
    State(api): State<Arc<Api>>,
    caller: Caller,
    headers: HeaderMap,
) -> Result<Json<SessionDetail>> {
    let csrf = cookie(&headers).map(csrf).unwrap_or_default();
    let detail = caller.token.as_ref().map(|token| token.detail.clone());
    let local = || TokenDetail {
        id: String::new(),
        role: Role::Admin,
        project: None,
        label: caller.name().into(),
        created_at: 0,
        expires_at: None,
        revoked_at: None,
        last_used_at: None,
    };
    Ok(Json(describe(&api, &detail.unwrap_or_else(local), csrf)))
}

/// Signs a browser out: its session is over.
#[utoipa::path(delete, path = "/v1/session", tag = "session", security(("token" = ["viewer"])),
    responses((status = 204)))]
pub async fn sign_out(State(api): State<Arc<Api>>, caller: Caller, headers: HeaderMap) -> Result<Response> {
    // A token that is no session stays what it is
    if let Some(session) = caller.token.as_ref().filter(|token| token.parent.is_some()) {
        api.coordinator.store.revoke_token(&session.detail.id, api.coordinator.now()).await?;
        api.tokens.forget(&session.detail.id);
    }
    let cookie = set_cookie(&headers, "", 0);
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]).into_response())
}

fn describe(api: &Api, token: &TokenDetail, csrf: String) -> SessionDetail {
    SessionDetail {
        name: token.label.clone(),
        role: token.role,
        project: token.project.clone(),
        expires_at: token.expires_at,
        csrf,
        version: env!("CARGO_PKG_VERSION").into(),
        now: api.coordinator.now(),
    }
}

/// The secret of a browser's session.
pub fn cookie(headers: &HeaderMap) -> Option<&str> {
    let cookies = headers.get_all(header::COOKIE).into_iter().filter_map(|value| value.to_str().ok());
    let mut pairs = cookies.flat_map(|value| value.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(name, _)| *name == COOKIE).map(|(_, value)| value).filter(|value| !value.is_empty())
}

/// What changes of a session have to send: known to whoever can read our answers, which other sites cannot.
pub fn csrf(secret: &str) -> String {
    let mut hash = sha256(format!("csrf {secret}").as_bytes());
    hash.truncate(32);
    hash
}

/// The cookie; sent back over TLS only where it came over TLS, which a proxy before us says.
fn set_cookie(headers: &HeaderMap, secret: &str, seconds: i64) -> String {
    let secure = headers.get("x-forwarded-proto").is_some_and(|proto| proto == "https");
    let secure = if secure { "; Secure" } else { "" };
    format!("{COOKIE}={secret}; HttpOnly; SameSite=Lax; Path=/; Max-Age={seconds}{secure}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(cookies: &[&'static str]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for cookie in cookies {
            headers.append(header::COOKIE, cookie.parse().unwrap());
        }
        headers
    }

    /// Catches a session that is not found among other cookies, and another's cookie that is taken for ours.
    #[test]
    fn the_session_is_found_among_cookies() {
        assert_eq!(cookie(&headers(&["a=b; pantaray_session=x; c=d"])), Some("x"));
        assert_eq!(cookie(&headers(&["a=b", "pantaray_session=y"])), Some("y"));
        for none in ["", "pantaray_session=", "xpantaray_session=x", "pantaray_session"] {
            assert_eq!(cookie(&headers(&[none])), None, "{none}");
        }
    }

    /// Catches an address that can guess on, and one that is shut out for what another did.
    #[test]
    fn failures_are_counted_by_address_and_minute() {
        let sign_ins = SignIns::default();
        for _ in 0..FAILED_MAX.0 {
            sign_ins.check("a", 0).unwrap();
            sign_ins.failed("a");
        }
        assert_eq!(sign_ins.check("a", 59_999).unwrap_err().kind, Kind::TooMany);
        sign_ins.check("b", 59_999).unwrap();
        sign_ins.check("a", 60_000).unwrap();
    }
}
