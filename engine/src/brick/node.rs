//! The node: eight children with quantised boxes and far field, two cache lines.
//!
//! ```text
//! byte   0  origin      3 x i32   lattice coordinates of the lower corner
//!       12  exponent    3 x u8    a box unit is 2^exponent lattice steps, per axis
//!       15  count       u8        children, 0 to 8
//!       16  children    8 x u16   kind in the top 2 bits, location in the lower 14: 4-byte units from
//!                                 the node's start
//!       32  lower       3 x 8 u8  lower faces of the children's boxes, x of all, y of all, z of all
//!       56  upper       3 x 8 u8  upper faces
//!       80  far         8 x 6 u8  far field of each child
//! ```
//!
//! After Ylitie et al. 2017 (compressed wide BVH). The second line's far field is touched only where a child is not
//! opened.

use bytemuck::{Pod, Zeroable};
use glam::IVec3;

/// Children of a node.
pub const WIDTH: usize = 8;

/// Bytes of a child's far field.
pub const FAR_BYTES: usize = 6;

/// What a child is, and where: in units of [`LOCATION_BYTES`] from the start of the node that refers to it, so that a walk needs
/// nothing of a brick but the node it stands at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Child {
    /// A node of the same brick.
    Node(u16),
    /// A leaf of the same brick.
    Leaf(u16),
    /// Another brick: where its number stands in this brick's table.
    Brick(u16),
    /// A prototype's tree under a map: where the [record](super::instance) lies in this brick.
    Instance(u16),
}

const KIND_NODE: u16 = 0;
const KIND_LEAF: u16 = 1;
const KIND_BRICK: u16 = 2;
const KIND_INSTANCE: u16 = 3;
/// Bits of a child's location.
pub const LOCATION_BITS: u32 = 14;
/// Bytes of a unit of location.
pub const LOCATION_BYTES: usize = 4;

impl Child {
    /// The 16 bits stored in a node.
    pub fn encode(self) -> u16 {
        let (kind, location) = match self {
            Self::Node(location) => (KIND_NODE, location),
            Self::Leaf(location) => (KIND_LEAF, location),
            Self::Brick(location) => (KIND_BRICK, location),
            Self::Instance(location) => (KIND_INSTANCE, location),
        };
        debug_assert!(location < 1 << LOCATION_BITS);
        kind << LOCATION_BITS | location
    }

    /// What the 16 bits say.
    #[inline(always)]
    pub fn decode(bits: u16) -> Self {
        let location = bits & ((1 << LOCATION_BITS) - 1);
        match bits >> LOCATION_BITS {
            KIND_NODE => Self::Node(location),
            KIND_LEAF => Self::Leaf(location),
            KIND_BRICK => Self::Brick(location),
            _ => Self::Instance(location),
        }
    }
}

/// An 8-wide node with quantised boxes.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Node {
    /// Lattice coordinates of the lower corner.
    pub origin: [i32; 3],
    /// A box unit is `2^exponent` lattice steps.
    pub exponent: [u8; 3],
    /// Children in use; they come first.
    pub count: u8,
    /// [`Child`] of each.
    pub children: [u16; WIDTH],
    /// Lower faces of the boxes, per axis.
    pub lower: [[u8; WIDTH]; 3],
    /// Upper faces of the boxes, per axis.
    pub upper: [[u8; WIDTH]; 3],
    /// Far field of each child: what stands in for it when it is not opened.
    pub far: [[u8; FAR_BYTES]; WIDTH],
}

const _: () = assert!(size_of::<Node>() == 128);

/// A box on the lattice, both corners inside.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct LatticeBox {
    /// Lower corner.
    pub min: IVec3,
    /// Upper corner.
    pub max: IVec3,
}

impl LatticeBox {
    /// The box that holds nothing.
    pub const EMPTY: Self = Self { min: IVec3::MAX, max: IVec3::MIN };

    /// The smallest box that holds both.
    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Grows to hold `point`.
    pub fn add(&mut self, point: IVec3) {
        self.min = self.min.min(point);
        self.max = self.max.max(point);
    }

    /// Whether they have a point in common.
    pub fn touches(&self, other: &Self) -> bool {
        self.min.cmple(other.max).all() && self.max.cmpge(other.min).all()
    }

    /// Whether it holds nothing.
    pub fn is_empty(&self) -> bool {
        !self.min.cmple(self.max).all()
    }
}

impl Node {
    /// A node over `boxes` (1 to 8, none empty) with quantised boxes that contain them. Children and far field are
    /// left zero.
    pub fn over(boxes: &[LatticeBox]) -> Self {
        debug_assert!((1..=WIDTH).contains(&boxes.len()));
        let all = boxes.iter().fold(LatticeBox::EMPTY, |all, &b| all.union(b));
        let mut node = Self::zeroed();
        node.origin = all.min.to_array();
        node.count = boxes.len() as u8;
        for axis in 0..3 {
            let extent = (all.max[axis] - all.min[axis]) as u32;
            let mut exponent = 0;
            while extent.div_ceil(1 << exponent) > 255 {
                exponent += 1;
            }
            node.exponent[axis] = exponent;
            for (slot, b) in boxes.iter().enumerate() {
                node.lower[axis][slot] = ((b.min[axis] - all.min[axis]) >> exponent) as u8;
                node.upper[axis][slot] = ((b.max[axis] - all.min[axis]) as u32).div_ceil(1 << exponent) as u8;
            }
        }
        node
    }

    /// The decoded box of a child: every number that belongs to a child (far field above all) belongs to this box.
    #[inline(always)]
    pub fn child_box(&self, slot: usize) -> LatticeBox {
        let (mut min, mut max) = (IVec3::from_array(self.origin), IVec3::from_array(self.origin));
        for axis in 0..3 {
            let exponent = self.exponent[axis];
            min[axis] = min[axis].wrapping_add(i32::from(self.lower[axis][slot]) << exponent);
            max[axis] = max[axis].wrapping_add(i32::from(self.upper[axis][slot]) << exponent);
        }
        LatticeBox { min, max }
    }

    /// Half the extents of [`child_box`](Self::child_box).
    #[inline(always)]
    pub fn child_half(&self, slot: usize) -> glam::Vec3 {
        let mut half = glam::Vec3::ZERO;
        for axis in 0..3 {
            let scale = f32::from_bits((u32::from(self.exponent[axis]) + 127) << 23);
            half[axis] =
                (f32::from(self.upper[axis][slot]) - f32::from(self.lower[axis][slot])) * (0.5 * scale);
        }
        half
    }

    /// The lower corner of [`child_box`](Self::child_box).
    #[inline(always)]
    pub fn lower_corner(&self, slot: usize) -> IVec3 {
        let mut corner = IVec3::from_array(self.origin);
        for axis in 0..3 {
            corner[axis] =
                corner[axis].wrapping_add(i32::from(self.lower[axis][slot]) << self.exponent[axis]);
        }
        corner
    }

    /// What the child is; none beyond those in use.
    #[inline(always)]
    pub fn child(&self, slot: usize) -> Option<Child> {
        (slot < usize::from(self.count)).then(|| Child::decode(self.children[slot]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a quantised box that does not contain what it stands for, by far the worst error a tree can have.
    #[test]
    fn decoded_boxes_contain_the_boxes() {
        let mut seed = 1;
        let mut next = |range: i32| {
            seed = crate::math::hash::hash32(seed);
            (seed % range as u32) as i32
        };
        for scale in [1, 7, 300, 40_000, 100_000_000] {
            let boxes: Vec<LatticeBox> = (0..8)
                .map(|_| {
                    let min = IVec3::new(next(scale), next(scale), next(scale)) - scale / 2;
                    LatticeBox { min, max: min + IVec3::new(next(scale), next(scale), 0) }
                })
                .collect();
            let node = Node::over(&boxes);
            for (slot, b) in boxes.iter().enumerate() {
                let decoded = node.child_box(slot);
                assert!(
                    decoded.min.cmple(b.min).all() && decoded.max.cmpge(b.max).all(),
                    "{b:?} {decoded:?}"
                );
            }
        }
    }

    /// Catches a child that changes on its way through 16 bits.
    #[test]
    fn children_round_trip() {
        let far = (1 << 14) - 1;
        for child in
            [Child::Node(255), Child::Leaf(0), Child::Leaf(far), Child::Brick(7), Child::Instance(far)]
        {
            assert_eq!(Child::decode(child.encode()), child);
        }
    }
}
