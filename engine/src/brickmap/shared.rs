//! Instances that share bricks: which geometries do, and where each copy stands.
//!
//! A geometry with copies is a prototype, built once as a tree on a lattice of its own, if
//!
//! - it has at least two copies, and all maps together at most [`INSTANCES_MAX`],
//! - all its copies together have at least [`MICROPOLYGONS_MIN`] micropolygons,
//! - a place in a copy lies in at most [`OVERLAP_MAX`] copies on the average, or all copies together have more than
//!   [`EXPANDED_MAX`] micropolygons, and
//! - every copy's map can be stored in a [record](crate::brick::instance), and none is so small for the map's extent that its
//!   rays could not be told from each other.
//!
//! Otherwise its copies are expanded. That depends on the inputs alone, never on memory or threads.

use glam::{DMat3, DMat4, DVec3};

use super::census::{self, Census};
use super::pack::{Content, Primitive};
use super::{Job, OccluderStream};
use crate::brick::lattice::exp2;
use crate::brick::{Instance, Lattice, LatticeBox};
use crate::math::Bounds;
use crate::stream::MicrogridStream;
use crate::stream::adapt::{MatrixSource, Placement, cube_root};
use crate::{Error, Result};

/// Copies of all prototypes of a map at most; they are in memory together when the tree over them is built.
pub const INSTANCES_MAX: usize = 1 << 19;

/// Micropolygons of all copies of a geometry from which they share bricks. Smaller ones are traced faster when they are expanded.
pub const MICROPOLYGONS_MIN: u64 = 1 << 20;

/// Copies that a place in one of them lies in, on the average, from which on their trees are so often walked one after the other
/// that one tree over all of them is faster by more than a quarter. Measured: `docs/performance/build.md`.
pub const OVERLAP_MAX: f64 = 4.0;

/// Micropolygons of all copies of a geometry that are not expanded however much they overlap.
pub const EXPANDED_MAX: u64 = 1 << 26;

/// A geometry whose copies share bricks.
#[derive(Debug)]
pub struct Prototype {
    /// Its place among the occluders.
    pub occluder: usize,
    /// World from object, per copy.
    matrices: Vec<DMat4>,
    /// Its own lattice.
    pub lattice: Lattice,
    /// In object space, radii included.
    bounds: Bounds,
    /// What its bytes depend on.
    pub content: u128,
    /// Microgrids.
    pub grids: u64,
    /// What pass 1 has counted; none where that would take too much memory, so that it is counted once more.
    census: Option<Census>,
}

/// A copy on the map's lattice.
#[derive(Clone, Copy, Debug)]
pub struct Placed {
    /// Which prototype.
    pub prototype: u32,
    /// Root brick of its tree.
    pub brick: u32,
    /// Prototype's lattice from the map's.
    pub linear: DMat3,
    /// Where the map's zero lies on the prototype's lattice.
    base: DVec3,
}

impl Placed {
    /// The record for a child whose decoded box has the lower corner `corner`.
    pub fn record(&self, corner: glam::IVec3) -> Option<Instance> {
        Instance::new(self.brick, self.linear, self.linear * corner.as_dvec3() + self.base)
    }

    /// Whether a record can hold it, wherever its prototype's box `own` lies in the decoded box of its node.
    fn can_hold(&self, own: &LatticeBox) -> bool {
        // The decoded box begins a little below: by at most a 255th of its node, twice
        let bounds = self.bounds(own);
        let slack = 3.0 * exp2(24) * self.linear.to_cols_array().iter().fold(0.0_f64, |l, x| l.max(x.abs()));
        let corner = self.linear * bounds.min.as_dvec3() + self.base;
        self.record(bounds.min).is_some() && corner.abs().max_element() + slack < exp2(34)
    }

    /// The box that holds a box of the prototype's lattice.
    fn bounds(&self, own: &LatticeBox) -> LatticeBox {
        let map_from_prototype = self.linear.inverse();
        let mut bounds = LatticeBox::EMPTY;
        for corner in corners(own.min.as_dvec3(), own.max.as_dvec3()) {
            let at = map_from_prototype * (corner - self.base);
            // A step of room, so that what rounding moved on the prototype's lattice stays inside
            bounds.add((at - 1.0).floor().as_ivec3());
            bounds.add((at + 1.0).ceil().as_ivec3());
        }
        bounds
    }
}

impl Prototype {
    /// Judges a geometry by the rule; none if its copies are to be expanded. `taken` copies are placed already.
    ///
    /// # Errors
    /// When the stream or a matrix is broken, or the build is cancelled.
    pub fn judge(
        (occluder, stream): (usize, &mut OccluderStream<'_>),
        taken: usize,
        job: &Job<'_>,
    ) -> Result<Option<Self>> {
        let Some(source) = &mut stream.instances else { return Ok(None) };
        let Some(matrices) = read_matrices(&mut **source, INSTANCES_MAX - taken)? else { return Ok(None) };
        if matrices.len() < 2 {
            return Ok(None);
        }
        let mut own = [OccluderStream::once(&mut *stream.stream)];
        let census = census::count(&mut own, job)?;
        let micropolygons = census.faces().saturating_mul(matrices.len() as u64);
        if micropolygons < MICROPOLYGONS_MIN
            || micropolygons <= EXPANDED_MAX && overlap(&matrices, &census.bounds) > OVERLAP_MAX
        {
            return Ok(None);
        }
        let mut content = xxhash_rust::xxh3::Xxh3::new();
        content.update(&census.content.to_le_bytes());
        matrices.iter().for_each(|matrix| content.update(bytemuck::cast_slice(&matrix.to_cols_array())));
        let (lattice, bounds, grids, content) =
            (census.lattice()?, census.bounds, census.grids, content.digest128());
        let prototype = Self { occluder, matrices, lattice, bounds, content, grids, census: Some(census) };
        Ok(prototype.can_be_stored().then_some(prototype))
    }

    /// Whether records can hold all copies on any lattice that is as fine as the copies themselves.
    fn can_be_stored(&self) -> bool {
        self.matrices.iter().all(|matrix| {
            let linear = DMat3::from_mat4(*matrix).inverse() * scale_of(matrix);
            let largest = linear.to_cols_array().iter().fold(0.0_f64, |largest, x| largest.max(x.abs()));
            largest < exp2(6) && Instance::new(0, linear, DVec3::ZERO).is_some()
        })
    }

    /// Keeps what was counted, in less memory, if that takes at most `memory_bytes`. Returns how much is left of them.
    pub fn keep_census(&mut self, memory_bytes: u64) -> u64 {
        let Some(census) = &mut self.census else { return memory_bytes };
        census.cells.shrink();
        match memory_bytes.checked_sub(census.cells.memory_bytes()) {
            Some(left) => left,
            None => {
                self.census = None;
                memory_bytes
            }
        }
    }

    /// What was counted, to be used once; counts again where it was not kept.
    ///
    /// # Errors
    /// As the first count.
    pub fn take_census(&mut self, stream: &mut dyn MicrogridStream, job: &Job<'_>) -> Result<Census> {
        match self.census.take() {
            Some(census) => Ok(census),
            None => census::count(&mut [OccluderStream::once(stream)], job),
        }
    }

    /// How many copies.
    pub fn copies(&self) -> usize {
        self.matrices.len()
    }

    /// The copies' box in world space.
    pub fn world_bounds(&self) -> Bounds {
        let mut bounds = Bounds::EMPTY;
        for matrix in &self.matrices {
            corners(self.bounds.min, self.bounds.max)
                .for_each(|corner| bounds.add(matrix.transform_point3(corner)));
        }
        bounds
    }

    /// The exponent of a step that is right for the smallest copy.
    pub fn world_exponent(&self) -> i32 {
        let smallest = self.matrices.iter().map(scale_of).fold(f64::INFINITY, f64::min);
        self.lattice.exponent + ((smallest.to_bits() >> 52) & 0x7ff) as i32 - 1023
    }

    /// Whether records can hold all copies on the map's `lattice`.
    pub fn fits(&self, lattice: &Lattice) -> bool {
        let own = LatticeBox {
            min: self.lattice.exact(self.bounds.min).floor().as_ivec3(),
            max: self.lattice.exact(self.bounds.max).ceil().as_ivec3(),
        };
        self.matrices.iter().all(|matrix| self.placed(matrix, (0, 0), lattice).can_hold(&own))
    }

    /// A copy of prototype `number`, whose root brick is `brick`.
    fn placed(&self, matrix: &DMat4, (number, brick): (u32, u32), lattice: &Lattice) -> Placed {
        let (step, own_step) = (lattice.step(), self.lattice.step());
        let zero = lattice.origin.as_dvec3() * step;
        let object_from_world = DMat3::from_mat4(*matrix).inverse();
        let at_zero = object_from_world * (zero - matrix.w_axis.truncate());
        Placed {
            prototype: number,
            brick,
            linear: object_from_world * (step / own_step),
            base: at_zero / own_step - self.lattice.origin.as_dvec3(),
        }
    }

    /// Places all copies of the tree that is `root` in a map with `lattice`, which they [fit](Self::fits).
    pub fn place(
        &self,
        number: u32,
        root: &Primitive,
        lattice: &Lattice,
        placed: &mut Vec<Placed>,
        primitives: &mut Vec<Primitive>,
    ) {
        let Content::Brick(brick) = root.content else { return };
        for matrix in &self.matrices {
            let one = self.placed(matrix, (number, brick), lattice);
            let area_scale = cube_root(1.0 / one.linear.determinant().abs()).powi(2) as f32;
            primitives.push(Primitive {
                bounds: one.bounds(&root.bounds),
                area: root.area * area_scale,
                opaque_area: root.opaque_area * area_scale,
                micropolygons: root.micropolygons,
                content: Content::Instance(placed.len() as u32),
            });
            placed.push(one);
        }
    }
}

/// How many copies a place in a copy lies in on the average, itself included: their volume over that of the cells, as large as the
/// largest copy, in which they have their centres. Small copies among large ones count for less.
fn overlap(matrices: &[DMat4], bounds: &Bounds) -> f64 {
    let (size, center) = (bounds.size(), bounds.center());
    let extent = |matrix: &DMat4| size.max_element() * scale_of(matrix);
    let edge = matrices.iter().map(extent).fold(0.0, f64::max);
    if edge.is_nan() || edge <= 0.0 {
        return 0.0;
    }
    let mut cells: Vec<([i64; 3], f64)> = matrices
        .iter()
        .map(|matrix| {
            let cell = (matrix.transform_point3(center) / edge).floor().as_i64vec3();
            (cell.to_array(), size.element_product() * DMat3::from_mat4(*matrix).determinant().abs())
        })
        .collect();
    cells.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let (mut squares, mut sum) = (0.0, 0.0);
    for cell in cells.chunk_by(|a, b| a.0 == b.0) {
        let volume: f64 = cell.iter().map(|copy| copy.1).sum();
        (squares, sum) = (squares + volume * volume, sum + volume);
    }
    if sum > 0.0 { squares / sum / edge.powi(3) } else { 0.0 }
}

impl Census {
    /// Micropolygons that were counted.
    pub fn faces(&self) -> u64 {
        self.edges.iter().flatten().sum()
    }
}

/// All matrices; none if there are more than `count_max`.
fn read_matrices(source: &mut dyn MatrixSource, count_max: usize) -> Result<Option<Vec<DMat4>>> {
    source.rewind()?;
    let mut matrices = Vec::new();
    while let Some(matrix) = source.next()? {
        Placement::new(matrix)
            .map_err(|error| Error::invalid(format!("instance {}: {}", matrices.len(), error.message())))?;
        if matrices.len() == count_max {
            return Ok(None);
        }
        matrices.push(matrix);
    }
    Ok(Some(matrices))
}

/// By what a matrix scales lengths on the whole: the cube root of the volume that it gives a unit cube.
fn scale_of(matrix: &DMat4) -> f64 {
    cube_root(DMat3::from_mat4(*matrix).determinant().abs())
}

fn corners(low: DVec3, high: DVec3) -> impl Iterator<Item = DVec3> {
    let ends = [low, high];
    (0..8).map(move |i| DVec3::new(ends[i & 1].x, ends[i >> 1 & 1].y, ends[i >> 2 & 1].z))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches an overlap that is not how many copies lie over each other, whatever their size and wherever they are.
    #[test]
    fn overlap_counts_copies() {
        let bounds = Bounds { min: DVec3::splat(-1.0), max: DVec3::ONE };
        // Well inside the cells, so that rounding moves none to another
        let rows = |spacing: f64, scale: f64| -> Vec<DMat4> {
            let at = |i: i32| DVec3::new(f64::from(i % 16), f64::from(i / 16 % 16), f64::from(i / 256));
            (0..4096)
                .map(|i| {
                    DMat4::from_translation(at(i) * spacing * scale + (5e5 + 0.7 * scale))
                        * DMat4::from_scale(DVec3::splat(scale))
                })
                .collect()
        };
        for (spacing, expected) in [(2.0, 1.0), (1.0, 8.0), (0.5, 64.0)] {
            for scale in [1.0, 0.01] {
                let found = overlap(&rows(spacing, scale), &bounds);
                assert!((0.7 * expected..1.4 * expected).contains(&found), "{spacing}: {found}");
            }
        }
        // One large copy among small ones that lie apart
        let mut apart = rows(3.0, 1.0);
        apart.push(DMat4::from_scale(DVec3::splat(40.0)));
        assert!(overlap(&apart, &bounds) < 1.0);
        assert_eq!(overlap(&[DMat4::IDENTITY; 3], &Bounds { min: DVec3::ZERO, max: DVec3::ZERO }), 0.0);
    }
}
