//! The cache's files: folders for work in progress, and what is there and how much.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// A folder for work in progress, removed when it is dropped.
#[derive(Debug)]
pub struct Scratch(PathBuf);

impl Scratch {
    /// A folder that exists.
    pub(super) fn new(path: PathBuf) -> Self {
        Self(path)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!("cannot remove {}: {error}", self.0.display());
        }
    }
}

/// An object on the disk.
pub(super) struct Object {
    pub path: PathBuf,
    pub bytes: u64,
    pub links: u64,
    pub used: SystemTime,
}

/// Bytes of work in progress, without what is linked from elsewhere. Files come and go meanwhile: what cannot be looked at
/// is not counted.
pub(super) fn in_progress(root: &Path) -> u64 {
    let (mut bytes, mut folders) = (0, vec![root.join("scratch")]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            match entry.metadata() {
                Ok(metadata) if metadata.is_dir() => folders.push(entry.path()),
                Ok(metadata) if metadata.is_file() && metadata.nlink() == 1 => bytes += metadata.len(),
                _ => {}
            }
        }
    }
    bytes
}

/// All objects below `root`.
pub(super) fn objects(root: &Path) -> engine::Result<Vec<Object>> {
    let mut found = Vec::new();
    let folder = root.join("objects");
    for path in crate::depot::files_below(&folder)? {
        let path = folder.join(path);
        let metadata = fs::metadata(&path).map_err(|error| engine::Error::io("read", &path, error))?;
        let used = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        found.push(Object { bytes: metadata.len(), links: metadata.nlink(), used, path });
    }
    Ok(found)
}

/// Makes a folder and those above it.
pub(super) fn make_folder(path: &Path) -> engine::Result<()> {
    fs::create_dir_all(path).map_err(|error| engine::Error::io("create the folder", path, error))
}

/// Removes a file.
pub(super) fn remove(path: &Path) -> engine::Result<()> {
    fs::remove_file(path).map_err(|error| engine::Error::io("remove", path, error))
}
