//! An open block: its columns, how far they are used, and the checks that make slicing them safe.

use std::path::Path;

use glam::{DVec3, Vec3};

use super::block::{self, BlockHeader};
use super::read_le;
use crate::stream::microgrid::FACES_MAX;
use crate::stream::{Microgrid, Rate, Schema};
use crate::{Error, Result};

/// The exponent bits of an f32; all set in infinities and NaNs.
const EXPONENT: u32 = 0x7f80_0000;

/// What a counting pass needs to know of a grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridSummary {
    /// What positions are relative to, in scene units.
    pub anchor: DVec3,
    /// The offset of vertex `vertices / 2` from the anchor.
    pub middle: Vec3,
    /// Vertices, 1 to 256.
    pub vertices: u32,
    /// Faces, at most 1,024.
    pub faces: u32,
}

/// The block that is being read: its decoded columns and how far they are used.
#[derive(Default)]
pub(super) struct Block {
    pub offset: u64,
    pub grids: usize,
    vertices: usize,
    faces: usize,
    corners: usize,
    pub payload_frame: [u32; 2],
    pub payload_checksum: u64,
    pub payload_offset: u64,
    pub has_payload: bool,
    pub summary: Vec<u8>,
    pub payload: Vec<u8>,
    /// Where each attribute's column begins in the payload.
    columns: Vec<usize>,
    pub grid: usize,
    vertex: usize,
    face: usize,
    corner: usize,
}

impl Block {
    /// Whether every grid has been read.
    pub fn is_used_up(&self) -> bool {
        self.grid == self.grids
    }

    /// Steps over the next grid.
    pub fn step_summary(&mut self) -> GridSummary {
        let summary = self.summary_of(self.grid);
        let faces = self.face..self.face + summary.faces as usize;
        if self.has_payload {
            self.corner += corners_of(&self.payload[faces.clone()]);
        }
        self.grid += 1;
        self.vertex += summary.vertices as usize;
        self.face = faces.end;
        summary
    }

    pub fn forget(&mut self) {
        (self.grids, self.vertices, self.faces, self.corners) = (0, 0, 0, 0);
        (self.grid, self.vertex, self.face, self.corner) = (0, 0, 0, 0);
        (self.offset, self.has_payload) = (0, false);
    }

    pub fn begin(&mut self, offset: u64, header: &BlockHeader, summary: Vec<u8>) {
        self.forget();
        self.offset = offset;
        self.grids = header.grids as usize;
        self.vertices = header.vertices as usize;
        self.faces = header.faces as usize;
        self.corners = header.corners as usize;
        self.payload_frame = header.payload_bytes;
        self.payload_checksum = header.payload_checksum;
        self.payload_offset = offset + block::HEADER_BYTES as u64 + u64::from(header.summary_bytes[1]);
        self.summary = summary;
    }

    fn summary_of(&self, grid: usize) -> GridSummary {
        let [middles, vertex_counts, face_counts] = block::summary_columns(self.grids);
        let anchor = std::array::from_fn(|i| read_le!(f64, self.summary, 24 * grid + 8 * i));
        let middle = middles + 12 * grid;
        GridSummary {
            anchor: DVec3::from_array(anchor),
            middle: vec3(self.summary[middle..middle + 12].as_array().expect("12 bytes")),
            vertices: u32::from(self.summary[vertex_counts + grid]) + 1,
            faces: u32::from(read_le!(u16, self.summary, face_counts + 2 * grid)),
        }
    }

    /// Checks what later slicing relies on: the grids' counts add up to the block's.
    pub fn check_summary(&self, path: &Path) -> Result<()> {
        let (mut vertices, mut faces) = (0, 0);
        for grid in 0..self.grids {
            let summary = self.summary_of(grid);
            vertices += summary.vertices as usize;
            faces += summary.faces as usize;
            if summary.faces as usize > FACES_MAX {
                return Err(self.broken(
                    path,
                    grid,
                    &format!("has {} faces, at most {FACES_MAX} are possible", summary.faces),
                ));
            }
            if !summary.anchor.is_finite() || !summary.middle.is_finite() {
                return Err(self.broken(path, grid, "has a position that is not a finite number"));
            }
        }
        if vertices != self.vertices || faces != self.faces {
            return Err(Error::corrupt(path, self.offset, "the counts of a block's grids do not add up"));
        }
        Ok(())
    }

    /// Finds the columns and checks arities and positions of the whole block at once, which vectorises.
    pub fn open_payload(&mut self, schema: &Schema, path: &Path) -> Result<()> {
        let arities = &self.payload[..self.faces];
        let legal = arities.iter().fold(true, |legal, arity| legal & (1..=4).contains(arity));
        if !legal || corners_of(arities) != self.corners {
            return Err(Error::corrupt(path, self.payload_offset, "a block's faces do not add up"));
        }
        let positions = &self.payload[self.positions_at(0)..self.positions_at(self.vertices)];
        let exponents = positions.as_chunks::<4>().0.iter().map(|&x| u32::from_le_bytes(x) & EXPONENT);
        if !exponents.fold(true, |finite, exponent| finite & (exponent != EXPONENT)) {
            return Err(Error::corrupt(path, self.payload_offset, "a position is not a finite number"));
        }
        let mut at = self.positions_at(self.vertices);
        self.columns.clear();
        for attribute in &schema.attributes {
            self.columns.push(at);
            at += attribute.value_bytes()
                * if attribute.rate == Rate::Vertex { self.vertices } else { self.grids };
        }
        self.corner = corners_of(&self.payload[..self.face]);
        self.has_payload = true;
        Ok(())
    }

    /// Where the position of a vertex of the block begins in the payload.
    fn positions_at(&self, vertex: usize) -> usize {
        self.faces + self.corners + 12 * vertex
    }

    /// Copies the next grid out of the columns and checks its indices.
    pub fn read_grid(&mut self, schema: &Schema, grid: &mut Microgrid, path: &Path) -> Result<()> {
        let summary = self.summary_of(self.grid);
        let (vertices, faces) = (summary.vertices as usize, summary.faces as usize);
        let arities = &self.payload[self.face..self.face + faces];
        let corners = corners_of(arities);
        let indices = &self.payload[self.faces + self.corner..][..corners];
        let positions =
            &self.payload[self.positions_at(self.vertex)..self.positions_at(self.vertex + vertices)];
        let highest = indices.iter().fold(0, |highest, &index| index.max(highest));
        if usize::from(highest) >= vertices {
            let what = format!("has {vertices} vertices and a face index {highest}");
            return Err(self.broken(path, self.grid, &what));
        }
        grid.clear(schema.attributes.len());
        grid.anchor = summary.anchor;
        grid.positions.extend(positions.as_chunks::<12>().0.iter().map(vec3));
        if grid.positions[vertices / 2] != summary.middle {
            return Err(self.broken(
                path,
                self.grid,
                "has a middle vertex that is not the one of its summary",
            ));
        }
        grid.arities.extend_from_slice(arities);
        grid.indices.extend_from_slice(indices);
        for ((attribute, &at), column) in schema.attributes.iter().zip(&self.columns).zip(&mut grid.columns) {
            let (first, count) = match attribute.rate {
                Rate::Vertex => (self.vertex, vertices),
                Rate::Grid => (self.grid, 1),
            };
            let bytes = attribute.value_bytes();
            column.extend_from_slice(&self.payload[at + first * bytes..][..count * bytes]);
        }
        self.grid += 1;
        self.vertex += vertices;
        self.face += faces;
        self.corner += corners;
        Ok(())
    }

    /// After its last grid a block must be used up, or its counts lied.
    pub fn check_used_up(&self, path: &Path) -> Result<()> {
        let used = self.vertex == self.vertices && self.face == self.faces;
        if !used || (self.has_payload && self.corner != self.corners) {
            return Err(Error::corrupt(path, self.offset, "the counts of a block's grids do not add up"));
        }
        Ok(())
    }

    fn broken(&self, path: &Path, grid: usize, what: &str) -> Error {
        Error::corrupt(path, self.payload_offset, format!("grid {grid} of a block {what}"))
    }
}

/// The corners of faces of these arities. At most 4,096 in a grid and 8 Mi in a block.
fn corners_of(arities: &[u8]) -> usize {
    arities.iter().map(|&arity| u32::from(arity)).sum::<u32>() as usize
}

fn vec3(bytes: &[u8; 12]) -> Vec3 {
    Vec3::from_array(std::array::from_fn(|i| read_le!(f32, bytes, 4 * i)))
}
