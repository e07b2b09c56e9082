//! Lines down a partition's tree in memory: all lines of a box at once.

use glam::{Vec2, Vec3};

use super::super::bvh::{WideChild, WideNode};
use super::kernel::{Boxes, Kernel, relative};
use super::lines::{LINES_MAX, Lines};
use super::shapes::{Shape, Shapes, Special, TRIANGLES};
use crate::brick::far::transmittance;
use crate::brick::leaf::Kind;
use crate::brick::node::{Node, WIDTH};

/// A tree with its geometry.
#[derive(Clone, Copy, Debug)]
pub struct Grove<'a> {
    /// What the children of each node are; children come after their parents.
    pub tree: &'a [WideNode],
    /// Their decoded boxes.
    pub nodes: &'a [Node],
    /// The leaves' faces, by primitive.
    pub shapes: &'a Shapes,
}

/// What lines met.
#[derive(Debug)]
pub struct Hits {
    /// Bit i: line i met a face.
    pub met: u64,
    /// What is left of each line.
    pub passed: [f32; LINES_MAX],
}

impl Hits {
    /// Nothing.
    pub const NONE: Self = Self { met: 0, passed: [1.0; LINES_MAX] };
}

/// A shooter's memory, reused.
#[derive(Debug)]
pub struct Shooter {
    stack: Vec<(WideChild, u64)>,
    boxes: Boxes,
    triangles: [u16; LINES_MAX],
}

impl Shooter {
    /// A new one.
    pub fn new() -> Self {
        Self { stack: Vec::with_capacity(256), boxes: Boxes::default(), triangles: [0; LINES_MAX] }
    }

    /// Shoots the lines of `mask` through `start` and all below it. If `CLIP`, only hits between [`Lines::from`] and
    /// [`Lines::to`] count, and any face ends a line; else an opaque one does.
    ///
    /// # Safety
    /// The instruction set of `K` is available.
    #[inline(always)]
    pub unsafe fn shoot<K: Kernel, const CLIP: bool>(
        &mut self,
        grove: Grove<'_>,
        start: WideChild,
        lines: &Lines<'_>,
        mask: u64,
        hits: &mut Hits,
    ) {
        let mut alive = mask;
        self.stack.clear();
        self.stack.push((start, mask));
        while let Some((target, mask)) = self.stack.pop() {
            let mask = mask & alive;
            if mask == 0 {
                continue;
            }
            match target {
                WideChild::Node(node) => {
                    let mut met = [0; WIDTH];
                    // SAFETY: the caller's
                    unsafe {
                        K::boxes(&grove.nodes[node as usize], lines, &mut self.boxes);
                        K::meet_boxes::<CLIP>(&self.boxes, lines, mask, &mut met);
                    }
                    let wide = &grove.tree[node as usize];
                    for slot in 0..usize::from(wide.count) {
                        if met[slot] != 0 {
                            self.stack.push((wide.children[slot], met[slot]));
                        }
                    }
                }
                WideChild::Primitive(leaf) => {
                    let shape = grove.shapes.shape(leaf);
                    let special = grove.shapes.special(shape);
                    let met = match special {
                        Some(special) if shape.kind == Kind::Round => {
                            self.meet_round::<CLIP>(grove.shapes, shape, special, lines, mask)
                        }
                        _ => {
                            let blocks = [grove.shapes.block(shape), grove.shapes.second_block(shape)];
                            // SAFETY: the caller's
                            unsafe { K::meet_leaf::<CLIP>(shape, blocks, lines, mask, &mut self.triangles) }
                        }
                    };
                    hits.met |= met;
                    match special {
                        Some(special) if !CLIP => alive &= !self.attenuate(shape, special, met, hits),
                        _ => {
                            alive &= !met;
                            let mut rest = met;
                            while rest != 0 {
                                hits.passed[rest.trailing_zeros() as usize] = 0.0;
                                rest &= rest - 1;
                            }
                        }
                    }
                }
            }
            if alive == 0 {
                return;
            }
        }
    }

    /// Takes from each line of `met` what its faces keep, and returns the lines that end.
    #[inline(never)]
    fn attenuate(&self, shape: &Shape, special: &Special, met: u64, hits: &mut Hits) -> u64 {
        let (mut rest, mut ended) = (met, 0);
        while rest != 0 {
            let line = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let faces = shape.kind.faces(self.triangles[line]);
            for face in (0..TRIANGLES).filter(|face| faces >> face & 1 != 0) {
                hits.passed[line] *= transmittance(special.extinctions[face]);
            }
            ended |= u64::from(hits.passed[line] == 0.0) << line;
        }
        ended
    }

    /// The lines that meet points and lines of a leaf.
    #[inline(never)]
    fn meet_round<const CLIP: bool>(
        &mut self,
        shapes: &Shapes,
        shape: &Shape,
        special: &Special,
        lines: &Lines<'_>,
        mask: u64,
    ) -> u64 {
        let (mut rest, mut met) = (mask, 0);
        while rest != 0 {
            let line = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let direction = lines.direction(line);
            let [right, up] = [&lines.directions.right, &lines.directions.up]
                .map(|frame| Vec3::new(frame[0][line], frame[1][line], frame[2][line]));
            let mut faces = 0_u16;
            for face in 0..usize::from(shape.faces) {
                let ends = [shape.corners[0][face], shape.corners[1][face]];
                let [a, b] = ends.map(|end| relative(shapes.vertex(shape, end), lines));
                let [ra, rb] = ends.map(|end| special.radii[usize::from(end)]);
                let seen = |p: Vec3| {
                    Vec2::new(right.dot(p) - lines.across[0][line], up.dot(p) - lines.across[1][line])
                };
                let Some(share) = nearest_disc([seen(a), seen(b)], [ra, rb]) else { continue };
                let depth = direction.dot(a.lerp(b, share)) - lines.across[2][line];
                let in_range = depth >= lines.from[line] && depth <= lines.to[line];
                faces |= u16::from(!CLIP || in_range) << face;
            }
            self.triangles[line] = faces;
            met |= u64::from(faces != 0) << line;
        }
        met
    }
}

impl Default for Shooter {
    fn default() -> Self {
        Self::new()
    }
}

/// Whether zero is in the hull of two discs, which is what a round cone looks like along a line: the union of discs from one to
/// the other. Returns the share of the way to the one that holds it most.
fn nearest_disc([a, b]: [Vec2; 2], [ra, rb]: [f32; 2]) -> Option<f32> {
    let (axis, growth) = (b - a, rb - ra);
    // Depth in the disc at h is a parabola: |a + h axis|² - (ra + h growth)²
    let square = axis.length_squared() - growth * growth;
    let slope = ra * growth - a.dot(axis);
    let depth = |h: f32| (a + axis * h).length_squared() - (ra + growth * h).powi(2);
    let h = if square > 0.0 {
        (slope / square).clamp(0.0, 1.0)
    } else if depth(0.0) <= depth(1.0) {
        0.0
    } else {
        1.0
    };
    (depth(h) <= 0.0).then_some(h)
}
