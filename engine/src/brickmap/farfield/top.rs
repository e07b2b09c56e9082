//! The far field of the tree over partitions and copies of prototypes.
//!
//! A partition's record is its root's. A copy's is fitted to its prototype's lines, turned and stretched with it: a line through
//! the world box loses what one through the prototype's box loses, as often as it meets the turned box. A copy of a sheet must be
//! opened. Nodes over partitions are always opened: a batch that is far enough away from them is rare, and they are few. Nodes
//! over copies alone stand for all of them, as if those lay independently of each other.

use glam::{DMat3, Vec3};

use super::super::bvh::{WideChild, WideTree};
use super::super::pack::{Content, Primitive, Top};
use super::Root;
use super::lines::{Directions, LINES_MAX};
use super::moments::Moments;
use crate::brick::node::Node;
use crate::brick::{LatticeBox, far};

/// How much the nearest of the prototype's lines count for a copy's: a power of the cosine.
const SHARPNESS: u32 = 8;

/// Fills the nodes.
pub fn fill(tree: &WideTree, primitives: &[Primitive], top: &Top<'_>, nodes: &mut [Node]) {
    // Children come after their parents
    let mut sums: Vec<Option<Root>> = vec![None; tree.nodes.len()];
    for (index, wide) in tree.nodes.iter().enumerate().rev() {
        let (mut children, mut is_over_copies) = (Vec::new(), true);
        for (slot, child) in wide.children[..usize::from(wide.count)].iter().enumerate() {
            let own = match *child {
                WideChild::Node(child) => sums[child as usize],
                WideChild::Primitive(primitive) => match primitives[primitive as usize].content {
                    Content::Instance(copy) => {
                        let placed = &top.placed[copy as usize];
                        let prototype = &top.prototypes[placed.prototype as usize];
                        let bounds = &primitives[primitive as usize].bounds;
                        Some(prototype.placed(&placed.linear.inverse(), bounds))
                    }
                    _ => {
                        is_over_copies = false;
                        Some(top.roots[primitive as usize])
                    }
                },
            };
            let node = &mut nodes[index];
            node.far[slot] = match &own {
                Some(own) => own.record(&node.child_box(slot)),
                None => far::marked([0; 6]),
            };
            is_over_copies &= own.is_some();
            children.extend(own);
        }
        sums[index] = is_over_copies.then(|| Root::of(&children));
    }
}

impl Root {
    /// A copy of it under a map whose linear part is `map_from_prototype`, in the box `bounds` of the map's lattice.
    fn placed(&self, map_from_prototype: &DMat3, bounds: &LatticeBox) -> Self {
        let size: [f64; 3] = std::array::from_fn(|axis| f64::from(self.high[axis] - self.low[axis]));
        let [x, y, z] = [0, 1, 2].map(|axis| map_from_prototype.col(axis) * size[axis]);
        let faces = [y.cross(z), z.cross(x), x.cross(y)].map(|face| face.as_vec3());
        let prototype_from_map = map_from_prototype.inverse();
        let lost = |line: usize| {
            let direction = direction(line);
            let own = (prototype_from_map * direction.as_dvec3()).normalize_or_zero().as_vec3();
            let turned: f32 = faces.iter().map(|face| face.dot(direction).abs()).sum();
            let whole = shown(bounds, direction);
            let share = if whole > 0.0 { (turned / whole).min(1.0) } else { 1.0 };
            self.lost_along(own) * share
        };
        Self {
            moments: self.moments.placed(map_from_prototype),
            low: bounds.min.to_array(),
            high: bounds.max.to_array(),
            lost: std::array::from_fn(|row| std::array::from_fn(|lane| lost(16 * row + lane))),
            plate: None,
            must_open: self.must_open || self.plate.is_some(),
        }
    }

    /// What a line along `direction`, either way, loses: the mean of those that run about the same way.
    fn lost_along(&self, direction: Vec3) -> f32 {
        let (mut sum, mut weights) = (0.0, 0.0);
        for (line, lost) in self.lost.as_flattened().iter().enumerate() {
            let cosine = self::direction(line).dot(direction);
            let weight = (0..SHARPNESS).fold(1.0, |power: f32, _| power * (cosine * cosine));
            (sum, weights) = (sum + weight * lost, weights + weight);
        }
        if weights > 0.0 { sum / weights } else { 0.0 }
    }

    /// All of several, as if they lay independently of each other.
    pub fn of(parts: &[Self]) -> Self {
        let mut all = LatticeBox::EMPTY;
        let mut moments = Moments::default();
        for part in parts {
            all = all.union(part.bounds());
            moments.add(&part.moments);
        }
        let lost = |line: usize| {
            let whole = shown(&all, direction(line));
            let passed = parts.iter().fold(1.0, |passed: f32, part| {
                let own = shown(&part.bounds(), direction(line));
                let share = if whole > 0.0 { (own / whole).min(1.0) } else { 1.0 };
                passed * (1.0 - part.lost[line / 16][line % 16] * share)
            });
            1.0 - passed
        };
        Self {
            moments,
            low: all.min.to_array(),
            high: all.max.to_array(),
            lost: std::array::from_fn(|row| std::array::from_fn(|lane| lost(16 * row + lane))),
            plate: None,
            must_open: parts.iter().any(|part| part.must_open || part.plate.is_some()),
        }
    }

    fn bounds(&self) -> LatticeBox {
        LatticeBox { min: self.low.into(), max: self.high.into() }
    }
}

impl Moments {
    /// The sums under a linear map. Exact for similarities.
    fn placed(&self, linear: &DMat3) -> Self {
        // Areas with their normals turn by the cofactors
        let cofactors = (linear.inverse().transpose() * linear.determinant().abs()).as_mat3();
        let [xx, yy, zz, xy, yz, xz] = self.facing;
        let facing =
            glam::Mat3::from_cols(Vec3::new(xx, xy, xz), Vec3::new(xy, yy, yz), Vec3::new(xz, yz, zz));
        let turned = cofactors * facing * cofactors.transpose();
        let trace = turned.x_axis.x + turned.y_axis.y + turned.z_axis.z;
        let area = (trace.max(0.0) * self.area).sqrt();
        let scale = if trace > 0.0 { area / trace } else { 0.0 };
        let [x, y, z] = [turned.x_axis, turned.y_axis, turned.z_axis];
        Self { area, facing: [x.x, y.y, z.z, x.y, y.z, x.z].map(|sum| sum * scale), ..*self }
    }
}

fn direction(line: usize) -> Vec3 {
    const { assert!(LINES_MAX == 64) };
    let [x, y, z] = &Directions::many().along;
    Vec3::new(x[line], y[line], z[line])
}

/// The area that a box shows to a direction.
fn shown(bounds: &LatticeBox, direction: Vec3) -> f32 {
    let size = (bounds.max - bounds.min).as_vec3();
    Vec3::new(size.y * size.z, size.z * size.x, size.x * size.y).dot(direction.abs())
}
