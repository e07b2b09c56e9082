//! What a brick map's tree costs, by exact boxes and by those that its nodes store.

use engine::brick::leaf::{Layout, READ_PAST_BYTES};
use engine::brick::{Brick, Child, LatticeBox};
use engine::brickmap::BrickMap;
use glam::IVec3;

/// The tree of a map in numbers.
#[derive(Default)]
pub struct Tree {
    /// Half areas of all nodes and of all leaves over the root's, by exact boxes.
    pub nodes: f64,
    /// The leaves' share.
    pub leaves: f64,
    /// Both together by the boxes that nodes store.
    pub stored: f64,
    /// The boxes of all leaves.
    pub leaf_boxes: Vec<LatticeBox>,
    /// The boxes of all faces.
    pub face_boxes: Vec<LatticeBox>,
    /// Nodes.
    pub node_count: usize,
}

pub fn half_area(bounds: &LatticeBox) -> f64 {
    let size = (bounds.max - bounds.min).as_dvec3();
    size.x * size.y + size.y * size.z + size.z * size.x
}

/// Reads the whole map: bricks come before those that refer to them.
pub fn tree(map: &BrickMap) -> Tree {
    let mut tree = Tree::default();
    let (mut roots, mut bytes) = (Vec::new(), Vec::new());
    for number in 0..map.brick_count() {
        let length = map.brick_bytes(number) as usize;
        bytes.clear();
        bytes.resize(length + READ_PAST_BYTES, 0);
        map.read(number, 1, &mut bytes[..length]).expect("the map was just written");
        let brick = Brick::check(&bytes, length, number).expect("the map was just written");
        let mut boxes = vec![LatticeBox::EMPTY; brick.node_count()];
        for index in (0..brick.node_count()).rev() {
            let node = brick.node(index);
            for slot in 0..usize::from(node.count) {
                let bounds = match node.child(slot).expect("a known kind") {
                    Child::Node(offset) => boxes[brick.child_node(index, offset)],
                    Child::Brick(offset) => roots[brick.child_brick_at(index, offset) as usize],
                    Child::Leaf(offset) => tree.add_leaf(brick.at(index, offset), node.child_box(slot).min),
                    Child::Instance(_) => node.child_box(slot),
                };
                tree.stored += half_area(&node.child_box(slot));
                boxes[index] = boxes[index].union(bounds);
            }
            tree.nodes += half_area(&boxes[index]);
        }
        tree.node_count += boxes.len();
        roots.push(boxes[0]);
    }
    let root = half_area(roots.last().expect("a map has a brick"));
    tree.stored += root;
    for sum in [&mut tree.nodes, &mut tree.leaves, &mut tree.stored] {
        *sum /= root;
    }
    tree
}

impl Tree {
    fn add_leaf(&mut self, bytes: &[u8], corner: IVec3) -> LatticeBox {
        let layout = Layout::read_trusted(bytes, corner);
        let faces = (0..layout.faces).map(|face| layout.face(bytes, face).bounds());
        let bounds = faces.fold(LatticeBox::EMPTY, |bounds, face| {
            self.face_boxes.push(face);
            bounds.union(face)
        });
        self.leaves += half_area(&bounds);
        self.leaf_boxes.push(bounds);
        bounds
    }
}
