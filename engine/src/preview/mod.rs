//! The preview of a decorated stream: an octree of quantised points with their coefficients, for a viewer that shows the
//! coarse first and never has all of it (`docs/formats-preview.md`).
//!
//! [`sample`] picks points of the stream, the same whatever the machine; [`tree`] spreads them over nodes, so that each node
//! adds detail to those above it; [`mod@file`] is the layout, with a reader that checks everything.

pub mod file;
mod parts;
mod sample;
mod tree;

use std::path::Path;

pub use file::{Header, Node, Preview, RECORD_HEAD_BYTES};
pub use parts::{PartsPreview, Setting};

use crate::relight::{find_attribute, noted, noted_attribute};
use crate::stream::MicrogridStream;
use crate::stream::file::MgsReader;
use crate::stream::{Schema, ValueType};
use crate::{Error, Result};

/// Points of a preview at most.
pub const POINTS_MAX: u64 = 10_000_000;

/// Bytes of one node's points at most.
pub const NODE_BYTES_MAX: usize = 256 << 10;

/// What a preview came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PreviewReport {
    /// Points in it.
    pub points: u64,
    /// Vertices of the stream that have a result.
    pub baked: u64,
    /// Nodes.
    pub nodes: u64,
    /// Bytes of the file.
    pub bytes: u64,
}

/// Writes the preview of a decorated stream to `target`, which appears when it is complete. It has as many points as fit
/// into `memory_bytes`, and [`POINTS_MAX`] at most; the same points for the same stream and number.
///
/// # Errors
/// [`ErrorKind::NotFound`](crate::ErrorKind::NotFound) when the stream has no coefficients, or no vertex with a result;
/// when it cannot be read or the target cannot be written.
pub fn write_preview(
    stream: &mut MgsReader,
    target: &Path,
    memory_bytes: u64,
    progress: &mut dyn FnMut(f64),
) -> Result<PreviewReport> {
    let schema = stream.schema().clone();
    let column = find_attribute(&schema, noted_attribute(stream.metadata()))?;
    let name = schema.attributes[column].name.clone();
    let (weight, domain) = noted(stream.metadata(), &name);
    let error = find_error(&schema, &name);
    let counts = stream.footer()?.counts;
    let mut header = Header::new(&schema, (column, error), weight, domain);
    let points_max = (memory_bytes / sample::bytes_per_point(&header)).min(POINTS_MAX);
    let wanted = sample::Wanted { vertices: counts.vertices, points_max, corner: counts.bounds.min };
    let points = sample::sample(stream, &schema, &header, wanted, progress)?;
    if points.positions.is_empty() {
        let error = Error::new(crate::ErrorKind::NotFound, "no vertex of the stream has a result");
        return Err(error.at(target));
    }
    header.baked = points.baked;
    let nodes = tree::spread(&points, &mut header);
    let bytes = file::write(target, &header, &nodes, &points)?;
    Ok(PreviewReport { points: header.points, baked: header.baked, nodes: nodes.len() as u64, bytes })
}

/// The attribute that holds the error of the coefficients of the attribute `name`: it is called after it.
fn find_error(schema: &Schema, name: &str) -> Option<usize> {
    let column = schema.find(&format!("{name}_error"))?;
    let attribute = &schema.attributes[column];
    let is_number = matches!(attribute.value_type, ValueType::F16 | ValueType::F32);
    (is_number && attribute.components == 1).then_some(column)
}
