//! Instances that share bricks: which geometries do, and where each copy stands.
//!
//! A geometry with copies is a prototype, built once as a tree on a lattice of its own, if
//!
//! - it has at least two copies, and all maps together at most [`INSTANCES_MAX`],
//! - all its copies together have at least [`MICROPOLYGONS_MIN`] micropolygons, and
//! - every copy's map can be stored in a [record](crate::brick::instance).
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
        if census.faces() * (matrices.len() as u64) < MICROPOLYGONS_MIN {
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

    /// Places all copies of the tree that is `root` in a map with `lattice`.
    ///
    /// # Errors
    /// [`ErrorKind::Limit`](crate::ErrorKind::Limit) when a copy is too small for the map's extent.
    pub fn place(
        &self,
        number: u32,
        root: &Primitive,
        lattice: &Lattice,
        placed: &mut Vec<Placed>,
        primitives: &mut Vec<Primitive>,
    ) -> Result<()> {
        let Content::Brick(brick) = root.content else { return Ok(()) };
        let (step, own_step) = (lattice.step(), self.lattice.step());
        let zero = lattice.origin.as_dvec3() * step;
        for (copy, matrix) in self.matrices.iter().enumerate() {
            let object_from_world = DMat3::from_mat4(*matrix).inverse();
            let linear = object_from_world * (step / own_step);
            let at_zero = object_from_world * (zero - matrix.w_axis.truncate());
            let base = at_zero / own_step - self.lattice.origin.as_dvec3();
            let one = Placed { prototype: number, brick, linear, base };
            let bounds = one.bounds(&root.bounds);
            // The decoded box begins a little below: by at most a 255th of its node, twice
            let slack = 3.0 * exp2(24) * linear.to_cols_array().iter().fold(0.0_f64, |l, x| l.max(x.abs()));
            let corner = linear * bounds.min.as_dvec3() + base;
            if one.record(bounds.min).is_none() || corner.abs().max_element() + slack >= exp2(34) {
                return Err(Error::new(
                    crate::ErrorKind::Limit,
                    format!(
                        "instance {copy} of occluder {} is too small for the scene's extent",
                        self.occluder
                    ),
                )
                .hint("split the scene, or give the copies a common scale"));
            }
            let area_scale = cube_root(1.0 / linear.determinant().abs()).powi(2) as f32;
            primitives.push(Primitive {
                bounds,
                area: root.area * area_scale,
                opaque_area: root.opaque_area * area_scale,
                micropolygons: root.micropolygons,
                content: Content::Instance(placed.len() as u32),
            });
            placed.push(one);
        }
        Ok(())
    }
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
