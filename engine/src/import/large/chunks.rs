//! Faces sorted by place: chunks that fit in memory, each a mesh of its own that agrees with its neighbours.
//!
//! Chunks are runs of cells of a grid along a Morton curve. Vertices that chunks share get the same normal, which is summed
//! over all faces, and the same position, rounded to one step for all.

use std::path::Path;

use glam::{DVec3, Vec3};

use super::records::{self, NONE, Records, Scatter, Vertex};
use super::spill::{Traits, renumber};
use crate::Result;
use crate::import::emit::{Carried, Emitter, Placement, power_of_two, resolution};
use crate::import::mesh::{Face, Mesh, NO_NORMAL};
use crate::import::{GridSink, ImportOptions, ImportReport, cut, diced, radius};
use crate::math::Bounds;

/// Bits of a cell's number along an axis.
const CELL_BITS: u32 = 6;

/// Chunks that are looked at to find a radius.
const SAMPLES_MAX: usize = 8;

/// A mesh on disk, but for its faces.
pub(super) struct Parts {
    pub vertices: Records<Vertex>,
    pub normals: Records<[f32; 3]>,
    /// Normals of positions, where corners without one need them.
    pub smooth: Option<Records<[f32; 3]>>,
    pub palette: Vec<[u8; 3]>,
    pub traits: Traits,
    pub carried: Carried,
    /// The box of all faces.
    pub bounds: Bounds,
    /// The longest edge of a face's box.
    pub extent_max: f64,
    /// Points and lines among the faces.
    pub thin: [u64; 2],
}

/// A mesh on disk in chunks.
pub(super) struct Sorted {
    parts: Parts,
    faces: Records<records::Face>,
    /// Where each chunk begins, and its faces.
    chunks: Vec<(u64, usize)>,
    /// What positions are rounded to, unless all are single precision numbers.
    step: f64,
}

impl Sorted {
    /// Sorts faces into chunks of so many at most.
    pub fn new(
        folder: &Path,
        faces: Records<records::Face>,
        parts: Parts,
        chunk_faces_max: u64,
    ) -> Result<Self> {
        let cell = |face: &records::Face| cell_of(face.center, &parts.bounds);
        let mut counts = vec![0_u64; 1 << (3 * CELL_BITS)];
        faces.for_each_run(|_, run| (run.iter().for_each(|face| counts[cell(face)] += 1), Ok(())).1)?;

        // Runs of cells along the curve
        let (mut chunk_of, mut sizes, mut size) = (Vec::with_capacity(counts.len()), Vec::new(), 0);
        for count in counts {
            if size > 0 && size + count > chunk_faces_max {
                sizes.push(size);
                size = 0;
            }
            chunk_of.push(sizes.len());
            size += count;
        }
        sizes.push(size);
        let starts = sizes.iter().scan(0, |next, size| Some((*next, *next += size).0));

        // Faces to their chunks
        let sorted = Records::with_room(folder, faces.len())?;
        let mut scatter = Scatter::new(&sorted, starts.clone());
        let mut centers = vec![Bounds::EMPTY; sizes.len()];
        faces.for_each_run(|_, run| {
            run.iter().try_for_each(|face| {
                let chunk = chunk_of[cell(face)];
                centers[chunk].add(Vec3::from_array(face.center).as_dvec3());
                scatter.push(chunk, *face)
            })
        })?;
        scatter.finish()?;

        let slices = |(start, size): (u64, &u64)| {
            let end = start + size;
            let first = (start..end).step_by(chunk_faces_max as usize);
            first.map(move |first| (first, chunk_faces_max.min(end - first) as usize)).collect::<Vec<_>>()
        };
        let chunks = starts.zip(&sizes).flat_map(slices).collect();
        let largest = centers.iter().filter(|bounds| !bounds.is_empty());
        let largest = largest.map(|bounds| bounds.size().max_element()).fold(0.0, f64::max);
        let step = power_of_two(resolution(largest + parts.extent_max));
        Ok(Self { parts, faces: sorted, chunks, step })
    }

    /// Writes all chunks.
    pub fn emit(
        &self,
        sink: &mut dyn GridSink,
        options: &ImportOptions,
        report: &mut ImportReport,
    ) -> Result<()> {
        let radius = self.radius(options.meters_per_unit)?;
        if self.parts.carried.radius && !self.parts.traits.radii {
            radius::warn(radius, report);
        }
        let mut emitter = Emitter::new(sink, self.parts.carried.clone(), options)?;
        for &chunk in &self.chunks {
            let mesh = self.load(chunk)?;
            match &options.dice {
                Some(rate) => {
                    let how = (rate, Some(self.step));
                    diced::emit(&mut emitter, mesh, &Placement::HERE, how, (0, radius), report)?;
                }
                None => {
                    let clusters = cut::cut(&mesh);
                    emitter.emit(&mesh, &clusters, &Placement::HERE, (0, radius), report)?;
                }
            }
        }
        Ok(())
    }

    /// The radius of what has none.
    fn radius(&self, meters_per_unit: f64) -> Result<f32> {
        let mut spacings = Vec::new();
        if self.parts.carried.radius && !self.parts.traits.radii {
            let step = self.chunks.len().div_ceil(SAMPLES_MAX).max(1);
            for &chunk in self.chunks.iter().step_by(step) {
                let mesh = self.load(chunk)?;
                spacings.append(&mut radius::spacings(&mesh, &cut::cut(&mesh)));
            }
        }
        let diagonal = self.parts.bounds.size().length();
        Ok(radius::choose(diagonal, self.parts.thin, spacings, meters_per_unit))
    }

    /// A chunk as a finished mesh.
    fn load(&self, (first, count): (u64, usize)) -> Result<Mesh> {
        let Parts { vertices, normals, smooth, palette, traits, .. } = &self.parts;
        let mut records = Vec::new();
        self.faces.read(first, count, &mut records)?;
        let mut mesh = Mesh { palette: palette.clone(), ..Mesh::default() };
        mesh.single_precision = !traits.double_precision;
        let mut given = Vec::new();
        for record in &records {
            let (start, arity) = (mesh.corners.len() as u32, record.arity());
            let records::Face { material, object, opacity, .. } = *record;
            mesh.faces.push(Face {
                start,
                arity: arity as u32,
                material,
                object,
                opacity: opacity as u8,
                hole: false,
            });
            mesh.corners.extend_from_slice(&record.corners[..arity]);
            given.extend_from_slice(&record.normals[..arity]);
        }

        // Vertices of these faces alone
        let numbers = renumber(&mut mesh.corners);
        for vertex in vertices.gather(&numbers)? {
            let position = DVec3::from_array(vertex.position);
            let rounded = (position / self.step).round() * self.step;
            mesh.positions.push(if mesh.single_precision { position } else { rounded });
            mesh.colors.extend(traits.colors.then_some(vertex.color));
            mesh.opacities.extend(traits.opacities.then_some(vertex.opacity));
            mesh.radii.extend(traits.radii.then_some(vertex.radius));
        }
        if let Some(smooth) = smooth {
            mesh.smooth = smooth.gather(&numbers)?.into_iter().map(Vec3::from_array).collect();
        }

        // Their normals; what has none gets one by its position
        let mut known: Vec<u32> = given.iter().copied().filter(|&normal| normal != NONE).collect();
        known.sort_unstable();
        known.dedup();
        let local = |normal: u32| match normal {
            NONE => NO_NORMAL,
            normal => known.partition_point(|&other| other < normal) as u32,
        };
        mesh.corner_normals = given.into_iter().map(local).collect();
        mesh.normals = normals.gather(&known)?.into_iter().map(Vec3::from_array).collect();
        Ok(mesh)
    }
}

/// The cell of a place, along a Morton curve.
fn cell_of(center: [f32; 3], bounds: &Bounds) -> usize {
    let scale = f64::from(1 << CELL_BITS) / bounds.size().max_element().max(f64::MIN_POSITIVE);
    let p = (Vec3::from_array(center).as_dvec3() - bounds.min) * scale;
    let spread = |x: f64| {
        // What is not a number becomes 0
        let x = (x as usize).min((1 << CELL_BITS) - 1);
        (0..CELL_BITS).fold(0, |sum, bit| sum | (x >> bit & 1) << (3 * bit))
    };
    spread(p.x) | spread(p.y) << 1 | spread(p.z) << 2
}
