//! The inner loops for AVX-512: 32 ray numbers, 16 triangles or 8 boxes at a time.
//!
//! There are no closures here: one is a
//! function of its own, compiled without the instruction set, and every intrinsic in it would become a call.

use std::arch::x86_64::*;

use glam::{IVec3, Vec3};

use super::plain::Plain;
use super::{BOX_ERROR, Boxes, Corners, Lanes, Look, Planes, SLACK};
use crate::brick::bundle::{BoxOrigins, BoxRay, POINTS_MAX};
use crate::brick::leaf::{Kind, Layout, predict};
use crate::brick::node::{LOCATION_BITS, Node, WIDTH};

/// The loops for AVX-512 F, BW, DQ, VL, VBMI and VBMI2.
#[derive(Clone, Copy, Debug)]
pub struct Avx512;

/// Up to this many rays are tested one by one.
const SINGLE_MAX: usize = 6;

const _: () = assert!(SINGLE_MAX <= 8);
const _: () = assert!(POINTS_MAX == 32, "two vectors of origins");

/// Coordinates of more bits do not fit a 32-bit lane at every bit offset.
const LANE_BITS_MAX: u8 = 25;

impl Lanes for Avx512 {
    #[inline(always)]
    unsafe fn filter(alive: &[u32], ids: &[u16], out: &mut [u16]) -> usize {
        debug_assert!(out.len() >= ids.len() + SLACK);
        // SAFETY: loads are masked to `ids`; stores of 16 numbers stay within the slack; words of rays that exist are looked up
        unsafe {
            let mut count = 0;
            for chunk in ids.chunks(16) {
                let present = u16::MAX >> (16 - chunk.len());
                let ids = _mm256_maskz_loadu_epi16(present, chunk.as_ptr().cast());
                let ray = _mm512_cvtepu16_epi32(ids);
                let word = _mm512_srli_epi32::<5>(ray);
                let words = _mm512_i32gather_epi32::<4>(word, alive.as_ptr().cast());
                let bit = _mm512_rolv_epi32(_mm512_set1_epi32(1), ray);
                let keep = _mm512_mask_test_epi32_mask(present, words, bit);
                _mm256_storeu_si256(
                    out.as_mut_ptr().add(count).cast(),
                    _mm256_maskz_compress_epi16(keep, ids),
                );
                count += keep.count_ones() as usize;
            }
            count
        }
    }

    #[inline(always)]
    unsafe fn boxes(node: &Node, reference: IVec3, origins: &[Vec3; 2], out: &mut Boxes) {
        // SAFETY: loads are of 8 bytes of the node's own arrays; `out` is made of arrays of 8
        unsafe {
            let mut distance2 = _mm256_setzero_ps();
            let mut diagonal2 = _mm256_setzero_ps();
            for axis in 0..3 {
                let base = _mm256_set1_ps(node.origin[axis].wrapping_sub(reference[axis]) as f32);
                let scale = f32::from_bits((u32::from(node.exponent[axis]) + 127) << 23);
                let half_scale = _mm256_set1_ps(0.5 * scale);
                let (first, last) = (origins[0][axis], origins[1][axis]);
                let reach = _mm256_set1_ps(first.abs().max(last.abs()));
                let (lower, upper) = (widen(&node.lower[axis]), widen(&node.upper[axis]));
                let center = _mm256_fmadd_ps(_mm256_add_ps(lower, upper), half_scale, base);
                let half = _mm256_mul_ps(_mm256_sub_ps(upper, lower), half_scale);
                let below = _mm256_sub_ps(_mm256_set1_ps(first), _mm256_add_ps(center, half));
                let above = _mm256_sub_ps(_mm256_sub_ps(center, half), _mm256_set1_ps(last));
                let gap = _mm256_max_ps(_mm256_max_ps(below, above), _mm256_setzero_ps());
                distance2 = _mm256_fmadd_ps(gap, gap, distance2);
                diagonal2 = _mm256_fmadd_ps(_mm256_mul_ps(_mm256_set1_ps(4.0), half), half, diagonal2);
                let size = _mm256_add_ps(_mm256_add_ps(absolute(center), half), reach);
                let padded = _mm256_fmadd_ps(size, _mm256_set1_ps(BOX_ERROR), half);
                _mm256_storeu_ps(out.center[axis].as_mut_ptr(), center);
                _mm256_storeu_ps(out.half[axis].as_mut_ptr(), padded);
            }
            _mm256_storeu_ps(out.distance2.as_mut_ptr(), distance2);
            _mm256_storeu_ps(out.diagonal2.as_mut_ptr(), diagonal2);
        }
    }

    #[inline(always)]
    unsafe fn look(node: &Node, boxes: &Boxes, open2: f32, reach2: f32) -> Look {
        // SAFETY: arrays of 8
        unsafe {
            let distance2 = _mm256_loadu_ps(boxes.distance2.as_ptr());
            let diagonal2 = _mm256_loadu_ps(boxes.diagonal2.as_ptr());
            let limit = _mm256_mul_ps(_mm256_set1_ps(open2), distance2);
            let beyond = _mm256_cmp_ps_mask::<_CMP_GT_OQ>(distance2, _mm256_set1_ps(reach2));
            let children = _mm_loadu_si128(node.children.as_ptr().cast());
            let kind = _mm_srli_epi16::<{ LOCATION_BITS as i32 }>(children);
            Look {
                closed: _mm256_cmp_ps_mask::<_CMP_LT_OQ>(diagonal2, limit),
                beyond: beyond | (0xff_u32 << node.count) as u8,
                leaves: _mm_cmpeq_epi16_mask(kind, _mm_set1_epi16(1)),
                elsewhere: _mm_cmpgt_epi16_mask(kind, _mm_set1_epi16(1)),
            }
        }
    }

    #[inline(always)]
    unsafe fn order(distance2: &[f32; WIDTH], open: u8, out: &mut [u8; 2 * WIDTH]) {
        // SAFETY: an array of 8
        unsafe {
            let slot = _mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0);
            let distance = _mm256_loadu_si256(distance2.as_ptr().cast());
            let key = _mm256_or_si256(_mm256_andnot_si256(_mm256_set1_epi32(7), distance), slot);
            for i in 0..WIDTH {
                let this = _mm256_permutexvar_epi32(_mm256_set1_epi32(i as i32), key);
                let farther = _mm256_mask_cmpgt_epi32_mask(open, key, this).count_ones() as usize;
                // Children that are not open go where nobody looks
                let closed = usize::from(!open >> i & 1);
                out[farther | closed * WIDTH] = i as u8;
            }
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
        debug_assert!(masks.len() >= ids.len() + SLACK);
        // SAFETY: loads of ids are masked; `masks` has the slack; ids are rays, the first one in lanes without a ray
        unsafe {
            let mut any = _mm_setzero_si128();
            for (i, ids) in ids.chunks(16).enumerate() {
                let met = if ids.len() > SINGLE_MAX {
                    meet_boxes_16(boxes, rays, origins, ids)
                } else {
                    meet_boxes_singly(boxes, rays, origins, ids)
                };
                // Masks go out in one piece, so that the selections' loads can be served from the store
                _mm_storeu_si128(masks.as_mut_ptr().add(16 * i).cast(), met);
                any = _mm_or_si128(any, met);
            }
            let any = _mm_or_si128(any, _mm_srli_si128::<8>(any));
            let any = _mm_cvtsi128_si64(any) as u64;
            let any = any | any >> 32;
            let any = any | any >> 16;
            (any | any >> 8) as u8
        }
    }

    #[inline(always)]
    unsafe fn select(ids: &[u16], masks: &[u8], slot: usize, out: &mut [u16]) -> usize {
        debug_assert!(out.len() >= ids.len() + SLACK && masks.len() >= ids.len() + SLACK);
        // SAFETY: loads of ids are masked; masks and `out` have the slack
        unsafe {
            let bit = _mm256_set1_epi8((1_u8 << slot) as i8);
            let mut count = 0;
            for (i, chunk) in ids.chunks(32).enumerate() {
                let present = u32::MAX >> (32 - chunk.len());
                let ids = _mm512_maskz_loadu_epi16(present, chunk.as_ptr().cast());
                let masks = _mm256_loadu_si256(masks.as_ptr().add(32 * i).cast());
                let keep = _mm256_mask_test_epi8_mask(present, masks, bit);
                _mm512_storeu_si512(
                    out.as_mut_ptr().add(count).cast(),
                    _mm512_maskz_compress_epi16(keep, ids),
                );
                count += keep.count_ones() as usize;
            }
            count
        }
    }

    #[inline(always)]
    unsafe fn corners(leaf: &[u8], layout: &Layout, reference: IVec3, out: &mut Corners) {
        let widest = |bits: [u8; 3]| bits[0].max(bits[1]).max(bits[2]);
        if widest(layout.bits).max(layout.rest_bits.map_or(0, widest)) > LANE_BITS_MAX {
            // SAFETY: the caller's
            return unsafe { Plain::corners(leaf, layout, reference, out) };
        }
        debug_assert!(leaf.len() >= layout.bytes + crate::brick::leaf::READ_PAST_BYTES);
        // SAFETY: the leaf was checked and may be read 64 bytes past its end: indices take at most 40 bytes from byte 4 on,
        // and 16 coordinates start within the leaf
        unsafe {
            // Unpack the vertices relative to the reference
            let many = layout.vertices > 16;
            let tile = layout.rest_bits.map(|rest_bits| (PredictedTile::of(layout), rest_bits));
            let zero = _mm512_setzero_si512();
            let (mut first, mut second) = ([zero; 3], [zero; 3]);
            for axis in 0..3 {
                let bits = layout.bits[axis];
                let base = _mm512_set1_epi32(layout.origin[axis].wrapping_sub(reference[axis]));
                let shift = _mm_cvtsi32_si128(i32::from(layout.shift));
                let packed = leaf.as_ptr().add(layout.coordinates[axis]);
                let unpacked = match &tile {
                    Some((tile, rest_bits)) => tile.unpack(packed, bits, rest_bits[axis]),
                    None => unpack(packed, bits),
                };
                first[axis] = _mm512_add_epi32(_mm512_sll_epi32(unpacked, shift), base);
                if many {
                    let packed = packed.add(2 * usize::from(bits));
                    second[axis] = _mm512_add_epi32(_mm512_sll_epi32(unpack(packed, bits), shift), base);
                }
            }

            let lanes = if layout.columns > 0 {
                row_lanes(tile_faces(layout.columns), layout.stride)
            } else if layout.stride > 0 {
                let firsts = unpack(leaf.as_ptr().add(layout.indices), layout.index_bits as u8);
                row_lanes(pair(firsts, firsts), layout.stride)
            } else {
                index_lanes(leaf, layout)
            };

            // Gather the corners
            for axis in 0..3 {
                for c in 0..3 {
                    let gathered = if many {
                        _mm512_permutex2var_epi32(first[axis], lanes[c], second[axis])
                    } else {
                        _mm512_permutexvar_epi32(lanes[c], first[axis])
                    };
                    _mm512_storeu_si512(out.coordinates[c][axis].as_mut_ptr().cast(), gathered);
                }
            }
            let present = ((1_u32 << layout.faces) - 1) as u16;
            out.quads = layout.kind != Kind::Triangles;
            out.present = if out.quads { present | present << 8 } else { present };
        }
    }

    #[inline(always)]
    unsafe fn planes(source: &Corners, offset: IVec3, is_near: bool, out: &mut Planes) {
        // SAFETY: arrays of 16
        unsafe {
            // Exclude faces with a corner at the origin, both triangles of them
            let mut corners = [[_mm512_setzero_ps(); 3]; 3];
            let mut touches = 0_u16;
            for (corner, from) in corners.iter_mut().zip(&source.coordinates) {
                let mut at_origin = if is_near { u16::MAX } else { 0 };
                for axis in 0..3 {
                    let coordinates = _mm512_loadu_si512(from[axis].as_ptr().cast());
                    let relative = _mm512_sub_epi32(coordinates, _mm512_set1_epi32(offset[axis]));
                    if is_near {
                        at_origin = _mm512_mask_testn_epi32_mask(at_origin, relative, relative);
                    }
                    corner[axis] = _mm512_cvtepi32_ps(relative);
                }
                touches |= at_origin;
            }
            let excluded = if source.quads { touches | touches >> 8 | touches << 8 } else { touches };
            let mut valid = source.present & !excluded;

            // Make the planes; products are not fused, see the plain version
            let [a, b, c] = corners;
            let mut normals = [cross(a, b), cross(b, c), cross(c, a)];
            let n = normals[1];
            let volume = _mm512_fmadd_ps(a[2], n[2], _mm512_fmadd_ps(a[1], n[1], _mm512_mul_ps(a[0], n[0])));
            valid &= _mm512_cmp_ps_mask::<_CMP_NEQ_OQ>(volume, _mm512_setzero_ps());
            let sign = _mm512_and_ps(volume, _mm512_set1_ps(-0.0));
            for (normal, out) in normals.iter_mut().zip(&mut out.normals) {
                for (component, out) in normal.iter_mut().zip(out) {
                    *component = _mm512_xor_ps(*component, sign);
                    _mm512_storeu_ps(out.as_mut_ptr(), *component);
                }
            }
            _mm512_storeu_ps(out.volume.as_mut_ptr(), _mm512_andnot_ps(_mm512_set1_ps(-0.0), volume));
            out.valid = valid;
        }
    }

    #[inline(always)]
    unsafe fn meet_planes(planes: &Planes, direction: &[f32; 4]) -> u16 {
        // SAFETY: arrays of 16
        unsafe {
            let [x, y, z, _] = *direction;
            let d = [_mm512_set1_ps(x), _mm512_set1_ps(y), _mm512_set1_ps(z)];
            let mut hits = planes.valid;
            for normal in &planes.normals {
                let [x, y, z] = normal;
                let n =
                    [_mm512_loadu_ps(x.as_ptr()), _mm512_loadu_ps(y.as_ptr()), _mm512_loadu_ps(z.as_ptr())];
                let product =
                    _mm512_fmadd_ps(d[2], n[2], _mm512_fmadd_ps(d[1], n[1], _mm512_mul_ps(d[0], n[0])));
                hits = _mm512_mask_cmp_ps_mask::<_CMP_GE_OQ>(hits, product, _mm512_setzero_ps());
            }
            hits
        }
    }
}

/// The boxes that each of a few rays meets, a byte a ray: one ray against all boxes at a time.
#[inline(always)]
unsafe fn meet_boxes_singly(boxes: &Boxes, rays: &[BoxRay], origins: &BoxOrigins, ids: &[u16]) -> __m128i {
    // SAFETY: arrays of 8; ids are rays, whose origins are below `POINTS_MAX`
    unsafe {
        let mut masks = 0_u64;
        for (i, &id) in ids.iter().enumerate() {
            let ray = rays.get_unchecked(usize::from(id));
            let mut enter = _mm256_setzero_ps();
            let mut leave = _mm256_set1_ps(f32::MAX);
            for axis in 0..3 {
                let inverse = _mm256_set1_ps(ray.inverse[axis]);
                let origin = *origins[axis].get_unchecked(ray.origin as usize);
                let offset = _mm256_mul_ps(_mm256_set1_ps(origin), inverse);
                let middle = _mm256_fmsub_ps(_mm256_loadu_ps(boxes.center[axis].as_ptr()), inverse, offset);
                let (half, steep) = (_mm256_loadu_ps(boxes.half[axis].as_ptr()), absolute(inverse));
                enter = _mm256_max_ps(_mm256_fnmadd_ps(half, steep, middle), enter);
                leave = _mm256_min_ps(_mm256_fmadd_ps(half, steep, middle), leave);
            }
            let met = _mm256_cmp_ps_mask::<_CMP_LE_OQ>(enter, leave);
            masks |= u64::from(met) << (8 * i);
        }
        _mm_cvtsi64_si128(masks as i64)
    }
}

/// The boxes that each of up to 16 rays meets, a byte a ray: one box against all rays at a time.
#[inline(always)]
unsafe fn meet_boxes_16(boxes: &Boxes, rays: &[BoxRay], origins: &BoxOrigins, ids: &[u16]) -> __m128i {
    // SAFETY: loads of ids are masked; ids are rays, the first one in lanes without a ray; their origins are below
    // `POINTS_MAX`
    unsafe {
        let present = u16::MAX >> (16 - ids.len());
        let mut of_lane = [0_u16; 16];
        let ids = _mm256_maskz_loadu_epi16(present, ids.as_ptr().cast());
        _mm256_storeu_si256(of_lane.as_mut_ptr().cast(), ids);
        let [x, y, z, origin] = transpose(&of_lane, rays);
        let origin = _mm512_castps_si512(origin);
        let inverse = [x, y, z];
        let (mut offset, mut steep) = (inverse, inverse);
        for axis in 0..3 {
            let first = _mm512_loadu_ps(origins[axis].as_ptr());
            let last = _mm512_loadu_ps(origins[axis].as_ptr().add(POINTS_MAX - 16));
            let coordinate = _mm512_permutex2var_ps(first, origin, last);
            offset[axis] = _mm512_mul_ps(coordinate, inverse[axis]);
            steep[axis] = _mm512_andnot_ps(_mm512_set1_ps(-0.0), inverse[axis]);
        }

        // One box against all rays at a time
        let mut met = _mm_setzero_si128();
        for slot in 0..WIDTH {
            let mut enter = _mm512_setzero_ps();
            let mut leave = _mm512_set1_ps(f32::MAX);
            for axis in 0..3 {
                let center = _mm512_set1_ps(boxes.center[axis][slot]);
                let half = _mm512_set1_ps(boxes.half[axis][slot]);
                let middle = _mm512_fmsub_ps(center, inverse[axis], offset[axis]);
                enter = _mm512_max_ps(_mm512_fnmadd_ps(half, steep[axis], middle), enter);
                leave = _mm512_min_ps(_mm512_fmadd_ps(half, steep[axis], middle), leave);
            }
            let these = _mm512_mask_cmp_ps_mask::<_CMP_LE_OQ>(present, enter, leave);
            met = _mm_mask_add_epi8(met, these, met, _mm_set1_epi8((1_u8 << slot) as i8));
        }
        met
    }
}

/// The four components of 16 rays, each in a vector of its own.
#[inline(always)]
unsafe fn transpose(ids: &[u16; 16], rays: &[BoxRay]) -> [__m512; 4] {
    // SAFETY: ids are rays, each of four numbers
    unsafe {
        let mut rows = [_mm512_setzero_ps(); 4];
        for (i, row) in rows.iter_mut().enumerate() {
            *row = _mm512_castps128_ps512(four_of(rays, ids[i]));
            *row = _mm512_insertf32x4::<1>(*row, four_of(rays, ids[i + 4]));
            *row = _mm512_insertf32x4::<2>(*row, four_of(rays, ids[i + 8]));
            *row = _mm512_insertf32x4::<3>(*row, four_of(rays, ids[i + 12]));
        }
        let [a, b, c, d] = rows;
        let (ab, cd) = (_mm512_unpacklo_ps(a, b), _mm512_unpacklo_ps(c, d));
        let xy = [_mm512_castps_pd(ab), _mm512_castps_pd(cd)];
        let (ab, cd) = (_mm512_unpackhi_ps(a, b), _mm512_unpackhi_ps(c, d));
        let zw = [_mm512_castps_pd(ab), _mm512_castps_pd(cd)];
        [
            _mm512_castpd_ps(_mm512_unpacklo_pd(xy[0], xy[1])),
            _mm512_castpd_ps(_mm512_unpackhi_pd(xy[0], xy[1])),
            _mm512_castpd_ps(_mm512_unpacklo_pd(zw[0], zw[1])),
            _mm512_castpd_ps(_mm512_unpackhi_pd(zw[0], zw[1])),
        ]
    }
}

/// A ray as four numbers.
#[inline(always)]
unsafe fn four_of(rays: &[BoxRay], id: u16) -> __m128 {
    // SAFETY: the id is a ray's
    unsafe { _mm_load_ps(std::ptr::from_ref(rays.get_unchecked(usize::from(id))).cast()) }
}

/// The first vertices of a tile's triangles.
#[inline(always)]
unsafe fn tile_faces(columns: usize) -> __m512i {
    // SAFETY: no memory is touched
    unsafe {
        let face = _mm512_set_epi32(7, 6, 5, 4, 3, 2, 1, 0, 7, 6, 5, 4, 3, 2, 1, 0);
        // face / columns for up to 8 of each, by multiplication
        let inverse = _mm512_set1_epi32(256 / columns as i32 + 1);
        _mm512_add_epi32(face, _mm512_srli_epi32::<8>(_mm512_mullo_epi32(face, inverse)))
    }
}

/// The vertices of the triangles of quads in rows, per corner.
#[inline(always)]
unsafe fn row_lanes(first: __m512i, stride: usize) -> [__m512i; 3] {
    // SAFETY: no memory is touched
    unsafe {
        let stride = stride as i32;
        let second = _mm512_mask_set1_epi32(_mm512_set1_epi32(1), 0xff00, stride + 1);
        let third = _mm512_mask_set1_epi32(_mm512_set1_epi32(stride + 1), 0xff00, stride);
        [first, _mm512_add_epi32(first, second), _mm512_add_epi32(first, third)]
    }
}

/// What is the same for all axes of a predicted tile, a lane a vertex. See [`predict`](crate::brick::leaf::predict).
struct PredictedTile {
    corners: [__m512i; 4],
    /// Lanes of corners.
    are_corners: u16,
    /// Where a corner stands among the corners, another vertex among the others.
    place: __m512i,
    weights: [__m512i; 3],
}

impl PredictedTile {
    #[inline(always)]
    unsafe fn of(layout: &Layout) -> Self {
        let corners = predict::corners(layout.stride, layout.vertices);
        let rows = layout.vertices / layout.stride - 1;
        let lanes = &predict::LANES[layout.columns - 1][rows - 1];
        // SAFETY: loads are of whole arrays
        unsafe {
            let weights =
                |kind: usize| _mm512_cvtepu16_epi32(_mm256_loadu_si256(lanes.weights[kind].as_ptr().cast()));
            Self {
                corners: corners.map(|corner| _mm512_set1_epi32(corner as i32)),
                are_corners: corners.iter().fold(0, |all, &corner| all | 1 << corner),
                place: _mm512_cvtepu8_epi32(_mm_loadu_si128(lanes.places.as_ptr().cast())),
                weights: [weights(0), weights(1), weights(2)],
            }
        }
    }

    /// The coordinates along an axis whose column starts at `packed`.
    #[inline(always)]
    unsafe fn unpack(&self, packed: *const u8, bits: u8, rest_bits: u8) -> __m512i {
        // SAFETY: the caller may read 64 bytes
        unsafe {
            // Corners come first
            let width = _mm512_mask_set1_epi32(
                _mm512_set1_epi32(i32::from(rest_bits)),
                self.are_corners,
                i32::from(bits),
            );
            let bit = _mm512_mullo_epi32(self.place, width);
            let after_corners = _mm512_set1_epi32(4 * i32::from(bits));
            let bit = _mm512_mask_add_epi32(bit, !self.are_corners, bit, after_corners);
            let words = words_at(packed, bit);
            // A corner as it is, of what others differ by the sign too
            let unused = _mm512_sub_epi32(_mm512_set1_epi32(32), width);
            let high = _mm512_sllv_epi32(words, unused);
            let stored =
                _mm512_mask_srlv_epi32(_mm512_srav_epi32(high, unused), self.are_corners, high, unused);
            let [first, right, below, last] = [
                _mm512_permutexvar_epi32(self.corners[0], stored),
                _mm512_permutexvar_epi32(self.corners[1], stored),
                _mm512_permutexvar_epi32(self.corners[2], stored),
                _mm512_permutexvar_epi32(self.corners[3], stored),
            ];
            let height = _mm512_sub_epi32(below, first);
            let twist = _mm512_sub_epi32(_mm512_sub_epi32(last, right), height);
            let [across, down, both] = self.weights;
            let sum = _mm512_add_epi32(
                _mm512_add_epi32(
                    _mm512_mullo_epi32(across, _mm512_sub_epi32(right, first)),
                    _mm512_mullo_epi32(down, height),
                ),
                _mm512_mullo_epi32(both, twist),
            );
            let expected = _mm512_add_epi32(first, _mm512_srai_epi32::<8>(sum));
            _mm512_mask_add_epi32(stored, !self.are_corners, stored, expected)
        }
    }
}

/// The vertices of a leaf's triangles, per corner.
#[inline(always)]
unsafe fn index_lanes(leaf: &[u8], layout: &Layout) -> [__m512i; 3] {
    // SAFETY: the caller's leaf may be read 64 bytes past its end
    unsafe {
        let indices = leaf.as_ptr().add(layout.indices);
        let mut column = [_mm512_setzero_si512(); 4];
        for (corner, column) in column.iter_mut().enumerate().take(layout.kind.corners()) {
            let packed = indices.add(corner * layout.index_bytes);
            *column = unpack(packed, layout.index_bits as u8);
        }
        if layout.kind == Kind::Triangles {
            return [column[0], column[1], column[2]];
        }
        [pair(column[0], column[0]), pair(column[1], column[2]), pair(column[2], column[3])]
    }
}

/// The 16 numbers of `bits` bits that start at `packed`.
#[inline(always)]
unsafe fn unpack(packed: *const u8, bits: u8) -> __m512i {
    // SAFETY: the caller may read 64 bytes
    unsafe {
        let lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
        let bit = _mm512_mullo_epi32(lane, _mm512_set1_epi32(i32::from(bits)));
        _mm512_and_si512(words_at(packed, bit), _mm512_set1_epi32((1 << bits) - 1))
    }
}

/// The 25 bits or more from each of 16 bits on.
#[inline(always)]
unsafe fn words_at(packed: *const u8, bit: __m512i) -> __m512i {
    // SAFETY: the caller may read 64 bytes
    unsafe {
        let bytes = _mm512_loadu_si512(packed.cast());
        let byte = _mm512_mullo_epi32(_mm512_srli_epi32::<3>(bit), _mm512_set1_epi32(0x0101_0101));
        let words = _mm512_permutexvar_epi8(_mm512_add_epi32(byte, _mm512_set1_epi32(0x0302_0100)), bytes);
        _mm512_srlv_epi32(words, _mm512_and_si512(bit, _mm512_set1_epi32(7)))
    }
}

#[inline(always)]
unsafe fn absolute(x: __m256) -> __m256 {
    // SAFETY: no memory is touched
    unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), x) }
}

/// Eight bytes as numbers.
#[inline(always)]
unsafe fn widen(bytes: &[u8; 8]) -> __m256 {
    // SAFETY: eight bytes are read
    unsafe { _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(bytes.as_ptr().cast()))) }
}

/// The lower halves of both.
#[inline(always)]
unsafe fn pair(low: __m512i, high: __m512i) -> __m512i {
    // SAFETY: no memory is touched
    unsafe { _mm512_shuffle_i64x2::<0b01_00_01_00>(low, high) }
}

/// A component of the cross product; products are not fused.
#[inline(always)]
unsafe fn minor(p: &[__m512; 3], q: &[__m512; 3], i: usize, j: usize) -> __m512 {
    // SAFETY: no memory is touched
    unsafe { _mm512_sub_ps(_mm512_mul_ps(p[i], q[j]), _mm512_mul_ps(p[j], q[i])) }
}

#[inline(always)]
unsafe fn cross(p: [__m512; 3], q: [__m512; 3]) -> [__m512; 3] {
    // SAFETY: no memory is touched
    unsafe { [minor(&p, &q, 1, 2), minor(&p, &q, 2, 0), minor(&p, &q, 0, 1)] }
}
