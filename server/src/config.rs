//! How a coordinator is set up.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;

use engine::scene::Roots;
use protocol::limits;

use crate::db::retention::Retention;

/// Settings of a coordinator.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where it listens.
    pub listen: SocketAddr,
    /// The database's URL: `sqlite:PATH` or `postgres://…`.
    pub database: String,
    /// Connections to the database at most.
    pub connections: u32,
    /// Where objects are: a folder, or a URL such as `s3://bucket/prefix`.
    pub storage: String,
    /// The storage provider's options, such as `aws_endpoint`, besides those of the environment.
    pub storage_options: BTreeMap<String, String>,
    /// Folders that scenes may name as `root:NAME/path`.
    pub roots: Roots,
    /// Whether requests without a token may do everything: only for one machine's own use.
    pub without_tokens: bool,
    /// Milliseconds that a lease lasts without a heartbeat.
    pub lease_ttl_ms: i64,
    /// Bytes of one uploaded asset, or of an object of a worker, at most.
    pub asset_bytes_max: u64,
    /// One result in so many is baked again by another worker before it counts; none where this is 0.
    pub opinion_every: u32,
    /// How long things are kept that no project decides about.
    pub retention: Retention,
}

impl Settings {
    /// Settings for a SQLite file and objects in one folder.
    pub fn local(folder: &Path, listen: SocketAddr) -> Self {
        Self {
            listen,
            database: format!("sqlite:{}", folder.join("pantaray.db").display()),
            connections: 32,
            storage: folder.join("storage").display().to_string(),
            storage_options: BTreeMap::new(),
            roots: Roots::new(),
            without_tokens: false,
            lease_ttl_ms: limits::LEASE_TTL_MS,
            asset_bytes_max: limits::ASSET_BYTES_MAX,
            opinion_every: 0,
            retention: Retention::default(),
        }
    }
}
