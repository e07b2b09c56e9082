//! Meshes as they are read: small ones in memory, large ones through scratch files in chunks that lie close together.
//!
//! What a mesh takes beyond [`MESH_BYTES_MAX`] goes to files beside the output: vertices and normals by number, faces in
//! their order. When all is read, faces are checked, sorted by place, and come back chunk by chunk, each with the vertices
//! that it needs. So the memory taken depends on neither the file nor the limit, and nor does what is made of it.

mod chunks;
mod records;
mod spill;
#[cfg(test)]
mod tests;

use std::path::Path;

use self::spill::Spill;
use super::budget::Budget;
use super::emit::{Carried, Emitter, Placement};
use super::mesh::Mesh;
use super::{Expected, GridSink, ImportOptions, ImportReport, cut, radius};
use crate::Result;

/// Bytes of a mesh that stays in memory, by [`Mesh::bytes`].
const MESH_BYTES_MAX: u64 = 64 << 20;

/// Bytes that a larger one takes while it comes from scratch files: a chunk with its vertices, sums of normals, buffers.
const SPILL_BYTES: u64 = 96 << 20;

/// Faces of a chunk at most: some 40 MB with all that they need.
const CHUNK_FACES_MAX: u64 = 1 << 17;

/// A mesh that is being read.
pub(super) struct Elements<'a> {
    /// What was read and is held in memory. Indices count from the mesh's beginning, wherever that went.
    pub mesh: Mesh,
    spill: Option<Spill>,
    budget: Budget,
    options: &'a ImportOptions,
    /// [`MESH_BYTES_MAX`] and [`CHUNK_FACES_MAX`], but in tests.
    bytes_max: u64,
    chunk_faces_max: u64,
}

impl<'a> Elements<'a> {
    /// An empty mesh for the import of `path`.
    pub fn new(path: &Path, options: &'a ImportOptions) -> Self {
        let budget = Budget::new(options.memory_bytes, path);
        let (bytes_max, chunk_faces_max) = (MESH_BYTES_MAX, CHUNK_FACES_MAX);
        Self { mesh: Mesh::default(), spill: None, budget, options, bytes_max, chunk_faces_max }
    }

    /// Positions so far.
    pub fn positions(&self) -> u64 {
        self.spill.as_ref().map_or(0, Spill::positions) + self.mesh.positions.len() as u64
    }

    /// Normals so far.
    pub fn normals(&self) -> u64 {
        self.spill.as_ref().map_or(0, Spill::normals) + self.mesh.normals.len() as u64
    }

    /// Brings what was read to disk if it takes too much memory. To be called between elements.
    pub fn relieve(&mut self) -> Result<()> {
        let bytes = self.bytes();
        if bytes <= self.bytes_max.min(self.budget.left()) {
            return Ok(());
        }
        self.budget.check(if bytes > self.bytes_max { SPILL_BYTES } else { bytes }, "the mesh")?;
        let spill = match &mut self.spill {
            Some(spill) => spill,
            None => self.spill.insert(Spill::new(&self.options.scratch_folder())?),
        };
        spill.take(&mut self.mesh)
    }

    /// What is held in memory now, cut and written.
    fn bytes(&self) -> u64 {
        let Mesh { positions, normals, corners, faces, .. } = &self.mesh;
        Mesh::bytes((positions.len() + normals.len() / 2) as u64, corners.len() as u64, faces.len() as u64)
    }

    /// Writes the mesh.
    pub fn emit(mut self, sink: &mut dyn GridSink, report: &mut ImportReport) -> Result<()> {
        self.relieve()?;
        let Some(mut spill) = self.spill else {
            sink.expect(&Expected { memory_bytes: self.bytes(), leaves: 0 })?;
            return emit(self.mesh, sink, self.options, report);
        };
        sink.expect(&Expected { memory_bytes: SPILL_BYTES, leaves: 0 })?;
        spill.take(&mut self.mesh)?;
        spill.sort(self.mesh, self.chunk_faces_max, report)?.emit(sink, self.options, report)
    }
}

/// Writes a mesh that is in memory.
fn emit(
    mut mesh: Mesh,
    sink: &mut dyn GridSink,
    options: &ImportOptions,
    report: &mut ImportReport,
) -> Result<()> {
    mesh.finish(report)?;
    let clusters = cut::cut(&mesh);
    let radius = radius::default_radius(&mesh, &clusters, options.meters_per_unit);
    radius::warn_radius(&mesh, radius, report);
    let mut emitter = Emitter::new(sink, Carried::by(&mesh), options)?;
    let rate = options.dice.as_ref();
    emitter.emit_diced(&mesh, &clusters, &Placement::HERE, rate, (0, radius), report)
}
