//! From a tree to bricks: the tree is cut into treelets of a few kilobytes, each a brick.
//!
//! From the leaves up, a node takes its children's treelets into its own until they are too large; then the largest become
//! bricks of their own. Bricks are numbered and written children first, in the order of the tree: a subtree is one run of
//! bytes, and the last brick is its root.

use super::bvh::{WideChild, WideTree};
use super::farfield;
use crate::brick::node::WIDTH;
use crate::brick::{CHILDREN_MAX, Child, LatticeBox, Node, assemble, leaf};

/// Bytes that a brick's nodes and leaves take at most, unless a single node's leaves take more. Smaller bricks waste headers,
/// larger ones load what a batch does not touch.
pub const TREELET_BYTES: usize = 12 << 10;

/// Bytes of a reference to another brick.
const REFERENCE_BYTES: usize = 8;

/// What a primitive of the tree is.
#[derive(Clone, Copy, Debug)]
pub enum Content {
    /// A leaf, by its place among the encoded leaves.
    Leaf {
        /// First byte.
        offset: u32,
        /// Bytes.
        bytes: u32,
    },
    /// A brick that is written already.
    Brick(u32),
}

/// What a tree is built over: a leaf, or, at the top level, the root brick of a partition.
#[derive(Clone, Copy, Debug)]
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
    /// How good the tree is.
    pub tree: TreeStats,
}

/// What a tree is worth.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TreeStats {
    /// Nodes.
    pub nodes: u64,
    /// Children of all nodes.
    pub children: u64,
    /// Leaves.
    pub leaves: u64,
    /// Vertices in the leaves; those on the border of two are counted in both.
    pub vertices: u64,
    /// Half the areas of all nodes' boxes. Over that of the root's box: the nodes that a line through it visits.
    pub node_half_area: f64,
    /// Half the areas of all leaves' boxes.
    pub leaf_half_area: f64,
}

impl std::ops::AddAssign for TreeStats {
    fn add_assign(&mut self, other: Self) {
        self.nodes += other.nodes;
        self.children += other.children;
        self.leaves += other.leaves;
        self.vertices += other.vertices;
        self.node_half_area += other.node_half_area;
        self.leaf_half_area += other.leaf_half_area;
    }
}

/// Half the area of a box in squared lattice steps.
pub fn half_area(bounds: &LatticeBox) -> f64 {
    let size = (bounds.max - bounds.min).as_dvec3();
    size.x * size.y + size.y * size.z + size.z * size.x
}

/// Where a brick map's bytes go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct ByteSplit {
    /// Nodes without their far field.
    pub nodes: u64,
    /// Far field.
    pub far_field: u64,
    /// Leaves, index tables included.
    pub leaves: u64,
    /// The leaves' index tables.
    pub indices: u64,
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
        self.indices += other.indices;
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

/// How to cut a tree into bricks.
#[derive(Clone, Copy, Debug)]
pub struct Cut {
    /// The number of the first brick.
    pub first_number: u32,
    /// [`TREELET_BYTES`], or less in tests.
    pub treelet_bytes: usize,
    /// Roots that the tree may be opened into, for the sake of a higher tree over them.
    pub roots_max: usize,
}

/// Packs `tree` over `primitives` into bricks. `leaves` holds the encoded leaves. Returns the root bricks as primitives of a
/// higher tree: nodes above them are dropped, and the last brick is the last root.
pub fn pack(
    tree: &WideTree,
    primitives: &[Primitive],
    leaves: &[u8],
    cut: Cut,
    out: &mut Packed,
) -> Vec<Primitive> {
    let mut subtrees = measure(tree, primitives, cut.treelet_bytes, &mut out.tree);
    let roots = open_roots(tree, &subtrees, cut.roots_max, &mut out.tree);
    roots.iter().for_each(|&root| subtrees[root as usize].is_brick = true);
    let mut packer =
        Packer { tree, primitives, leaves, subtrees: &subtrees, first_number: cut.first_number, out };
    let primitive = |root: u32| {
        let Subtree { bounds, area, opaque_area, micropolygons, .. } = subtrees[root as usize];
        let content = Content::Brick(packer.brick(root));
        Primitive { bounds, area: area as f32, opaque_area: opaque_area as f32, micropolygons, content }
    };
    roots.into_iter().map(primitive).collect()
}

/// Opens the largest nodes from the root down into their children while these are at most `roots_max`; nodes with leaves of
/// their own stay. The opened ones are taken from `stats`.
fn open_roots(tree: &WideTree, subtrees: &[Subtree], roots_max: usize, stats: &mut TreeStats) -> Vec<u32> {
    let inner = |child: &WideChild| matches!(child, WideChild::Node(_));
    let mut roots = vec![0];
    loop {
        let can_open = |&(_, root): &(usize, &u32)| {
            let node = &tree.nodes[*root as usize];
            let children = &node.children[..usize::from(node.count)];
            roots.len() - 1 + children.len() <= roots_max && children.iter().all(inner)
        };
        let area = |&(_, root): &(usize, &u32)| half_area(&subtrees[*root as usize].bounds);
        let largest = roots.iter().enumerate().filter(can_open).max_by(|a, b| area(a).total_cmp(&area(b)));
        let Some((at, &root)) = largest else { return roots };
        let node = &tree.nodes[root as usize];
        let children = node.children[..usize::from(node.count)].iter().filter_map(|child| match *child {
            WideChild::Node(child) => Some(child),
            WideChild::Primitive(_) => None,
        });
        stats.nodes -= 1;
        stats.children -= u64::from(node.count);
        stats.node_half_area -= half_area(&subtrees[root as usize].bounds);
        roots.splice(at..=at, children);
    }
}

/// Sums up every subtree and decides which become bricks.
fn measure(
    tree: &WideTree,
    primitives: &[Primitive],
    treelet_bytes: usize,
    stats: &mut TreeStats,
) -> Vec<Subtree> {
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
        let mut sum = Subtree { bytes: size_of::<Node>(), nodes: 1, ..empty };
        let mut inner = [0; WIDTH];
        let mut inner_count = 0;
        for child in &node.children[..usize::from(node.count)] {
            match *child {
                WideChild::Primitive(primitive) => {
                    let p = &primitives[primitive as usize];
                    sum.bounds = sum.bounds.union(p.bounds);
                    sum.area += f64::from(p.area);
                    sum.opaque_area += f64::from(p.opaque_area);
                    sum.micropolygons += p.micropolygons;
                    sum.bytes += match p.content {
                        Content::Leaf { bytes, .. } => {
                            stats.leaves += 1;
                            stats.leaf_half_area += half_area(&p.bounds);
                            bytes as usize
                        }
                        Content::Brick(_) => REFERENCE_BYTES,
                    };
                }
                WideChild::Node(child) => {
                    let below = &subtrees[child as usize];
                    sum.bounds = sum.bounds.union(below.bounds);
                    sum.area += below.area;
                    sum.opaque_area += below.opaque_area;
                    sum.micropolygons += below.micropolygons;
                    sum.bytes += below.bytes;
                    sum.nodes += below.nodes;
                    inner[inner_count] = child as usize;
                    inner_count += 1;
                }
            }
        }
        // The largest children become bricks until the rest fits
        let inner = &mut inner[..inner_count];
        inner.sort_by_key(|&child| std::cmp::Reverse(subtrees[child].bytes));
        for &child in inner.iter() {
            if sum.bytes <= treelet_bytes && sum.nodes <= CHILDREN_MAX / WIDTH {
                break;
            }
            sum.bytes -= subtrees[child].bytes - REFERENCE_BYTES;
            sum.nodes -= subtrees[child].nodes;
            subtrees[child].is_brick = true;
        }
        stats.nodes += 1;
        stats.children += u64::from(node.count);
        stats.node_half_area += half_area(&sum.bounds);
        subtrees[index] = sum;
    }
    subtrees
}

/// Writes bricks.
struct Packer<'a> {
    tree: &'a WideTree,
    primitives: &'a [Primitive],
    leaves: &'a [u8],
    subtrees: &'a [Subtree],
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
        let (mut micropolygons, mut index_bytes) = (0, 0);
        let mut next_member = 1;
        for &member in &members {
            let wide = self.tree.nodes[member as usize];
            let children = &wide.children[..usize::from(wide.count)];
            let mut boxes = [LatticeBox::EMPTY; WIDTH];
            children.iter().zip(&mut boxes).for_each(|(child, b)| *b = self.bounds(child));
            let mut node = Node::over(&boxes[..children.len()]);
            for (slot, child) in children.iter().enumerate() {
                let (area, opaque_area) = self.areas(child);
                node.far[slot] = farfield::paper(&node.child_box(slot), area, opaque_area);
                let reference = match *child {
                    WideChild::Node(child) if self.subtrees[child as usize].is_brick => {
                        table.push(self.brick(child));
                        Child::Brick((table.len() - 1) as _)
                    }
                    WideChild::Node(_) => {
                        next_member += 1;
                        Child::Node(next_member - 1)
                    }
                    WideChild::Primitive(primitive) => {
                        let primitive = &self.primitives[primitive as usize];
                        match primitive.content {
                            Content::Leaf { offset, bytes } => {
                                let here = (leaves.len() / 8) as u16;
                                let leaf = &self.leaves[offset as usize..(offset + bytes) as usize];
                                leaves.extend_from_slice(leaf);
                                let layout = leaf::Layout::read_trusted(leaf);
                                index_bytes += (layout.coordinates[0] - leaf::HEADER_BYTES) as u64;
                                self.out.tree.vertices += layout.vertices as u64;
                                micropolygons += primitive.micropolygons as u32;
                                Child::Leaf(here)
                            }
                            Content::Brick(number) => {
                                table.push(number);
                                Child::Brick((table.len() - 1) as _)
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
            indices: index_bytes,
            headers: length as u64 - node_bytes - far_field - leaves.len() as u64,
            directory: 0,
        };
        number
    }

    fn bounds(&self, child: &WideChild) -> LatticeBox {
        match *child {
            WideChild::Node(node) => self.subtrees[node as usize].bounds,
            WideChild::Primitive(primitive) => self.primitives[primitive as usize].bounds,
        }
    }

    fn areas(&self, child: &WideChild) -> (f32, f32) {
        match *child {
            WideChild::Node(node) => {
                let subtree = &self.subtrees[node as usize];
                (subtree.area as f32, subtree.opaque_area as f32)
            }
            WideChild::Primitive(primitive) => {
                let primitive = &self.primitives[primitive as usize];
                (primitive.area, primitive.opaque_area)
            }
        }
    }
}
