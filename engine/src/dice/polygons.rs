//! Triangles and quads, diced linearly: points, normals and values between their corners.

use glam::{DVec3, Vec3};

use super::patch::{Diced, Key, NO_POINT, Vertex, quad, triangle};
use super::rate::Rate;

/// Polygons and what their corners carry.
#[derive(Debug, Default)]
pub struct Polygons {
    /// Points.
    pub positions: Vec<DVec3>,
    /// Corners of the faces, three or four each.
    pub corners: Vec<u32>,
    /// Where the corners of each face end.
    pub ends: Vec<u32>,
    /// Unit normal per corner.
    pub normals: Vec<Vec3>,
    /// Values per corner, `width` each.
    pub values: Vec<f32>,
    /// Values of a corner.
    pub width: usize,
}

impl Polygons {
    /// The corners of a face, as a range of all corners.
    fn face(&self, face: u32) -> std::ops::Range<usize> {
        let start = face.checked_sub(1).map_or(0, |before| self.ends[before as usize]);
        start as usize..self.ends[face as usize] as usize
    }

    /// Faces that a face becomes, at most.
    pub fn estimate(&self, face: u32, rate: &Rate) -> u64 {
        let finest = (0..self.face(face).len()).map(|side| self.level(face, side, rate)).max();
        1 << (2 * finest.unwrap_or(0))
    }

    /// The centre of a face.
    pub fn center(&self, face: u32) -> DVec3 {
        let range = self.face(face);
        let count = range.len() as f64;
        self.corners[range].iter().map(|&corner| self.positions[corner as usize]).sum::<DVec3>() / count
    }

    /// Whether a face stays coarser than asked for.
    pub fn falls_short(&self, face: u32, rate: &Rate) -> bool {
        (0..self.face(face).len()).map(|side| self.side(face, side)).any(|[a, b]| rate.falls_short(a, b))
    }

    /// The ends of a side.
    fn side(&self, face: u32, side: usize) -> [DVec3; 2] {
        let corners = &self.corners[self.face(face)];
        [corners[side], corners[(side + 1) % corners.len()]].map(|point| self.positions[point as usize])
    }

    /// The level of a side.
    fn level(&self, face: u32, side: usize, rate: &Rate) -> u8 {
        let [a, b] = self.side(face, side);
        rate.level(a, b)
    }

    /// Dices some of the faces.
    pub fn dice(&self, faces: &[u32], rate: &Rate) -> Diced {
        let mut diced = Diced::default();
        for &face in faces {
            let range = self.face(face);
            let levels: Vec<u8> = (0..range.len()).map(|side| self.level(face, side, rate)).collect();
            let first = range.start;
            let count = range.len();
            let mut border = |diced: &mut Diced, side: usize, step: usize| {
                self.border(diced, [first + side, first + (side + 1) % count], levels[side], step)
            };
            match levels[..] {
                [a, b, c] => {
                    let n = f64::from(1_u32 << a.max(b).max(c));
                    let mut inside = |diced: &mut Diced, i: usize, j: usize| {
                        let (s, t) = (i as f64 / n, j as f64 / n);
                        diced.push(&self.blend(&[(first, 1.0 - s - t), (first + 1, s), (first + 2, t)]))
                    };
                    triangle(&mut diced, [a, b, c], face, &mut border, &mut inside);
                }
                [a, b, c, d] => {
                    let [n, m] = [a.max(c), b.max(d)].map(|level| f64::from(1_u32 << level));
                    let mut inside = |diced: &mut Diced, i: usize, j: usize| {
                        let (s, t) = (i as f64 / n, j as f64 / m);
                        let weights = [(1.0 - s) * (1.0 - t), s * (1.0 - t), s * t, (1.0 - s) * t];
                        diced.push(&self.blend(&[0, 1, 2, 3].map(|i| (first + i, weights[i]))))
                    };
                    quad(&mut diced, [a, b, c, d], face, &mut border, &mut inside);
                }
                _ => debug_assert!(false, "a face of {count} corners"),
            }
        }
        diced
    }

    /// The vertex at a step of a side between two corners: the same for both faces that have it, since it is made from the
    /// point of the lower number.
    fn border(&self, diced: &mut Diced, ends: [usize; 2], level: u8, step: usize) -> u32 {
        let steps = 1_usize << level;
        let [a, b] = ends.map(|corner| self.corners[corner]);
        let (ends, step) = if a <= b { (ends, step) } else { ([ends[1], ends[0]], steps - step) };
        let [a, b] = ends.map(|corner| self.corners[corner]);
        let end = match step {
            0 => Some(ends[0]),
            step if step == steps => Some(ends[1]),
            _ => None,
        };
        if let Some(corner) = end {
            let point = self.corners[corner];
            return diced
                .push_border([point, NO_POINT, 0], &Vertex { point, ..self.blend(&[(corner, 1.0)]) });
        }
        let t = step as f64 / steps as f64;
        let key: Key = [a, b, step as u32];
        diced.push_border(key, &self.blend(&[(ends[0], 1.0 - t), (ends[1], t)]))
    }

    /// A sum of corners.
    fn blend(&self, weights: &[(usize, f64)]) -> Vertex {
        let mut position = DVec3::ZERO;
        let mut normal = DVec3::ZERO;
        let mut values = vec![0.0; self.width];
        for &(corner, weight) in weights {
            position += self.positions[self.corners[corner] as usize] * weight;
            normal += self.normals[corner].as_dvec3() * weight;
            for (value, &own) in values.iter_mut().zip(&self.values[corner * self.width..]) {
                *value += own * weight as f32;
            }
        }
        Vertex { position, normal: normal.normalize_or_zero().as_vec3(), values, point: NO_POINT }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// A bumpy sheet of quads and triangles of very different sizes.
    fn sheet() -> Polygons {
        let mut polygons = Polygons { width: 1, ..Polygons::default() };
        let x = [0.0, 1.0, 1.25, 4.0, 11.0];
        for j in 0..5 {
            for i in 0..5 {
                polygons.positions.push(DVec3::new(x[i], x[j], f64::from((i * 7 + j * 3) as u32 % 5) * 0.3));
            }
        }
        let mut push = |corners: &[u32]| {
            polygons.corners.extend_from_slice(corners);
            polygons.ends.push(polygons.corners.len() as u32);
        };
        for j in 0..4_u32 {
            for i in 0..4_u32 {
                let at = 5 * j + i;
                match (i + j) % 3 {
                    0 => push(&[at, at + 1, at + 6, at + 5]),
                    1 => [[at, at + 1, at + 6], [at, at + 6, at + 5]].iter().for_each(|t| push(t)),
                    _ => push(&[at + 6, at + 5, at, at + 1]),
                }
            }
        }
        polygons.normals = vec![Vec3::Z; polygons.corners.len()];
        polygons.values = polygons.corners.iter().map(|&c| polygons.positions[c as usize].x as f32).collect();
        polygons
    }

    /// Catches a crack or an overlap: inside the sheet every edge must have exactly two faces, in opposite directions, by
    /// the exact positions of its ends, over chunks that are diced apart; and the sheet must have its area.
    #[test]
    fn neighbours_of_different_rates_leave_no_crack() {
        let polygons = sheet();
        let rate = Rate::world(0.3).unwrap();
        let all: Vec<u32> = (0..polygons.ends.len() as u32).collect();
        let mut edges: BTreeMap<[[u64; 3]; 2], i32> = BTreeMap::new();
        let (mut faces, mut area) = (0, 0.0);
        for chunk in all.chunks(5) {
            let diced = polygons.dice(chunk, &rate);
            for face in &diced.faces {
                let count = if face[3] == NO_POINT { 3 } else { 4 };
                let at = |i: usize| diced.positions[face[i % count] as usize];
                for i in 0..count {
                    let [a, b] = [at(i), at(i + 1)].map(|p| p.to_array().map(f64::to_bits));
                    *edges.entry([a.min(b), a.max(b)]).or_default() += if a < b { 1 } else { -1 };
                }
                area += 0.5 * (1..count - 1).map(|i| (at(i) - at(0)).cross(at(i + 1) - at(0)).z).sum::<f64>();
                faces += 1;
            }
            for (vertex, position) in diced.positions.iter().enumerate() {
                assert!((diced.values[vertex] - position.x as f32).abs() < 1e-5);
                assert!((diced.normals[vertex] - Vec3::Z).length() < 1e-6);
            }
        }
        assert!(faces > 2000);
        assert!((area - 121.0).abs() < 1e-9, "{area}");
        let is_border = |p: [u64; 3], axis: usize| [0.0, 11.0].contains(&f64::from_bits(p[axis]));
        for (ends, balance) in edges {
            let on_border = (0..2).any(|axis| ends[0][axis] == ends[1][axis] && is_border(ends[0], axis));
            assert_eq!(balance != 0, on_border, "{:?}", ends.map(|p| p.map(f64::from_bits)));
        }
    }

    /// Catches vertices that are doubled on borders, a point whose number is lost, and edges longer than asked for.
    #[test]
    fn vertices_are_shared_and_edges_short() {
        let polygons = sheet();
        let all: Vec<u32> = (0..polygons.ends.len() as u32).collect();
        let diced = polygons.dice(&all, &Rate::world(0.5).unwrap());
        let mut places: Vec<_> = diced.positions.iter().map(|p| p.to_array().map(f64::to_bits)).collect();
        places.sort_unstable();
        let count = places.len();
        places.dedup();
        assert_eq!(places.len(), count);
        let mut points: Vec<u32> = diced.points.iter().copied().filter(|&point| point != NO_POINT).collect();
        points.sort_unstable();
        assert_eq!(points, (0..25).collect::<Vec<_>>());
    }
}
