//! The shooter's inner loops with AVX-512: the same operations in the same order as [`Plain`](super::kernel::Plain).

use std::arch::x86_64::*;

use super::kernel::{BOX_ERROR, Boxes, Kernel};
use super::lines::{Column, LINES_MAX, Lines};
use super::shapes::{BLOCK, Shape, TRIANGLES};
use crate::brick::node::{Node, WIDTH};

/// AVX-512 F, BW, DQ and VL.
#[derive(Clone, Copy, Debug)]
pub struct Avx512;

/// From this many lines of sixteen on, a vector holds one box and sixteen lines, else one line and eight boxes.
const MANY: u32 = 6;

impl Kernel for Avx512 {
    #[inline(always)]
    unsafe fn boxes(node: &Node, lines: &Lines<'_>, out: &mut Boxes) {
        // SAFETY: the caller vouches for the instruction set; loads and stores are of whole arrays
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            for axis in 0..3 {
                let base = _mm256_set1_ps(node.origin[axis].wrapping_sub(lines.center[axis]) as f32);
                let scale = _mm256_set1_ps(f32::from_bits((u32::from(node.exponent[axis]) + 126) << 23));
                let reach = _mm256_set1_ps(lines.half[axis] + lines.half[axis]);
                let lower = _mm256_cvtepu8_epi32(_mm_loadl_epi64(node.lower[axis].as_ptr().cast()));
                let upper = _mm256_cvtepu8_epi32(_mm_loadl_epi64(node.upper[axis].as_ptr().cast()));
                let (lower, upper) = (_mm256_cvtepi32_ps(lower), _mm256_cvtepi32_ps(upper));
                let center = _mm256_fmadd_ps(_mm256_add_ps(lower, upper), scale, base);
                let half = _mm256_mul_ps(_mm256_sub_ps(upper, lower), scale);
                let size = _mm256_add_ps(_mm256_add_ps(_mm256_andnot_ps(sign, center), half), reach);
                let half = _mm256_fmadd_ps(size, _mm256_set1_ps(BOX_ERROR), half);
                _mm256_storeu_ps(out.center[axis].as_mut_ptr(), center);
                _mm256_storeu_ps(out.half[axis].as_mut_ptr(), half);
            }
        }
    }

    #[inline(always)]
    unsafe fn meet_boxes<const CLIP: bool>(
        boxes: &Boxes,
        lines: &Lines<'_>,
        mask: u64,
        out: &mut [u64; WIDTH],
    ) {
        *out = [0; WIDTH];
        let (mut bytes, mut few) = ([0_u8; LINES_MAX], 0_u64);
        for group in 0..LINES_MAX / 16 {
            let part = (mask >> (16 * group)) as u16;
            if part.count_ones() >= MANY {
                // SAFETY: the caller vouches for the instruction set
                unsafe { many::<CLIP>(boxes, lines, 16 * group, part, out) };
            } else {
                few |= u64::from(part) << (16 * group);
            }
        }
        if few == 0 {
            return;
        }
        let mut rest = few;
        while rest != 0 {
            let line = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            // SAFETY: the caller vouches for the instruction set
            bytes[line] = unsafe { one::<CLIP>(boxes, lines, line) };
        }
        // SAFETY: the caller vouches for the instruction set; the load is of the whole array
        unsafe {
            let bytes = _mm512_loadu_si512(bytes.as_ptr().cast());
            for (slot, out) in out.iter_mut().enumerate() {
                *out |= _mm512_test_epi8_mask(bytes, _mm512_set1_epi8((1_u8 << slot) as i8));
            }
        }
    }

    #[inline(always)]
    unsafe fn corners(
        shape: &Shape,
        blocks: [&[[i32; BLOCK]; 3]; 2],
        reference: [i32; 3],
        out: &mut [[[f32; TRIANGLES]; 3]; 3],
    ) {
        // SAFETY: the caller vouches for the instruction set; loads and stores are of whole arrays
        unsafe {
            let lanes = [
                corner_lanes(&shape.corners[0]),
                corner_lanes(&shape.corners[1]),
                corner_lanes(&shape.corners[2]),
            ];
            for axis in 0..3 {
                let base = _mm512_set1_epi32(reference[axis]);
                let first = _mm512_sub_epi32(_mm512_loadu_si512(blocks[0][axis].as_ptr().cast()), base);
                let second = _mm512_sub_epi32(_mm512_loadu_si512(blocks[1][axis].as_ptr().cast()), base);
                let (first, second) = (_mm512_cvtepi32_ps(first), _mm512_cvtepi32_ps(second));
                for corner in 0..3 {
                    let gathered = _mm512_permutex2var_ps(first, lanes[corner], second);
                    _mm512_storeu_ps(out[corner][axis].as_mut_ptr(), gathered);
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn meet_leaf<const CLIP: bool>(
        shape: &Shape,
        blocks: [&[[i32; BLOCK]; 3]; 2],
        lines: &Lines<'_>,
        mask: u64,
        triangles: &mut [u16; LINES_MAX],
    ) -> u64 {
        let present = shape.present;
        // SAFETY: the caller vouches for the instruction set; loads are of whole arrays, lines are below LINES_MAX
        unsafe {
            let corners = [
                corner_lanes(&shape.corners[0]),
                corner_lanes(&shape.corners[1]),
                corner_lanes(&shape.corners[2]),
            ];
            let first = relative(blocks[0], lines);
            if shape.is_large {
                let second = relative(blocks[1], lines);
                meet_triangles::<CLIP>(&corners, &first, Some(&second), present, lines, mask, triangles)
            } else {
                meet_triangles::<CLIP>(&corners, &first, None, present, lines, mask, triangles)
            }
        }
    }
}

/// The lines of `mask` that meet the triangles in the lanes of `present`.
#[inline(always)]
unsafe fn meet_triangles<const CLIP: bool>(
    corners: &[__m512i; 3],
    first: &[__m512; 3],
    second: Option<&[__m512; 3]>,
    present: u16,
    lines: &Lines<'_>,
    mask: u64,
    triangles: &mut [u16; LINES_MAX],
) -> u64 {
    let (mut met, mut rest) = (0, mask);
    while rest != 0 {
        let line = rest.trailing_zeros() as usize;
        rest &= rest - 1;
        // SAFETY: the caller vouches for the instruction set; the line is below LINES_MAX
        let lanes = unsafe {
            let zero = _mm512_setzero_ps();
            let (mut low, mut high) = (zero, zero);
            let x = seen(&lines.directions.right, &lines.across[0], line, first, second, corners);
            let y = seen(&lines.directions.up, &lines.across[1], line, first, second, corners);
            let edges = edges(&x, &y, &mut low, &mut high);
            if CLIP {
                let depth = seen(&lines.directions.along, &lines.across[2], line, first, second, corners);
                clip(lines, line, &edges, &depth, &mut low, &mut high);
            }
            let positive = _mm512_mask_cmp_ps_mask::<_CMP_GE_OQ>(present, low, zero);
            positive | _mm512_mask_cmp_ps_mask::<_CMP_LE_OQ>(present, high, zero)
        };
        triangles[line] = lanes;
        met |= u64::from(lanes != 0) << line;
    }
    met
}

/// The numbers of a corner's vertices, one a triangle.
#[inline(always)]
unsafe fn corner_lanes(corners: &[u8; TRIANGLES]) -> __m512i {
    // SAFETY: the caller vouches for the instruction set; the load is of the whole array
    unsafe { _mm512_cvtepu8_epi32(_mm_loadu_si128(corners.as_ptr().cast())) }
}

/// Vertices relative to the lines' centre, per axis.
#[inline(always)]
unsafe fn relative(block: &[[i32; BLOCK]; 3], lines: &Lines<'_>) -> [__m512; 3] {
    // SAFETY: the caller vouches for the instruction set; loads are of whole arrays
    unsafe {
        let x =
            _mm512_sub_epi32(_mm512_loadu_si512(block[0].as_ptr().cast()), _mm512_set1_epi32(lines.center.x));
        let y =
            _mm512_sub_epi32(_mm512_loadu_si512(block[1].as_ptr().cast()), _mm512_set1_epi32(lines.center.y));
        let z =
            _mm512_sub_epi32(_mm512_loadu_si512(block[2].as_ptr().cast()), _mm512_set1_epi32(lines.center.z));
        [_mm512_cvtepi32_ps(x), _mm512_cvtepi32_ps(y), _mm512_cvtepi32_ps(z)]
    }
}

/// One axis of a line's frame: the coordinates of the triangles' three corners.
#[inline(always)]
unsafe fn seen(
    frame: &[Column; 3],
    across: &Column,
    line: usize,
    first: &[__m512; 3],
    second: Option<&[__m512; 3]>,
    corners: &[__m512i; 3],
) -> [__m512; 3] {
    // SAFETY: the caller vouches for the instruction set and that `line` is below LINES_MAX
    unsafe {
        let across = _mm512_set1_ps(-*across.get_unchecked(line));
        let x = _mm512_set1_ps(*frame[0].get_unchecked(line));
        let y = _mm512_set1_ps(*frame[1].get_unchecked(line));
        let z = _mm512_set1_ps(*frame[2].get_unchecked(line));
        let low =
            _mm512_fmadd_ps(first[0], x, _mm512_fmadd_ps(first[1], y, _mm512_fmadd_ps(first[2], z, across)));
        match second {
            None => [
                _mm512_permutexvar_ps(corners[0], low),
                _mm512_permutexvar_ps(corners[1], low),
                _mm512_permutexvar_ps(corners[2], low),
            ],
            Some(v) => {
                let high =
                    _mm512_fmadd_ps(v[0], x, _mm512_fmadd_ps(v[1], y, _mm512_fmadd_ps(v[2], z, across)));
                [
                    _mm512_permutex2var_ps(low, corners[0], high),
                    _mm512_permutex2var_ps(low, corners[1], high),
                    _mm512_permutex2var_ps(low, corners[2], high),
                ]
            }
        }
    }
}

/// The edge functions of the triangles at zero, with their least and largest.
#[inline(always)]
unsafe fn edges(x: &[__m512; 3], y: &[__m512; 3], low: &mut __m512, high: &mut __m512) -> [__m512; 3] {
    // SAFETY: the caller vouches for the instruction set
    unsafe {
        let ab = _mm512_fmsub_ps(x[0], y[1], _mm512_mul_ps(y[0], x[1]));
        let bc = _mm512_fmsub_ps(x[1], y[2], _mm512_mul_ps(y[1], x[2]));
        let ca = _mm512_fmsub_ps(x[2], y[0], _mm512_mul_ps(y[2], x[0]));
        *low = _mm512_min_ps(_mm512_min_ps(ab, bc), ca);
        *high = _mm512_max_ps(_mm512_max_ps(ab, bc), ca);
        [ab, bc, ca]
    }
}

/// Takes into `low` and `high` whether the hit lies where it counts.
#[inline(always)]
unsafe fn clip(
    lines: &Lines<'_>,
    line: usize,
    edges: &[__m512; 3],
    depth: &[__m512; 3],
    low: &mut __m512,
    high: &mut __m512,
) {
    // SAFETY: the caller vouches for the instruction set and that `line` is below LINES_MAX
    unsafe {
        let from = _mm512_set1_ps(*lines.from.get_unchecked(line));
        let to = _mm512_set1_ps(*lines.to.get_unchecked(line));
        let [ab, bc, ca] = *edges;
        let area = _mm512_add_ps(_mm512_add_ps(ab, bc), ca);
        let sum = _mm512_fmadd_ps(ab, depth[2], _mm512_fmadd_ps(ca, depth[1], _mm512_mul_ps(bc, depth[0])));
        let (after, before) = (_mm512_fnmadd_ps(from, area, sum), _mm512_fmsub_ps(to, area, sum));
        *low = _mm512_min_ps(*low, _mm512_min_ps(after, before));
        *high = _mm512_max_ps(*high, _mm512_max_ps(after, before));
    }
}

/// Sixteen lines from `first` on against the boxes one by one.
#[inline(always)]
unsafe fn many<const CLIP: bool>(
    boxes: &Boxes,
    lines: &Lines<'_>,
    first: usize,
    part: u16,
    out: &mut [u64; WIDTH],
) {
    // SAFETY: the caller vouches for the instruction set; `first` is at most LINES_MAX - 16
    unsafe {
        let (mut inverse, mut offset, mut positive) =
            ([_mm512_setzero_ps(); 3], [_mm512_setzero_ps(); 3], [_mm512_setzero_ps(); 3]);
        for axis in 0..3 {
            inverse[axis] = _mm512_loadu_ps(lines.directions.inverse[axis].as_ptr().add(first));
            offset[axis] = _mm512_loadu_ps(lines.offset[axis].as_ptr().add(first));
            positive[axis] = _mm512_abs_ps(inverse[axis]);
        }
        let (mut start, mut end) = (_mm512_set1_ps(f32::MIN), _mm512_set1_ps(f32::MAX));
        if CLIP {
            start = _mm512_loadu_ps(lines.from.as_ptr().add(first));
            end = _mm512_loadu_ps(lines.to.as_ptr().add(first));
        }
        for slot in 0..WIDTH {
            let (mut enter, mut leave) = (start, end);
            for axis in 0..3 {
                let center = _mm512_set1_ps(boxes.center[axis][slot]);
                let half = _mm512_set1_ps(boxes.half[axis][slot]);
                let middle = _mm512_fmsub_ps(center, inverse[axis], offset[axis]);
                enter = _mm512_max_ps(_mm512_fnmadd_ps(half, positive[axis], middle), enter);
                leave = _mm512_min_ps(_mm512_fmadd_ps(half, positive[axis], middle), leave);
            }
            let met = _mm512_mask_cmp_ps_mask::<_CMP_LE_OQ>(part, enter, leave);
            out[slot] |= u64::from(met) << first;
        }
    }
}

/// One line against all boxes.
#[inline(always)]
unsafe fn one<const CLIP: bool>(boxes: &Boxes, lines: &Lines<'_>, line: usize) -> u8 {
    // SAFETY: the caller vouches for the instruction set; loads are of whole arrays, the line is below LINES_MAX
    unsafe {
        let (mut enter, mut leave) = if CLIP {
            (_mm256_set1_ps(*lines.from.get_unchecked(line)), _mm256_set1_ps(*lines.to.get_unchecked(line)))
        } else {
            (_mm256_set1_ps(f32::MIN), _mm256_set1_ps(f32::MAX))
        };
        for axis in 0..3 {
            let inverse = *lines.directions.inverse[axis].get_unchecked(line);
            let offset = _mm256_set1_ps(*lines.offset[axis].get_unchecked(line));
            let (inverse, positive) = (_mm256_set1_ps(inverse), _mm256_set1_ps(inverse.abs()));
            let center = _mm256_loadu_ps(boxes.center[axis].as_ptr());
            let half = _mm256_loadu_ps(boxes.half[axis].as_ptr());
            let middle = _mm256_fmsub_ps(center, inverse, offset);
            enter = _mm256_max_ps(_mm256_fnmadd_ps(half, positive, middle), enter);
            leave = _mm256_min_ps(_mm256_fmadd_ps(half, positive, middle), leave);
        }
        _mm256_cmp_ps_mask::<_CMP_LE_OQ>(enter, leave)
    }
}
