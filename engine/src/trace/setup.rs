//! A batch before it is traced: what to compute, where its rays start, which of its points go together.

use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};

use super::stream::TraceOptions;
use crate::Result;
use crate::batch::Point;
use crate::brick::LatticeBox;
use crate::brick::bundle::{POINTS_MAX, RAYS_MAX};
use crate::brickmap::BrickMap;
use crate::cut::{Arena, Cut, select};
use crate::scene::ShOcclusion;
use crate::shade::sample::{Sampler, Spread};

/// Points of a bundle, unless their rays are too many or they lie too far apart.
const BUNDLE_POINTS: usize = 32;
const _: () = assert!(BUNDLE_POINTS <= POINTS_MAX);

/// Hits nearer than this are tested again in double precision (paper, section 5).
const NEAR_METERS: f64 = 0.001;

/// What to compute at a batch's points.
#[derive(Debug)]
pub struct Shading {
    /// The shader's parameters.
    pub shader: ShOcclusion,
    /// Makes the rays.
    pub(super) sampler: Sampler,
    /// Lattice shift of the geometry that the points lie on.
    shift: u8,
    /// Whether the halves of every point's rays are projected too.
    pub(super) has_halves: bool,
}

impl Shading {
    /// Prepares a shader for the bake set with the given name, whose points lie on a geometry of lattice shift `shift`
    /// (0 if it is no occluder).
    pub fn new(shader: &ShOcclusion, seed: u64, bake_set: &str, shift: u8) -> Self {
        let sampler = Sampler::new(shader.samples, seed, bake_set_hash(bake_set));
        Self { shader: shader.clone(), sampler, shift, has_halves: false }
    }

    /// With what [`half_split_error`](crate::shade::sh_occlusion::half_split_error) needs: as many numbers again after every
    /// point's coefficients. The CPU computes them.
    pub fn with_halves(self) -> Self {
        Self { has_halves: true, ..self }
    }

    /// The unit normal and the spread of directions of a point.
    pub(super) fn spread(&self, normal: Vec3) -> (Vec3, Spread) {
        let unit = normal.as_dvec3().normalize_or_zero().as_vec3();
        let has_normal = unit != Vec3::ZERO;
        (if has_normal { unit } else { Vec3::Z }, Spread::new(&self.shader, has_normal))
    }

    /// Coefficients of a point.
    pub fn coefficients(&self) -> usize {
        (self.shader.bands * self.shader.bands) as usize
    }

    /// Numbers that are computed at a point: its coefficients, and what [`with_halves`](Self::with_halves) adds.
    pub fn values(&self) -> usize {
        self.coefficients() * if self.has_halves { 2 } else { 1 }
    }
}

/// The hash of a bake set's name that its rays' rotations start from: the low 32 bits of its xxh3.
pub fn bake_set_hash(name: &str) -> u32 {
    xxhash_rust::xxh3::xxh3_64(name.as_bytes()) as u32
}

/// A few neighbouring points, or a part of one point's rays.
#[derive(Clone, Debug)]
pub(super) struct Piece {
    /// Points of the batch.
    pub points: Range<usize>,
    /// Samples of each point.
    pub samples: Range<u32>,
}

/// What all rays of a batch have in common, whatever traces them.
#[derive(Debug)]
pub(super) struct Setup {
    /// Origins of the points, in lattice coordinates.
    pub origins: Vec<IVec3>,
    /// The same before they were rounded.
    pub exact: Vec<DVec3>,
    /// Their box.
    pub bounds: LatticeBox,
    /// Steradians that a ray stands for, where that is least.
    pub solid_angle: f32,
    /// A child whose squared diagonal is below this times its squared distance stays closed.
    pub open2: f32,
    /// Hits nearer than this many lattice steps are tested again.
    pub near: f32,
    /// Rays end after this many lattice steps.
    pub reach: f32,
    /// The points that go through the bricks together.
    pub pieces: Vec<Piece>,
}

impl Setup {
    /// Looks at a batch.
    pub fn new(
        points: &[Point],
        shading: &Shading,
        map: &BrickMap,
        options: &TraceOptions,
        meters_per_unit: f64,
    ) -> Self {
        let lattice = map.lattice();
        let origins: Vec<IVec3> =
            points.iter().map(|point| lattice.snap(point.position, shading.shift)).collect();
        let mut bounds = LatticeBox::EMPTY;
        origins.iter().for_each(|&origin| bounds.add(origin));
        // A point without a normal samples the sphere with as many rays: its footprint is larger, the cut is the finer one's
        let has_normals = points.iter().any(|point| point.normal != Vec3::ZERO);
        let solid_angle = Spread::new(&shading.shader, has_normals).measure(shading.shader.samples);
        Self {
            pieces: pieces(&origins, &bounds, shading.shader.samples),
            open2: options.lod.node_open2(solid_angle),
            near: (NEAR_METERS / (meters_per_unit * lattice.step())) as f32,
            reach: shading.shader.max_distance.map_or(f32::INFINITY, |d| (d / lattice.step()) as f32),
            exact: points.iter().map(|point| lattice.exact(point.position)).collect(),
            origins,
            bounds,
            solid_angle,
        }
    }
}

/// A batch whose cut is selected, and loaded as far as it fits.
#[derive(Debug)]
pub(super) struct Prepared {
    /// The batch.
    pub setup: Setup,
    /// Its cut.
    pub cut: Cut,
    /// Whether all of the cut is in memory.
    pub is_resident: bool,
    /// Seconds that it took.
    pub seconds: f64,
}

impl Prepared {
    /// Selects and loads the cut of a batch.
    ///
    /// # Errors
    /// When bricks cannot be read.
    pub fn new(
        points: &[Point],
        shading: &Shading,
        arena: &mut Arena,
        options: &TraceOptions,
        meters_per_unit: f64,
    ) -> Result<Self> {
        let start = std::time::Instant::now();
        let setup = Setup::new(points, shading, arena.map(), options, meters_per_unit);
        let mut cut = Cut::default();
        let is_resident = select::select(arena, &setup.bounds, options.lod, setup.solid_angle, &mut cut)?;
        let seconds = start.elapsed().as_secs_f64();
        Ok(Self { setup, cut, is_resident, seconds })
    }
}

/// Cuts a batch into bundles: neighbours on the curve, as long as they lie close together.
fn pieces(origins: &[IVec3], bounds: &LatticeBox, samples: u32) -> Vec<Piece> {
    let mut pieces = Vec::new();
    if samples as usize > RAYS_MAX {
        for point in 0..origins.len() {
            for first in (0..samples).step_by(RAYS_MAX) {
                let samples = first..samples.min(first + RAYS_MAX as u32);
                pieces.push(Piece { points: point..point + 1, samples });
            }
        }
        return pieces;
    }
    // On a surface, neighbours are about this far apart
    let diagonal = (bounds.max - bounds.min).as_dvec3().length();
    let spacing = diagonal / (origins.len() as f64).sqrt();
    let near2 = (6.0 * spacing) * (6.0 * spacing);
    let points_max = BUNDLE_POINTS.min(RAYS_MAX / samples as usize);
    let mut start = 0;
    for point in 1..=origins.len() {
        let full = point == origins.len() || point - start == points_max || {
            let apart = (origins[point] - origins[start]).as_dvec3();
            apart.length_squared() > near2
        };
        if full {
            pieces.push(Piece { points: start..point, samples: 0..samples });
            start = point;
        }
    }
    pieces
}
