//! The farm's commands: how a coordinator is reached, and what several of them need.

pub mod admin;
pub mod control;
pub mod fetch;
mod files;
pub mod gc;
pub mod jobs;
pub mod logs;
pub mod submit;
pub mod watch;
pub mod worker;

use std::path::{Path, PathBuf};
use std::time::Duration;

use ::worker::client::Client;
use clap::Args;
use engine::{Error, ErrorKind, Result};

/// Patience with a coordinator that does not answer.
const PATIENCE: Duration = Duration::from_secs(20);
/// Bytes of a file with a token at most.
const TOKEN_BYTES_MAX: u64 = 4096;

/// How the coordinator is reached.
#[derive(Clone, Debug, Args)]
pub struct Connection {
    /// The coordinator
    #[arg(long, value_name = "URL", env = "PANTARAY_URL", default_value = "http://127.0.0.1:8470")]
    url: String,
    /// The file that holds the caller's token; none for a coordinator that asks for none
    #[arg(long, value_name = "FILE", env = "PANTARAY_TOKEN_FILE")]
    token_file: Option<PathBuf>,
}

impl Connection {
    /// A client for it.
    pub fn client(&self) -> Result<Client> {
        let token = self.token_file.as_deref().map(read_token).transpose()?;
        Client::new(&self.url, token.as_deref(), PATIENCE)
    }
}

/// The token in a file.
fn read_token(path: &Path) -> Result<String> {
    use std::io::Read;
    let file = std::fs::File::open(path).map_err(|error| Error::io("open the token file", path, error))?;
    let mut text = String::new();
    let read = file.take(TOKEN_BYTES_MAX).read_to_string(&mut text);
    read.map_err(|error| Error::io("read the token file", path, error))?;
    let token = text.trim();
    if token.is_empty() || !token.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err(Error::invalid("this file holds no token").at(path));
    }
    Ok(token.into())
}

/// `NAME=VALUE`.
pub fn pair(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.is_empty() && !value.is_empty() => Ok((name.into(), value.into())),
        _ => Err("expected NAME=DIR".into()),
    }
}

/// The error of a user who has seen enough.
fn left(job: &str) -> Error {
    Error::new(ErrorKind::Cancelled, "no longer watched: the job goes on")
        .hint(format!("`pantaray watch {job}` looks again, `pantaray cancel {job}` ends it"))
}

/// A random word, by which the coordinator knows a repeated request.
fn random_key() -> String {
    use std::hash::{BuildHasher, Hasher};
    let word = || std::hash::RandomState::new().build_hasher().finish();
    format!("{:016x}{:016x}", word(), word())
}
