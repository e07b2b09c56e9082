//! Trees over boxes: a binary tree by the surface area heuristic, collapsed to eight-wide nodes of the least cost.
//!
//! Binned SAH (Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies", 2007), with every split tried where
//! few boxes are left; the collapse is the dynamic program of Ylitie, Karras and Laine, "Efficient Incoherent Ray
//! Traversal on GPUs Through Compressed Wide BVHs", 2017, section 3. A leaf costs as much as a node.

use glam::Vec4;

use super::bucket::longest_axis;
use crate::brick::LatticeBox;
use crate::brick::node::WIDTH;

const BINS: usize = 16;

/// Up to this many boxes, every split along every axis is tried.
const SWEEP_MAX: usize = 8;

/// Below this depth, halves are split by count: a tree over boxes of wildly different sizes stays shallow.
const SAH_DEPTH_MAX: u32 = 48;

/// A child of a wide node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WideChild {
    /// A node, by index.
    Node(u32),
    /// A primitive, by index.
    Primitive(u32),
}

/// An eight-wide node. Children are in the order of the tree.
#[derive(Clone, Copy, Debug)]
pub struct WideNode {
    /// Its children; only the first `count` are used.
    pub children: [WideChild; WIDTH],
    /// How many.
    pub count: u8,
}

/// A tree of wide nodes; node 0 is the root, children come after their parents. Keeps its memory for the next one.
#[derive(Debug, Default)]
pub struct WideTree {
    /// The nodes.
    pub nodes: Vec<WideNode>,
    references: Vec<Reference>,
    binary: Vec<Binary>,
    plans: Vec<Plan>,
}

/// A node of the binary tree. Children are neighbours and come after their parents.
#[derive(Clone, Copy, Debug)]
struct Binary {
    half_area: f32,
    /// First child, or the primitive.
    child: u32,
    is_leaf: bool,
}

/// A primitive on its way into the tree: the corners of its box, its number in the bits of `low.w`.
#[derive(Clone, Copy, Debug)]
struct Reference {
    low: Vec4,
    high: Vec4,
}

impl Reference {
    /// Twice the middle; `w` means nothing.
    #[inline(always)]
    fn center(&self) -> Vec4 {
        self.low + self.high
    }
}

/// A box that grows; `w` means nothing.
#[derive(Clone, Copy, Debug)]
struct Extent {
    low: Vec4,
    high: Vec4,
}

impl Extent {
    const EMPTY: Self = Self { low: Vec4::INFINITY, high: Vec4::NEG_INFINITY };

    #[inline(always)]
    fn add(&mut self, other: &Reference) {
        self.low = self.low.min(other.low);
        self.high = self.high.max(other.high);
    }

    #[inline(always)]
    fn add_point(&mut self, point: Vec4) {
        self.low = self.low.min(point);
        self.high = self.high.max(point);
    }

    #[inline(always)]
    fn union(self, other: Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    #[inline(always)]
    fn half_area(&self) -> f32 {
        let size = self.high - self.low;
        size.x * size.y + size.y * size.z + size.z * size.x
    }
}

impl WideTree {
    /// Builds the tree over boxes; there must be at least one.
    pub fn build(&mut self, boxes: impl ExactSizeIterator<Item = LatticeBox>) {
        self.build_binary(boxes);
        self.plan();
        self.emit();
    }

    fn build_binary(&mut self, boxes: impl ExactSizeIterator<Item = LatticeBox>) {
        let Self { references, binary, .. } = self;
        references.clear();
        references.extend(boxes.enumerate().map(|(i, b)| Reference {
            low: b.min.as_vec3().extend(f32::from_bits(i as u32)),
            high: b.max.as_vec3().extend(0.0),
        }));
        let empty = Binary { half_area: 0.0, child: 0, is_leaf: false };
        binary.clear();
        binary.reserve(2 * references.len());
        binary.push(empty);
        let mut stack = vec![(0_usize, 0..references.len(), 0_u32)];
        while let Some((node, range, depth)) = stack.pop() {
            let part = &mut references[range.clone()];
            let (mut extent, mut centers) = (Extent::EMPTY, Extent::EMPTY);
            for reference in part.iter() {
                extent.add(reference);
                centers.add_point(reference.center());
            }
            let half_area = extent.half_area();
            if part.len() == 1 {
                binary[node] = Binary { half_area, child: part[0].low.w.to_bits(), is_leaf: true };
                continue;
            }
            let child = binary.len();
            binary[node] = Binary { half_area, child: child as u32, is_leaf: false };
            binary.extend([empty; 2]);
            let middle = range.start
                + match part.len() {
                    2 => 1,
                    _ if depth >= SAH_DEPTH_MAX => split_halves(part, &centers),
                    3..=SWEEP_MAX => split_by_sweep(part),
                    _ => split_by_bins(part, &centers),
                };
            stack.push((child + 1, middle..range.end, depth + 1));
            stack.push((child, range.start..middle, depth + 1));
        }
    }

    /// Finds the cheapest ways to put every binary subtree into slots of wide nodes.
    fn plan(&mut self) {
        let Self { binary, plans, .. } = self;
        plans.clear();
        plans.resize(binary.len(), Plan { cost: [0.0; WIDTH - 1], left: [0; WIDTH - 1], node_left: 0 });
        // Children come after their parents: backwards is bottom up
        for index in (0..binary.len()).rev() {
            let node = &binary[index];
            if node.is_leaf {
                plans[index].cost = [node.half_area; WIDTH - 1];
                continue;
            }
            let (left, right) = (plans[node.child as usize].cost, plans[node.child as usize + 1].cost);
            let distribute = |slots: usize| {
                let mut best = (f32::INFINITY, 0);
                for k in slots.saturating_sub(WIDTH - 1).max(1)..slots.min(WIDTH) {
                    let cost = left[k - 1] + right[slots - k - 1];
                    if cost < best.0 {
                        best = (cost, k as u8);
                    }
                }
                best
            };
            let plan = &mut plans[index];
            let (inside, node_left) = distribute(WIDTH);
            plan.node_left = node_left;
            plan.cost[0] = node.half_area + inside;
            for slots in 2..WIDTH {
                let (cost, k) = distribute(slots);
                let fewer = plan.cost[slots - 2];
                (plan.cost[slots - 1], plan.left[slots - 1]) =
                    if cost < fewer { (cost, k) } else { (fewer, 0) };
            }
        }
    }

    /// Makes the wide nodes of the plan, top down.
    fn emit(&mut self) {
        let Self { nodes, binary, plans, .. } = self;
        let unused = WideNode { children: [WideChild::Primitive(u32::MAX); WIDTH], count: 0 };
        nodes.clear();
        nodes.push(unused);
        let mut queue = std::collections::VecDeque::from([(0_u32, 0_u32)]);
        // Subtrees with the slots they may take, leftmost on top
        let mut pending = Vec::with_capacity(WIDTH);
        while let Some((from, to)) = queue.pop_front() {
            let mut wide = unused;
            if binary[from as usize].is_leaf {
                pending.push((from, 1));
            } else {
                let child = binary[from as usize].child;
                let left = usize::from(plans[from as usize].node_left);
                pending.extend([(child + 1, WIDTH - left), (child, left)]);
            }
            while let Some((index, slots)) = pending.pop() {
                let (node, plan) = (&binary[index as usize], &plans[index as usize]);
                // Fewer slots may do
                let mut slots = slots.min(WIDTH - 1);
                while slots > 1 && plan.left[slots - 1] == 0 {
                    slots -= 1;
                }
                if !node.is_leaf && slots > 1 {
                    let left = usize::from(plan.left[slots - 1]);
                    pending.extend([(node.child + 1, slots - left), (node.child, left)]);
                    continue;
                }
                wide.children[usize::from(wide.count)] = if node.is_leaf {
                    WideChild::Primitive(node.child)
                } else {
                    let number = nodes.len() as u32;
                    nodes.push(unused);
                    queue.push_back((index, number));
                    WideChild::Node(number)
                };
                wide.count += 1;
            }
            nodes[to as usize] = wide;
        }
    }
}

/// The cheapest ways to put a binary subtree into 1 to 7 slots of a wide node.
#[derive(Clone, Copy, Debug)]
struct Plan {
    /// Cost with at most `i + 1` slots.
    cost: [f32; WIDTH - 1],
    /// Slots that go to the left child with `i + 1` slots; 0 if fewer slots are as good.
    left: [u8; WIDTH - 1],
    /// Slots of the left child when the subtree becomes a node of its own.
    node_left: u8,
}

/// Splits by count along the longest axis of the centers. Puts the left half in front and returns its length, at least one
/// and less than all, as the other splits do.
fn split_halves(part: &mut [Reference], centers: &Extent) -> usize {
    let axis = longest_axis((centers.high - centers.low).truncate().to_array());
    let middle = part.len() / 2;
    part.select_nth_unstable_by(middle, |a, b| {
        let key = |r: &Reference| (r.center()[axis], r.low.w.to_bits());
        key(a).partial_cmp(&key(b)).expect("lattice coordinates are numbers")
    });
    middle
}

/// Tries every split along every axis.
fn split_by_sweep(part: &mut [Reference]) -> usize {
    let count = part.len();
    let sort = |part: &mut [Reference], axis: usize| {
        // Insertion: eight at most
        for i in 1..count {
            let (moved, key) = (part[i], part[i].center()[axis]);
            let mut at = i;
            while at > 0 && part[at - 1].center()[axis] > key {
                part[at] = part[at - 1];
                at -= 1;
            }
            part[at] = moved;
        }
    };
    let mut best = (f32::INFINITY, 0, 0);
    for axis in 0..3 {
        sort(part, axis);
        let mut right = [0.0; SWEEP_MAX];
        let mut extent = Extent::EMPTY;
        for i in (1..count).rev() {
            extent.add(&part[i]);
            right[i] = extent.half_area() * (count - i) as f32;
        }
        let mut extent = Extent::EMPTY;
        for left in 1..count {
            extent.add(&part[left - 1]);
            let cost = extent.half_area() * left as f32 + right[left];
            if cost < best.0 {
                best = (cost, axis, left);
            }
        }
    }
    let (_, axis, left) = best;
    if axis != 2 {
        sort(part, axis);
    }
    left.max(1)
}

/// Splits between two of sixteen bins.
fn split_by_bins(part: &mut [Reference], centers: &Extent) -> usize {
    let size = centers.high - centers.low;
    // A little less than all bins, so that the highest center is in the last one
    let scale =
        Vec4::from_array(size.to_array().map(|s| if s > 0.0 { BINS as f32 * 0.999_99 / s } else { 0.0 }));
    let bins_of = |r: &Reference| {
        let bins = (r.center() - centers.low) * scale;
        [bins.x, bins.y, bins.z].map(|bin| (bin as i32 as usize).min(BINS - 1))
    };
    let mut counts = [[0_u32; BINS]; 3];
    let mut extents = [[Extent::EMPTY; BINS]; 3];
    for reference in part.iter() {
        let bins = bins_of(reference);
        for axis in 0..3 {
            counts[axis][bins[axis]] += 1;
            extents[axis][bins[axis]].add(reference);
        }
    }
    let mut best = (f32::INFINITY, 0, 0);
    for axis in 0..3 {
        if size[axis] > 0.0 {
            let (cost, bin) = best_bin(&counts[axis], &extents[axis]);
            if cost < best.0 {
                best = (cost, axis, bin);
            }
        }
    }
    let (cost, axis, bin) = best;
    if cost.is_finite() {
        let middle = partition(part, |r| bins_of(r)[axis] <= bin);
        if 0 < middle && middle < part.len() {
            return middle;
        }
    }
    // All in one place: halves keep the tree's depth logarithmic
    split_halves(part, centers)
}

/// The bin after which to split along an axis, and what that costs.
fn best_bin(counts: &[u32; BINS], extents: &[Extent; BINS]) -> (f32, usize) {
    let mut right = [f32::INFINITY; BINS];
    let (mut count, mut all) = (0, Extent::EMPTY);
    for bin in (1..BINS).rev() {
        count += counts[bin];
        all = all.union(extents[bin]);
        if count > 0 {
            right[bin] = count as f32 * all.half_area();
        }
    }
    let mut best = (f32::INFINITY, 0);
    (count, all) = (0, Extent::EMPTY);
    for bin in 0..BINS - 1 {
        count += counts[bin];
        all = all.union(extents[bin]);
        if count > 0 {
            let cost = count as f32 * all.half_area() + right[bin + 1];
            if cost < best.0 {
                best = (cost, bin);
            }
        }
    }
    best
}

/// Puts those for which `left` holds in front, keeps no order, and returns how many they are.
fn partition(part: &mut [Reference], left: impl Fn(&Reference) -> bool) -> usize {
    let (mut front, mut back) = (0, part.len());
    loop {
        while front < back && left(&part[front]) {
            front += 1;
        }
        while front < back && !left(&part[back - 1]) {
            back -= 1;
        }
        if front >= back {
            return front;
        }
        part.swap(front, back - 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::hash::hash32;
    use glam::IVec3;

    fn random_boxes(count: u32, spread: u32) -> Vec<LatticeBox> {
        let random = |i: u32| (hash32(i) % spread) as i32;
        (0..count)
            .map(|i| {
                let min = IVec3::new(random(6 * i), random(6 * i + 1), random(6 * i + 2));
                LatticeBox {
                    min,
                    max: min + IVec3::new(random(6 * i + 3), random(6 * i + 4), random(6 * i + 5)) / 50,
                }
            })
            .collect()
    }

    /// Catches a primitive that is lost or doubled, whatever the number and however degenerate the boxes.
    #[test]
    fn every_primitive_is_in_the_tree_once() {
        let mut tree = WideTree::default();
        for (count, spread) in [(1, 100), (2, 100), (9, 100), (1000, 10_000), (5000, 1), (3000, 3)] {
            tree.build(random_boxes(count, spread).into_iter());
            let mut seen = vec![0; count as usize];
            let mut parents = vec![0; tree.nodes.len()];
            for (index, node) in tree.nodes.iter().enumerate() {
                for child in &node.children[..usize::from(node.count)] {
                    match *child {
                        WideChild::Primitive(primitive) => seen[primitive as usize] += 1,
                        WideChild::Node(child) => {
                            assert!(child as usize > index);
                            parents[child as usize] += 1;
                        }
                    }
                }
            }
            assert!(seen.iter().all(|&n| n == 1), "{count} {spread}");
            assert!(parents[1..].iter().all(|&n| n == 1));
        }
    }

    /// Catches a collapse that leaves nodes half empty.
    #[test]
    fn nodes_are_well_filled() {
        let mut tree = WideTree::default();
        tree.build(random_boxes(20_000, 100_000).into_iter());
        let children: usize = tree.nodes.iter().map(|node| usize::from(node.count)).sum();
        let fill = children as f64 / tree.nodes.len() as f64;
        // Greedy collapse was measured to reach 4.3
        assert!(fill > 4.6, "{fill} children a node");
    }

    /// Catches a tree that is as deep as it has boxes when every box is twice as large as the one before.
    #[test]
    fn depth_is_bounded() {
        let boxes = (0..3000).map(|i| {
            let min = IVec3::new(1 << (i % 29), i, 0);
            LatticeBox { min, max: min + (1 << (i % 28)) }
        });
        let mut tree = WideTree::default();
        tree.build(boxes);
        let mut depths = vec![0; tree.nodes.len()];
        for (index, node) in tree.nodes.iter().enumerate() {
            for child in &node.children[..usize::from(node.count)] {
                if let WideChild::Node(child) = *child {
                    depths[child as usize] = depths[index] + 1;
                }
            }
        }
        assert!(depths.iter().all(|&depth| depth <= 60));
    }
}
