//! A walk's leaves: rays against faces.

use glam::Vec3;

use super::super::bundle::EXTINCTION_OPAQUE;
use super::super::intersect;
use super::super::lanes::{Lanes, within};
use super::super::leaf::{self, Kind, Layout};
use super::super::node::LOCATION_BYTES;
use super::Bricks;
use super::nodes::{LOCATION_MASK, Walk, node_at};
use super::scratch::Scratch;

impl<L: Lanes, B: Bricks> Walk<'_, L, B> {
    /// Tests `count` rays against the faces of a node's leaf.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    pub(super) unsafe fn visit_leaf(&mut self, node: usize, slot: usize, count: usize) {
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
        let near = self.bundle.near * self.bundle.stretch;
        gap2 <= near * near
    }

    /// Looks again, in double precision, at those of `hits` that are near. The faces that are met.
    #[inline(never)]
    fn retest(
        &mut self,
        leaf: &[u8],
        layout: &Layout,
        origin: &super::super::bundle::Origin,
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
            let mut direction = Vec3::from_slice(&direction[..3]).as_dvec3();
            let mut reach = reach;
            if self.entrance.is_some() {
                let length = direction.length();
                (direction, reach) = (direction / length, reach * length);
            }
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

/// A stored extinction as it adds up: an opaque face ends every ray.
#[inline(always)]
pub(super) fn face_extinction(stored: u16) -> u32 {
    if stored == leaf::OPAQUE { EXTINCTION_OPAQUE } else { u32::from(stored) }
}
