//! The five inner loops of a walk, one implementation per instruction set, all with the same bits.
//!
//! [`plain`] is the truth: loops over arrays. The others do the same operations in the same order on vectors; fused
//! multiply-adds are fused everywhere, products that must not be fused never are.

use glam::IVec3;

use super::bundle::{BoxOrigins, BoxRay};
use super::leaf::Layout;
use super::node::{Node, WIDTH};

#[cfg(target_arch = "x86_64")]
pub mod avx512;
pub mod plain;

/// Entries that a lane writes past the end of its output at most.
pub const SLACK: usize = 32;

/// Relative error of box arithmetic: a few roundings of 2^-24.
pub const BOX_ERROR: f32 = 1.0 / (1 << 21) as f32;

/// The boxes of a node's children relative to a bundle's reference, in lattice steps.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Boxes {
    /// Centres, per axis.
    pub center: [[f32; WIDTH]; 3],
    /// Half extents, per axis, padded against rounding.
    pub half: [[f32; WIDTH]; 3],
    /// Squared distance from the bundle's origins.
    pub distance2: [f32; WIDTH],
    /// Squared diagonal.
    pub diagonal2: [f32; WIDTH],
}

/// What a bundle makes of a node's children, one bit each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Look {
    /// So small and far that their far field stands in for them.
    pub closed: u8,
    /// Out of the rays' reach, or not there.
    pub beyond: u8,
    /// Leaves.
    pub leaves: u8,
    /// Neither leaves nor nodes of the same brick.
    pub elsewhere: u8,
}

/// Corners of a leaf's triangles relative to a bundle's reference, in lattice steps: lanes 0 to 7 have the first triangles of
/// quads 0 to 7, lanes 8 to 15 the second ones; or each lane has a triangle of its own.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Corners {
    /// Coordinates: corner, axis, lane.
    pub coordinates: [[[i32; 16]; 3]; 3],
    /// Lanes that hold a triangle.
    pub present: u16,
    /// Whether lanes 0 to 7 and 8 to 15 are the two triangles of quads.
    pub quads: bool,
}

impl Corners {
    /// No triangles.
    pub const EMPTY: Self = Self { coordinates: [[[0; 16]; 3]; 3], present: 0, quads: true };
}

/// Triangles of a leaf, seen from one origin, in the same lanes.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Planes {
    /// Normals of the planes through the origin and an edge: edge, axis, lane. Signs are such that a direction with
    /// three products of zero or more meets the triangle.
    pub normals: [[[f32; 16]; 3]; 3],
    /// Six times the volume of origin and triangle, positive.
    pub volume: [f32; 16],
    /// Lanes that hold a triangle which may be met.
    pub valid: u16,
}

impl Planes {
    /// No triangles.
    pub const EMPTY: Self = Self { normals: [[[0.0; 16]; 3]; 3], volume: [0.0; 16], valid: 0 };
}

/// The inner loops. All methods are inlined into a caller that has the instruction set enabled.
///
/// # Safety
/// The methods of an implementation may only be called where its instruction set is available. Ray numbers in `ids`
/// must be below the lengths of the slices they index.
pub trait Lanes {
    /// Writes those of `ids` that are alive to `out`, in order, and returns how many. `out` is at least
    /// `ids.len() + SLACK` long.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn filter(alive: &[u32], ids: &[u16], out: &mut [u16]) -> usize;

    /// Decodes a node's boxes relative to `reference`; `origins` is the box of the origins, likewise.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn boxes(node: &Node, reference: IVec3, origins: &[glam::Vec3; 2], out: &mut Boxes);

    /// Looks at a node's decoded children: those whose squared diagonal is below `open2` times their squared distance are
    /// closed, those of a squared distance above `reach2` beyond.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn look(node: &Node, boxes: &Boxes, open2: f32, reach2: f32) -> Look;

    /// Writes the children in `open` to `out`, far ones first; further entries are of no meaning. Distances that differ in
    /// the last three bits only count as equal, and then the later child comes first.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn order(distance2: &[f32; WIDTH], open: u8, out: &mut [u8; 2 * WIDTH]);

    /// Writes to `masks`, for each of `ids`, the boxes that its ray meets, one bit a box, and returns the boxes that any
    /// meets. `masks` is at least `ids.len() + SLACK` long.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn meet_boxes(
        boxes: &Boxes,
        rays: &[BoxRay],
        origins: &BoxOrigins,
        ids: &[u16],
        masks: &mut [u8],
    ) -> u8;

    /// Writes those of `ids` whose mask has bit `slot` to `out`, in order, and returns how many. `out` is at least
    /// `ids.len() + SLACK` long, `masks` too.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn select(ids: &[u16], masks: &[u8], slot: usize, out: &mut [u16]) -> usize;

    /// Decodes the triangles of a flat leaf.
    ///
    /// # Safety
    /// See the trait. `leaf` was checked and runs on past its end by
    /// [`READ_PAST_BYTES`](super::leaf::READ_PAST_BYTES).
    unsafe fn corners(leaf: &[u8], layout: &Layout, reference: IVec3, out: &mut Corners);

    /// Turns triangles into planes as seen from an origin, which lies at `offset` from the reference. Faces with a corner at
    /// the origin are left out; only if `is_near` may there be any.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn planes(corners: &Corners, offset: IVec3, is_near: bool, out: &mut Planes);

    /// The triangles that a ray meets, one bit a lane.
    ///
    /// # Safety
    /// See the trait.
    unsafe fn meet_planes(planes: &Planes, direction: &[f32; 4]) -> u16;
}

/// Of the triangles in `hits`, those that a ray meets within `reach` steps. Rare, so plain for all; in the operations that
/// decide whether it meets them at all.
pub fn within(planes: &Planes, direction: &[f32; 4], hits: u16, reach: f32) -> u16 {
    let mut near = 0;
    for lane in (0..16).filter(|lane| hits >> lane & 1 != 0) {
        let edge = |e: usize| {
            let [x, y, z] = planes.normals[e].each_ref().map(|axis| axis[lane]);
            direction[2].mul_add(z, direction[1].mul_add(y, direction[0] * x))
        };
        let sum = edge(0) + edge(1) + edge(2);
        near |= u16::from(planes.volume[lane] <= reach * sum) << lane;
    }
    near
}

/// An instruction set that the walk has inner loops for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum InstructionSet {
    /// Whatever the target has at compile time.
    Plain,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 F, BW, DQ, VL, VBMI and VBMI2.
    Avx512,
}

impl InstructionSet {
    /// The best that this machine has.
    pub fn detect() -> Self {
        Self::available().into_iter().max().unwrap_or(Self::Plain)
    }

    /// All that this machine has.
    pub fn available() -> Vec<Self> {
        #[allow(unused_mut, reason = "other targets have the plain loops only")]
        let mut sets = vec![Self::Plain];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                sets.push(Self::Avx2);
            }
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512vbmi")
                && is_x86_feature_detected!("avx512vbmi2")
                && is_x86_feature_detected!("fma")
            {
                sets.push(Self::Avx512);
            }
        }
        sets
    }

    /// Its name, as `devices` prints it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }
}
