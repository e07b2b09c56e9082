//! The plants: every species, how far it reaches, and the plan of parts that a seed grows into.

use glam::Vec3;

use super::leaf::{BigLeaf, Leaflets, Sprig, Tuft};
use super::noise::Rng;
use super::pen::{Pen, Topology};
use super::wood::{Stone, Tube};
use super::{frond, herb, tree};

/// Everything that stands on the ground.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Species {
    /// A tall tree with buttresses, limbs, sprigs of leaves and lianas.
    Giant,
    /// A slender tree of the second storey.
    Sapling,
    /// A palm: ringed trunk, arching fronds of narrow leaflets.
    Palm,
    /// A tree fern: dark trunk, fronds twice divided.
    TreeFern,
    /// A banana: large paddles with waved, torn margins.
    Banana,
    /// An elephant's ear: heart-shaped leaves on long stalks.
    ElephantEar,
    /// A split-leaf philodendron.
    SplitLeaf,
    /// A fern of the forest floor.
    Fern,
    /// A shrub of many small leaves.
    Shrub,
    /// A low herb: a rosette of round leaves.
    Rosette,
    /// A tuft of grass.
    Grass,
    /// A tuft of tall meadow grass with seed heads.
    TallGrass,
    /// A meadow flower.
    Flower,
    /// Fallen leaves.
    Litter,
    /// A fallen trunk.
    Log,
    /// A cut-faced stone, closed.
    Stone,
    /// A few mushrooms.
    Mushrooms,
}

impl Species {
    /// All of them.
    pub const ALL: [Self; 17] = [
        Self::Giant,
        Self::Sapling,
        Self::Palm,
        Self::TreeFern,
        Self::Banana,
        Self::ElephantEar,
        Self::SplitLeaf,
        Self::Fern,
        Self::Shrub,
        Self::Rosette,
        Self::Grass,
        Self::TallGrass,
        Self::Flower,
        Self::Litter,
        Self::Log,
        Self::Stone,
        Self::Mushrooms,
    ];

    /// How far in metres the plant reaches from its foot at eye height, at its full size.
    pub fn reach(self) -> f32 {
        match self {
            Self::Giant => 1.8,
            Self::Sapling => 2.2,
            Self::Palm => 3.4,
            Self::TreeFern => 2.4,
            Self::Banana => 2.4,
            Self::ElephantEar | Self::SplitLeaf => 1.1,
            Self::Fern | Self::Shrub => 1.1,
            Self::Log => 2.4,
            Self::Rosette | Self::Stone => 0.3,
            Self::Grass | Self::TallGrass | Self::Flower | Self::Litter | Self::Mushrooms => 0.0,
        }
    }
}

/// A plant's place.
#[derive(Clone, Copy, Debug)]
pub struct Site {
    /// What grows there.
    pub species: Species,
    /// The plant's own seed.
    pub seed: u32,
    /// Its size, 1 for a grown plant.
    pub scale: f32,
    /// Where it stands, metres.
    pub x: f32,
    /// Where it stands, metres.
    pub z: f32,
}

/// What a part of a plant looks like.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// Leaves around a twig.
    Sprig(Sprig),
    /// Blades from the ground.
    Tuft(Tuft),
    /// Leaflets of a frond.
    Leaflets(Leaflets),
    /// A piece of a large leaf.
    BigLeaf(BigLeaf),
    /// A stem or branch.
    Tube(Tube),
    /// A side of a stone.
    Stone(Stone),
    /// Leaves lying on the ground.
    Litter(herb::Litter),
}

/// One grid of a plant.
#[derive(Clone, Copy, Debug)]
pub struct Part {
    /// Its form, in metres from the plant's foot.
    pub shape: Shape,
    /// Diffuse reflectance, linear RGB.
    pub albedo: Vec3,
}

impl Part {
    /// Draws the part and says how its vertices connect.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        pen.start();
        match &self.shape {
            Shape::Sprig(shape) => shape.draw(pen),
            Shape::Tuft(shape) => shape.draw(pen),
            Shape::Leaflets(shape) => shape.draw(pen),
            Shape::BigLeaf(shape) => shape.draw(pen),
            Shape::Tube(shape) => shape.draw(pen),
            Shape::Stone(shape) => shape.draw(pen),
            Shape::Litter(shape) => shape.draw(pen),
        }
    }

    /// Quads it will have, without drawing it.
    pub fn quads(&self) -> u64 {
        let quads = match &self.shape {
            Shape::Sprig(shape) => shape.blade.pack(shape.leaves).quads(),
            Shape::Tuft(shape) => shape.blade.pack(shape.blades).quads(),
            Shape::Leaflets(shape) => shape.blade.pack(2 * shape.pairs).quads(),
            Shape::BigLeaf(shape) => shape.quads[0] * shape.quads[1],
            Shape::Tube(shape) => shape.quads[0] * shape.quads[1],
            Shape::Stone(shape) => shape.quads * shape.quads,
            Shape::Litter(shape) => shape.blade.pack(shape.leaves).quads(),
        };
        u64::from(quads)
    }
}

/// Parts of a plant at most; the largest tree stays below (tested). Bounds the stream's memory.
pub const PARTS_MAX: usize = 4096;

/// The parts of one plant, in the order they are drawn. Keeps its memory from plant to plant.
#[derive(Clone, Debug, Default)]
pub struct Plan {
    /// The parts.
    pub parts: Vec<Part>,
}

impl Plan {
    /// Plans the plant of `site` on ground that rises by `slope` (metres per metre in x and z).
    pub fn grow(&mut self, site: &Site, slope: [f32; 2]) {
        self.parts.clear();
        let (mut rng, scale) = (Rng::new(site.seed), site.scale);
        match site.species {
            Species::Giant => tree::plan(self, &mut rng, &tree::GIANT, scale),
            Species::Sapling => tree::plan(self, &mut rng, &tree::SAPLING, scale),
            Species::Palm => frond::palm(self, &mut rng, scale),
            Species::TreeFern => frond::tree_fern(self, &mut rng, scale),
            Species::Fern => frond::fern(self, &mut rng, scale),
            Species::Banana => herb::banana(self, &mut rng, scale),
            Species::ElephantEar => herb::stalked(self, &mut rng, scale, &herb::ELEPHANT_EAR),
            Species::SplitLeaf => herb::stalked(self, &mut rng, scale, &herb::SPLIT_LEAF),
            Species::Shrub => herb::shrub(self, &mut rng, scale),
            Species::Rosette => herb::rosette(self, &mut rng, scale),
            Species::Grass => herb::grass(self, &mut rng, scale),
            Species::TallGrass => herb::tall_grass(self, &mut rng, scale),
            Species::Flower => herb::flower(self, &mut rng, scale),
            Species::Litter => herb::litter(self, &mut rng, scale, slope),
            Species::Log => tree::log(self, &mut rng, scale, slope),
            Species::Stone => herb::stone(self, &mut rng, scale),
            Species::Mushrooms => herb::mushrooms(self, &mut rng, scale),
        }
        debug_assert!(self.parts.len() <= PARTS_MAX);
    }

    /// Quads of the whole plant.
    pub fn quads(&self) -> u64 {
        self.parts.iter().map(Part::quads).sum()
    }

    /// Adds a part.
    pub fn push(&mut self, shape: Shape, albedo: Vec3) {
        self.parts.push(Part { shape, albedo });
    }

    /// Adds a tube.
    pub fn tube(&mut self, tube: Tube, albedo: Vec3) {
        self.push(Shape::Tube(tube), albedo);
    }

    /// Adds a tube too long for one grid, in `pieces`.
    pub fn long_tube(&mut self, tube: Tube, pieces: u32, albedo: Vec3) {
        for piece in 0..pieces {
            let span = [piece as f32 / pieces as f32, (piece + 1) as f32 / pieces as f32];
            self.tube(Tube { span, ..tube }, albedo);
        }
    }
}

/// A colour near `base`: lighter or darker by up to `amount`, and warmer or cooler by a third of that.
pub fn tint(base: Vec3, rng: &mut Rng, amount: f32) -> Vec3 {
    let light = 1.0 + amount * rng.signed();
    let warm = 0.35 * amount * rng.signed();
    (base * light * Vec3::new(1.0 + warm, 1.0 + 0.25 * warm, 1.0 - warm))
        .clamp(Vec3::splat(0.005), Vec3::splat(0.95))
}
