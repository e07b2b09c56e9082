//! A walk's nodes: from the stack, through the rays' box tests, to the children that are opened.

use super::super::ALIGNMENT;
use super::super::bundle::Bundle;
use super::super::far;
use super::super::lanes::{Lanes, Look, SLACK};
use super::super::node::{Child, LOCATION_BITS, LOCATION_BYTES, Node, WIDTH};
use super::super::{HEADER_BYTES, bundle::RAYS_MAX};
use super::instances::{Entrance, instance_at};
use super::scratch::{Entry, INSTANCE, LEAVE, NO_LEAF, Scratch, Waiting};
use super::{Bricks, Location, Start};

/// The location's bits of a stored child.
pub(super) const LOCATION_MASK: u16 = (1 << LOCATION_BITS) - 1;

/// A walk under way.
pub(super) struct Walk<'a, L: Lanes, B: Bricks> {
    pub(super) bricks: &'a B,
    pub(super) memory: &'a [u8],
    /// What holds where the walk is.
    pub(super) open2: f32,
    /// What holds outside instances.
    pub(super) open2_outside: f32,
    /// The instance that the walk is in.
    pub(super) entrance: Option<Entrance>,
    pub(super) bundle: &'a mut Bundle,
    pub(super) scratch: &'a mut Scratch,
    lanes: std::marker::PhantomData<L>,
}

impl<'a, L: Lanes, B: Bricks> Walk<'a, L, B> {
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    pub(super) unsafe fn run(
        bricks: &'a B,
        start: &Start,
        rays: &[u16],
        open2: f32,
        bundle: &'a mut Bundle,
        scratch: &'a mut Scratch,
    ) {
        let mut walk = Self {
            bricks,
            memory: bricks.memory(),
            open2,
            open2_outside: open2,
            entrance: None,
            bundle,
            scratch,
            lanes: std::marker::PhantomData,
        };
        walk.scratch.stack.clear();
        let count = rays.len();
        match bricks.locate(start.brick) {
            Location::Resident(at) => {
                walk.scratch.lists[..count].copy_from_slice(rays);
                let entry = Entry { address: root_node(at), leaf: NO_LEAF, count: count as u16, first: 0 };
                match start.entrance {
                    None => walk.scratch.stack.push(entry),
                    Some(entrance) => walk.enter(entrance, entry, rays),
                }
            }
            Location::Missing | Location::FarField => {
                let scratch = &mut *walk.scratch;
                let first = scratch.waiting_rays.len() as u32;
                scratch.waiting_rays.extend_from_slice(rays);
                scratch.waiting.push(Waiting { start: *start, first, count: count as u32 });
            }
        }
        while let Some(entry) = walk.scratch.stack.pop() {
            // The list is the topmost one: what it takes becomes free for the children's lists
            let (first, end) = (entry.first as usize, entry.first as usize + usize::from(entry.count));
            if entry.leaf == LEAVE {
                walk.leave();
                continue;
            }
            let scratch = &mut *walk.scratch;
            // SAFETY: `current` has room for all rays of a bundle and the slack
            let count =
                unsafe { L::filter(&walk.bundle.alive, &scratch.lists[first..end], &mut scratch.current) };
            if count == 0 {
                continue;
            }
            if entry.leaf == NO_LEAF {
                // SAFETY: as the caller's
                unsafe { walk.visit_node(entry, count) };
            } else if entry.leaf & INSTANCE == 0 {
                // SAFETY: as the caller's
                unsafe { walk.visit_leaf(entry.address, usize::from(entry.leaf), count) };
            } else {
                walk.visit_instance(entry, count);
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

        // Ask for all children before the rays are tested; places that are not in use are the node itself
        let mut children = [0; WIDTH];
        for (child, &stored) in children.iter_mut().zip(&node.children) {
            *child = entry.address + LOCATION_BYTES * usize::from(stored & LOCATION_MASK);
            prefetch(self.memory, *child);
        }

        // Decode the boxes, and see what is to be opened
        let reach = self.bundle.reach * self.bundle.stretch;
        // SAFETY: as the caller's
        let Look { mut closed, beyond, leaves, elsewhere } = unsafe {
            L::boxes(node, self.bundle.reference, &self.bundle.bounds, boxes);
            L::look(node, boxes, self.open2, reach * reach)
        };
        if closed != 0 {
            for (slot, record) in node.far.iter().enumerate() {
                closed &= !(u8::from(far::must_open(record)) << slot);
            }
        }

        // Test the rays
        let Bundle { box_rays, box_origins, .. } = &*self.bundle;
        // SAFETY: ray numbers in lists are below the bundle's length; `masks` has the slack
        let met = unsafe { L::meet_boxes(boxes, box_rays, box_origins, &current[..count], masks) } & !beyond;

        // Look up what lies elsewhere
        let (mut instances, mut missing) = (0_u8, 0_u8);
        let mut rest = met & !closed & elsewhere;
        while rest != 0 {
            let slot = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            match self.target(entry.address, slot) {
                Target::Node(address) => children[slot] = address,
                Target::Instance => instances |= 1 << slot,
                Target::FarField => closed |= 1 << slot,
                Target::Wait => missing |= 1 << slot,
            }
        }
        if met & closed != 0 {
            // SAFETY: as the caller's
            unsafe { self.meet_far_fields(node, met & closed, count) };
        }

        // Put the others on the stack, far ones first, so that near ones are visited first
        let open = met & !closed;
        let mut order = [0; 2 * WIDTH];
        // SAFETY: as the caller's
        unsafe { L::order(&self.scratch.boxes.distance2, open, &mut order) };
        let mut first = entry.first as usize;
        if self.scratch.lists.len() < first + WIDTH * count + SLACK {
            let longer = 2 * self.scratch.lists.len() + WIDTH * RAYS_MAX;
            self.scratch.lists.resize(longer, 0);
        }
        for &slot in &order[..open.count_ones() as usize] {
            let slot = usize::from(slot) % WIDTH;
            let Scratch { current, masks, lists, stack, .. } = &mut *self.scratch;
            // SAFETY: the list has just been made long enough
            let met = unsafe { L::select(&current[..count], masks, slot, &mut lists[first..]) };
            if missing >> slot & 1 != 0 {
                self.wait(entry.address, slot, first..first + met);
                continue;
            }
            let is_instance = instances >> slot & 1 != 0;
            let stays = (leaves | instances) >> slot & 1 != 0;
            let leaf = slot as u16 | if is_instance { INSTANCE } else { 0 };
            stack.push(Entry {
                address: if stays { entry.address } else { children[slot] },
                leaf: if stays { leaf } else { NO_LEAF },
                count: met as u16,
                first: first as u32,
            });
            first += met;
        }
    }

    /// Lets the rays in a range of the lists wait for the brick that a child of the node at `address` refers to.
    #[inline(never)]
    fn wait(&mut self, address: usize, slot: usize, rays: std::ops::Range<usize>) {
        let child = node_at(self.memory, address).children[slot];
        let brick = match Child::decode(child) {
            Child::Instance(_) => instance_at(self.memory, address, child).brick,
            _ => self.brick_number(address + LOCATION_BYTES * usize::from(child & LOCATION_MASK)),
        };
        let start = self.start(brick, address, slot);
        let scratch = &mut *self.scratch;
        let (first, count) = (scratch.waiting_rays.len() as u32, rays.len() as u32);
        scratch.waiting_rays.extend_from_slice(&scratch.lists[rays]);
        scratch.waiting.push(Waiting { start, first, count });
    }

    /// What a child of the node at `address` asks for that is neither a leaf nor a node of the same brick.
    #[inline(always)]
    fn target(&self, address: usize, slot: usize) -> Target {
        let child = node_at(self.memory, address).children[slot];
        if let Child::Instance(_) = Child::decode(child) {
            let instance = instance_at(self.memory, address, child);
            if self.entrance.is_some() || !instance.is_within_reach(self.scratch.boxes.distance2[slot]) {
                return Target::FarField;
            }
            return match self.bricks.locate(instance.brick) {
                Location::Resident(at) => {
                    prefetch(self.memory, root_node(at));
                    Target::Instance
                }
                Location::FarField => Target::FarField,
                Location::Missing => Target::Wait,
            };
        }
        let number = self.brick_number(address + LOCATION_BYTES * usize::from(child & LOCATION_MASK));
        match self.bricks.locate(number) {
            Location::Resident(at) => Target::Node(root_node(at)),
            Location::FarField => Target::FarField,
            Location::Missing => Target::Wait,
        }
    }

    /// The brick's number at a place in a brick's table.
    #[inline(always)]
    fn brick_number(&self, at: usize) -> u32 {
        let bytes = &self.memory[at..at + 4];
        u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
    }
}

/// What becomes of a child that lies elsewhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Target {
    /// Its far field stands in for it.
    FarField,
    /// It is a node to visit, at this byte address.
    Node(usize),
    /// It is an instance to enter.
    Instance,
    /// It is not in memory.
    Wait,
}

/// The byte address of a brick's root node, from the brick's in units of [`ALIGNMENT`].
#[inline(always)]
pub(super) fn root_node(brick: u32) -> usize {
    brick as usize * ALIGNMENT + HEADER_BYTES
}

/// The node at a byte address.
#[inline(always)]
pub(super) fn node_at(memory: &[u8], address: usize) -> &Node {
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
