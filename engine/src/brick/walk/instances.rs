//! A walk's way into an instance and out of it again.
//!
//! The rays that meet an instance's box are turned onto the prototype's lattice and go on there with the same numbers, until
//! all that the instance put on the stack is done. Prototypes have no instances.

use glam::IVec3;

use super::super::instance::Instance;
use super::super::lanes::Lanes;
use super::super::node::{Child, LOCATION_BYTES};
use super::nodes::{LOCATION_MASK, Walk, node_at, root_node};
use super::scratch::{Entry, INSTANCE, LEAVE, NO_LEAF, Scratch};
use super::{Bricks, Location};

/// An instance and the lower corner of its decoded box: what a walk needs to enter it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Entrance {
    /// The record.
    pub instance: Instance,
    /// Lattice coordinates of the map.
    pub corner: IVec3,
}

/// Where a walk starts: at a brick, and inside an instance if the brick is a prototype's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Start {
    /// The brick.
    pub brick: u32,
    /// The instance.
    pub entrance: Option<Entrance>,
}

impl<L: Lanes, B: Bricks> Walk<'_, L, B> {
    /// Takes `count` rays onto the lattice of an instance's prototype.
    #[inline(never)]
    pub(super) fn visit_instance(&mut self, entry: Entry, count: usize) {
        let slot = usize::from(entry.leaf & !INSTANCE);
        let entrance = entrance_at(self.memory, entry.address, slot);
        let Location::Resident(at) = self.bricks.locate(entrance.instance.brick) else { return };
        let current = std::mem::take(&mut self.scratch.current);
        self.scratch.lists[entry.first as usize..][..count].copy_from_slice(&current[..count]);
        let root = Entry { address: root_node(at), leaf: NO_LEAF, count: count as u16, ..entry };
        self.enter(entrance, root, &current[..count]);
        self.scratch.current = current;
    }

    /// Enters an instance, to go on there at `root` with the list of `rays`.
    pub(super) fn enter(&mut self, entrance: Entrance, root: Entry, rays: &[u16]) {
        let Scratch { inside, stack, counts, .. } = &mut *self.scratch;
        inside.place(self.bundle, rays, &entrance.instance, entrance.corner);
        inside.swap(self.bundle);
        stack.push(Entry { leaf: LEAVE, count: 0, ..root });
        stack.push(root);
        counts.instances += 1;
        counts.instance_rays += rays.len() as u64;
        self.open2 = self.open2_outside * entrance.instance.evenness();
        self.entrance = Some(entrance);
    }

    /// Comes back out of an instance.
    pub(super) fn leave(&mut self) {
        self.scratch.inside.swap(self.bundle);
        self.open2 = self.open2_outside;
        self.entrance = None;
    }

    /// Where rays go on that wait for `brick`, which a child of the node at `address` refers to.
    #[inline(never)]
    pub(super) fn start(&self, brick: u32, address: usize, slot: usize) -> Start {
        let entrance = match Child::decode(node_at(self.memory, address).children[slot]) {
            Child::Instance(_) => Some(entrance_at(self.memory, address, slot)),
            _ => self.entrance,
        };
        Start { brick, entrance }
    }
}

/// The instance that a child of the node at a byte address is.
fn entrance_at(memory: &[u8], address: usize, slot: usize) -> Entrance {
    let node = node_at(memory, address);
    let instance = instance_at(memory, address, node.children[slot]);
    Entrance { instance, corner: node.lower_corner(slot) }
}

/// The record that `child` of the node at a byte address refers to.
#[inline(always)]
pub(super) fn instance_at(memory: &[u8], address: usize, child: u16) -> Instance {
    Instance::read(&memory[address + LOCATION_BYTES * usize::from(child & LOCATION_MASK)..])
}
