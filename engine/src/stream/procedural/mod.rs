//! Procedural streams: a jungle around a clearing, a meadow, bare ground (`docs/procedural.md`).
//!
//! The generator plans a world without end from hashes of whole numbers ([`terrain`], [`scatter`]) and shows a square
//! of it, patch by patch in Hilbert order. A plant is first planned as a list of parts ([`plant`], [`tree`], [`frond`],
//! [`herb`]); each part is then drawn into one microgrid ([`leaf`], [`wood`], [`pen`]). Only the current patch and the
//! current plan are held, whatever the stream's size. All arithmetic is IEEE additions, products, quotients and square
//! roots, so the bytes are the same on every machine.

mod extent;
mod frond;
mod herb;
mod hilbert;
mod leaf;
mod noise;
mod pen;
mod plant;
mod scatter;
mod terrain;
mod tree;
mod trig;
mod wood;

#[cfg(test)]
mod tests;

use std::ops::Range;
use std::sync::Arc;

use glam::{DMat4, DVec3, Vec3};

use crate::math::hash::combine;
use crate::scene::{Procedural, ProceduralKind};
use crate::stream::piece::PIECE_VERTICES;
use crate::stream::schema::{Schema, UpAxis};
use crate::stream::{Microgrid, MicrogridStream, Piece};
use crate::{Error, Result};

use extent::{Extent, World};
use noise::noise;
use pen::{Paint, Pen, Space};
use plant::{Part, Plan, Site};
use terrain::{Patch, PatchRange};

/// Micropolygons that can be asked for at most.
pub const MICROPOLYGONS_MAX: u64 = 1_000_000_000_000;

/// A procedural stream: deterministic by seed, of any size, in constant memory.
///
/// Grids carry `N` (f32 × 3 per vertex, unit), `albedo` (f16 × 3 per grid, linear) and `id` (u32 per grid: 0 for the
/// ground, then the plants' numbers in stream order). Faces are quads, counter-clockwise seen from where `N` points.
#[derive(Clone, Debug)]
pub struct ProceduralStream {
    schema: Schema,
    extent: Extent,
    /// The next place on the Hilbert curve over all patches.
    place: u64,
    artist: Artist,
    /// Plants in the pieces so far.
    plants: u32,
}

/// Draws one patch after the other: the ground, then plant by plant, part by part.
#[derive(Clone, Debug)]
struct Artist {
    space: Space,
    world: Arc<World>,
    patch: Patch,
    /// Plants of the patch, and the next one to plan.
    sites: Vec<Site>,
    site: usize,
    /// Parts of the plant, and the next one to draw.
    plan: Plan,
    part: usize,
    /// Foot of the plant in metres.
    foot: DVec3,
    /// Plants so far.
    plants: u32,
    pen: Pen,
}

/// Patches of a procedural stream that have not been drawn yet.
struct PatchPiece {
    space: Space,
    world: Arc<World>,
    /// Each with its plants among `sites`.
    patches: Vec<(PatchRange, Range<usize>)>,
    sites: Vec<Site>,
    /// Plants before the first patch.
    plants: u32,
}

impl Piece for PatchPiece {
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        let mut artist = Artist::new(self.space, self.world);
        artist.plants = self.plants;
        for (range, sites) in self.patches {
            artist.sites.clear();
            artist.sites.extend_from_slice(&self.sites[sites]);
            artist.draw_ground(range, grid);
            each(grid)?;
            while artist.draw_part(grid) {
                each(grid)?;
            }
        }
        Ok(())
    }
}

impl ProceduralStream {
    /// A stream of about `parameters.micropolygons` (see `docs/procedural.md` for how near), in a scene of
    /// `meters_per_unit` whose `up` axis points up.
    ///
    /// Takes up to about a second for large jungles: the square's size is fitted to the count.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when the count is 0 or above [`MICROPOLYGONS_MAX`], or the
    /// unit is not a positive number.
    pub fn new(parameters: &Procedural, meters_per_unit: f64, up: UpAxis) -> Result<Self> {
        let schema = pen::schema(meters_per_unit, up);
        schema.validate()?;
        let (world, extent) = fit(parameters)?;
        let artist = Artist::new(Space::new(meters_per_unit, up), Arc::new(world));
        Ok(Self { schema, extent, place: 0, artist, plants: 0 })
    }
}

impl Artist {
    fn new(space: Space, world: Arc<World>) -> Self {
        Self {
            space,
            world,
            patch: Patch::default(),
            sites: Vec::new(),
            site: 0,
            plan: Plan::default(),
            part: 0,
            foot: DVec3::ZERO,
            plants: 0,
            pen: Pen::default(),
        }
    }

    /// Goes to a patch whose plants are in `sites`, and draws its ground.
    fn draw_ground(&mut self, range: PatchRange, grid: &mut Microgrid) {
        self.world.ground.patch(range, &mut self.patch);
        self.site = 0;
        self.pen.start();
        let topology = self.patch.draw(&mut self.pen);
        let paint = Paint { albedo: ground_albedo(&self.world, &self.patch), id: 0 };
        self.pen.finish(grid, &self.space, self.patch.anchor(), topology, &paint);
    }

    /// Draws the next part of the patch's plants. False if there is none.
    fn draw_part(&mut self, grid: &mut Microgrid) -> bool {
        while self.part == self.plan.parts.len() {
            if !self.plan_plant() {
                return false;
            }
        }
        let part = &self.plan.parts[self.part];
        self.part += 1;
        let topology = Part::draw(part, &mut self.pen);
        let paint = Paint { albedo: part.albedo, id: self.plants };
        self.pen.finish(grid, &self.space, self.foot, topology, &paint);
        true
    }

    /// Plans the next plant of the patch. False if there is none.
    fn plan_plant(&mut self) -> bool {
        let Some(site) = self.sites.get(self.site) else { return false };
        self.site += 1;
        self.part = 0;
        self.plants = self.plants.wrapping_add(1);
        let height = self.patch.height(site.x, site.z);
        let slope = [
            (self.patch.height(site.x + 0.05, site.z) - height) * 20.0,
            (self.patch.height(site.x, site.z + 0.05) - height) * 20.0,
        ];
        self.foot = Vec3::new(site.x, height, site.z).as_dvec3();
        self.plan.grow(site, slope);
        true
    }
}

impl MicrogridStream for ProceduralStream {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        (self.place, self.plants) = (0, 0);
        self.artist.plants = 0;
        (self.artist.site, self.artist.part) = (0, 0);
        self.artist.sites.clear();
        self.artist.plan.parts.clear();
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        if self.artist.draw_part(grid) {
            return Ok(true);
        }
        let Some(range) = self.extent.next_patch(&mut self.place) else { return Ok(false) };
        let [low, high] = self.extent.rectangle(&range);
        self.artist.world.scatter.plants(low, high, &mut self.artist.sites);
        self.artist.draw_ground(range, grid);
        Ok(true)
    }

    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        let Artist { space, world, .. } = &self.artist;
        let mut piece = PatchPiece {
            space: *space,
            world: world.clone(),
            patches: Vec::new(),
            sites: Vec::new(),
            plants: self.plants,
        };
        let (mut vertices, mut sites) = (0.0, Vec::new());
        while vertices < PIECE_VERTICES as f64 {
            let Some(range) = self.extent.next_patch(&mut self.place) else { break };
            let [low, high] = self.extent.rectangle(&range);
            world.scatter.plants(low, high, &mut sites);
            let quads = sites.iter().map(|site| world.scatter.mean_quads[site.species as usize]);
            vertices += 256.0 + quads.sum::<f64>();
            let first = piece.sites.len();
            piece.sites.append(&mut sites);
            piece.patches.push((range, first..piece.sites.len()));
        }
        self.plants = self.plants.wrapping_add(piece.sites.len() as u32);
        Ok((!piece.patches.is_empty()).then(|| Box::new(piece) as Box<dyn Piece>))
    }

    fn progress(&self) -> f64 {
        self.extent.progress(self.place)
    }
}

/// Where a camera for this stream should stand: world from camera (looking along its -z, +y up in the picture) in
/// scene units, and the vertical field of view in degrees. The ground before it is free of tall plants.
///
/// # Errors
/// As [`ProceduralStream::new`].
pub fn demo_camera(parameters: &Procedural, meters_per_unit: f64, up: UpAxis) -> Result<(DMat4, f64)> {
    pen::schema(meters_per_unit, up).validate()?;
    let (world, _) = fit(parameters)?;
    let stand = world.scatter.stand();
    let at = |[x, z]: [f32; 2], above: f32| Vec3::new(x, world.ground.height(x, z) + above, z).as_dvec3();
    let (eye, target) = (at(stand.foot, stand.eye), at(stand.target, stand.target_height));
    let space = Space::new(meters_per_unit, up);
    let vertical = space.point(DVec3::Y).normalize();
    let eye = space.point(eye);
    let back = (eye - space.point(target)).normalize();
    let right = vertical.cross(back).normalize();
    let columns = [right.extend(0.0), back.cross(right).extend(0.0), back.extend(0.0), eye.extend(1.0)];
    let [x, y, z, w] = columns;
    Ok((DMat4::from_cols(x, y, z, w), stand.fov_degrees))
}

/// The world of the parameters and the square of it that holds the count asked for.
fn fit(parameters: &Procedural) -> Result<(World, Extent)> {
    let count = parameters.micropolygons;
    if count == 0 || count > MICROPOLYGONS_MAX {
        let message = format!("a procedural stream of `{count}` micropolygons");
        return Err(Error::invalid(message).hint(format!("1 to {MICROPOLYGONS_MAX} are possible")));
    }
    let seed = combine(parameters.seed as u32, (parameters.seed >> 32) as u32);
    Ok(extent::fit(parameters.kind, seed, count))
}

/// The colour of the ground around the middle of a patch.
fn ground_albedo(world: &World, patch: &Patch) -> Vec3 {
    let [x, z] = [0, 1].map(|axis| {
        (patch.range.first[axis] as f32 + 0.5 * patch.range.quads[axis] as f32) * world.ground.quad_meters
    });
    let (height, steepness) = patch.lie();
    let drift = noise(world.seed ^ 0x5011, x * 0.031, z * 0.031)
        + 0.5 * noise(world.seed ^ 0x5012, x * 0.12, z * 0.12);
    match world.kind {
        ProceduralKind::Jungle => Vec3::new(0.100, 0.075, 0.046) * (1.0 + 0.4 * drift),
        ProceduralKind::Grass => Vec3::new(0.085, 0.105, 0.036) * (1.0 + 0.4 * drift),
        ProceduralKind::Terrain => {
            let grass = Vec3::new(0.13, 0.155, 0.065).lerp(Vec3::new(0.22, 0.195, 0.10), 0.5 + 0.6 * drift);
            let rock = Vec3::new(0.23, 0.205, 0.175) * (1.0 + 0.2 * drift);
            // A wide band: patches are one colour each, and must not show.
            let bare = noise::smoothstep(0.05, 1.0, 0.55 * steepness + 0.006 * height + 0.12 * drift);
            grass.lerp(rock, bare)
        }
    }
}
