//! What a leaf holds, before it is written: its vertices, and which of them its faces have.

use glam::IVec3;

use super::layout::Kind;
use super::{FACES_MAX, Face, OPAQUE, TRIANGLES_MAX, VERTICES_MAX};

/// Vertices to five faces at most where quads are stored in rows: what indices save may be spent on vertices that two faces
/// have in common.
const ROW_VERTICES_MAX: usize = 5;

/// What a leaf holds.
#[derive(Clone, Copy, Debug)]
pub struct Contents<'a> {
    /// What the faces are.
    pub kind: Kind,
    /// Faces.
    pub faces: usize,
    /// Vertices from one row to the next where all faces are quads over two rows, else 0. Those of a tile follow one another.
    pub stride: usize,
    /// Lattice shift of the faces' geometry: coordinates are multiples of `2^shift`.
    pub shift: u8,
    /// The vertices.
    pub vertices: &'a [IVec3],
    /// The number of every face's first vertex, then, unless there is a stride, of every second one, and so on. None in a tile.
    pub indices: &'a [u8],
    /// Of each face, or none where all are opaque.
    pub extinctions: &'a [u16],
    /// Of each vertex in lattice steps; round faces only.
    pub radii: &'a [f32],
}

impl Contents<'_> {
    /// The vertex number of a face's corner.
    #[inline(always)]
    pub fn index(&self, face: usize, corner: usize) -> usize {
        let corner = corner.min(self.kind.corners() - 1);
        match self.stride {
            0 => usize::from(self.indices[corner * self.faces + face]),
            stride => {
                let first = if self.kind == Kind::Tile {
                    face + face / (stride - 1)
                } else {
                    usize::from(self.indices[face])
                };
                first + [0, 1, stride + 1, stride][corner]
            }
        }
    }
}

/// Faces gathered into a leaf.
#[derive(Debug)]
pub struct Gathered {
    kind: Kind,
    faces: usize,
    stride: usize,
    shift: u8,
    vertices: [IVec3; VERTICES_MAX],
    count: usize,
    indices: [u8; 4 * TRIANGLES_MAX],
    index_count: usize,
    extinctions: [u16; TRIANGLES_MAX],
    is_opaque: bool,
    radii: [f32; VERTICES_MAX],
}

impl Gathered {
    /// Gathers 1 to [`FACES_MAX`] faces, all flat or all round, or up to [`TRIANGLES_MAX`] triangles of no more than
    /// [`VERTICES_MAX`] vertices. `shift` is that of the faces' geometry.
    pub fn of(faces: &[Face], shift: u8) -> Self {
        let kind = match () {
            () if faces[0].is_round() => Kind::Round,
            () if faces.iter().all(|face| face.arity == 3) => Kind::Triangles,
            () => Kind::Quads,
        };
        let faces_max = if kind == Kind::Triangles { TRIANGLES_MAX } else { FACES_MAX };
        debug_assert!((1..=faces_max).contains(&faces.len()));
        let mut gathered = Self {
            kind,
            faces: faces.len(),
            stride: 0,
            shift,
            vertices: [IVec3::ZERO; VERTICES_MAX],
            count: 0,
            indices: [0; 4 * TRIANGLES_MAX],
            index_count: 0,
            extinctions: [OPAQUE; TRIANGLES_MAX],
            is_opaque: true,
            radii: [0.0; VERTICES_MAX],
        };
        if !gathered.take_rows(faces) {
            gathered.take_corners(faces);
        }
        for (extinction, face) in gathered.extinctions.iter_mut().zip(faces) {
            *extinction = face.extinction;
            gathered.is_opaque &= face.extinction == OPAQUE;
        }
        gathered
    }

    /// What the leaf holds.
    pub fn contents(&self) -> Contents<'_> {
        Contents {
            kind: self.kind,
            faces: self.faces,
            stride: self.stride,
            shift: self.shift,
            vertices: &self.vertices[..self.count],
            indices: &self.indices[..self.index_count],
            extinctions: if self.is_opaque { &[] } else { &self.extinctions[..self.faces] },
            radii: if self.kind == Kind::Round { &self.radii[..self.count] } else { &[] },
        }
    }

    /// Numbers the distinct vertices.
    fn take_corners(&mut self, faces: &[Face]) {
        let corners = self.kind.corners();
        let (mut count, is_round) = (0, self.kind == Kind::Round);
        for (f, face) in faces.iter().enumerate() {
            debug_assert_eq!(face.is_round(), is_round);
            for corner in 0..corners {
                let used = corner.min(usize::from(face.arity) - 1);
                let radius = if is_round { face.radii[used] } else { 0.0 };
                let vertex = face.vertices[used];
                let is_known = |&i: &usize| self.vertices[i] == vertex && self.radii[i] == radius;
                let index = (0..count).find(is_known).unwrap_or_else(|| {
                    (self.vertices[count], self.radii[count]) = (vertex, radius);
                    count += 1;
                    count - 1
                });
                self.indices[corner * self.faces + f] = index as u8;
            }
        }
        (self.count, self.index_count) = (count, corners * self.faces);
    }

    /// Numbers the vertices in rows, all of the same length, if the faces are quads that lie so, in one block or in several.
    /// Leaves everything as it is if they do not.
    fn take_rows(&mut self, faces: &[Face]) -> bool {
        if self.kind != Kind::Quads || faces.iter().any(|face| face.arity != 4) {
            return false;
        }
        let follows = |pair: &[Face]| {
            pair[1].vertices[0] == pair[0].vertices[1] && pair[1].vertices[3] == pair[0].vertices[2]
        };
        let stride = 2 + faces.windows(2).take_while(|pair| follows(pair)).count();
        let vertices_max = (ROW_VERTICES_MAX * faces.len() / 2).min(VERTICES_MAX);
        let steps = [0, 1, stride + 1, stride];
        let (mut vertices, mut known) = ([IVec3::ZERO; VERTICES_MAX], 0_u32);
        let (mut last, mut row, mut end) = (0, 0, 0);
        for (f, face) in faces.iter().enumerate() {
            let fits = |first: usize| {
                known >> first & 1 != 0
                    && first + stride + 1 < vertices_max
                    && steps.iter().zip(&face.vertices).all(|(step, vertex)| {
                        known >> (first + step) & 1 == 0 || vertices[first + step] == *vertex
                    })
            };
            // Beside the last face, below its row, or the first of another block
            let first = if f > 0 && fits(last + 1) {
                last + 1
            } else {
                row = if f > 0 && fits(row + stride) { row + stride } else { end };
                row
            };
            if first + stride + 1 >= vertices_max {
                return false;
            }
            for (step, vertex) in steps.iter().zip(&face.vertices) {
                vertices[first + step] = *vertex;
                known |= 1 << (first + step);
            }
            self.indices[f] = first as u8;
            (last, end) = (first, end.max(first + stride + 2));
        }
        if known.count_ones() as usize != end {
            return false;
        }
        (self.vertices, self.count, self.index_count, self.stride) = (vertices, end, faces.len(), stride);
        true
    }
}
