//! Any hit over bricks for a bundle of rays with shared origins.
//!
//! All rays of a bundle go down the tree together: a node is decoded once for all of them, then each ray is tested
//! against its eight boxes, and the rays that meet a child go on as a list of ray numbers. One order of children, near
//! first, holds for all rays because they start at the same place. A hit adds extinction to a ray; extinctions are
//! integers, so the order of hits does not matter, and a ray that passes its limit drops out of every list. [`instances`] has
//! what is different where one tree stands in several places.
mod far;
#[cfg(test)]
mod instance_tests;
mod instances;
mod leaf;
mod nodes;
mod scratch;
#[cfg(test)]
pub(super) mod tests;

pub use instances::{Entrance, Start};
pub use scratch::{Counts, Scratch, Waiting};

use super::bundle::Bundle;
use super::lanes::{InstructionSet, plain::Plain};
use nodes::Walk;

/// Where a brick is, for the current batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Location {
    /// In memory, at a multiple of [`ALIGNMENT`](super::ALIGNMENT) bytes.
    Resident(u32),
    /// Not in the batch's cut: its far field stands in for it.
    FarField,
    /// In the cut, but not in memory now: the rays wait for it.
    Missing,
}

/// The bricks that a walk may visit.
pub trait Bricks {
    /// The memory that holds the resident bricks, all checked, with [`READ_PAST_BYTES`](super::leaf::READ_PAST_BYTES) to spare at the end.
    fn memory(&self) -> &[u8];
    /// Where a brick is.
    fn locate(&self, brick: u32) -> Location;
}

/// Traces the rays numbered `rays` of a bundle through the brick at `start` and all below it.
///
/// A child whose squared diagonal is less than `open2` times its squared distance from the origins is not opened: its
/// far field stands in for it. With 0 every child of a resident brick is opened.
pub fn walk(
    bricks: &impl Bricks,
    start: &Start,
    rays: &[u16],
    open2: f32,
    bundle: &mut Bundle,
    scratch: &mut Scratch,
    instructions: InstructionSet,
) {
    match instructions {
        // SAFETY: the plain loops need no instruction set
        InstructionSet::Plain => unsafe {
            Walk::<Plain, _>::run(bricks, start, rays, open2, bundle, scratch)
        },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: InstructionSet::detect and ::available are the only sources of these values outside tests
        InstructionSet::Avx2 => unsafe { walk_avx2(bricks, start, rays, open2, bundle, scratch) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above
        InstructionSet::Avx512 => unsafe { walk_avx512(bricks, start, rays, open2, bundle, scratch) },
        #[cfg(not(target_arch = "x86_64"))]
        // SAFETY: the plain loops need no instruction set
        _ => unsafe { Walk::<Plain, _>::run(bricks, start, rays, open2, bundle, scratch) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt")]
unsafe fn walk_avx2(
    bricks: &impl Bricks,
    start: &Start,
    rays: &[u16],
    open2: f32,
    bundle: &mut Bundle,
    scratch: &mut Scratch,
) {
    // SAFETY: the caller vouches for the instruction set
    unsafe { Walk::<Plain, _>::run(bricks, start, rays, open2, bundle, scratch) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(
    enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx512vbmi2,avx2,fma,bmi1,bmi2,popcnt"
)]
unsafe fn walk_avx512(
    bricks: &impl Bricks,
    start: &Start,
    rays: &[u16],
    open2: f32,
    bundle: &mut Bundle,
    scratch: &mut Scratch,
) {
    // SAFETY: the caller vouches for the instruction set
    unsafe { Walk::<super::lanes::avx512::Avx512, _>::run(bricks, start, rays, open2, bundle, scratch) }
}
