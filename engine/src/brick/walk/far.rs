//! What rays meet of children that are not opened.

use glam::Vec3;

use super::super::bundle::EXTINCTION_OPAQUE;
use super::super::far::{self, Aggregate, Plate, SeenBox};
use super::super::lanes::Lanes;
use super::super::node::Node;
use super::Bricks;
use super::leaf::face_extinction;
use super::nodes::Walk;
use super::scratch::Scratch;

impl<L: Lanes, B: Bricks> Walk<'_, L, B> {
    /// Adds the extinction of the children in `far_mask` to the rays that meet their boxes.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    pub(super) unsafe fn meet_far_fields(&mut self, node: &Node, mut far_mask: u8, count: usize) {
        while far_mask != 0 {
            let slot = far_mask.trailing_zeros() as usize;
            far_mask &= far_mask - 1;
            let Scratch { current, masks, far, .. } = &mut *self.scratch;
            // SAFETY: lists are long enough for all rays of a bundle and the slack
            let met = unsafe { L::select(&current[..count], masks, slot, far) };
            self.scratch.counts.far_hits += met as u64;
            let (record, half) = (&node.far[slot], node.child_half(slot));
            match far::kind(record) {
                // SAFETY: as the caller's
                far::Kind::Single | far::Kind::Layered => unsafe { self.meet_aggregate(record, half, met) },
                // SAFETY: as the caller's
                far::Kind::Plate => unsafe { self.meet_plate(record, half, slot, met) },
                far::Kind::Scalar => {
                    let extinction = face_extinction(u16::from_le_bytes([record[0], record[1]]));
                    for i in 0..met {
                        let ray = self.scratch.far[i];
                        self.bundle.extinguish(ray, extinction);
                    }
                }
            }
        }
    }

    /// Adds an aggregate's extinction to the first `met` rays of the list.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    unsafe fn meet_aggregate(&mut self, record: &far::Record, half: Vec3, met: usize) {
        let aggregate = Aggregate::decode(record);
        for i in 0..met {
            let ray = self.scratch.far[i];
            let direction = Vec3::from_slice(&self.bundle.directions[usize::from(ray)][..3]);
            let extinction = aggregate.extinction(direction, half);
            self.bundle.extinguish(ray, extinction);
        }
    }

    /// Ends those of the first `met` rays of the list that meet a plate.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(never)]
    unsafe fn meet_plate(&mut self, record: &far::Record, half: Vec3, slot: usize, met: usize) {
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
}
