//! Pass 1: how many micropolygons lie where, how fine they are, and a hash of them all.

use glam::DVec3;
use xxhash_rust::xxh3::{Xxh3, xxh3_64_with_seed};

use super::bucket::Cells;
use super::{Job, OccluderStream};
use crate::brick::Lattice;
use crate::brick::lattice;
use crate::math::Bounds;
use crate::stream::piece::in_order;
use crate::stream::schema::{Schema, names};
use crate::stream::{Microgrid, Piece};
use crate::{Error, Result};

/// Memory of a thread that counts: its table of cells, twice while cells are merged, and a block of a stream.
const THREAD_BYTES: u64 = 32 << 20;

/// Faces of a grid of quads that are measured, evenly spaced.
const QUADS_MEASURED: usize = 16;

/// Micropolygons by the binary logarithm of their grid's mean edge, from 2^-64 to 2^63 scene units.
pub(super) type Edges = [u64; 128];

/// What pass 1 finds.
#[derive(Debug)]
pub struct Census {
    /// Micropolygons by place.
    pub cells: Cells,
    /// The box of everything, radii included.
    pub bounds: Bounds,
    /// Microgrids with faces.
    pub grids: u64,
    /// A hash of everything that the map depends on.
    pub content: u128,
    /// Per stream.
    pub(super) edges: Vec<Edges>,
}

/// The columns of a stream that matter to occlusion.
pub struct Columns {
    /// Of points and lines.
    pub radius: Option<usize>,
    /// Of faces.
    pub opacity: Option<usize>,
}

impl Columns {
    /// Finds them.
    pub fn of(schema: &Schema) -> Self {
        Self { radius: schema.find(names::RADIUS), opacity: schema.find(names::OPACITY) }
    }
}

/// Where a grid is filed.
pub fn middle(grid: &Microgrid) -> DVec3 {
    grid.position(grid.vertex_count() / 2)
}

impl Census {
    /// The lattice for the finest stream.
    ///
    /// # Errors
    /// When the geometry is too far away for any.
    pub fn lattice(&self) -> Result<Lattice> {
        Lattice::new(self.exponent().unwrap_or(0), &self.bounds)
    }

    /// The exponent of the finest stream's step; none if there is no stream with faces.
    pub fn exponent(&self) -> Option<i32> {
        self.edges.iter().filter_map(typical_exponent).min()
    }

    /// The lattice shift of every stream.
    pub fn shifts(&self, lattice: &Lattice) -> Vec<u8> {
        let shift = |edges| {
            let exponent = typical_exponent(edges).unwrap_or(lattice.exponent);
            (exponent - lattice.exponent).clamp(0, i32::from(lattice::SHIFT_MAX)) as u8
        };
        self.edges.iter().map(shift).collect()
    }
}

/// The lattice exponent for edges of the first percentile.
fn typical_exponent(edges: &Edges) -> Option<i32> {
    let total: u64 = edges.iter().sum();
    let mut below = 0;
    for (bin, &count) in edges.iter().enumerate() {
        below += count;
        if below > 0 && below >= total.div_ceil(100) {
            return Some(bin as i32 - 64 - lattice::EDGE_BITS);
        }
    }
    None
}

/// What one thread has counted. Sums, unions and cells come out the same however the pieces are shared out.
struct Tally {
    grid: Microgrid,
    cells: Cells,
    bounds: Bounds,
    edges: Edges,
    grids: u64,
    content: u64,
}

/// Pass 1.
///
/// # Errors
/// When a stream is broken, there is nothing in it, or the build is cancelled.
pub fn count(occluders: &mut [OccluderStream<'_>], job: &Job<'_>) -> Result<Census> {
    let threads = (job.options.memory_bytes / THREAD_BYTES).clamp(1, job.options.threads.max(1) as u64);
    let tally = || Tally {
        grid: Microgrid::default(),
        cells: Cells::new(-30),
        bounds: Bounds::EMPTY,
        edges: [0; 128],
        grids: 0,
        content: 0,
    };
    let mut tallies: Vec<Tally> = (0..threads).map(|_| tally()).collect();
    let mut all_edges = Vec::with_capacity(occluders.len());
    let streams = occluders.len() as f64;
    for (number, OccluderStream { stream, .. }) in occluders.iter_mut().enumerate() {
        stream.rewind()?;
        let schema = stream.schema().clone();
        let columns = Columns::of(&schema);
        let mut pieces = 0_u64;
        let next = || {
            job.tell("count", (number as f64 + stream.progress()) / streams)?;
            pieces += 1;
            let seed = ((number as u64) << 40) + pieces;
            Ok(stream.next_piece()?.map(|piece| (seed, piece)))
        };
        in_order(&mut tallies, next, |tally, (seed, piece)| tally.count(seed, piece, &schema, &columns), Ok)?;
        let mut edges = [0; 128];
        for tally in &mut tallies {
            let counted = std::mem::replace(&mut tally.edges, [0; 128]);
            edges.iter_mut().zip(counted).for_each(|(sum, count)| *sum += count);
        }
        all_edges.push(edges);
    }
    let mut sum = tally();
    for tally in tallies {
        sum.bounds = sum.bounds.union(&tally.bounds);
        sum.grids += tally.grids;
        sum.content = sum.content.wrapping_add(tally.content);
        sum.cells.merge(tally.cells);
    }
    if sum.grids == 0 && !occluders.is_empty() {
        return Err(Error::invalid("the occluders hold no geometry"));
    }
    let mut content = Xxh3::new();
    content.update(&sum.content.to_le_bytes());
    content.update(bytemuck::cast_slice(&[sum.grids, all_edges.len() as u64]));
    let content = content.digest128();
    Ok(Census { cells: sum.cells, bounds: sum.bounds, grids: sum.grids, content, edges: all_edges })
}

impl Tally {
    /// Counts a piece whose place among all is `seed`.
    fn count(&mut self, seed: u64, piece: Box<dyn Piece>, schema: &Schema, columns: &Columns) -> Result<()> {
        let mut grid = std::mem::take(&mut self.grid);
        let mut content = seed;
        piece.read(&mut grid, &mut |grid| {
            if grid.face_count() == 0 {
                return Ok(());
            }
            let mut bounds = grid.bounds();
            if !(bounds.min.is_finite() && bounds.max.is_finite()) {
                return Err(Error::invalid("a position of an occluder is not a finite number"));
            }
            let (edge, radius) = edge_and_radius(grid, schema, columns)?;
            bounds.min -= radius;
            bounds.max += radius;
            self.bounds = self.bounds.union(&bounds);
            let bin = lattice::exponent_for_edge(edge) + lattice::EDGE_BITS + 64;
            self.edges[bin.clamp(0, 127) as usize] += grid.face_count() as u64;
            self.cells.add(middle(grid), grid.face_count() as u64);
            self.grids += 1;
            content = hash(grid, columns, content);
            Ok(())
        })?;
        self.content = self.content.wrapping_add(content);
        self.grid = grid;
        Ok(())
    }
}

/// Chains what the map depends on in a grid to a hash.
fn hash(grid: &Microgrid, columns: &Columns, seed: u64) -> u64 {
    let mut hash = xxh3_64_with_seed(bytemuck::cast_slice(&grid.positions), seed);
    hash = xxh3_64_with_seed(bytemuck::bytes_of(&grid.anchor), hash);
    hash = xxh3_64_with_seed(&grid.arities, hash);
    hash = xxh3_64_with_seed(&grid.indices, hash);
    for column in [columns.radius, columns.opacity].into_iter().flatten() {
        hash = xxh3_64_with_seed(&grid.columns[column], hash);
    }
    hash
}

/// The mean edge of a grid's faces, points counting their diameter, and the largest radius.
fn edge_and_radius(grid: &Microgrid, schema: &Schema, columns: &Columns) -> Result<(f64, f64)> {
    let edges = |face: &[u8]| {
        let at = |i: usize| grid.positions[usize::from(face[i])];
        0.5 * f64::from(at(0).distance(at(1)) + at(1).distance(at(2)))
    };
    let faces = grid.face_count();
    if grid.indices.len() == 4 * faces && grid.arities.iter().all(|&arity| arity == 4) {
        let step = faces.div_ceil(QUADS_MEASURED);
        let measured = grid.indices.chunks_exact(4).step_by(step);
        let count = measured.len() as f64;
        return Ok((measured.map(edges).sum::<f64>() / count, 0.0));
    }
    let (mut sum, mut largest) = (0.0_f64, 0.0_f64);
    for face in grid.faces() {
        if face.len() <= 2 {
            let radius =
                columns.radius.map_or(0.0, |c| f64::from(grid.value(schema, c, usize::from(face[0]), 0)));
            if radius.is_nan() || radius.is_infinite() {
                return Err(Error::invalid("a radius is not a finite number"));
            }
            largest = largest.max(radius);
            sum += 2.0 * radius;
        } else {
            sum += edges(face);
        }
    }
    // The second end of a line may be the thicker one
    if let Some(column) = columns.radius {
        let radii = (0..grid.vertex_count()).map(|v| f64::from(grid.value(schema, column, v, 0)));
        largest = radii.filter(|radius| radius.is_finite()).fold(largest, f64::max);
    }
    Ok((sum / faces as f64, largest))
}
