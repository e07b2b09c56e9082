//! The footer of a `.mgs` file: counts and bounds for inspectors, and the proof that the end is there.

use std::path::Path;

use glam::DVec3;
use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::{StreamCounts, read_le};
use crate::math::Bounds;
use crate::{Error, Result};

/// The first four bytes of a footer, where a block would have its own.
pub(super) const MAGIC: [u8; 4] = *b"MGSF";

/// Bytes of a footer.
pub(super) const BYTES: usize = 136;

/// What a whole file holds.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Footer {
    /// Grids, micropolygons, vertices and the box around them.
    pub counts: StreamCounts,
    /// Blocks.
    pub blocks: u64,
    /// Points, lines, triangles and quads.
    pub faces_by_arity: [u64; 4],
}

impl Footer {
    /// The footer's bytes at `offset` of a file whose header has the checksum `seed`.
    pub(super) fn encode(&self, offset: u64, seed: u64) -> [u8; BYTES] {
        let mut out = [0; BYTES];
        out[..4].copy_from_slice(&MAGIC);
        out[4..8].copy_from_slice(&(BYTES as u32).to_le_bytes());
        let counts = [self.counts.grids, self.counts.micropolygons, self.counts.vertices, self.blocks];
        let bounds = self.counts.bounds.min.to_array().into_iter().chain(self.counts.bounds.max.to_array());
        let words =
            counts.into_iter().chain(self.faces_by_arity).chain(bounds.map(f64::to_bits)).chain([offset]);
        for (slot, word) in out[8..].chunks_exact_mut(8).zip(words) {
            slot.copy_from_slice(&word.to_le_bytes());
        }
        let checksum = xxh3_64_with_seed(&out[..BYTES - 8], seed.wrapping_add(offset));
        out[BYTES - 8..].copy_from_slice(&checksum.to_le_bytes());
        out
    }

    /// Reads the footer that stands at `offset`.
    pub(super) fn decode(bytes: &[u8; BYTES], offset: u64, seed: u64, path: &Path) -> Result<Self> {
        if bytes[..4] != MAGIC || read_le!(u32, bytes, 4) as usize != BYTES {
            let end = offset + BYTES as u64;
            return Err(Error::corrupt(
                path,
                end,
                format!("no footer before the end of the file at byte {end}"),
            )
            .hint("the file is truncated, or something was appended to it"));
        }
        let checksum = xxh3_64_with_seed(&bytes[..BYTES - 8], seed.wrapping_add(offset));
        if checksum != read_le!(u64, bytes, BYTES - 8) || read_le!(u64, bytes, BYTES - 16) != offset {
            return Err(Error::corrupt(path, offset, "the footer's checksum does not match"));
        }
        let word = |index: usize| read_le!(u64, bytes, 8 + 8 * index);
        let corner =
            |index: usize| DVec3::from_array(std::array::from_fn(|i| f64::from_bits(word(index + i))));
        Ok(Self {
            counts: StreamCounts {
                grids: word(0),
                micropolygons: word(1),
                vertices: word(2),
                bounds: Bounds { min: corner(8), max: corner(11) },
            },
            blocks: word(3),
            faces_by_arity: std::array::from_fn(|i| word(4 + i)),
        })
    }
}
