//! The inner loops over plain arrays. Compiled with AVX2 enabled they are the AVX2 version.

use glam::{IVec3, Vec3};

use super::{BOX_ERROR, Boxes, Corners, Lanes, Look, Planes};
use crate::brick::bundle::{BoxOrigins, BoxRay};
use crate::brick::leaf::{FACES_MAX, Kind, Layout, VERTICES_MAX};
use crate::brick::node::{LOCATION_BITS, Node, WIDTH};

/// The plain loops.
#[derive(Clone, Copy, Debug)]
pub struct Plain;

impl Lanes for Plain {
    #[inline(always)]
    unsafe fn filter(alive: &[u32], ids: &[u16], out: &mut [u16]) -> usize {
        let mut count = 0;
        for &id in ids {
            out[count] = id;
            count += (alive[usize::from(id) / 32] >> (id % 32) & 1) as usize;
        }
        count
    }

    #[inline(always)]
    unsafe fn boxes(node: &Node, reference: IVec3, origins: &[Vec3; 2], out: &mut Boxes) {
        let mut distance2 = [0.0_f32; WIDTH];
        let mut diagonal2 = [0.0_f32; WIDTH];
        for axis in 0..3 {
            let base = node.origin[axis].wrapping_sub(reference[axis]) as f32;
            let scale = f32::from_bits((u32::from(node.exponent[axis]) + 127) << 23);
            let reach = origins[0][axis].abs().max(origins[1][axis].abs());
            for slot in 0..WIDTH {
                let lower = f32::from(node.lower[axis][slot]);
                let upper = f32::from(node.upper[axis][slot]);
                let center = (lower + upper).mul_add(0.5 * scale, base);
                let half = (upper - lower) * (0.5 * scale);
                let below = origins[0][axis] - (center + half);
                let above = (center - half) - origins[1][axis];
                let gap = max(max(below, above), 0.0);
                distance2[slot] = gap.mul_add(gap, distance2[slot]);
                diagonal2[slot] = (4.0 * half).mul_add(half, diagonal2[slot]);
                out.center[axis][slot] = center;
                out.half[axis][slot] = (center.abs() + half + reach).mul_add(BOX_ERROR, half);
            }
        }
        (out.distance2, out.diagonal2) = (distance2, diagonal2);
    }

    #[inline(always)]
    unsafe fn look(node: &Node, boxes: &Boxes, open2: f32, reach2: f32) -> Look {
        let mut look = Look { beyond: (0xff_u32 << node.count) as u8, ..Look::default() };
        for slot in 0..WIDTH {
            let kind = node.children[slot] >> LOCATION_BITS;
            look.closed |= u8::from(boxes.diagonal2[slot] < open2 * boxes.distance2[slot]) << slot;
            look.beyond |= u8::from(boxes.distance2[slot] > reach2) << slot;
            look.leaves |= u8::from(kind == 1) << slot;
            look.elsewhere |= u8::from(kind > 1) << slot;
        }
        look
    }

    #[inline(always)]
    unsafe fn order(distance2: &[f32; WIDTH], open: u8, out: &mut [u8; 2 * WIDTH]) {
        // Squared distances are not negative: their bits are in their order
        let key = |slot: usize| distance2[slot].to_bits() & !7 | slot as u32;
        for slot in (0..WIDTH).filter(|slot| open >> slot & 1 != 0) {
            let farther = (0..WIDTH).filter(|&other| open >> other & 1 != 0 && key(other) > key(slot));
            out[farther.count()] = slot as u8;
        }
    }

    #[inline(always)]
    unsafe fn meet_boxes(
        boxes: &Boxes,
        rays: &[BoxRay],
        origins: &BoxOrigins,
        ids: &[u16],
        masks: &mut [u8],
    ) -> u8 {
        let mut any = 0;
        for (&id, mask) in ids.iter().zip(masks) {
            let ray = &rays[usize::from(id)];
            let mut enter = [0.0_f32; WIDTH];
            let mut leave = [f32::MAX; WIDTH];
            for axis in 0..3 {
                let inverse = ray.inverse[axis];
                let offset = origins[axis][ray.origin as usize] * inverse;
                for slot in 0..WIDTH {
                    let middle = boxes.center[axis][slot].mul_add(inverse, -offset);
                    let half = boxes.half[axis][slot];
                    enter[slot] = max((-half).mul_add(inverse.abs(), middle), enter[slot]);
                    leave[slot] = min(half.mul_add(inverse.abs(), middle), leave[slot]);
                }
            }
            *mask = (0..WIDTH).fold(0, |mask, slot| mask | u8::from(enter[slot] <= leave[slot]) << slot);
            any |= *mask;
        }
        any
    }

    #[inline(always)]
    unsafe fn select(ids: &[u16], masks: &[u8], slot: usize, out: &mut [u16]) -> usize {
        let mut count = 0;
        for (&id, &mask) in ids.iter().zip(masks) {
            out[count] = id;
            count += usize::from(mask >> slot & 1);
        }
        count
    }

    #[inline(always)]
    unsafe fn corners(leaf: &[u8], layout: &Layout, reference: IVec3, out: &mut Corners) {
        let mut vertices = [[0_i32; VERTICES_MAX]; 3];
        for axis in 0..3 {
            let mut packed = [0; VERTICES_MAX];
            layout.unpack(leaf, axis, &mut packed);
            let base = layout.origin[axis].wrapping_sub(reference[axis]);
            for (vertex, packed) in vertices[axis].iter_mut().zip(packed) {
                *vertex = base.wrapping_add((packed << layout.shift) as i32);
            }
        }
        if layout.kind == Kind::Triangles {
            for face in 0..layout.faces.min(16) {
                for corner in 0..3 {
                    let index = layout.index(leaf, face, corner) % VERTICES_MAX;
                    for axis in 0..3 {
                        out.coordinates[corner][axis][face] = vertices[axis][index];
                    }
                }
            }
            (out.present, out.quads) = (((1_u32 << layout.faces) - 1) as u16, false);
            return;
        }
        for face in 0..FACES_MAX.min(layout.faces) {
            let indices = [0, 1, 2, 3].map(|corner| layout.index(leaf, face, corner) % VERTICES_MAX);
            for axis in 0..3 {
                let [a, b, c, d] = indices.map(|index| vertices[axis][index]);
                (out.coordinates[0][axis][face], out.coordinates[0][axis][face + 8]) = (a, a);
                (out.coordinates[1][axis][face], out.coordinates[1][axis][face + 8]) = (b, c);
                (out.coordinates[2][axis][face], out.coordinates[2][axis][face + 8]) = (c, d);
            }
        }
        let present = ((1_u32 << layout.faces) - 1) as u16;
        (out.present, out.quads) = (present | present << 8, true);
    }

    #[inline(always)]
    unsafe fn planes(source: &Corners, offset: IVec3, is_near: bool, out: &mut Planes) {
        let mut corners = [[[0.0_f32; 16]; 3]; 3];
        let mut touches = 0_u16;
        for (corner, from) in corners.iter_mut().zip(&source.coordinates) {
            let mut at_origin = if is_near { u16::MAX } else { 0 };
            for axis in 0..3 {
                for lane in 0..16 {
                    let relative = from[axis][lane].wrapping_sub(offset[axis]);
                    corner[axis][lane] = relative as f32;
                    at_origin &= !(u16::from(relative != 0) << lane);
                }
            }
            touches |= at_origin;
        }
        // Both triangles of a quad are left out
        let excluded = if source.quads { touches | touches >> 8 | touches << 8 } else { touches };
        let [a, b, c] = &corners;
        let edges = [[a, b], [b, c], [c, a]];
        // Products are not fused: both faces of an edge get the same numbers with opposite signs
        for (normal, [p, q]) in out.normals.iter_mut().zip(edges) {
            for axis in 0..3 {
                let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
                for lane in 0..16 {
                    normal[axis][lane] = p[i][lane] * q[j][lane] - p[j][lane] * q[i][lane];
                }
            }
        }
        let mut valid = 0_u16;
        for lane in 0..16 {
            let n = &out.normals[1];
            let volume =
                a[2][lane].mul_add(n[2][lane], a[1][lane].mul_add(n[1][lane], a[0][lane] * n[0][lane]));
            let sign = 1.0_f32.copysign(volume);
            out.normals.iter_mut().flatten().for_each(|normal| normal[lane] *= sign);
            out.volume[lane] = volume.abs();
            valid |= u16::from(volume != 0.0) << lane;
        }
        out.valid = valid & !excluded & source.present;
    }

    #[inline(always)]
    unsafe fn meet_planes(planes: &Planes, direction: &[f32; 4]) -> u16 {
        let mut hits = planes.valid;
        for normal in &planes.normals {
            let mut inside = 0;
            for lane in 0..16 {
                let product = direction[2].mul_add(
                    normal[2][lane],
                    direction[1].mul_add(normal[1][lane], direction[0] * normal[0][lane]),
                );
                inside |= u16::from(product >= 0.0) << lane;
            }
            hits &= inside;
        }
        hits
    }
}

/// As the machines' instruction has it: the second operand if either is not a number.
#[inline(always)]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// See [`max`].
#[inline(always)]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}
