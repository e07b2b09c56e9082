//! A walk's leaves: rays against faces.

use glam::Vec3;

use super::super::bundle::EXTINCTION_OPAQUE;
use super::super::intersect;
use super::super::lanes::{BOX_ERROR, Lanes, within};
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
            // SAFETY: as the caller's
            unsafe { self.visit_round_leaf(bytes, &layout, count) };
            return;
        }
        // SAFETY: the brick was checked when it was loaded, and memory runs on past it
        unsafe { L::corners(bytes, &layout, self.bundle.reference, &mut self.scratch.corners) };
        let is_near = self.is_near(&layout);
        let again = is_near || self.bundle.reach.is_finite();

        // Test the rays, which are in the order of their origins, and keep those that meet faces
        let (mut origin, mut end) = (0, 0);
        let mut met = 0;
        for i in 0..count {
            let ray = self.scratch.current[i];
            if ray >= end {
                while ray >= self.bundle.origins[origin].end {
                    origin += 1;
                }
                end = self.bundle.origins[origin].end;
                let offset = self.bundle.origins[origin].position.wrapping_sub(self.bundle.reference);
                let Scratch { corners, planes, .. } = &mut *self.scratch;
                // SAFETY: as the caller's
                unsafe { L::planes(corners, offset, is_near, planes) };
            }
            let direction = &self.bundle.directions[usize::from(ray)];
            // SAFETY: as the caller's
            let hits = unsafe { L::meet_planes(&self.scratch.planes, direction) };
            let faces = if again && hits != 0 {
                self.look_again(bytes, &layout, origin, ray, hits)
            } else {
                layout.kind.faces(hits)
            };
            self.scratch.met[met] = (ray, faces);
            met += usize::from(faces != 0);
        }

        // Add up what they met
        for i in 0..met {
            let (ray, faces) = self.scratch.met[i];
            // SAFETY: as the caller's
            unsafe { self.meet_faces(bytes, &layout, ray, faces) };
        }
    }

    /// The faces of `hits` that a ray meets within its reach; those that are near are tested again in double precision.
    #[inline(never)]
    fn look_again(&mut self, leaf: &[u8], layout: &Layout, origin: usize, ray: u16, mut hits: u16) -> u16 {
        let direction = self.bundle.directions[usize::from(ray)];
        if self.bundle.reach.is_finite() {
            hits = within(&self.scratch.planes, &direction, hits, self.bundle.reach);
        }
        if self.bundle.near == 0.0 || hits == 0 {
            return layout.kind.faces(hits);
        }
        let origin = self.bundle.origins[origin];
        self.retest(leaf, layout, &origin, &direction, hits)
    }

    /// Whether the leaf's vertices may lie within the near distance of an origin, or touch one.
    #[inline(always)]
    fn is_near(&self, layout: &Layout) -> bool {
        let (bounds, mut gap2, mut size) = (&self.bundle.bounds, 0.0, 0.0);
        for axis in 0..3 {
            let lower = layout.origin[axis].wrapping_sub(self.bundle.reference[axis]) as f32;
            let upper = lower + ((1_u64 << layout.bits[axis]) << layout.shift) as f32;
            let gap = (lower - bounds[1][axis]).max(bounds[0][axis] - upper).max(0.0);
            gap2 += gap * gap;
            size += lower.abs() + upper.abs();
        }
        // Differences are rounded
        let near = self.bundle.near * self.bundle.stretch + BOX_ERROR * size;
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
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(never)]
    unsafe fn visit_round_leaf(&mut self, leaf: &[u8], layout: &Layout, count: usize) {
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
                // SAFETY: as the caller's
                unsafe { self.meet_faces(leaf, layout, ray, faces) };
            }
        }
    }

    /// Adds the extinction of the faces in the mask to a ray.
    ///
    /// # Safety
    /// The instruction set of `L` is available.
    #[inline(always)]
    unsafe fn meet_faces(&mut self, leaf: &[u8], layout: &Layout, ray: u16, mut faces: u16) {
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
