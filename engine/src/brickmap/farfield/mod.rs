//! What stands in for a child that is not opened.
//!
//! The directional far field is decided by lines through the real geometry ([`lines`], [`shapes`], [`shoot`], [`kernel`]): an
//! aggregate fitted to what they meet ([`moments`], [`fit`]), an opaque plate where a sheet has no gaps, or a mark that the
//! child must be opened ([`mod@fill`]).
//!
//! The paper's opacity (section 4.1): min(1, Σ area of the micropolygons / area of the box) times their mean opacity. It is
//! right for closed convex solids, half transparent for a wall and too thin for leaves; it is kept as `--farfield paper`.
//! It belongs to the *decoded* box, which a ray is tested against.

#[cfg(target_arch = "x86_64")]
mod avx512;
pub mod fill;
pub mod fit;
pub mod kernel;
pub mod lines;
pub mod moments;
pub mod shapes;
pub mod shoot;
#[cfg(test)]
mod tests;
pub mod top;

use std::str::FromStr;

use serde::{Deserialize, Serialize};

pub use fill::{Others, Root};
use lines::{Column, Lines};
use shapes::Shapes;
use shoot::{Grove, Hits, Shooter};

use super::bvh::{WideChild, WideNode, WideTree};
use crate::brick::lanes::InstructionSet;
use crate::brick::leaf::{EXTINCTION_PER_OCTAVE, Face, OPAQUE, extinction_from_opacity};
use crate::brick::node::{Node, WIDTH};
use crate::brick::{LatticeBox, far};

/// Which far field a brick map has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FarField {
    /// The paper's: one opacity per box, from sums of areas.
    Paper,
    /// By direction, without leaks: aggregates, plates and must-open marks.
    Directional,
}

impl FarField {
    /// `paper` or `directional`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Directional => "directional",
        }
    }
}

impl FromStr for FarField {
    type Err = String;

    /// Reads a [`name`](Self::name).
    fn from_str(text: &str) -> Result<Self, String> {
        let kinds = [Self::Paper, Self::Directional];
        kinds
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| "expected `paper` or `directional`".into())
    }
}

/// The directional far field of a partition's tree: of every node's children, for the decoded boxes of `nodes`, and of its
/// root. `others` are boxes of geometry that is not in the tree. Every instruction set gives the same bits.
pub fn directional(
    tree: &WideTree,
    nodes: &[Node],
    shapes: &Shapes,
    others: Others<'_>,
    instructions: InstructionSet,
) -> (Vec<[far::Record; WIDTH]>, Root) {
    match instructions {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: InstructionSet::detect and ::available are the only sources of these values outside tests
        InstructionSet::Avx2 => unsafe { directional_avx2(&tree.nodes, nodes, shapes, others) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above
        InstructionSet::Avx512 => unsafe { directional_avx512(&tree.nodes, nodes, shapes, others) },
        // SAFETY: the plain loops need no instruction set
        _ => unsafe { fill::fill::<kernel::Plain>(&tree.nodes, nodes, shapes, others) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt")]
unsafe fn directional_avx2(
    tree: &[WideNode],
    nodes: &[Node],
    shapes: &Shapes,
    others: Others<'_>,
) -> (Vec<[far::Record; WIDTH]>, Root) {
    // SAFETY: the caller vouches for the instruction set
    unsafe { fill::fill::<kernel::Plain>(tree, nodes, shapes, others) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,bmi1,bmi2,popcnt")]
unsafe fn directional_avx512(
    tree: &[WideNode],
    nodes: &[Node],
    shapes: &Shapes,
    others: Others<'_>,
) -> (Vec<[far::Record; WIDTH]>, Root) {
    // SAFETY: the caller vouches for the instruction set
    unsafe { fill::fill::<avx512::Avx512>(tree, nodes, shapes, others) }
}

/// What the lines lose below `target`, 0 to 1 each.
pub fn lost(grove: Grove<'_>, target: WideChild, lines: &Lines<'_>) -> Column {
    #[cfg(target_arch = "x86_64")]
    if InstructionSet::detect() == InstructionSet::Avx512 {
        // SAFETY: just detected
        return unsafe { lost_avx512(grove, target, lines) };
    }
    // SAFETY: the plain loops need no instruction set
    unsafe { lost_with::<kernel::Plain>(grove, target, lines) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,bmi1,bmi2,popcnt")]
unsafe fn lost_avx512(grove: Grove<'_>, target: WideChild, lines: &Lines<'_>) -> Column {
    // SAFETY: the caller vouches for the instruction set
    unsafe { lost_with::<avx512::Avx512>(grove, target, lines) }
}

#[inline(always)]
unsafe fn lost_with<K: kernel::Kernel>(grove: Grove<'_>, target: WideChild, lines: &Lines<'_>) -> Column {
    let mut hits = Hits::NONE;
    // SAFETY: the caller vouches for the instruction set
    unsafe { Shooter::new().shoot::<K, false>(grove, target, lines, lines.all, &mut hits) };
    hits.passed.map(|passed| 1.0 - passed)
}

/// The area of a face in squared lattice steps. Points and lines count their surface.
pub fn area(face: &Face) -> f32 {
    let [a, b, c, d] = face.vertices.map(|vertex| (vertex - face.vertices[0]).as_vec3());
    let triangle = |u: glam::Vec3, v: glam::Vec3| 0.5 * u.cross(v).length();
    let [ra, rb] = face.radii;
    match face.arity {
        1 => 4.0 * std::f32::consts::PI * ra * ra,
        2 => std::f32::consts::PI * ((ra + rb) * (b - a).length() + 2.0 * (ra * ra + rb * rb)),
        3 => triangle(b, c),
        _ => triangle(b, c) + triangle(c, d),
    }
}

/// The opacity of an extinction.
pub fn opacity(extinction: u16) -> f32 {
    if extinction == OPAQUE { 1.0 } else { 1.0 - (-f32::from(extinction) / EXTINCTION_PER_OCTAVE).exp2() }
}

/// The far field of a child with the given decoded box and sums of areas.
pub fn paper(bounds: &LatticeBox, area: f32, opaque_area: f32) -> far::Record {
    let size = (bounds.max - bounds.min).as_vec3();
    let surface = 2.0 * (size.x * size.y + size.y * size.z + size.z * size.x);
    let covered = if surface > 0.0 { (area / surface).min(1.0) } else { 1.0 };
    let mean_opacity = if area > 0.0 { opaque_area / area } else { 0.0 };
    far::scalar(extinction_from_opacity(covered * mean_opacity))
}

#[cfg(test)]
mod paper_tests {
    use super::*;
    use glam::IVec3;

    /// Catches a far field that is not the paper's formula.
    #[test]
    fn a_cube_of_faces_is_opaque_and_a_wall_half() {
        let cube = LatticeBox { min: IVec3::ZERO, max: IVec3::splat(10) };
        assert_eq!(paper(&cube, 600.0, 600.0)[..2], OPAQUE.to_le_bytes());
        let wall = LatticeBox { min: IVec3::ZERO, max: IVec3::new(10, 10, 0) };
        assert_eq!(paper(&wall, 100.0, 100.0)[..2], 4096_u16.to_le_bytes());
        assert_eq!(paper(&wall, 100.0, 0.0), far::scalar(0));
    }
}
