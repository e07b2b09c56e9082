//! Batches: the points of a bake set in groups of up to 1 M rays, compact in space (paper, section 4.2).
//!
//! [`split`](split()) turns a microgrid stream into a [`BatchPlan`]: a median-split k-d tree, out of core, whose leaves
//! are the batches, ordered along a Hilbert curve through their centroids. A [`PointFilter`] says which vertices are
//! baked at all.

mod bitset;
mod filter;
mod hilbert;
mod plan;
mod scratch;
mod spill;
mod split;

pub use bitset::BitSet;
pub use filter::{GridMask, KeepAll, PointFilter};
pub use hilbert::HilbertCurve;
pub use plan::{BatchInfo, BatchPlan, PlanTable};
pub(crate) use scratch::{ScratchFile, sweep};
pub use split::{Progress, SplitOptions, split};

use glam::{DVec3, Vec3};

/// Rays of a batch at most; points of a batch are this over the rays per point (paper, section 4.2: "up to 1M rays").
pub const RAYS_PER_BATCH_MAX: u32 = 1 << 20;

/// One vertex of a bake set: where to bake.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Running number of the vertex in the bake set's stream.
    pub index: u64,
    /// Position in scene units. No component is a negative zero.
    pub position: DVec3,
    /// Unit normal; zero when the vertex has none.
    pub normal: Vec3,
}

impl Point {
    /// Bytes of a point on disk: index, position and normal, little endian, without gaps.
    pub const BYTES: usize = 44;

    /// The point as it stands on disk.
    pub fn to_bytes(&self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        bytes[..8].copy_from_slice(&self.index.to_le_bytes());
        for (bytes, x) in bytes[8..32].chunks_exact_mut(8).zip(self.position.to_array()) {
            bytes.copy_from_slice(&x.to_le_bytes());
        }
        for (bytes, x) in bytes[32..].chunks_exact_mut(4).zip(self.normal.to_array()) {
            bytes.copy_from_slice(&x.to_le_bytes());
        }
        bytes
    }

    /// The point that stands in `bytes`; its numbers may be anything.
    pub fn from_bytes(bytes: &[u8; Self::BYTES]) -> Self {
        let double = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"));
        let single = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
        Self {
            index: u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")),
            position: DVec3::new(double(8), double(16), double(24)),
            normal: Vec3::new(single(32), single(36), single(40)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a field at another place than `docs/formats.md` says, or one that is cut on the way.
    #[test]
    fn a_point_survives_its_bytes() {
        let point = Point {
            index: 0x0123_4567_89ab_cdef,
            position: DVec3::new(1.0 / 3.0, -2e300, 5e-324),
            normal: Vec3::new(0.1, -0.2, 0.3),
        };
        let bytes = point.to_bytes();
        assert_eq!(Point::from_bytes(&bytes), point);
        assert_eq!(bytes[0], 0xef);
        assert_eq!(bytes[8..16], (1.0f64 / 3.0).to_le_bytes());
        assert_eq!(bytes[40..44], 0.3f32.to_le_bytes());
    }
}
