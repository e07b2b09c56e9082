//! Whether the coordinator is well, and its figures.

use std::sync::{Arc, OnceLock};

use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use protocol::FailureClass;
use protocol::gc::GcKind;

use super::Api;
use crate::error::Kind;
use crate::{Error, Result};

/// Bounds of the buckets of everything that is measured in seconds.
const SECONDS: [f64; 12] = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 5.0, 30.0];

/// What collects this process's figures.
pub fn metrics_handle() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    let install = || {
        let builder =
            PrometheusBuilder::new().set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &SECONDS);
        let recorder = builder.unwrap_or_else(|_| PrometheusBuilder::new()).build_recorder();
        let handle = recorder.handle();
        // Another library's recorder may be there: then these figures stay empty
        let _ = metrics::set_global_recorder(recorder);
        metrics::gauge!("pantaray_build_info", "version" => env!("CARGO_PKG_VERSION")).set(1.0);
        begin_at_zero();
        handle
    };
    HANDLE.get_or_init(install).clone()
}

/// Counters are there before they count: a rate over what is not there is nothing, and an alert on it sleeps.
fn begin_at_zero() {
    let classes: Vec<&str> = FailureClass::ALL.iter().map(|class| class.word()).collect();
    let labelled: [(&'static str, &'static str, &[&str]); 4] = [
        ("pantaray_claims_total", "result", &["granted", "empty"]),
        ("pantaray_claims_locality_total", "kind", &["own", "warm", "adjacent", "steal", "cold"]),
        (
            "pantaray_completions_total",
            "outcome",
            &["accepted", "already_done", "superseded", "cancelled", "rejected"],
        ),
        ("pantaray_batch_failures_total", "class", &classes),
    ];
    for (name, label, words) in labelled {
        for word in words {
            metrics::counter!(name, label => (*word).to_owned()).increment(0);
        }
    }
    for outcome in ["asked", "agreed", "split", "counted"] {
        metrics::counter!("pantaray_second_opinions_total", "outcome" => outcome).increment(0);
    }
    for kind in GcKind::ALL {
        metrics::counter!("pantaray_gc_deleted_total", "kind" => kind.word()).increment(0);
        metrics::counter!("pantaray_gc_deleted_bytes_total", "kind" => kind.word()).increment(0);
    }
    for name in [
        "pantaray_leases_expired_total",
        "pantaray_worker_sick_total",
        "pantaray_workers_distrusted_total",
        "pantaray_output_divergence_total",
    ] {
        metrics::counter!(name).increment(0);
    }
}

/// The process runs.
#[utoipa::path(get, path = "/healthz", tag = "health", security(()), responses((status = 200, body = str)))]
pub async fn healthz() -> &'static str {
    "ok\n"
}

/// The database takes writes, and the coordinator is not about to end.
#[utoipa::path(get, path = "/readyz", tag = "health", security(()), responses((status = 200, body = str)))]
pub async fn readyz(State(api): State<Arc<Api>>) -> Result<&'static str> {
    if api.coordinator.is_stopping() {
        return Err(Error::new(Kind::Unavailable, "this coordinator is about to end"));
    }
    api.coordinator.store.probe().await?;
    Ok("ready\n")
}

/// Figures for Prometheus. No figure costs a query.
#[utoipa::path(get, path = "/metrics", tag = "health", security(("token" = ["viewer"])), responses((status = 200, body = str)))]
pub async fn metrics(State(api): State<Arc<Api>>) -> Response {
    api.metrics.run_upkeep();
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4")], api.metrics.render()).into_response()
}

/// This document.
#[utoipa::path(get, path = "/openapi.json", tag = "health", security(()), responses((status = 200, body = str)))]
pub async fn openapi(State(api): State<Arc<Api>>) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], api.openapi.clone()).into_response()
}
