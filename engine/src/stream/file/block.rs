//! The layout of a block: its 64-byte header, its maxima and the sizes that follow from a schema.

use std::path::Path;

use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::read_le;
use crate::stream::microgrid::{FACES_MAX, VERTICES_MAX};
use crate::stream::{Rate, Schema};
use crate::{Error, ErrorKind, Result};

/// The first four bytes of a block.
pub(super) const MAGIC: [u8; 4] = *b"MGSB";

/// Bytes of a block's header.
pub(super) const HEADER_BYTES: usize = 64;

/// A writer closes a block that has reached this many bytes of payload.
pub(super) const PAYLOAD_BYTES_TARGET: usize = 1 << 20;

/// Bytes of an uncompressed payload at most: what a reader has to be ready to allocate.
pub(super) const PAYLOAD_BYTES_MAX: usize = 8 << 20;

/// Bytes that the largest grid of a schema may need. With a target of 1 MiB no block can pass the maximum.
pub(super) const GRID_BYTES_MAX: usize = PAYLOAD_BYTES_MAX - PAYLOAD_BYTES_TARGET;

/// Grids of a block at most.
pub(super) const GRIDS_MAX: usize = 1 << 15;

/// Bytes of a grid in the summary: anchor (24), middle vertex (12), vertex count (1), face count (2).
pub(super) const SUMMARY_BYTES: usize = 39;

/// Where the columns of a summary of `grids` grids begin: anchors at 0, then these.
pub(super) const fn summary_columns(grids: usize) -> [usize; 3] {
    [24 * grids, 36 * grids, 37 * grids]
}

/// Bytes that a schema's attributes take per vertex and per grid.
#[derive(Clone, Copy, Debug)]
pub(super) struct ValueBytes {
    pub per_vertex: usize,
    pub per_grid: usize,
}

impl ValueBytes {
    /// Adds a schema up and refuses one whose largest grid would not fit a block.
    pub fn of(schema: &Schema) -> Result<Self> {
        let sum = |rate| {
            let attributes = schema.attributes.iter().filter(|attribute| attribute.rate == rate);
            attributes.map(|attribute| attribute.value_bytes()).sum()
        };
        let value_bytes = Self { per_vertex: sum(Rate::Vertex), per_grid: sum(Rate::Grid) };
        let largest = value_bytes.payload(1, VERTICES_MAX as u64, FACES_MAX as u64, 4 * FACES_MAX as u64);
        if largest > GRID_BYTES_MAX as u64 {
            return Err(Error::new(
                ErrorKind::Limit,
                format!("a grid with these attributes may need {largest} bytes, at most {GRID_BYTES_MAX} are possible"),
            )
            .hint("use fewer components or smaller types"));
        }
        Ok(value_bytes)
    }

    /// Bytes of an uncompressed payload. With the maxima of a block's counts the sum stays below 2^50.
    pub fn payload(self, grids: u64, vertices: u64, faces: u64, corners: u64) -> u64 {
        faces + corners + vertices * (12 + self.per_vertex as u64) + grids * self.per_grid as u64
    }
}

/// The header of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct BlockHeader {
    pub grids: u32,
    pub vertices: u32,
    pub faces: u32,
    pub corners: u32,
    /// Uncompressed and stored bytes of the summary frame. Equal: stored as it is.
    pub summary_bytes: [u32; 2],
    /// Uncompressed and stored bytes of the payload frame. Equal: stored as it is.
    pub payload_bytes: [u32; 2],
    pub summary_checksum: u64,
    pub payload_checksum: u64,
}

impl BlockHeader {
    /// The header's bytes at `offset` of a file whose header has the checksum `seed`.
    pub fn encode(&self, offset: u64, seed: u64) -> [u8; HEADER_BYTES] {
        let mut out = [0; HEADER_BYTES];
        out[..4].copy_from_slice(&MAGIC);
        let counts = [self.grids, self.vertices, self.faces, self.corners];
        let words = counts.into_iter().chain(self.summary_bytes).chain(self.payload_bytes);
        for (slot, word) in out[4..].chunks_exact_mut(4).zip(words) {
            slot.copy_from_slice(&word.to_le_bytes());
        }
        // Bytes 36 to 40 are reserved and zero.
        out[40..48].copy_from_slice(&self.summary_checksum.to_le_bytes());
        out[48..56].copy_from_slice(&self.payload_checksum.to_le_bytes());
        let checksum = xxh3_64_with_seed(&out[..56], seed.wrapping_add(offset));
        out[56..].copy_from_slice(&checksum.to_le_bytes());
        out
    }

    /// Reads the header at `offset` and checks it against every maximum and against the bytes left in the file.
    pub fn decode(
        bytes: &[u8; HEADER_BYTES],
        offset: u64,
        seed: u64,
        value_bytes: ValueBytes,
        left: u64,
        path: &Path,
    ) -> Result<Self> {
        let word = |at: usize| read_le!(u32, bytes, at);
        let header = Self {
            grids: word(4),
            vertices: word(8),
            faces: word(12),
            corners: word(16),
            summary_bytes: [word(20), word(24)],
            payload_bytes: [word(28), word(32)],
            summary_checksum: read_le!(u64, bytes, 40),
            payload_checksum: read_le!(u64, bytes, 48),
        };
        let checksum = xxh3_64_with_seed(&bytes[..56], seed.wrapping_add(offset));
        if bytes[..4] != MAGIC || word(36) != 0 || checksum != read_le!(u64, bytes, 56) {
            return Err(Error::corrupt(path, offset, "the checksum of a block's header does not match"));
        }
        match header.implausible(value_bytes, left) {
            Some((at, what)) => Err(Error::corrupt(path, offset + at, what)),
            None => Ok(header),
        }
    }

    /// What is impossible in the header, and at which of its bytes.
    fn implausible(&self, value_bytes: ValueBytes, left: u64) -> Option<(u64, String)> {
        let [grids, vertices, faces, corners] =
            [self.grids, self.vertices, self.faces, self.corners].map(u64::from);
        let ranges = [
            (4, "grids", grids, 1, GRIDS_MAX as u64),
            (8, "vertices", vertices, grids, grids * VERTICES_MAX as u64),
            (12, "faces", faces, 0, grids * FACES_MAX as u64),
            (16, "face indices", corners, faces, 4 * faces),
        ];
        for (at, what, found, min, max) in ranges {
            if !(min..=max).contains(&found) {
                return Some((at, format!("a block of {found} {what}, {min} to {max} are possible")));
            }
        }
        let payload = value_bytes.payload(grids, vertices, faces, corners);
        if payload > PAYLOAD_BYTES_MAX as u64 {
            return Some((
                28,
                format!("a payload of {payload} bytes, at most {PAYLOAD_BYTES_MAX} are possible"),
            ));
        }
        let frames =
            [(20, self.summary_bytes, grids * SUMMARY_BYTES as u64), (28, self.payload_bytes, payload)];
        for (at, [bytes, stored], expected) in frames {
            if u64::from(bytes) != expected {
                return Some((at, format!("a frame of {bytes} bytes, {expected} follow from the counts")));
            }
            if stored > bytes || (stored == 0 && bytes != 0) {
                return Some((at + 4, format!("{stored} stored bytes for a frame of {bytes}")));
            }
        }
        let stored = self.stored_bytes();
        (stored > left).then(|| (24, format!("a block of {stored} bytes, the file has {left} left")))
    }

    /// Bytes of the two frames together.
    pub fn stored_bytes(&self) -> u64 {
        u64::from(self.summary_bytes[1]) + u64::from(self.payload_bytes[1])
    }
}
