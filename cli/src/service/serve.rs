//! `pantaray serve`: the coordinator.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use clap::Args;
use engine::{Error, Result};
use protocol::Role;
use protocol::admin::{Secret, TokenRequest};
use serde_json::json;
use server::config::Settings;
use server::coordinator::Coordinator;
use server::db::retention::Retention;

use super::embedded::{self, Crew};
use super::{Place, block_on, write_secret};
use crate::console::{Answer, LogFormat};
use crate::signals;

/// How long the token of embedded workers holds; it is revoked when their process ends in peace.
const WORKER_TOKEN_SECONDS: i64 = 30 * 86_400;

/// Run the farm's coordinator until it is stopped
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    place: Place,
    /// Everything in one folder: a SQLite file and the objects; nothing else is needed
    #[arg(long, conflicts_with_all = ["database", "storage"])]
    embedded: bool,
    /// Bake here, too: workers in this process, which share its cores
    #[arg(long, value_name = "N", default_value_t = 0, requires = "embedded", value_parser = clap::value_parser!(u16).range(0..=64))]
    workers: u16,
    /// Where to listen
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8470")]
    listen: SocketAddr,
    /// Where objects are: a folder, or `s3://BUCKET/PREFIX`, `gs://…`, `az://…` [default: a folder beside the database]
    #[arg(long, value_name = "PLACE", env = "PANTARAY_STORAGE")]
    storage: Option<String>,
    /// An option of S3 and its like, such as `aws_endpoint=http://minio:9000`; keys and secrets belong in the environment
    #[arg(long, value_name = "NAME=VALUE", value_parser = option)]
    storage_option: Vec<(String, String)>,
    /// Scenes may name files below DIR as `root:NAME/path`; may be repeated
    #[arg(long, value_name = "NAME=DIR", value_parser = crate::farm::pair)]
    root: Vec<(String, PathBuf)>,
    /// Everybody on this machine may do everything without a token; only on the loopback interface
    #[arg(long)]
    insecure_local: bool,
    /// Seconds that a lease lasts without a heartbeat
    #[arg(long, value_name = "SECONDS", default_value_t = 60, value_parser = clap::value_parser!(u32).range(5..=3600))]
    lease: u32,
    /// Bytes of one uploaded file at most
    #[arg(long, value_name = "SIZE", default_value = "1TiB", value_parser = crate::values::size)]
    upload_max: u64,
    /// One batch in N is baked again by another worker of the same device before it counts; 0: none
    #[arg(long, value_name = "N", default_value_t = 1_000)]
    second_opinion: u32,
    /// Days after a job's end that its logs are kept
    #[arg(long, value_name = "DAYS", default_value_t = 30, value_parser = days())]
    log_days: i64,
    /// Days that events are kept
    #[arg(long, value_name = "DAYS", default_value_t = 7, value_parser = days())]
    event_days: i64,
    /// Days that the audit is kept
    #[arg(long, value_name = "DAYS", default_value_t = 365, value_parser = days())]
    audit_days: i64,
}

fn days() -> clap::builder::RangedI64ValueParser {
    clap::value_parser!(i64).range(1..=36_500)
}

/// Serves until SIGTERM or SIGINT.
pub fn run(arguments: Arguments, log_format: LogFormat) -> Result<Answer> {
    let loopback = |ip: IpAddr| ip.is_loopback();
    if arguments.insecure_local && !loopback(arguments.listen.ip()) {
        let message = format!("`{}` can be reached from elsewhere", arguments.listen);
        return Err(
            Error::invalid(message).hint("`--insecure-local` wants a loopback address, such as 127.0.0.1")
        );
    }
    arguments.place.make()?;
    let folder = || arguments.place.data.join("storage").display().to_string();
    let settings = Settings {
        listen: arguments.listen,
        database: arguments.place.database(),
        connections: 32,
        storage: arguments.storage.clone().unwrap_or_else(folder),
        storage_options: arguments.storage_option.iter().cloned().collect(),
        roots: arguments.root.iter().cloned().collect(),
        without_tokens: arguments.insecure_local,
        lease_ttl_ms: i64::from(arguments.lease) * 1_000,
        asset_bytes_max: arguments.upload_max,
        opinion_every: arguments.second_opinion,
        retention: Retention {
            log_days: arguments.log_days,
            event_days: arguments.event_days,
            audit_days: arguments.audit_days,
        },
    };
    let (place, listen, count) = (arguments.place.clone(), arguments.listen, arguments.workers);
    let served = block_on(async move {
        let coordinator = Coordinator::open(settings).await?;
        let listener = tokio::net::TcpListener::bind(listen).await.map_err(|error| {
            server::Error::new(server::error::Kind::Conflict, format!("cannot listen at `{listen}`: {error}"))
        })?;
        let listen = listener.local_addr()?;
        if !coordinator.settings.without_tokens && !coordinator.store.has_tokens().await? {
            first_token(&coordinator, &place, log_format).await?;
        }
        log_format.tell(&format!("listening at http://{listen}"));
        let token = if count > 0 { worker_token(&coordinator).await? } else { None };
        let stop = until_done(coordinator.clone(), count, token, listen, place.data.join("workers"));
        server::http::serve(coordinator, listener, stop).await?;
        Ok(listen)
    })?;
    Answer::new(&json!({ "listened": served.to_string() }), "stopped")
}

/// `NAME=VALUE`, where the value may be empty.
fn option(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE")?;
    Ok((name.into(), value.into()))
}

/// A database without tokens gets one, for its administrator.
async fn first_token(coordinator: &Coordinator, place: &Place, log_format: LogFormat) -> server::Result<()> {
    let (project, expires_s) = (None, None);
    let request = TokenRequest { role: Role::Admin, project, label: "first".into(), expires_s };
    let made = server::http::make_token(&coordinator.store, &request, coordinator.now()).await?;
    let path = place.data.join("admin.token");
    write_secret(&path, &made.secret)?;
    log_format.tell(&format!("an administrator's token is in {}", path.display()));
    Ok(())
}

/// A token for the workers of this process; none where nobody needs one.
async fn worker_token(coordinator: &Coordinator) -> server::Result<Option<Secret>> {
    if coordinator.settings.without_tokens {
        return Ok(None);
    }
    let (project, expires_s) = (None, Some(WORKER_TOKEN_SECONDS));
    let request = TokenRequest { role: Role::Worker, project, label: "embedded".into(), expires_s };
    server::http::make_token(&coordinator.store, &request, coordinator.now()).await.map(Some)
}

/// Lets the workers of this process work until it is asked to stop, and give back what they have.
async fn until_done(
    coordinator: Arc<Coordinator>,
    count: u16,
    token: Option<Secret>,
    listen: SocketAddr,
    folder: PathBuf,
) {
    let (mark, roots) = (format!("{:x}", coordinator.now() / 1_000), coordinator.settings.roots.clone());
    let crew = Crew { count, mark, token: token.as_ref().map(|token| token.secret.clone()), roots };
    let workers = embedded::start(&crew, listen, &folder);
    until_stopped().await;
    match workers {
        Ok(workers) => drop(tokio::task::spawn_blocking(move || embedded::join(workers)).await),
        Err(error) => tracing::error!("no embedded workers: {error}"),
    }
    if let Some(token) = token
        && let Err(error) = coordinator.store.revoke_token(&token.id, coordinator.now()).await
    {
        tracing::error!("the token of the embedded workers is not revoked: {error}");
    }
}

async fn until_stopped() {
    while !signals::cancel_flag().load(Ordering::Relaxed) {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}
