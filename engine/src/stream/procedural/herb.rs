//! The lower storeys: banana, stalked leaves, shrubs, grass, flowers, litter, stones, mushrooms.

use glam::Vec3;

use super::leaf::{BigLeaf, Blade, Frame, GRASS, HEART, LANCE, OVATE, Outline, PADDLE, PETAL, Sprig, Tuft};
use super::noise::Rng;
use super::pen::{Pen, Topology, unit_or};
use super::plant::{Plan, Shape, tint};
use super::trig::{GOLDEN_ANGLE, TURN, sincos};
use super::wood::{Curve, Stone, Taper, Tube};

/// A unit vector at `azimuth` around the vertical, `elevation` above the horizon.
fn direction(azimuth: f32, elevation: f32) -> Vec3 {
    let ((sin, cos), (rise, run)) = (sincos(azimuth), sincos(elevation));
    Vec3::new(cos * run, rise, sin * run)
}

/// Plans a banana: a false stem and paddles of 1.3 to 2.2 m.
pub fn banana(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let stem = scale * rng.range(0.7, 1.8);
    let top = Vec3::new(0.08 * rng.signed(), stem, 0.08 * rng.signed());
    let curve = Curve::between(Vec3::new(0.0, -0.2, 0.0), Vec3::Y * stem, top, Vec3::Y * stem);
    let trunk = Tube {
        bark: 0.06,
        flare: 0.3,
        seed: rng.bits(),
        ..Tube::plain(curve, [0.10 * scale, 0.05 * scale], [12, 12])
    };
    plan.tube(trunk, tint(Vec3::new(0.20, 0.26, 0.10), rng, 0.2));
    let green = tint(Vec3::new(0.15, 0.36, 0.055), rng, 0.2);
    let leaves = rng.count(7, 10);
    let mut azimuth = rng.unit() * TURN;
    for leaf in 0..leaves {
        azimuth += GOLDEN_ANGLE;
        let age = (leaf as f32 + rng.unit()) / leaves as f32;
        let length = scale * rng.range(1.3, 2.1) * (0.8 + 0.2 * age);
        let rise = direction(azimuth, 1.45 - 0.85 * age);
        let stalk_end = top + rise * (0.35 * scale);
        let albedo = tint(green.lerp(Vec3::new(0.28, 0.32, 0.07), 0.4 * age * age), rng, 0.1);
        plan.tube(Tube::plain(Curve::line(top, stalk_end), [0.03 * scale, 0.018 * scale], [6, 4]), albedo);
        let big = BigLeaf {
            frame: Frame::facing(stalk_end, rise, Vec3::Y + rng.vec3() * 0.15),
            blade: Blade {
                outline: &PADDLE,
                length,
                half_width: length * rng.range(0.13, 0.165),
                bend: 0.85 + 0.75 * age,
                fold: 0.54,
                columns: 2,
                rows: 1,
            },
            span: [0.0, 1.0],
            quads: [14, 15],
            ripple: 0.09,
            waves: 40.0 + 14.0 * rng.signed(),
            cuts: 0.10 * age,
            phase: rng.unit() * TURN,
        };
        pieces(plan, big, 4, albedo);
    }
}

/// Adds a big leaf in pieces along its length.
fn pieces(plan: &mut Plan, leaf: BigLeaf, count: u32, albedo: Vec3) {
    for piece in 0..count {
        let span = [piece as f32 / count as f32, (piece + 1) as f32 / count as f32];
        plan.push(Shape::BigLeaf(BigLeaf { span, ..leaf }), albedo);
    }
}

/// A plant of single big leaves on long stalks.
pub struct Stalked {
    leaves: [u32; 2],
    stalk: [f32; 2],
    leaf: [f32; 2],
    /// Half width relative to length.
    width: f32,
    outline: &'static Outline,
    cuts: f32,
    waves: f32,
    green: Vec3,
}

/// Elephant's ear.
pub const ELEPHANT_EAR: Stalked = Stalked {
    leaves: [7, 12],
    stalk: [0.45, 1.0],
    leaf: [0.40, 0.68],
    width: 0.40,
    outline: &HEART,
    cuts: 0.0,
    waves: 16.0,
    green: Vec3::new(0.13, 0.32, 0.06),
};

/// Split-leaf philodendron.
pub const SPLIT_LEAF: Stalked = Stalked {
    leaves: [8, 13],
    stalk: [0.35, 0.8],
    leaf: [0.42, 0.62],
    width: 0.44,
    outline: &OVATE,
    cuts: 0.62,
    waves: 44.0,
    green: Vec3::new(0.075, 0.22, 0.045),
};

/// Plans a plant of stalked leaves.
pub fn stalked(plan: &mut Plan, rng: &mut Rng, scale: f32, form: &Stalked) {
    let green = tint(form.green, rng, 0.2);
    let leaves = rng.count(form.leaves[0], form.leaves[1]);
    let mut azimuth = rng.unit() * TURN;
    for leaf in 0..leaves {
        azimuth += GOLDEN_ANGLE;
        let age = (leaf as f32 + rng.unit()) / leaves as f32;
        let rise = direction(azimuth, 1.4 - 0.7 * age);
        let stalk = scale * rng.range(form.stalk[0], form.stalk[1]);
        let foot = rng.vec3() * Vec3::new(0.05, 0.0, 0.05);
        let top = foot + rise * stalk;
        let out = direction(azimuth, -0.15);
        let curve =
            Curve::between(foot - Vec3::Y * 0.05, rise * stalk * 1.2, top, (rise + out) * (0.4 * stalk));
        let albedo = tint(green, rng, 0.16);
        plan.tube(Tube::plain(curve, [0.014 * scale, 0.008 * scale], [6, 8]), albedo * 0.9);
        // The blade hangs from the stalk's end, its base lobes behind it.
        let length = scale * rng.range(form.leaf[0], form.leaf[1]);
        let forward = direction(azimuth + 0.3 * rng.signed(), -0.25 - 0.45 * age);
        let frame = Frame::facing(top - forward * (0.16 * length), forward, Vec3::Y + rng.vec3() * 0.25);
        let rows = if form.cuts > 0.0 { 2 } else { 1 };
        let big = BigLeaf {
            frame,
            blade: Blade {
                outline: form.outline,
                length,
                half_width: form.width * length,
                bend: 0.6 + 0.5 * rng.unit(),
                fold: 0.44,
                columns: 2,
                rows: 1,
            },
            span: [0.0, 1.0],
            quads: [14, 15],
            ripple: 0.06,
            waves: form.waves,
            cuts: form.cuts,
            phase: rng.unit() * TURN,
        };
        pieces(plan, big, rows, albedo);
    }
}

/// Plans a shrub of 0.6 to 1.6 m.
pub fn shrub(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let height = scale * rng.range(0.7, 1.5);
    let palette = [
        Vec3::new(0.11, 0.25, 0.04),
        Vec3::new(0.20, 0.33, 0.06),
        Vec3::new(0.08, 0.19, 0.05),
        Vec3::new(0.24, 0.22, 0.05),
    ];
    let green = tint(palette[rng.count(0, 3) as usize], rng, 0.2);
    let leaf = scale * rng.range(0.085, 0.15);
    let outline = if rng.unit() < 0.5 { &LANCE } else { &OVATE };
    let stems = rng.count(6, 9);
    let mut azimuth = rng.unit() * TURN;
    for _ in 0..stems {
        azimuth += GOLDEN_ANGLE + 0.3 * rng.signed();
        let out = direction(azimuth, rng.range(0.7, 1.4));
        let to = out * (height * rng.range(0.8, 1.1));
        let curve =
            Curve::between(Vec3::new(0.0, -0.05, 0.0), Vec3::Y * height + out * 0.2, to, out * height);
        plan.tube(Tube::plain(curve, [0.016 * scale, 0.005 * scale], [6, 6]), Vec3::new(0.14, 0.11, 0.07));
        for sprig in 0..6 {
            let at = 0.22 + 0.78 * (sprig as f32 + rng.unit()) / 6.0;
            let axis = unit_or(curve.tangent(at) * 0.5 + rng.vec3() * 0.8 + Vec3::Y * 0.25, Vec3::Y);
            let sprig = Sprig {
                base: curve.point(at),
                axis,
                length: leaf * rng.range(2.0, 3.2),
                leaves: 16,
                blade: Blade {
                    outline,
                    length: leaf,
                    half_width: leaf * 0.27,
                    bend: 0.7,
                    fold: 0.33,
                    columns: 2,
                    rows: 4,
                },
                rise: 0.5,
                level: 0.3,
                seed: rng.bits(),
            };
            plan.push(Shape::Sprig(sprig), tint(green, rng, 0.2));
        }
    }
}

/// Plans a rosette of round leaves, 10 to 25 cm.
pub fn rosette(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let green = tint(Vec3::new(0.14, 0.31, 0.06), rng, 0.3);
    let length = scale * rng.range(0.08, 0.17);
    let tuft = Tuft {
        base: Vec3::ZERO,
        radius: 0.05 * scale,
        blades: rng.count(9, 14),
        blade: Blade {
            outline: &PETAL,
            length,
            half_width: length * 0.34,
            bend: 0.8,
            fold: 0.29,
            columns: 2,
            rows: 4,
        },
        lean: [0.25, 1.25],
        uneven: 0.3,
        seed: rng.bits(),
    };
    plan.push(Shape::Tuft(tuft), green);
}

/// A blade of grass of four quads.
pub fn grass_blade(length: f32, half_width: f32, bend: f32) -> Blade {
    Blade { outline: &GRASS, length, half_width, bend, fold: 0.0, columns: 1, rows: 4 }
}

/// Greens and straws of grass.
fn grass_color(rng: &mut Rng) -> Vec3 {
    let base = Vec3::new(0.15, 0.30, 0.05).lerp(Vec3::new(0.36, 0.33, 0.12), rng.unit() * rng.unit() * 0.9);
    tint(base, rng, 0.22)
}

/// Plans a tuft of short grass.
pub fn grass(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let length = scale * rng.range(0.18, 0.38);
    let tuft = Tuft {
        base: Vec3::new(0.0, -0.01, 0.0),
        radius: scale * 0.13,
        blades: 25,
        blade: grass_blade(length, 0.0052 * (0.6 + 0.4 * scale), 1.1),
        lean: [0.05, 0.75],
        uneven: 0.55,
        seed: rng.bits(),
    };
    plan.push(Shape::Tuft(tuft), grass_color(rng));
}

/// Plans a tuft of tall grass with seed heads.
pub fn tall_grass(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let length = scale * rng.range(0.45, 0.75);
    let leaves = Tuft {
        base: Vec3::new(0.0, -0.01, 0.0),
        radius: scale * 0.10,
        blades: 25,
        blade: grass_blade(length, 0.0055, 1.2),
        lean: [0.05, 0.5],
        uneven: 0.5,
        seed: rng.bits(),
    };
    let albedo = grass_color(rng);
    plan.push(Shape::Tuft(leaves), albedo);
    let straw = tint(Vec3::new(0.42, 0.36, 0.19), rng, 0.2);
    for _ in 0..rng.count(2, 4) {
        let top = direction(rng.unit() * TURN, rng.range(1.15, 1.5)) * (length * rng.range(1.1, 1.5));
        let curve = Curve::between(Vec3::ZERO, Vec3::Y * top.y, top, top);
        plan.tube(Tube::plain(curve, [0.0016, 0.0010], [3, 8]), albedo.lerp(straw, 0.5));
        let head = Sprig {
            base: top,
            axis: unit_or(curve.tangent(1.0) + rng.vec3() * 0.1, Vec3::Y),
            length: 0.11 * scale,
            leaves: 20,
            blade: Blade {
                outline: &LANCE,
                length: 0.022,
                half_width: 0.0035,
                bend: 0.2,
                fold: 0.0,
                columns: 1,
                rows: 2,
            },
            rise: 1.6,
            level: 0.0,
            seed: rng.bits(),
        };
        plan.push(Shape::Sprig(head), straw);
    }
}

/// Plans a meadow flower: stalk, leaves, petals, eye.
pub fn flower(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    // Daisy, buttercup, poppy, cornflower: petal, eye, petals, petal length (m), half width relative to length.
    let kinds = [
        (Vec3::new(0.82, 0.82, 0.78), Vec3::new(0.75, 0.48, 0.04), 16, 0.022, 0.17),
        (Vec3::new(0.80, 0.60, 0.03), Vec3::new(0.55, 0.40, 0.03), 6, 0.016, 0.55),
        (Vec3::new(0.66, 0.05, 0.025), Vec3::new(0.03, 0.03, 0.03), 5, 0.034, 0.62),
        (Vec3::new(0.13, 0.17, 0.62), Vec3::new(0.10, 0.06, 0.30), 12, 0.020, 0.28),
    ];
    let (petal, eye, petals, length, width) = kinds[rng.count(0, 3) as usize];
    let top = direction(rng.unit() * TURN, rng.range(1.2, 1.55)) * (scale * rng.range(0.36, 0.62));
    let curve = Curve::between(Vec3::ZERO, Vec3::Y * top.y, top, top + Vec3::Y * 0.1);
    let green = tint(Vec3::new(0.14, 0.27, 0.06), rng, 0.2);
    plan.tube(Tube::plain(curve, [0.0026, 0.0018], [5, 8]), green);
    let foliage = Tuft {
        base: Vec3::ZERO,
        radius: 0.03,
        blades: 10,
        blade: Blade {
            outline: &LANCE,
            length: 0.15 * scale,
            half_width: 0.014,
            bend: 0.9,
            fold: 0.29,
            columns: 2,
            rows: 4,
        },
        lean: [0.3, 1.1],
        uneven: 0.4,
        seed: rng.bits(),
    };
    plan.push(Shape::Tuft(foliage), green);
    let length = length * rng.range(1.1, 1.6);
    let corolla = Tuft {
        base: top,
        radius: 0.004,
        blades: petals,
        blade: Blade {
            outline: &PETAL,
            length,
            half_width: length * width,
            bend: 0.3,
            fold: 0.23,
            columns: 2,
            rows: 4,
        },
        lean: [1.05, 1.35],
        uneven: 0.12,
        seed: rng.bits(),
    };
    plan.push(Shape::Tuft(corolla), tint(petal, rng, 0.12));
    let dome = Curve::line(top - Vec3::Y * 0.001, top + Vec3::Y * 0.006);
    plan.tube(Tube { taper: Taper::Dome, ..Tube::plain(dome, [0.009, 0.001], [8, 4]) }, eye);
}

/// Leaves lying on the ground.
#[derive(Clone, Copy, Debug)]
pub struct Litter {
    /// Metres from the middle to the outermost leaf.
    pub radius: f32,
    /// Rise of the ground in metres per metre in x and z.
    pub slope: [f32; 2],
    /// How many leaves.
    pub leaves: u32,
    /// Their mean form.
    pub blade: Blade,
    /// Seed of the leaves' differences.
    pub seed: u32,
}

impl Litter {
    /// Draws all leaves into one grid.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let mut rng = Rng::new(self.seed);
        let up = unit_or(Vec3::new(-self.slope[0], 1.0, -self.slope[1]), Vec3::Y);
        for index in 0..self.leaves {
            let at = rng.vec3() * self.radius;
            let ground = self.slope[0] * at.x + self.slope[1] * at.z;
            let origin = Vec3::new(at.x, ground + 0.012 + 0.0015 * index as f32, at.z);
            let normal = unit_or(up + rng.vec3() * 0.22, up);
            let forward = super::pen::perpendicular(normal, rng.vec3());
            let mut blade = self.blade;
            let size = 0.6 + 0.6 * rng.unit();
            blade.length *= size;
            blade.half_width *= size;
            blade.bend *= rng.signed();
            blade.draw(pen, Frame { origin, forward, normal });
        }
        self.blade.pack(self.leaves)
    }
}

/// Plans a patch of fallen leaves.
pub fn litter(plan: &mut Plan, rng: &mut Rng, scale: f32, slope: [f32; 2]) {
    let palette = [
        Vec3::new(0.24, 0.14, 0.06),
        Vec3::new(0.17, 0.10, 0.055),
        Vec3::new(0.33, 0.22, 0.08),
        Vec3::new(0.12, 0.085, 0.05),
    ];
    let length = scale * rng.range(0.10, 0.20);
    let litter = Litter {
        radius: 0.28,
        slope,
        leaves: 8,
        blade: Blade {
            outline: &LANCE,
            length,
            half_width: length * 0.25,
            bend: 0.8,
            fold: 0.33,
            columns: 2,
            rows: 4,
        },
        seed: rng.bits(),
    };
    plan.push(Shape::Litter(litter), tint(palette[rng.count(0, 3) as usize], rng, 0.25));
}

/// Plans a stone.
pub fn stone(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let size = scale * rng.range(0.14, 0.45);
    let size = Vec3::new(rng.range(0.9, 1.4), rng.range(0.6, 0.9), rng.range(0.8, 1.2)) * size;
    let albedo = tint(Vec3::new(0.21, 0.20, 0.18), rng, 0.3);
    let seed = rng.bits();
    for side in 0..6 {
        let stone = Stone { center: Vec3::Y * (size.y * 0.35), size, side, quads: 12, seed };
        plan.push(Shape::Stone(stone), albedo);
    }
}

/// Plans three to seven mushrooms.
pub fn mushrooms(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let cap = tint(
        [Vec3::new(0.45, 0.22, 0.09), Vec3::new(0.60, 0.50, 0.36), Vec3::new(0.50, 0.07, 0.03)]
            [rng.count(0, 2) as usize],
        rng,
        0.15,
    );
    for _ in 0..rng.count(3, 7) {
        let foot = rng.vec3() * Vec3::new(0.14, 0.0, 0.14);
        let height = scale * rng.range(0.05, 0.12);
        let top = foot + Vec3::new(0.02 * rng.signed(), height, 0.02 * rng.signed());
        let stem = Curve::between(foot - Vec3::Y * 0.02, Vec3::Y * height, top, Vec3::Y * height);
        plan.tube(Tube::plain(stem, [height * 0.13, height * 0.09], [8, 8]), Vec3::new(0.55, 0.50, 0.40));
        let radius = height * rng.range(0.38, 0.6);
        let dome = Curve::line(top - Vec3::Y * (0.12 * height), top + Vec3::Y * (radius * 0.62));
        plan.tube(Tube { taper: Taper::Dome, ..Tube::plain(dome, [radius, radius * 0.04], [16, 9]) }, cap);
        // The gills close the cap from below: a shallow funnel from the stem out to the rim.
        let rim = top - Vec3::Y * (0.12 * height);
        let gills = Curve::line(rim - Vec3::Y * (0.1 * height), rim);
        plan.tube(Tube::plain(gills, [height * 0.08, radius], [16, 3]), Vec3::new(0.42, 0.36, 0.28));
    }
}
