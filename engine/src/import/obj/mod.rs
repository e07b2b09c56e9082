//! Wavefront OBJ: polygons, lines and points with normals, groups, materials and the vertex colour extension.

mod mtl;
mod read;

use std::path::Path;

use super::{GridSink, ImportOptions, ImportReport};
use crate::Result;

/// Imports an OBJ file.
pub(super) fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let mut report = ImportReport::default();
    read::read(path, options, &mut report)?.emit(sink, &mut report)?;
    Ok(report)
}
