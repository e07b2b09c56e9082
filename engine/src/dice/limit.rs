//! The limit of a Catmull-Clark surface at the vertices of a level, where it is and which way it faces.
//!
//! Positions by the masks of Halstead, Kass and DeRose (1993), tangents as OpenSubdiv has them: of smooth vertices by the second
//! eigenvectors, along creases and borders by the edges, across them by the mask of Biermann, Levin and Zorin (2000).

use glam::{DVec3, Vec3};

use super::level::{Level, NONE};
use super::refine::add;
use crate::math::trig::cos_sin_turns;

/// Faces around a vertex that are looked at, at most: each of them asks for the vertex. With more it counts as sharp.
pub(super) const VALENCE_MAX: usize = 1024;

/// Values of a vertex on the limit surface. All faces around it must be quads.
pub(super) fn row(level: &Level, vertex: u32) -> Vec<f64> {
    let own = level.row(vertex);
    let is_crowded = level.corners_of(vertex).len() > VALENCE_MAX;
    if is_crowded || level.vertex_sharpness[vertex as usize] > 0.0 {
        return own.to_vec();
    }
    let (count, creases) = level.sharp_edges(vertex);
    if count > 2 {
        return own.to_vec();
    }
    let mut sum = vec![0.0; level.width];
    if count == 2 {
        add(&mut sum, own, 4.0 / 6.0);
        creases.iter().for_each(|&edge| add(&mut sum, level.row(level.other(edge, vertex)), 1.0 / 6.0));
        return sum;
    }
    let edges = level.edges_of(vertex);
    let n = edges.len() as f64;
    let weight = 1.0 / (n * (n + 5.0));
    edges.iter().for_each(|&edge| add(&mut sum, level.row(level.other(edge, vertex)), 4.0 * weight));
    for &corner in level.corners_of(vertex) {
        add(&mut sum, level.row(level.corners[level.turn(corner, 2) as usize]), weight);
    }
    add(&mut sum, own, n * n * weight);
    sum
}

/// The unit normal of the limit surface at a corner of a face: that of the side of a crease that the face lies on. Zero
/// where there is none, and where more than [`VALENCE_MAX`] faces meet.
pub(super) fn normal(level: &Level, corner: u32) -> Vec3 {
    if level.corners_of(level.corners[corner as usize]).len() > VALENCE_MAX {
        return Vec3::ZERO;
    }
    let normal = fan_normal(level, corner).normalize_or_zero();
    if normal != DVec3::ZERO {
        return normal.as_vec3();
    }
    // A cusp, or neighbours that fall together: the face itself
    let at = |corner: usize| DVec3::from_slice(level.row(level.corners[corner]));
    let face: Vec<DVec3> = level.face(level.corner_faces[corner as usize]).map(at).collect();
    (face[2] - face[0]).cross(face[3] - face[1]).normalize_or_zero().as_vec3()
}

/// The cross product of the tangents of the fan of faces that a corner is in.
fn fan_normal(level: &Level, corner: u32) -> DVec3 {
    let vertex = level.corners[corner as usize];
    let fan = Fan::around(level, corner);
    let at = |vertex: u32| DVec3::from_slice(level.row(vertex));
    let own = at(vertex);
    let (count, _) = level.sharp_edges(vertex);
    let is_corner = count > 2 || level.vertex_sharpness[vertex as usize] > 0.0;
    let edges: Vec<DVec3> = fan.edges.iter().map(|&vertex| at(vertex)).collect();
    let faces: Vec<DVec3> = fan.faces.iter().map(|&vertex| at(vertex)).collect();
    let (n, k) = (edges.len(), faces.len());
    if fan.closed {
        let (mut s, mut t) = (DVec3::ZERO, DVec3::ZERO);
        let turn = |i: usize| cos_sin_turns(i as f64 / n as f64);
        let (c1, _) = turn(1);
        let (half, _) = cos_sin_turns(0.5 / n as f64);
        let a = 1.0 + c1 + half * (2.0 * (9.0 + c1)).sqrt();
        for i in 0..n {
            let ((c, d), (next_c, next_d)) = (turn(i), turn(i + 1));
            s += a * c * edges[i] + (c + next_c) * faces[i];
            t += a * d * edges[i] + (d + next_d) * faces[i];
        }
        s.cross(t)
    } else if is_corner || k == 1 {
        (edges[0] - own).cross(edges[n - 1] - own)
    } else {
        let (c, d) = cos_sin_turns(0.5 / k as f64);
        let weight = 1.0 / (k as f64 * (3.0 + c));
        let r = (c + 1.0) / d;
        let mut across = 4.0 * r * (c - 1.0) * weight * own;
        across -= r * (1.0 + 2.0 * c) * weight * (edges[0] + edges[n - 1]);
        let sine = |i: usize| cos_sin_turns(0.5 * i as f64 / k as f64).1;
        for i in 0..k {
            across += (sine(i) + sine(i + 1)) * weight * faces[i];
            if i > 0 {
                across += 4.0 * sine(i) * weight * edges[i];
            }
        }
        (edges[0] - edges[n - 1]).cross(across)
    }
}

/// The faces around a vertex from one sharp edge to the next, counter-clockwise.
struct Fan {
    /// Ends of the edges in order; the last is behind the last face unless the fan is closed.
    edges: Vec<u32>,
    /// The corners opposite in the faces between them.
    faces: Vec<u32>,
    closed: bool,
}

impl Fan {
    fn around(level: &Level, corner: u32) -> Self {
        let corners = level.corners_of(level.corners[corner as usize]).len();
        // Back to the sharp edge that the fan begins with, or once around
        let (mut first, mut lowest) = (corner, corner);
        let mut closed = true;
        let edge = |corner: u32| level.corner_edges[corner as usize];
        for _ in 0..corners {
            match level.across(first, edge(first)) {
                // The face across the edge to the next corner lies clockwise
                Some(before) if before != corner => {
                    first = before;
                    lowest = if edge(before) < edge(lowest) { before } else { lowest };
                }
                Some(_) => break,
                None => {
                    closed = false;
                    break;
                }
            }
        }
        if closed {
            // Begin with the edge of the lowest number, whichever face asks
            first = lowest;
        }
        let mut fan = Self { edges: Vec::new(), faces: Vec::new(), closed };
        let mut at = first;
        for _ in 0..corners {
            fan.edges.push(level.corners[level.turn(at, 1) as usize]);
            fan.faces.push(level.corners[level.turn(at, 2) as usize]);
            let last = level.turn(at, -1);
            match level.across(at, edge(last)) {
                Some(next) if next != first => at = next,
                Some(_) => break,
                None => {
                    fan.edges.push(level.corners[last as usize]);
                    break;
                }
            }
        }
        fan
    }
}

impl Level {
    /// The corner at the same vertex in the face on the other side of an edge that is not sharp.
    fn across(&self, corner: u32, edge: u32) -> Option<u32> {
        if self.edge_sharpness[edge as usize] > 0.0 {
            return None;
        }
        let ([a, b], _) = self.edge_faces[edge as usize];
        let face = if a == self.corner_faces[corner as usize] { b } else { a };
        if face == NONE {
            return None;
        }
        let vertex = self.corners[corner as usize];
        self.face(face).map(|corner| corner as u32).find(|&corner| self.corners[corner as usize] == vertex)
    }
}
