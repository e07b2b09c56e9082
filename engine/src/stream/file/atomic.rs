//! Writes a file under a temporary name beside its target and renames it when it is complete.

use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::{Error, ErrorKind, Result};

/// Temporary names tried before giving up; a clash needs a file left over from a process of the same number.
const NAMES_MAX: u64 = 64;

/// A file that appears under its name only when [`commit`](Self::commit) succeeds.
///
/// Until then it is `.NAME.PROCESS-NUMBER.partial` in the same folder. Dropped without a commit, it is removed and
/// the target, if there was one, stays as it was.
#[derive(Debug)]
pub struct AtomicFile {
    target: PathBuf,
    partial: PathBuf,
    file: Option<File>,
}

impl AtomicFile {
    /// Opens a temporary file beside `target`.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when `target` names no file, otherwise what the operating system says.
    pub fn create(target: &Path) -> Result<Self> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let Some(name) = target.file_name() else {
            return Err(Error::invalid("the output's path names no file").at(target));
        };
        if target.is_dir() {
            return Err(Error::invalid("the output's path is a folder").at(target).hint("name a file in it"));
        }
        for _ in 0..NAMES_MAX {
            let number = NEXT.fetch_add(1, Ordering::Relaxed);
            let mut partial = std::ffi::OsString::from(".");
            partial.push(name);
            partial.push(format!(".{}-{number}.partial", std::process::id()));
            let partial = target.with_file_name(partial);
            match OpenOptions::new().read(true).write(true).create_new(true).open(&partial) {
                Ok(file) => return Ok(Self { target: target.to_path_buf(), partial, file: Some(file) }),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(Error::io("create", target, error)),
            }
        }
        Err(Error::new(ErrorKind::Io, "cannot find a free temporary name").at(target))
    }

    /// The name it will have.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Flushes the data to the disk, renames the file to its target and makes the name durable.
    ///
    /// # Errors
    /// When the operating system refuses; the temporary file is then removed.
    pub fn commit(mut self) -> Result<()> {
        let file = self.file.take().expect("open until commit or drop");
        let result = file.sync_all().and_then(|()| {
            drop(file);
            std::fs::rename(&self.partial, &self.target)
        });
        if let Err(error) = result {
            let _ = std::fs::remove_file(&self.partial);
            return Err(Error::io("write", &self.target, error));
        }
        // A rename survives a power cut only when the folder reached the disk. Not every file system can do this,
        // and the file itself is complete, so a refusal is no error.
        let parent = self.target.parent().filter(|parent| !parent.as_os_str().is_empty());
        if let Ok(folder) = File::open(parent.unwrap_or(Path::new("."))) {
            let _ = folder.sync_all();
        }
        Ok(())
    }

    fn open_file(&mut self) -> &mut File {
        self.file.as_mut().expect("open until commit or drop")
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        if self.file.take().is_some() {
            let _ = std::fs::remove_file(&self.partial);
        }
    }
}

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.open_file().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.open_file().flush()
    }
}

impl Seek for AtomicFile {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.open_file().seek(position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    /// Catches a half-written file under the final name, and temporary files that stay.
    #[test]
    fn the_target_appears_at_commit_only_and_nothing_else_stays() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("a.bin");
        std::fs::write(&target, "old").unwrap();
        let mut file = AtomicFile::create(&target).unwrap();
        file.write_all(b"new").unwrap();
        assert_eq!(std::fs::read(&target).unwrap(), b"old");
        drop(file);
        assert_eq!(names(folder.path()), ["a.bin"]);
        let mut file = AtomicFile::create(&target).unwrap();
        file.write_all(b"new").unwrap();
        file.commit().unwrap();
        assert_eq!(std::fs::read(&target).unwrap(), b"new");
        assert_eq!(names(folder.path()), ["a.bin"]);
    }

    /// Catches a missing folder or a folder as target that is noticed only at the end.
    #[test]
    fn impossible_targets_are_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let missing = AtomicFile::create(&folder.path().join("none/a.bin")).unwrap_err();
        assert_eq!(missing.kind(), ErrorKind::NotFound);
        let is_folder = AtomicFile::create(folder.path()).unwrap_err();
        assert_eq!(is_folder.kind(), ErrorKind::Invalid);
    }
}
