//! Plants of fronds: palm, tree fern, fern.

use glam::Vec3;

use super::leaf::{Blade, Frame, LEAFLET, Leaflets, Outline};
use super::noise::Rng;
use super::pen::unit_or;
use super::plant::{Plan, Shape, tint};
use super::trig::{GOLDEN_ANGLE, TURN, sincos};
use super::wood::{Curve, Tube};

/// Leaflet lengths along a palm's frond.
const PALM: Outline =
    [0.55, 0.70, 0.82, 0.90, 0.96, 0.99, 1.00, 0.99, 0.97, 0.93, 0.88, 0.81, 0.72, 0.62, 0.50, 0.36, 0.20];
/// Leaflet lengths along a fern's frond.
const FERN: Outline =
    [0.42, 0.62, 0.80, 0.92, 0.99, 1.00, 0.97, 0.92, 0.85, 0.77, 0.68, 0.58, 0.48, 0.37, 0.26, 0.15, 0.05];

/// A frond's rib: where it starts and how it arches.
struct Rib {
    frame: Frame,
    length: f32,
    /// Radians it bends down over its length.
    arch: f32,
    /// The part of the rib below the first leaflets.
    bare: f32,
    radius: f32,
}

impl Rib {
    /// A rib that leaves `origin` at `azimuth`, `elevation` above the horizon.
    fn new(origin: Vec3, azimuth: f32, elevation: f32, length: f32, arch: f32) -> Self {
        let ((sin, cos), (rise, run)) = (sincos(azimuth), sincos(elevation));
        let forward = Vec3::new(cos * run, rise, sin * run);
        let frame = Frame { origin, forward, normal: Vec3::new(-cos * rise, run, -sin * rise) };
        Self { frame, length, arch, bare: 0.15, radius: 0.01 }
    }

    /// The frame at `t` from 0 to 1.
    fn at(&self, t: f32) -> Frame {
        let (sin, cos) = sincos(self.arch * t);
        let Frame { origin, forward, normal } = self.frame;
        let (ahead, down) = if self.arch > 1e-3 {
            (self.length * sin / self.arch, self.length * (1.0 - cos) / self.arch)
        } else {
            (self.length * t, 0.0)
        };
        Frame {
            origin: origin + forward * ahead - normal * down,
            forward: forward * cos - normal * sin,
            normal: forward * sin + normal * cos,
        }
    }

    /// Plans the rib's tube.
    fn draw(&self, plan: &mut Plan, quads: [u32; 2], albedo: Vec3) {
        let (foot, tip) = (self.frame, self.at(0.97));
        // A Bézier whose handles follow the arc: (4/3) tan(arch/4) of the radius, near enough a third of its length.
        let curve =
            Curve::between(foot.origin, foot.forward * self.length, tip.origin, tip.forward * self.length);
        plan.tube(Tube::plain(curve, [self.radius, self.radius * 0.25], quads), albedo);
    }

    /// Plans leaflets: `grids` grids of `pairs` pairs each.
    fn leaflets(&self, plan: &mut Plan, rng: &mut Rng, form: &Leaflets, grids: u32, albedo: Vec3) {
        let total = grids * form.pairs;
        let gap = (1.0 - self.bare) / total as f32;
        for grid in 0..grids {
            let first = grid * form.pairs;
            let rank = |pair: u32| pair as f32 / (total - 1) as f32;
            let leaflets = Leaflets {
                rib: self.at(self.bare + gap * first as f32),
                step: gap * self.length,
                bend: gap * self.arch,
                span: [rank(first), rank(first + form.pairs - 1)],
                seed: rng.bits(),
                ..*form
            };
            plan.push(Shape::Leaflets(leaflets), tint(albedo, rng, 0.08));
        }
    }
}

/// Leaflets whose rib, step and span are still to be filled in.
fn leaflets(outline: &'static Outline, blade: Blade, pairs: u32, sweep: f32, lift: f32) -> Leaflets {
    let rib = Frame { origin: Vec3::ZERO, forward: Vec3::X, normal: Vec3::Y };
    Leaflets { rib, step: 0.0, bend: 0.0, pairs, span: [0.0, 1.0], outline, blade, sweep, lift, seed: 0 }
}

/// Plans a palm of 2.5 to 7 m.
pub fn palm(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let height = scale * rng.range(1.6, 5.0);
    let lean = rng.vec3() * Vec3::new(0.25, 0.0, 0.25) * height;
    let top = Vec3::new(lean.x, height, lean.z);
    let curve =
        Curve::between(Vec3::new(0.0, -0.3, 0.0), Vec3::Y * height * 0.7 + lean, top, Vec3::Y * height);
    let radius = scale * rng.range(0.09, 0.13);
    let trunk = Tube {
        flare: 0.4,
        bark: 0.05,
        seed: rng.bits(),
        ..Tube::plain(curve, [radius, radius * 0.8], [12, 15])
    };
    plan.long_tube(trunk, 2, tint(Vec3::new(0.26, 0.22, 0.17), rng, 0.2));
    let green = tint(Vec3::new(0.12, 0.27, 0.045), rng, 0.2);
    let fronds = rng.count(15, 21);
    let mut azimuth = rng.unit() * TURN;
    for frond in 0..fronds {
        azimuth += GOLDEN_ANGLE;
        // The innermost fronds are young and upright, the outermost old, hanging and yellow.
        let age = (frond as f32 + rng.unit()) / fronds as f32;
        let length = scale * rng.range(2.2, 3.0) * (0.75 + 0.35 * age);
        let mut rib = Rib::new(top, azimuth, 1.35 - 1.35 * age, length, 0.75 + 0.75 * age);
        (rib.radius, rib.bare) = (0.022 * scale, 0.18);
        let dead = rng.unit() < (age - 0.8) * 2.0;
        let albedo = if dead {
            Vec3::new(0.26, 0.18, 0.08)
        } else {
            green.lerp(Vec3::new(0.22, 0.28, 0.06), 0.35 * age * age)
        };
        rib.draw(plan, [6, 12], albedo * Vec3::new(1.2, 1.05, 1.0));
        let blade = Blade {
            outline: &LEAFLET,
            length: 0.62 * scale,
            half_width: 0.021 * scale,
            bend: 0.9,
            fold: 0.36,
            columns: 2,
            rows: 4,
        };
        let form = leaflets(&PALM, blade, 8, 0.65, 0.30);
        let albedo = tint(albedo, rng, 0.1);
        rib.leaflets(plan, rng, &form, 4, albedo);
    }
}

/// Plans a tree fern of 1.5 to 4.5 m.
pub fn tree_fern(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let height = scale * rng.range(0.7, 2.9);
    let lean = rng.vec3() * Vec3::new(0.15, 0.0, 0.15) * height;
    let top = Vec3::new(lean.x, height, lean.z);
    let curve = Curve::between(Vec3::new(0.0, -0.3, 0.0), Vec3::Y * height, top, Vec3::Y * height);
    let radius = 0.10 * scale;
    let trunk = Tube {
        bark: 0.16,
        flare: 0.5,
        seed: rng.bits(),
        ..Tube::plain(curve, [radius, radius * 1.1], [16, 14])
    };
    plan.long_tube(trunk, 2, tint(Vec3::new(0.085, 0.060, 0.042), rng, 0.2));
    let green = tint(Vec3::new(0.11, 0.30, 0.04), rng, 0.2);
    let fronds = rng.count(12, 16);
    let mut azimuth = rng.unit() * TURN;
    for frond in 0..fronds {
        azimuth += GOLDEN_ANGLE;
        let age = (frond as f32 + rng.unit()) / fronds as f32;
        let length = scale * rng.range(1.6, 2.1) * (0.7 + 0.3 * age);
        let mut rib = Rib::new(top, azimuth, 1.15 - 0.95 * age, length, 0.9 + 0.5 * age);
        (rib.radius, rib.bare) = (0.012 * scale, 0.12);
        let albedo = tint(green.lerp(Vec3::new(0.20, 0.26, 0.05), 0.3 * age), rng, 0.1);
        rib.draw(plan, [6, 12], Vec3::new(0.12, 0.13, 0.05));
        pinnae(plan, rng, &rib, scale, albedo);
    }
}

/// Plans the pinnae of a twice divided frond: each is a small frond of its own.
fn pinnae(plan: &mut Plan, rng: &mut Rng, rib: &Rib, scale: f32, albedo: Vec3) {
    let pairs = 17;
    for pair in 0..pairs {
        let rank = pair as f32 / (pairs - 1) as f32;
        let foot = rib.at(rib.bare + (0.985 - rib.bare) * rank);
        let station = rank * 15.99;
        let size = FERN[station as usize]
            + (station - station.floor()) * (FERN[station as usize + 1] - FERN[station as usize]);
        for sign in [-1.0, 1.0] {
            let length = scale * 0.52 * size.max(0.14) * rng.range(0.93, 1.07);
            let forward = unit_or(
                foot.side() * sign + foot.forward * (0.28 + 0.4 * rank) + foot.normal * 0.10,
                foot.forward,
            );
            let mut pinna = Rib::new(foot.origin, 0.0, 0.0, length, 0.45);
            pinna.frame = Frame::facing(foot.origin, forward, foot.normal);
            pinna.bare = 0.04;
            let spacing = length / 12.0;
            let blade = Blade {
                outline: &LEAFLET,
                length: scale * 0.085 * (0.35 + 0.65 * size),
                half_width: spacing * 0.44,
                bend: 0.5,
                fold: 0.0,
                columns: 1,
                rows: 2,
            };
            let form = leaflets(&FERN, blade, 12, 0.25, 0.0);
            pinna.leaflets(plan, rng, &form, 1, albedo);
        }
    }
}

/// Plans a fern of 0.5 to 1.1 m.
pub fn fern(plan: &mut Plan, rng: &mut Rng, scale: f32) {
    let green = tint(Vec3::new(0.13, 0.33, 0.045), rng, 0.25);
    let fronds = rng.count(9, 14);
    let mut azimuth = rng.unit() * TURN;
    for frond in 0..fronds {
        azimuth += GOLDEN_ANGLE;
        let age = (frond as f32 + rng.unit()) / fronds as f32;
        let length = scale * rng.range(0.7, 1.05) * (0.75 + 0.25 * age);
        let base = Vec3::new(0.0, 0.01, 0.0) + rng.vec3() * 0.03;
        let mut rib = Rib::new(base, azimuth, 1.25 - 0.65 * age, length, 0.9 + 0.6 * age);
        (rib.radius, rib.bare) = (0.006 * scale, 0.14);
        let albedo = tint(green.lerp(Vec3::new(0.24, 0.29, 0.06), 0.3 * age * age), rng, 0.1);
        rib.draw(plan, [5, 8], Vec3::new(0.14, 0.15, 0.05));
        let blade = Blade {
            outline: &LEAFLET,
            length: 0.19 * scale,
            half_width: 0.0135 * scale,
            bend: 0.5,
            fold: 0.0,
            columns: 1,
            rows: 4,
        };
        let form = leaflets(&FERN, blade, 8, 0.3, 0.08);
        rib.leaflets(plan, rng, &form, 3, albedo);
    }
}
