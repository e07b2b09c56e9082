//! Pass 2: every microgrid goes to the lattice, and to its partition's part of the spill.

use std::sync::atomic::AtomicBool;

use super::OccluderStream;
use super::census::{Census, Columns, each_grid, middle};
use super::spill::{Log, Partition, Quantised, Scatter};
use crate::brick::lattice::Lattice;
use crate::brick::leaf::{OPAQUE, extinction_from_opacity};
use crate::stream::Microgrid;
use crate::stream::schema::{Rate, Schema};
use crate::{Error, Result};

/// Reads all streams a second time and fills `partitions` partitions, as the census's cells say.
///
/// # Errors
/// When a stream is broken or not what it was, the disk is full, or `cancel` is set.
#[expect(clippy::too_many_arguments, reason = "the whole state of the build")]
pub fn fill(
    occluders: &mut [OccluderStream<'_>],
    census: &Census,
    partitions: usize,
    lattice: &Lattice,
    shifts: &[u8],
    log: &mut Log,
    buffer_bytes: u64,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
) -> Result<Vec<Partition>> {
    let mut scatter = Scatter::new(partitions, buffer_bytes);
    let mut quantised = Quantised::default();
    let (mut grids, mut faces) = (0, 0);
    let changed = || Error::invalid("the occluders changed between two readings");
    each_grid(occluders, "fill", progress, cancel, |stream, schema, columns, grid| {
        quantise(grid, schema, columns, lattice, shifts[stream], &mut quantised)?;
        (grids, faces) = (grids + 1, faces + grid.face_count() as u64);
        let partition = census.cells.partition_of(middle(grid)).ok_or_else(changed)?;
        scatter.push(log, partition, &quantised)
    })?;
    if (grids, faces) != (census.grids, census.faces) {
        return Err(changed());
    }
    scatter.finish(log)
}

/// Puts a grid on the lattice.
fn quantise(
    grid: &Microgrid,
    schema: &Schema,
    columns: &Columns,
    lattice: &Lattice,
    shift: u8,
    out: &mut Quantised,
) -> Result<()> {
    out.clear();
    out.shift = shift;
    out.vertices.extend((0..grid.vertex_count()).map(|vertex| lattice.snap(grid.position(vertex), shift)));
    out.arities.extend_from_slice(&grid.arities);
    out.indices.extend_from_slice(&grid.indices);
    out.find_columns();
    if columns.radius.is_some() && grid.arities.iter().any(|&arity| arity <= 2) {
        // What is not a positive number becomes 0; faces without a radius are counted later
        let radius = |vertex| match columns.radius(schema, grid, vertex as u8) / lattice.step() {
            radius if radius > 0.0 && radius.is_finite() => radius as f32,
            _ => 0.0,
        };
        out.radii.extend((0..grid.vertex_count()).map(radius));
    }
    if let Some(column) = columns.opacity {
        push_extinctions(grid, schema, column, &mut out.extinctions)?;
    }
    Ok(())
}

/// One extinction a face, of the mean of its vertices' opacities; none if all faces are opaque.
fn push_extinctions(grid: &Microgrid, schema: &Schema, column: usize, out: &mut Vec<u16>) -> Result<()> {
    let at = |vertex: u8| grid.unit_value(schema, column, usize::from(vertex), 0);
    let mean = |face: &[u8]| match schema.attributes[column].rate {
        Rate::Grid => at(0),
        Rate::Vertex => face.iter().map(|&vertex| at(vertex)).sum::<f32>() / face.len() as f32,
    };
    // Neighbours often have the same opacity: one logarithm does
    let (mut known, mut extinction) = (1.0, OPAQUE);
    for face in grid.faces() {
        let opacity = mean(face);
        if opacity.is_nan() {
            return Err(Error::invalid("an opacity is not a number"));
        }
        if opacity != known {
            (known, extinction) = (opacity, extinction_from_opacity(opacity));
        }
        out.push(extinction);
    }
    if out.iter().all(|&extinction| extinction == OPAQUE) {
        out.clear();
    }
    Ok(())
}
