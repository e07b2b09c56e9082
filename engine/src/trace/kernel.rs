//! The twin of the GPU's kernel (`shaders/kernel.wgsl`): one ray after the other, a plain loop with a short stack.
//!
//! It meets what the walk of bundles ([`crate::brick::walk`]) meets, ray by ray, and counts what the GPU will do for it. What
//! does not fit the stack, and what is left when a ray has taken its share of steps, becomes an [`Item`]; since hits are
//! whole numbers that add up in any order, an item can be resumed at any time.

use glam::{IVec3, Vec3};

use crate::brick::bundle::{BoxRay, Bundle, EXTINCTION_OPAQUE};
use crate::brick::far::{self, SeenBox};
use crate::brick::intersect;
use crate::brick::lanes::{Boxes, Corners, Lanes, Planes, SLACK, plain::Plain, within};
use crate::brick::leaf::{self, Kind, Layout};
use crate::brick::node::{Child, LOCATION_BYTES, Node, WIDTH};
use crate::brick::walk::{Bricks, Location};
use crate::brick::{ALIGNMENT, HEADER_BYTES};

/// Nodes that the short stack holds.
pub const STACK_ENTRIES: usize = 12;

/// What is left of a ray.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Item {
    /// Children of the node at this byte address, next one first.
    Children(usize, Order),
    /// A brick that was not in memory.
    Brick(u32),
}

/// Children of a node that are yet to be visited.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Order {
    slots: [u8; WIDTH],
    next: u8,
    end: u8,
}

impl Order {
    fn pop(&mut self) -> Option<usize> {
        let slot = (self.next < self.end).then(|| usize::from(self.slots[usize::from(self.next)]))?;
        self.next += 1;
        Some(slot)
    }

    fn is_empty(&self) -> bool {
        self.next == self.end
    }
}

/// What a ray met and what it took.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Traced {
    /// Extinction; past the ray's limit the ray has ended.
    pub extinction: u32,
    /// What is left to do.
    pub items: Vec<Item>,
    /// Nodes whose children were tested.
    pub nodes: u64,
    /// Leaves whose faces were tested.
    pub leaves: u64,
    /// Bytes of nodes and leaves that were read.
    pub bytes: u64,
}

/// A ray of a bundle, which also says what the rays of neighbouring points decide together.
#[derive(Clone, Copy, Debug)]
pub struct KernelRay<'a> {
    /// The bundle that the ray would be in on the CPU.
    pub bundle: &'a Bundle,
    /// The ray's number there.
    pub ray: usize,
    /// As for [`crate::brick::walk::walk`].
    pub open2: f32,
    /// Children that are visited before the rest becomes items.
    pub budget: u32,
}

/// Traces a ray from the root of brick `root`, or goes on with an item.
pub fn trace<B: Bricks>(bricks: &B, ray: KernelRay<'_>, from: Item, before: u32) -> Traced {
    let origins = &ray.bundle.origins;
    let origin =
        origins.iter().find(|origin| ray.ray < usize::from(origin.end)).expect("a ray has an origin");
    let mut state = State {
        bricks,
        ray,
        before,
        origin: origin.position,
        direction: ray.bundle.directions[ray.ray],
        box_ray: ray.bundle.box_rays[ray.ray],
        current: (0, Order::default()),
        stack: Vec::with_capacity(STACK_ENTRIES),
        traced: Traced::default(),
    };
    match from {
        Item::Children(node, order) => state.current = (node, order),
        Item::Brick(number) => match bricks.locate(number) {
            Location::Resident(at) => state.visit(root_node(at)),
            Location::FarField | Location::Missing => state.traced.items.push(from),
        },
    }
    state.walk();
    state.traced
}

/// The byte address of a brick's root node.
fn root_node(place: u32) -> usize {
    place as usize * ALIGNMENT + HEADER_BYTES
}

struct State<'a, B: Bricks> {
    bricks: &'a B,
    ray: KernelRay<'a>,
    before: u32,
    origin: IVec3,
    direction: [f32; 4],
    box_ray: BoxRay,
    /// The node whose children are visited.
    current: (usize, Order),
    stack: Vec<(usize, Order)>,
    traced: Traced,
}

impl<B: Bricks> State<'_, B> {
    fn walk(&mut self) {
        let mut steps = 0;
        while !self.has_ended() {
            if self.current.1.is_empty() {
                let Some(next) = self.stack.pop() else { return };
                self.current = next;
            }
            if steps == self.ray.budget {
                self.stack.push(self.current);
                self.traced.items.extend(self.stack.iter().map(|&(node, order)| Item::Children(node, order)));
                return;
            }
            steps += 1;
            let (address, order) = &mut self.current;
            let (address, Some(slot)) = (*address, order.pop()) else { continue };
            self.open(address, slot);
        }
    }

    fn has_ended(&self) -> bool {
        self.before + self.traced.extinction > self.ray.bundle.limit[self.ray.ray]
    }

    fn node(&self, address: usize) -> &Node {
        bytemuck::from_bytes(&self.bricks.memory()[address..address + size_of::<Node>()])
    }

    /// Visits a child.
    fn open(&mut self, address: usize, slot: usize) {
        match self.node(address).child(slot) {
            Some(Child::Node(offset)) => self.visit(address + LOCATION_BYTES * usize::from(offset)),
            Some(Child::Leaf(offset)) => {
                self.meet_leaf(address, slot, address + LOCATION_BYTES * usize::from(offset));
            }
            Some(Child::Brick(offset)) => {
                let at = address + LOCATION_BYTES * usize::from(offset);
                let bytes = self.bricks.memory()[at..at + 4].try_into().expect("4 bytes");
                let number = u32::from_le_bytes(bytes);
                match self.bricks.locate(number) {
                    Location::Resident(place) => self.visit(root_node(place)),
                    Location::Missing => self.traced.items.push(Item::Brick(number)),
                    Location::FarField => {
                        let (boxes, _) = self.test(address);
                        self.meet_far_field(address, slot, &boxes);
                    }
                }
            }
            // A map with instances is not traced by the kernel yet
            Some(Child::Instance(_)) | None => {}
        }
    }

    /// A node's boxes, and those that the ray meets.
    fn test(&self, address: usize) -> (Boxes, u8) {
        let zero = [[0.0; WIDTH]; 3];
        let mut boxes = Boxes { center: zero, half: zero, distance2: [0.0; WIDTH], diagonal2: [0.0; WIDTH] };
        let mut masks = [0; 1 + SLACK];
        let bundle = self.ray.bundle;
        // SAFETY: the plain loops need no instruction set; there is one ray, of number 0
        let met = unsafe {
            Plain::boxes(self.node(address), bundle.reference, &bundle.bounds, &mut boxes);
            Plain::meet_boxes(&boxes, &[self.box_ray], &bundle.box_origins, &[0], &mut masks)
        };
        (boxes, met)
    }

    /// Tests the ray against a node's children: far fields add up, the others come next, near ones first.
    fn visit(&mut self, address: usize) {
        self.traced.nodes += 1;
        self.traced.bytes += 80;
        let (boxes, met) = self.test(address);
        let (mut order, mut keys) = (Order::default(), [f32::INFINITY; WIDTH]);
        for slot in (0..usize::from(self.node(address).count)).filter(|slot| met >> slot & 1 != 0) {
            let (distance2, reach) = (boxes.distance2[slot], self.ray.bundle.reach);
            if distance2 > reach * reach {
                continue;
            }
            let is_small = boxes.diagonal2[slot] < self.ray.open2 * distance2;
            if is_small && !far::must_open(&self.node(address).far[slot]) {
                self.meet_far_field(address, slot, &boxes);
                continue;
            }
            let mut at = usize::from(order.end);
            while at > 0 && keys[at - 1] > distance2 {
                (keys[at], order.slots[at]) = (keys[at - 1], order.slots[at - 1]);
                at -= 1;
            }
            (keys[at], order.slots[at]) = (distance2, slot as u8);
            order.end += 1;
        }
        if !self.current.1.is_empty() {
            if self.stack.len() == STACK_ENTRIES {
                let (node, rest) = self.stack.remove(0);
                self.traced.items.push(Item::Children(node, rest));
            }
            self.stack.push(self.current);
        }
        self.current = (address, order);
    }

    fn meet_far_field(&mut self, address: usize, slot: usize, boxes: &Boxes) {
        self.traced.bytes += 6;
        let node = self.node(address);
        let axis = |axis: usize| {
            let (lower, upper) = (f32::from(node.lower[axis][slot]), f32::from(node.upper[axis][slot]));
            let scale = f32::from_bits((u32::from(node.exponent[axis]) + 127) << 23);
            (boxes.center[axis][slot], (upper - lower) * (0.5 * scale))
        };
        let [x, y, z] = [axis(0), axis(1), axis(2)];
        let relative = (self.origin - self.ray.bundle.reference).as_vec3();
        let seen = SeenBox { center: Vec3::new(x.0, y.0, z.0) - relative, half: Vec3::new(x.1, y.1, z.1) };
        let direction = Vec3::from_slice(&self.direction[..3]);
        self.traced.extinction += far::extinction(&node.far[slot], direction, &seen);
    }

    /// Tests the ray against a leaf's faces.
    fn meet_leaf(&mut self, node: usize, slot: usize, address: usize) {
        self.traced.leaves += 1;
        let leaf = &self.bricks.memory()[address..];
        let layout = Layout::read_trusted(leaf, self.node(node).lower_corner(slot));
        self.traced.bytes += layout.bytes as u64;
        let faces =
            if layout.kind == Kind::Round { self.round(leaf, &layout) } else { self.flat(leaf, &layout) };
        if faces == 0 {
            return;
        }
        if layout.opaque {
            self.traced.extinction += EXTINCTION_OPAQUE;
            return;
        }
        for face in (0..layout.faces).filter(|face| faces >> face & 1 != 0) {
            self.traced.extinction += match layout.extinction(leaf, face) {
                leaf::OPAQUE => EXTINCTION_OPAQUE,
                extinction => u32::from(extinction),
            };
        }
    }

    fn round(&self, leaf: &[u8], layout: &Layout) -> u16 {
        let direction = Vec3::from_slice(&self.direction[..3]).as_dvec3();
        let reach = f64::from(self.ray.bundle.reach);
        (0..layout.faces).fold(0, |faces, face| {
            faces
                | u16::from(intersect::meets(&layout.face(leaf, face), self.origin, direction, reach)) << face
        })
    }

    fn flat(&self, leaf: &[u8], layout: &Layout) -> u16 {
        let bundle = self.ray.bundle;
        let (mut corners, mut planes) = (Corners::EMPTY, Planes::EMPTY);
        // SAFETY: the plain loops need no instruction set; the leaf was checked when its brick was loaded
        let mut hits = unsafe {
            Plain::corners(leaf, layout, self.origin, &mut corners);
            Plain::planes(&corners, IVec3::ZERO, true, &mut planes);
            Plain::meet_planes(&planes, &self.direction)
        };
        if bundle.reach.is_finite() {
            hits = within(&planes, &self.direction, hits, bundle.reach);
        }
        let close = if bundle.near > 0.0 { within(&planes, &self.direction, hits, bundle.near) } else { 0 };
        let mut faces = layout.kind.faces(hits & !close);
        let close = layout.kind.faces(close);
        for face in (0..layout.faces).filter(|face| close >> face & 1 != 0) {
            let met = meets_on_lattice(&layout.face(leaf, face), self.origin, &self.direction, bundle.reach);
            faces |= u16::from(met) << face;
        }
        faces
    }
}

/// Steps of a direction's fixed point.
const DIRECTION_SCALE: f32 = 1_073_741_824.0;

/// Whether a ray meets a flat face, decided by whole numbers alone: [`intersect::meets`] without rounding.
fn meets_on_lattice(face: &leaf::Face, origin: IVec3, direction: &[f32; 4], reach: f32) -> bool {
    let corners = &face.vertices[..usize::from(face.arity)];
    if corners.contains(&origin) {
        return false;
    }
    let d = [0, 1, 2].map(|axis| i128::from((direction[axis] * DIRECTION_SCALE).round_ties_even() as i32));
    let [a, b, c, e] = face.vertices.map(|vertex| (vertex - origin).to_array().map(i128::from));
    triangle_on_lattice([a, b, c], d, reach) || face.arity == 4 && triangle_on_lattice([a, c, e], d, reach)
}

fn triangle_on_lattice([a, b, c]: [[i128; 3]; 3], d: [i128; 3], reach: f32) -> bool {
    let cross = |p: [i128; 3], q: [i128; 3]| {
        [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]
    };
    let dot = |p: [i128; 3], q: [i128; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    let volume = dot(a, cross(b, c));
    let edges = [cross(a, b), cross(b, c), cross(c, a)].map(|normal| dot(normal, d) * volume.signum());
    let sum: i128 = edges.iter().sum();
    let is_inside = volume != 0 && edges.iter().all(|&edge| edge >= 0);
    // Far reaches need no more than single precision
    is_inside && sum > 0 && volume.abs() as f32 * DIRECTION_SCALE <= reach * sum as f32
}
