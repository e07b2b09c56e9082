//! Bricks: what the builder writes and the tracers read (paper, section 4.1).
//!
//! A brick is a treelet of at most 256 nodes with all its leaves, contiguous in memory and on disk. Inside it, all
//! references are 8 to 14 bits; a child may be another brick. [`lattice`] has the integer coordinates, [`node`] and
//! [`leaf`] the two records, [`intersect`] rays against faces, [`walk`] any hit over bricks.
//!
//! ```text
//! byte  0  magic          4 bytes  "PBRK"
//!       4  bytes          u32      of the whole brick, a multiple of 64
//!       8  checksum       u64      xxh3 of everything from byte 16
//!      16  number         u32      the brick's own number
//!      20  micropolygons  u32      in this brick's own leaves
//!      24  nodes          u16      1 to 256, the root first, children after their parents
//!      26  children       u16      entries of the table of brick numbers, 0 to 256
//!      28  reserved       36 bytes of zero
//!      64  nodes, 128 bytes each; then the table of brick numbers, u32 each; then, from a multiple of 8, the leaves
//! ```

pub mod lattice;
pub mod leaf;
pub mod node;

use xxhash_rust::xxh3::xxh3_64;

pub use lattice::Lattice;
pub use node::{Child, LatticeBox, Node};

use crate::{Error, Result};

/// Bytes before the first node.
pub const HEADER_BYTES: usize = 64;
/// Nodes of a brick at most.
pub const NODES_MAX: usize = 256;
/// Other bricks that a brick may refer to.
pub const CHILDREN_MAX: usize = 256;
/// Bytes of a brick at most: leaf offsets have 14 bits of 8 bytes.
pub const BYTES_MAX: usize = 8 << node::LOCATION_BITS;
/// Bricks start and end at multiples of this, on disk and in the arena.
pub const ALIGNMENT: usize = 64;

const MAGIC: [u8; 4] = *b"PBRK";

/// A brick in memory. Made by [`Brick::check`] from bytes of unknown origin, or by [`Brick::trusted`] from bytes that
/// were checked when they came in.
#[derive(Clone, Copy, Debug)]
pub struct Brick<'a> {
    /// The brick's bytes; may run on past its end, so that decoders can read whole words.
    bytes: &'a [u8],
}

impl<'a> Brick<'a> {
    /// A brick that was checked before. `bytes` starts at the brick and should run at least
    /// [`leaf::READ_PAST_BYTES`] past its end.
    #[inline(always)]
    pub fn trusted(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    /// Checks everything that decoding relies on: magic, length, checksum, every reference, every leaf.
    ///
    /// `length` is the brick's length as its directory says, `bricks` the number of bricks in the map; `bytes` runs
    /// on at least [`leaf::READ_PAST_BYTES`] past the brick.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`](crate::ErrorKind::Corrupt), without a place.
    pub fn check(bytes: &'a [u8], length: usize, number: u32, bricks: u32) -> Result<Self> {
        let brick = Self { bytes };
        let corrupt = |what: &str| {
            Err(Error::new(crate::ErrorKind::Corrupt, format!("brick {number}: {what}"))
                .hint("build the brick map again"))
        };
        if length < HEADER_BYTES + size_of::<Node>()
            || length > BYTES_MAX
            || bytes.len() < length + leaf::READ_PAST_BYTES
        {
            return corrupt("impossible length");
        }
        if bytes[..4] != MAGIC || brick.u32_at(4) as usize != length || brick.u32_at(16) != number {
            return corrupt("not the brick that the directory promises");
        }
        if u64::from_le_bytes(bytes[8..16].try_into().expect("8 bytes")) != xxh3_64(&bytes[16..length]) {
            return corrupt("checksum does not match");
        }
        let (nodes, children) = (brick.node_count(), brick.child_count());
        let leaves = leaves_offset(nodes, children);
        if !(1..=NODES_MAX).contains(&nodes) || children > CHILDREN_MAX || leaves > length {
            return corrupt("impossible counts");
        }
        if (0..children).any(|index| brick.child_brick(index) >= bricks) {
            return corrupt("a child brick is not in the map");
        }
        for index in 0..nodes {
            let node = brick.node(index);
            if usize::from(node.count) > node::WIDTH || node.exponent.iter().any(|&e| e > 23) {
                return corrupt("impossible node");
            }
            for slot in 0..usize::from(node.count) {
                let sound = match node.child(slot) {
                    // Children come after their parents: no cycles
                    Some(Child::Node(child)) => usize::from(child) > index && usize::from(child) < nodes,
                    Some(Child::Brick(child)) => usize::from(child) < children,
                    Some(Child::Leaf(offset)) => {
                        let at = 8 * usize::from(offset);
                        at >= leaves
                            && at < length
                            && leaf::Layout::read(&bytes[at..length])
                                .is_some_and(|l| l.is_sound(&bytes[at..]))
                    }
                    None => false,
                };
                if !sound {
                    return corrupt("a node refers to what is not there");
                }
            }
        }
        Ok(brick)
    }

    /// Nodes of the brick.
    pub fn node_count(&self) -> usize {
        usize::from(u16::from_le_bytes([self.bytes[24], self.bytes[25]]))
    }

    /// Entries of the table of brick numbers.
    pub fn child_count(&self) -> usize {
        usize::from(u16::from_le_bytes([self.bytes[26], self.bytes[27]]))
    }

    /// Micropolygons in the brick's own leaves.
    pub fn micropolygons(&self) -> u32 {
        self.u32_at(20)
    }

    /// A node by index; the root is 0.
    #[inline(always)]
    pub fn node(&self, index: usize) -> &'a Node {
        let at = HEADER_BYTES + index * size_of::<Node>();
        bytemuck::from_bytes(&self.bytes[at..at + size_of::<Node>()])
    }

    /// The number of a child brick, by index in the table.
    #[inline(always)]
    pub fn child_brick(&self, index: usize) -> u32 {
        self.u32_at(HEADER_BYTES + self.node_count() * size_of::<Node>() + 4 * index)
    }

    /// The bytes from a leaf on, by its offset in units of 8 bytes.
    #[inline(always)]
    pub fn leaf(&self, offset: u16) -> &'a [u8] {
        &self.bytes[8 * usize::from(offset)..]
    }

    fn u32_at(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.bytes[at..at + 4].try_into().expect("4 bytes"))
    }
}

/// Where the leaves of a brick start.
fn leaves_offset(nodes: usize, children: usize) -> usize {
    (HEADER_BYTES + nodes * size_of::<Node>() + 4 * children).next_multiple_of(8)
}

/// Bytes of a brick of the given parts.
pub fn brick_bytes(nodes: usize, children: usize, leaf_bytes: usize) -> usize {
    (leaves_offset(nodes, children) + leaf_bytes).next_multiple_of(ALIGNMENT)
}

/// Appends a brick to `out`. Leaf children of `nodes` are given as offsets into `leaves` (in units of 8 bytes) and
/// shifted to where the leaves come to lie.
///
/// # Panics
/// When counts or bytes exceed [`NODES_MAX`], [`CHILDREN_MAX`] or [`BYTES_MAX`]: a builder's mistake.
pub fn assemble(
    number: u32,
    nodes: &mut [Node],
    children: &[u32],
    leaves: &[u8],
    micropolygons: u32,
    out: &mut Vec<u8>,
) {
    let length = brick_bytes(nodes.len(), children.len(), leaves.len());
    assert!(nodes.len() <= NODES_MAX && children.len() <= CHILDREN_MAX && length <= BYTES_MAX);
    let first_leaf = leaves_offset(nodes.len(), children.len()) / 8;
    for node in nodes.iter_mut() {
        for slot in 0..usize::from(node.count) {
            if let Some(Child::Leaf(offset)) = node.child(slot) {
                node.children[slot] = Child::Leaf(offset + first_leaf as u16).encode();
            }
        }
    }
    let start = out.len();
    out.resize(start + HEADER_BYTES, 0);
    out.extend_from_slice(bytemuck::cast_slice(nodes));
    children.iter().for_each(|child| out.extend_from_slice(&child.to_le_bytes()));
    out.resize(start + 8 * first_leaf, 0);
    out.extend_from_slice(leaves);
    out.resize(start + length, 0);

    let brick = &mut out[start..];
    brick[..4].copy_from_slice(&MAGIC);
    brick[4..8].copy_from_slice(&(length as u32).to_le_bytes());
    brick[16..20].copy_from_slice(&number.to_le_bytes());
    brick[20..24].copy_from_slice(&micropolygons.to_le_bytes());
    brick[24..26].copy_from_slice(&(nodes.len() as u16).to_le_bytes());
    brick[26..28].copy_from_slice(&(children.len() as u16).to_le_bytes());
    let checksum = xxh3_64(&brick[16..]);
    brick[8..16].copy_from_slice(&checksum.to_le_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use glam::IVec3;

    fn small_brick() -> (Vec<u8>, usize) {
        let face = leaf::Face {
            vertices: [IVec3::ZERO, IVec3::new(4, 0, 0), IVec3::new(4, 4, 0), IVec3::new(0, 4, 0)],
            arity: 4,
            extinction: leaf::OPAQUE,
            radii: [0.0; 2],
        };
        let mut leaves = Vec::new();
        leaf::encode(&[face], 0, &mut leaves);
        let mut node = Node::over(&[face.bounds(), face.bounds()]);
        node.children[0] = Child::Leaf(0).encode();
        node.children[1] = Child::Brick(0).encode();
        let mut bytes = Vec::new();
        assemble(3, &mut [node], &[5], &leaves, 1, &mut bytes);
        let length = bytes.len();
        bytes.resize(length + leaf::READ_PAST_BYTES, 0);
        (bytes, length)
    }

    /// Catches a brick that its own check refuses.
    #[test]
    fn an_assembled_brick_passes_its_check() {
        let (bytes, length) = small_brick();
        let brick = Brick::check(&bytes, length, 3, 6).unwrap();
        assert_eq!((brick.node_count(), brick.child_brick(0), brick.micropolygons()), (1, 5, 1));
    }

    /// Catches any flipped bit, any wrong length and any wrong number that would be traced.
    #[test]
    fn damage_is_found() {
        let (bytes, length) = small_brick();
        for bit in 0..8 * length {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(Brick::check(&damaged, length, 3, 6).is_err(), "bit {bit}");
        }
        assert!(Brick::check(&bytes, length - 64, 3, 6).is_err());
        assert!(Brick::check(&bytes, length, 4, 6).is_err());
        assert!(Brick::check(&bytes, length, 3, 5).is_err(), "child brick 5 of 5");
    }

    /// Catches references out of bounds that a valid checksum hides: a hostile file, not a damaged one.
    #[test]
    fn hostile_references_are_found() {
        for child in [Child::Node(0), Child::Node(1), Child::Brick(1), Child::Leaf(2000)] {
            let mut node = Node::zeroed();
            node.count = 1;
            node.children[0] = child.encode();
            let mut bytes = Vec::new();
            assemble(0, &mut [node], &[0], &[], 0, &mut bytes);
            let length = bytes.len();
            bytes.resize(length + leaf::READ_PAST_BYTES, 0);
            assert!(Brick::check(&bytes, length, 0, 1).is_err(), "{child:?}");
        }
    }
}
