//! From a tree to bricks: the tree is cut into treelets of a few kilobytes, each a brick.
//!
//! From the leaves up, a node takes its children's treelets into its own until they are too large; then the largest become
//! bricks of their own. Bricks are numbered and written children first, in the order of the tree: a subtree is one run of
//! bytes, and the last brick is its root.

use super::bvh::{WideChild, WideNode, WideTree};
use super::farfield::{self, shapes::Shapes};
use super::leaves::Leaves;
use super::shared::Placed;
use crate::brick::lanes::InstructionSet;
use crate::brick::node::{LOCATION_BYTES, WIDTH};
use crate::brick::{
    ALIGNMENT, CHILDREN_MAX, Child, HEADER_BYTES, INSTANCE_BYTES, LatticeBox, Node, assemble,
};

/// Bytes that a brick's nodes and leaves take at most, unless a single node's leaves take more. Smaller bricks waste headers,
/// larger ones load what a batch does not touch.
const TREELET_BYTES: usize = 12 << 10;

/// What a primitive of the tree is.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum Content {
    /// A leaf, of the same number.
    Leaf,
    /// A brick that is written already.
    Brick(u32),
    /// A copy of a prototype, by its place among all of the top level.
    Instance(u32),
}

/// What a tree is built over: a leaf, or, at the top level, the root brick of a partition.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Primitive {
    /// Its box.
    pub bounds: LatticeBox,
    /// Area of the faces in squared lattice steps.
    pub area: f32,
    /// The same, each face weighted by its opacity.
    pub opaque_area: f32,
    /// Micropolygons in it.
    pub micropolygons: u64,
    /// What it is.
    pub content: Content,
}

/// Bricks, one after the other.
#[derive(Debug, Default)]
pub struct Packed {
    /// Their bytes.
    pub bytes: Vec<u8>,
    /// The length of each.
    pub lengths: Vec<u32>,
    /// Bytes by what they are for.
    pub split: ByteSplit,
    /// What a tree over partitions needs of the root, with a directional far field.
    pub root: Option<farfield::Root>,
}

/// Where a brick map's bytes go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct ByteSplit {
    /// Nodes without their far field.
    pub nodes: u64,
    /// Far field.
    pub far_field: u64,
    /// Leaves.
    pub leaves: u64,
    /// Brick headers, tables and padding.
    pub headers: u64,
    /// The directory.
    pub directory: u64,
}

impl std::ops::AddAssign for ByteSplit {
    fn add_assign(&mut self, other: Self) {
        self.nodes += other.nodes;
        self.far_field += other.far_field;
        self.leaves += other.leaves;
        self.headers += other.headers;
        self.directory += other.directory;
    }
}

/// A node of the tree with all that lies below it.
#[derive(Clone, Copy, Debug)]
struct Subtree {
    bounds: LatticeBox,
    area: f64,
    opaque_area: f64,
    micropolygons: u64,
    /// Bytes and nodes of its treelet, before it becomes a brick.
    bytes: usize,
    nodes: usize,
    /// Whether it is the root of a brick.
    is_brick: bool,
}

/// Packs `tree` over `primitives` into bricks numbered from `first_number` on. `leaves` has what those primitives hold that are
/// leaves. Returns the root brick as a primitive of a higher tree.
pub fn pack(
    tree: &WideTree,
    primitives: &[Primitive],
    leaves: &Leaves,
    first_number: u32,
    far: Far<'_>,
    out: &mut Packed,
) -> Primitive {
    let mut subtrees = sum_up(tree, primitives);
    let mut nodes = nodes(tree, primitives, &subtrees);
    match far {
        Far::Paper => fill_paper(tree, primitives, &subtrees, &mut nodes),
        Far::Directional(others) => {
            out.root = Some(fill_directional(tree, leaves, others, &mut nodes));
        }
        Far::Over(top) if top.is_paper => fill_paper(tree, primitives, &subtrees, &mut nodes),
        Far::Over(top) => farfield::top::fill(tree, primitives, top, &mut nodes),
    }
    let encoded = Encoded::of(tree, &nodes, leaves);
    let bytes = cut(tree, primitives, &encoded, &mut subtrees);
    out.bytes.reserve(bytes);
    let placed = if let Far::Over(top) = far { top.placed } else { &[] };
    let mut packer =
        Packer { tree, primitives, encoded, placed, subtrees: &subtrees, nodes, first_number, out };
    let number = packer.brick(0);
    let root = &subtrees[0];
    Primitive {
        bounds: root.bounds,
        area: root.area as f32,
        opaque_area: root.opaque_area as f32,
        micropolygons: root.micropolygons,
        content: Content::Brick(number),
    }
}

/// Leaves as they are written, each relative to its box as its node has it.
struct Encoded {
    bytes: Vec<u8>,
    /// First byte of each and the byte after its last.
    places: Vec<[u32; 2]>,
}

impl Encoded {
    fn of(tree: &WideTree, nodes: &[Node], leaves: &Leaves) -> Self {
        let mut encoded = Self { bytes: Vec::new(), places: vec![[0; 2]; leaves.len()] };
        if leaves.is_empty() {
            return encoded;
        }
        for (node, wide) in nodes.iter().zip(&tree.nodes) {
            for (slot, child) in wide.children[..usize::from(wide.count)].iter().enumerate() {
                if let WideChild::Primitive(leaf) = *child {
                    let start = encoded.bytes.len() as u32;
                    leaves.get(leaf as usize).encode(node.lower_corner(slot), &mut encoded.bytes);
                    encoded.places[leaf as usize] = [start, encoded.bytes.len() as u32];
                }
            }
        }
        encoded
    }

    fn leaf(&self, leaf: u32) -> &[u8] {
        let [start, end] = self.places[leaf as usize];
        &self.bytes[start as usize..end as usize]
    }
}

/// How nodes get their far field.
#[derive(Clone, Copy, Debug)]
pub enum Far<'a> {
    /// By the paper's formula.
    Paper,
    /// By lines through the leaves, among others' geometry.
    Directional(farfield::Others<'a>),
    /// From what was found of the roots that the tree is over.
    Over(&'a Top<'a>),
}

/// What a tree over partitions and copies of prototypes needs to know of them.
#[derive(Debug)]
pub struct Top<'a> {
    /// Whether the far field is the paper's, which needs nothing of what follows but `placed`.
    pub is_paper: bool,
    /// Roots of the partitions, which are the first primitives.
    pub roots: &'a [farfield::Root],
    /// Roots of the prototypes.
    pub prototypes: &'a [farfield::Root],
    /// The copies.
    pub placed: &'a [Placed],
}

/// The tree's nodes with boxes, without far field; their children are not placed yet.
fn nodes(tree: &WideTree, primitives: &[Primitive], subtrees: &[Subtree]) -> Vec<Node> {
    let bounds = |child: &WideChild| match *child {
        WideChild::Node(node) => subtrees[node as usize].bounds,
        WideChild::Primitive(primitive) => primitives[primitive as usize].bounds,
    };
    let over = |wide: &WideNode| {
        let mut boxes = [LatticeBox::EMPTY; WIDTH];
        let children = &wide.children[..usize::from(wide.count)];
        children.iter().zip(&mut boxes).for_each(|(child, b)| *b = bounds(child));
        Node::over(&boxes[..children.len()])
    };
    tree.nodes.iter().map(over).collect()
}

/// Fills the nodes with the paper's far field.
fn fill_paper(tree: &WideTree, primitives: &[Primitive], subtrees: &[Subtree], nodes: &mut [Node]) {
    for (node, wide) in nodes.iter_mut().zip(&tree.nodes) {
        for (slot, child) in wide.children[..usize::from(wide.count)].iter().enumerate() {
            let (area, opaque_area) = areas(child, primitives, subtrees);
            node.far[slot] = farfield::paper(&node.child_box(slot), area, opaque_area);
        }
    }
}

/// Fills the nodes over leaves with the directional far field and returns what it is of the root.
fn fill_directional(
    tree: &WideTree,
    leaves: &Leaves,
    others: farfield::Others<'_>,
    nodes: &mut [Node],
) -> farfield::Root {
    let mut shapes = Shapes::default();
    (0..leaves.len()).for_each(|leaf| shapes.push(&leaves.get(leaf)));
    let (records, root) = farfield::directional(tree, nodes, &shapes, others, InstructionSet::detect());
    nodes.iter_mut().zip(records).for_each(|(node, far)| node.far = far);
    root
}

/// Sums of areas below a child: of all, and weighted by opacity.
fn areas(child: &WideChild, primitives: &[Primitive], subtrees: &[Subtree]) -> (f32, f32) {
    match *child {
        WideChild::Node(node) => {
            let subtree = &subtrees[node as usize];
            (subtree.area as f32, subtree.opaque_area as f32)
        }
        WideChild::Primitive(primitive) => {
            let primitive = &primitives[primitive as usize];
            (primitive.area, primitive.opaque_area)
        }
    }
}

/// Sums up every subtree; none is a brick yet.
fn sum_up(tree: &WideTree, primitives: &[Primitive]) -> Vec<Subtree> {
    let empty = Subtree {
        bounds: LatticeBox::EMPTY,
        area: 0.0,
        opaque_area: 0.0,
        micropolygons: 0,
        bytes: 0,
        nodes: 0,
        is_brick: false,
    };
    let mut subtrees = vec![empty; tree.nodes.len()];
    for (index, node) in tree.nodes.iter().enumerate().rev() {
        let mut sum = empty;
        for child in &node.children[..usize::from(node.count)] {
            match *child {
                WideChild::Primitive(primitive) => {
                    let p = &primitives[primitive as usize];
                    sum.bounds = sum.bounds.union(p.bounds);
                    sum.area += f64::from(p.area);
                    sum.opaque_area += f64::from(p.opaque_area);
                    sum.micropolygons += p.micropolygons;
                }
                WideChild::Node(child) => {
                    let below = &subtrees[child as usize];
                    sum.bounds = sum.bounds.union(below.bounds);
                    sum.area += below.area;
                    sum.opaque_area += below.opaque_area;
                    sum.micropolygons += below.micropolygons;
                }
            }
        }
        subtrees[index] = sum;
    }
    subtrees
}

/// Decides which subtrees become bricks, the whole tree in any case. Returns about how many bytes all of them take.
fn cut(tree: &WideTree, primitives: &[Primitive], encoded: &Encoded, subtrees: &mut [Subtree]) -> usize {
    let mut total = 0;
    for (index, node) in tree.nodes.iter().enumerate().rev() {
        let (mut bytes, mut nodes) = (size_of::<Node>(), 1);
        let mut inner = [0; WIDTH];
        let mut inner_count = 0;
        for child in &node.children[..usize::from(node.count)] {
            match *child {
                WideChild::Primitive(primitive) => {
                    bytes += match primitives[primitive as usize].content {
                        Content::Leaf => encoded.leaf(primitive).len(),
                        Content::Brick(_) => 8,
                        Content::Instance(_) => INSTANCE_BYTES,
                    };
                }
                WideChild::Node(child) => {
                    bytes += subtrees[child as usize].bytes;
                    nodes += subtrees[child as usize].nodes;
                    inner[inner_count] = child as usize;
                    inner_count += 1;
                }
            }
        }
        // The largest children become bricks until the rest fits
        let inner = &mut inner[..inner_count];
        inner.sort_by_key(|&child| std::cmp::Reverse(subtrees[child].bytes));
        for &child in inner.iter() {
            if bytes <= TREELET_BYTES && nodes <= CHILDREN_MAX / WIDTH {
                break;
            }
            bytes -= subtrees[child].bytes - 8;
            nodes -= subtrees[child].nodes;
            subtrees[child].is_brick = true;
            total += subtrees[child].bytes + HEADER_BYTES + ALIGNMENT;
        }
        (subtrees[index].bytes, subtrees[index].nodes) = (bytes, nodes);
    }
    subtrees[0].is_brick = true;
    total + subtrees[0].bytes + HEADER_BYTES + ALIGNMENT
}

/// Writes bricks.
struct Packer<'a> {
    tree: &'a WideTree,
    primitives: &'a [Primitive],
    encoded: Encoded,
    placed: &'a [Placed],
    subtrees: &'a [Subtree],
    nodes: Vec<Node>,
    first_number: u32,
    out: &'a mut Packed,
}

impl Packer<'_> {
    /// Writes the bricks below `root`, then the brick of its treelet, and returns its number.
    fn brick(&mut self, root: u32) -> u32 {
        // The treelet's nodes, parents first
        let mut members = vec![root];
        let mut at = 0;
        while at < members.len() {
            let node = &self.tree.nodes[members[at] as usize];
            for child in &node.children[..usize::from(node.count)] {
                if let WideChild::Node(child) = *child
                    && !self.subtrees[child as usize].is_brick
                {
                    members.push(child);
                }
            }
            at += 1;
        }
        let (mut nodes, mut table, mut leaves) = (Vec::with_capacity(members.len()), Vec::new(), Vec::new());
        let mut micropolygons = 0;
        let mut next_member = 1;
        for &member in &members {
            let wide = self.tree.nodes[member as usize];
            let children = &wide.children[..usize::from(wide.count)];
            let mut node = self.nodes[member as usize];
            for (slot, child) in children.iter().enumerate() {
                let reference = match *child {
                    WideChild::Node(child) if self.subtrees[child as usize].is_brick => {
                        table.push(self.brick(child));
                        Child::Brick((table.len() - 1) as u16)
                    }
                    WideChild::Node(_) => {
                        next_member += 1;
                        Child::Node(next_member - 1)
                    }
                    WideChild::Primitive(number) => {
                        let primitive = &self.primitives[number as usize];
                        match primitive.content {
                            Content::Leaf => {
                                let here = (leaves.len() / LOCATION_BYTES) as u16;
                                leaves.extend_from_slice(self.encoded.leaf(number));
                                micropolygons += primitive.micropolygons as u32;
                                Child::Leaf(here)
                            }
                            Content::Brick(number) => {
                                table.push(number);
                                Child::Brick((table.len() - 1) as u16)
                            }
                            Content::Instance(copy) => {
                                let here = (leaves.len() / LOCATION_BYTES) as u16;
                                let record = self.placed[copy as usize].record(node.lower_corner(slot));
                                let record = record.expect("checked when it was placed");
                                leaves.extend_from_slice(bytemuck::bytes_of(&record));
                                Child::Instance(here)
                            }
                        }
                    }
                };
                node.children[slot] = reference.encode();
            }
            nodes.push(node);
        }
        let number = self.first_number + self.out.lengths.len() as u32;
        let start = self.out.bytes.len();
        assemble(number, &mut nodes, &table, &leaves, micropolygons, &mut self.out.bytes);
        let length = self.out.bytes.len() - start;
        self.out.lengths.push(length as u32);
        let far_field = (48 * nodes.len()) as u64;
        let node_bytes = (80 * nodes.len()) as u64;
        self.out.split += ByteSplit {
            nodes: node_bytes,
            far_field,
            leaves: leaves.len() as u64,
            headers: length as u64 - node_bytes - far_field - leaves.len() as u64,
            directory: 0,
        };
        number
    }
}
