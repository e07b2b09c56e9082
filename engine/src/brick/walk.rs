//! Any hit over bricks for a bundle of rays with shared origins.
//!
//! All rays of a bundle go down the tree together: a node is decoded once for all of them, then each ray is tested
//! against its eight boxes, and the rays that meet a child go on as a list of ray numbers. One order of children, near
//! first, holds for all rays because they start at the same place. A hit adds extinction to a ray; extinctions are
//! integers, so the order of hits does not matter, and a ray that passes its limit drops out of every list.

use glam::Vec3;

use super::ALIGNMENT;
use super::bundle::{Bundle, EXTINCTION_OPAQUE, RAYS_MAX};
use super::far::{self, Aggregate, Plate, SeenBox};
use super::intersect;
use super::lanes::{Boxes, Corners, InstructionSet, Lanes, Planes, SLACK, plain::Plain, within};
use super::leaf::{self, Kind, Layout};
use super::node::{Child, LOCATION_BITS, LOCATION_BYTES, Node, WIDTH};

/// Where a brick is, for the current batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Location {
    /// In memory, at a multiple of [`ALIGNMENT`] bytes.
    Resident(u32),
    /// Not in the batch's cut: its far field stands in for it.
    FarField,
    /// In the cut, but not in memory now: the rays wait for it.
    Missing,
}

/// The bricks that a walk may visit.
pub trait Bricks {
    /// The memory that holds the resident bricks, all checked, with [`leaf::READ_PAST_BYTES`] to spare at the end.
    fn memory(&self) -> &[u8];
    /// Where a brick is.
    fn locate(&self, brick: u32) -> Location;
}

/// Rays that wait for a brick: a range of [`Scratch::waiting_rays`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// The brick.
    pub brick: u32,
    /// First entry of the rays' numbers.
    pub first: u32,
    /// How many.
    pub count: u32,
}

/// What a walk counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Nodes visited.
    pub nodes: u64,
    /// Rays tested at nodes.
    pub node_rays: u64,
    /// Leaves visited.
    pub leaves: u64,
    /// Rays tested at leaves.
    pub leaf_rays: u64,
    /// Far fields met.
    pub far_hits: u64,
    /// Faces met.
    pub hits: u64,
    /// Faces tested again in double precision.
    pub retests: u64,
}

impl std::ops::AddAssign for Counts {
    fn add_assign(&mut self, other: Self) {
        self.nodes += other.nodes;
        self.node_rays += other.node_rays;
        self.leaves += other.leaves;
        self.leaf_rays += other.leaf_rays;
        self.far_hits += other.far_hits;
        self.hits += other.hits;
        self.retests += other.retests;
    }
}

/// A walk's memory, reused over bundles.
#[derive(Debug)]
pub struct Scratch {
    stack: Vec<Entry>,
    lists: Vec<u16>,
    current: Vec<u16>,
    far: Vec<u16>,
    masks: Vec<u8>,
    boxes: Boxes,
    corners: Corners,
    planes: Planes,
    /// Rays that met a brick which is not in memory.
    pub waiting: Vec<Waiting>,
    /// Their numbers.
    pub waiting_rays: Vec<u16>,
    /// What was counted.
    pub counts: Counts,
}

/// A node or leaf to visit, with its list of rays.
#[derive(Clone, Copy, Debug)]
struct Entry {
    /// Byte address of the node, or of the node that has the leaf as a child.
    address: usize,
    /// The leaf's place among the node's children; [`NO_LEAF`] for the node itself.
    leaf: u16,
    /// Entries of the list.
    count: u16,
    /// First entry of the list.
    first: u32,
}

/// See [`Entry::leaf`].
const NO_LEAF: u16 = u16::MAX;

impl Scratch {
    /// Memory for bundles of [`RAYS_MAX`] rays.
    pub fn new() -> Self {
        Self {
            stack: Vec::with_capacity(256),
            lists: vec![0; 16 * RAYS_MAX],
            current: vec![0; RAYS_MAX + SLACK],
            far: vec![0; RAYS_MAX + SLACK],
            masks: vec![0; RAYS_MAX + 2 * SLACK],
            boxes: Boxes {
                center: [[0.0; WIDTH]; 3],
                half: [[0.0; WIDTH]; 3],
                distance2: [0.0; WIDTH],
                diagonal2: [0.0; WIDTH],
            },
            corners: Corners::EMPTY,
            planes: Planes::EMPTY,
            waiting: Vec::new(),
            waiting_rays: Vec::new(),
            counts: Counts::default(),
        }
    }
}

impl Default for Scratch {
    fn default() -> Self {
        Self::new()
    }
}

/// Traces the rays numbered `rays` of a bundle through brick `start` and all below it.
///
/// A child whose squared diagonal is less than `open2` times its squared distance from the origins is not opened: its
/// far field stands in for it. With 0 every child of a resident brick is opened.
pub fn walk(
    bricks: &impl Bricks,
    start: u32,
    rays: &[u16],
    open2: f32,
    bundle: &mut Bundle,
    scratch: &mut Scratch,
    instructions: InstructionSet,
) {
    match instructions {
        // SAFETY: the plain loops need no instruction set
        InstructionSet::Plain => unsafe {
            Walk::<Plain, _>::run(bricks, start, rays, open2, bundle, scratch)
        },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: InstructionSet::detect and ::available are the only sources of these values outside tests
        InstructionSet::Avx2 => unsafe { walk_avx2(bricks, start, rays, open2, bundle, scratch) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above
        InstructionSet::Avx512 => unsafe { walk_avx512(bricks, start, rays, open2, bundle, scratch) },
        #[cfg(not(target_arch = "x86_64"))]
        // SAFETY: the plain loops need no instruction set
        _ => unsafe { Walk::<Plain, _>::run(bricks, start, rays, open2, bundle, scratch) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt")]
unsafe fn walk_avx2(
    bricks: &impl Bricks,
    start: u32,
    rays: &[u16],
    open2: f32,
    bundle: &mut Bundle,
    scratch: &mut Scratch,
) {
    // SAFETY: the caller vouches for the instruction set
    unsafe { Walk::<Plain, _>::run(bricks, start, rays, open2, bundle, scratch) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(
    enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi,avx512vbmi2,avx2,fma,bmi1,bmi2,popcnt"
)]
unsafe fn walk_avx512(
    bricks: &impl Bricks,
    start: u32,
    rays: &[u16],
    open2: f32,
    bundle: &mut Bundle,
    scratch: &mut Scratch,
) {
    // SAFETY: the caller vouches for the instruction set
    unsafe { Walk::<super::lanes::avx512::Avx512, _>::run(bricks, start, rays, open2, bundle, scratch) }
}

/// The location's bits of a stored child.
const LOCATION_MASK: u16 = (1 << LOCATION_BITS) - 1;

/// A walk under way.
struct Walk<'a, L: Lanes, B: Bricks> {
    bricks: &'a B,
    memory: &'a [u8],
    open2: f32,
    bundle: &'a mut Bundle,
    scratch: &'a mut Scratch,
    lanes: std::marker::PhantomData<L>,
}

impl<'a, L: Lanes, B: Bricks> Walk<'a, L, B> {
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    unsafe fn run(
        bricks: &'a B,
        start: u32,
        rays: &[u16],
        open2: f32,
        bundle: &'a mut Bundle,
        scratch: &'a mut Scratch,
    ) {
        let mut walk =
            Self { bricks, memory: bricks.memory(), open2, bundle, scratch, lanes: std::marker::PhantomData };
        walk.scratch.stack.clear();
        let count = rays.len();
        walk.scratch.lists[..count].copy_from_slice(rays);
        match bricks.locate(start) {
            Location::Resident(at) => walk.scratch.stack.push(Entry {
                address: root_node(at),
                leaf: NO_LEAF,
                count: count as u16,
                first: 0,
            }),
            Location::Missing | Location::FarField => {
                let scratch = &mut *walk.scratch;
                let first = scratch.waiting_rays.len() as u32;
                scratch.waiting_rays.extend_from_slice(rays);
                scratch.waiting.push(Waiting { brick: start, first, count: count as u32 });
            }
        }
        while let Some(entry) = walk.scratch.stack.pop() {
            // The list is the topmost one: what it takes becomes free for the children's lists
            let (first, end) = (entry.first as usize, entry.first as usize + usize::from(entry.count));
            let scratch = &mut *walk.scratch;
            // SAFETY: `current` has room for all rays of a bundle and the slack
            let count =
                unsafe { L::filter(&walk.bundle.alive, &scratch.lists[first..end], &mut scratch.current) };
            if count == 0 {
                continue;
            }
            if entry.leaf != NO_LEAF {
                // SAFETY: as the caller's
                unsafe { walk.visit_leaf(entry.address, usize::from(entry.leaf), count) };
            } else {
                // SAFETY: as the caller's
                unsafe { walk.visit_node(entry, count) };
            }
        }
    }

    /// Tests `count` rays against a node's children and puts those to open on the stack, far ones first.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    unsafe fn visit_node(&mut self, entry: Entry, count: usize) {
        let node = node_at(self.memory, entry.address);
        self.scratch.counts.nodes += 1;
        self.scratch.counts.node_rays += count as u64;
        let Scratch { current, masks, boxes, .. } = &mut *self.scratch;

        // Decode the boxes, and see what is to be opened
        // SAFETY: as the caller's
        unsafe { L::boxes(node, self.bundle.reference, &self.bundle.bounds, boxes) };
        let mut far_mask = 0_u8;
        let mut beyond = (0xff_u32 << node.count) as u8;
        let reach2 = self.bundle.reach * self.bundle.reach;
        for slot in 0..usize::from(node.count) {
            if boxes.diagonal2[slot] < self.open2 * boxes.distance2[slot] && !far::must_open(&node.far[slot])
            {
                far_mask |= 1 << slot;
            }
            beyond |= u8::from(boxes.distance2[slot] > reach2) << slot;
            // A node or leaf that will be visited is asked for before the rays are tested
            let child = node.children[slot];
            if child >> LOCATION_BITS < 2 {
                prefetch(self.memory, entry.address + LOCATION_BYTES * usize::from(child & LOCATION_MASK));
            }
        }

        // Test the rays
        // SAFETY: ray numbers in lists are below the bundle's length; `masks` has the slack
        let met = unsafe { L::meet_boxes(boxes, &self.bundle.box_rays, &current[..count], masks) } & !beyond;

        // Order the children to open, far ones first, so that near ones are visited first
        let mut order = [0_u64; WIDTH];
        let mut targets = [Target::FarField; WIDTH];
        let mut opened = 0;
        let mut rest = met & !far_mask;
        while rest != 0 {
            let slot = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            targets[slot] = Self::target(self.bricks, self.memory, entry.address, node.child(slot));
            if targets[slot] == Target::FarField {
                far_mask |= 1 << slot;
                continue;
            }
            // Squared distances are not negative: their bits are in their order
            let key = u64::from(self.scratch.boxes.distance2[slot].to_bits()) << 8 | slot as u64;
            let mut at = opened;
            while at > 0 && order[at - 1] < key {
                order[at] = order[at - 1];
                at -= 1;
            }
            order[at] = key;
            opened += 1;
        }
        if met & far_mask != 0 {
            // SAFETY: as the caller's
            unsafe { self.meet_far_fields(node, met & far_mask, count) };
        }
        let mut first = entry.first as usize;
        for &key in &order[..opened] {
            let slot = key as usize & 7;
            let Scratch { current, masks, lists, stack, .. } = &mut *self.scratch;
            if lists.len() < first + count + SLACK {
                lists.resize(2 * lists.len() + RAYS_MAX, 0);
            }
            // SAFETY: the list has just been made long enough
            let met = unsafe { L::select(&current[..count], masks, slot, &mut lists[first..]) };
            if met == 0 {
                continue;
            }
            match targets[slot] {
                Target::Node(address) => {
                    prefetch(self.memory, address);
                    stack.push(Entry { address, leaf: NO_LEAF, count: met as u16, first: first as u32 });
                    first += met;
                }
                Target::Leaf => {
                    let (address, leaf) = (entry.address, slot as u16);
                    stack.push(Entry { address, leaf, count: met as u16, first: first as u32 });
                    first += met;
                }
                Target::Wait(brick) => {
                    let scratch = &mut *self.scratch;
                    let start = scratch.waiting_rays.len() as u32;
                    scratch.waiting_rays.extend_from_slice(&scratch.lists[first..first + met]);
                    scratch.waiting.push(Waiting { brick, first: start, count: met as u32 });
                }
                Target::FarField => {}
            }
        }
    }

    /// What a child of the node at `address` asks for.
    #[inline(always)]
    fn target(bricks: &B, memory: &[u8], address: usize, child: Option<Child>) -> Target {
        match child {
            Some(Child::Node(offset)) => Target::Node(address + LOCATION_BYTES * usize::from(offset)),
            Some(Child::Leaf(_)) => Target::Leaf,
            Some(Child::Brick(offset)) => {
                let at = address + LOCATION_BYTES * usize::from(offset);
                let number = u32::from_le_bytes(memory[at..at + 4].try_into().expect("4 bytes"));
                match bricks.locate(number) {
                    Location::Resident(at) => Target::Node(root_node(at)),
                    Location::FarField => Target::FarField,
                    Location::Missing => Target::Wait(number),
                }
            }
            // Checked when the brick was loaded
            None => Target::FarField,
        }
    }

    /// Adds the extinction of the children in `far_mask` to the rays that meet their boxes.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    unsafe fn meet_far_fields(&mut self, node: &Node, mut far_mask: u8, count: usize) {
        while far_mask != 0 {
            let slot = far_mask.trailing_zeros() as usize;
            far_mask &= far_mask - 1;
            let Scratch { current, masks, far, .. } = &mut *self.scratch;
            // SAFETY: lists are long enough for all rays of a bundle and the slack
            let met = unsafe { L::select(&current[..count], masks, slot, far) };
            self.scratch.counts.far_hits += met as u64;
            let (record, half) = (&node.far[slot], node.child_half(slot));
            match far::kind(record) {
                far::Kind::Single | far::Kind::Layered => self.meet_aggregate(record, half, met),
                far::Kind::Plate => self.meet_plate(record, half, slot, met),
                far::Kind::Scalar => {
                    let extinction = face_extinction(u16::from_le_bytes([record[0], record[1]]));
                    for &ray in &self.scratch.far[..met] {
                        self.bundle.extinguish(ray, extinction);
                    }
                }
            }
        }
    }

    /// Adds an aggregate's extinction to the first `met` rays of the list.
    #[inline(always)]
    fn meet_aggregate(&mut self, record: &far::Record, half: Vec3, met: usize) {
        let aggregate = Aggregate::decode(record);
        for &ray in &self.scratch.far[..met] {
            let direction = Vec3::from_slice(&self.bundle.directions[usize::from(ray)][..3]);
            self.bundle.extinguish(ray, aggregate.extinction(direction, half));
        }
    }

    /// Ends those of the first `met` rays of the list that meet a plate.
    #[inline(never)]
    fn meet_plate(&mut self, record: &far::Record, half: Vec3, slot: usize, met: usize) {
        let plate = Plate::decode(record, half);
        let center = Vec3::from_array(self.scratch.boxes.center.map(|center| center[slot]));
        let mut at = 0;
        for origin in 0..self.bundle.origins.len() {
            let origin = self.bundle.origins[origin];
            let offset = origin.position.wrapping_sub(self.bundle.reference).as_vec3();
            let bounds = SeenBox { center: center - offset, half };
            while at < met && self.scratch.far[at] < origin.end {
                let ray = self.scratch.far[at];
                let direction = Vec3::from_slice(&self.bundle.directions[usize::from(ray)][..3]);
                let (enter, leave) = far::pass(direction, &bounds);
                if plate.is_met(direction, &bounds, enter, leave) {
                    self.bundle.extinguish(ray, EXTINCTION_OPAQUE);
                }
                at += 1;
            }
        }
    }

    /// Tests `count` rays against the faces of a node's leaf.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    unsafe fn visit_leaf(&mut self, node: usize, slot: usize, count: usize) {
        let parent = node_at(self.memory, node);
        let address = node + LOCATION_BYTES * usize::from(parent.children[slot] & LOCATION_MASK);
        let bytes = &self.memory[address..];
        let layout = Layout::read_trusted(bytes, parent.lower_corner(slot));
        self.scratch.counts.leaves += 1;
        self.scratch.counts.leaf_rays += count as u64;
        if layout.kind == Kind::Round {
            self.visit_round_leaf(bytes, &layout, count);
            return;
        }
        // SAFETY: the brick was checked when it was loaded, and memory runs on past it
        unsafe { L::corners(bytes, &layout, self.bundle.reference, &mut self.scratch.corners) };
        // Rays are in order: each origin's are a run
        let mut at = 0;
        for origin in 0..self.bundle.origins.len() {
            let origin = self.bundle.origins[origin];
            let start = at;
            while at < count && self.scratch.current[at] < origin.end {
                at += 1;
            }
            if at == start {
                continue;
            }
            let offset = origin.position.wrapping_sub(self.bundle.reference);
            let Scratch { corners, planes, .. } = &mut *self.scratch;
            // SAFETY: as the caller's
            unsafe { L::planes(corners, offset, planes) };
            if self.scratch.planes.valid == 0 {
                continue;
            }
            let near = self.bundle.near > 0.0 && self.is_near(&layout, origin.position);
            for i in start..at {
                let ray = self.scratch.current[i];
                let direction = self.bundle.directions[usize::from(ray)];
                // SAFETY: as the caller's
                let mut hits = unsafe { L::meet_planes(&self.scratch.planes, &direction) };
                if hits == 0 {
                    continue;
                }
                if self.bundle.reach.is_finite() {
                    hits = within(&self.scratch.planes, &direction, hits, self.bundle.reach);
                }
                let mut faces = layout.kind.faces(hits);
                if near && faces != 0 {
                    faces = self.retest(bytes, &layout, &origin, &direction, hits);
                }
                if faces != 0 {
                    self.meet_faces(bytes, &layout, ray, faces);
                }
            }
        }
    }

    /// Whether the leaf's vertices may lie within the near distance of an origin.
    #[inline(always)]
    fn is_near(&self, layout: &Layout, origin: glam::IVec3) -> bool {
        let mut gap2 = 0.0;
        for axis in 0..3 {
            let lower = layout.origin[axis].wrapping_sub(origin[axis]) as f32;
            let extent = ((1_u64 << layout.bits[axis]) << layout.shift) as f32;
            let gap = lower.max(-(lower + extent)).max(0.0);
            gap2 += gap * gap;
        }
        gap2 <= self.bundle.near * self.bundle.near
    }

    /// Looks again, in double precision, at those of `hits` that are near. The faces that are met.
    #[inline(never)]
    fn retest(
        &mut self,
        leaf: &[u8],
        layout: &Layout,
        origin: &super::bundle::Origin,
        direction: &[f32; 4],
        hits: u16,
    ) -> u16 {
        let close = within(&self.scratch.planes, direction, hits, self.bundle.near);
        let close_faces = layout.kind.faces(close);
        let mut faces = layout.kind.faces(hits & !close);
        let exact = Vec3::from_slice(&direction[..3]).as_dvec3();
        for face in (0..layout.faces).filter(|face| close_faces >> face & 1 != 0) {
            self.scratch.counts.retests += 1;
            let reach = f64::from(self.bundle.reach);
            if intersect::meets(&layout.face(leaf, face), origin.position, exact, reach) {
                faces |= 1 << face;
            }
        }
        faces
    }

    /// Points and lines: few, and tested in double precision.
    #[inline(never)]
    fn visit_round_leaf(&mut self, leaf: &[u8], layout: &Layout, count: usize) {
        let reach = f64::from(self.bundle.reach);
        let decoded: [_; leaf::FACES_MAX] =
            std::array::from_fn(|face| layout.face(leaf, face.min(layout.faces - 1)));
        for i in 0..count {
            let ray = self.scratch.current[i];
            let origin =
                self.bundle.origins.iter().find(|origin| ray < origin.end).expect("every ray has an origin");
            let (position, direction) = (origin.position, self.bundle.directions[usize::from(ray)]);
            let direction = Vec3::from_slice(&direction[..3]).as_dvec3();
            let mut faces = 0;
            for (face, decoded) in decoded[..layout.faces].iter().enumerate() {
                faces |= u16::from(intersect::meets(decoded, position, direction, reach)) << face;
            }
            if faces != 0 {
                self.meet_faces(leaf, layout, ray, faces);
            }
        }
    }

    /// Adds the extinction of the faces in the mask to a ray.
    #[inline(always)]
    fn meet_faces(&mut self, leaf: &[u8], layout: &Layout, ray: u16, mut faces: u16) {
        self.scratch.counts.hits += u64::from(faces.count_ones());
        let mut extinction = 0;
        if layout.opaque {
            extinction = EXTINCTION_OPAQUE;
        } else {
            while faces != 0 {
                extinction += face_extinction(layout.extinction(leaf, faces.trailing_zeros() as usize));
                faces &= faces - 1;
            }
        }
        self.bundle.extinguish(ray, extinction);
    }
}

/// What becomes of a child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Target {
    /// Its far field stands in for it.
    FarField,
    /// It is a node to visit, at this byte address.
    Node(usize),
    /// It is a leaf to visit.
    Leaf,
    /// It is a brick that is not in memory.
    Wait(u32),
}

/// A stored extinction as it adds up: an opaque face ends every ray.
#[inline(always)]
fn face_extinction(stored: u16) -> u32 {
    if stored == leaf::OPAQUE { EXTINCTION_OPAQUE } else { u32::from(stored) }
}

/// The byte address of a brick's root node, from the brick's in units of [`ALIGNMENT`].
#[inline(always)]
fn root_node(brick: u32) -> usize {
    brick as usize * ALIGNMENT + super::HEADER_BYTES
}

/// The node at a byte address.
#[inline(always)]
fn node_at(memory: &[u8], address: usize) -> &Node {
    bytemuck::from_bytes(&memory[address..address + size_of::<Node>()])
}

/// Asks for the memory of a child that may be visited soon: the first two lines.
#[inline(always)]
fn prefetch(memory: &[u8], address: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let at = memory.as_ptr().wrapping_add(address);
        // SAFETY: prefetching never faults, whatever the address
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(at.cast());
            _mm_prefetch::<_MM_HINT_T0>(at.wrapping_add(64).cast());
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (memory, address);
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;
    use crate::brick::leaf::{Face, OPAQUE, READ_PAST_BYTES};
    use crate::brick::{LatticeBox, Node, assemble};
    use crate::math::hash::{hash32, unit_f32};

    /// Bricks in plain memory: brick i starts at `starts[i]`.
    struct Loaded {
        memory: Vec<u8>,
        starts: Vec<u32>,
    }

    impl Bricks for Loaded {
        fn memory(&self) -> &[u8] {
            &self.memory
        }

        fn locate(&self, brick: u32) -> Location {
            Location::Resident(self.starts[brick as usize] / ALIGNMENT as u32)
        }
    }

    struct Random(u32);

    impl Random {
        fn next(&mut self, range: u32) -> i32 {
            self.0 = hash32(self.0);
            (self.0 % range) as i32
        }

        fn unit(&mut self) -> f32 {
            self.0 = hash32(self.0);
            unit_f32(self.0)
        }

        fn vertex(&mut self, extent: u32) -> IVec3 {
            IVec3::new(self.next(extent), self.next(extent), self.next(extent)) - extent as i32 / 2
        }
    }

    /// A two-level map of random faces: 8 bricks of one node with 8 leaves each under a root brick.
    fn random_map(random: &mut Random, extent: u32, size: u32) -> (Loaded, Vec<Face>) {
        let (mut memory, mut starts, mut all) = (Vec::new(), vec![0], Vec::new());
        let mut boxes = Vec::new();
        let mut bricks = Vec::new();
        for number in 1..=8 {
            let (mut leaves, mut leaf_faces, mut offsets) = (Vec::new(), Vec::new(), Vec::new());
            for leaf in 0..8 {
                let (round, triangles) = (leaf == 7, leaf == 6);
                let faces: Vec<Face> = (0..1 + random.next(if triangles { 10 } else { 8 }))
                    .map(|_| {
                        let arity = match (round, triangles) {
                            (true, _) => 1 + random.next(2) as u8,
                            (_, true) => 3,
                            _ => 3 + random.next(2) as u8,
                        };
                        let center = random.vertex(extent);
                        let mut vertices = [center; 4];
                        for corner in 1..4 {
                            let last = vertices[corner - 1];
                            vertices[corner] =
                                if corner < usize::from(arity) { center + random.vertex(size) } else { last };
                        }
                        let extinction = if random.next(2) == 0 { OPAQUE } else { random.next(9000) as u16 };
                        let radii = if round { [0.01, 0.02].map(|r| r * size as f32) } else { [0.0; 2] };
                        Face {
                            vertices,
                            arity,
                            extinction,
                            radii: if arity == 1 { [radii[0]; 2] } else { radii },
                        }
                    })
                    .collect();
                leaf_faces.push(faces);
            }
            let bounds = |faces: &Vec<Face>| faces.iter().fold(LatticeBox::EMPTY, |b, f| b.union(f.bounds()));
            let leaf_boxes: Vec<LatticeBox> = leaf_faces.iter().map(bounds).collect();
            let mut node = Node::over(&leaf_boxes);
            for (slot, faces) in leaf_faces.into_iter().enumerate() {
                offsets.push((leaves.len() / LOCATION_BYTES) as u16);
                leaf::encode(&faces, 0, node.lower_corner(slot), &mut leaves);
                all.extend(faces);
            }
            for slot in 0..8 {
                node.children[slot] = Child::Leaf(offsets[slot]).encode();
                node.far[slot] = std::array::from_fn(|_| random.next(256) as u8);
            }
            boxes.push(leaf_boxes.iter().fold(LatticeBox::EMPTY, |b, &l| b.union(l)));
            let mut brick = Vec::new();
            assemble(number, &mut [node], &[], &leaves, 0, &mut brick);
            bricks.push(brick);
        }
        let mut root = Node::over(&boxes);
        (0..8).for_each(|slot| root.children[slot] = Child::Brick(slot as u16).encode());
        assemble(0, &mut [root], &[1, 2, 3, 4, 5, 6, 7, 8], &[], 0, &mut memory);
        for brick in bricks {
            starts.push(memory.len() as u32);
            memory.extend(brick);
        }
        memory.resize(memory.len() + READ_PAST_BYTES, 0);
        (Loaded { memory, starts }, all)
    }

    fn random_bundle(random: &mut Random, extent: u32, vertex: IVec3, reach: f32) -> Bundle {
        let mut bundle = Bundle::new();
        bundle.clear(reach, 20.0);
        for point in 0..4 {
            // One origin on a vertex of the scene, the others anywhere near it
            let offset = random.vertex(extent / 4);
            bundle.push_origin(if point == 0 { vertex } else { vertex + offset });
            for ray in 0..64 {
                let direction = match ray {
                    0 => Vec3::X,
                    1 => -Vec3::Z,
                    _ => (Vec3::new(random.unit(), random.unit(), random.unit()) - 0.5).normalize_or(Vec3::Y),
                };
                bundle.push_ray(direction, u32::MAX);
            }
        }
        bundle
    }

    /// Catches any face that traversal misses or invents: every ray against every face in double precision is the truth.
    #[test]
    fn every_instruction_set_agrees_with_brute_force() {
        for instructions in InstructionSet::available() {
            let mut random = Random(11);
            let (mut hits, mut rays, mut differences) = (0_u64, 0_u64, 0_u64);
            for case in 0..60 {
                let extent = [100, 5000, 1 << 20, 1 << 27][case % 4];
                let (map, faces) = random_map(&mut random, extent, (extent / [2, 8][case % 2]).max(4));
                let reach = if case % 3 == 0 { extent as f32 / 3.0 } else { f32::INFINITY };
                let mut bundle = random_bundle(&mut random, extent, faces[0].vertices[0], reach);
                let ids: Vec<u16> = (0..bundle.len() as u16).collect();
                walk(&map, 0, &ids, 0.0, &mut bundle, &mut Scratch::new(), instructions);
                for ray in 0..bundle.len() {
                    let origin = bundle.origins[ray / 64].position;
                    let direction = Vec3::from_slice(&bundle.directions[ray][..3]).as_dvec3();
                    let expected: u64 = faces
                        .iter()
                        .filter(|face| intersect::meets(face, origin, direction, f64::from(reach)))
                        .map(|face| u64::from(face_extinction(face.extinction)))
                        .sum();
                    rays += 1;
                    hits += u64::from(expected > 0);
                    // A leaf with an opaque face counts it once
                    let opaque = u64::from(EXTINCTION_OPAQUE);
                    let met = u64::from(bundle.extinction[ray]);
                    differences += u64::from(met.min(opaque) != expected.min(opaque));
                }
            }
            // Single precision may decide a ray through an edge, or at the reach, differently
            assert!(hits > rays / 20, "{instructions:?}: {hits} of {rays} rays hit, the test is empty");
            assert!(differences <= rays / 5000, "{instructions:?}: {differences} of {rays} rays differ");
        }
    }

    /// Catches an instruction set that gives other bits than the plain loops.
    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let mut random = Random(12);
        for case in 0..40 {
            let extent = [60, 3000, 1 << 22, 1 << 28][case % 4];
            let (map, faces) = random_map(&mut random, extent, extent / 4);
            let seed = random.0;
            let of = |instructions| {
                let mut bundle =
                    random_bundle(&mut Random(seed), extent, faces[3].vertices[1], f32::INFINITY);
                let ids: Vec<u16> = (0..bundle.len() as u16).collect();
                let mut scratch = Scratch::new();
                walk(&map, 0, &ids, 0.05 * (case % 2) as f32, &mut bundle, &mut scratch, instructions);
                (bundle.extinction, bundle.alive, scratch.counts)
            };
            let plain = of(InstructionSet::Plain);
            for instructions in InstructionSet::available() {
                assert_eq!(of(instructions), plain, "{instructions:?}, case {case}");
            }
        }
    }
}
