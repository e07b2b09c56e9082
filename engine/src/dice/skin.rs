//! Skins: values that differ between the faces of a point follow the surface too. Faces that have equal values at their
//! common points are one island, a surface of its own that ends at its seams.

use std::collections::{HashMap, HashSet};

use super::cage::{Cage, sorted};
use super::level::{NONE, SHARP};

/// Which points of a skin stay where they are at its seams: USD's `faceVaryingLinearInterpolation`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Seams {
    /// None: `none`.
    Smooth,
    /// Those of one face of an island: `cornersOnly`.
    Corners,
    /// And those where three islands and more meet: `cornersPlus1`, USD's fallback.
    #[default]
    Junctions,
    /// And those where a seam ends, or goes around one face: `cornersPlus2`.
    Darts,
    /// All on a seam: `boundaries`.
    Boundaries,
    /// All: values are linear in each face: `all`.
    Linear,
}

impl Cage {
    /// Adds values, `width` for each corner of all faces. [`Seams::Linear`] has no skin: such values are [`linear`](Self::linear).
    pub fn add_skin(&mut self, values: &[f32], width: usize, seams: Seams) {
        // A point of the skin for each value at a point
        let (mut skin, mut points) =
            (Self { smooth_width: width, ends: self.ends.clone(), ..Self::default() }, vec![]);
        let mut heads = vec![NONE; self.positions.len()];
        let mut nexts: Vec<u32> = Vec::new();
        for (corner, &point) in self.corners.iter().enumerate() {
            let own = &values[corner * width..(corner + 1) * width];
            let head = heads[point as usize];
            let mut at = head;
            while at != NONE && !has_bits(&skin.smooth[at as usize * width..][..width], own) {
                at = nexts[at as usize];
            }
            if at == NONE {
                at = nexts.len() as u32;
                nexts.push(head);
                heads[point as usize] = at;
                points.push(point);
                skin.positions.push(self.positions[point as usize]);
                skin.smooth.extend_from_slice(own);
            }
            skin.corners.push(at);
        }
        self.sharpen(&mut skin, &points, seams);
        self.skins.push(skin);
    }

    /// Makes a skin sharp where the surface is, and at its seams.
    fn sharpen(&self, skin: &mut Self, points: &[u32], seams: Seams) {
        for face in (0..self.ends.len() as u32).filter(|_| !self.creases.is_empty()) {
            for side in 0..self.face(face).len() {
                if let Some(&sharpness) = self.creases.get(&sorted(self.edge(face, side))) {
                    skin.creases.insert(sorted(skin.edge(face, side)), sharpness);
                }
            }
        }
        skin.sharp_corners = seams != Seams::Smooth;
        let mut faces = vec![0_u32; points.len()];
        skin.corners.iter().for_each(|&corner| faces[corner as usize] += 1);
        // Islands at a point, and the fewest faces that one of them has there
        let mut islands: HashMap<u32, (u32, u32)> = HashMap::new();
        for (&point, &faces) in points.iter().zip(&faces) {
            let (count, fewest) = islands.entry(point).or_insert((0, u32::MAX));
            (*count, *fewest) = (*count + 1, faces.min(*fewest));
        }
        let on_seam = match seams {
            Seams::Darts | Seams::Boundaries => open_points(skin),
            _ => HashSet::new(),
        };
        let on_border = if seams == Seams::Darts { open_points(self) } else { HashSet::new() };
        for (number, point) in (0..).zip(points) {
            let (count, fewest) = islands[point];
            let is_junction = count > 2;
            let is_dart = match count {
                1 => on_seam.contains(&number) && !on_border.contains(point),
                2 => fewest == 1,
                _ => false,
            };
            let is_sharp = match seams {
                Seams::Smooth | Seams::Corners | Seams::Linear => false,
                Seams::Junctions => is_junction,
                Seams::Darts => is_junction || is_dart,
                Seams::Boundaries => on_seam.contains(&number),
            };
            let own = self.sharp_points.get(point).copied().unwrap_or(0.0);
            let sharpness = if is_sharp { SHARP } else { own };
            if sharpness > 0.0 {
                skin.sharp_points.insert(number, sharpness);
            }
        }
    }
}

fn has_bits(a: &[f32], b: &[f32]) -> bool {
    a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}

/// The ends of all edges of one face alone.
fn open_points(cage: &Cage) -> HashSet<u32> {
    let faces = 0..cage.ends.len() as u32;
    let sides =
        faces.flat_map(|face| (0..cage.face(face).len()).map(move |side| sorted(cage.edge(face, side))));
    let mut counts: HashMap<[u32; 2], u32> = HashMap::new();
    sides.for_each(|ends| *counts.entry(ends).or_default() += 1);
    counts.into_iter().filter(|(_, count)| *count == 1).flat_map(|(ends, _)| ends).collect()
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, Vec3};

    use super::*;
    use crate::dice::{Diced, Rate};

    /// A bumpy sheet of `n` by `n` quads.
    fn sheet(n: u32) -> Cage {
        let mut cage = Cage { sharp_corners: true, ..Cage::default() };
        for i in 0..(n + 1) * (n + 1) {
            let (x, y) = (i % (n + 1), i / (n + 1));
            cage.positions.push(DVec3::new(x.into(), y.into(), f64::from((3 * x + 5 * y) % 4) * 0.4));
        }
        for at in (0..n * n).map(|i| i / n * (n + 1) + i % n) {
            cage.corners.extend([at, at + 1, at + n + 2, at + n + 1]);
            cage.ends.push(cage.corners.len() as u32);
        }
        cage
    }

    /// The positions of all corners, as values.
    fn places(cage: &Cage) -> Vec<f32> {
        cage.corners.iter().flat_map(|&point| cage.positions[point as usize].as_vec3().to_array()).collect()
    }

    fn dice(cage: &Cage, faces: &[u32]) -> Diced {
        cage.prepare(&Rate::world(0.3).unwrap()).dice(faces)
    }

    fn rows(diced: &Diced) -> impl Iterator<Item = (Vec3, Vec3)> {
        diced
            .positions
            .iter()
            .zip(diced.values.chunks_exact(3))
            .map(|(p, row)| (p.as_vec3(), Vec3::from_slice(row)))
    }

    /// Catches values that stay behind the surface though they belong to corners, near creases too.
    #[test]
    fn values_of_corners_follow_the_surface() {
        for seams in [Seams::Corners, Seams::Junctions, Seams::Darts] {
            let mut cage = sheet(4);
            cage.creases.insert([6, 11], SHARP);
            cage.creases.insert([11, 12], 1.5);
            cage.sharp_points.insert(18, 0.7);
            let values = places(&cage);
            cage.add_skin(&values, 3, seams);
            let faces: Vec<u32> = (0..16).collect();
            let diced = dice(&cage, &faces);
            assert!(rows(&diced).count() > 200);
            for (place, value) in rows(&diced) {
                assert!((place - value).length() < 1e-5, "{seams:?} {place} {value}");
            }
        }
    }

    /// Catches islands that pull at each other: each must be as if it were alone, whichever parts are diced together.
    #[test]
    fn an_island_is_a_surface_of_its_own() {
        let mut whole = sheet(4);
        let is_left = |face: u32| face % 4 < 2;
        let offset =
            |corner: usize| if is_left(corner as u32 / 4) { Vec3::ZERO } else { Vec3::new(50.0, 0.0, 7.0) };
        let shifted: Vec<f32> = places(&whole)
            .chunks_exact(3)
            .enumerate()
            .flat_map(|(corner, row)| (Vec3::from_slice(row) + offset(corner)).to_array())
            .collect();
        whole.add_skin(&shifted, 3, Seams::Junctions);
        let left: Vec<u32> = (0..16).filter(|&face| is_left(face)).collect();
        let mut alone = Cage { positions: whole.positions.clone(), sharp_corners: true, ..Cage::default() };
        for &face in &left {
            alone.corners.extend(&whole.corners[whole.face(face)]);
            alone.ends.push(alone.corners.len() as u32);
        }
        let own = dice(&alone, &(0..8).collect::<Vec<_>>());
        for faces in [&left[..], &left[2..3], &[0, 1, 2, 3]] {
            for (_, value) in rows(&dice(&whole, faces)).filter(|(_, value)| value.x < 40.0) {
                let near = own.positions.iter().map(|p| p.as_vec3().distance(value)).fold(f32::MAX, f32::min);
                assert!(near < 1e-5, "{value} {near}");
            }
        }
    }

    /// Catches rules that are mixed up: which points stay at a seam that goes around one face, and at a junction.
    #[test]
    fn seams_keep_the_points_that_their_rule_says() {
        // Around the face 5 of 4 by 4 goes a seam; faces 10, 11, 14 and 15 differ, too, and meet it at the point 12
        let island = |face: u32| match face {
            5 => 1.0,
            10 => 2.0,
            11 | 14 | 15 => 3.0,
            _ => 0.0,
        };
        let kept = |seams: Seams| {
            let mut cage = sheet(4);
            let values: Vec<f32> = places(&cage)
                .chunks_exact(3)
                .enumerate()
                .flat_map(|(corner, row)| [row[0], row[1], row[2] + 100.0 * island(corner as u32 / 4)])
                .collect();
            cage.add_skin(&values, 3, seams);
            let skin = &cage.skins[0];
            let sharp = |number: &u32| skin.sharp_points.contains_key(number);
            let mut points: Vec<[i64; 2]> = (0..skin.positions.len() as u32)
                .filter(sharp)
                .map(|number| skin.positions[number as usize].truncate().to_array().map(|x| x as i64))
                .collect();
            points.sort_unstable();
            points.dedup();
            (points, skin.sharp_corners)
        };
        assert_eq!(kept(Seams::Smooth), (vec![], false));
        assert_eq!(kept(Seams::Corners), (vec![], true));
        // Three islands and more meet at the point (2, 2), and two at (3, 2) and (2, 3), besides the one around them
        assert_eq!(kept(Seams::Junctions), (vec![[2, 2], [2, 3], [3, 2]], true));
        // Corners are sharp anyhow: (2, 4) and (4, 2) are
        let darts = [[1, 1], [1, 2], [2, 1], [2, 2], [2, 3], [2, 4], [3, 2], [3, 3], [4, 2]];
        assert_eq!(kept(Seams::Darts).0, darts);
        let all = kept(Seams::Boundaries).0;
        assert!(all.contains(&[0, 2]) && all.contains(&[4, 3]) && !all.contains(&[1, 3]), "{all:?}");
    }
}
