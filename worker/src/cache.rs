//! What is kept on the local disk: objects by their hash, within a quota, and folders made of links to them.
//!
//! ```text
//! lock
//! objects/ab/abcd…   an object by its SHA-256, never written again
//! objects/blocks/…   blocks of objects that are too large to be kept whole
//! folders/NAME/…     hard links to objects: what the engine reads
//! scratch/N/…        work in progress
//! ```
//!
//! An object with a second link is in use by a folder. When room is needed, objects without one go first, those used
//! longest ago before others, then folders that nobody holds. A cache outlives its process: objects stay, the rest goes.

mod disk;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use engine::ErrorKind;
use protocol::storage::FolderFile;

pub use self::disk::Scratch;
use self::disk::{Object, in_progress, make_folder, objects, remove};
use crate::depot::{Depot, Wanted};
use crate::{Error, Result, digest};

/// The local disk's share of the farm's bytes.
#[derive(Debug)]
pub struct Cache {
    root: PathBuf,
    bytes_max: u64,
    state: Mutex<State>,
    scratches: AtomicU64,
    _lock: File,
}

#[derive(Debug, Default)]
struct State {
    /// Bytes of all objects.
    bytes: u64,
    /// Folders by name, and the order of their last use.
    folders: BTreeMap<String, (Arc<Folder>, u64)>,
    uses: u64,
}

/// A folder of links to objects; it stays as long as somebody holds it.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
}

impl Folder {
    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// A file of a folder to be, and where its bytes are.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Relative path in the folder.
    pub path: String,
    /// The object's key.
    pub key: String,
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    /// Bytes, where known.
    pub bytes: Option<u64>,
}

impl Cache {
    /// Opens the cache in `root`, which is made if it is not there, and holds it against other processes.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`] when another process has it.
    pub fn open(root: &Path, bytes_max: u64) -> engine::Result<Self> {
        for name in ["objects", "folders", "scratch"] {
            make_folder(&root.join(name))?;
        }
        let path = root.join("lock");
        let lock = File::options().create(true).truncate(false).write(true).open(&path);
        let lock = lock.map_err(|error| engine::Error::io("open", &path, error))?;
        lock.try_lock().map_err(|_| {
            engine::Error::new(ErrorKind::Busy, "another worker uses this folder")
                .at(root)
                .hint("give each worker a folder of its own: `--cache DIR`")
        })?;
        for name in ["folders", "scratch"] {
            let path = root.join(name);
            fs::remove_dir_all(&path).map_err(|error| engine::Error::io("remove", &path, error))?;
            make_folder(&path)?;
        }
        let state =
            State { bytes: objects(root)?.iter().map(|object| object.bytes).sum(), ..State::default() };
        let (state, scratches) = (Mutex::new(state), AtomicU64::new(0));
        Ok(Self { root: root.to_path_buf(), bytes_max, state, scratches, _lock: lock })
    }

    /// Bytes of all objects.
    pub fn bytes(&self) -> u64 {
        self.state().bytes
    }

    /// A new empty folder for work in progress, on the same file system as the objects.
    ///
    /// # Errors
    /// When it cannot be made.
    pub fn scratch(&self) -> engine::Result<Scratch> {
        let number = self.scratches.fetch_add(1, Ordering::Relaxed);
        let path = self.root.join("scratch").join(number.to_string());
        make_folder(&path)?;
        Ok(Scratch::new(path))
    }

    /// The folder called `name` with these entries; what is missing is fetched from `depot` and verified.
    ///
    /// # Errors
    /// When an object cannot be had, is damaged, or does not fit.
    pub fn folder(&self, name: &str, entries: &[Entry], depot: &dyn Depot) -> Result<Arc<Folder>> {
        let mut state = self.state();
        let State { folders, uses, .. } = &mut *state;
        if let Some((folder, used)) = folders.get_mut(name) {
            (*uses, *used) = (*uses + 1, *uses);
            return Ok(folder.clone());
        }
        drop(state);
        let scratch = self.scratch()?;
        self.fetch(entries, depot, scratch.path())?;
        let folder = Folder { path: self.root.join("folders").join(name) };
        let made = scratch.path().join("folder");
        make_folder(&made)?;
        self.link(entries, &made)?;
        let folder_error = |error| engine::Error::io("rename to", &folder.path, error);
        fs::rename(&made, &folder.path).map_err(folder_error)?;
        let mut state = self.state();
        state.uses += 1;
        let (folder, used) = (Arc::new(folder), state.uses);
        state.folders.insert(name.into(), (folder.clone(), used));
        Ok(folder)
    }

    /// Links objects that are there into a folder that is being made.
    ///
    /// # Errors
    /// When one is not there, or cannot be linked.
    pub fn link(&self, entries: &[Entry], folder: &Path) -> engine::Result<()> {
        for Entry { path, sha256, .. } in entries {
            let (from, to) = (self.object(sha256), folder.join(path));
            make_folder(to.parent().unwrap_or(folder))?;
            fs::hard_link(&from, &to).map_err(|error| engine::Error::io("link", &to, error))?;
        }
        Ok(())
    }

    /// Fetches those objects that are not there, by way of `scratch`.
    ///
    /// # Errors
    /// When one cannot be had, is damaged, or does not fit.
    pub fn fetch(&self, entries: &[Entry], depot: &dyn Depot, scratch: &Path) -> Result<()> {
        let mut missing: Vec<&Entry> = Vec::new();
        for entry in entries {
            let path = self.object(&entry.sha256);
            match File::options()
                .append(true)
                .open(&path)
                .and_then(|file| file.set_modified(SystemTime::now()))
            {
                Ok(()) => {}
                Err(_) if path.exists() => {}
                Err(_) if missing.iter().any(|other| other.sha256 == entry.sha256) => {}
                Err(_) => missing.push(entry),
            }
        }
        for chunk in missing.chunks(protocol::limits::URLS_MAX) {
            self.make_room(chunk.iter().filter_map(|entry| entry.bytes).sum(), 0)?;
            let wanted: Vec<Wanted> = chunk
                .iter()
                .map(|entry| Wanted {
                    key: entry.key.clone(),
                    path: scratch.join(&entry.sha256),
                    bytes_max: entry.bytes.unwrap_or(self.bytes_max),
                })
                .collect();
            for (entry, (came, wanted)) in chunk.iter().zip(depot.read(&wanted).into_iter().zip(&wanted)) {
                let came = came?;
                if came.sha256 != entry.sha256 || entry.bytes.is_some_and(|bytes| bytes != came.bytes) {
                    return Err(Error::Damaged(format!("`{}` is not what its hash says", entry.key)));
                }
                self.adopt(&wanted.path, &came)?;
            }
        }
        Ok(())
    }

    /// Keeps a file whose hash is known as an object; the file stays and must not be written any more.
    ///
    /// # Errors
    /// When it does not fit or cannot be linked.
    pub fn adopt(&self, path: &Path, content: &FolderFile) -> engine::Result<()> {
        let target = self.object(&content.sha256);
        if target.exists() {
            return Ok(());
        }
        self.make_room(content.bytes, content.bytes)?;
        make_folder(target.parent().unwrap_or(&self.root))?;
        match fs::hard_link(path, &target) {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => return Ok(()),
            Err(error) => return Err(engine::Error::io("link", &target, error)),
            Ok(()) => {}
        }
        self.state().bytes += content.bytes;
        Ok(())
    }

    /// Compares every object that `folder` links to with its hash; those that are damaged are thrown away, and the folder
    /// with them. Whether there were any.
    ///
    /// # Errors
    /// When something cannot be read or removed.
    pub fn check(&self, name: &str, entries: &[Entry]) -> engine::Result<bool> {
        let mut damaged = false;
        for Entry { sha256, .. } in entries {
            let path = self.object(sha256);
            if path.exists() && digest::of_file(&path)?.sha256 != *sha256 {
                damaged = true;
                let bytes = fs::metadata(&path).map_or(0, |metadata| metadata.len());
                remove(&path)?;
                let mut state = self.state();
                state.bytes = state.bytes.saturating_sub(bytes);
            }
        }
        if damaged && let Some((folder, _)) = self.state().folders.remove(name) {
            let io = |error| engine::Error::io("remove", folder.path(), error);
            fs::remove_dir_all(folder.path()).map_err(io)?;
        }
        Ok(damaged)
    }

    /// Whether all of these objects are there.
    pub fn has(&self, files: &BTreeMap<String, FolderFile>) -> bool {
        files.values().all(|file| self.object(&file.sha256).exists())
    }

    /// Bytes that the cache may keep.
    pub fn bytes_max(&self) -> u64 {
        self.bytes_max
    }

    /// A block that was kept under `name`, from `offset` on, into `out`; false where it is not there or too short.
    pub fn read_block(&self, name: &str, offset: u64, out: &mut [u8]) -> bool {
        let read = |file: File| {
            file.read_exact_at(out, offset)?;
            file.set_modified(SystemTime::now())
        };
        File::open(self.block(name)).and_then(read).is_ok()
    }

    /// Keeps a block.
    ///
    /// # Errors
    /// When it does not fit or cannot be written.
    pub fn keep_block(&self, name: &str, bytes: &[u8]) -> engine::Result<()> {
        self.make_room(bytes.len() as u64, 0)?;
        let (path, scratch) = (self.block(name), self.scratch()?);
        let temporary = scratch.path().join("block");
        fs::write(&temporary, bytes).map_err(|error| engine::Error::io("write", &temporary, error))?;
        make_folder(path.parent().unwrap_or(&self.root))?;
        let known = fs::metadata(&path).map_or(0, |metadata| metadata.len());
        fs::rename(&temporary, &path).map_err(|error| engine::Error::io("rename to", &path, error))?;
        let mut state = self.state();
        state.bytes = (state.bytes + bytes.len() as u64).saturating_sub(known);
        Ok(())
    }

    /// Throws away the blocks whose names begin with `prefix`; whether there were any.
    ///
    /// # Errors
    /// When one cannot be removed.
    pub fn forget_blocks(&self, prefix: &str) -> engine::Result<bool> {
        let prefix = self.block(prefix);
        let mut found = objects(&self.root)?;
        found.retain(|object| {
            object.path.as_os_str().as_encoded_bytes().starts_with(prefix.as_os_str().as_encoded_bytes())
        });
        let mut state = self.state();
        for object in &found {
            remove(&object.path)?;
            state.bytes = state.bytes.saturating_sub(object.bytes);
        }
        Ok(!found.is_empty())
    }

    fn block(&self, name: &str) -> PathBuf {
        self.root.join("objects").join("blocks").join(name)
    }

    /// Makes room for so many bytes, and some more: finding what can go takes time. Work in progress has precedence over
    /// what is kept, and is not what a cache is too small for. `there` bytes of what is wanted are in progress as yet.
    fn make_room(&self, wanted: u64, there: u64) -> engine::Result<()> {
        let bytes = wanted + in_progress(&self.root).saturating_sub(there);
        let mut state = self.state();
        if state.bytes + bytes <= self.bytes_max {
            return Ok(());
        }
        let ample = self.bytes_max - self.bytes_max / 16;
        // Objects that no folder links to first, then folders one by one
        loop {
            let mut free: Vec<Object> = objects(&self.root)?;
            free.retain(|object| object.links == 1);
            free.sort_by(|a, b| (a.used, &a.path).cmp(&(b.used, &b.path)));
            for object in free {
                if state.bytes + bytes <= ample {
                    return Ok(());
                }
                remove(&object.path)?;
                state.bytes = state.bytes.saturating_sub(object.bytes);
            }
            if state.bytes + bytes <= self.bytes_max {
                return Ok(());
            }
            let unheld = state.folders.iter().filter(|(_, (folder, _))| Arc::strong_count(folder) == 1);
            let Some(name) = unheld.min_by_key(|(_, (_, used))| *used).map(|(name, _)| name.clone()) else {
                if state.bytes + wanted <= self.bytes_max {
                    return Ok(());
                }
                let message =
                    format!("the cache of {} bytes is full, {wanted} more are needed", self.bytes_max);
                return Err(engine::Error::new(ErrorKind::Limit, message)
                    .at(&self.root)
                    .hint("give the worker more: `--cache-size`"));
            };
            if let Some((folder, _)) = state.folders.remove(&name) {
                let io = |error| engine::Error::io("remove", folder.path(), error);
                fs::remove_dir_all(folder.path()).map_err(io)?;
            }
        }
    }

    fn object(&self, sha256: &str) -> PathBuf {
        self.root.join("objects").join(&sha256[..2]).join(sha256)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::digest;

    /// Catches a quota that work in progress does not count for, and work that fails because of what is kept.
    #[test]
    fn what_is_kept_makes_room_for_work_in_progress() {
        let root = tempfile::tempdir().unwrap();
        let cache = Cache::open(root.path(), 16_000).unwrap();
        let keep = |name: &str, bytes: usize| {
            let scratch = cache.scratch().unwrap();
            let path = scratch.path().join(name);
            let content = digest::of_bytes(&vec![name.as_bytes()[0]; bytes]);
            fs::write(&path, vec![name.as_bytes()[0]; bytes]).unwrap();
            cache.adopt(&path, &content)
        };
        keep("a", 7_000).unwrap();
        keep("b", 7_000).unwrap();
        assert_eq!(cache.bytes(), 14_000);
        let work = cache.scratch().unwrap();
        fs::write(work.path().join("work"), vec![0; 6_000]).unwrap();
        keep("c", 1_000).unwrap();
        assert!(cache.bytes() <= 10_000, "{}", cache.bytes());
        // Work alone may take more than the quota: what is kept is only less useful then
        fs::write(work.path().join("more"), vec![0; 60_000]).unwrap();
        keep("d", 1_000).unwrap();
        assert!(cache.bytes() <= 2_000, "{}", cache.bytes());
        assert!(keep("e", 17_000).is_err());
    }
}
