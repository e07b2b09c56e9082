//! Writing a brick map: a folder of immutable objects, byte by byte in `docs/formats-brickmap.md`.
//!
//! ```text
//! manifest.json    version, lattice, counts, hashes; written last
//! directory        "PDIR", version u32, bricks u32, 0 u32; then u16 per brick: its length / 64
//! segment.0000 …   bricks by number, 1 GiB at most each; a brick does not straddle two
//! ```
//!
//! Bricks lie back to back; one that does not fit into the rest of a segment starts the next. So lengths give offsets.
//! The folder appears under its name when it is complete.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::farfield::FarField;
use super::pack::{ByteSplit, TreeStats};
use crate::brick::ALIGNMENT;
use crate::{Error, ErrorKind, Result};

/// The version of bricks and map. Others are refused.
pub const FORMAT_VERSION: u32 = 2;

/// Bytes of a segment at most.
pub const SEGMENT_BYTES: u64 = 1 << 30;

/// Bytes before the directory's lengths.
pub const DIRECTORY_HEADER_BYTES: usize = 16;
/// How the directory starts.
pub const DIRECTORY_MAGIC: [u8; 4] = *b"PDIR";

/// The manifest's name.
pub const MANIFEST: &str = "manifest.json";
/// The directory's name.
pub const DIRECTORY: &str = "directory";

/// Bricks of a map at most: their numbers have 32 bits and some are set aside.
pub const BRICKS_MAX: u64 = 0xffff_0000;

/// What `manifest.json` says.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`].
    pub version: u32,
    /// xxh3 of this file with zeros in this place, hexadecimal.
    pub manifest_hash: String,
    /// xxh3 of the directory, hexadecimal.
    pub directory_hash: String,
    /// xxh3-128 of the occluder streams, hexadecimal: what [`super::hash_occluders`] returns.
    pub stream_hash: String,
    /// The lattice's step is `2^exponent` scene units.
    pub lattice_exponent: i32,
    /// The lattice's origin in steps.
    pub lattice_origin: [i64; 3],
    /// Lattice shift of each occluder stream.
    pub shifts: Vec<u8>,
    /// Lower corner of everything on the lattice.
    pub low: [i32; 3],
    /// Upper corner.
    pub high: [i32; 3],
    /// Bricks; the last one is the root.
    pub bricks: u32,
    /// Bytes of all bricks.
    pub bytes: u64,
    /// Bytes of a segment at most.
    pub segment_bytes: u64,
    /// The segments.
    pub segments: Vec<Segment>,
    /// Micropolygons in the map.
    pub micropolygons: u64,
    /// Microgrids that they came in.
    pub grids: u64,
    /// The far field.
    pub far_field: FarField,
    /// Where the bytes go.
    pub split: ByteSplit,
    /// The tree's counts and areas.
    pub tree: TreeStats,
}

/// One of a map's segments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Segment {
    /// Its bytes.
    pub bytes: u64,
    /// Their xxh3, hexadecimal.
    pub hash: String,
}

/// A segment that is being written.
struct OpenSegment {
    file: BufWriter<File>,
    bytes: u64,
    hash: Xxh3,
}

/// Writes a brick map.
pub struct MapWriter {
    target: PathBuf,
    temporary: PathBuf,
    segment_bytes: u64,
    segment: Option<OpenSegment>,
    segments: Vec<Segment>,
    /// In units of [`ALIGNMENT`].
    lengths: Vec<u16>,
    bytes: u64,
    done: bool,
}

impl MapWriter {
    /// Starts a map that will appear at `target`, with segments of at most `segment_bytes`.
    ///
    /// # Errors
    /// When the folder cannot be made, or `target` is something else than a brick map or an empty folder.
    pub fn create(target: &Path, segment_bytes: u64) -> Result<Self> {
        let Some(name) = target.file_name() else {
            return Err(Error::invalid("a brick map needs a folder with a name").at(target));
        };
        check_replaceable(target)?;
        let temporary = sibling(target, name, "tmp");
        if temporary.exists() {
            std::fs::remove_dir_all(&temporary).map_err(|e| Error::io("remove", &temporary, e))?;
        }
        std::fs::create_dir_all(&temporary).map_err(|e| Error::io("create the folder", &temporary, e))?;
        Ok(Self {
            target: target.to_path_buf(),
            temporary,
            segment_bytes,
            segment: None,
            segments: Vec::new(),
            lengths: Vec::new(),
            bytes: 0,
            done: false,
        })
    }

    /// Bricks written so far.
    pub fn bricks(&self) -> u32 {
        self.lengths.len() as u32
    }

    /// Writes bricks that lie one after the other in `bytes`.
    ///
    /// # Errors
    /// When the disk is full or fails, or there are too many bricks.
    pub fn write(&mut self, mut bytes: &[u8], lengths: &[u32]) -> Result<()> {
        if (self.lengths.len() + lengths.len()) as u64 > BRICKS_MAX {
            return Err(Error::new(ErrorKind::Limit, format!("more than {BRICKS_MAX} bricks")));
        }
        for &length in lengths {
            let (brick, rest) = bytes.split_at(length as usize);
            bytes = rest;
            if self.segment.as_ref().is_none_or(|s| s.bytes + u64::from(length) > self.segment_bytes) {
                self.next_segment()?;
            }
            let segment = self.segment.as_mut().expect("opened above");
            segment.file.write_all(brick).map_err(|e| io("write", &self.target, e))?;
            segment.hash.update(brick);
            segment.bytes += u64::from(length);
            self.bytes += u64::from(length);
            self.lengths.push((length as usize / ALIGNMENT) as u16);
        }
        Ok(())
    }

    fn next_segment(&mut self) -> Result<()> {
        self.finish_segment()?;
        let path = self.temporary.join(segment_name(self.segments.len() as u64));
        let file = File::create(&path).map_err(|e| io("create", &path, e))?;
        let file = BufWriter::with_capacity(1 << 20, file);
        self.segment = Some(OpenSegment { file, bytes: 0, hash: Xxh3::new() });
        Ok(())
    }

    fn finish_segment(&mut self) -> Result<()> {
        let Some(OpenSegment { file, bytes, hash }) = self.segment.take() else { return Ok(()) };
        let sync = || file.into_inner().map_err(std::io::IntoInnerError::into_error)?.sync_all();
        sync().map_err(|e| io("write", &self.target, e))?;
        self.segments.push(Segment { bytes, hash: format!("{:016x}", hash.digest()) });
        Ok(())
    }

    /// Writes directory and manifest, and gives the map its name. Bricks, bytes, segments, hashes and `split.directory`
    /// are filled in.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn finish(mut self, mut manifest: Manifest) -> Result<Manifest> {
        self.finish_segment()?;
        let mut directory = DIRECTORY_MAGIC.to_vec();
        for word in [FORMAT_VERSION, self.bricks(), 0] {
            directory.extend_from_slice(&word.to_le_bytes());
        }
        self.lengths.iter().for_each(|length| directory.extend_from_slice(&length.to_le_bytes()));
        manifest.bricks = self.bricks();
        manifest.bytes = self.bytes;
        manifest.segments = std::mem::take(&mut self.segments);
        manifest.directory_hash = format!("{:016x}", xxh3_64(&directory));
        manifest.split.directory = directory.len() as u64;
        let json = sealed(&mut manifest)?;
        let write = |name: &str, bytes: &[u8]| {
            let mut file = File::create(self.temporary.join(name))?;
            file.write_all(bytes)?;
            file.sync_all()
        };
        let publish = || {
            write(DIRECTORY, &directory)?;
            write(MANIFEST, &json)?;
            sync_folder(&self.temporary)?;
            // What is there makes way, and goes when the new map is in its place
            let old = sibling(&self.target, self.target.file_name().unwrap_or_default(), "old");
            let replaces = self.target.exists();
            if replaces {
                std::fs::rename(&self.target, &old)?;
            }
            std::fs::rename(&self.temporary, &self.target)?;
            if replaces {
                std::fs::remove_dir_all(&old)?;
            }
            sync_folder(self.target.parent().unwrap_or(Path::new(".")))
        };
        check_replaceable(&self.target)?;
        publish().map_err(|e| io("write", &self.target, e))?;
        self.done = true;
        Ok(manifest)
    }
}

impl Drop for MapWriter {
    fn drop(&mut self) {
        if !self.done {
            // Nothing sensible can be done about a failure here
            _ = std::fs::remove_dir_all(&self.temporary);
        }
    }
}

impl std::fmt::Debug for MapWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("MapWriter")
            .field("target", &self.target)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}

/// The name of a segment.
pub fn segment_name(number: u64) -> String {
    format!("segment.{number:04}")
}

/// A name beside `target` that no other process uses.
fn sibling(target: &Path, name: &std::ffi::OsStr, what: &str) -> PathBuf {
    target.with_file_name(format!(".{}.{}.{what}", name.to_string_lossy(), std::process::id()))
}

/// Nothing but a brick map or an empty folder may be replaced by a brick map.
fn check_replaceable(target: &Path) -> Result<()> {
    let entries = match std::fs::read_dir(target) {
        Ok(mut entries) => entries.next().is_some(),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(Error::io("replace", target, error)),
    };
    if entries && !target.join(MANIFEST).exists() {
        return Err(Error::invalid("the folder holds something else than a brick map")
            .at(target)
            .hint("give another folder, or empty this one"));
    }
    Ok(())
}

fn sync_folder(folder: &Path) -> std::io::Result<()> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    File::open(folder)?.sync_all()
}

fn io(what: &str, path: &Path, error: std::io::Error) -> Error {
    let full = error.kind() == std::io::ErrorKind::StorageFull;
    let error = Error::io(what, path, error);
    if full { error.hint("a brick map needs about 20 bytes for every micropolygon") } else { error }
}

const HASH_KEY: &str = "\"manifest_hash\": \"";

/// The manifest's text with its own hash in it.
fn sealed(manifest: &mut Manifest) -> Result<Vec<u8>> {
    manifest.manifest_hash = "0".repeat(16);
    let mut json = serde_json::to_vec_pretty(&manifest).map_err(|e| Error::invalid(e.to_string()))?;
    json.push(b'\n');
    let hash = format!("{:016x}", xxh3_64(&json));
    let at = hash_place(&json).expect("the key was written above");
    json[at..at + 16].copy_from_slice(hash.as_bytes());
    manifest.manifest_hash = hash;
    Ok(json)
}

/// Whether the text's hash is that of the text.
pub fn is_sealed(json: &[u8]) -> bool {
    let Some(at) = hash_place(json) else { return false };
    let mut zeroed = json.to_vec();
    zeroed[at..at + 16].fill(b'0');
    json[at..at + 16] == *format!("{:016x}", xxh3_64(&zeroed)).as_bytes()
}

fn hash_place(json: &[u8]) -> Option<usize> {
    let at = json.windows(HASH_KEY.len()).position(|window| window == HASH_KEY.as_bytes())? + HASH_KEY.len();
    (json.len() >= at + 16).then_some(at)
}
