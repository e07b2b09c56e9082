//! A bake's folder: locked while it is in use, and remembering what it is a bake of.

use std::fs::File;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::brickmap::is_unfinished;
use crate::{Error, ErrorKind, Result};

/// A bake's folder, locked until it is dropped.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    /// Holds the lock.
    _lock: File,
}

/// What the folder is a bake of.
#[derive(Debug, Serialize, Deserialize, PartialEq, Eq)]
struct Record {
    version: u32,
    /// Hash of scene, inputs and options.
    bake: String,
}

const VERSION: u32 = 1;

impl Folder {
    /// Makes the folder if it is not there, and locks it.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`] when another process bakes there.
    pub fn open(path: &Path) -> Result<Self> {
        std::fs::create_dir_all(path.join("work")).map_err(|e| Error::io("create the folder", path, e))?;
        let lock_path = path.join("work").join("lock");
        let lock = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&lock_path)
            .map_err(|e| Error::io("open", &lock_path, e))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { path: path.to_path_buf(), _lock: lock }),
            Err(std::fs::TryLockError::WouldBlock) => {
                Err(Error::new(ErrorKind::Busy, "another bake is using this folder")
                    .at(path)
                    .hint("wait for it, or give another folder"))
            }
            Err(std::fs::TryLockError::Error(error)) => Err(Error::io("lock", &lock_path, error)),
        }
    }

    /// The folder's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// A folder for what is removed when the bake is complete, made if it is not there.
    ///
    /// # Errors
    /// When it cannot be made.
    pub fn work(&self, name: &str) -> Result<PathBuf> {
        let path = self.path.join("work").join(name);
        std::fs::create_dir_all(&path).map_err(|e| Error::io("create the folder", &path, e))?;
        Ok(path)
    }

    /// Records that this is the bake with the given hash. An interrupted bake of the same hash is continued; another
    /// one is refused, or with `restart` begun anew.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when the folder holds another bake.
    pub fn claim(&self, bake: u64, restart: bool) -> Result<()> {
        let path = self.path.join("work").join("bake.json");
        let record = Record { version: VERSION, bake: format!("{bake:016x}") };
        let known = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Record>(&bytes).ok());
        match known {
            Some(known) if known == record && !restart => return Ok(()),
            Some(known) if known != record && !restart => {
                return Err(Error::invalid(
                    "this folder holds an unfinished bake of another scene, input or option",
                )
                .at(&self.path)
                .hint("give another folder, or `--restart` to begin anew here"));
            }
            _ => {}
        }
        let sets = self.path.join("work").join("sets");
        if sets.exists() {
            std::fs::remove_dir_all(&sets).map_err(|e| Error::io("remove", &sets, e))?;
        }
        let bytes = serde_json::to_vec_pretty(&record).map_err(|e| Error::invalid(e.to_string()))?;
        write_atomically(&path, &bytes)
    }

    /// Removes what only an unfinished bake needs, brick maps of other occluders in `maps` that were not finished included.
    ///
    /// # Errors
    /// When something cannot be removed.
    pub fn finish(&self, maps: &Path) -> Result<()> {
        for name in ["sets", "import", "build"] {
            let path = self.path.join("work").join(name);
            if path.exists() {
                std::fs::remove_dir_all(&path).map_err(|e| Error::io("remove", &path, e))?;
            }
        }
        for entry in std::fs::read_dir(maps).map_err(|e| Error::io("read", maps, e))? {
            let path = entry.map_err(|e| Error::io("read", maps, e))?.path();
            if is_unfinished(&path) {
                std::fs::remove_dir_all(&path).map_err(|e| Error::io("remove", &path, e))?;
            }
        }
        let record = self.path.join("work").join("bake.json");
        match std::fs::remove_file(&record) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(Error::io("remove", &record, error))
            }
            _ => Ok(()),
        }
    }
}

/// Writes a small file so that it is there whole or not at all.
///
/// # Errors
/// When it cannot be written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    use std::io::Write;
    let temporary = path.with_extension("tmp");
    let write = || {
        let mut file = File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    };
    write().map_err(|error| Error::io("write", path, error))
}
