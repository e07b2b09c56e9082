//! What stands in for a child that is not opened.
//!
//! The paper's opacity (section 4.1): min(1, Σ area of the micropolygons / area of the box) times their mean opacity. It is
//! right for closed convex solids, half transparent for a wall and too thin for leaves; it is kept as `--farfield paper`.
//! It belongs to the *decoded* box, which a ray is tested against.

use serde::{Deserialize, Serialize};

use crate::brick::leaf::{EXTINCTION_PER_OCTAVE, Face, OPAQUE, extinction_from_opacity};
use crate::brick::{LatticeBox, far};

/// Which far field a brick map has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FarField {
    /// The paper's: one opacity per box, from sums of areas.
    Paper,
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
mod tests {
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
