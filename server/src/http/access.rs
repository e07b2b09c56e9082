//! Who asks, and whether they may: every operation's role stands in the OpenAPI document, and what stands there is what
//! is enforced. Changes are written down in the audit.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use axum::extract::{ConnectInfo, FromRequestParts, MatchedPath, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use protocol::Role;
use protocol::admin::AuditEntry;

use super::{Api, session};
use crate::coordinator::lock;
use crate::db::access::Token;
use crate::error::Kind;
use crate::storage::sha256;
use crate::{Error, Result, random};

/// Milliseconds for which a token is not looked up again: a revoked one works so long at other coordinators.
const REMEMBER_MS: i64 = 10_000;
/// Tokens that are remembered.
const REMEMBERED_MAX: usize = 16_384;
/// Milliseconds to which the time of a token's last use is known.
const USED_MS: i64 = 60_000;

/// Operations by method and path: the role that each needs, none where everybody may.
pub type Roles = HashMap<(Method, String), Option<Role>>;

/// Tokens that were used lately, and when they were looked up.
#[derive(Debug, Default)]
pub struct Tokens(Mutex<HashMap<String, (Arc<Token>, i64)>>);

impl Tokens {
    /// Forgets a token and its sessions: it was revoked.
    pub fn forget(&self, id: &str) {
        lock(&self.0).retain(|known, (token, _)| known != id && token.parent.as_deref() != Some(id));
    }
}

/// Who asks.
#[derive(Clone, Debug)]
pub struct Caller {
    /// The token; none without tokens, when everybody may do everything.
    pub token: Option<Arc<Token>>,
    /// Where from.
    pub address: String,
}

impl Caller {
    /// The token's label.
    pub fn name(&self) -> &str {
        self.token.as_ref().map_or("local", |token| &token.detail.label)
    }

    /// The token's id.
    pub fn token_id(&self) -> Option<&str> {
        self.token.as_ref().map(|token| token.detail.id.as_str())
    }

    /// The only project that this caller may see and change.
    pub fn project(&self) -> Option<&str> {
        self.token.as_ref().and_then(|token| token.detail.project.as_deref())
    }

    /// Whether this caller may see a project.
    pub fn sees(&self, project: &str) -> bool {
        self.project().is_none_or(|own| own == project)
    }

    /// The project that a list is to be of: the one that was asked for, or the caller's only one.
    ///
    /// # Errors
    /// [`Kind::Forbidden`] for a project of others.
    pub fn project_or<'a>(&'a self, asked: Option<&'a str>) -> Result<Option<&'a str>> {
        match asked {
            Some(project) if !self.sees(project) => {
                Err(Error::new(Kind::Forbidden, format!("the token is not for the project `{project}`")))
            }
            asked => Ok(asked.or(self.project())),
        }
    }
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Error;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self> {
        let caller = parts.extensions.get::<Self>().cloned();
        caller.ok_or_else(|| Error::new(Kind::Unauthorized, "a token is needed"))
    }
}

/// Lets a request through to its operation if its token has the role; writes changes down.
pub async fn guard(State(api): State<Arc<Api>>, mut request: Request, next: Next) -> Response {
    let start = Instant::now();
    let path = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str).to_owned();
    let method = match request.method() {
        &Method::HEAD => Method::GET,
        method => method.clone(),
    };
    // What the document does not know, nobody may do
    let Some(&needed) = api.roles.get(&(method.clone(), path.clone())) else {
        let message = format!("`{}` has no such method", request.uri().path());
        return Error::new(Kind::Method, message).into_response();
    };
    let address = request.extensions().get::<ConnectInfo<SocketAddr>>();
    let address = address.map_or_else(String::new, |ConnectInfo(address)| address.ip().to_string());
    // Where nobody is asked who they are, a cookie that is left over is in nobody's way
    let secret = match needed.map_or(Ok(None), |_| secret(&method, request.headers())) {
        Ok(secret) => secret.map(str::to_owned),
        Err(error) => return error.into_response(),
    };
    let caller = match api.admit(secret, address, needed).await {
        Ok(caller) => caller,
        Err(error) => return error.into_response(),
    };
    let action = format!("{method} {}", request.uri().path());
    if let Some(caller) = &caller {
        request.extensions_mut().insert(caller.clone());
    }
    let response = next.run(request).await;
    let labels = [("operation", format!("{method} {path}"))];
    metrics::histogram!("pantaray_http_seconds", &labels).record(start.elapsed().as_secs_f64());
    if let Some(caller) = caller.filter(|_| method != Method::GET && needed != Some(Role::Worker)) {
        let entry = AuditEntry {
            id: 0,
            at: api.coordinator.now(),
            actor: caller.name().into(),
            token: caller.token_id().map(str::to_owned),
            address: caller.address,
            action: protocol::limits::cut(&action, 500).into(),
            status: i64::from(response.status().as_u16()),
        };
        tracing::info!(actor = entry.actor, action = entry.action, status = entry.status, "a change");
        if let Err(error) = api.coordinator.store.add_audit(&entry).await {
            tracing::error!(%error, actor = entry.actor, action, "a change could not be written to the audit");
        }
    }
    response
}

impl Api {
    /// The caller, if they may; none where nobody is asked who they are.
    async fn admit(
        &self,
        secret: Option<String>,
        address: String,
        needed: Option<Role>,
    ) -> Result<Option<Caller>> {
        let Some(needed) = needed else { return Ok(None) };
        if self.coordinator.settings.without_tokens {
            return Ok(Some(Caller { token: None, address }));
        }
        let secret = secret.ok_or_else(|| Error::new(Kind::Unauthorized, "a token is needed"))?;
        let token = self.token(&secret).await?;
        if !token.detail.role.may(needed) {
            let message = format!("the token's role is `{}`, `{needed}` is needed", token.detail.role);
            return Err(Error::new(Kind::Forbidden, message));
        }
        Ok(Some(Caller { token: Some(token), address }))
    }

    /// The token of a secret. What is wrong with a secret is not told.
    pub async fn token(&self, secret: &str) -> Result<Arc<Token>> {
        let refused = || Error::new(Kind::Unauthorized, "the token is not valid");
        let id = token_id(secret).ok_or_else(refused)?;
        let (now, hash) = (self.coordinator.now(), sha256(secret.as_bytes()));
        let known = lock(&self.tokens.0).get(id).filter(|(_, at)| now - at < REMEMBER_MS).cloned();
        let token = match known {
            Some((token, _)) => token,
            None => {
                let token = Arc::new(self.coordinator.store.token(id).await?.ok_or_else(refused)?);
                let mut tokens = lock(&self.tokens.0);
                if tokens.len() >= REMEMBERED_MAX {
                    tokens.clear();
                }
                tokens.insert(id.into(), (token.clone(), now));
                token
            }
        };
        let detail = &token.detail;
        let over = detail.revoked_at.is_some() || detail.expires_at.is_some_and(|end| end <= now);
        if over || !same(&token.sha256, &hash) {
            return Err(refused());
        }
        if detail.last_used_at.is_none_or(|at| now - at > USED_MS) {
            self.coordinator.store.token_used(id, now).await?;
            // It is looked up again, with the time of this use
            self.tokens.forget(id);
        }
        Ok(token)
    }
}

/// Compares hashes in a time that does not depend on where they differ.
fn same(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b)) == 0
}

/// The secret of a request: a header's, or else that of a browser's session, which cannot change anything unless the
/// page itself asks.
fn secret<'a>(method: &Method, headers: &'a HeaderMap) -> Result<Option<&'a str>> {
    if let Some(secret) = bearer(headers) {
        return Ok(Some(secret));
    }
    let Some(secret) = session::cookie(headers) else { return Ok(None) };
    let asked_by_page = || {
        let sent = headers.get(session::CSRF_HEADER).and_then(|value| value.to_str().ok());
        sent.is_some_and(|sent| same(sent, &session::csrf(secret)))
    };
    if *method == Method::GET || asked_by_page() {
        return Ok(Some(secret));
    }
    let message = format!("a change by a session needs the header `{}`", session::CSRF_HEADER);
    Err(Error::new(Kind::Forbidden, message).hint("`GET /v1/session` says its value"))
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    headers.get(header::AUTHORIZATION)?.to_str().ok()?.strip_prefix("Bearer ").map(str::trim)
}

/// A new secret: `pantaray_ID_` and 160 random bits; with its id.
pub fn new_secret(now: i64) -> (String, String) {
    let id = random::id(now);
    let secret = format!("pantaray_{id}_{}", random::secret());
    (id, secret)
}

/// The id in a secret.
pub fn token_id(secret: &str) -> Option<&str> {
    let (id, rest) = secret.strip_prefix("pantaray_")?.split_once('_')?;
    let plain = |text: &str| text.bytes().all(|byte| byte.is_ascii_alphanumeric());
    (id.len() == 26 && rest.len() == 32 && plain(id) && plain(rest)).then_some(id)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches secrets whose id cannot be told, and strangers' text that reaches the database as an id.
    #[test]
    fn secrets_carry_their_id() {
        let (id, secret) = new_secret(1_700_000_000_000);
        assert_eq!(token_id(&secret), Some(&*id));
        for text in ["", "pantaray_", &secret[1..], &format!("{secret}x"), &secret.replace('_', "-")] {
            assert_eq!(token_id(text), None, "{text}");
        }
    }
}
