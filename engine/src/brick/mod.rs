//! Bricks: what the builder writes and the tracers read (paper, section 4.1).
//!
//! A brick is a treelet of at most 256 nodes with all its leaves, contiguous in memory and on disk. Inside it, all
//! references are 14 bits; a child may be another brick. [`lattice`] has the integer coordinates, [`node`] and
//! [`leaf`] the two records, [`far`] what stands in for a child, [`instance`] what refers to a prototype, [`intersect`] rays against faces, [`bundle`] the rays of a few points, [`lanes`] the inner
//! loops per instruction set, [`walk`] any hit over bricks.
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
//!      64  nodes, 128 bytes each; then the table of brick numbers, u64 each; then leaves and instances
//! ```

pub mod bundle;
pub mod far;
pub mod instance;
pub mod intersect;
pub mod lanes;
pub mod lattice;
pub mod leaf;
pub mod node;
pub mod walk;

use xxhash_rust::xxh3::xxh3_64;

pub use instance::{INSTANCE_BYTES, Instance};
pub use lattice::Lattice;
pub use node::{Child, LatticeBox, Node};

use crate::{Error, Result};

/// Bytes before the first node.
pub const HEADER_BYTES: usize = 64;
/// Nodes of a brick at most.
pub const NODES_MAX: usize = 256;
/// Other bricks that a brick may refer to.
pub const CHILDREN_MAX: usize = 256;
/// Bytes of a brick at most: locations have 14 bits of 4 bytes.
pub const BYTES_MAX: usize = node::LOCATION_BYTES << node::LOCATION_BITS;
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
    /// `length` and `number` are the brick's as its directory says; `bytes` runs on at least
    /// [`leaf::READ_PAST_BYTES`] past the brick.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`](crate::ErrorKind::Corrupt), without a place.
    pub fn check(bytes: &'a [u8], length: usize, number: u32) -> Result<Self> {
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
        let (table, leaves) = (table_offset(nodes), leaves_offset(nodes, children));
        if !(1..=NODES_MAX).contains(&nodes) || children > CHILDREN_MAX || leaves > length {
            return corrupt("impossible counts");
        }
        // Child bricks come before their parents: no cycles
        if (0..children).any(|index| brick.child_brick(index) >= number) {
            return corrupt("a child brick does not come before it");
        }
        let mut has_parent = [false; NODES_MAX];
        for index in 0..nodes {
            let node = brick.node(index);
            if usize::from(node.count) > node::WIDTH || node.exponent.iter().any(|&e| e > 23) {
                return corrupt("impossible node");
            }
            let from = table_offset(index);
            for slot in 0..usize::from(node.count) {
                let sound = match node.child(slot) {
                    // Children come after their parents and have one only: no cycles, no blow-up
                    Some(Child::Node(offset)) => {
                        let distance = node::LOCATION_BYTES * usize::from(offset);
                        let child = index + distance / size_of::<Node>();
                        distance.is_multiple_of(size_of::<Node>())
                            && child > index
                            && child < nodes
                            && !std::mem::replace(&mut has_parent[child], true)
                    }
                    Some(Child::Brick(offset)) => {
                        let at = from + node::LOCATION_BYTES * usize::from(offset);
                        at >= table && at < table + 8 * children && (at - table).is_multiple_of(8)
                    }
                    Some(Child::Leaf(offset)) => {
                        let at = from + node::LOCATION_BYTES * usize::from(offset);
                        at >= leaves
                            && at < length
                            && leaf::Layout::read(&bytes[at..length], node.child_box(slot).min)
                                .is_some_and(|l| l.is_sound(&bytes[at..]))
                    }
                    Some(Child::Instance(offset)) => {
                        let at = from + node::LOCATION_BYTES * usize::from(offset);
                        at >= leaves
                            && at + INSTANCE_BYTES <= length
                            && Instance::read(&bytes[at..]).is_sound(number)
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
        self.u32_at(table_offset(self.node_count()) + 8 * index)
    }

    /// The bytes from what a node refers to on.
    pub fn at(&self, node: usize, offset: u16) -> &'a [u8] {
        &self.bytes[HEADER_BYTES + node * size_of::<Node>() + node::LOCATION_BYTES * usize::from(offset)..]
    }

    /// The number of the child brick that a node refers to.
    pub fn child_brick_at(&self, node: usize, offset: u16) -> u32 {
        u32::from_le_bytes(self.at(node, offset)[..4].try_into().expect("4 bytes"))
    }

    /// The index of the node that a node refers to.
    pub fn child_node(&self, node: usize, offset: u16) -> usize {
        node + node::LOCATION_BYTES * usize::from(offset) / size_of::<Node>()
    }

    fn u32_at(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.bytes[at..at + 4].try_into().expect("4 bytes"))
    }
}

/// Where the table of brick numbers starts.
fn table_offset(nodes: usize) -> usize {
    HEADER_BYTES + nodes * size_of::<Node>()
}

/// Where the leaves of a brick start.
fn leaves_offset(nodes: usize, children: usize) -> usize {
    table_offset(nodes) + 8 * children
}

/// Bytes of a brick of the given parts.
pub fn brick_bytes(nodes: usize, children: usize, leaf_bytes: usize) -> usize {
    (leaves_offset(nodes, children) + leaf_bytes).next_multiple_of(ALIGNMENT)
}

/// Appends a brick to `out`. Children of `nodes` are given by index: nodes in `nodes`, bricks in `children`, leaves and
/// instances by their offset in `leaves` in units of 4 bytes; here they get the places where things come to lie.
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
    let (table, first_leaf) = (table_offset(nodes.len()), leaves_offset(nodes.len(), children.len()));
    for (index, node) in nodes.iter_mut().enumerate() {
        let from = table_offset(index);
        let distance = |at: usize| ((at - from) / node::LOCATION_BYTES) as u16;
        for slot in 0..usize::from(node.count) {
            node.children[slot] = match node.child(slot).expect("a builder makes known children") {
                Child::Node(child) => Child::Node(distance(table_offset(usize::from(child)))),
                Child::Brick(child) => Child::Brick(distance(table + 8 * usize::from(child))),
                Child::Leaf(offset) => {
                    Child::Leaf(distance(first_leaf + node::LOCATION_BYTES * usize::from(offset)))
                }
                Child::Instance(offset) => {
                    Child::Instance(distance(first_leaf + node::LOCATION_BYTES * usize::from(offset)))
                }
            }
            .encode();
        }
    }
    let start = out.len();
    out.resize(start + HEADER_BYTES, 0);
    out.extend_from_slice(bytemuck::cast_slice(nodes));
    children.iter().for_each(|&child| out.extend_from_slice(&u64::from(child).to_le_bytes()));
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

/// Gives a brick that [`assemble`] made, and its references to other bricks, numbers that are higher by `base`. What its
/// instances refer to was numbered before.
pub fn renumber(brick: &mut [u8], base: u32) {
    let view = Brick::trusted(brick);
    let table = table_offset(view.node_count());
    let (number, children) = (view.u32_at(16), view.child_count());
    brick[16..20].copy_from_slice(&(number + base).to_le_bytes());
    for child in brick[table..table + 8 * children].chunks_exact_mut(8) {
        let number = u32::from_le_bytes([child[0], child[1], child[2], child[3]]);
        child[..4].copy_from_slice(&(number + base).to_le_bytes());
    }
    let checksum = xxh3_64(&brick[16..]);
    brick[8..16].copy_from_slice(&checksum.to_le_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::IVec3;

    fn small_brick() -> (Vec<u8>, usize) {
        let face = leaf::Face {
            vertices: [IVec3::ZERO, IVec3::new(4, 0, 0), IVec3::new(4, 4, 0), IVec3::new(0, 4, 0)],
            arity: 4,
            extinction: leaf::OPAQUE,
            radii: [0.0; 2],
        };
        let mut leaves = Vec::new();
        let mut node = Node::over(&[face.bounds(), face.bounds()]);
        leaf::encode(&[face], 0, node.child_box(0).min, &mut leaves);
        node.children[0] = Child::Leaf(0).encode();
        node.children[1] = Child::Brick(0).encode();
        let mut bytes = Vec::new();
        assemble(6, &mut [node], &[5], &leaves, 1, &mut bytes);
        let length = bytes.len();
        bytes.resize(length + leaf::READ_PAST_BYTES, 0);
        (bytes, length)
    }

    /// Catches a brick that its own check refuses.
    #[test]
    fn an_assembled_brick_passes_its_check() {
        let (bytes, length) = small_brick();
        let brick = Brick::check(&bytes, length, 6).unwrap();
        assert_eq!((brick.node_count(), brick.child_brick(0), brick.micropolygons()), (1, 5, 1));
    }

    /// Catches any flipped bit, any wrong length and any wrong number that would be traced.
    #[test]
    fn damage_is_found() {
        let (bytes, length) = small_brick();
        for bit in 0..8 * length {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert!(Brick::check(&damaged, length, 6).is_err(), "bit {bit}");
        }
        assert!(Brick::check(&bytes, length - 64, 6).is_err());
        assert!(Brick::check(&bytes, length, 4).is_err());
    }

    /// Catches a renumbered brick that its check refuses.
    #[test]
    fn a_renumbered_brick_passes_its_check() {
        let (mut bytes, length) = small_brick();
        renumber(&mut bytes[..length], 100);
        assert_eq!(Brick::check(&bytes, length, 106).unwrap().child_brick(0), 105);
    }

    /// Catches references out of bounds that a valid checksum hides: a hostile file, not a damaged one.
    #[test]
    fn hostile_references_are_found() {
        for child in [
            Child::Node(0),
            Child::Node(1),
            Child::Node(32),
            Child::Brick(0),
            Child::Leaf(0),
            Child::Leaf(4000),
            Child::Instance(0),
            Child::Instance(40),
            Child::Instance(4000),
        ] {
            let (mut bytes, length) = small_brick();
            bytes[HEADER_BYTES + 16..HEADER_BYTES + 18].copy_from_slice(&child.encode().to_le_bytes());
            let checksum = xxh3_64(&bytes[16..length]);
            bytes[8..16].copy_from_slice(&checksum.to_le_bytes());
            assert!(Brick::check(&bytes, length, 6).is_err(), "{child:?}");
        }
    }
}
