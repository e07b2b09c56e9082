//! Wavefront OBJ: polygons, lines and points with normals, groups, materials and the vertex colour extension.

mod mtl;
mod read;

use std::path::Path;

use super::emit::{Carried, Emitter, Placement};
use super::{GridSink, ImportOptions, ImportReport, cut, radius};
use crate::Result;

/// Imports an OBJ file.
pub(super) fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let mut report = ImportReport::default();
    let mut mesh = read::read(path, options, &mut report)?;
    mesh.finish(&mut report)?;
    let clusters = cut::cut(&mesh);
    let radius = radius::default_radius(&mesh, &clusters, options.meters_per_unit);
    radius::warn_radius(&mesh, radius, &mut report);
    let mut emitter = Emitter::new(sink, Carried::by(&mesh), options)?;
    let rate = options.dice.as_ref();
    emitter.emit_diced(&mesh, &clusters, &Placement::HERE, rate, (0, radius), &mut report)?;
    Ok(report)
}
