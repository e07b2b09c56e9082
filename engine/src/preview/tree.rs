//! Points spread over an octree: a node keeps the first of its points in the order of their hashes, which is a fair sample
//! of all, and leaves the rest to its children. So a node and those above it show its cube, coarsely or finely.

use std::collections::{HashSet, VecDeque};

use glam::{UVec3, Vec3};

use super::NODE_BYTES_MAX;
use super::file::{Header, Node};
use super::sample::Points;

/// Levels at most: below that, points that share a place are left out.
const LEVELS_MAX: u8 = 20;
/// Cells along an edge of a node's cube in which its area is counted.
const CELLS: u32 = 32;
/// Points of which a node's area is counted at most.
const COUNTED_MAX: usize = 65_536;

/// A node and its points.
#[derive(Debug)]
pub(super) struct Spread {
    /// What the directory says.
    pub node: Node,
    /// The cube's lower corner, relative to the points' corner.
    pub corner: Vec3,
    /// The cube's edge.
    pub edge: f32,
    /// Its points.
    pub points: Vec<u32>,
}

/// A node to be.
struct Pending {
    corner: Vec3,
    edge: f32,
    level: u8,
    /// Points of nodes above in this cube.
    above: Vec<u32>,
    /// Points of it and of what is below, by rising hash.
    points: Vec<u32>,
    /// The node above, by number, and which of its children this is.
    parent: Option<(usize, u8)>,
}

/// Makes the nodes, level by level, and says in the header where the cube is.
pub(super) fn spread(points: &Points, header: &mut Header) -> Vec<Spread> {
    let (min, max) = points
        .positions
        .iter()
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(min, max), &p| (min.min(p), max.max(p)));
    // A cube of no size has no places in it
    let edge = (max - min).max_element().max(1e-6 * max.abs().max_element()).max(f32::MIN_POSITIVE);
    header.corner = points.corner + min.as_dvec3();
    header.edge = f64::from(edge);
    let mut order: Vec<u32> = (0..points.positions.len() as u32).collect();
    order.sort_unstable_by_key(|&point| (points.hashes[point as usize], point));
    let capacity = NODE_BYTES_MAX / header.record_bytes();
    let mut nodes: Vec<Spread> = Vec::new();
    let root = Pending { corner: min, edge, level: 0, above: Vec::new(), points: order, parent: None };
    let mut queue = VecDeque::from([root]);
    while let Some(mut pending) = queue.pop_front() {
        let number = nodes.len();
        if let Some((parent, child)) = pending.parent {
            nodes[parent].node.children |= 1 << child;
        }
        let spacing = spacing(points, &pending, capacity);
        let rest = pending.points.split_off(capacity.min(pending.points.len()));
        header.points += pending.points.len() as u64;
        let node =
            Node { points: pending.points.len() as u32, spacing, level: pending.level, ..Node::default() };
        if pending.level < LEVELS_MAX && !rest.is_empty() {
            queue.extend(children(points, &pending, rest, number));
        }
        let Pending { corner, edge, points, .. } = pending;
        nodes.push(Spread { node, corner, edge, points });
    }
    nodes
}

/// The children of a node that have points.
fn children(points: &Points, node: &Pending, rest: Vec<u32>, parent: usize) -> Vec<Pending> {
    let half = 0.5 * node.edge;
    let middle = node.corner + half;
    let octant = |point: u32| {
        let p = points.positions[point as usize];
        usize::from(p.x >= middle.x) | usize::from(p.y >= middle.y) << 1 | usize::from(p.z >= middle.z) << 2
    };
    let child = |octant: usize| Pending {
        corner: node.corner
            + half * Vec3::from_array(std::array::from_fn(|axis| (octant >> axis & 1) as f32)),
        edge: half,
        level: node.level + 1,
        above: Vec::new(),
        points: Vec::new(),
        parent: Some((parent, octant as u8)),
    };
    let mut children: Vec<Pending> = (0..8).map(child).collect();
    for point in rest {
        children[octant(point)].points.push(point);
    }
    for &point in node.above.iter().chain(&node.points) {
        children[octant(point)].above.push(point);
    }
    children.retain(|child| !child.points.is_empty());
    children
}

/// How far apart a node's points and those above lie in its cube: their share of the area, which is that of the cells that
/// hold any.
fn spacing(points: &Points, pending: &Pending, capacity: usize) -> f32 {
    let scale = CELLS as f32 / pending.edge;
    let cell = |point: u32| {
        let at = (points.positions[point as usize] - pending.corner) * scale;
        let at = at.max(Vec3::ZERO).as_uvec3().min(UVec3::splat(CELLS - 1));
        (at.z * CELLS + at.y) * CELLS + at.x
    };
    let all = pending.above.iter().chain(&pending.points).take(COUNTED_MAX);
    let cells = all.map(|&point| cell(point)).collect::<HashSet<u32>>().len();
    let shown = pending.above.len() + pending.points.len().min(capacity);
    pending.edge / CELLS as f32 * (cells as f32 / shown.max(1) as f32).sqrt()
}
