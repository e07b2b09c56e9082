//! The `.mgs` file, the microgrid stream at rest: blocks of about 1 MiB, columns inside, lz4, a checksum for every byte.
//!
//! ```text
//! header │ block │ block │ … │ footer
//!          64 bytes of counts, lengths and checksums │ summary frame │ payload frame
//! ```
//!
//! A reader needs one forward pass and constant memory; the footer serves inspectors and proves that the end is
//! there. `docs/formats.md` describes every byte.

mod atomic;
mod block;
mod footer;
mod header;
mod reader;
mod writer;

pub use atomic::AtomicFile;
pub use footer::Footer;
pub use header::{HEADER_BYTES_MAX, METADATA_MAX, VERSION};
pub use reader::{GridSummary, MgsReader};
pub use writer::MgsWriter;

use super::Microgrid;
use crate::math::Bounds;

/// What a stream holds, counted.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct StreamCounts {
    /// Microgrids.
    pub grids: u64,
    /// Faces: points, lines, triangles and quads.
    pub micropolygons: u64,
    /// Vertices, counted once per grid.
    pub vertices: u64,
    /// The box of all vertices in scene units; empty when there are none.
    pub bounds: Bounds,
}

impl StreamCounts {
    /// Counts one more grid.
    pub fn add(&mut self, grid: &Microgrid) {
        self.grids += 1;
        self.micropolygons += grid.face_count() as u64;
        self.vertices += grid.vertex_count() as u64;
        self.bounds = self.bounds.union(&grid.bounds());
    }
}

/// The little-endian integer or float at `at`; the caller has checked the length.
macro_rules! read_le {
    ($type:ty, $bytes:expr, $at:expr) => {
        <$type>::from_le_bytes(
            $bytes[$at..$at + size_of::<$type>()].try_into().expect("a slice of the type's size"),
        )
    };
}
use read_le;

#[cfg(test)]
mod tests;
