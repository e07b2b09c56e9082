//! The square of the world that a stream shows, fitted to the number of micropolygons asked for.

use super::hilbert;
use super::noise::Rng;
use super::plant::{Plan, Site, Species};
use super::scatter::Scatter;
use super::terrain::{Ground, PATCH_QUADS, PatchRange};
use crate::math::hash::combine;
use crate::scene::ProceduralKind;

/// What grows where, without end.
#[derive(Clone, Debug)]
pub struct World {
    /// What it is.
    pub kind: ProceduralKind,
    /// Its seed.
    pub seed: u32,
    /// The ground.
    pub ground: Ground,
    /// The plants.
    pub scatter: Scatter,
}

/// A square of `side` by `side` quads of ground around the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Quads along a side.
    pub side: i32,
    quad_meters: f32,
}

impl Extent {
    /// A square of `side` quads of `quad_meters`.
    pub fn new(side: i32, quad_meters: f32) -> Self {
        Self { side, quad_meters }
    }

    /// First vertex on either axis.
    fn low(&self) -> i32 {
        -(self.side / 2)
    }

    /// First patch on either axis, and how many there are.
    fn patches(&self) -> (i32, i32) {
        let first = self.low().div_euclid(PATCH_QUADS);
        (first, (self.low() + self.side - 1).div_euclid(PATCH_QUADS) - first + 1)
    }

    /// Order of the Hilbert curve that covers all patches.
    fn order(&self) -> u32 {
        (self.patches().1 as u32).next_power_of_two().ilog2()
    }

    /// The patch `x`, `z` from the first one, cut to the square.
    fn patch(&self, [x, z]: [u32; 2]) -> Option<PatchRange> {
        let (first, count) = self.patches();
        let (low, high) = (self.low(), self.low() + self.side);
        if x >= count as u32 || z >= count as u32 {
            return None;
        }
        let span = |cell: u32| {
            let from = (first + cell as i32) * PATCH_QUADS;
            (from.max(low), (from + PATCH_QUADS).min(high))
        };
        let ((x0, x1), (z0, z1)) = (span(x), span(z));
        Some(PatchRange { first: [x0, z0], quads: [x1 - x0, z1 - z0] })
    }

    /// The next patch along the curve from `place` on, which moves behind it.
    pub fn next_patch(&self, place: &mut u64) -> Option<PatchRange> {
        let order = self.order();
        while *place < 1 << (2 * order) {
            let cell = hilbert::cell(order, *place);
            *place += 1;
            if let Some(range) = self.patch(cell) {
                return Some(range);
            }
        }
        None
    }

    /// The part of the curve before `place`, from 0 to 1.
    pub fn progress(&self, place: u64) -> f64 {
        place as f64 / (1u64 << (2 * self.order())) as f64
    }

    /// Low and high corner of a patch in metres.
    pub fn rectangle(&self, range: &PatchRange) -> [[f32; 2]; 2] {
        let low = [0, 1].map(|axis| range.first[axis] as f32 * self.quad_meters);
        let high = [0, 1].map(|axis| (range.first[axis] + range.quads[axis]) as f32 * self.quad_meters);
        [low, high]
    }

    /// Half a side in metres.
    fn half_meters(&self) -> f32 {
        0.5 * self.side as f32 * self.quad_meters
    }
}

/// Patches looked at to estimate a square's quads.
const SAMPLES: u32 = 2048;

/// Squares of at most this many patches are counted plant by plant.
const EXACT_PATCHES: i64 = 2048;

/// The world of `kind` and the square of it that holds about `count` quads.
pub fn fit(kind: ProceduralKind, seed: u32, count: u64) -> (World, Extent) {
    if kind == ProceduralKind::Terrain {
        let side = (count as f64).sqrt().round().max(1.0) as i32;
        return world(kind, seed, side, count, &[0.0; Species::ALL.len()]);
    }
    let mean_quads = mean_quads(kind, seed);
    // Quads grow with the side, nearly without exception, and the ground alone has no more than all: bisect.
    let (mut low, mut high) = (0i64, (count as f64).sqrt().round().max(1.0) as i64);
    while high - low > 1 {
        let middle = (low + high) / 2;
        let (world, extent) = world(kind, seed, middle as i32, count, &mean_quads);
        let [fixed, adjustable] = estimate(&world, &extent);
        if fixed + adjustable < count as f64 {
            low = middle;
        } else {
            high = middle;
        }
    }
    let (mut world, extent) = world(kind, seed, high as i32, count, &mean_quads);
    adjust(&mut world, &extent, count);
    (world, extent)
}

fn world(
    kind: ProceduralKind,
    seed: u32,
    side: i32,
    count: u64,
    mean_quads: &[f64; Species::ALL.len()],
) -> (World, Extent) {
    let quad_meters = Ground::new(kind, seed, 0.0).quad_meters;
    let extent = Extent::new(side, quad_meters);
    let mut scatter = Scatter::new(kind, seed, extent.half_meters(), *mean_quads);
    // No plant makes up more than a twentieth of the stream; a tuft of grass may make up an eighth.
    scatter.plant_quads_max = (count as f64 / 20.0).max((count as f64 / 8.0).min(120.0));
    let ground = Ground::new(kind, seed, scatter.clearing);
    (World { kind, seed, ground, scatter }, extent)
}

/// Mean quads of the species, from a few plants of each.
pub fn mean_quads(kind: ProceduralKind, seed: u32) -> [f64; Species::ALL.len()] {
    const PLANTS: u32 = 24;
    let mut plan = Plan::default();
    debug_assert!(kind != ProceduralKind::Terrain);
    Species::ALL.map(|species| {
        let mut sum = 0;
        for number in 0..PLANTS {
            let site = Site { species, seed: combine(seed ^ 0x3ea7, number), scale: 1.0, x: 0.0, z: 0.0 };
            plan.grow(&site, [0.0; 2]);
            sum += plan.quads();
        }
        sum as f64 / f64::from(PLANTS)
    })
}

/// Quads to be expected in the square: fixed (the ground and the tall storeys) and adjustable.
fn estimate(world: &World, extent: &Extent) -> [f64; 2] {
    let patches = i64::from(extent.patches().1).pow(2);
    let mut sum = [0.0; 2];
    let mut add = |cell: [u32; 2]| {
        let range = extent.patch(cell).expect("a cell inside the square");
        let [low, high] = extent.rectangle(&range);
        let expected = world.scatter.expected_quads(low, high);
        sum[0] += expected[0];
        sum[1] += expected[1];
    };
    let side = extent.patches().1 as u32;
    if patches <= i64::from(SAMPLES) {
        (0..side).for_each(|z| (0..side).for_each(|x| add([x, z])));
    } else {
        // The clearing is small in a square of so many patches: a random sample will do.
        let mut rng = Rng::new(world.seed ^ 0x5a3b);
        let pick = |bits: u32| ((u64::from(bits) * u64::from(side)) >> 32) as u32;
        (0..SAMPLES).for_each(|_| add([pick(rng.bits()), pick(rng.bits())]));
        sum = sum.map(|quads| quads * patches as f64 / f64::from(SAMPLES));
    }
    [sum[0] + f64::from(extent.side).powi(2), sum[1]]
}

/// Thins or thickens the lower storeys until the square holds `count` quads.
fn adjust(world: &mut World, extent: &Extent, count: u64) {
    let [fixed, adjustable] = estimate(world, extent);
    if adjustable <= 0.0 {
        return;
    }
    let wanted = count as f64;
    world.scatter.density = (((wanted - fixed) / adjustable) as f32).clamp(0.0, 4.0);
    if i64::from(extent.patches().1).pow(2) > EXACT_PATCHES {
        return;
    }
    // Few plants stray from their mean: count them, and correct by what is missing.
    for _ in 0..8 {
        let missing = wanted - exact(world, extent) as f64;
        if missing.abs() < 0.01 * wanted {
            return;
        }
        let density = f64::from(world.scatter.density) + missing / adjustable;
        world.scatter.density = (density as f32).clamp(0.0, 4.0);
    }
}

/// Quads of the square, plant by plant.
pub fn exact(world: &World, extent: &Extent) -> u64 {
    let (mut plan, mut sites, mut place) = (Plan::default(), Vec::new(), 0);
    let mut sum = 0;
    while let Some(range) = extent.next_patch(&mut place) {
        sum += range.quads[0] as u64 * range.quads[1] as u64;
        let [low, high] = extent.rectangle(&range);
        world.scatter.plants(low, high, &mut sites);
        for site in &sites {
            plan.grow(site, [0.0; 2]);
            sum += plan.quads();
        }
    }
    sum
}
