//! The log of finished parts in a bake folder: append only, so that an interrupted bake loses little and repeats less.
//!
//! ```text
//! header │ frame │ frame │ …        frame = length, check of the length, encoded part
//! ```
//!
//! Every frame is written with one call, so a killed process loses nothing that was appended. What a power cut may
//! take is bounded: the log goes to disk every 32 MiB, and whenever the owner, who has a clock, asks.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::{xxh3_64, xxh3_64_with_seed};

use super::{Part, PartFormat};
use crate::batch::BitSet;
use crate::stream::file::AtomicFile;
use crate::{Error, ErrorKind, Result};

const MAGIC: &[u8; 8] = b"PNTRPLOG";
const VERSION: u32 = 1;
const FRAME_BYTES: u64 = 8;

/// Appended bytes after which the log goes to disk: some seconds of baking on a fast machine, a minute on a slow one.
const SYNC_BYTES: u64 = 32 << 20;

/// Where a merge gets its parts from, in any order.
pub trait PartSource {
    /// What the parts have in common.
    fn format(&self) -> &PartFormat;

    /// Starts again from the first part.
    ///
    /// # Errors
    /// When the source cannot be read again.
    fn rewind(&mut self) -> Result<()>;

    /// Reads the next part into `part`, reusing its memory. False at the end.
    ///
    /// # Errors
    /// When a part is unreadable or damaged; the error says where.
    fn next(&mut self, part: &mut Part) -> Result<bool>;
}

/// What opening a log found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Recovery {
    /// Whole parts.
    pub parts: u64,
    /// Frames whose part is damaged; their batches count as not done.
    pub damaged: u64,
    /// Bytes of a torn end that were cut off.
    pub truncated_bytes: u64,
}

/// The parts of one bake set in one append-only file.
///
/// The file is locked as long as it is open. Memory: 24 bytes per batch and one part.
#[derive(Debug)]
pub struct PartLog {
    path: PathBuf,
    file: File,
    format: PartFormat,
    /// Where each batch's part is.
    entries: Vec<Entry>,
    completed: BitSet,
    recovery: Recovery,
    end: u64,
    unsynced_bytes: u64,
    buffer: Vec<u8>,
    /// The batch that iteration comes to next.
    cursor: usize,
}

/// Where a part is. No part has length zero.
#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    offset: u64,
    bytes: u32,
    hash: u64,
}

impl PartLog {
    /// Opens the log at `path` for a bake set of `batches` batches, to continue it; makes it where there is none.
    ///
    /// Every part is read and checked. A damaged one counts as not done and is skipped from then on. Where the frames
    /// themselves break off, as after a power cut, the rest is cut off.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when the log is of another bake, [`ErrorKind::Busy`] when another process has it,
    /// [`ErrorKind::Corrupt`] when the header is damaged, and what the operating system refuses.
    pub fn open(path: impl AsRef<Path>, format: &PartFormat, batches: u32) -> Result<Self> {
        let path = path.as_ref().to_path_buf();
        let header = header(format, batches);
        match path.try_exists() {
            Ok(true) => {}
            // The header appears as a whole: a log without one is damaged, never merely young.
            Ok(false) => {
                let mut file = AtomicFile::create(&path)?;
                file.write_all(&header).map_err(|error| Error::io("write the log", &path, error))?;
                file.commit()?;
            }
            Err(error) => return Err(Error::io("open the log", &path, error)),
        }
        let file = OpenOptions::new().read(true).write(true).open(&path);
        let file = file.map_err(|error| Error::io("open the log", &path, error))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let error = Error::new(ErrorKind::Busy, "another process writes to this log").at(&path);
                return Err(error.hint("wait for the other bake to end"));
            }
            Err(TryLockError::Error(error)) => return Err(Error::io("lock the log", &path, error)),
        }
        let mut log = Self {
            path,
            file,
            format: format.clone(),
            entries: vec![Entry::default(); batches as usize],
            completed: BitSet::new(u64::from(batches)),
            recovery: Recovery::default(),
            end: 0,
            unsynced_bytes: 0,
            buffer: Vec::new(),
            cursor: 0,
        };
        log.check_header(&header)?;
        log.scan(header.len() as u64)?;
        Ok(log)
    }

    /// The batches whose part is in the log.
    pub fn completed(&self) -> &BitSet {
        &self.completed
    }

    /// What opening found.
    pub fn recovery(&self) -> Recovery {
        self.recovery
    }

    /// Appends the part of a batch. A part that is there already with the same bytes is no error and no work.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when the part does not fit the format, has no such batch, or differs from the one that is
    /// there already; and what the operating system refuses: the log ends before the part then.
    pub fn append(&mut self, part: &Part) -> Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        buffer.clear();
        buffer.resize(FRAME_BYTES as usize, 0);
        let result =
            part.encode(&self.format, &mut buffer).and_then(|()| self.append_frame(part.batch, &mut buffer));
        self.buffer = buffer;
        result
    }

    /// Brings all that was appended to disk.
    ///
    /// # Errors
    /// When the operating system refuses.
    pub fn sync(&mut self) -> Result<()> {
        self.file.sync_data().map_err(|error| Error::io("write the log to disk", &self.path, error))?;
        self.unsynced_bytes = 0;
        Ok(())
    }

    /// Writes a frame, whose first eight bytes are still free, at the end.
    fn append_frame(&mut self, batch: u32, frame: &mut [u8]) -> Result<()> {
        let part = &frame[FRAME_BYTES as usize..];
        let (bytes, hash) = (part.len() as u32, xxh3_64(part));
        match self.entries.get(batch as usize) {
            None => {
                let message = format!("batch `{batch}` of a bake set of {} batches", self.entries.len());
                return Err(Error::invalid(message));
            }
            Some(entry) if entry.bytes == bytes && entry.hash == hash => return Ok(()),
            Some(entry) if entry.bytes != 0 => {
                let message = format!("batch `{batch}` was baked twice with different results");
                return Err(Error::invalid(message).at_byte(&self.path, entry.offset));
            }
            Some(_) => {}
        }
        let offset = self.end;
        frame[..FRAME_BYTES as usize].copy_from_slice(&frame_header(offset, bytes));
        let written = self.file.seek(SeekFrom::Start(offset)).and_then(|_| self.file.write_all(frame));
        if let Err(error) = written {
            // Half a frame would be cut off by the next opening as well; the first error is the one to tell.
            let _ = self.file.set_len(offset);
            return Err(Error::io("append to the log", &self.path, error));
        }
        self.end += frame.len() as u64;
        self.unsynced_bytes += frame.len() as u64;
        self.entries[batch as usize] = Entry { offset: offset + FRAME_BYTES, bytes, hash };
        self.completed.insert(u64::from(batch));
        if self.unsynced_bytes >= SYNC_BYTES { self.sync() } else { Ok(()) }
    }

    fn check_header(&mut self, expected: &[u8]) -> Result<()> {
        let mut found = vec![0; expected.len()];
        self.file.read_exact(&mut found).map_err(|error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof => {
                Error::corrupt(&self.path, 0, "the log ends within its header")
            }
            _ => Error::io("read the log", &self.path, error),
        })?;
        if found[..8] != MAGIC[..] {
            return Err(Error::corrupt(&self.path, 0, "this is not a log of batch parts"));
        }
        let version = u32::from_le_bytes(found[8..12].try_into().expect("4 bytes"));
        if version != VERSION {
            let message = format!("version {version} of a log of batch parts, {VERSION} wanted");
            return Err(Error::unsupported(message).at_byte(&self.path, 8));
        }
        if found != expected {
            return Err(Error::invalid("this log is one of another bake, or its header is damaged")
                .at(&self.path)
                .hint("bake into another folder, or begin anew with --restart"));
        }
        Ok(())
    }

    /// Reads all frames from `start` on, notes where parts are, and cuts off a torn end.
    fn scan(&mut self, start: u64) -> Result<()> {
        let refused = |error| Error::io("read the log", &self.path, error);
        let file_bytes = self.file.metadata().map_err(refused)?.len();
        let mut input = BufReader::with_capacity(1 << 20, &self.file);
        let mut part = Part::default();
        let mut bytes = Vec::new();
        let mut at = start;
        while file_bytes - at >= FRAME_BYTES {
            let mut head = [0; FRAME_BYTES as usize];
            input.read_exact(&mut head).map_err(refused)?;
            let length = u32::from_le_bytes(head[..4].try_into().expect("4 bytes"));
            let sound = head == frame_header(at, length) && length as usize <= self.format.part_bytes_max();
            if !sound || length == 0 || file_bytes - at - FRAME_BYTES < u64::from(length) {
                break;
            }
            let offset = at + FRAME_BYTES;
            bytes.resize(length as usize, 0);
            input.read_exact(&mut bytes).map_err(refused)?;
            at = offset + u64::from(length);
            match part.decode(&bytes, &self.format, &self.path, offset) {
                Ok(()) if u64::from(part.batch) < self.completed.len() => {
                    self.recovery.parts += u64::from(self.completed.insert(u64::from(part.batch)));
                    self.entries[part.batch as usize] =
                        Entry { offset, bytes: length, hash: xxh3_64(&bytes) };
                }
                _ => self.recovery.damaged += 1,
            }
        }
        self.recovery.truncated_bytes = file_bytes - at;
        self.end = at;
        if at < file_bytes {
            let cut = self.file.set_len(at).and_then(|()| self.file.sync_all());
            cut.map_err(|error| Error::io("cut off the torn end of the log", &self.path, error))?;
        }
        Ok(())
    }
}

impl Drop for PartLog {
    fn drop(&mut self) {
        // An owner that wants to know calls `sync`; here nobody listens.
        let _ = self.file.sync_data();
    }
}

impl PartSource for PartLog {
    fn format(&self) -> &PartFormat {
        &self.format
    }

    fn rewind(&mut self) -> Result<()> {
        self.cursor = 0;
        Ok(())
    }

    fn next(&mut self, part: &mut Part) -> Result<bool> {
        let Some(skip) = self.entries[self.cursor..].iter().position(|entry| entry.bytes != 0) else {
            return Ok(false);
        };
        let batch = self.cursor + skip;
        let entry = self.entries[batch];
        self.cursor = batch + 1;
        self.buffer.resize(entry.bytes as usize, 0);
        let read = self
            .file
            .seek(SeekFrom::Start(entry.offset))
            .and_then(|_| self.file.read_exact(&mut self.buffer));
        read.map_err(|error| Error::io("read the log", &self.path, error))?;
        part.decode(&self.buffer, &self.format, &self.path, entry.offset)?;
        if part.batch as usize != batch {
            let message = format!("the part of batch `{}` where that of `{batch}` was", part.batch);
            return Err(Error::corrupt(&self.path, entry.offset, message));
        }
        Ok(true)
    }
}

/// The header of a log: magic, version, batches, bake, points of a part at most, row layout, checksum.
fn header(format: &PartFormat, batches: u32) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&batches.to_le_bytes());
    out.extend_from_slice(&format.bake().to_le_bytes());
    out.extend_from_slice(&format.points_max().to_le_bytes());
    out.extend_from_slice(&(format.layout().len() as u32).to_le_bytes());
    out.extend_from_slice(format.layout());
    let checksum = xxh3_64(&out);
    out.extend_from_slice(&checksum.to_le_bytes());
    out
}

/// The head of a frame at `offset`: its length, and a check of it that fails at any other place.
fn frame_header(offset: u64, length: u32) -> [u8; FRAME_BYTES as usize] {
    let mut bytes = [0; FRAME_BYTES as usize];
    bytes[..4].copy_from_slice(&length.to_le_bytes());
    let check = xxh3_64_with_seed(&length.to_le_bytes(), offset) as u32;
    bytes[4..].copy_from_slice(&check.to_le_bytes());
    bytes
}

#[cfg(test)]
#[path = "log_tests.rs"]
mod tests;
