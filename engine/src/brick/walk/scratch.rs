//! A walk's memory and what it counts.

use super::super::bundle::{Inside, RAYS_MAX};
use super::super::lanes::{Boxes, Corners, Planes, SLACK};
use super::super::node::WIDTH;
use super::Start;

/// Rays that wait for a brick: a range of [`Scratch::waiting_rays`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waiting {
    /// Where they go on.
    pub start: Start,
    /// First entry of the rays' numbers.
    pub first: u32,
    /// How many.
    pub count: u32,
}

/// What a walk counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Nodes visited.
    pub nodes: u64,
    /// Rays tested at nodes.
    pub node_rays: u64,
    /// Leaves visited.
    pub leaves: u64,
    /// Rays tested at leaves.
    pub leaf_rays: u64,
    /// Far fields met.
    pub far_hits: u64,
    /// Faces met.
    pub hits: u64,
    /// Faces tested again in double precision.
    pub retests: u64,
    /// Instances entered.
    pub instances: u64,
    /// Rays that entered them.
    pub instance_rays: u64,
}

impl std::ops::AddAssign for Counts {
    fn add_assign(&mut self, other: Self) {
        self.nodes += other.nodes;
        self.node_rays += other.node_rays;
        self.leaves += other.leaves;
        self.leaf_rays += other.leaf_rays;
        self.far_hits += other.far_hits;
        self.hits += other.hits;
        self.retests += other.retests;
        self.instances += other.instances;
        self.instance_rays += other.instance_rays;
    }
}

/// A walk's memory, reused over bundles.
#[derive(Debug)]
pub struct Scratch {
    pub(super) stack: Vec<Entry>,
    pub(super) lists: Vec<u16>,
    pub(super) current: Vec<u16>,
    pub(super) far: Vec<u16>,
    pub(super) masks: Vec<u8>,
    /// Rays that meet faces of the leaf being visited, and the faces.
    pub(super) met: Vec<(u16, u16)>,
    pub(super) boxes: Boxes,
    pub(super) corners: Corners,
    pub(super) planes: Planes,
    pub(super) inside: Inside,
    /// Rays that met a brick which is not in memory.
    pub waiting: Vec<Waiting>,
    /// Their numbers.
    pub waiting_rays: Vec<u16>,
    /// What was counted.
    pub counts: Counts,
}

/// A node, leaf or instance to visit, with its list of rays.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    /// Byte address of the node, or of the node that has the leaf or instance as a child.
    pub(super) address: usize,
    /// The leaf's place among the node's children; that of an instance and [`INSTANCE`]; [`NO_LEAF`] for the node itself;
    /// [`LEAVE`] where the instance that was entered last is left.
    pub(super) leaf: u16,
    /// Entries of the list.
    pub(super) count: u16,
    /// First entry of the list.
    pub(super) first: u32,
}

/// See [`Entry::leaf`].
pub(super) const NO_LEAF: u16 = u16::MAX;
/// See [`Entry::leaf`].
pub(super) const INSTANCE: u16 = 1 << 8;
/// See [`Entry::leaf`].
pub(super) const LEAVE: u16 = 1 << 9;

impl Scratch {
    /// Memory for bundles of [`RAYS_MAX`] rays.
    pub fn new() -> Self {
        Self {
            stack: Vec::with_capacity(256),
            lists: vec![0; 16 * RAYS_MAX],
            current: vec![0; RAYS_MAX + SLACK],
            far: vec![0; RAYS_MAX + SLACK],
            masks: vec![0; RAYS_MAX + 2 * SLACK],
            met: vec![(0, 0); RAYS_MAX + 1],
            boxes: Boxes {
                center: [[0.0; WIDTH]; 3],
                half: [[0.0; WIDTH]; 3],
                distance2: [0.0; WIDTH],
                diagonal2: [0.0; WIDTH],
            },
            corners: Corners::EMPTY,
            planes: Planes::EMPTY,
            inside: Inside::new(),
            waiting: Vec::new(),
            waiting_rays: Vec::new(),
            counts: Counts::default(),
        }
    }
}

impl Default for Scratch {
    fn default() -> Self {
        Self::new()
    }
}
