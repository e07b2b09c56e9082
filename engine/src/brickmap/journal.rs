//! The journal of a map under construction: which partitions are written, so that a build that was interrupted continues.
//!
//! ```text
//! header  `PTRJ`, version u32, content u128: a hash of everything that the map depends on
//! entry   note bytes u32, bricks u32, note, per brick length / 64 - 1 as u16, xxh3 of the bricks u64, xxh3 of all that u64
//! ```
//!
//! Entries are written after their bricks. What is not whole, or whose bricks do not have their hash, is as if it had never
//! been written; so nothing needs to be synced on the way.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::xxh3_64;

use crate::brick::ALIGNMENT;
use crate::{Error, ErrorKind, Result};

const MAGIC: [u8; 4] = *b"PTRJ";
const VERSION: u32 = 1;
const HEADER_BYTES: u64 = 24;
/// Bytes of a note at most.
const NOTE_BYTES_MAX: u32 = 1 << 16;

/// A journal, locked while it is open.
#[derive(Debug)]
pub struct Journal {
    file: File,
    path: PathBuf,
}

/// Bricks that were written in one go.
#[derive(Debug, PartialEq)]
pub struct Entry {
    /// What the writer wants to know of them.
    pub note: Vec<u8>,
    /// Bytes of each brick.
    pub lengths: Vec<u32>,
    /// xxh3 of their bytes.
    pub checksum: u64,
    /// Where the entry ends in the journal.
    pub end: u64,
}

impl Journal {
    /// Opens the journal at `path`, or begins one for `content` where there is none, or one for something else.
    /// True when it was there.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`] when another process has it, and when the disk fails.
    pub fn open(path: &Path, content: u128) -> Result<(Self, bool)> {
        let io = |error| Error::io("open", path, error);
        let mut file =
            File::options().read(true).write(true).create(true).truncate(false).open(path).map_err(io)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(std::fs::TryLockError::WouldBlock) => {
                let message = "another process is building this brick map";
                return Err(Error::new(ErrorKind::Busy, message).at(path).hint("wait for it"));
            }
            Err(std::fs::TryLockError::Error(error)) => return Err(Error::io("lock", path, error)),
        }
        let mut expected = [0; HEADER_BYTES as usize];
        expected[..4].copy_from_slice(&MAGIC);
        expected[4..8].copy_from_slice(&VERSION.to_le_bytes());
        expected[8..].copy_from_slice(&content.to_le_bytes());
        let mut found = [0; HEADER_BYTES as usize];
        let is_known = file.read_exact(&mut found).is_ok() && found == expected;
        if !is_known {
            let begin = |file: &mut File| {
                file.set_len(0)?;
                file.seek(SeekFrom::Start(0))?;
                file.write_all(&expected)
            };
            begin(&mut file).map_err(|error| Error::io("write", path, error))?;
        }
        Ok((Self { file, path: path.to_path_buf() }, is_known))
    }

    /// The entries from the beginning, up to the first that is not whole.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn entries(&mut self) -> Result<impl Iterator<Item = Entry> + '_> {
        let io = |error| Error::io("read", &self.path, error);
        let bytes = self.file.metadata().map_err(io)?.len();
        self.file.seek(SeekFrom::Start(HEADER_BYTES)).map_err(io)?;
        let mut reader = BufReader::new(&self.file);
        let mut at = HEADER_BYTES;
        Ok(std::iter::from_fn(move || {
            let entry = read_entry(&mut reader, at, bytes)?;
            at = entry.end;
            Some(entry)
        }))
    }

    /// Forgets what follows `end`, which is where the next entry goes.
    ///
    /// # Errors
    /// When the disk fails.
    pub fn truncate(&mut self, end: u64) -> Result<()> {
        let end = end.max(HEADER_BYTES);
        let truncate = self.file.set_len(end).and_then(|()| self.file.seek(SeekFrom::Start(end)));
        truncate.map(|_| ()).map_err(|error| Error::io("write", &self.path, error))
    }

    /// Adds an entry for bricks that have been written.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn append(&mut self, note: &[u8], lengths: &[u32], checksum: u64) -> Result<()> {
        debug_assert!(note.len() <= NOTE_BYTES_MAX as usize);
        let mut bytes = Vec::with_capacity(24 + note.len() + 2 * lengths.len());
        bytes.extend_from_slice(&(note.len() as u32).to_le_bytes());
        bytes.extend_from_slice(&(lengths.len() as u32).to_le_bytes());
        bytes.extend_from_slice(note);
        for &length in lengths {
            bytes.extend_from_slice(&((length / ALIGNMENT as u32 - 1) as u16).to_le_bytes());
        }
        bytes.extend_from_slice(&checksum.to_le_bytes());
        bytes.extend_from_slice(&xxh3_64(&bytes).to_le_bytes());
        self.file.write_all(&bytes).map_err(|error| Error::io("write", &self.path, error))
    }
}

/// The entry at byte `at` of a journal of `file_bytes`; none if it is not whole.
fn read_entry(reader: &mut impl Read, at: u64, file_bytes: u64) -> Option<Entry> {
    let mut bytes = vec![0; 8];
    reader.read_exact(&mut bytes).ok()?;
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
    let (note_bytes, bricks) = (word(0), word(4));
    let end = at + 24 + u64::from(note_bytes) + 2 * u64::from(bricks);
    if note_bytes > NOTE_BYTES_MAX || end > file_bytes {
        return None;
    }
    bytes.resize((end - at) as usize, 0);
    reader.read_exact(&mut bytes[8..]).ok()?;
    let (content, hash) = bytes.split_at(bytes.len() - 8);
    if xxh3_64(content).to_le_bytes() != *hash {
        return None;
    }
    let (note, rest) = content[8..].split_at(note_bytes as usize);
    let (lengths, checksum) = rest.split_at(2 * bricks as usize);
    let length = |bytes: &[u8; 2]| (u32::from(u16::from_le_bytes(*bytes)) + 1) * ALIGNMENT as u32;
    Some(Entry {
        note: note.to_vec(),
        lengths: lengths.as_chunks::<2>().0.iter().map(length).collect(),
        checksum: u64::from_le_bytes(checksum.try_into().expect("8 bytes")),
        end,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches an entry that is half there and believed, or whole and forgotten, and a journal of something else.
    #[test]
    fn whole_entries_survive() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal");
        let (mut journal, known) = Journal::open(&path, 7).unwrap();
        assert!(!known);
        assert_eq!(Journal::open(&path, 7).unwrap_err().kind(), ErrorKind::Busy);
        let lengths = [vec![64, 4096], vec![], vec![128; 1000]];
        for (i, lengths) in lengths.iter().enumerate() {
            journal.append(format!("note {i}").as_bytes(), lengths, i as u64).unwrap();
        }
        drop(journal);
        let whole = std::fs::read(&path).unwrap();
        let mut ends = Vec::new();
        for cut in (0..=whole.len()).rev() {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let (mut journal, known) = Journal::open(&path, 7).unwrap();
            assert_eq!(known, cut as u64 >= HEADER_BYTES);
            let entries: Vec<Entry> = journal.entries().unwrap().collect();
            if cut == whole.len() {
                ends = entries.iter().map(|entry| entry.end).collect();
            }
            assert_eq!(entries.len(), ends.iter().filter(|&&end| end <= cut as u64).count(), "{cut}");
            for (i, entry) in entries.iter().enumerate() {
                assert_eq!((&entry.lengths, entry.checksum), (&lengths[i], i as u64));
            }
        }
        // A flipped bit ends it there; what follows the last good entry goes
        let mut flipped = whole.clone();
        flipped[ends[0] as usize + 9] ^= 1;
        std::fs::write(&path, &flipped).unwrap();
        let (mut journal, _) = Journal::open(&path, 7).unwrap();
        assert_eq!(journal.entries().unwrap().count(), 1);
        journal.truncate(ends[0]).unwrap();
        journal.append(b"again", &[192], 5).unwrap();
        assert_eq!(journal.entries().unwrap().last().unwrap().lengths, [192]);
        drop(journal);
        assert!(!Journal::open(&path, 8).unwrap().1);
    }
}
