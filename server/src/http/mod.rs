//! The way in: every operation on one screen, with its role in the OpenAPI document that is made from the code.

#![expect(unused_qualifications, reason = "in what utoipa's macros write")]

pub mod access;
mod admin;
mod bytes;
mod events;
mod extract;
mod gc;
mod health;
mod jobs;
mod overview;
mod session;
#[cfg(test)]
mod tests;
mod trace;
mod work;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::extract::{DefaultBodyLimit, Request};
use axum::http::Method;
use axum::{Router, middleware};
use metrics_exporter_prometheus::PrometheusHandle;
use protocol::{Role, limits};
use tokio::net::TcpListener;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use self::access::{Roles, Tokens, guard};
pub use self::admin::make_token;
use crate::coordinator::Coordinator;
use crate::{Error, Result};

/// Time for requests that are under way when the coordinator is asked to end.
const GRACE: Duration = Duration::from_secs(10);

/// What handlers share.
pub struct Api {
    /// The coordinator.
    pub coordinator: Arc<Coordinator>,
    tokens: Tokens,
    roles: Roles,
    openapi: String,
    metrics: PrometheusHandle,
    /// The minute, and enrolments that failed in it.
    failed_enrolments: Mutex<(i64, u32)>,
    sign_ins: session::SignIns,
}

/// Every operation.
fn operations() -> OpenApiRouter<Arc<Api>> {
    OpenApiRouter::new()
        // Workers
        .routes(routes!(work::register, admin::workers))
        .routes(routes!(work::claim))
        .routes(routes!(work::heartbeat))
        .routes(routes!(work::complete))
        .routes(routes!(work::release))
        .routes(routes!(work::add_log))
        .routes(routes!(work::urls))
        .routes(routes!(work::lease_scene))
        .routes(routes!(work::lease_parts))
        .routes(routes!(work::read_object, work::write_object))
        // Jobs
        .routes(routes!(jobs::submit, jobs::jobs))
        .routes(routes!(jobs::validate))
        .routes(routes!(jobs::job, jobs::patch, gc::delete_job))
        .routes(routes!(jobs::cancel))
        .routes(routes!(jobs::pause))
        .routes(routes!(jobs::resume))
        .routes(routes!(jobs::retry))
        .routes(routes!(jobs::skip))
        .routes(routes!(jobs::resubmit))
        .routes(routes!(gc::preview))
        .routes(routes!(jobs::segments))
        .routes(routes!(jobs::batches))
        .routes(routes!(jobs::failures))
        .routes(routes!(jobs::manifest))
        .routes(routes!(bytes::output))
        .routes(routes!(bytes::log))
        .routes(routes!(events::events))
        // The farm at a glance, and what of a bake is for the eye
        .routes(routes!(overview::farm))
        .routes(routes!(overview::leases))
        .routes(routes!(overview::pace))
        .routes(routes!(overview::job_picture))
        .routes(routes!(overview::picture))
        .routes(routes!(overview::preview))
        .routes(routes!(overview::work))
        .routes(routes!(overview::provisional))
        .routes(routes!(overview::skies))
        // Assets
        .routes(routes!(bytes::missing_assets))
        .routes(routes!(bytes::put_asset))
        // Sessions of browsers
        .routes(routes!(session::sign_in, session::session, session::sign_out))
        // Administrators
        .routes(routes!(admin::act_on_worker))
        .routes(routes!(admin::create_token, admin::tokens))
        .routes(routes!(admin::revoke_token))
        .routes(routes!(admin::create_ticket))
        .routes(routes!(admin::enrol))
        .routes(routes!(admin::projects))
        .routes(routes!(admin::put_project))
        .routes(routes!(admin::audit))
        .routes(routes!(gc::collect))
        // Health
        .routes(routes!(health::healthz))
        .routes(routes!(health::readyz))
        .routes(routes!(health::metrics))
        .routes(routes!(health::openapi))
}

/// The OpenAPI document, JSON.
pub fn document() -> serde_json::Value {
    complete(operations().split_for_parts().1)
}

/// What every operation has in common is said here once: the title, how tokens are sent, what errors look like.
fn complete(openapi: utoipa::openapi::OpenApi) -> serde_json::Value {
    use serde_json::json;
    let mut document = serde_json::to_value(openapi).unwrap_or_default();
    document["info"] = json!({ "title": "Pantaray", "version": env!("CARGO_PKG_VERSION"),
        "description": "A coordinator of bakes. The role that an operation needs stands in its `security`.",
        "license": { "name": "Apache-2.0 OR MIT" } });
    document["components"]["securitySchemes"]["token"] = json!({ "type": "http", "scheme": "bearer" });
    let schema = <protocol::Problem as utoipa::PartialSchema>::schema();
    document["components"]["schemas"]["Problem"] = serde_json::to_value(schema).unwrap_or_default();
    let problem = json!({ "description": "A problem, RFC 9457", "content": {
        "application/problem+json": { "schema": { "$ref": "#/components/schemas/Problem" } } } });
    let paths = document["paths"].as_object_mut().into_iter().flat_map(|paths| paths.values_mut());
    for operation in paths.filter_map(|path| path.as_object_mut()).flat_map(|path| path.values_mut()) {
        operation["responses"]["default"] = problem.clone();
    }
    document
}

/// The role of every operation, as the document has it: none where no token is asked for.
pub fn roles(document: &serde_json::Value) -> BTreeMap<(String, String), Option<Role>> {
    let mut roles = BTreeMap::new();
    for (path, operations) in document["paths"].as_object().into_iter().flatten() {
        for (method, operation) in operations.as_object().into_iter().flatten() {
            let security = &operation["security"][0];
            // An operation without a word about it is an administrator's
            let role = match (&security["token"][0], security.as_object()) {
                (serde_json::Value::String(role), _) => Some(role.parse().unwrap_or(Role::Admin)),
                (_, Some(none)) if none.is_empty() => None,
                _ => Some(Role::Admin),
            };
            roles.insert((method.to_uppercase(), path.clone()), role);
        }
    }
    roles
}

/// The router of a coordinator.
pub fn router(coordinator: Arc<Coordinator>) -> Router {
    let (router, openapi) = operations().split_for_parts();
    let document = complete(openapi);
    let known = roles(&document).into_iter().filter_map(|((method, path), role)| {
        Some(((Method::from_bytes(method.as_bytes()).ok()?, path), role))
    });
    let api = Arc::new(Api {
        coordinator,
        tokens: Tokens::default(),
        roles: known.collect(),
        openapi: format!("{document:#}\n"),
        metrics: health::metrics_handle(),
        failed_enrolments: Mutex::default(),
        sign_ins: session::SignIns::default(),
    });
    let unknown = async |request: Request| Error::not_found("operation", request.uri().path());
    router
        .route_layer(middleware::from_fn_with_state(api.clone(), guard))
        .merge(crate::dashboard::router())
        .layer(DefaultBodyLimit::max(limits::REQUEST_BYTES_MAX))
        .layer(middleware::from_fn(trace::name))
        .fallback(unknown)
        .with_state(api)
}

/// Serves until `end` comes; then takes no more claims, lets requests end, and returns.
///
/// # Errors
/// When the listener fails.
pub async fn serve(
    coordinator: Arc<Coordinator>,
    listener: TcpListener,
    end: impl Future<Output = ()> + Send + 'static,
) -> Result<()> {
    let router = router(coordinator.clone()).into_make_service_with_connect_info::<SocketAddr>();
    let loops = tokio::spawn(coordinator.clone().run());
    let events = tokio::spawn(coordinator.clone().pass_events_on());
    let pace = tokio::spawn(coordinator.clone().note_pace());
    let garbage = tokio::spawn(coordinator.clone().collect_garbage());
    let (ended, late) = tokio::sync::oneshot::channel::<()>();
    let stopping = coordinator.clone();
    let graceful = axum::serve(listener, router).with_graceful_shutdown(async move {
        end.await;
        stopping.stop();
        // Whoever waits for the receiver's end hears of it
        let _ = ended.send(());
    });
    let too_late = async {
        let _ = late.await;
        tokio::time::sleep(GRACE).await;
    };
    tokio::select! {
        served = graceful.into_future() => served?,
        () = too_late => tracing::warn!("requests were still under way {GRACE:?} after the end was asked for"),
    }
    coordinator.stop();
    let _ = tokio::join!(loops, events, pace, garbage);
    coordinator.store.driver().close().await;
    Ok(())
}
