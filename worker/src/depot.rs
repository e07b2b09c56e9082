//! Where the bytes of a lease come from and go to.

use std::fmt::Debug;
use std::path::{Path, PathBuf};

use protocol::storage::{FolderFile, FolderIndex, SceneFiles};
use protocol::work::PartPage;
use protocol::{keys, limits};

use crate::{Error, Result, digest};

/// An object to read into a file.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// Its key.
    pub key: String,
    /// The file that it becomes.
    pub path: PathBuf,
    /// Bytes at most.
    pub bytes_max: u64,
}

/// The bytes that a lease may reach.
pub trait Depot: Debug + Send + Sync {
    /// The scene as it was submitted.
    ///
    /// # Errors
    /// When it cannot be had.
    fn scene(&self) -> Result<SceneFiles>;

    /// Reads objects; one answer for each, with the hash of what came.
    fn read(&self, wanted: &[Wanted]) -> Vec<Result<FolderFile>>;

    /// Fills `out` with an object's bytes from `offset` on.
    ///
    /// # Errors
    /// When they cannot be had.
    fn read_range(&self, key: &str, offset: u64, out: &mut [u8]) -> Result<()>;

    /// Writes a file as an object.
    ///
    /// # Errors
    /// When it cannot be written.
    fn write(&self, key: &str, path: &Path, content: &FolderFile) -> Result<()>;

    /// The committed parts that the lease's task merges, those after batch `after`.
    ///
    /// # Errors
    /// When they cannot be had.
    fn parts(&self, after: Option<i64>) -> Result<PartPage>;
}

/// Bytes of an index at most.
const INDEX_BYTES_MAX: u64 = 64 << 20;

/// Reads what a folder in storage holds, by way of a file below `scratch`.
///
/// # Errors
/// When there is no such folder, or its index is damaged.
pub fn read_index(depot: &dyn Depot, folder: &str, scratch: &Path) -> Result<FolderIndex> {
    let (key, path) = (keys::index(folder), scratch.join("index.json"));
    let wanted = Wanted { key: key.clone(), path: path.clone(), bytes_max: INDEX_BYTES_MAX };
    depot.read(&[wanted]).remove(0)?;
    let bytes = std::fs::read(&path).map_err(|error| engine::Error::io("read", &path, error))?;
    let damaged = || Error::Damaged(format!("`{key}` is not the index of a folder"));
    let index: FolderIndex = serde_json::from_slice(&bytes).map_err(|_| damaged())?;
    let sound =
        |(path, file): (&String, &FolderFile)| keys::is_relative(path) && keys::is_sha256(&file.sha256);
    if index.version != 1 || index.files.len() > limits::FOLDER_FILES_MAX || !index.files.iter().all(sound) {
        return Err(damaged());
    }
    Ok(index)
}

/// Writes the files at `paths` below `root` as a folder in storage, its index last; the hash of the index.
///
/// # Errors
/// When one cannot be read or written.
pub fn write_folder(
    depot: &dyn Depot,
    folder: &str,
    root: &Path,
    paths: &[String],
    scratch: &Path,
) -> Result<(FolderIndex, FolderFile)> {
    let mut index = FolderIndex { version: 1, ..FolderIndex::default() };
    for path in paths {
        let content = digest::of_file(&root.join(path))?;
        depot.write(&format!("{folder}/{path}"), &root.join(path), &content)?;
        index.files.insert(path.clone(), content);
    }
    let json = serde_json::to_vec(&index).map_err(|error| engine::Error::invalid(error.to_string()))?;
    let path = scratch.join("index.json");
    std::fs::write(&path, &json).map_err(|error| engine::Error::io("write", &path, error))?;
    let content = digest::of_bytes(&json);
    depot.write(&keys::index(folder), &path, &content)?;
    Ok((index, content))
}

/// The files below `root`, relative, in order.
///
/// # Errors
/// When a folder cannot be read, or a name is not UTF-8.
pub fn files_below(root: &Path) -> engine::Result<Vec<String>> {
    let mut files = Vec::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        let io = |error| engine::Error::io("read", &folder, error);
        for entry in std::fs::read_dir(&folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let relative = path.strip_prefix(root).ok().and_then(Path::to_str);
            let relative = relative.ok_or_else(|| engine::Error::invalid("name is not UTF-8").at(&path))?;
            files.push(relative.to_owned());
        }
    }
    files.sort_unstable();
    Ok(files)
}
