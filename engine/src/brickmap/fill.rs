//! Pass 2: every grid is put on the lattice and spilled to its partition.

use super::census::{Census, Columns, middle};
use super::log::{Batch, Spill};
use super::spill::Quantised;
use super::{Job, OccluderStream};
use crate::brick::Lattice;
use crate::brick::leaf::{OPAQUE, extinction_from_opacity};
use crate::stream::piece::in_order;
use crate::stream::schema::Schema;
use crate::stream::{Microgrid, Piece};
use crate::{Error, Result};

/// Pass 2. Of the grids of the first `done` partitions only the boxes are kept.
///
/// # Errors
/// When a stream is broken or differs from what pass 1 read, the disk is full, or the build is cancelled.
pub fn fill(
    occluders: &mut [OccluderStream<'_>],
    census: &Census,
    (lattice, shifts): (&Lattice, &[u8]),
    done: usize,
    spill: &mut Spill,
    job: &Job<'_>,
) -> Result<()> {
    let mut states: Vec<(Microgrid, Quantised)> = vec![Default::default(); job.options.threads.max(1)];
    let streams = occluders.len() as f64;
    for (number, (OccluderStream { stream, .. }, &shift)) in occluders.iter_mut().zip(shifts).enumerate() {
        stream.rewind()?;
        let schema = stream.schema().clone();
        let columns = Columns::of(&schema);
        let changed = || Error::invalid(format!("occluder stream {number} changed between two readings"));
        let work = |(grid, quantised): &mut (Microgrid, Quantised), piece: Box<dyn Piece>| {
            let mut batch = Batch::default();
            piece.read(grid, &mut |grid| {
                if grid.face_count() == 0 {
                    return Ok(());
                }
                let partition = census.cells.partition_of(middle(grid)).ok_or_else(changed)?;
                quantise(grid, &schema, &columns, lattice, shift, quantised);
                if partition >= done {
                    batch.push(partition, quantised);
                } else {
                    batch.note(partition, quantised);
                }
                Ok(())
            })?;
            Ok(batch)
        };
        let next = || {
            job.tell("fill", (number as f64 + stream.progress()) / streams)?;
            stream.next_piece()
        };
        in_order(&mut states, next, work, |batch| spill.add(&batch))?;
    }
    Ok(())
}

/// Puts a grid on the lattice.
fn quantise(
    grid: &Microgrid,
    schema: &Schema,
    columns: &Columns,
    lattice: &Lattice,
    shift: u8,
    out: &mut Quantised,
) {
    out.clear();
    out.shift = shift;
    out.vertices.extend((0..grid.vertex_count()).map(|vertex| lattice.snap(grid.position(vertex), shift)));
    out.arities.extend_from_slice(&grid.arities);
    out.indices.extend_from_slice(&grid.indices);
    out.find_columns();
    if let Some(column) = columns.radius
        && grid.arities.iter().any(|&arity| arity <= 2)
    {
        let radius = |vertex| {
            (f64::from(grid.value(schema, column, vertex, 0)) / lattice.step()).clamp(0.0, 5e8) as f32
        };
        out.radii.extend((0..grid.vertex_count()).map(radius));
    }
    if let Some(column) = columns.opacity {
        let mean = |face: &[u8]| {
            let sum: f32 = face.iter().map(|&v| grid.unit_value(schema, column, usize::from(v), 0)).sum();
            extinction_from_opacity(sum / face.len() as f32)
        };
        out.extinctions.extend(grid.faces().map(mean));
        if out.extinctions.iter().all(|&extinction| extinction == OPAQUE) {
            out.extinctions.clear();
        }
    }
}
