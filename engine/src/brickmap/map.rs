//! Reading a brick map.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use glam::{I64Vec3, IVec3};
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::file::{
    BRICKS_MAX, DIRECTORY, DIRECTORY_HEADER_BYTES, DIRECTORY_MAGIC, FORMAT_VERSION, MANIFEST, Manifest,
    SEGMENT_BYTES, is_sealed, segment_name,
};
use crate::brick::lattice::SHIFT_MAX;
use crate::brick::{ALIGNMENT, BYTES_MAX, Lattice, LatticeBox};
use crate::math::Bounds;
use crate::{Error, ErrorKind, Result};

/// Bytes of a manifest at most: a million streams have room.
const MANIFEST_BYTES_MAX: u64 = 16 << 20;

/// Bricks from one known offset to the next.
const STRIDE: usize = 64;

/// An open brick map. In memory it takes about 2 bytes for every brick.
#[derive(Debug)]
pub struct BrickMap {
    path: PathBuf,
    manifest: Manifest,
    /// In units of [`ALIGNMENT`].
    lengths: Vec<u16>,
    /// Of every [`STRIDE`]th brick, counted as if every segment but the last were full.
    offsets: Vec<u64>,
    segments: Vec<File>,
}

impl BrickMap {
    /// Opens the map in a folder.
    ///
    /// # Errors
    /// When it is not there, of another version, or damaged.
    pub fn open(path: &Path) -> Result<Self> {
        let manifest = read_manifest(&path.join(MANIFEST))?;
        let lengths = read_directory(&path.join(DIRECTORY), &manifest)?;
        let mut map =
            Self { path: path.to_path_buf(), manifest, lengths, offsets: Vec::new(), segments: Vec::new() };
        map.place_bricks()?;
        for number in 0..map.manifest.segments.len() {
            let path = path.join(segment_name(number as u64));
            let file = File::open(&path).map_err(|e| Error::io("open", &path, e))?;
            let found = file.metadata().map_err(|e| Error::io("read", &path, e))?.len();
            let expected = map.manifest.segments[number].bytes;
            if found != expected {
                let message = format!("{found} bytes, {expected} expected");
                return Err(corrupt(&path, found.min(expected), message));
            }
            map.segments.push(file);
        }
        Ok(map)
    }

    /// Finds the bricks' offsets and checks that they are what the segments hold.
    fn place_bricks(&mut self) -> Result<()> {
        let mut ends = Vec::new();
        let mut offset = 0;
        for (brick, &length) in self.lengths.iter().enumerate() {
            let bytes = u64::from(length) * ALIGNMENT as u64;
            if bytes == 0 || bytes > BYTES_MAX as u64 {
                let at = DIRECTORY_HEADER_BYTES + 2 * brick;
                return Err(corrupt(&self.path.join(DIRECTORY), at as u64, "impossible length of a brick"));
            }
            let start = self.start(offset, bytes);
            if brick > 0 && start.is_multiple_of(self.manifest.segment_bytes) {
                ends.push(offset);
            }
            offset = start + bytes;
            if brick % STRIDE == 0 {
                self.offsets.push(start);
            }
        }
        ends.push(offset);
        let size = self.manifest.segment_bytes;
        let found = ends.iter().enumerate().map(|(number, end)| end - number as u64 * size);
        if !found.eq(self.manifest.segments.iter().map(|segment| segment.bytes)) {
            return Err(corrupt(&self.path.join(DIRECTORY), 0, "lengths do not add up to the segments"));
        }
        Ok(())
    }

    /// Where a brick of `bytes` starts when the one before ends at `end`: not across two segments.
    fn start(&self, end: u64, bytes: u64) -> u64 {
        let size = self.manifest.segment_bytes;
        if end.next_multiple_of(size) - end >= bytes || end.is_multiple_of(size) {
            end
        } else {
            end.next_multiple_of(size)
        }
    }

    /// The offset of a brick.
    fn offset(&self, brick: usize) -> u64 {
        let known = brick / STRIDE * STRIDE;
        let bytes = |brick: usize| u64::from(self.lengths[brick]) * ALIGNMENT as u64;
        let start = self.offsets[brick / STRIDE];
        (known..brick).fold(start, |at, brick| self.start(at + bytes(brick), bytes(brick + 1)))
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the manifest says.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Whether the map was built from the streams with the given [`super::hash_occluders`], by the rules of this version.
    pub fn matches(&self, stream_hash: u128, far_field: super::FarField) -> bool {
        self.manifest.stream_hash == format!("{stream_hash:032x}") && self.manifest.far_field == far_field
    }

    /// The lattice that all vertices lie on.
    pub fn lattice(&self) -> Lattice {
        Lattice {
            exponent: self.manifest.lattice_exponent,
            origin: I64Vec3::from_array(self.manifest.lattice_origin),
        }
    }

    /// The lattice shift of an occluder stream: its vertices are multiples of `2^shift` steps.
    pub fn shift(&self, stream: usize) -> u8 {
        self.manifest.shifts.get(stream).copied().unwrap_or(0)
    }

    /// Bricks.
    pub fn brick_count(&self) -> u32 {
        self.manifest.bricks
    }

    /// The root brick's number.
    pub fn root(&self) -> u32 {
        self.manifest.bricks - 1
    }

    /// The box of everything on the lattice.
    pub fn root_box(&self) -> LatticeBox {
        LatticeBox { min: IVec3::from_array(self.manifest.low), max: IVec3::from_array(self.manifest.high) }
    }

    /// The box of everything in scene units.
    pub fn bounds(&self) -> Bounds {
        let (lattice, all) = (self.lattice(), self.root_box());
        Bounds { min: lattice.position(all.min), max: lattice.position(all.max) }
    }

    /// Bytes of all bricks.
    pub fn bytes(&self) -> u64 {
        self.manifest.bytes
    }

    /// Bytes of a brick.
    pub fn brick_bytes(&self, brick: u32) -> u32 {
        u32::from(self.lengths[brick as usize]) * ALIGNMENT as u32
    }

    /// Reads `count` bricks from `first` on into `out`, one after the other; their lengths add up to its length.
    ///
    /// # Errors
    /// When storage fails.
    pub fn read(&self, first: u32, count: u32, mut out: &mut [u8]) -> Result<()> {
        let (mut brick, end) = (first as usize, first as usize + count as usize);
        while brick < end {
            // One read for all that lie in one segment
            let start = self.offset(brick);
            let segment_end = (start / self.manifest.segment_bytes + 1) * self.manifest.segment_bytes;
            let mut bytes = 0;
            while brick < end && start + bytes + u64::from(self.brick_bytes(brick as u32)) <= segment_end {
                bytes += u64::from(self.brick_bytes(brick as u32));
                brick += 1;
            }
            let part = out.split_off_mut(..bytes as usize).ok_or_else(|| {
                Error::invalid(format!("the memory for bricks {first} to {} is too small", end - 1))
            })?;
            self.read_at(start, part)?;
        }
        Ok(())
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<()> {
        let (segment, at) = (offset / self.manifest.segment_bytes, offset % self.manifest.segment_bytes);
        self.segments[segment as usize].read_exact_at(out, at).map_err(|error| {
            Error::io("read", self.path.join(segment_name(segment)), error)
                .at_byte(self.path.join(segment_name(segment)), at)
        })
    }

    /// Reads everything and compares it with the manifest's hashes.
    ///
    /// # Errors
    /// When a segment is damaged, or storage fails.
    pub fn verify(&self) -> Result<()> {
        let mut buffer = vec![0; 1 << 20];
        for (number, segment) in self.manifest.segments.iter().enumerate() {
            let mut hash = Xxh3::new();
            for at in (0..segment.bytes).step_by(buffer.len()) {
                let part = &mut buffer[..(segment.bytes - at).min(1 << 20) as usize];
                self.read_at(number as u64 * self.manifest.segment_bytes + at, part)?;
                hash.update(part);
            }
            if format!("{:016x}", hash.digest()) != segment.hash {
                return Err(corrupt(
                    &self.path.join(segment_name(number as u64)),
                    0,
                    "checksum does not match",
                ));
            }
        }
        Ok(())
    }
}

fn corrupt(path: &Path, offset: u64, message: impl Into<String>) -> Error {
    Error::corrupt(path, offset, message).hint("build the brick map again")
}

/// Reads and checks the lengths of all bricks.
fn read_directory(path: &Path, manifest: &Manifest) -> Result<Vec<u16>> {
    let expected = DIRECTORY_HEADER_BYTES as u64 + 2 * u64::from(manifest.bricks);
    let found = std::fs::metadata(path).map_err(|e| Error::io("read", path, e))?.len();
    if found != expected {
        return Err(corrupt(path, found.min(expected), format!("{found} bytes, {expected} expected")));
    }
    let bytes = std::fs::read(path).map_err(|e| Error::io("read", path, e))?;
    if format!("{:016x}", xxh3_64(&bytes)) != manifest.directory_hash || bytes[..4] != DIRECTORY_MAGIC {
        return Err(corrupt(path, 0, "checksum does not match"));
    }
    let lengths = bytes[DIRECTORY_HEADER_BYTES..].chunks_exact(2);
    Ok(lengths.map(|length| u16::from_le_bytes([length[0], length[1]])).collect())
}

/// Reads and checks a manifest.
fn read_manifest(path: &Path) -> Result<Manifest> {
    let found = std::fs::metadata(path).map_err(|e| Error::io("read", path, e))?.len();
    if found > MANIFEST_BYTES_MAX {
        return Err(corrupt(path, 0, format!("a manifest of {found} bytes")));
    }
    let bytes = std::fs::read(path).map_err(|e| Error::io("read", path, e))?;
    let text = |e: serde_json::Error| {
        let (line, column) = (e.line() as u64, e.column() as u64);
        let message = format!("broken manifest: {e}");
        Error::new(ErrorKind::Corrupt, message).at_text(path, line, column).hint("build the brick map again")
    };
    let value: serde_json::Value = serde_json::from_slice(&bytes).map_err(text)?;
    let version = value.get("version").and_then(serde_json::Value::as_u64);
    if version != Some(u64::from(FORMAT_VERSION)) {
        let version = version.map_or("none".into(), |version| version.to_string());
        let message = format!("brick map of version {version}, version {FORMAT_VERSION} wanted");
        return Err(Error::unsupported(message).at(path).hint("build the brick map again"));
    }
    if !is_sealed(&bytes) {
        return Err(corrupt(path, 0, "checksum does not match"));
    }
    let manifest: Manifest = serde_json::from_value(value).map_err(text)?;
    let is_sane = (-60..=60).contains(&manifest.lattice_exponent)
        && manifest.lattice_origin.iter().all(|c| c.unsigned_abs() < 1 << 62)
        && manifest.low.iter().zip(&manifest.high).all(|(low, high)| low <= high)
        && manifest.low.iter().chain(&manifest.high).all(|c| c.unsigned_abs() <= 1 << 30)
        && manifest.shifts.iter().all(|&shift| shift <= SHIFT_MAX)
        && (1..=BRICKS_MAX).contains(&u64::from(manifest.bricks))
        && (BYTES_MAX as u64..=SEGMENT_BYTES).contains(&manifest.segment_bytes)
        && manifest.segment_bytes.is_multiple_of(ALIGNMENT as u64)
        && manifest.segments.iter().all(|segment| segment.bytes <= manifest.segment_bytes);
    if !is_sane {
        return Err(corrupt(path, 0, "impossible numbers in the manifest"));
    }
    Ok(manifest)
}
