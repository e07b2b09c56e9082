//! The leaf: a few micropolygons as bit-packed lattice vertices, relative to the box that the parent node has for it.
//!
//! ```text
//! byte 0  header       u32      bits 0-2    faces - 1; in a tile, rows - 1
//!                                    3-7    vertices - 1; in a tile, columns - 1
//!                                    8-12   shift
//!                                   13-27   bits of a vertex coordinate, 5 per axis, 0 to 30
//!                                   28-29   kind: 0 quads, 1 triangles, 2 round, 3 tile
//!                                   30      extinctions follow
//!                                   31      triangles: eight more faces; quads: in rows; tile: predicted
//!         stride       u8       quads in rows: vertices from one row to the next
//!         rest bits    u16      predicted tile: bits of a coordinate that is no corner's, 5 per axis, 0 to 30
//!         indices      the corners of the faces: all first ones, then all second ones, ... each column
//!                      ceil(faces * b / 8) bytes, b = 4 bits an index, or 5 for more than 16 vertices;
//!                      four columns for quads, three for triangles, two for round faces, one for quads in rows,
//!                      none in a tile
//!         coordinates  per axis ceil(vertices * bits / 8) bytes, least significant bit first; in a predicted
//!                      tile those of the four corners, then the others' with their own bits, together padded to a byte
//!         extinctions  u16 per face, if flagged
//!         radii        f32 per vertex in lattice steps, round leaves only
//! ```
//!
//! A coordinate is `((corner >> shift) + packed) << shift`, where `corner` is the lower corner of the child's decoded box:
//! a leaf cannot be read without the node that refers to it. A leaf of quads may hold triangles, which repeat their last
//! index; round leaves hold points (spheres), which repeat their only one, and lines (round cones). A tile is a piece of a
//! regular grid, faces and vertices in rows. Quads in rows have the vertices `i`, `i + 1`, `i + stride + 1` and `i + stride`, `i` being the index that is stored.
//! What is stored of a predicted tile's vertices between its corners is the signed difference from [what is
//! expected](predict).

mod contents;
mod encode;
mod layout;
pub mod predict;
#[cfg(test)]
mod tests;

use glam::IVec3;

pub use contents::{Contents, Gathered};
pub use encode::encode;
pub use layout::{Kind, Layout};

use super::node::LatticeBox;

/// Faces of a leaf at most, unless all are triangles.
pub const FACES_MAX: usize = 8;
/// Triangles of a leaf without other faces at most.
pub const TRIANGLES_MAX: usize = 16;
/// Vertices of a leaf at most.
pub const VERTICES_MAX: usize = 32;
/// Bits of a packed coordinate at most: lattice coordinates stay within ±2^29.
pub const BITS_MAX: u8 = 30;
/// Bytes before the indices.
pub const HEADER_BYTES: usize = 4;
/// Leaves start and end at multiples of this.
pub const ALIGNMENT: usize = 4;
/// Readable bytes a decoder may touch past a leaf's end.
pub const READ_PAST_BYTES: usize = 64;

/// Extinction of a fully opaque face.
pub const OPAQUE: u16 = u16::MAX;

/// Units of extinction per halving of transmittance.
///
/// Transmittances multiply; extinctions, their logarithms, add. As integers they add exactly in any order, so a
/// ray's result does not depend on the order in which it meets things.
pub const EXTINCTION_PER_OCTAVE: f32 = 4096.0;

/// The extinction of an opacity from 0 to 1: `-4096 log2(1 - opacity)`; [`OPAQUE`] from 0.99998 up.
pub fn extinction_from_opacity(opacity: f32) -> u16 {
    let transmittance = f64::from(1.0 - opacity.clamp(0.0, 1.0));
    let extinction = -f64::from(EXTINCTION_PER_OCTAVE) * transmittance.log2();
    if extinction < 65_000.0 { extinction.round() as u16 } else { OPAQUE }
}

/// One face of a leaf as the builder gives it and the plain decoder returns it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Vertices, 1 to 4; unused ones repeat the last.
    pub vertices: [IVec3; 4],
    /// 1 point, 2 line, 3 triangle, 4 quad.
    pub arity: u8,
    /// Extinction, [`OPAQUE`] for a solid face.
    pub extinction: u16,
    /// Radii of the first two vertices in lattice steps; points and lines only.
    pub radii: [f32; 2],
}

impl Face {
    /// Whether it is a point or a line.
    pub fn is_round(&self) -> bool {
        self.arity <= 2
    }

    /// Its box, radius included.
    pub fn bounds(&self) -> LatticeBox {
        if !self.is_round() {
            // Unused vertices repeat the last
            let [a, b, c, d] = self.vertices;
            return LatticeBox { min: a.min(b).min(c.min(d)), max: a.max(b).max(c.max(d)) };
        }
        let mut bounds = LatticeBox::EMPTY;
        for (&vertex, radius) in self.vertices[..usize::from(self.arity)].iter().zip(self.radii) {
            let radius = radius.ceil() as i32;
            bounds.add(vertex - radius);
            bounds.add(vertex + radius);
        }
        bounds
    }
}
