//! The leaves of a partition before they are written: their vertices in memory, so that each is encoded once, when the node is
//! known that refers to it.

use crate::brick::leaf::{Contents, Kind};
use glam::IVec3;

/// Leaves, numbered in the order in which they came.
#[derive(Debug, Default)]
pub struct Leaves {
    vertices: Vec<IVec3>,
    indices: Vec<u8>,
    extinctions: Vec<u16>,
    radii: Vec<f32>,
    records: Vec<Record>,
}

/// Where a leaf's columns end; they begin where those of the leaf before it end.
#[derive(Clone, Copy, Debug)]
struct Record {
    vertices: u32,
    indices: u32,
    extinctions: u32,
    radii: u32,
    kind: Kind,
    faces: u8,
    stride: u8,
    shift: u8,
}

impl Leaves {
    /// Adds a leaf.
    pub fn push(&mut self, leaf: &Contents<'_>) {
        self.vertices.extend_from_slice(leaf.vertices);
        self.indices.extend_from_slice(leaf.indices);
        self.extinctions.extend_from_slice(leaf.extinctions);
        self.radii.extend_from_slice(leaf.radii);
        self.records.push(Record {
            vertices: self.vertices.len() as u32,
            indices: self.indices.len() as u32,
            extinctions: self.extinctions.len() as u32,
            radii: self.radii.len() as u32,
            kind: leaf.kind,
            faces: leaf.faces as u8,
            stride: leaf.stride as u8,
            shift: leaf.shift,
        });
    }

    /// A leaf.
    #[inline(always)]
    pub fn get(&self, leaf: usize) -> Contents<'_> {
        let end = &self.records[leaf];
        let [v, i, e, r] = match leaf.checked_sub(1).map(|before| &self.records[before]) {
            Some(start) => [start.vertices, start.indices, start.extinctions, start.radii],
            None => [0; 4],
        };
        Contents {
            kind: end.kind,
            faces: usize::from(end.faces),
            stride: usize::from(end.stride),
            shift: end.shift,
            vertices: &self.vertices[v as usize..end.vertices as usize],
            indices: &self.indices[i as usize..end.indices as usize],
            extinctions: &self.extinctions[e as usize..end.extinctions as usize],
            radii: &self.radii[r as usize..end.radii as usize],
        }
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }
}
