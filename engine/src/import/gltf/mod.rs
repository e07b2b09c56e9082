//! glTF 2.0, as text or binary: node hierarchy, instances, and base colour into `albedo` and `opacity`.
//!
//! The document is read by structures of its own rather than by the `gltf` crate, whose node transforms are single
//! precision, and whose accessors panic where a view is too short.

mod accessor;
mod check;
mod container;
mod document;
mod leaves;
mod nodes;
mod primitive;
mod texture;

use std::path::Path;

use self::container::Container;
use self::document::AlphaMode;
use self::nodes::Copies;
use super::emit::{Carried, Emitter, Placement};
use super::mesh::Mesh;
use super::{GridSink, ImportOptions, ImportReport, cut, radius};
use crate::Result;

/// Imports a glTF or GLB file.
pub(super) fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let mut report = ImportReport::default();
    let mut container = Container::open(path, options.memory_bytes)?;
    let copies = nodes::copies(&mut container, options, &mut report)?;
    let carried = carried(&container, &copies);
    let wanted = primitive::Wanted { albedo: carried.albedo, leaves: options.dice.is_some() };
    let mut emitter = Emitter::new(sink, carried, options)?;
    let mut images = texture::Images::default();
    for (&mesh, places) in &copies {
        if container.document.meshes[mesh].weights.iter().any(|&weight| weight != 0.0) {
            report.warn("morph targets are not applied: meshes stand as modelled".into());
        }
        for index in 0..container.document.meshes[mesh].primitives.len() {
            let mut own = ImportReport::default();
            let read = primitive::read(&mut container, (mesh, index), &mut images, wanted, &mut own)?;
            add_copies(&mut report, &own, places.len() as u64);
            let Some(read) = read else { continue };
            let Some(leaves) = read.leaves else {
                emit(&mut emitter, &read.mesh, places, options, &mut report)?;
                drop(read.mesh);
                container.budget.give(read.bytes);
                continue;
            };
            let mut own = ImportReport::default();
            leaves.cut(&read.mesh, &images, &mut own, |part| {
                emit(&mut emitter, part, places, options, &mut report)
            })?;
            add_copies(&mut report, &own, places.len() as u64);
            drop(read.mesh);
            container.budget.give(read.bytes);
            primitive::release(&mut container, leaves.colors, Some(leaves.uvs));
        }
    }
    Ok(report)
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
