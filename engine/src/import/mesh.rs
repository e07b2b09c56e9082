//! An indexed mesh in memory, as every format leaves it for the cutter.

use std::collections::HashMap;

use glam::{DVec3, Vec3};

use super::{ImportReport, polygon};
use crate::{Error, ErrorKind, Result};

/// No normal was given for a corner.
pub(super) const NO_NORMAL: u32 = u32::MAX;

/// Coordinates beyond this are treated as if they were not finite: their differences would leave single precision.
pub(super) const COORDINATE_MAX: f64 = 1e30;

/// A face: a run of corners and what is the same for all of them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Face {
    /// Its first corner.
    pub start: u32,
    /// Its corners; at most four once the mesh is finished.
    pub arity: u32,
    /// Its colour: an index into the palette.
    pub material: u32,
    /// The object it belongs to, from 0 without gaps.
    pub object: u32,
    /// Its opacity, 255 is opaque.
    pub opacity: u8,
    /// Whether it shapes the surface of a cage and is no part of it.
    pub hole: bool,
}

/// Positions, faces over them, and what vertices carry.
#[derive(Clone, Debug, Default)]
pub(super) struct Mesh {
    /// Vertex positions, in the file's own space.
    pub positions: Vec<DVec3>,
    /// Normals as the file has them; one per position unless `corner_normals` says otherwise.
    pub normals: Vec<Vec3>,
    /// Per corner an index into `normals` or [`NO_NORMAL`]; empty when normals are indexed like positions.
    pub corner_normals: Vec<u32>,
    /// Linear albedo per position; empty when faces have it from the palette, or there is none.
    pub colors: Vec<[u8; 3]>,
    /// Opacity per position, which goes before that of faces; may be empty.
    pub opacities: Vec<u8>,
    /// Radius per position; may be empty.
    pub radii: Vec<f32>,
    /// Per corner the row of what differs between the corners of a position; empty when nothing does.
    pub corner_variants: Vec<u32>,
    /// Linear albedo per variant, which goes before that of positions; may be empty.
    pub variant_colors: Vec<[u8; 3]>,
    /// Opacity per variant, which goes before that of positions; may be empty.
    pub variant_opacities: Vec<u8>,
    /// Values of the stream's further attributes, in their order; may be empty.
    pub extras: Vec<Extra>,
    /// Per position its number in the file; empty when that is its index.
    pub point_numbers: Vec<u32>,
    /// Position indices of all faces.
    pub corners: Vec<u32>,
    /// The faces.
    pub faces: Vec<Face>,
    /// Linear albedo of materials.
    pub palette: Vec<[u8; 3]>,
    /// Area-weighted normal per position, from [`finish`](Self::finish) unless it is there already; empty when no corner needs one.
    pub smooth: Vec<Vec3>,
    /// The surface that the faces stand for, if not for themselves; only dicing heeds it.
    pub subdivision: Option<Subdivision>,
    /// Whether every position is exactly a single precision number.
    pub single_precision: bool,
}

/// A Catmull-Clark surface's own parameters.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Subdivision {
    /// Sharp edges by their ends, the lower first.
    pub creases: HashMap<[u32; 2], f32>,
    /// Sharp points.
    pub sharp_points: HashMap<u32, f32>,
    /// Whether points of one face alone are sharp.
    pub sharp_corners: bool,
    /// How what differs between the corners of a position follows the surface.
    pub seams: crate::dice::Seams,
}

/// Values of an attribute that the engine hands on without reading it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Extra {
    /// Numbers of a value.
    pub components: usize,
    /// What a value belongs to.
    pub rate: ExtraRate,
    /// The values, one after the other. Where one is missing, it is zero.
    pub values: Vec<f32>,
}

/// What each value of an [`Extra`] belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum ExtraRate {
    /// The mesh.
    #[default]
    Constant,
    /// A position.
    Position,
    /// A variant, see [`Mesh::corner_variants`].
    Variant,
}

impl Extra {
    /// The value at a corner of the given position and variant.
    pub fn at(&self, position: usize, variant: Option<u32>) -> Option<&[f32]> {
        let row = match self.rate {
            ExtraRate::Constant => 0,
            ExtraRate::Position => position,
            ExtraRate::Variant => variant? as usize,
        };
        let value = self.values.get(row * self.components..(row + 1) * self.components)?;
        (!value.is_empty()).then_some(value)
    }
}

impl Mesh {
    /// Bytes that a mesh of these counts takes at its peak: positions, normals of both kinds and the sums they are
    /// made of, attributes; corners with normal indices; faces, the cutter's items and its clusters.
    pub fn bytes(vertices: u64, corners: u64, faces: u64) -> u64 {
        let per_vertex = vertices.saturating_mul(24 + 12 + 12 + 24 + 4 + 8);
        per_vertex.saturating_add(corners.saturating_mul(8)).saturating_add(faces.saturating_mul(20 + 16 + 5))
    }

    /// Adds a face of the given positions, and counts it by its corners.
    pub fn push_face(&mut self, face: Face, corners: &[u32], report: &mut ImportReport) -> Result<()> {
        let start = u32::try_from(self.corners.len())
            .ok()
            .filter(|start| start.checked_add(corners.len() as u32).is_some())
            .ok_or_else(|| {
                Error::new(ErrorKind::Limit, "a mesh of more than 4,294,967,295 face corners")
                    .hint("cut the file into parts")
            })?;
        let source = &mut report.source;
        match corners.len() {
            0 => return Ok(()),
            1 => source.points += 1,
            2 => source.lines += 1,
            3 => source.triangles += 1,
            4 => source.quads += 1,
            _ => source.ngons += 1,
        }
        self.corners.extend_from_slice(corners);
        self.faces.push(Face { start, arity: corners.len() as u32, ..face });
        Ok(())
    }

    /// The position indices of a face.
    pub fn face_corners(&self, face: &Face) -> &[u32] {
        &self.corners[face.start as usize..(face.start + face.arity) as usize]
    }

    /// The index of a corner's normal in `normals`, or [`NO_NORMAL`].
    pub fn normal_index(&self, corner: usize) -> u32 {
        match self.corner_normals.get(corner) {
            Some(&normal) => normal,
            None if self.normals.is_empty() => NO_NORMAL,
            None => self.corners[corner],
        }
    }

    /// The variant of a corner, if corners have any.
    pub fn variant(&self, corner: usize) -> Option<u32> {
        self.corner_variants.get(corner).copied()
    }

    /// Whether vertices have normals: those of the file, or those of faces that have an area.
    pub fn has_normals(&self) -> bool {
        !self.normals.is_empty() || self.faces.iter().any(|face| face.arity > 2)
    }

    /// Whether there are points or lines.
    pub fn has_radii(&self) -> bool {
        self.faces.iter().any(|face| face.arity < 3)
    }

    /// Whether any vertex lets light through.
    pub fn has_opacity(&self) -> bool {
        self.opacities.iter().chain(&self.variant_opacities).any(|&opacity| opacity < 255)
            || self.faces.iter().any(|face| face.opacity < 255)
    }

    /// Takes out the faces that are holes.
    pub fn open_holes(&mut self) {
        self.faces.retain(|face| !face.hole);
    }

    /// Makes faces usable, and computes the normals that are missing. Indices must be in range.
    pub fn finish(&mut self, report: &mut ImportReport) -> Result<()> {
        self.keep_usable(report)?;
        let without = |face: &Face| {
            face.arity > 2
                && (face.start..face.start + face.arity).any(|c| self.normal_index(c as usize) == NO_NORMAL)
        };
        if self.smooth.is_empty() && self.faces.iter().any(without) {
            self.compute_normals();
        }
        Ok(())
    }

    /// Drops faces that cannot be used, turns polygons of more than four corners into triangles, and turns quads whose
    /// diagonal v0-v2 lies outside.
    pub fn keep_usable(&mut self, report: &mut ImportReport) -> Result<()> {
        let faces = std::mem::take(&mut self.faces);
        let mut kept = Vec::with_capacity(faces.len());
        let mut scratch = polygon::Scratch::default();
        for mut face in faces {
            match self.check(&mut face) {
                Err(reason) => report.skip(reason, 1),
                Ok(()) if face.arity > 4 => self.triangulate(&face, &mut kept, &mut scratch, report)?,
                Ok(()) => kept.push(face),
            }
        }
        self.faces = kept;
        Ok(())
    }

    /// Parts quads along their diagonal v0-v2.
    pub fn split_quads(&mut self) {
        for face in std::mem::take(&mut self.faces) {
            if face.arity != 4 {
                self.faces.push(face);
                continue;
            }
            for order in [[0, 1, 2], [0, 2, 3]] {
                let start = self.corners.len() as u32;
                let sources = order.map(|i| face.start as usize + i);
                for parallel in [&mut self.corners, &mut self.corner_normals, &mut self.corner_variants] {
                    if !parallel.is_empty() {
                        parallel.extend(sources.map(|source| parallel[source]));
                    }
                }
                self.faces.push(Face { start, arity: 3, ..face });
            }
        }
    }

    /// Says why a face cannot be used; a quad may become a triangle, or start at another corner.
    fn check(&mut self, face: &mut Face) -> Result<(), &'static str> {
        let mut points = [DVec3::ZERO; 4];
        let corners = self.face_corners(face);
        if !corners.iter().all(|&c| is_usable(self.positions[c as usize])) {
            return Err("faces with a position that is not finite");
        }
        for (point, &corner) in points.iter_mut().zip(corners) {
            *point = self.positions[corner as usize];
        }
        let degenerate = match face.arity {
            0 => true,
            1 => false,
            2 => points[0] == points[1],
            3 => polygon::area_normal(&points[..3]) == DVec3::ZERO,
            4 => return self.check_quad(face, &points),
            _ => false,
        };
        if degenerate { Err(DEGENERATE) } else { Ok(()) }
    }

    fn check_quad(&mut self, face: &mut Face, points: &[DVec3; 4]) -> Result<(), &'static str> {
        let start = face.start as usize;
        if let Some(twin) = (0..4).find(|&i| points[i] == points[(i + 1) % 4]) {
            self.rotate_face(start, 4, (twin + 1) % 4);
            face.arity = 3;
            return self.check(face);
        }
        match polygon::quad_diagonal(points) {
            None => return Err(DEGENERATE),
            Some(0) => {}
            Some(first) => self.rotate_face(start, 4, first),
        }
        Ok(())
    }

    /// Makes corner `first` of a face its first one.
    fn rotate_face(&mut self, start: usize, arity: usize, first: usize) {
        self.corners[start..start + arity].rotate_left(first);
        for parallel in [&mut self.corner_normals, &mut self.corner_variants] {
            if !parallel.is_empty() {
                parallel[start..start + arity].rotate_left(first);
            }
        }
    }

    /// Appends a polygon's triangles.
    fn triangulate(
        &mut self,
        face: &Face,
        kept: &mut Vec<Face>,
        scratch: &mut polygon::Scratch,
        report: &mut ImportReport,
    ) -> Result<()> {
        let start = face.start as usize;
        let corners = self.corners[start..start + face.arity as usize].to_vec();
        let points: Vec<DVec3> = corners.iter().map(|&c| self.positions[c as usize]).collect();
        if !polygon::triangulate(&points, scratch) {
            report.skip("concave polygons of too many corners", 1);
            return Ok(());
        }
        for triangle in &scratch.triangles {
            let new_start = u32::try_from(self.corners.len())
                .ok()
                .filter(|&start| start < u32::MAX - 3)
                .ok_or_else(|| Error::new(ErrorKind::Limit, "a mesh of too many face corners"))?;
            let [a, b, c] = triangle.map(|i| points[i as usize]);
            if polygon::area_normal(&[a, b, c]) == DVec3::ZERO {
                report.skip("triangles of no area in polygons", 1);
                continue;
            }
            for &i in triangle {
                self.corners.push(corners[i as usize]);
                for parallel in [&mut self.corner_normals, &mut self.corner_variants] {
                    if !parallel.is_empty() {
                        parallel.push(parallel[start + i as usize]);
                    }
                }
            }
            kept.push(Face { start: new_start, arity: 3, ..*face });
        }
        Ok(())
    }

    /// Area-weighted normal of every position that a face with an area uses.
    fn compute_normals(&mut self) {
        let mut sums = vec![DVec3::ZERO; self.positions.len()];
        for face in self.faces.iter().filter(|face| face.arity > 2) {
            let corners = self.face_corners(face);
            let mut points = [DVec3::ZERO; 4];
            for (point, &corner) in points.iter_mut().zip(corners) {
                *point = self.positions[corner as usize];
            }
            let normal = polygon::area_normal(&points[..corners.len()]);
            corners.iter().for_each(|&corner| sums[corner as usize] += normal);
        }
        self.smooth = sums.into_iter().map(|sum| sum.normalize_or_zero().as_vec3()).collect();
    }

    /// The box of the positions that faces use.
    pub fn bounds(&self) -> crate::math::Bounds {
        let mut bounds = crate::math::Bounds::EMPTY;
        for face in &self.faces {
            self.face_corners(face).iter().for_each(|&c| bounds.add(self.positions[c as usize]));
        }
        bounds
    }
}

const DEGENERATE: &str = "degenerate faces (a repeated vertex or no area)";

/// Whether a position can be stored.
pub(super) fn is_usable(position: DVec3) -> bool {
    position.abs().cmple(DVec3::splat(COORDINATE_MAX)).all()
}

#[cfg(test)]
mod tests {
    use super::*;

    const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

    fn mesh(positions: &[[f64; 3]], faces: &[&[u32]]) -> (Mesh, ImportReport) {
        let mut report = ImportReport::default();
        let mut mesh = Mesh { positions: positions.iter().map(|&p| p.into()).collect(), ..Mesh::default() };
        for face in faces {
            mesh.push_face(FACE, face, &mut report).unwrap();
        }
        mesh.finish(&mut report).unwrap();
        (mesh, report)
    }

    const CORNERS: [[f64; 3]; 6] = [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [1.0, 1.0, 0.0],
        [0.0, 1.0, 0.0],
        [f64::NAN, 0.0, 0.0],
        [2.0, 0.0, 0.0],
    ];

    /// Catches a broken face that slips through, or a good one that is lost with it.
    #[test]
    fn unusable_faces_are_dropped_and_counted() {
        let faces: [&[u32]; 7] =
            [&[0, 1, 2, 3], &[0, 1, 4], &[0, 1, 1], &[0, 1, 5], &[0, 0], &[2], &[0, 1, 2, 2]];
        let (mesh, report) = mesh(&CORNERS, &faces);
        let arities: Vec<u32> = mesh.faces.iter().map(|face| face.arity).collect();
        assert_eq!(arities, [4, 1, 3]);
        assert_eq!(mesh.face_corners(&mesh.faces[2]), [2, 0, 1]);
        assert_eq!(report.skipped.iter().map(|s| s.1).collect::<Vec<_>>(), [1, 3]);
    }

    /// Catches normals that are not weighted by area, or not of unit length.
    #[test]
    fn missing_normals_are_area_weighted() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 3.0]];
        let (mesh, _) = mesh(&positions, &[&[0, 1, 2], &[0, 3, 1]]);
        let expected = Vec3::new(0.0, 3.0, 1.0).normalize();
        assert!((mesh.smooth[0] - expected).length() < 1e-6, "{}", mesh.smooth[0]);
    }
}
