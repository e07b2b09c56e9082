//! The records that host and kernels share. A test compares every offset with the shaders'.

#![expect(missing_docs, reason = "the shaders say what the members mean")]

use bytemuck::{Pod, Zeroable};

/// A batch's numbers: `Batch` in `shaders/batch.wgsl`, which says what they mean.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct BatchRecord {
    pub open2: f32,
    pub reach: f32,
    pub reach2: f32,
    pub near: f32,
    pub step: f32,
    pub measure_hemisphere: f32,
    pub measure_cosine: f32,
    pub measure_sphere: f32,
    pub is_limited: u32,
    pub samples: u32,
    pub slices: u32,
    pub first: u32,
    pub points: u32,
    pub items: u32,
    pub capacity: u32,
    pub budget: u32,
    pub bands: u32,
    pub root: u32,
    pub zero: u32,
    pub unused: u32,
}

/// A point: `Point` in `shaders/batch.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct PointRecord {
    pub origin: [i32; 3],
    pub group: u32,
    pub normal: [f32; 3],
    pub hash: u32,
    pub cosine: f32,
    pub sine: f32,
    pub frame: f32,
    pub spread: u32,
}

/// Neighbouring points: `Group` in `shaders/batch.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct GroupRecord {
    pub reference: [i32; 3],
    pub unused_a: u32,
    pub lower: [f32; 3],
    pub unused_b: u32,
    pub upper: [f32; 3],
    pub unused_c: u32,
}

/// What is left of a ray: `Item` in `shaders/batch.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct ItemRecord {
    pub ray: u32,
    pub line: u32,
    pub order: u32,
}

/// The `order` of an item that waits for the brick `line`.
pub const WAITS_FOR_BRICK: u32 = u32::MAX;

/// Bytes of `Items` before its list.
pub const ITEMS_HEADER_BYTES: u64 = 16;

/// Words of `Results` before the coefficients: a bit for each of 65,536 points.
pub const COVERAGE_WORDS: usize = 2048;
