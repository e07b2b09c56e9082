//! Mesh prims: points, polygons, normals.

use std::collections::{HashMap, HashSet};

use glam::Vec3;

use super::dress::{Elements, dress};
use super::material::{self, Cover};
use super::primvar::{self, Interpolation, Primvar, Values};
use super::read::{Geometry, Stage};
use super::value;
use super::walk::Prim;
use crate::dice::{NO_POINT, SHARP, Seams};
use crate::import::ImportReport;
use crate::import::mesh::{Face, Mesh, NO_NORMAL, Subdivision};
use crate::stream::Attribute;
use crate::{Error, ErrorKind, Result};

const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

/// Reads a mesh.
pub(super) fn read(stage: &Stage, prim: &Prim, attributes: &[Attribute]) -> Result<Geometry> {
    let path = prim.path.as_str();
    let mut geometry = Geometry::default();
    let Geometry { mesh, report, covers } = &mut geometry;
    let points = stage.value(path, "points");
    let counts = stage.integers(path, "faceVertexCounts").unwrap_or_default();
    let indices = stage.integers(path, "faceVertexIndices").unwrap_or_default();
    *covers = material::covers(stage, &prim.materials, report);
    let materials = materials(covers, counts.len());
    mesh.single_precision = matches!(points, Some(openusd::sdf::Value::Vec3fVec(_)));
    if let Some(points) = points {
        mesh.positions =
            value::vectors(&points).ok_or_else(|| stage.broken(path, "`points` is no array of vectors"))?;
    }
    report.source.vertices = mesh.positions.len() as u64;
    check(stage, path, mesh, &counts, &indices, attributes)?;

    // Faces, in the order of their front
    let is_left_handed =
        stage.text(path, "orientation").is_some_and(|orientation| orientation == "leftHanded");
    let holes: HashSet<i64> = stage.integers(path, "holeIndices").unwrap_or_default().into_iter().collect();
    let mut corner_sources = Vec::with_capacity(indices.len());
    let mut corners = Vec::new();
    let (mut next, mut uncounted) = (0_u32, ImportReport::default());
    for (number, &count) in counts.iter().enumerate() {
        let range = next..next + count as u32;
        next = range.end;
        if count < 3 {
            report.skip("faces of fewer than three corners", 1);
            continue;
        }
        corners.clear();
        corners.extend(range);
        if is_left_handed {
            corners[1..].reverse();
        }
        corner_sources.extend(corners.iter().map(|&corner| (number as u32, corner)));
        corners.iter_mut().for_each(|corner| *corner = indices[*corner as usize] as u32);
        let material = materials.get(number).copied().unwrap_or(0);
        let hole = holes.contains(&(number as i64));
        report.skip("faces that are holes", u64::from(hole));
        let report = if hole { &mut uncounted } else { &mut *report };
        mesh.push_face(Face { material, hole, ..FACE }, &corners, report)?;
    }
    let scheme = stage.text(path, "subdivisionScheme").unwrap_or_else(|| "catmullClark".into());
    match scheme.as_str() {
        "catmullClark" => {
            mesh.subdivision = Some(subdivision(stage, path, mesh, report));
        }
        "none" | "bilinear" => {}
        "loop" => report.skip("Loop subdivision surfaces, which are read as their polygons", 1),
        _ => report.skip("meshes of an unknown subdivision scheme, which are read as their polygons", 1),
    }
    let elements = Elements {
        faces: counts.len(),
        points: mesh.positions.len(),
        corners: indices.len(),
        corner_sources: &corner_sources,
    };
    // The normals of a cage are not those of the surface it stands for
    if scheme == "none" || scheme == "bilinear" {
        push_normals(stage, prim, &elements, mesh);
    }
    dress(stage, prim, attributes, &elements, &Some, mesh, report);
    if let Some(&color) = mesh.palette.first() {
        mesh.palette.resize(covers.len() + 1, color);
    }
    Ok(geometry)
}

/// The cover of each of `faces` faces, from 1; empty where there is none.
fn materials(covers: &[Cover], faces: usize) -> Vec<u32> {
    let mut materials = vec![0; if covers.is_empty() { 0 } else { faces }];
    for (cover, number) in covers.iter().zip(1..) {
        match &cover.faces {
            None => materials.fill(number),
            Some(faces) => {
                let faces = faces.iter().filter_map(|&face| usize::try_from(face).ok());
                for face in faces {
                    if let Some(material) = materials.get_mut(face) {
                        *material = number;
                    }
                }
            }
        }
    }
    materials
}

/// The creases and corners of a subdivision surface. What does not fit the mesh is left out and counted.
fn subdivision(stage: &Stage, path: &str, mesh: &Mesh, report: &mut ImportReport) -> Subdivision {
    let integers = |name| stage.integers(path, name).unwrap_or_default();
    let numbers = |name| stage.numbers(path, name).unwrap_or_default();
    let clamp = |sharpness: f64| (sharpness as f32).clamp(0.0, SHARP);
    let boundary = stage.text(path, "interpolateBoundary");
    let mut found = Subdivision {
        sharp_corners: boundary.is_none_or(|boundary| boundary == "edgeAndCorner"),
        seams: seams(stage, path, report),
        ..Subdivision::default()
    };

    // Creases: one sharpness for each, or one for each of its edges
    let (points, lengths) = (integers("creaseIndices"), integers("creaseLengths"));
    let values = numbers("creaseSharpnesses");
    let sides: i64 =
        lengths.iter().map(|length| length.saturating_sub(1).max(0)).fold(0, i64::saturating_add);
    let per_side = values.len() as i64 == sides && values.len() != lengths.len();
    let edges = if lengths.is_empty() { HashSet::new() } else { edges(mesh) };
    let (mut first, mut side, mut lost) = (0_usize, 0, 0);
    for (crease, &length) in lengths.iter().enumerate() {
        let run = usize::try_from(length).ok().and_then(|n| points.get(first..first.checked_add(n)?));
        let Some(run) = run else {
            lost += (lengths.len() - crease) as u64;
            break;
        };
        for ends in run.windows(2) {
            let ends = [ends[0].min(ends[1]), ends[0].max(ends[1])]
                .map(|end| u32::try_from(end).unwrap_or(NO_POINT));
            match values.get(if per_side { side } else { crease }) {
                Some(&sharpness) if edges.contains(&ends) => _ = found.creases.insert(ends, clamp(sharpness)),
                _ => lost += 1,
            }
            side += 1;
        }
        first += run.len();
    }
    report.skip("creases of subdivision surfaces that lie on no edge or have no sharpness", lost);

    // Corners
    let (corners, values) = (integers("cornerIndices"), numbers("cornerSharpnesses"));
    let mut lost = 0;
    for (number, &point) in corners.iter().enumerate() {
        let point = usize::try_from(point).ok().filter(|&point| point < mesh.positions.len());
        match (point, values.get(number)) {
            (Some(point), Some(&sharpness)) => _ = found.sharp_points.insert(point as u32, clamp(sharpness)),
            _ => lost += 1,
        }
    }
    report.skip("sharp corners of subdivision surfaces that are no point or have no sharpness", lost);
    found
}

/// How values of corners follow the surface.
fn seams(stage: &Stage, path: &str, report: &mut ImportReport) -> Seams {
    match stage.text(path, "faceVaryingLinearInterpolation").as_deref() {
        Some("none") => Seams::Smooth,
        Some("cornersOnly") => Seams::Corners,
        Some("cornersPlus1") | None => Seams::Junctions,
        Some("cornersPlus2") => Seams::Darts,
        Some("boundaries") => Seams::Boundaries,
        Some("all") => Seams::Linear,
        Some(_) => {
            report.skip("unknown rules of faceVarying interpolation, read as `cornersPlus1`", 1);
            Seams::Junctions
        }
    }
}

/// The edges of all faces, the lower end first.
fn edges(mesh: &Mesh) -> HashSet<[u32; 2]> {
    let sides = |face: &Face| {
        let corners = mesh.face_corners(face);
        (0..corners.len()).map(|i| [corners[i], corners[(i + 1) % corners.len()]])
    };
    mesh.faces.iter().flat_map(sides).map(|[a, b]| [a.min(b), a.max(b)]).collect()
}

/// Refuses a mesh whose numbers do not fit together, or that needs more memory than allowed.
fn check(
    stage: &Stage,
    path: &str,
    mesh: &Mesh,
    counts: &[i64],
    indices: &[i64],
    attributes: &[Attribute],
) -> Result<()> {
    let points = mesh.positions.len();
    let mut corners = 0_i64;
    for (face, &count) in counts.iter().enumerate() {
        if !(0..=i64::from(u32::MAX)).contains(&count) {
            return Err(stage.broken(path, format!("face {face} has {count} corners")));
        }
        corners += count;
    }
    if corners != indices.len() as i64 {
        let found = indices.len();
        return Err(
            stage.broken(path, format!("`faceVertexIndices` has {found} corners, {corners} expected"))
        );
    }
    if let Some(corner) = indices.iter().position(|&index| !(0..points as i64).contains(&index)) {
        let index = indices[corner];
        return Err(stage.broken(path, format!("corner {corner} is point {index} of {points} points")));
    }
    need_memory(stage, path, points, indices.len(), counts.len(), attributes)?;
    Ok(())
}

/// The bytes that a prim takes; refuses what would not fit.
pub(super) fn need_memory(
    stage: &Stage,
    path: &str,
    points: usize,
    corners: usize,
    faces: usize,
    attributes: &[Attribute],
) -> Result<u64> {
    let values: u64 = attributes.iter().map(|attribute| attribute.value_bytes() as u64).sum();
    let bytes =
        Mesh::bytes(points as u64, corners as u64, faces as u64) + (corners.max(points) as u64) * values;
    if bytes > stage.memory_bytes {
        let (need, have) = (bytes.div_ceil(1 << 20), stage.memory_bytes >> 20);
        let message = format!("prim `{path}` takes {need} MiB, {have} MiB are allowed");
        return Err(Error::new(ErrorKind::Limit, message)
            .at(&stage.path)
            .hint("allow more memory (`--memory`), or cut the prim into parts"));
    }
    Ok(bytes)
}

/// Gives a mesh the normals that are written, where there is one for each element.
fn push_normals(stage: &Stage, prim: &Prim, elements: &Elements<'_>, mesh: &mut Mesh) {
    let Some(found) = normals(stage, prim) else { return };
    let vector = |value: &[f32]| Vec3::from_slice(value);
    let per_corner = |number: &dyn Fn(u32, u32) -> u32| {
        elements.corner_sources.iter().map(|&(face, corner)| number(face, corner)).collect()
    };
    match found.interpolation {
        Interpolation::Vertex | Interpolation::Varying if found.len() >= elements.points => {
            mesh.normals = found.expand(elements.points).chunks_exact(3).map(vector).collect();
        }
        Interpolation::Uniform if found.len() >= elements.faces => {
            mesh.normals = found.expand(elements.faces).chunks_exact(3).map(vector).collect();
            mesh.corner_normals = per_corner(&|face, _| face);
        }
        Interpolation::FaceVarying if found.len() >= elements.corners => {
            // Corners with equal normals share a vertex
            let mut known: HashMap<[u32; 3], u32> = HashMap::new();
            let values = found.expand(elements.corners);
            let mut numbers = Vec::with_capacity(elements.corners);
            for value in values.chunks_exact(3) {
                let next = mesh.normals.len() as u32;
                let number = *known.entry([0, 1, 2].map(|i| value[i].to_bits())).or_insert(next);
                if number == next {
                    mesh.normals.push(vector(value));
                }
                numbers.push(if vector(value) == Vec3::ZERO { NO_NORMAL } else { number });
            }
            mesh.corner_normals = per_corner(&|_, corner| numbers[corner as usize]);
        }
        Interpolation::Constant => {
            mesh.normals = vec![vector(&found.expand(1))];
            mesh.corner_normals = per_corner(&|_, _| 0);
        }
        _ => {}
    }
}

/// The normals that a prim has written: as a primvar, or else as `normals`.
pub(super) fn normals(stage: &Stage, prim: &Prim) -> Option<Values> {
    let primvar = prim.primvars.iter().find(|primvar| primvar.name == "normals" && primvar.components == 3);
    if let Some(found) = primvar.and_then(|primvar| primvar::read(stage, primvar)) {
        return Some(found);
    }
    plain(stage, &prim.path, "normals", 3)
}

/// An attribute with an interpolation that is no primvar: `normals`, `widths`.
pub(super) fn plain(stage: &Stage, path: &str, name: &str, components: usize) -> Option<Values> {
    let values: Vec<f32> = stage.numbers(path, name)?.iter().map(|&x| x as f32).collect();
    let token = stage.field(path, name, "interpolation").and_then(|value| value::text(&value));
    let interpolation = token.and_then(|token| primvar::parse(&token)).unwrap_or(Interpolation::Vertex);
    let fits = !values.is_empty() && values.len().is_multiple_of(components);
    fits.then_some(Values { interpolation, components, values, indices: None })
}

/// Whether a prim has a primvar of this name.
pub(super) fn primvar_named<'a>(prim: &'a Prim, name: &str) -> Option<&'a Primvar> {
    prim.primvars.iter().find(|primvar| primvar.name == name && primvar.components == 1)
}
