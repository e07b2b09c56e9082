//! Patches become grids of faces that meet their neighbours without cracks.
//!
//! A patch has four sides, or three, and each side a level of its own, which its neighbour agrees on. Inside the patch a
//! regular grid has the finest level of the sides; on a coarser side its vertices move to the nearest one that the side has,
//! and faces that this flattens are left out. So both patches at a side have the same vertices there, and no others.

use std::collections::HashMap;

use glam::{DVec3, Vec3};

/// A vertex that no point of the cage is.
pub const NO_POINT: u32 = u32::MAX;

/// What identifies a vertex on the border of a patch, the same for all patches that meet there.
pub(super) type Key = [u32; 3];

/// A vertex as a surface gives it.
#[derive(Clone, Debug)]
pub(super) struct Vertex {
    pub position: DVec3,
    pub normal: Vec3,
    pub values: Vec<f32>,
    /// The point of the cage, or [`NO_POINT`].
    pub point: u32,
}

/// Faces of diced patches over shared vertices.
#[derive(Debug, Default)]
pub struct Diced {
    /// Per vertex where it is.
    pub positions: Vec<DVec3>,
    /// Per vertex its unit normal; zero where the surface has none.
    pub normals: Vec<Vec3>,
    /// Per vertex the values of the surface, one after the other.
    pub values: Vec<f32>,
    /// Per vertex the point of the cage, or [`NO_POINT`].
    pub points: Vec<u32>,
    /// Vertices of all faces; of three corners where the fourth is [`NO_POINT`].
    pub faces: Vec<[u32; 4]>,
    /// Per face that of the cage.
    pub sources: Vec<u32>,
    /// Vertices on borders, by key; several where normals or values differ between patches.
    borders: HashMap<Key, Vec<u32>>,
}

impl Diced {
    /// Adds a vertex inside a patch.
    pub(super) fn push(&mut self, vertex: &Vertex) -> u32 {
        let index = self.positions.len() as u32;
        self.positions.push(vertex.position);
        self.normals.push(vertex.normal);
        self.values.extend_from_slice(&vertex.values);
        self.points.push(vertex.point);
        index
    }

    /// Adds a vertex on a border, unless the same one is there.
    pub(super) fn push_border(&mut self, key: Key, vertex: &Vertex) -> u32 {
        let width = vertex.values.len();
        let same = |&&index: &&u32| {
            let at = index as usize;
            // Bits, not numbers: zeros of both signs and what is not a number stay what they are
            let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
            bits(&self.normals[at].to_array()) == bits(&vertex.normal.to_array())
                && bits(&self.values[at * width..(at + 1) * width]) == bits(&vertex.values)
        };
        let known = self.borders.get(&key).and_then(|all| all.iter().find(same)).copied();
        known.unwrap_or_else(|| {
            let index = self.push(vertex);
            self.borders.entry(key).or_default().push(index);
            index
        })
    }

    /// Adds a face unless it is flat. Corners that follow each other may be the same.
    fn push_face(&mut self, corners: [u32; 4], source: u32) {
        let mut kept = [NO_POINT; 4];
        let mut count = 0;
        for (i, &corner) in corners.iter().enumerate() {
            if corner != NO_POINT && corner != corners[(i + 3) % 4] && !kept[..count].contains(&corner) {
                kept[count] = corner;
                count += 1;
            }
        }
        if count >= 3 {
            self.faces.push(kept);
            self.sources.push(source);
        }
    }
}

/// The nearest of the places that a side has: step `i` of `1 << fine` on a side of `1 << coarse` steps, in its own steps.
fn snap(i: usize, fine: u8, coarse: u8) -> usize {
    let shift = fine - coarse;
    if shift == 0 { i } else { (i + (1 << (shift - 1))) >> shift }
}

/// Adds the faces of a patch of four sides. `levels` are those of the sides from corner to corner, in order; `border`
/// gives the vertex at a step of a side, counted along the patch's turn in the side's own steps; `inside` that at a place
/// (i, j) of the grid of `1 << u` by `1 << v` cells.
pub(super) fn quad(
    diced: &mut Diced,
    levels: [u8; 4],
    source: u32,
    border: &mut dyn FnMut(&mut Diced, usize, usize) -> u32,
    inside: &mut dyn FnMut(&mut Diced, usize, usize) -> u32,
) {
    let (u, v) = (levels[0].max(levels[2]), levels[1].max(levels[3]));
    let (n, m) = (1_usize << u, 1_usize << v);
    let mut row = |diced: &mut Diced, j: usize| -> Vec<u32> {
        (0..=n)
            .map(|i| match (i, j) {
                (i, 0) => border(diced, 0, snap(i, u, levels[0])),
                (i, j) if j == m => border(diced, 2, snap(n - i, u, levels[2])),
                (0, j) => border(diced, 3, snap(m - j, v, levels[3])),
                (i, j) if i == n => border(diced, 1, snap(j, v, levels[1])),
                (i, j) => inside(diced, i, j),
            })
            .collect()
    };
    let mut below = row(diced, 0);
    for j in 0..m {
        let above = row(diced, j + 1);
        for i in 0..n {
            diced.push_face([below[i], below[i + 1], above[i + 1], above[i]], source);
        }
        below = above;
    }
}

/// Adds the faces of a patch of three sides; `inside` gives the vertex at steps `i` towards the second corner and `j`
/// towards the third, of `1 << level`, the finest of the sides.
pub(super) fn triangle(
    diced: &mut Diced,
    levels: [u8; 3],
    source: u32,
    border: &mut dyn FnMut(&mut Diced, usize, usize) -> u32,
    inside: &mut dyn FnMut(&mut Diced, usize, usize) -> u32,
) {
    let level = levels[0].max(levels[1]).max(levels[2]);
    let n = 1_usize << level;
    let mut row = |diced: &mut Diced, j: usize| -> Vec<u32> {
        (0..=n - j)
            .map(|i| match (i, j) {
                (i, 0) => border(diced, 0, snap(i, level, levels[0])),
                (i, j) if i + j == n => border(diced, 1, snap(j, level, levels[1])),
                (0, j) => border(diced, 2, snap(n - j, level, levels[2])),
                (i, j) => inside(diced, i, j),
            })
            .collect()
    };
    let mut below = row(diced, 0);
    for j in 0..n {
        let above = row(diced, j + 1);
        for i in 0..n - j {
            diced.push_face([below[i], below[i + 1], above[i], NO_POINT], source);
            if i + 1 < n - j {
                diced.push_face([below[i + 1], above[i + 1], above[i], NO_POINT], source);
            }
        }
        below = above;
    }
}
