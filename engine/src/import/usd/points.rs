//! Points prims: particles with their widths.

use super::dress::{Elements, dress};
use super::polygons::{need_memory, normals, plain, primvar_named};
use super::primvar::{self, Interpolation, Values};
use super::read::{Geometry, Stage};
use super::value;
use super::walk::Prim;
use crate::Result;
use crate::import::mesh::Face;
use crate::stream::Attribute;

const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

/// Reads points.
pub(super) fn read(stage: &Stage, prim: &Prim, attributes: &[Attribute]) -> Result<Geometry> {
    let path = prim.path.as_str();
    let mut geometry = Geometry::default();
    let Geometry { mesh, report, .. } = &mut geometry;
    let points = stage.value(path, "points");
    mesh.single_precision = matches!(points, Some(openusd::sdf::Value::Vec3fVec(_)));
    if let Some(points) = points {
        mesh.positions =
            value::vectors(&points).ok_or_else(|| stage.broken(path, "`points` is no array of vectors"))?;
    }
    let count = mesh.positions.len();
    report.source.vertices = count as u64;
    need_memory(stage, path, count, count, count, attributes)?;
    for point in 0..count as u32 {
        mesh.push_face(FACE, &[point], report)?;
    }
    let per_point = |values: &Values| match values.interpolation {
        Interpolation::Constant => Some(values.expand(1).repeat(count)),
        _ => (values.len() >= count).then(|| values.expand(count)),
    };
    if let Some(widths) = widths(stage, prim) {
        match per_point(&widths) {
            Some(widths) => mesh.radii = widths.iter().map(|width| 0.5 * width).collect(),
            None => report.skip("widths without a value for every point", 1),
        }
    }
    if let Some(normals) = normals(stage, prim).as_ref().and_then(per_point) {
        mesh.normals = normals.chunks_exact(3).map(glam::Vec3::from_slice).collect();
    }
    let elements = Elements { faces: 1, points: count, corners: count, corner_sources: &[] };
    // A value for the whole is a constant, and one for each corner one for each point
    let resample = |mut values: Values| {
        values.interpolation = match values.interpolation {
            Interpolation::Uniform => Interpolation::Constant,
            Interpolation::FaceVarying => Interpolation::Vertex,
            other => other,
        };
        Some(values)
    };
    dress(stage, prim, attributes, &elements, &resample, mesh, report);
    Ok(geometry)
}

/// The widths that a prim has written, which are diameters.
pub(super) fn widths(stage: &Stage, prim: &Prim) -> Option<Values> {
    let found = primvar_named(prim, "widths").and_then(|primvar| primvar::read(stage, primvar));
    found.or_else(|| plain(stage, &prim.path, "widths", 1))
}
