//! A partition's far field: every child of every node, top down.
//!
//! A child's own lines say how opaque it is; where it is a layer rather than a heap, the same lines among its neighbours say
//! whether it is a sheet without gaps (then it is an opaque plate, and so are its children), or whether what it lets through
//! is blocked by others (then it must be opened: a miss of one box is not independent of the hit in the next).

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::super::bvh::{WideChild, WideNode};
use super::fit;
use super::kernel::{Boxes, Kernel, slab};
use super::lines::{Column, Directions, LINES_MAX, Lines};
use super::moments::Moments;
use super::shapes::Shapes;
use super::shoot::{Grove, Hits, Shooter};
use crate::brick::LatticeBox;
use crate::brick::far::{self, Plate, Record};
use crate::brick::node::{Node, WIDTH};

/// A child is a layer, not a heap, if its lines are blocked at least this often for its area.
const LAYER_MIN: f32 = 0.6;
/// A sheet is thinner than this share of its box's diagonal.
const SHEET_THICKNESS_MAX: f32 = 0.3;
/// A piece of a sheet is a plate if it is thinner than this share of its box's diagonal.
const PIECE_THICKNESS_MAX: f32 = 0.5;
/// The share of lines through a sheet that something blocks.
const SHEET_BLOCKED_MIN: f32 = 0.97;
/// How far beyond the plate neighbours count, as a share of the box's diagonal.
const MARGIN: f32 = 0.05;
/// The share of lines that something blocks from which a child must be opened, if it is not the child itself that blocks them.
const BLOCKED_MIN: f32 = 0.5;
/// What others may block before that matters.
const BLOCKED_BY_OTHERS_MAX: f32 = 0.05;
/// Lines that must meet a plate to judge it.
const JUDGES_MIN: u32 = 12;
/// Below this share of n n' along the normal, geometry has no side that a plate could lie in.
const FLAT_MIN: f32 = 0.6;

/// What surrounds a partition: boxes of the geometry of others. A line that leaves no hit there may meet something that is not
/// in memory: it says neither that a sheet has a gap nor that it has none.
pub type Others<'a> = &'a [LatticeBox];

/// A partition's root as a child: what a tree over partitions needs of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Root {
    /// Sums over all its faces.
    pub moments: Moments,
    /// Its box, which the lines were shot through.
    pub(super) low: [i32; 3],
    pub(super) high: [i32; 3],
    /// What each of [`Directions::many`] lost, 0 to 1.
    pub(super) lost: [[f32; 16]; 4],
    /// A plate for all of it, if it is a sheet: the normal's code, and the range along it from the box's centre.
    pub(super) plate: Option<([i8; 2], f32, f32)>,
    /// Whether it must be opened.
    pub(super) must_open: bool,
}

/// What a node passes on to its children.
#[derive(Clone, Copy, Debug)]
struct Heritage {
    /// Whether they are pieces of a sheet.
    is_sheet: bool,
    /// The share of lines through it that something blocks; 0 where that does not matter.
    blocked: f32,
}

/// A node to fill.
#[derive(Clone, Copy, Debug)]
struct Task {
    node: u32,
    heritage: Heritage,
    /// Its neighbours: a range of the list.
    first: usize,
    end: usize,
}

/// A subtree near a node.
#[derive(Clone, Copy, Debug)]
struct Neighbour {
    target: WideChild,
    bounds: LatticeBox,
}

/// The far field of all children, in the order of the nodes, and of the root itself.
///
/// # Safety
/// The instruction set of `K` is available.
#[inline(always)]
pub unsafe fn fill<K: Kernel>(
    tree: &[WideNode],
    nodes: &[Node],
    shapes: &Shapes,
    others: Others<'_>,
) -> (Vec<[Record; WIDTH]>, Root) {
    let grove = Grove { tree, nodes, shapes };
    // A loop, since an iterator's would not have the instruction set
    let mut leaf_moments = Vec::with_capacity(shapes.len());
    for leaf in 0..shapes.len() as u32 {
        // SAFETY: the caller's
        leaf_moments.push(unsafe { Moments::of::<K>(shapes, shapes.shape(leaf)) });
    }
    let mut filler = Filler {
        grove,
        others,
        node_moments: sum_up(tree, &leaf_moments),
        leaf_moments,
        records: vec![[[0; 6]; WIDTH]; tree.len()],
        neighbours: Vec::new(),
        tasks: Vec::new(),
        shooter: Shooter::new(),
        lines: Lines::new(Directions::few()),
        covered: [0.0; LINES_MAX],
        lost: [0.0; LINES_MAX],
        slab: [[0.0; LINES_MAX]; 2],
    };
    let heritage = Heritage { is_sheet: false, blocked: 0.0 };
    filler.tasks.push(Task { node: 0, heritage, first: 0, end: 0 });
    while let Some(task) = filler.tasks.pop() {
        // SAFETY: the caller's
        unsafe { filler.node::<K>(task) };
    }
    // SAFETY: the caller's
    let root = unsafe { filler.root::<K>() };
    (filler.records, root)
}

/// The sums of all nodes; children come after their parents.
fn sum_up(tree: &[WideNode], leaves: &[Moments]) -> Vec<Moments> {
    let mut nodes = vec![Moments::default(); tree.len()];
    for (index, node) in tree.iter().enumerate().rev() {
        let mut sum = Moments::default();
        for child in &node.children[..usize::from(node.count)] {
            match *child {
                WideChild::Node(child) => sum.add(&nodes[child as usize]),
                WideChild::Primitive(leaf) => sum.add(&leaves[leaf as usize]),
            }
        }
        nodes[index] = sum;
    }
    nodes
}

/// At work on a partition.
struct Filler<'a> {
    grove: Grove<'a>,
    others: Others<'a>,
    node_moments: Vec<Moments>,
    leaf_moments: Vec<Moments>,
    records: Vec<[Record; WIDTH]>,
    /// Lists of neighbours; those of a task lie above those of the tasks before it.
    neighbours: Vec<Neighbour>,
    tasks: Vec<Task>,
    shooter: Shooter,
    lines: Lines<'static>,
    covered: Column,
    lost: Column,
    slab: [Column; 2],
}

/// What a child turned out to be.
struct Verdict {
    record: Record,
    heritage: Heritage,
}

impl Filler<'_> {
    /// Fills the children of a node and puts those that are nodes on the list of tasks.
    #[inline(always)]
    unsafe fn node<K: Kernel>(&mut self, task: Task) {
        self.neighbours.truncate(task.end);
        let wide = self.grove.tree[task.node as usize];
        let boxes = self.grove.nodes[task.node as usize];
        for slot in 0..usize::from(wide.count) {
            let (target, bounds) = (wide.children[slot], boxes.child_box(slot));
            let first = self.neighbours.len();
            if !task.heritage.is_sheet {
                self.gather(task, slot, &bounds);
            }
            let end = self.neighbours.len();
            // SAFETY: the caller's
            let verdict = unsafe { self.child::<K>(target, &bounds, task.heritage, first..end) };
            self.records[task.node as usize][slot] = verdict.record;
            match target {
                WideChild::Node(node) => {
                    self.tasks.push(Task { node, heritage: verdict.heritage, first, end });
                }
                WideChild::Primitive(_) => self.neighbours.truncate(first),
            }
        }
    }

    /// Lists the subtrees near a child that are no larger than it, or leaves.
    fn gather(&mut self, task: Task, slot: usize, bounds: &LatticeBox) {
        if matches!(self.grove.tree[task.node as usize].children[slot], WideChild::Primitive(_)) {
            return;
        }
        let size = (bounds.max - bounds.min).as_vec3();
        let margin = (MARGIN * size.length()).ceil() as i32 + 1;
        let reach = LatticeBox { min: bounds.min - margin, max: bounds.max + margin };
        let start = self.neighbours.len();
        for i in task.first..task.end {
            let neighbour = self.neighbours[i];
            if neighbour.bounds.touches(&reach) {
                self.neighbours.push(neighbour);
            }
        }
        let wide = self.grove.tree[task.node as usize];
        let boxes = self.grove.nodes[task.node as usize];
        for other in (0..usize::from(wide.count)).filter(|&other| other != slot) {
            let near = boxes.child_box(other);
            if near.touches(&reach) {
                self.neighbours.push(Neighbour { target: wide.children[other], bounds: near });
            }
        }
        // Open what is larger than the child
        let area = half_area(size);
        let mut at = start;
        while at < self.neighbours.len() {
            let Neighbour { target, bounds } = self.neighbours[at];
            let WideChild::Node(node) = target else {
                at += 1;
                continue;
            };
            if half_area((bounds.max - bounds.min).as_vec3()) <= area {
                at += 1;
                continue;
            }
            self.neighbours.swap_remove(at);
            let (wide, boxes) = (&self.grove.tree[node as usize], &self.grove.nodes[node as usize]);
            for child in 0..usize::from(wide.count) {
                let near = boxes.child_box(child);
                if near.touches(&reach) {
                    self.neighbours.push(Neighbour { target: wide.children[child], bounds: near });
                }
            }
        }
    }

    /// The far field of one child with its decoded box, and what its own children inherit.
    #[inline(always)]
    unsafe fn child<K: Kernel>(
        &mut self,
        target: WideChild,
        bounds: &LatticeBox,
        heritage: Heritage,
        neighbours: std::ops::Range<usize>,
    ) -> Verdict {
        let (moments, is_leaf) = match target {
            WideChild::Node(node) => (self.node_moments[node as usize], false),
            WideChild::Primitive(leaf) => (self.leaf_moments[leaf as usize], true),
        };
        let half = (bounds.max - bounds.min).as_vec3() * 0.5;
        if heritage.is_sheet {
            let (record, thickness) = self.plate(target, bounds, &moments, half);
            let is_thin = thickness < PIECE_THICKNESS_MAX;
            return Verdict { record: if is_thin { record } else { far::marked(record) }, heritage };
        }

        // Shoot the child's own lines
        let directions = if is_leaf { Directions::few() } else { Directions::many() };
        self.lines.fill(bounds, directions, 0);
        let mut hits = Hits::NONE;
        // SAFETY: the caller's
        unsafe { self.shooter.shoot::<K, false>(self.grove, target, &self.lines, self.lines.all, &mut hits) };
        for i in 0..directions.count.min(LINES_MAX) {
            self.lost[i] = 1.0 - hits.passed[i];
        }
        fit::covered(&moments, &self.lines, &mut self.covered);
        let record = fit::fit(&moments, &self.lines, &self.covered, &self.lost);
        let own = hits.met.count_ones() as f32;
        if is_leaf {
            let share = own / directions.count as f32;
            let is_blocked =
                heritage.blocked >= BLOCKED_MIN && heritage.blocked - share > BLOCKED_BY_OTHERS_MAX;
            return Verdict { record: if is_blocked { far::marked(record) } else { record }, heritage };
        }

        // A layer is judged among its neighbours
        let covered = &self.covered;
        let expected = fit::sum(directions.count, |i| if covered[i] < 1.0 { covered[i] } else { 1.0 });
        let none = Heritage { is_sheet: false, blocked: 0.0 };
        if own < LAYER_MIN * expected {
            return Verdict { record, heritage: none };
        }
        let (plate, thickness) = self.plate(target, bounds, &moments, half);
        let judges = self.clip(&plate, bounds, half);
        let count = judges.count_ones();
        if count < JUDGES_MIN {
            return Verdict { record, heritage: none };
        }
        let mut missing = judges & !hits.met;
        // SAFETY: the caller's
        missing &= !unsafe { self.met_beside::<K>(neighbours, missing) };
        let unknown = self.unknown(missing, bounds);
        let (known, missing) =
            ((judges & !unknown).count_ones() as f32, (missing & !unknown).count_ones() as f32);
        if known < 0.5 * count as f32 {
            return Verdict { record: far::marked(record), heritage: none };
        }
        let own = (hits.met & judges).count_ones() as f32 / count as f32;
        let blocked = 1.0 - missing / known;
        let heritage = Heritage { is_sheet: false, blocked };
        if !moments.is_transparent && thickness < SHEET_THICKNESS_MAX && blocked >= SHEET_BLOCKED_MIN {
            return Verdict { record: plate, heritage: Heritage { is_sheet: true, blocked } };
        }
        let is_blocked = blocked >= BLOCKED_MIN && blocked - own > BLOCKED_BY_OTHERS_MAX;
        Verdict { record: if is_blocked { far::marked(record) } else { record }, heritage }
    }

    /// The lines of `missing` that meet one of the neighbours where hits count.
    #[inline(always)]
    unsafe fn met_beside<K: Kernel>(&mut self, neighbours: std::ops::Range<usize>, mut missing: u64) -> u64 {
        let (mut others, mut boxes, mut near) = (Hits::NONE, Boxes::default(), [0; WIDTH]);
        let mut first = neighbours.start;
        while first < neighbours.end && missing != 0 {
            // Most neighbours touch a corner only, which few lines pass
            let count = WIDTH.min(neighbours.end - first);
            for slot in 0..count {
                boxes.put(slot, &self.neighbours[first + slot].bounds, &self.lines);
            }
            // SAFETY: the caller's
            unsafe { K::meet_boxes::<true>(&boxes, &self.lines, missing, &mut near) };
            for slot in 0..count {
                let (target, mask) = (self.neighbours[first + slot].target, near[slot] & missing);
                if mask != 0 {
                    // SAFETY: the caller's
                    unsafe {
                        self.shooter.shoot::<K, true>(self.grove, target, &self.lines, mask, &mut others)
                    };
                    missing &= !others.met;
                }
            }
            first += count;
        }
        others.met
    }

    /// The lines of `missing` that pass the plate where other partitions have geometry.
    fn unknown(&self, missing: u64, bounds: &LatticeBox) -> u64 {
        if missing == 0 || !self.others.iter().any(|other| other.touches(bounds)) {
            return 0;
        }
        let (mut unknown, mut rest) = (0, missing);
        while rest != 0 {
            let line = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let middle = 0.5 * (self.lines.from[line] + self.lines.to[line]);
            let start = Vec3::from_array(self.lines.start.each_ref().map(|column| column[line]));
            let at = self.lines.center + (start + self.lines.direction(line) * middle).round().as_ivec3();
            let point = LatticeBox { min: at, max: at };
            unknown |= u64::from(self.others.iter().any(|other| other.touches(&point))) << line;
        }
        unknown
    }

    /// The root as a child of a tree over partitions. Nothing is known of its neighbours: what is a layer but no whole sheet
    /// must be opened.
    #[inline(always)]
    unsafe fn root<K: Kernel>(&mut self) -> Root {
        let boxes = &self.grove.nodes[0];
        let bounds = (0..usize::from(boxes.count))
            .fold(LatticeBox::EMPTY, |all, slot| all.union(boxes.child_box(slot)));
        let half = (bounds.max - bounds.min).as_vec3() * 0.5;
        let moments = self.node_moments[0];
        self.lines.fill(&bounds, Directions::many(), 0);
        let mut hits = Hits::NONE;
        let target = WideChild::Node(0);
        // SAFETY: the caller's
        unsafe { self.shooter.shoot::<K, false>(self.grove, target, &self.lines, self.lines.all, &mut hits) };
        fit::covered(&moments, &self.lines, &mut self.covered);
        let covered = &self.covered;
        let expected = fit::sum(LINES_MAX, |i| if covered[i] < 1.0 { covered[i] } else { 1.0 });
        let is_layer = hits.met.count_ones() as f32 >= LAYER_MIN * expected;
        let (record, thickness) = self.plate(target, &bounds, &moments, half);
        let judges = self.clip(&record, &bounds, half);
        let blocked = (judges & hits.met).count_ones() as f32 / judges.count_ones().max(1) as f32;
        let is_sheet = is_layer
            && !moments.is_transparent
            && thickness < SHEET_THICKNESS_MAX
            && blocked >= SHEET_BLOCKED_MIN;
        let plate = Plate::decode(&record, half);
        Root {
            moments,
            low: bounds.min.to_array(),
            high: bounds.max.to_array(),
            lost: std::array::from_fn(|i| std::array::from_fn(|lane| 1.0 - hits.passed[16 * i + lane])),
            plate: is_sheet.then_some(([record[0] as i8, record[1] as i8], plate.low, plate.high)),
            must_open: is_layer && !is_sheet && blocked >= BLOCKED_MIN,
        }
    }

    /// The plate that holds a child's faces, and its thickness as a share of the box's diagonal.
    #[inline(always)]
    fn plate(
        &mut self,
        target: WideChild,
        bounds: &LatticeBox,
        moments: &Moments,
        half: Vec3,
    ) -> (Record, f32) {
        let (normal, flatness) = moments.normal();
        let code = far::plate_code(normal);
        let coded = far::plate_normal(code).as_vec3();
        let reach = (coded.abs() * half).element_sum();
        let (low, high) =
            if flatness < FLAT_MIN { (-reach, reach) } else { self.range(target, bounds, coded) };
        let record = Plate::encode(code, low, high, half);
        let plate = Plate::decode(&record, half);
        let diagonal = 2.0 * half.length() * coded.length();
        (record, if diagonal > 0.0 { (plate.high - plate.low) / diagonal } else { 0.0 })
    }

    /// How far the faces below `target` reach along a normal from the box's centre.
    #[inline(always)]
    fn range(&mut self, target: WideChild, bounds: &LatticeBox, normal: Vec3) -> (f32, f32) {
        let corner = bounds.min;
        let (mut low, mut high) = ([f32::MAX; 16], [f32::MIN; 16]);
        let mut stack = vec![target];
        while let Some(target) = stack.pop() {
            match target {
                WideChild::Node(node) => {
                    let wide = &self.grove.tree[node as usize];
                    stack.extend_from_slice(&wide.children[..usize::from(wide.count)]);
                }
                WideChild::Primitive(leaf) => {
                    let shapes = self.grove.shapes;
                    let shape = shapes.shape(leaf);
                    let radius = shapes.special(shape).map_or(0.0, |special| {
                        special.radii.iter().fold(0.0, |largest: f32, &radius| largest.max(radius))
                            * normal.length()
                    });
                    let blocks = [shapes.block(shape), shapes.second_block(shape)];
                    for block in &blocks[..1 + usize::from(shape.is_large)] {
                        for lane in 0..16 {
                            let at = |axis: usize| block[axis][lane].wrapping_sub(corner[axis]) as f32;
                            let along = (normal.x * at(0) + normal.y * at(1)) + normal.z * at(2);
                            let (below, above) = (along - radius, along + radius);
                            low[lane] = if below < low[lane] { below } else { low[lane] };
                            high[lane] = if above > high[lane] { above } else { high[lane] };
                        }
                    }
                }
            }
        }
        let middle = normal.dot((bounds.max - bounds.min).as_vec3() * 0.5);
        let low = low.iter().fold(f32::MAX, |all, &x| if x < all { x } else { all });
        let high = high.iter().fold(f32::MIN, |all, &x| if x > all { x } else { all });
        (low - middle, high - middle)
    }

    /// Sets the part of every line that counts, the plate with a margin, and returns the lines that meet the plate in the box.
    #[inline(always)]
    fn clip(&mut self, plate: &Record, bounds: &LatticeBox, half: Vec3) -> u64 {
        let Plate { normal, low, high } = Plate::decode(plate, half);
        let margin = MARGIN * 2.0 * half.length();
        let corner = (bounds.min - self.lines.center).as_vec3();
        let middle = normal.dot(corner + half);
        slab(&self.lines, normal, middle, low, high, &mut self.slab);
        let mut judges = 0;
        for first in (0..LINES_MAX).step_by(16) {
            let mut bits = 0_u16;
            for lane in 0..16 {
                let i = first + lane;
                bits |= u16::from(self.slab[0][i] <= self.lines.leave[i] && self.slab[1][i] >= 0.0) << lane;
            }
            judges |= u64::from(bits) << first;
        }
        let wider = margin * normal.length();
        slab(&self.lines, normal, middle, low - wider, high + wider, &mut self.slab);
        for i in 0..LINES_MAX {
            let (from, to, leave) = (self.slab[0][i], self.slab[1][i], self.lines.leave[i] + margin);
            self.lines.from[i] = if from > -margin { from } else { -margin };
            self.lines.to[i] = if to < leave { to } else { leave };
        }
        judges
    }
}

impl Root {
    /// The record for a decoded box that holds the root's.
    pub fn record(&self, bounds: &LatticeBox) -> Record {
        let half = (bounds.max - bounds.min).as_vec3() * 0.5;
        let own = LatticeBox { min: self.low.into(), max: self.high.into() };
        if let Some((code, low, high)) = self.plate {
            let shift = ((own.min - bounds.min) + (own.max - bounds.max)).as_vec3() * 0.5;
            let along = far::plate_normal(code).as_vec3().dot(shift);
            return Plate::encode(code, low + along, high + along, half);
        }
        // What a line through the root's box loses, a line through the larger one loses as often as it meets the former
        let (mut lines, mut lost, mut covered) =
            (Lines::new(Directions::many()), [0.0; LINES_MAX], [0.0; LINES_MAX]);
        lines.fill(&own, Directions::many(), 0);
        let shown = lines.shown;
        lines.fill(bounds, Directions::many(), 0);
        for i in 0..LINES_MAX {
            let share = if lines.shown[i] > 0.0 { shown[i] / lines.shown[i] } else { 0.0 };
            lost[i] = self.lost[i / 16][i % 16] * share;
        }
        fit::covered(&self.moments, &lines, &mut covered);
        let record = fit::fit(&self.moments, &lines, &covered, &lost);
        if self.must_open { far::marked(record) } else { record }
    }
}

fn half_area(size: Vec3) -> f32 {
    size.x * size.y + size.y * size.z + size.z * size.x
}
