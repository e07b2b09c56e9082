//! Writes a brick map, and continues one whose build was interrupted.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::file::{BRICKS_MAX, Manifest, SEGMENT_BYTES, entry, place, place_after, segment_name};
use super::journal::Journal;
use crate::brick::BYTES_MAX;
use crate::{Error, ErrorKind, Result};

/// Writes a brick map. While it is not complete it is a hidden folder beside the target, with a journal in it.
#[derive(Debug)]
pub struct MapWriter {
    target: PathBuf,
    unfinished: PathBuf,
    journal: Journal,
    segment: Option<File>,
    /// Segments on their way to the disk.
    syncs: Vec<JoinHandle<std::io::Result<()>>>,
    offset: u64,
    directory: Vec<u8>,
    /// Whether the folder stays when the writer goes.
    stays: bool,
}

/// The hidden folder in which the map `target` is made.
pub fn unfinished_path(target: &Path) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    target.with_file_name(format!(".{name}.unfinished"))
}

/// Whether a path is such a folder.
pub fn is_unfinished(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with('.') && name.ends_with(".unfinished")
}

impl MapWriter {
    /// Starts a map of `content` that will appear at `target`, or continues one that was interrupted. `parse` reads the
    /// notes of its journal: whether the bricks up to there can stay, and what the caller makes of the note.
    ///
    /// # Errors
    /// When the folder cannot be made or read, or another process is writing it.
    pub fn open<N>(
        target: &Path,
        content: u128,
        parse: impl Fn(&[u8]) -> Option<(bool, N)>,
    ) -> Result<(Self, Vec<N>)> {
        let unfinished = unfinished_path(target);
        std::fs::create_dir_all(&unfinished).map_err(|e| Error::io("create the folder", &unfinished, e))?;
        let (mut journal, is_known) = Journal::open(&unfinished.join("journal"), content)?;
        let mut kept = Kept::default();
        if is_known {
            kept = Kept::find(&unfinished, &mut journal, &parse)?;
        }
        journal.truncate(kept.journal_end)?;
        let mut writer = Self {
            target: target.to_path_buf(),
            unfinished,
            journal,
            segment: None,
            syncs: Vec::new(),
            offset: kept.offset,
            directory: kept.directory,
            stays: false,
        };
        writer.cut_segments().map_err(|error| Error::io("continue", &writer.unfinished, error))?;
        Ok((writer, kept.notes))
    }

    /// Removes what follows `offset`, and opens the segment that it lies in.
    fn cut_segments(&mut self) -> std::io::Result<()> {
        let (number, within) = (self.offset / SEGMENT_BYTES, self.offset % SEGMENT_BYTES);
        let whole = number + u64::from(within > 0);
        for entry in std::fs::read_dir(&self.unfinished)? {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let is_kept = name == "journal" || (0..whole).any(|number| segment_name(number) == name);
            if !is_kept {
                std::fs::remove_file(path)?;
            }
        }
        if within > 0 {
            let mut file = File::options().write(true).open(self.unfinished.join(segment_name(number)))?;
            file.set_len(within)?;
            file.seek(SeekFrom::End(0))?;
            self.segment = Some(file);
        }
        Ok(())
    }

    /// Bricks written so far.
    pub fn bricks(&self) -> u32 {
        (self.directory.len() / 8) as u32
    }

    /// Writes bricks that lie one after the other in `bytes`. With a note they are entered in the journal.
    ///
    /// # Errors
    /// When the disk is full or fails, or there are too many bricks.
    pub fn write(&mut self, bytes: &[u8], lengths: &[u32], note: Option<&[u8]>) -> Result<()> {
        if (self.directory.len() / 8 + lengths.len()) as u64 > BRICKS_MAX {
            return Err(Error::new(ErrorKind::Limit, format!("more than {BRICKS_MAX} bricks")));
        }
        // One call for all bricks that go into one segment
        let (mut from, mut to) = (0, 0);
        for &length in lengths {
            let offset = place_after(self.offset, u64::from(length));
            if offset.is_multiple_of(SEGMENT_BYTES) {
                self.append(&bytes[from..to])?;
                from = to;
                self.next_segment(offset / SEGMENT_BYTES)?;
            }
            self.directory.extend_from_slice(&entry(offset, length).to_le_bytes());
            self.offset = offset + u64::from(length);
            to += length as usize;
        }
        self.append(&bytes[from..to])?;
        match note {
            Some(note) => self.journal.append(note, lengths, xxh3_64(&bytes[..to])),
            None => Ok(()),
        }
    }

    fn append(&mut self, bytes: &[u8]) -> Result<()> {
        match &mut self.segment {
            Some(segment) if !bytes.is_empty() => {
                segment.write_all(bytes).map_err(|e| Error::io("write", &self.target, e))
            }
            _ => Ok(()),
        }
    }

    /// Sends the segment to the disk in the background and begins another.
    fn next_segment(&mut self, number: u64) -> Result<()> {
        self.syncs.extend(self.segment.take().map(|file| std::thread::spawn(move || file.sync_all())));
        let path = self.unfinished.join(segment_name(number));
        self.segment = Some(File::create(&path).map_err(|e| Error::io("create", &path, e))?);
        Ok(())
    }

    /// Writes directory and manifest, and gives the map its name. `directory_hash` and `split.directory` are filled in.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn finish(mut self, mut manifest: Manifest) -> Result<Manifest> {
        manifest.directory_hash = format!("{:016x}", xxh3_64(&self.directory));
        manifest.split.directory = self.directory.len() as u64;
        let json = serde_json::to_vec_pretty(&manifest).map_err(|e| Error::invalid(e.to_string()))?;
        self.publish(&json).map_err(|e| Error::io("write", &self.target, e))?;
        self.stays = true;
        Ok(manifest)
    }

    fn publish(&mut self, manifest: &[u8]) -> std::io::Result<()> {
        if let Some(segment) = self.segment.take() {
            segment.sync_all()?;
        }
        for sync in self.syncs.drain(..) {
            sync.join().expect("a syncing thread does not panic")?;
        }
        let write = |name: &str, bytes: &[u8]| {
            let mut file = File::create(self.unfinished.join(name))?;
            file.write_all(bytes)?;
            file.sync_all()
        };
        write("directory", &self.directory)?;
        write("manifest.json", manifest)?;
        std::fs::remove_file(self.unfinished.join("journal"))?;
        if self.target.exists() {
            std::fs::remove_dir_all(&self.target)?;
        }
        std::fs::rename(&self.unfinished, &self.target)
    }

    /// Leaves what is there for a build that continues, if there is anything.
    pub fn suspend(mut self) {
        self.stays = !self.directory.is_empty();
    }
}

impl Drop for MapWriter {
    fn drop(&mut self) {
        if !self.stays {
            // Nothing sensible can be done about a failure here
            _ = std::fs::remove_dir_all(&self.unfinished);
        }
    }
}

/// What is kept of a map whose build was interrupted.
struct Kept<N> {
    notes: Vec<N>,
    directory: Vec<u8>,
    offset: u64,
    journal_end: u64,
}

impl<N> Default for Kept<N> {
    fn default() -> Self {
        Self { notes: Vec::new(), directory: Vec::new(), offset: 0, journal_end: 0 }
    }
}

impl<N> Kept<N> {
    /// The longest beginning whose bricks have the hashes that the journal says, up to a note that can stay.
    fn find(
        unfinished: &Path,
        journal: &mut Journal,
        parse: &impl Fn(&[u8]) -> Option<(bool, N)>,
    ) -> Result<Self> {
        let (mut kept, mut pending) = (Self::default(), Vec::new());
        let (mut offset, mut directory, mut directory_bytes) = (0, Vec::new(), 0);
        for found in journal.entries()? {
            let Some((is_end, note)) = parse(&found.note) else { break };
            let mut hash = Xxh3::new();
            for &length in &found.lengths {
                let at = place_after(offset, u64::from(length));
                directory.extend_from_slice(&entry(at, length).to_le_bytes());
                offset = at + u64::from(length);
            }
            let first = directory.len() - 8 * found.lengths.len();
            if hash_bricks(unfinished, &directory[first..], &mut hash).is_err()
                || hash.digest() != found.checksum
            {
                break;
            }
            pending.push(note);
            if is_end {
                kept.notes.append(&mut pending);
                (kept.offset, kept.journal_end) = (offset, found.end);
                directory_bytes = directory.len();
            }
        }
        directory.truncate(directory_bytes);
        kept.directory = directory;
        Ok(kept)
    }
}

/// Adds the bytes of bricks that lie one after the other to a hash.
fn hash_bricks(folder: &Path, directory: &[u8], hash: &mut Xxh3) -> std::io::Result<()> {
    let mut segment: Option<(u64, File)> = None;
    let mut brick = [0; BYTES_MAX];
    for bytes in directory.as_chunks::<8>().0 {
        let (offset, length) = place(u64::from_le_bytes(*bytes));
        let number = offset / SEGMENT_BYTES;
        let file = match &mut segment {
            Some((open, file)) if *open == number => file,
            _ => {
                let file = File::open(folder.join(segment_name(number)))?;
                &mut segment.insert((number, file)).1
            }
        };
        let brick = brick.get_mut(..length as usize).ok_or(std::io::ErrorKind::InvalidData)?;
        file.read_exact_at(brick, offset % SEGMENT_BYTES)?;
        hash.update(brick);
    }
    Ok(())
}
