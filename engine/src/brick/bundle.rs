//! A bundle: all rays of one or a few neighbouring points, which pass through the bricks together.
//!
//! Rays are known by 16-bit numbers. Everything is in lattice steps relative to the bundle's reference point, so
//! that single precision is exact where it matters: near the origins. Inside an [instance] the same
//! numbers stand for the same rays on the prototype's lattice ([`Inside`]).

use glam::{DVec3, IVec3, Vec3};

use super::instance::{self, Instance};

/// Rays of a bundle at most.
pub const RAYS_MAX: usize = 16384;
/// Points of a bundle at most.
pub const POINTS_MAX: usize = 32;

/// What a box test reads of a ray. Rays are looked up by number all the time: the smaller, the more of them are near.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(16))]
pub struct BoxRay {
    /// Reciprocal direction.
    pub inverse: [f32; 3],
    /// Number of the origin.
    pub origin: u32,
}

impl BoxRay {
    /// The ray along `direction` from the origin of the given number.
    #[inline(always)]
    fn new(origin: usize, direction: Vec3) -> Self {
        // A component of zero would make 0 * infinity; a tiny one is as good
        let inverse =
            direction.to_array().map(|d| 1.0 / if d.abs() < 1e-18 { 1e-18_f32.copysign(d) } else { d });
        Self { inverse, origin: origin as u32 }
    }
}

/// A bundle's origins relative to its reference, per axis: the other thing that a box test reads.
pub type BoxOrigins = [[f32; POINTS_MAX]; 3];

/// Notes origin `number`, which lies at `relative` from the reference.
#[inline(always)]
fn place_origin(origins: &mut BoxOrigins, number: usize, relative: Vec3) {
    for (origins, coordinate) in origins.iter_mut().zip(relative.to_array()) {
        origins[number] = coordinate;
    }
}

/// One origin of a bundle and its range of rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Origin {
    /// Lattice coordinates.
    pub position: IVec3,
    /// The same before they were rounded: what a prototype's own lattice rounds.
    pub exact: DVec3,
    /// First ray.
    pub first: u16,
    /// One past the last ray.
    pub end: u16,
}

/// The rays of a few neighbouring points.
#[derive(Debug)]
pub struct Bundle {
    /// What everything is relative to: the first origin, in lattice coordinates.
    pub reference: IVec3,
    /// The origins, in the order of their rays.
    pub origins: Vec<Origin>,
    /// Box of the origins, relative to the reference.
    pub bounds: [Vec3; 2],
    /// For box tests.
    pub box_rays: Vec<BoxRay>,
    /// Likewise.
    pub box_origins: BoxOrigins,
    /// Directions; the fourth component is 0. Unit vectors, but not inside an instance.
    pub directions: Vec<[f32; 4]>,
    /// Extinction met so far.
    pub extinction: Vec<u32>,
    /// A ray ends when its extinction passes this.
    pub limit: Vec<u32>,
    /// Bit i: ray i has not ended.
    pub alive: [u32; RAYS_MAX / 32],
    /// Rays end after this many times their direction; infinite if nothing limits them.
    pub reach: f32,
    /// Hits nearer than this many times the direction are tested again in double precision.
    pub near: f32,
    /// No direction is longer than this many steps; 1 but inside an instance.
    pub stretch: f32,
}

/// What is different about a bundle's rays inside an instance; outside, what they are to come back to.
#[derive(Debug)]
pub struct Inside {
    reference: IVec3,
    origins: Vec<Origin>,
    bounds: [Vec3; 2],
    box_rays: Vec<BoxRay>,
    box_origins: BoxOrigins,
    directions: Vec<[f32; 4]>,
    reach: f32,
    near: f32,
    stretch: f32,
}

/// Extinction that no limit reaches: what an opaque face adds.
pub const EXTINCTION_OPAQUE: u32 = 1 << 24;

impl Bundle {
    /// An empty bundle with memory for [`RAYS_MAX`] rays.
    pub fn new() -> Self {
        Self {
            reference: IVec3::ZERO,
            origins: Vec::with_capacity(POINTS_MAX),
            bounds: [Vec3::ZERO; 2],
            box_rays: Vec::with_capacity(RAYS_MAX),
            box_origins: [[0.0; POINTS_MAX]; 3],
            directions: Vec::with_capacity(RAYS_MAX),
            extinction: Vec::with_capacity(RAYS_MAX),
            limit: Vec::with_capacity(RAYS_MAX),
            alive: [0; RAYS_MAX / 32],
            reach: f32::INFINITY,
            near: 0.0,
            stretch: 1.0,
        }
    }

    /// Empties the bundle and sets what its rays have in common.
    pub fn clear(&mut self, reach: f32, near: f32) {
        self.origins.clear();
        self.box_rays.clear();
        self.directions.clear();
        self.extinction.clear();
        self.limit.clear();
        self.alive = [0; RAYS_MAX / 32];
        (self.reach, self.near) = (reach, near);
    }

    /// Rays.
    pub fn len(&self) -> usize {
        self.directions.len()
    }

    /// Whether there are no rays.
    pub fn is_empty(&self) -> bool {
        self.directions.is_empty()
    }

    /// Starts a new origin on the lattice; rays pushed from now on belong to it.
    pub fn push_origin(&mut self, position: IVec3) {
        self.push_rounded_origin(position, position.as_dvec3());
    }

    /// Starts a new origin that was rounded to `position` from `exact`, both in lattice coordinates.
    pub fn push_rounded_origin(&mut self, position: IVec3, exact: DVec3) {
        if self.origins.is_empty() {
            self.reference = position;
            self.bounds = [Vec3::ZERO; 2];
        }
        let relative = (position - self.reference).as_vec3();
        self.bounds = [self.bounds[0].min(relative), self.bounds[1].max(relative)];
        place_origin(&mut self.box_origins, self.origins.len(), relative);
        let first = self.len() as u16;
        self.origins.push(Origin { position, exact, first, end: first });
    }

    /// Adds a ray of the newest origin. `limit` is the extinction at which it ends.
    #[inline(always)]
    pub fn push_ray(&mut self, direction: Vec3, limit: u32) {
        let ray = self.len();
        debug_assert!(ray < RAYS_MAX);
        let number = self.origins.len().wrapping_sub(1);
        let Some(origin) = self.origins.last_mut() else { return };
        self.box_rays.push(BoxRay::new(number, direction));
        self.directions.push([direction.x, direction.y, direction.z, 0.0]);
        self.extinction.push(0);
        self.limit.push(limit);
        self.alive[ray / 32] |= 1 << (ray % 32);
        origin.end = ray as u16 + 1;
    }

    /// Adds extinction to a ray. Whether that passes its limit.
    #[inline(always)]
    pub fn add(&mut self, ray: u16, extinction: u32) -> bool {
        let ray = usize::from(ray);
        let total = self.extinction[ray].saturating_add(extinction);
        self.extinction[ray] = total;
        total > self.limit[ray]
    }

    /// Adds extinction to a ray and ends it if that passes its limit. Whether it lives on.
    #[inline(always)]
    pub fn extinguish(&mut self, ray: u16, extinction: u32) -> bool {
        let ends = self.add(ray, extinction);
        if ends {
            self.alive[usize::from(ray) / 32] &= !(1 << (ray % 32));
        }
        !ends
    }

    /// Whether a ray has not ended.
    #[inline(always)]
    pub fn is_alive(&self, ray: u16) -> bool {
        self.alive[usize::from(ray) / 32] >> (ray % 32) & 1 != 0
    }
}

impl Inside {
    /// Memory for [`RAYS_MAX`] rays.
    pub fn new() -> Self {
        Self {
            reference: IVec3::ZERO,
            origins: Vec::with_capacity(POINTS_MAX),
            bounds: [Vec3::ZERO; 2],
            box_rays: vec![BoxRay::default(); RAYS_MAX],
            box_origins: [[0.0; POINTS_MAX]; 3],
            directions: vec![[0.0; 4]; RAYS_MAX],
            reach: f32::INFINITY,
            near: 0.0,
            stretch: 1.0,
        }
    }

    /// Takes the rays numbered `rays`, ascending, of a bundle that is not inside an instance into one whose decoded box has the
    /// lower corner `corner`. They get there by [`swap`](Self::swap). Operations have one order and are not fused.
    #[inline(always)]
    pub fn place(&mut self, bundle: &Bundle, rays: &[u16], instance: &Instance, corner: IVec3) {
        self.origins.clear();
        self.bounds = [Vec3::ZERO; 2];
        let corner = corner.as_dvec3();
        let [x, y, z] = instance.directions();
        let mut at = 0;
        for origin in &bundle.origins {
            // A vertex that was placed in the map comes back to its own integers here
            let exact = instance.point(origin.exact - corner);
            let position = instance::round(exact);
            if self.origins.is_empty() {
                self.reference = position;
            }
            let relative = position.wrapping_sub(self.reference).as_vec3();
            self.bounds = [self.bounds[0].min(relative), self.bounds[1].max(relative)];
            let number = self.origins.len();
            place_origin(&mut self.box_origins, number, relative);
            self.origins.push(Origin { position, exact, ..*origin });
            while at < rays.len() && rays[at] < origin.end {
                let ray = usize::from(rays[at]);
                let [dx, dy, dz, _] = bundle.directions[ray];
                let direction = (x * dx + y * dy) + z * dz;
                self.box_rays[ray] = BoxRay::new(number, direction);
                self.directions[ray] = [direction.x, direction.y, direction.z, 0.0];
                at += 1;
            }
        }
        let scale = instance.ray_scale();
        (self.reach, self.near) = (bundle.reach * scale, bundle.near * scale);
        // Never less than the largest stretch
        let squares = (x.length_squared() + y.length_squared()) + z.length_squared();
        self.stretch = 1.000_01 * squares.sqrt();
    }

    /// Takes a bundle's rays in or out. What has become of them stays with the bundle.
    #[inline(always)]
    pub fn swap(&mut self, bundle: &mut Bundle) {
        std::mem::swap(&mut self.reference, &mut bundle.reference);
        std::mem::swap(&mut self.origins, &mut bundle.origins);
        std::mem::swap(&mut self.bounds, &mut bundle.bounds);
        std::mem::swap(&mut self.box_rays, &mut bundle.box_rays);
        std::mem::swap(&mut self.box_origins, &mut bundle.box_origins);
        std::mem::swap(&mut self.directions, &mut bundle.directions);
        std::mem::swap(&mut self.reach, &mut bundle.reach);
        std::mem::swap(&mut self.near, &mut bundle.near);
        std::mem::swap(&mut self.stretch, &mut bundle.stretch);
    }
}

impl Default for Inside {
    fn default() -> Self {
        Self::new()
    }
}

impl Default for Bundle {
    fn default() -> Self {
        Self::new()
    }
}
