//! Temporary files: files that vanish with their owner, and files of points read and written in one pass.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::Point;
use crate::math::Bounds;
use crate::{Error, Result};

/// Bytes of a read or write buffer, a whole number of points: large enough that the kernel's part is small.
const BUFFER_BYTES: usize = 23_831 * Point::BYTES;

/// A file that is removed when its owner lets go of it.
#[derive(Debug)]
pub struct ScratchFile {
    /// The open file.
    pub file: File,
    path: PathBuf,
}

impl ScratchFile {
    /// A new file for reading and writing.
    ///
    /// # Errors
    /// When the file exists already or cannot be made.
    pub fn create(path: PathBuf) -> Result<Self> {
        let options = OpenOptions::new().read(true).write(true).create_new(true).open(&path);
        let file = options.map_err(|error| Error::io("create the temporary file", &path, error))?;
        Ok(Self { file, path })
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for ScratchFile {
    fn drop(&mut self) {
        // A file that cannot be removed now is swept by the next run.
        let _ = fs::remove_file(&self.path);
    }
}

/// Removes the files in `folder` that a killed run left: those whose names start with `prefix` and end in `suffix`.
///
/// # Errors
/// When the folder cannot be read or a file cannot be removed.
pub fn sweep(folder: &Path, prefix: &str, suffix: &str) -> Result<()> {
    let entries = fs::read_dir(folder).map_err(|error| Error::io("read the folder", folder, error))?;
    for entry in entries {
        let entry = entry.map_err(|error| Error::io("read the folder", folder, error))?;
        let name = entry.file_name();
        if name.to_str().is_some_and(|name| name.starts_with(prefix) && name.ends_with(suffix)) {
            let path = entry.path();
            fs::remove_file(&path).map_err(|error| Error::io("remove the stale file", &path, error))?;
        }
    }
    Ok(())
}

/// Writes points one after the other and keeps count and bounds.
pub struct PointWriter {
    scratch: ScratchFile,
    buffer: Vec<u8>,
    points: u64,
    bounds: Bounds,
}

impl PointWriter {
    /// A writer into a new temporary file.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: PathBuf) -> Result<Self> {
        let scratch = ScratchFile::create(path)?;
        Ok(Self { scratch, buffer: Vec::with_capacity(BUFFER_BYTES), points: 0, bounds: Bounds::EMPTY })
    }

    /// Appends a point.
    ///
    /// # Errors
    /// When the disk is full or refuses.
    pub fn push(&mut self, point: &Point) -> Result<()> {
        self.buffer.extend_from_slice(&point.to_bytes());
        self.points += 1;
        self.bounds.add(point.position);
        if self.buffer.len() >= BUFFER_BYTES { self.flush() } else { Ok(()) }
    }

    /// Ends writing.
    ///
    /// # Errors
    /// When the disk is full or refuses.
    pub fn finish(mut self) -> Result<PointFile> {
        self.flush()?;
        Ok(PointFile { scratch: self.scratch, points: self.points, bounds: self.bounds })
    }

    fn flush(&mut self) -> Result<()> {
        let written = self.scratch.file.write_all(&self.buffer);
        written.map_err(|error| Error::io("write points", self.scratch.path(), error))?;
        self.buffer.clear();
        Ok(())
    }
}

/// Points in a temporary file, read in one pass, as often as wanted.
pub struct PointFile {
    scratch: ScratchFile,
    /// How many.
    pub points: u64,
    /// Their box.
    pub bounds: Bounds,
}

impl PointFile {
    /// Calls `each` with every point, in the order they were written.
    ///
    /// # Errors
    /// When the file cannot be read, or the first error of `each`.
    pub fn for_each(&mut self, mut each: impl FnMut(&Point) -> Result<()>) -> Result<()> {
        let refused = |path: &Path, error| Error::io("read points", path, error);
        let Self { scratch: ScratchFile { file, path }, points, .. } = self;
        file.seek(SeekFrom::Start(0)).map_err(|error| refused(path, error))?;
        let mut buffer = vec![0; BUFFER_BYTES];
        let mut rest = *points;
        while rest > 0 {
            let count = rest.min((BUFFER_BYTES / Point::BYTES) as u64);
            let bytes = &mut buffer[..count as usize * Point::BYTES];
            file.read_exact(bytes).map_err(|error| refused(path, error))?;
            for record in bytes.as_chunks().0 {
                each(&Point::from_bytes(record))?;
            }
            rest -= count;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec3, Vec3};

    /// Catches points lost at the border of a buffer, and files that stay behind.
    #[test]
    fn points_come_back_in_order_and_the_file_vanishes() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("split-0.tmp");
        let count = 2 * (BUFFER_BYTES / Point::BYTES) as u64 + 5;
        let mut writer = PointWriter::create(path.clone()).expect("a file");
        for index in 0..count {
            let position = DVec3::new(index as f64, -(index as f64), 1.0);
            writer.push(&Point { index, position, normal: Vec3::Y }).expect("written");
        }
        let mut file = writer.finish().expect("written");
        assert_eq!(file.points, count);
        assert_eq!(file.bounds.max, DVec3::new((count - 1) as f64, 0.0, 1.0));
        for _ in 0..2 {
            let mut expected = 0;
            file.for_each(|point| {
                assert_eq!(point.index, expected);
                expected += 1;
                Ok(())
            })
            .expect("read");
            assert_eq!(expected, count);
        }
        drop(file);
        assert!(!path.exists());
    }

    /// Catches a sweep that leaves a killed run's files, or takes what is not its own.
    #[test]
    fn the_sweep_takes_its_own_and_nothing_else() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["split-7.tmp", "split-7.bin", "plan.bin", "other.tmp"] {
            fs::write(folder.path().join(name), b"x").expect("written");
        }
        sweep(folder.path(), "split-", ".tmp").expect("swept");
        let mut left: Vec<_> =
            fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["other.tmp", "plan.bin", "split-7.bin"]);
    }
}
