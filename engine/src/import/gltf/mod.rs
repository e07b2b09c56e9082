//! glTF 2.0, as text or binary: node hierarchy, instances, and base colour into `albedo` and `opacity`.
//!
//! The document is read by structures of its own rather than by the `gltf` crate, whose node transforms are single
//! precision, and whose accessors panic where a view is too short.

mod accessor;
mod check;
mod container;
mod document;
mod nodes;
mod primitive;
mod texture;

use std::path::Path;

use self::container::Container;
use self::nodes::Copies;
use super::emit::{Carried, Emitter, Placement};
use super::leaves::texture::AlphaMode;
use super::leaves::{self, Leaves};
use super::mesh::Mesh;
use super::{Expected, GridSink, ImportOptions, ImportReport, cut, radius};
use crate::Result;

/// Imports a glTF or GLB file.
pub(super) fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let mut report = ImportReport::default();
    let mut container = Container::open(path, options.memory_bytes)?;
    let copies = nodes::copies(&mut container, options, &mut report)?;
    let carried = carried(&container, &copies);
    let wanted = primitive::Wanted { albedo: carried.albedo, leaves: Leaves::are_wanted(options) };
    let memory_bytes = primitive::check_memory(&mut container, &copies, wanted)?;
    let mut images = texture::Images::default();
    let leaves = count_leaves(&mut container, &copies, &mut images, wanted, options)?;
    sink.expect(&Expected { memory_bytes, leaves })?;
    let mut emitter = Emitter::new(sink, carried, options)?;
    for (&mesh, places) in &copies {
        if container.document.meshes[mesh].weights.iter().any(|&weight| weight != 0.0) {
            report.warn("morph targets are not applied: meshes stand as modelled".into());
        }
        for index in 0..container.document.meshes[mesh].primitives.len() {
            let mut own = ImportReport::default();
            let read = primitive::read(&mut container, (mesh, index), &mut images, wanted, &mut own)?;
            add_copies(&mut report, &own, places.len() as u64);
            let Some(read) = read else { continue };
            match &read.leaves {
                None => emit(&mut emitter, &read.mesh, places, options, &mut report)?,
                Some(cut) => {
                    let corner = |corner| cut.corner(&read.mesh, corner);
                    let look = (&cut.texture, cut.alpha, cut.factor);
                    let mut leaves =
                        Leaves::new(&read.mesh, look, &corner, (options.texels, options.dice.as_ref()));
                    for (id, placement) in places {
                        leaves.emit(&mut emitter, placement, *id, &mut report)?;
                    }
                }
            }
            read.release(&mut container);
        }
    }
    Ok(report)
}

/// How many micropolygons leaves will become; refuses more than allowed.
fn count_leaves(
    container: &mut Container,
    copies: &Copies,
    images: &mut texture::Images,
    wanted: primitive::Wanted,
    options: &ImportOptions,
) -> Result<u64> {
    let mut count = 0_u64;
    for (&mesh, places) in copies {
        for index in 0..container.document.meshes[mesh].primitives.len() {
            if !wanted.leaves || !is_see_through(container, (mesh, index)) {
                continue;
            }
            // What is found on the way is reported when it is read to be written
            let read =
                primitive::read(container, (mesh, index), images, wanted, &mut ImportReport::default())?;
            let Some(read) = read else { continue };
            if let Some(cut) = &read.leaves {
                let corner = |corner| cut.corner(&read.mesh, corner);
                let look = (&cut.texture, cut.alpha, cut.factor);
                let mut leaves =
                    Leaves::new(&read.mesh, look, &corner, (options.texels, options.dice.as_ref()));
                for (_, placement) in places {
                    count = count.saturating_add(leaves.count(placement)?);
                }
            }
            read.release(container);
        }
    }
    leaves::check_count(count, options)?;
    Ok(count)
}

/// Whether a primitive's texture may let light through.
fn is_see_through(container: &Container, (mesh, index): (usize, usize)) -> bool {
    let document = &container.document;
    let material = document.meshes[mesh].primitives[index].material;
    let material = material.and_then(|material| document.materials.get(material));
    material.is_some_and(|material| {
        material.alpha() != Some(AlphaMode::Opaque) && material.base().base_color_texture.is_some()
    })
}

/// Writes a mesh wherever it stands.
fn emit(
    emitter: &mut Emitter<'_>,
    mesh: &Mesh,
    places: &[(u32, Placement)],
    options: &ImportOptions,
    report: &mut ImportReport,
) -> Result<()> {
    let clusters = cut::cut(mesh);
    let radius = radius::default_radius(mesh, &clusters, 1.0);
    radius::warn_radius(mesh, radius, report);
    for (id, placement) in places {
        let rate = options.dice.as_ref();
        emitter.emit_diced(mesh, &clusters, placement, rate, (*id, radius), report)?;
    }
    Ok(())
}

/// The attributes that the placed primitives need, by what the document says of them.
fn carried(container: &Container, copies: &Copies) -> Carried {
    let document = &container.document;
    let mut carried = Carried::default();
    for primitive in copies.keys().flat_map(|&mesh| &document.meshes[mesh].primitives) {
        let mode = primitive.mode.unwrap_or(4);
        let material = primitive.material.and_then(|material| document.materials.get(material));
        let alpha = material.and_then(|material| material.alpha());
        carried.normal |= mode > 3 || primitive.attributes.contains_key("NORMAL");
        carried.radius |= mode < 4;
        carried.albedo |= material.is_some() || primitive.attributes.contains_key("COLOR_0");
        carried.opacity |= alpha.is_some_and(|alpha| alpha != AlphaMode::Opaque);
    }
    carried
}

/// Adds what was found in a primitive, as often as it is placed.
fn add_copies(report: &mut ImportReport, own: &ImportReport, copies: u64) {
    let (sum, source) = (&mut report.source, own.source);
    sum.vertices += source.vertices * copies;
    sum.triangles += source.triangles * copies;
    sum.lines += source.lines * copies;
    sum.points += source.points * copies;
    for (reason, count) in &own.skipped {
        report.skip(reason, count * copies);
    }
    own.warnings.iter().for_each(|warning| report.warn(warning.clone()));
}
