//! Polygons of more than four corners become triangles; quads get the diagonal that lies inside.

use glam::{DVec2, DVec3};

/// Corners of a concave polygon at most. Clipping ears takes time quadratic in the corners: at this bound a thousand
/// steps for each corner a file has.
const EARS_MAX: usize = 1024;

/// Memory and result of [`triangulate`].
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// The triangles, as indices into the polygon's corners.
    pub triangles: Vec<[u32; 3]>,
    flat: Vec<DVec2>,
    ring: Vec<u32>,
    ears: Vec<bool>,
}

/// The normal of a polygon, its length twice the area (Newell's sum, relative to the first corner).
pub(super) fn area_normal(points: &[DVec3]) -> DVec3 {
    let origin = points[0];
    points.windows(2).skip(1).map(|pair| (pair[0] - origin).cross(pair[1] - origin)).sum()
}

/// Which corner a quad must start with for its diagonal v0-v2 to lie inside; none when it has no area.
pub(super) fn quad_diagonal(points: &[DVec3; 4]) -> Option<usize> {
    let [a, b, c, d] = *points;
    let halves = [area_normal(&[a, b, c]), area_normal(&[a, c, d])];
    if halves[0] == DVec3::ZERO && halves[1] == DVec3::ZERO {
        return None;
    }
    let other = [area_normal(&[b, c, d]), area_normal(&[b, d, a])];
    let folds = halves[0].dot(halves[1]) < 0.0 && other[0].dot(other[1]) > 0.0;
    Some(usize::from(folds))
}

/// Fills `scratch.triangles` with n - 2 triangles that cover a simple polygon: a fan when it is convex, else by
/// clipping ears (Meisters 1975). False for a concave polygon of more than [`EARS_MAX`] corners.
pub(super) fn triangulate(points: &[DVec3], scratch: &mut Scratch) -> bool {
    scratch.triangles.clear();
    flatten(points, &mut scratch.flat);
    let flat = &scratch.flat;
    let n = flat.len();
    if is_convex(flat) {
        scratch.triangles.extend((1..n as u32 - 1).map(|i| [0, i, i + 1]));
        return true;
    }
    if n > EARS_MAX {
        return false;
    }
    clip_ears(scratch);
    true
}

/// Projects to the plane of the two axes that show most of the polygon, turning counter-clockwise.
fn flatten(points: &[DVec3], flat: &mut Vec<DVec2>) {
    let normal = area_normal(points);
    let size = normal.abs();
    let origin = points[0];
    let (u, v, turn) = if size.x >= size.y && size.x >= size.z {
        (1, 2, normal.x)
    } else if size.y >= size.z {
        (2, 0, normal.y)
    } else {
        (0, 1, normal.z)
    };
    let sign = if turn < 0.0 { -1.0 } else { 1.0 };
    flat.clear();
    flat.extend(points.iter().map(|&p| DVec2::new((p - origin)[u] * sign, (p - origin)[v])));
}

/// Twice the signed area of a triangle.
fn turn(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

/// Whether all corners turn left and the outline goes around once.
fn is_convex(flat: &[DVec2]) -> bool {
    let n = flat.len();
    // An outline that goes around once changes its direction along x twice
    let mut changes = 0;
    let mut last = 0.0;
    for i in 0..2 * n {
        let step = flat[(i + 1) % n].x - flat[i % n].x;
        if step != 0.0 {
            changes += usize::from(i >= n && last * step < 0.0);
            last = step.signum();
        }
    }
    changes <= 2 && (0..n).all(|i| turn(flat[i], flat[(i + 1) % n], flat[(i + 2) % n]) >= 0.0)
}

/// Cuts off one ear after the other. Only the two neighbours of a cut can change from an ear or to one. Where no corner
/// is an ear, as in polygons that cross themselves, the most convex one is cut, so that the work always ends.
fn clip_ears(scratch: &mut Scratch) {
    let Scratch { triangles, flat, ring, ears } = scratch;
    let n = flat.len();
    ring.clear();
    ring.extend(0..n as u32);
    ears.clear();
    ears.extend((0..n).map(|i| is_ear(around(ring, i), ring, flat)));
    let mut at = 0;
    while ring.len() > 3 {
        let n = ring.len();
        let ear = (0..n).map(|step| (at + step) % n).find(|&i| ears[i]);
        let cut = ear.unwrap_or_else(|| most_convex(ring, flat));
        triangles.push(around(ring, cut));
        ring.remove(cut);
        ears.remove(cut);
        let n = ring.len();
        for i in [(cut + n - 1) % n, cut % n] {
            ears[i] = is_ear(around(ring, i), ring, flat);
        }
        // Going on behind the next corner spreads the triangles instead of making one long fan
        at = (cut + 1) % n;
    }
    triangles.push([ring[0], ring[1], ring[2]]);
}

/// A corner of the ring between its neighbours.
fn around(ring: &[u32], i: usize) -> [u32; 3] {
    let n = ring.len();
    [ring[(i + n - 1) % n], ring[i], ring[(i + 1) % n]]
}

/// Whether a corner turns left and no other corner of the ring lies in its triangle.
fn is_ear([a, b, c]: [u32; 3], ring: &[u32], flat: &[DVec2]) -> bool {
    let [pa, pb, pc] = [a, b, c].map(|i| flat[i as usize]);
    if turn(pa, pb, pc) <= 0.0 {
        return false;
    }
    !ring.iter().any(|&i| {
        let p = flat[i as usize];
        let is_corner = p == pa || p == pb || p == pc;
        !is_corner && turn(pa, pb, p) >= 0.0 && turn(pb, pc, p) >= 0.0 && turn(pc, pa, p) >= 0.0
    })
}

fn most_convex(ring: &[u32], flat: &[DVec2]) -> usize {
    let n = ring.len();
    let area = |i: usize| {
        let [a, b, c] = around(ring, i).map(|j| flat[j as usize]);
        turn(a, b, c)
    };
    (0..n).max_by(|&i, &j| area(i).total_cmp(&area(j))).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(points: &[DVec3], triangles: &[[u32; 3]]) -> (f64, f64) {
        let signed = |t: &[u32; 3]| 0.5 * area_normal(&t.map(|i| points[i as usize])).z;
        (triangles.iter().map(signed).sum(), triangles.iter().map(|t| signed(t).abs()).sum())
    }

    /// A star of `n` tips in the plane z = 3.
    fn star(n: usize, inner: f64) -> Vec<DVec3> {
        (0..2 * n)
            .map(|i| {
                let angle = std::f64::consts::PI * i as f64 / n as f64;
                let radius = if i % 2 == 0 { 1.0 } else { inner };
                DVec3::new(radius * angle.cos(), radius * angle.sin(), 3.0)
            })
            .collect()
    }

    /// Catches triangles that overlap, leave a hole, or turn over: each must lie inside, their areas sum to the whole.
    #[test]
    fn triangles_cover_concave_polygons_once() {
        let comb: Vec<DVec3> = (0..20)
            .map(|i| DVec3::new(f64::from(i), if i % 2 == 0 { 5.0 } else { 1.0 }, 3.0))
            .rev()
            .chain([DVec3::new(0.0, 0.0, 3.0), DVec3::new(19.0, 0.0, 3.0)])
            .collect();
        for points in [star(5, 0.3), star(5, 0.95), star(200, 0.5), comb] {
            let mut scratch = Scratch::default();
            assert!(triangulate(&points, &mut scratch));
            assert_eq!(scratch.triangles.len(), points.len() - 2);
            let whole = 0.5 * area_normal(&points).z;
            let (signed, absolute) = area(&points, &scratch.triangles);
            assert!((signed - whole).abs() < 1e-9, "{signed} {whole}");
            assert!((absolute - whole).abs() < 1e-9, "{absolute} {whole}");
        }
    }

    /// Catches a hang or a loss of triangles on outlines that cross themselves or fold onto a line.
    #[test]
    fn crossing_polygons_still_end() {
        let crossed: Vec<DVec3> =
            (0..50).map(|i| DVec3::new(f64::from(i * 37 % 11), f64::from(i * 53 % 13), 0.0)).collect();
        let line: Vec<DVec3> = (0..9).map(|i| DVec3::new(f64::from(i * 4 % 9), 0.0, 0.0)).collect();
        for points in [crossed, line] {
            let mut scratch = Scratch::default();
            assert!(triangulate(&points, &mut scratch));
            assert_eq!(scratch.triangles.len(), points.len() - 2);
        }
        assert!(!triangulate(&star(EARS_MAX, 0.5), &mut Scratch::default()));
    }

    /// Catches an arrowhead that would be split along the diagonal outside it.
    #[test]
    fn arrowheads_start_at_their_notch() {
        let notch_at_1 =
            [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, 0.0, 0.0], [1.0, 4.0, 0.0]].map(DVec3::from);
        assert_eq!(quad_diagonal(&notch_at_1), Some(1));
        let mut notch_at_0 = notch_at_1;
        notch_at_0.rotate_left(1);
        assert_eq!(quad_diagonal(&notch_at_0), Some(0));
        assert_eq!(quad_diagonal(&[DVec3::ZERO; 4]), None);
    }
}
