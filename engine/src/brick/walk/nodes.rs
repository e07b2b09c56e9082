//! A walk's nodes: from the stack, through the rays' box tests, to the children that are opened.

use super::super::ALIGNMENT;
use super::super::bundle::Bundle;
use super::super::far;
use super::super::lanes::{Lanes, SLACK};
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

        // Decode the boxes, and see what is to be opened
        // SAFETY: as the caller's
        unsafe { L::boxes(node, self.bundle.reference, &self.bundle.bounds, boxes) };
        let mut far_mask = 0_u8;
        let mut beyond = (0xff_u32 << node.count) as u8;
        let reach = self.bundle.reach * self.bundle.stretch;
        let reach2 = reach * reach;
        for slot in 0..usize::from(node.count) {
            if boxes.diagonal2[slot] < self.open2 * boxes.distance2[slot] && !far::must_open(&node.far[slot])
            {
                far_mask |= 1 << slot;
            }
            beyond |= u8::from(boxes.distance2[slot] > reach2) << slot;
            // A node, leaf or instance that will be visited is asked for before the rays are tested
            let child = node.children[slot];
            if child >> LOCATION_BITS != 2 {
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
            targets[slot] = self.target(entry.address, slot);
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
                Target::Instance => {
                    let (address, leaf) = (entry.address, slot as u16 | INSTANCE);
                    stack.push(Entry { address, leaf, count: met as u16, first: first as u32 });
                    first += met;
                }
                Target::Wait(brick) => {
                    let start = self.start(brick, entry.address, slot);
                    let scratch = &mut *self.scratch;
                    let begin = scratch.waiting_rays.len() as u32;
                    scratch.waiting_rays.extend_from_slice(&scratch.lists[first..first + met]);
                    scratch.waiting.push(Waiting { start, first: begin, count: met as u32 });
                }
                Target::FarField => {}
            }
        }
    }

    /// What a child of the node at `address` asks for.
    #[inline(always)]
    fn target(&self, address: usize, slot: usize) -> Target {
        let child = node_at(self.memory, address).children[slot];
        match Child::decode(child) {
            Child::Node(offset) => Target::Node(address + LOCATION_BYTES * usize::from(offset)),
            Child::Leaf(_) => Target::Leaf,
            Child::Brick(offset) => {
                let at = address + LOCATION_BYTES * usize::from(offset);
                let number = u32::from_le_bytes(self.memory[at..at + 4].try_into().expect("4 bytes"));
                match self.bricks.locate(number) {
                    Location::Resident(at) => Target::Node(root_node(at)),
                    Location::FarField => Target::FarField,
                    Location::Missing => Target::Wait(number),
                }
            }
            Child::Instance(_) => {
                let instance = instance_at(self.memory, address, child);
                let distance2 = self.scratch.boxes.distance2[slot];
                match self.bricks.locate(instance.brick) {
                    _ if self.entrance.is_some() || !instance.is_within_reach(distance2) => Target::FarField,
                    Location::Resident(at) => {
                        prefetch(self.memory, root_node(at));
                        Target::Instance
                    }
                    Location::FarField => Target::FarField,
                    Location::Missing => Target::Wait(instance.brick),
                }
            }
        }
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
    /// It is an instance to enter.
    Instance,
    /// It is a brick that is not in memory.
    Wait(u32),
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
