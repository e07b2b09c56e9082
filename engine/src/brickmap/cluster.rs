//! Gathers faces that lie in no rows into full leaves.
//!
//! A leaf has room for eight quads, points or lines, or for sixteen triangles. Faces are parted at planes that make the boxes
//! of full leaves small ([`sah`]).

use glam::IVec3;

use super::sah::{self, Reference};
use crate::brick::LatticeBox;
use crate::brick::leaf::{FACES_MAX, Face, TRIANGLES_MAX, VERTICES_MAX};

/// What fits a leaf: a triangle among triangles weighs 1, any other face 2.
const CAPACITY: u32 = 2 * FACES_MAX as u32;
const _: () = assert!(CAPACITY as usize == TRIANGLES_MAX);

/// Triangles have sixteen to a leaf in mind where less than one face in so many is of another kind.
const OTHERS_SHARE_MIN: usize = 16;

/// Faces that stay together: one of any kind, or a few quads.
#[derive(Clone, Copy, Debug)]
pub struct Item {
    /// The first of its faces.
    pub first: u32,
    /// How many.
    pub count: u32,
    /// The box around them.
    pub bounds: LatticeBox,
}

impl Item {
    /// The item of `faces`, the first of which is number `first`.
    pub fn new(first: u32, faces: &[Face]) -> Self {
        let bounds = faces.iter().fold(LatticeBox::EMPTY, |bounds, face| bounds.union(face.bounds()));
        Self { first, count: faces.len() as u32, bounds }
    }
}

/// Calls `each` with the numbers of the faces of every leaf.
pub fn cluster(items: &[Item], faces: &[Face], mut each: impl FnMut(&[u32])) {
    let Some(base) = items.first().map(|item| item.bounds.min) else { return };
    // A few other faces cost their leaves half the room; many cost all of them that
    let others = faces.iter().filter(|face| face.arity != 3).count();
    let weight = if OTHERS_SHARE_MIN * others > faces.len() { 2 } else { 1 };
    let mut references: Vec<Reference> = items
        .iter()
        .zip(0..)
        .map(|(item, index)| Reference::new(&item.bounds, base, weight * item.count, index))
        .collect();
    let mut members = Vec::with_capacity(TRIANGLES_MAX);
    let mut stack = vec![0..references.len()];
    while let Some(range) = stack.pop() {
        let part = &mut references[range.clone()];
        if part.len() <= TRIANGLES_MAX {
            members.clear();
            let parts = part.iter().map(|r| &items[r.index() as usize]);
            members.extend(parts.flat_map(|item| item.first..item.first + item.count));
            if part.len() == 1 || fits(&members, faces) {
                each(&members);
                continue;
            }
        }
        let middle = range.start + sah::split(part, CAPACITY);
        stack.push(middle..range.end);
        stack.push(range.start..middle);
    }
}

/// Whether faces fit a leaf.
fn fits(members: &[u32], faces: &[Face]) -> bool {
    if members.len() <= FACES_MAX {
        return true;
    }
    let triangles = || members.iter().map(|&member| &faces[member as usize]);
    members.len() <= TRIANGLES_MAX
        && triangles().all(|face| face.arity == 3)
        && (3 * members.len() <= VERTICES_MAX || vertices_fit(triangles()))
}

fn vertices_fit<'a>(triangles: impl Iterator<Item = &'a Face>) -> bool {
    let (mut known, mut count) = ([IVec3::ZERO; VERTICES_MAX], 0);
    for vertex in triangles.flat_map(|face| &face.vertices[..3]) {
        if !known[..count].contains(vertex) {
            if count == VERTICES_MAX {
                return false;
            }
            known[count] = *vertex;
            count += 1;
        }
    }
    true
}
