//! The coordinator's commands: to serve, and what administrators do.

mod embedded;
pub mod migrate;
pub mod serve;
pub mod sim;
pub mod token;

use std::path::{Path, PathBuf};

use clap::Args;
use engine::{Error, ErrorKind, Result};
use server::error::Kind;

/// Where a coordinator keeps what is true.
#[derive(Clone, Debug, Args)]
pub struct Place {
    /// The folder of the database, the objects and the first token; made if it is not there
    #[arg(long, value_name = "DIR", default_value = "pantaray-data")]
    data: PathBuf,
    /// The database: `sqlite:PATH` or `postgres://USER@HOST/NAME` [default: a SQLite file in the folder]
    #[arg(long, value_name = "URL", env = "PANTARAY_DATABASE")]
    database: Option<String>,
}

impl Place {
    /// The database's URL.
    fn database(&self) -> String {
        let file = || format!("sqlite:{}", self.data.join("pantaray.db").display());
        self.database.clone().unwrap_or_else(file)
    }

    /// Makes the folder, for its owner only.
    fn make(&self) -> Result<()> {
        use std::os::unix::fs::DirBuilderExt;
        let made = std::fs::DirBuilder::new().recursive(true).mode(0o700).create(&self.data);
        made.map_err(|error| Error::io("create the folder", &self.data, error))
    }
}

/// Runs what waits for network and database.
fn block_on<T>(work: impl Future<Output = server::Result<T>>) -> Result<T> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
    let runtime =
        runtime.map_err(|error| Error::new(ErrorKind::Io, "no threads can be had").caused_by(error))?;
    let result = runtime.block_on(work);
    // What still reads files or waits in a database call is not waited for
    runtime.shutdown_background();
    result.map_err(told)
}

/// A coordinator's error as this program's.
fn told(error: server::Error) -> Error {
    let kind = match error.kind {
        Kind::NotFound => ErrorKind::NotFound,
        Kind::Conflict => ErrorKind::Busy,
        Kind::Unavailable | Kind::Internal => ErrorKind::Io,
        _ => ErrorKind::Invalid,
    };
    let told = Error::new(kind, error.detail);
    match error.hint {
        Some(hint) => told.hint(hint),
        None => told,
    }
}

/// Writes a secret to a file that only its owner can read; what stood there is replaced.
pub fn write_secret(path: &Path, secret: &str) -> std::io::Result<()> {
    use std::io::Write;
    use std::os::unix::fs::OpenOptionsExt;
    let temporary = path.with_extension("new");
    let _ = std::fs::remove_file(&temporary);
    let mut file = std::fs::File::options().write(true).create_new(true).mode(0o600).open(&temporary)?;
    file.write_all(format!("{secret}\n").as_bytes())?;
    file.sync_all()?;
    std::fs::rename(&temporary, path)
}
