//! A brick map on disk: a folder of immutable objects.
//!
//! ```text
//! manifest.json    version, lattice, counts, build parameters; written last
//! directory        u64 per brick: offset / 64 in the upper 52 bits, length / 64 - 1 in the lower 12
//! segment.0000 …   bricks in order, 1 GiB at most each; a brick does not straddle two
//! ```
//!
//! Offsets count through all segments as if each had its full size. The folder appears under its name when it is
//! complete. Every brick has its own checksum, the directory's is in the manifest.

use std::fmt::Debug;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{I64Vec3, IVec3};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

use super::farfield::FarField;
use super::pack::ByteSplit;
use crate::brick::lattice::SHIFT_MAX;
use crate::brick::{ALIGNMENT, BYTES_MAX, Lattice, LatticeBox};
use crate::math::Bounds;
use crate::{Error, ErrorKind, Result};

/// The version of bricks and map. Others are refused.
pub const FORMAT_VERSION: u32 = 4;

/// Bytes of a segment at most.
pub(super) const SEGMENT_BYTES: u64 = 1 << 30;
const LENGTH_BITS: u32 = 12;
const _: () = assert!(BYTES_MAX / ALIGNMENT <= 1 << LENGTH_BITS);

/// Bricks of a map at most: their numbers have 32 bits and some are set aside.
pub(super) const BRICKS_MAX: u64 = 0xffff_0000;

/// What `manifest.json` says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`].
    pub version: u32,
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
    /// xxh3 of the directory, hexadecimal.
    pub directory_hash: String,
    /// Micropolygons in the map.
    pub micropolygons: u64,
    /// Microgrids that they came in.
    pub grids: u64,
    /// The far field.
    pub far_field: FarField,
    /// Copies of prototypes: micropolygons count as often as they stand.
    pub instances: u64,
    /// Prototypes.
    pub prototypes: u64,
    /// Where the bytes go.
    pub split: ByteSplit,
    /// Leaves, and nodes: with the counts above, how full they are.
    pub leaves: u64,
    /// Nodes.
    pub nodes: u64,
}

/// The name of a segment's file.
pub(super) fn segment_name(number: u64) -> String {
    format!("segment.{number:04}")
}

/// Where segments are read from that do not lie beside their map's manifest.
pub trait SegmentSource: Debug + Send + Sync {
    /// Fills `out` with the bytes of the segment called `name` from `offset` on.
    ///
    /// # Errors
    /// When they cannot be had.
    fn read(&self, name: &str, offset: u64, out: &mut [u8]) -> Result<()>;
}

/// An open brick map.
#[derive(Debug)]
pub struct BrickMap {
    path: PathBuf,
    manifest: Manifest,
    directory: Vec<u64>,
    segments: Segments,
}

#[derive(Debug)]
enum Segments {
    Files(Vec<File>),
    Elsewhere(Arc<dyn SegmentSource>),
}

impl BrickMap {
    /// Opens the map in a folder.
    ///
    /// # Errors
    /// When it is not there, of another version, or damaged.
    pub fn open(path: &Path) -> Result<Self> {
        let (mut map, bytes) = Self::open_directory(path, Segments::Files(Vec::new()))?;
        map.segments = Segments::Files(map.open_segments(bytes)?);
        Ok(map)
    }

    /// Opens the map whose manifest and directory are in a folder, and whose segments come from `source`.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_with(path: &Path, source: Arc<dyn SegmentSource>) -> Result<Self> {
        Ok(Self::open_directory(path, Segments::Elsewhere(source))?.0)
    }

    /// Reads and checks manifest and directory; the map and the bytes of all segments.
    fn open_directory(path: &Path, segments: Segments) -> Result<(Self, u64)> {
        let manifest = read_manifest(&path.join("manifest.json"))?;
        let directory_path = path.join("directory");
        let expected = 8 * u64::from(manifest.bricks);
        let found =
            std::fs::metadata(&directory_path).map_err(|e| Error::io("read", &directory_path, e))?.len();
        if found != expected || manifest.bricks == 0 {
            return Err(Error::corrupt(
                &directory_path,
                found.min(expected),
                format!("{found} bytes, {expected} expected"),
            )
            .hint("build the brick map again"));
        }
        let bytes = std::fs::read(&directory_path).map_err(|e| Error::io("read", &directory_path, e))?;
        if format!("{:016x}", xxh3_64(&bytes)) != manifest.directory_hash {
            return Err(Error::corrupt(&directory_path, 0, "checksum does not match")
                .hint("build the brick map again"));
        }
        let directory: Vec<u64> = bytes
            .chunks_exact(8)
            .map(|entry| u64::from_le_bytes(entry.try_into().expect("8 bytes")))
            .collect();
        let map = Self { path: path.to_path_buf(), manifest, directory, segments };
        let end = map.check_directory()?;
        Ok((map, end))
    }

    /// Checks that bricks lie in the segments in order; where the last one ends.
    fn check_directory(&self) -> Result<u64> {
        let mut end = 0;
        for (brick, &entry) in self.directory.iter().enumerate() {
            let (offset, length) = place(entry);
            let straddles = offset / SEGMENT_BYTES != (offset + length - 1) / SEGMENT_BYTES;
            if offset < end || straddles || offset / SEGMENT_BYTES > end / SEGMENT_BYTES + 1 {
                return Err(Error::corrupt(
                    self.path.join("directory"),
                    8 * brick as u64,
                    "impossible entry",
                ));
            }
            end = offset + length;
        }
        Ok(end)
    }

    /// Opens the segments' files, which end at `end`.
    fn open_segments(&self, end: u64) -> Result<Vec<File>> {
        let mut segments = Vec::new();
        for number in 0..end.div_ceil(SEGMENT_BYTES) {
            let path = self.path.join(segment_name(number));
            let file = File::open(&path).map_err(|e| Error::io("open", &path, e))?;
            let found = file.metadata().map_err(|e| Error::io("read", &path, e))?.len();
            let last =
                self.directory.partition_point(|&entry| place(entry).0 < (number + 1) * SEGMENT_BYTES) - 1;
            let (offset, length) = place(self.directory[last]);
            let expected = offset + length - number * SEGMENT_BYTES;
            if found != expected {
                return Err(Error::corrupt(
                    &path,
                    found.min(expected),
                    format!("{found} bytes, {expected} expected"),
                )
                .hint("build the brick map again"));
            }
            segments.push(file);
        }
        Ok(segments)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the manifest says.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
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
        place(self.directory[brick as usize]).1 as u32
    }

    /// Reads `count` bricks from `first` on into `out`, one after the other; their lengths add up to its length.
    ///
    /// # Errors
    /// When storage fails.
    pub fn read(&self, first: u32, count: u32, out: &mut [u8]) -> Result<()> {
        let mut at = 0;
        let mut brick = first as usize;
        let end = first as usize + count as usize;
        while brick < end {
            // One read for all that lie in one segment
            let (offset, _) = place(self.directory[brick]);
            let segment = offset / SEGMENT_BYTES;
            let mut bytes = 0;
            while brick < end && place(self.directory[brick]).0 / SEGMENT_BYTES == segment {
                bytes += place(self.directory[brick]).1 as usize;
                brick += 1;
            }
            let (out, offset) = (&mut out[at..at + bytes], offset % SEGMENT_BYTES);
            match &self.segments {
                Segments::Files(files) => files[segment as usize]
                    .read_exact_at(out, offset)
                    .map_err(|e| Error::io("read", self.path.join(segment_name(segment)), e))?,
                Segments::Elsewhere(source) => source.read(&segment_name(segment), offset, out)?,
            }
            at += bytes;
        }
        Ok(())
    }
}

/// Where a brick of `length` bytes goes after those that end at `offset`: bricks do not straddle segments.
pub(super) fn place_after(offset: u64, length: u64) -> u64 {
    if offset % SEGMENT_BYTES + length > SEGMENT_BYTES {
        offset.next_multiple_of(SEGMENT_BYTES)
    } else {
        offset
    }
}

/// The directory entry of a brick.
pub(super) fn entry(offset: u64, length: u32) -> u64 {
    ((offset / ALIGNMENT as u64) << LENGTH_BITS) | (length as usize / ALIGNMENT - 1) as u64
}

/// Offset and length in bytes of a directory entry.
pub(super) fn place(entry: u64) -> (u64, u64) {
    let length = (entry & ((1 << LENGTH_BITS) - 1)) + 1;
    ((entry >> LENGTH_BITS) * ALIGNMENT as u64, length * ALIGNMENT as u64)
}

/// Reads and checks a manifest.
fn read_manifest(path: &Path) -> Result<Manifest> {
    let found = std::fs::metadata(path).map_err(|e| Error::io("read", path, e))?.len();
    if found > 1 << 20 {
        return Err(Error::corrupt(path, 0, "a manifest of over a mebibyte"));
    }
    let bytes = std::fs::read(path).map_err(|e| Error::io("read", path, e))?;
    let text = |e: serde_json::Error| {
        Error::new(ErrorKind::Corrupt, format!("broken manifest: {e}")).at_text(
            path,
            e.line() as u64,
            e.column() as u64,
        )
    };
    let value: serde_json::Value = serde_json::from_slice(&bytes).map_err(text)?;
    let version = value.get("version").and_then(serde_json::Value::as_u64);
    if version != Some(u64::from(FORMAT_VERSION)) {
        let version = version.map_or("none".into(), |version| version.to_string());
        return Err(Error::unsupported(format!(
            "brick map of version {version}, version {FORMAT_VERSION} wanted"
        ))
        .at(path)
        .hint("build the brick map again"));
    }
    let manifest: Manifest = serde_json::from_value(value).map_err(text)?;
    let sane = (-60..=60).contains(&manifest.lattice_exponent)
        && manifest.lattice_origin.iter().all(|c| c.unsigned_abs() < 1 << 62)
        && manifest
            .low
            .iter()
            .zip(&manifest.high)
            .all(|(l, h)| l <= h && l.abs() <= 1 << 30 && h.abs() <= 1 << 30)
        && manifest.shifts.iter().all(|&shift| shift <= SHIFT_MAX)
        && manifest.bytes <= u64::from(manifest.bricks) * BYTES_MAX as u64;
    if !sane {
        return Err(
            Error::corrupt(path, 0, "impossible numbers in the manifest").hint("build the brick map again")
        );
    }
    Ok(manifest)
}
