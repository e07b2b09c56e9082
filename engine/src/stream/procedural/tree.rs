//! Trees: trunk, limbs, branches, sprigs, lianas; and trunks that have fallen.

use glam::Vec3;

use super::leaf::{Blade, LANCE, OVATE, Outline, Sprig};
use super::noise::Rng;
use super::pen::{perpendicular, unit_or};
use super::plant::{Plan, Shape, tint};
use super::trig::{GOLDEN_ANGLE, TURN, sincos};
use super::wood::{Curve, Tube};

/// What one kind of tree has in common. Metres.
pub struct Form {
    height: [f32; 2],
    /// Trunk radius relative to height.
    girth: f32,
    buttress: f32,
    /// Where the crown begins, relative to height.
    crown: f32,
    limbs: [u32; 2],
    /// Length of the lowest limbs relative to height.
    spread: f32,
    branches: u32,
    sprigs: u32,
    /// Leaves of a sprig, and quads along each: fewer where the crown is high.
    leaves: [u32; 2],
    leaf: f32,
    leaf_outline: &'static Outline,
    leaf_width: f32,
    foliage: Vec3,
    bark: Vec3,
    lianas: u32,
    trunk_pieces: u32,
}

/// The emergent tree, 17 to 25 m.
pub const GIANT: Form = Form {
    height: [17.0, 25.0],
    girth: 0.021,
    buttress: 1.9,
    crown: 0.42,
    limbs: [9, 12],
    spread: 0.27,
    branches: 6,
    sprigs: 6,
    leaves: [24, 2],
    leaf: 0.34,
    leaf_outline: &OVATE,
    leaf_width: 0.24,
    foliage: Vec3::new(0.10, 0.23, 0.035),
    bark: Vec3::new(0.23, 0.18, 0.13),
    lianas: 3,
    trunk_pieces: 5,
};

/// The second storey, 5 to 9 m.
pub const SAPLING: Form = Form {
    height: [5.0, 9.0],
    girth: 0.010,
    buttress: 0.3,
    crown: 0.30,
    limbs: [8, 11],
    spread: 0.27,
    branches: 3,
    sprigs: 4,
    leaves: [16, 4],
    leaf: 0.24,
    leaf_outline: &LANCE,
    leaf_width: 0.19,
    foliage: Vec3::new(0.15, 0.31, 0.05),
    bark: Vec3::new(0.20, 0.17, 0.13),
    lianas: 0,
    trunk_pieces: 2,
};

/// Plans a tree.
pub fn plan(plan: &mut Plan, rng: &mut Rng, form: &Form, scale: f32) {
    let height = scale * rng.range(form.height[0], form.height[1]);
    let radius = form.girth * height * rng.range(0.85, 1.2);
    let lean = rng.vec3() * Vec3::new(0.09, 0.0, 0.09) * height;
    let curve = Curve([
        Vec3::new(0.0, -0.4 * scale, 0.0),
        Vec3::new(lean.z * 0.3, height * 0.3, -lean.x * 0.3),
        Vec3::new(lean.x, height * 0.65, lean.z),
        Vec3::new(lean.x * 1.2, height * 0.95, lean.z * 1.2),
    ]);
    let bark = tint(form.bark, rng, 0.25);
    let foliage = tint(form.foliage, rng, 0.22);
    let trunk = Tube {
        radii: [radius, radius * 0.22],
        quads: [16, 14],
        flare: form.buttress,
        bark: 0.07,
        seed: rng.bits(),
        ..Tube::plain(curve, [1.0; 2], [16, 14])
    };
    plan.long_tube(trunk, form.trunk_pieces, bark);
    let limbs = rng.count(form.limbs[0], form.limbs[1]);
    let mut azimuth = rng.unit() * TURN;
    // Lianas hang from the lowest limbs.
    let mut anchors = [Vec3::ZERO; 4];
    for limb in 0..limbs {
        azimuth += GOLDEN_ANGLE + 0.4 * rng.signed();
        let rank = limb as f32 / (limbs - 1) as f32;
        let at = form.crown + (0.99 - form.crown) * rank;
        let length = height * form.spread * (1.0 - 0.55 * rank) * rng.range(0.8, 1.2);
        let grown = Limb {
            from: curve.point(at),
            azimuth,
            elevation: 0.25 + 0.95 * rank,
            length,
            radius: radius * (0.5 - 0.3 * rank),
        };
        let anchor = grow_limb(plan, rng, form, &grown, [bark, foliage]);
        if let Some(slot) = anchors.get_mut(limb as usize) {
            *slot = anchor;
        }
    }
    for _ in 0..rng.count(0, form.lianas) {
        let anchor = anchors[rng.count(0, 3) as usize];
        liana(plan, rng, anchor, foliage);
    }
}

/// Where a limb leaves the trunk and how it goes.
struct Limb {
    from: Vec3,
    azimuth: f32,
    /// Radians above the horizon.
    elevation: f32,
    length: f32,
    radius: f32,
}

/// Plans a limb with its branches and leaves. Returns a point two thirds along.
fn grow_limb(plan: &mut Plan, rng: &mut Rng, form: &Form, limb: &Limb, [bark, foliage]: [Vec3; 2]) -> Vec3 {
    let (sin, cos) = sincos(limb.azimuth);
    let (rise, run) = sincos(limb.elevation);
    let outward = Vec3::new(cos * run, rise, sin * run);
    // Limbs start steep and level out as they reach for light beyond the crown.
    let start = unit_or(outward + Vec3::Y * 0.4, outward) * limb.length;
    let end = unit_or(outward - Vec3::Y * 0.15 + rng.vec3() * 0.3, outward) * limb.length;
    let tip = limb.from + outward * limb.length;
    let curve = Curve::between(limb.from, start, tip, end);
    plan.tube(Tube::plain(curve, [limb.radius, limb.radius * 0.25], [8, 8]), bark);
    for branch in 0..form.branches {
        let rank = (branch as f32 + 0.5) / form.branches as f32;
        let at = 0.35 + 0.65 * rank;
        let (from, along) = (curve.point(at), curve.tangent(at));
        let side = perpendicular(along, Vec3::Y).cross(along) * if branch % 2 == 0 { 1.0 } else { -1.0 };
        let direction =
            unit_or(along * (0.35 + 0.5 * rank) + side * 0.8 + Vec3::Y * rng.range(-0.1, 0.45), along);
        let length = limb.length * rng.range(0.30, 0.48);
        let to = from + direction * length;
        let twig = Curve::between(
            from,
            (along + direction) * (0.5 * length),
            to,
            (direction - Vec3::Y * 0.3) * length,
        );
        let thickness = limb.radius * (0.42 - 0.2 * rank);
        plan.tube(Tube::plain(twig, [thickness, thickness * 0.3], [6, 5]), bark);
        sprigs(plan, rng, form, &twig, length, foliage);
    }
    curve.point(0.66)
}

/// Plans the sprigs of one branch.
fn sprigs(plan: &mut Plan, rng: &mut Rng, form: &Form, branch: &Curve, length: f32, foliage: Vec3) {
    for index in 0..form.sprigs {
        let at = 0.15 + 0.85 * (index as f32 + rng.unit()) / form.sprigs as f32;
        let along = branch.tangent(at);
        let axis = unit_or(along * 0.7 + rng.vec3() * 0.9 + Vec3::Y * 0.35, along);
        let leaf = form.leaf * rng.range(0.85, 1.15);
        let sprig = Sprig {
            base: branch.point(at) + rng.vec3() * (0.06 * length),
            axis,
            length: leaf * rng.range(1.6, 2.4),
            leaves: form.leaves[0],
            blade: Blade {
                outline: form.leaf_outline,
                length: leaf,
                half_width: leaf * form.leaf_width,
                bend: 0.75,
                fold: 0.29,
                columns: 2,
                rows: form.leaves[1],
            },
            rise: 0.45,
            level: 0.5,
            seed: rng.bits(),
        };
        plan.push(Shape::Sprig(sprig), tint(foliage, rng, 0.20));
    }
}

/// Plans a liana that hangs from `from` to the ground, with a few leaves.
fn liana(plan: &mut Plan, rng: &mut Rng, from: Vec3, foliage: Vec3) {
    if from.y < 3.0 {
        return;
    }
    let drift = rng.vec3() * Vec3::new(1.6, 0.0, 1.6);
    let curve = Curve([
        from,
        from - Vec3::Y * (0.4 * from.y) + drift,
        Vec3::new(from.x + drift.z, from.y * 0.25, from.z - drift.x),
        Vec3::new(from.x, -0.5, from.z) + drift * 0.4,
    ]);
    let radius = rng.range(0.015, 0.04);
    plan.long_tube(
        Tube::plain(curve, [radius, radius * 0.8], [6, 20]),
        2,
        tint(Vec3::new(0.13, 0.10, 0.07), rng, 0.2),
    );
    for _ in 0..rng.count(8, 14) {
        let at = rng.range(0.03, 0.85);
        let leaf = rng.range(0.12, 0.2);
        let sprig = Sprig {
            base: curve.point(at),
            axis: unit_or(rng.vec3() * 0.6 - Vec3::Y, Vec3::NEG_Y),
            length: 0.5,
            leaves: 12,
            blade: Blade {
                outline: &OVATE,
                length: leaf,
                half_width: leaf * 0.36,
                bend: 0.6,
                fold: 0.25,
                columns: 2,
                rows: 4,
            },
            rise: 0.2,
            level: 0.2,
            seed: rng.bits(),
        };
        plan.push(Shape::Sprig(sprig), tint(foliage, rng, 0.25));
    }
}

/// Plans a fallen trunk lying on the slope, with the stumps of branches and moss.
pub fn log(plan: &mut Plan, rng: &mut Rng, scale: f32, slope: [f32; 2]) {
    let (sin, cos) = sincos(rng.unit() * TURN);
    let half = scale * rng.range(1.4, 2.3);
    let radius = scale * rng.range(0.14, 0.24);
    let along = Vec3::new(cos, slope[0] * cos + slope[1] * sin, sin) * half;
    let up = Vec3::Y * (radius * 0.72);
    let sag = Vec3::new(-sin, 0.0, cos) * (0.12 * half);
    let curve = Curve([up - along, up - along * 0.3 + sag, up + along * 0.3 - sag, up + along]);
    let bark = tint(Vec3::new(0.15, 0.12, 0.085), rng, 0.25);
    let trunk = Tube {
        bark: 0.13,
        seed: rng.bits() & !0xff00,
        ..Tube::plain(curve, [radius, radius * 0.75], [16, 14])
    };
    plan.long_tube(trunk, 3, bark);
    for _ in 0..rng.count(1, 3) {
        let at = rng.range(0.25, 0.9);
        let from = curve.point(at);
        let to = from + unit_or(rng.vec3() + Vec3::Y * 0.9, Vec3::Y) * (radius * rng.range(2.0, 5.0));
        plan.tube(Tube::plain(Curve::line(from, to), [radius * 0.3, radius * 0.12], [8, 5]), bark);
    }
    for _ in 0..rng.count(5, 10) {
        let at = rng.range(0.03, 0.97);
        let moss = super::leaf::Tuft {
            base: curve.point(at) + Vec3::Y * (radius * 0.85),
            radius: radius * 0.7,
            blades: 24,
            blade: super::herb::grass_blade(rng.range(0.05, 0.10), 0.006, 0.9),
            lean: [0.1, 1.0],
            uneven: 0.5,
            seed: rng.bits(),
        };
        plan.push(Shape::Tuft(moss), tint(Vec3::new(0.11, 0.22, 0.03), rng, 0.25));
    }
}
