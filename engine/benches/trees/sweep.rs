//! The yardstick: one global tree by a full sweep over all places to split, collapsed to eight-wide nodes and leaves of the
//! least cost by a dynamic program.

use engine::brick::LatticeBox;
use engine::brick::node::WIDTH;
use glam::Vec3A;

/// Cost of the yardstick over boxes: the areas of nodes and leaves over the root's. A leaf holds up to `leaf_max` boxes.
pub fn cost(boxes: &[LatticeBox], leaf_max: usize) -> (f64, f64) {
    let boxes: Vec<Box3> = boxes.iter().map(Box3::of).collect();
    let mut orders: [Vec<u32>; 3] = std::array::from_fn(|axis| {
        let mut order: Vec<u32> = (0..boxes.len() as u32).collect();
        order.sort_by(|&a, &b| boxes[a as usize].center(axis).total_cmp(&boxes[b as usize].center(axis)));
        order
    });
    let mut sweep =
        Sweep { boxes: &boxes, leaf_max, left: vec![false; boxes.len()], scratch: vec![], areas: vec![] };
    let [x, y, z] = &mut orders;
    let slots = sweep.slots([x, y, z]);
    let root = boxes.iter().fold(Box3::EMPTY, |all, b| all.union(b));
    (f64::from(slots[0].0) / f64::from(root.half_area()), boxes.len() as f64 / f64::from(slots[0].1))
}

/// The one of less cost.
fn cheaper(a: (f32, f32), b: (f32, f32)) -> (f32, f32) {
    if b.0 < a.0 { b } else { a }
}

#[derive(Clone, Copy)]
struct Box3 {
    low: Vec3A,
    high: Vec3A,
}

impl Box3 {
    const EMPTY: Self = Self { low: Vec3A::INFINITY, high: Vec3A::NEG_INFINITY };

    fn of(bounds: &LatticeBox) -> Self {
        Self { low: bounds.min.as_vec3a(), high: bounds.max.as_vec3a() }
    }

    fn union(&self, other: &Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    fn half_area(&self) -> f32 {
        let size = self.high - self.low;
        size.x * size.y + size.y * size.z + size.z * size.x
    }

    fn center(&self, axis: usize) -> f32 {
        self.low[axis] + self.high[axis]
    }
}

struct Sweep<'a> {
    boxes: &'a [Box3],
    leaf_max: usize,
    left: Vec<bool>,
    scratch: Vec<u32>,
    areas: Vec<f32>,
}

impl Sweep<'_> {
    /// Cost and leaves of a subtree in 1 to 7 slots of a node. `orders` holds its boxes sorted along each axis.
    fn slots(&mut self, orders: [&mut [u32]; 3]) -> [(f32, f32); WIDTH - 1] {
        let count = orders[0].len();
        let all = orders[0].iter().fold(Box3::EMPTY, |all, &b| all.union(&self.boxes[b as usize]));
        let area = all.half_area();
        if count == 1 {
            return [(area, 1.0); WIDTH - 1];
        }
        let (axis, middle) = self.split(&orders);
        for (i, &b) in orders[axis].iter().enumerate() {
            self.left[b as usize] = i < middle;
        }
        let [[xl, xr], [yl, yr], [zl, zr]] = orders.map(|order| {
            self.part(order);
            let (left, right) = order.split_at_mut(middle);
            [left, right]
        });
        let left = self.slots([xl, yl, zl]);
        let right = self.slots([xr, yr, zr]);
        let distribute = |slots: usize| {
            (1..slots)
                .map(|k| (left[k.min(7) - 1], right[(slots - k).min(7) - 1]))
                .map(|(left, right)| (left.0 + right.0, left.1 + right.1))
                .fold((f32::INFINITY, 0.0), cheaper)
        };
        let (inside, leaves) = distribute(WIDTH);
        let mut cost = [(area + inside, leaves); WIDTH - 1];
        if count <= self.leaf_max {
            cost = [cheaper((area, 1.0), cost[0]); WIDTH - 1];
        }
        for slots in 2..WIDTH {
            cost[slots - 1] = cheaper(cost[slots - 2], distribute(slots));
        }
        cost
    }

    /// The axis and place of the cheapest split.
    fn split(&mut self, orders: &[&mut [u32]; 3]) -> (usize, usize) {
        let count = orders[0].len();
        let mut best = (f32::INFINITY, 0, count / 2);
        for (axis, order) in orders.iter().enumerate() {
            self.areas.resize(count.max(self.areas.len()), 0.0);
            let mut all = Box3::EMPTY;
            for i in (1..count).rev() {
                all = all.union(&self.boxes[order[i] as usize]);
                self.areas[i] = all.half_area();
            }
            all = Box3::EMPTY;
            for i in 1..count {
                all = all.union(&self.boxes[order[i - 1] as usize]);
                let cost = all.half_area() * i as f32 + self.areas[i] * (count - i) as f32;
                if cost < best.0 {
                    best = (cost, axis, i);
                }
            }
        }
        (best.1, best.2)
    }

    /// Puts the boxes that go left in front, in their order.
    fn part(&mut self, order: &mut [u32]) {
        self.scratch.clear();
        let mut front = 0;
        for i in 0..order.len() {
            if self.left[order[i] as usize] {
                order[front] = order[i];
                front += 1;
            } else {
                self.scratch.push(order[i]);
            }
        }
        order[front..].copy_from_slice(&self.scratch);
    }
}
