//! Pass 1: what there is. Bounds, edge lengths, a count for every cell of space, and a hash of everything that the brick map
//! depends on.

use std::sync::atomic::AtomicBool;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use super::bucket::Cells;
use super::{Limits, OccluderStream, check};
use crate::brick::lattice::{self, Lattice};
use crate::math::Bounds;
use crate::stream::Microgrid;
use crate::stream::schema::{Rate, Schema, names};
use crate::{Error, ErrorKind, Result};

/// Faces of a grid whose edges are measured.
const FACES_MEASURED: usize = 8;

/// Positions are refused beyond this many scene units: squares of differences stay finite.
const POSITION_MAX: f64 = 1e60;

/// Grids between two looks at the cancel flag.
pub const GRIDS_PER_CHECK: u64 = 256;

/// What pass 1 finds.
#[derive(Debug)]
pub struct Census {
    /// Micropolygons by place.
    pub cells: Cells,
    /// Everything in scene units, radii included.
    pub bounds: Bounds,
    /// Per stream.
    pub edges: Vec<Edges>,
    /// Grids with faces.
    pub grids: u64,
    /// Faces.
    pub faces: u64,
    /// Vertices.
    pub vertices: u64,
    /// xxh3-128 of all that the map depends on.
    pub hash: u128,
}

/// Micropolygons by the binary logarithm of their grid's mean edge, from 2^-64 to 2^63 scene units.
#[derive(Clone, Debug, PartialEq)]
pub struct Edges([u64; 128]);

impl Edges {
    fn add(&mut self, edge: f64, faces: u64) {
        if edge > 0.0 {
            let bin = lattice::exponent_for_edge(edge) + lattice::EDGE_BITS + 64;
            self.0[bin.clamp(0, 127) as usize] += faces;
        }
    }

    /// The lattice exponent for these edges: the finest tenth of the micropolygons has edges of at least
    /// `2^EDGE_BITS` steps, save the finest hundredth, which has at least an eighth of that. One speck of fine detail
    /// does not make everything else larger.
    fn exponent(&self) -> Option<i32> {
        let total: u64 = self.0.iter().sum();
        let percentile = |percent: u64| {
            let mut below = 0;
            let reached = |count: &u64| {
                below += count;
                below > 0 && below * 100 >= total * percent
            };
            self.0.iter().position(reached).map(|bin| bin as i32 - 64 - lattice::EDGE_BITS)
        };
        Some(percentile(10)?.min(percentile(1)? + 3))
    }
}

impl Census {
    /// Reads all streams once.
    ///
    /// # Errors
    /// When a stream is broken, a position is not finite, there is nothing to build, or `cancel` is set.
    pub fn take(
        occluders: &mut [OccluderStream<'_>],
        limits: &Limits,
        progress: &(dyn Fn(&str, f64) + Sync),
        cancel: &AtomicBool,
    ) -> Result<Self> {
        let mut census = Self {
            cells: Cells::new(-30, limits.cells_max),
            bounds: Bounds::EMPTY,
            edges: Vec::new(),
            grids: 0,
            faces: 0,
            vertices: 0,
            hash: 0,
        };
        let mut hash = Xxh3::new();
        each_grid(occluders, "count", progress, cancel, |stream, schema, columns, grid| {
            if census.edges.len() <= stream {
                census.edges.resize(stream + 1, Edges([0; 128]));
                hash.update(&(stream as u64).to_le_bytes());
                hash.update(format!("{:?}", columns.types(schema)).as_bytes());
            }
            columns.hash(grid, &mut hash);
            census.add(stream, schema, columns, grid)
        })?;
        census.edges.resize(occluders.len(), Edges([0; 128]));
        census.hash = hash.digest128();
        if census.faces == 0 {
            return Err(Error::invalid("no occluder geometry")
                .hint("at least one occluder must have a point, line, triangle or quad"));
        }
        Ok(census)
    }

    fn add(&mut self, stream: usize, schema: &Schema, columns: &Columns, grid: &Microgrid) -> Result<()> {
        let faces = grid.face_count() as u64;
        let radius = columns.radius_max(schema, grid);
        let mut bounds = grid.bounds();
        bounds.min -= radius;
        bounds.max += radius;
        if bounds.min.abs().max(bounds.max.abs()).max_element() > POSITION_MAX {
            return Err(Error::new(
                ErrorKind::Limit,
                format!("a position or radius over {POSITION_MAX:e} units"),
            ));
        }
        self.bounds = self.bounds.union(&bounds);
        self.edges[stream].add(mean_edge(grid, schema, columns), faces);
        self.cells.add(middle(grid), faces);
        self.grids += 1;
        self.faces += faces;
        self.vertices += grid.vertex_count() as u64;
        Ok(())
    }

    /// The lattice: its step follows the finest stream.
    ///
    /// # Errors
    /// When the scene is too far from the origin for its detail.
    pub fn lattice(&self) -> Result<Lattice> {
        Lattice::new(self.edges.iter().filter_map(Edges::exponent).min().unwrap_or(0), &self.bounds)
    }

    /// The lattice shift of every stream: one for all its grids, so that nothing cracks inside it.
    pub fn shifts(&self, lattice: &Lattice) -> Vec<u8> {
        let shift = |edges: &Edges| {
            let exponent = edges.exponent().unwrap_or(lattice.exponent);
            (exponent - lattice.exponent).clamp(0, i32::from(lattice::SHIFT_MAX)) as u8
        };
        self.edges.iter().map(shift).collect()
    }
}

/// A hash of everything in the streams that a brick map depends on: the same that [`super::build`] writes into the manifest.
/// Reads them once.
///
/// # Errors
/// As [`super::build`].
pub fn hash_occluders(occluders: &mut [OccluderStream<'_>], cancel: &AtomicBool) -> Result<u128> {
    Census::take(occluders, &Limits::default(), &|_, _| {}, cancel).map(|census| census.hash)
}

/// Calls `each` with the stream's number, its schema, the columns that matter, and every grid that has faces.
pub fn each_grid(
    occluders: &mut [OccluderStream<'_>],
    stage: &str,
    progress: &(dyn Fn(&str, f64) + Sync),
    cancel: &AtomicBool,
    mut each: impl FnMut(usize, &Schema, &Columns, &Microgrid) -> Result<()>,
) -> Result<()> {
    let mut grid = Microgrid::default();
    let streams = occluders.len() as f64;
    for (number, OccluderStream { stream }) in occluders.iter_mut().enumerate() {
        stream.rewind()?;
        let schema = stream.schema().clone();
        let columns = Columns::of(&schema);
        let mut grids = 0_u64;
        while stream.next(&mut grid)? {
            if grids.is_multiple_of(GRIDS_PER_CHECK) {
                progress(stage, (number as f64 + stream.progress()) / streams);
                check(cancel)?;
            }
            if grid.face_count() > 0 {
                let sound = grid.validate(&schema);
                sound.and_then(|()| each(number, &schema, &columns, &grid)).map_err(|error| {
                    let message =
                        format!("microgrid {grids} of occluder stream {number}: {}", error.message());
                    if error.place().is_none() { Error::new(error.kind(), message) } else { error }
                })?;
            }
            grids += 1;
        }
    }
    progress(stage, 1.0);
    Ok(())
}

/// Where a grid is filed.
pub fn middle(grid: &Microgrid) -> DVec3 {
    grid.position(grid.vertex_count() / 2)
}

/// The columns of a stream that matter to occlusion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Columns {
    /// Radius of points and lines.
    pub radius: Option<usize>,
    /// Opacity.
    pub opacity: Option<usize>,
}

impl Columns {
    fn of(schema: &Schema) -> Self {
        Self { radius: schema.find(names::RADIUS), opacity: schema.find(names::OPACITY) }
    }

    fn types(&self, schema: &Schema) -> [Option<(crate::stream::ValueType, Rate)>; 2] {
        let types = |column: usize| (schema.attributes[column].value_type, schema.attributes[column].rate);
        [self.radius.map(types), self.opacity.map(types)]
    }

    fn hash(&self, grid: &Microgrid, hash: &mut Xxh3) {
        let counts = [grid.vertex_count() as u64, grid.face_count() as u64];
        hash.update(bytemuck::cast_slice(&counts));
        hash.update(bytemuck::cast_slice(&grid.anchor.to_array()));
        hash.update(bytemuck::cast_slice(&grid.positions));
        hash.update(&grid.arities);
        hash.update(&grid.indices);
        [self.radius, self.opacity].iter().flatten().for_each(|&column| hash.update(&grid.columns[column]));
    }

    /// The radius of a vertex in scene units; 0 where there is none.
    pub fn radius(&self, schema: &Schema, grid: &Microgrid, vertex: u8) -> f64 {
        self.radius.map_or(0.0, |column| f64::from(grid.value(schema, column, usize::from(vertex), 0)))
    }

    /// The largest usable radius of the points and lines.
    fn radius_max(&self, schema: &Schema, grid: &Microgrid) -> f64 {
        if self.radius.is_none() || grid.arities.iter().all(|&arity| arity > 2) {
            return 0.0;
        }
        let round = grid.faces().filter(|face| face.len() <= 2).flatten();
        let radii = round.map(|&vertex| self.radius(schema, grid, vertex));
        radii.filter(|radius| radius.is_finite()).fold(0.0, f64::max)
    }
}

/// The mean edge of some of a grid's faces, in scene units. Points count their diameter, lines the geometric mean of
/// length and diameter.
fn mean_edge(grid: &Microgrid, schema: &Schema, columns: &Columns) -> f64 {
    let step = grid.face_count().div_ceil(FACES_MEASURED);
    let (mut sum, mut count) = (0.0, 0);
    for face in grid.faces().step_by(step) {
        let length = |a: usize, b: usize| {
            let [a, b] = [a, b].map(|i| grid.positions[usize::from(face[i])].as_dvec3());
            a.distance(b)
        };
        let diameter = || 2.0 * columns.radius(schema, grid, face[0]).abs();
        let edge = match face.len() {
            1 => diameter(),
            2 => (length(0, 1) * diameter()).sqrt(),
            corners => (0..corners).map(|i| length(i, (i + 1) % corners)).sum::<f64>() / corners as f64,
        };
        if edge > 0.0 && edge.is_finite() {
            sum += edge;
            count += 1;
        }
    }
    sum / f64::from(count.max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a lattice that a speck of fine detail makes needlessly fine, or that crushes it.
    #[test]
    fn the_step_follows_the_finer_micropolygons() {
        let exponent = |counts: &[(f64, u64)]| {
            let mut edges = Edges([0; 128]);
            counts.iter().for_each(|&(edge, count)| edges.add(edge, count));
            edges.exponent().unwrap() + lattice::EDGE_BITS
        };
        assert_eq!(exponent(&[(1.5, 1000)]), 0);
        assert_eq!(exponent(&[(1.5, 1000), (0.25, 200)]), -2);
        assert_eq!(exponent(&[(1.5, 1000), (0.25, 50)]), 0);
        assert_eq!(exponent(&[(1.5, 1000), (0.015_625, 50)]), -3);
        assert_eq!(exponent(&[(1.5, 1000), (0.015_625, 5)]), 0);
    }
}
