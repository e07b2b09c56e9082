//! Rays against single faces in double precision: the truth that the tracers are tested against, the second look at
//! near hits (paper, section 5, "numerical precision"), and the only test for round faces.
//!
//! All positions are lattice steps relative to the ray's origin. A hit is any point of the face at a distance above
//! zero along the ray.

use glam::{DVec3, IVec3};

use super::leaf::Face;

/// Whether a ray from `origin` (lattice coordinates) along the unit vector `direction` meets `face` within `reach`
/// lattice steps.
///
/// A face with a vertex at the origin is not met: a ray from a face's own corner cannot meet it again. A round face
/// that contains the origin is not met either.
pub fn meets(face: &Face, origin: IVec3, direction: DVec3, reach: f64) -> bool {
    let corners = &face.vertices[..usize::from(face.arity)];
    let relative = |vertex: IVec3| (vertex - origin).as_dvec3();
    match face.arity {
        1 => sphere(relative(corners[0]), f64::from(face.radii[0]), direction, reach),
        2 => cone([relative(corners[0]), relative(corners[1])], face.radii.map(f64::from), direction, reach),
        _ if corners.contains(&origin) => false,
        3 => triangle([relative(corners[0]), relative(corners[1]), relative(corners[2])], direction, reach),
        _ => {
            let [a, b, c, d] = [0, 1, 2, 3].map(|i| relative(corners[i]));
            // Quads are split v0-v2
            triangle([a, b, c], direction, reach) || triangle([a, c, d], direction, reach)
        }
    }
}

/// Whether a ray from zero meets a triangle. Edges are inside: neighbours leave no gap.
pub fn triangle([a, b, c]: [DVec3; 3], direction: DVec3, reach: f64) -> bool {
    let normals = [cross(a, b), cross(b, c), cross(c, a)];
    let volume = a.dot(normals[1]);
    let [e0, e1, e2] = normals.map(|n| direction.dot(n) * volume.signum());
    volume != 0.0 && e0 >= 0.0 && e1 >= 0.0 && e2 >= 0.0 && volume.abs() <= reach * (e0 + e1 + e2)
}

/// The cross product without fused operations, so that `cross(a, b) == -cross(b, a)` exactly and the two faces of an
/// edge agree.
fn cross(a: DVec3, b: DVec3) -> DVec3 {
    DVec3::new(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)
}

/// Whether a ray from zero meets a solid sphere that does not contain zero.
pub fn sphere(center: DVec3, radius: f64, direction: DVec3, reach: f64) -> bool {
    let (along, square) = (center.dot(direction), center.length_squared() - radius * radius);
    let beside = center.cross(direction).length_squared();
    if square <= 0.0 || along <= 0.0 || beside > radius * radius {
        return false;
    }
    along - (radius * radius - beside).sqrt() <= reach
}

/// Whether a ray from zero meets the convex hull of two spheres (a round cone) that does not contain zero.
///
/// The hull is the union of spheres with linearly varying centre and radius. After I. Quilez, "Round cone -
/// intersection" (2018), with the two caps as spheres.
pub fn cone([a, b]: [DVec3; 2], [ra, rb]: [f64; 2], direction: DVec3, reach: f64) -> bool {
    let axis = b - a;
    let length2 = axis.length_squared();
    let dr = ra - rb;
    // One sphere holds the other: the hull is the larger sphere
    if length2 <= dr * dr {
        let (center, radius) = if ra >= rb { (a, ra) } else { (b, rb) };
        return sphere(center, radius, direction, reach);
    }
    if distance_to_cone(a, axis, length2, ra, dr) <= 0.0 {
        return false;
    }
    if sphere(a, ra, direction, reach) || sphere(b, rb, direction, reach) {
        return true;
    }
    // The mantle: |p - a|² m0 = ... as a quadratic in the distance along the ray
    let oa = -a;
    let (m0, m1, m2, m3) = (length2, axis.dot(oa), axis.dot(direction), direction.dot(oa));
    let m5 = oa.length_squared();
    let d2 = m0 - dr * dr;
    let k2 = d2 - m2 * m2;
    let k1 = d2 * m3 - m1 * m2 + m2 * ra * dr;
    let k0 = d2 * m5 - m1 * m1 + 2.0 * m1 * ra * dr - m0 * ra * ra;
    let h = k1 * k1 - k0 * k2;
    if h < 0.0 || k2 == 0.0 {
        return false;
    }
    let on_mantle = |t: f64| {
        let y = m1 - ra * dr + t * m2;
        t > 0.0 && t <= reach && y > 0.0 && y < d2
    };
    let root = h.sqrt();
    on_mantle((-root - k1) / k2) || on_mantle((root - k1) / k2)
}

/// Signed distance of zero from the hull's surface, negative inside.
fn distance_to_cone(a: DVec3, axis: DVec3, length2: f64, ra: f64, dr: f64) -> f64 {
    let length = length2.sqrt();
    let along = -a.dot(axis) / length;
    let beside = (a.length_squared() - along * along).max(0.0).sqrt();
    // The nearest sphere of the family lies where the mantle's normal through the point meets the axis
    let slope = dr / (length2 - dr * dr).sqrt();
    let center = (along - beside * slope).clamp(0.0, length);
    (along - center).hypot(beside) - (ra - dr * center / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::leaf::OPAQUE;
    use crate::math::hash::{hash32, unit_f32};

    fn unit(seed: &mut u32) -> f64 {
        *seed = hash32(*seed);
        f64::from(unit_f32(*seed))
    }

    /// Catches a wrong round cone: it must agree with a fine chain of its spheres.
    #[test]
    fn a_cone_is_the_union_of_its_spheres() {
        let mut seed = 5;
        let mut met = 0;
        for _ in 0..3000 {
            let point = |seed: &mut u32| DVec3::new(unit(seed), unit(seed), unit(seed)) * 20.0 - 10.0;
            let (a, b) = (point(&mut seed), point(&mut seed));
            let (ra, rb) = (0.5 + 3.0 * unit(&mut seed), 0.5 + 3.0 * unit(&mut seed));
            let direction = (point(&mut seed) + 0.01).normalize();
            let chain = |grow: f64| {
                let spheres =
                    (0..=2000).map(|i| i as f64 / 2000.0).map(|t| (a.lerp(b, t), ra + (rb - ra) * t + grow));
                let inside = spheres.clone().any(|(c, r)| c.length() <= r);
                !inside && spheres.clone().any(|(c, r)| sphere(c, r, direction, f64::INFINITY))
            };
            let exact = cone([a, b], [ra, rb], direction, f64::INFINITY);
            // Where a slightly thinner and a slightly thicker chain agree, the cone must too
            if chain(-0.01) == chain(0.01) {
                assert_eq!(exact, chain(0.0), "{a} {b} {ra} {rb} {direction}");
                met += usize::from(exact);
            }
        }
        assert!(met > 100, "only {met} hits: the test is empty");
    }

    /// Catches a gap or a double wall between the two triangles of a quad and between neighbours.
    #[test]
    fn a_ray_through_an_edge_meets_a_neighbour() {
        let corner = |x: i32, y: i32| IVec3::new(16 * x - 32, 16 * y - 32, 50);
        let faces: Vec<Face> = (0..16)
            .map(|i| (i % 4, i / 4))
            .map(|(x, y)| Face {
                vertices: [corner(x, y), corner(x + 1, y), corner(x + 1, y + 1), corner(x, y + 1)],
                arity: 4,
                extinction: OPAQUE,
                radii: [0.0; 2],
            })
            .collect();
        for x in -31..=31 {
            for y in -31..=31 {
                let direction = DVec3::new(f64::from(x), f64::from(y), 50.0).normalize();
                assert!(faces.iter().any(|f| meets(f, IVec3::ZERO, direction, f64::INFINITY)), "{x} {y}");
                assert!(!faces.iter().any(|f| meets(f, IVec3::ZERO, -direction, f64::INFINITY)));
                assert!(!faces.iter().any(|f| meets(f, IVec3::ZERO, direction, 40.0)), "out of reach");
            }
        }
    }

    /// Catches a self-hit at a face's own corner.
    #[test]
    fn a_face_with_a_corner_at_the_origin_is_not_met() {
        let corners = [IVec3::ZERO, IVec3::new(9, 0, 1), IVec3::new(9, 9, 0), IVec3::new(0, 9, 1)];
        let face = Face { vertices: corners, arity: 4, extinction: OPAQUE, radii: [0.0; 2] };
        let direction = DVec3::new(1.0, 1.0, 0.05).normalize();
        assert!(corners.iter().all(|&origin| !meets(&face, origin, direction, f64::INFINITY)));
        let behind = IVec3::new(3, 4, -20);
        assert!(meets(&face, behind, DVec3::Z, f64::INFINITY));
    }
}
