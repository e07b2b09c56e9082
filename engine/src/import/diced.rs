//! Meshes diced on their way into microgrids.
//!
//! Faces are diced in chunks that lie close together, several at once, and written in order. All vertices are rounded to one
//! step for the whole mesh, so that chunks agree where they meet.

use glam::DVec3;
use rayon::prelude::*;

use super::columns::Columns;
use super::emit::{self, Emitter, Placement};
use super::mesh::{Mesh, is_usable};
use super::{ImportReport, cut};
use crate::dice::cage::{Cage, Prepared};
use crate::dice::polygons::Polygons;
use crate::dice::{Rate, Seams};
use crate::{Error, ErrorKind, Result};

/// Faces that a chunk becomes at most, unless one of its faces alone becomes more: some 30 MB.
const CHUNK_MAX: u64 = 1 << 17;

/// Faces that a mesh may become.
const FACES_MAX: u64 = 4_000_000_000;

/// Corners of a cage's face at most.
const CORNERS_MAX: usize = 1024;

/// What a mesh is to be diced as: its faces, linearly, or the surface that they stand for.
enum Surface<'a> {
    Polygons(Polygons),
    CatmullClark(Prepared<'a>),
}

/// Writes a copy of a mesh, diced by a rate. Positions are rounded to a step: that of the mesh, if none is given. The mesh is not
/// finished if it has a surface.
pub(super) fn emit(
    emitter: &mut Emitter<'_>,
    mut mesh: Mesh,
    placement: &Placement,
    (rate, step): (&Rate, Option<f64>),
    (first_id, radius): (u32, f32),
    report: &mut ImportReport,
) -> Result<()> {
    place(&mut mesh, placement);
    let thin = take_thin(&mut mesh, report)?;
    if !thin.faces.is_empty() {
        emitter.emit(&thin, &cut::cut(&thin), &Placement::HERE, (first_id, radius), report)?;
    }
    let columns = Columns::of(&mesh);
    let cage = match mesh.subdivision.is_some() {
        true => Some(cage(&mut mesh, &columns, report)),
        false => {
            mesh.finish(report)?;
            None
        }
    };
    let surface = match &cage {
        Some(cage) => Surface::CatmullClark(cage.prepare(rate)),
        None => Surface::Polygons(polygons(&mesh, &columns)),
    };
    let chunks = chunks(&mesh, &surface, rate)?;
    let falls_short = |face: &u32| match &surface {
        Surface::Polygons(polygons) => polygons.falls_short(*face, rate),
        Surface::CatmullClark(prepared) => prepared.falls_short(*face),
    };
    let short = chunks.iter().flatten().filter(|face| falls_short(face)).count();
    report.skip("finer parts of faces that have 256 along an edge and would need more", short as u64);
    let own_step = || emit::power_of_two(emit::resolution(mesh.bounds().size().max_element()));
    let step = step.unwrap_or_else(own_step);
    for batch in chunks.chunks(2 * rayon::current_num_threads()) {
        let diced: Vec<Mesh> = (batch.par_iter())
            .map(|faces| {
                let diced = match &surface {
                    Surface::Polygons(polygons) => polygons.dice(faces, rate),
                    Surface::CatmullClark(prepared) => prepared.dice(faces),
                };
                columns.mesh(&mesh, diced, step)
            })
            .collect();
        for mut part in diced {
            let mut own = ImportReport::default();
            part.finish(&mut own)?;
            own.skipped.iter().for_each(|(reason, count)| report.skip(reason, *count));
            let clusters = cut::cut(&part);
            emitter.emit(&part, &clusters, &Placement::HERE, (first_id, radius), report)?;
        }
    }
    Ok(())
}

/// Brings a mesh to where a copy stands.
fn place(mesh: &mut Mesh, placement: &Placement) {
    mesh.positions.iter_mut().for_each(|position| *position = placement.point(*position));
    mesh.normals.iter_mut().for_each(|normal| *normal = placement.normal(*normal));
    mesh.radii.iter_mut().for_each(|radius| *radius *= placement.scale as f32);
    mesh.single_precision = false;
    if !placement.is_identity() {
        // Where space is stretched, faces weigh differently
        mesh.smooth.clear();
    }
    if placement.mirrored {
        for face in &mesh.faces {
            let range = face.start as usize + 1..(face.start + face.arity) as usize;
            mesh.corners[range.clone()].reverse();
            for parallel in [&mut mesh.corner_normals, &mut mesh.corner_variants] {
                if !parallel.is_empty() {
                    parallel[range.clone()].reverse();
                }
            }
        }
    }
}

/// Takes points and lines out of a mesh: these stay as they are.
fn take_thin(mesh: &mut Mesh, report: &mut ImportReport) -> Result<Mesh> {
    if mesh.faces.iter().all(|face| face.arity > 2) {
        return Ok(Mesh::default());
    }
    let mut thin = mesh.clone();
    thin.faces.retain(|face| face.arity < 3);
    mesh.faces.retain(|face| face.arity > 2);
    thin.finish(report)?;
    Ok(thin)
}

/// The faces of a mesh as a cage, holes among them; those that cannot be one are dropped and counted.
fn cage(mesh: &mut Mesh, columns: &Columns, report: &mut ImportReport) -> Cage {
    let mut seen = std::collections::HashSet::new();
    let positions = &mesh.positions;
    let mut is_good = |corners: &[u32]| {
        seen.clear();
        corners.len() <= CORNERS_MAX
            && corners.iter().all(|&corner| is_usable(positions[corner as usize]) && seen.insert(corner))
    };
    let subdivision = mesh.subdivision.as_ref().expect("a mesh with a surface");
    let faces = std::mem::take(&mut mesh.faces);
    let (mut bad, mut kept) = (0, Vec::with_capacity(faces.len()));
    for face in faces {
        let corners = face.start as usize..(face.start + face.arity) as usize;
        if is_good(&mesh.corners[corners]) { kept.push(face) } else { bad += u64::from(!face.hole) }
    }
    report.skip("faces of subdivision surfaces with a repeated or impossible point, or too many", bad);
    let seams = subdivision.seams;
    mesh.faces = kept;
    let mut cage = Cage {
        positions: mesh.positions.clone(),
        smooth_width: columns.smooth.iter().map(|column| column.components).sum(),
        creases: subdivision.creases.clone(),
        sharp_points: subdivision.sharp_points.clone(),
        sharp_corners: subdivision.sharp_corners,
        ..Cage::default()
    };
    for face in &mesh.faces {
        cage.corners.extend_from_slice(mesh.face_corners(face));
        cage.ends.push(cage.corners.len() as u32);
    }
    let corners =
        || mesh.faces.iter().flat_map(|face| face.start as usize..(face.start + face.arity) as usize);
    if seams == Seams::Linear {
        cage.linear_width = columns.linear.iter().map(|column| column.components).sum();
        corners().for_each(|corner| {
            columns.linear.iter().for_each(|own| own.push(mesh, corner, &mut cage.linear))
        });
    } else {
        for column in &columns.linear {
            let mut values = Vec::new();
            corners().for_each(|corner| column.push(mesh, corner, &mut values));
            cage.add_skin(&values, column.components, seams);
        }
    }
    for position in 0..mesh.positions.len() {
        columns.smooth.iter().for_each(|column| column.push_at(mesh, position, None, &mut cage.smooth));
    }
    cage
}

/// The faces of a finished mesh as polygons.
fn polygons(mesh: &Mesh, columns: &Columns) -> Polygons {
    let all = || columns.smooth.iter().chain(&columns.linear);
    let width = all().map(|column| column.components).sum();
    let mut polygons = Polygons { positions: mesh.positions.clone(), width, ..Polygons::default() };
    for face in &mesh.faces {
        polygons.corners.extend_from_slice(mesh.face_corners(face));
        polygons.ends.push(polygons.corners.len() as u32);
        for corner in face.start as usize..(face.start + face.arity) as usize {
            polygons.normals.push(emit::corner_normal(mesh, face, corner, &Placement::HERE));
            all().for_each(|column| column.push(mesh, corner, &mut polygons.values));
        }
    }
    polygons
}

/// Faces in chunks, along a Morton curve through the mesh's box.
fn chunks(mesh: &Mesh, surface: &Surface<'_>, rate: &Rate) -> Result<Vec<Vec<u32>>> {
    let bounds = mesh.bounds();
    let scale = 1_048_575.0 / bounds.size().max_element().max(f64::MIN_POSITIVE);
    let spread = |x: f64| (0..20).fold(0_u64, |sum, bit| sum | ((x as u64) >> bit & 1) << (3 * bit));
    let mut order: Vec<(u64, u32, u64)> = (0..mesh.faces.len() as u32)
        .into_par_iter()
        .filter(|&face| !mesh.faces[face as usize].hole)
        .map(|face| {
            let (center, count) = match surface {
                Surface::Polygons(polygons) => (polygons.center(face), polygons.estimate(face, rate)),
                Surface::CatmullClark(prepared) => (prepared.center(face), prepared.estimate(face)),
            };
            let p = (center - bounds.min) * scale;
            (spread(p.x) | spread(p.y) << 1 | spread(p.z) << 2, face, count)
        })
        .collect();
    order.sort_unstable();
    let total = order.iter().fold(0_u64, |sum, (_, _, count)| sum.saturating_add(*count));
    if total > FACES_MAX {
        let message =
            format!("dicing would make about {total} faces of one mesh, at most {FACES_MAX} are made");
        return Err(Error::new(ErrorKind::Limit, message).hint("dice less finely"));
    }
    let (mut chunks, mut chunk, mut sum) = (Vec::new(), Vec::new(), 0);
    for (_, face, count) in order {
        if sum > 0 && sum + count > CHUNK_MAX {
            chunks.push(std::mem::take(&mut chunk));
            sum = 0;
        }
        chunk.push(face);
        sum += count;
    }
    chunks.push(chunk);
    Ok(chunks)
}

/// A rate for a prototype: that of the copy that needs the finest, in the prototype's own units, near `center`.
pub(super) fn prototype_rate(rate: &Rate, copies: &mut super::Copies, center: DVec3) -> Result<Rate> {
    use crate::stream::adapt::MatrixSource;
    let mut finest = f64::INFINITY;
    copies.rewind()?;
    while let Some(matrix) = copies.next()? {
        let axes = [matrix.x_axis, matrix.y_axis, matrix.z_axis].map(|axis| axis.truncate().length());
        let scale = axes.into_iter().fold(0.0, f64::max).max(f64::MIN_POSITIVE);
        finest = finest.min(rate.edge_at(matrix.transform_point3(center)) / scale);
    }
    copies.rewind()?;
    Rate::world(finest)
}
