//! Stems, trunks and stones: tubes along a curve, and closed solids.

use glam::Vec3;

use super::noise::Rng;
use super::pen::{Pen, Topology, perpendicular, unit_or};
use super::trig::{TURN, sincos, turn};

/// A cubic Bézier curve.
#[derive(Clone, Copy, Debug)]
pub struct Curve(pub [Vec3; 4]);

impl Curve {
    /// A straight line.
    pub fn line(from: Vec3, to: Vec3) -> Self {
        Self([from, from + (to - from) * (1.0 / 3.0), from + (to - from) * (2.0 / 3.0), to])
    }

    /// A curve that leaves `from` along `start` (metres) and arrives at `to` along `end` (metres).
    pub fn between(from: Vec3, start: Vec3, to: Vec3, end: Vec3) -> Self {
        Self([from, from + start * (1.0 / 3.0), to - end * (1.0 / 3.0), to])
    }

    /// The point at `t` from 0 to 1.
    pub fn point(&self, t: f32) -> Vec3 {
        let [a, b, c, d] = self.0;
        let s = 1.0 - t;
        a * (s * s * s) + b * (3.0 * s * s * t) + c * (3.0 * s * t * t) + d * (t * t * t)
    }

    /// The unit tangent at `t`.
    pub fn tangent(&self, t: f32) -> Vec3 {
        let [a, b, c, d] = self.0;
        let s = 1.0 - t;
        unit_or((b - a) * (s * s) + (c - b) * (2.0 * s * t) + (d - c) * (t * t), Vec3::Y)
    }
}

/// How a tube's radius runs from base to end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Taper {
    /// Straight from the first radius to the second.
    Linear,
    /// A dome over the first radius: a mushroom's cap.
    Dome,
}

/// A tube along a curve, of which one grid draws the part `span`.
#[derive(Clone, Copy, Debug)]
pub struct Tube {
    /// Its axis.
    pub curve: Curve,
    /// Radii in metres at the base and at the end.
    pub radii: [f32; 2],
    /// Part of the curve drawn.
    pub span: [f32; 2],
    /// Quads around (3 to 16) and along.
    pub quads: [u32; 2],
    /// The form of its radius.
    pub taper: Taper,
    /// Height of the buttresses at the foot, relative to the radius there.
    pub flare: f32,
    /// Depth of the bark's ribs, relative to the radius.
    pub bark: f32,
    /// Seed of the bark.
    pub seed: u32,
}

impl Tube {
    /// A plain tapered tube.
    pub fn plain(curve: Curve, radii: [f32; 2], quads: [u32; 2]) -> Self {
        Self { curve, radii, span: [0.0, 1.0], quads, taper: Taper::Linear, flare: 0.0, bark: 0.0, seed: 0 }
    }

    /// Draws it.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let [sides, rings] = self.quads;
        let mut lattice = [Vec3::ZERO; 16 * 19];
        let mut ribs = [1.0f32; 16];
        let mut rng = Rng::new(self.seed);
        for rib in &mut ribs[..sides as usize] {
            *rib = 1.0 + self.bark * rng.signed();
        }
        let lobes = (3 + (self.seed >> 8) % 3) as f32;
        let phase = TURN * (self.seed & 0xff) as f32 * (1.0 / 256.0);
        let (step_sin, step_cos) = sincos(TURN / sides as f32);
        for ring in 0..rings + 3 {
            let along = self.span[0] + (self.span[1] - self.span[0]) * ((ring as f32 - 1.0) / rings as f32);
            let clamped = along.clamp(0.0, 1.0);
            // Past its ends the tube goes on straight, to give the end rings their normals.
            let tangent = self.curve.tangent(clamped);
            let beyond = (along - clamped) * (self.curve.0[3] - self.curve.0[0]).length();
            let center = self.curve.point(clamped) + tangent * beyond;
            let first = perpendicular(tangent, Vec3::new(0.83, 0.29, 0.47));
            let second = tangent.cross(first);
            let radius = self.radius(along);
            let foot = (1.0 - 7.0 * clamped).max(0.0);
            let flare = self.flare * foot * foot;
            let mut azimuth = (1.0, 0.0);
            for side in 0..sides as usize {
                let mut r = radius * ribs[side];
                if flare > 0.0 {
                    let lobe = 0.5 + 0.5 * sincos(lobes * TURN * side as f32 / sides as f32 + phase).1;
                    r += radius * flare * (0.25 + lobe * lobe);
                }
                let radial = first * azimuth.0 + second * azimuth.1;
                lattice[ring as usize * sides as usize + side] = center + radial * r;
                azimuth = turn(azimuth, (step_cos, step_sin));
            }
        }
        let topology = Topology { strips: 1, columns: sides, rows: rings, closed: true };
        pen.smooth(topology, &lattice[..(sides * (rings + 3)) as usize]);
        topology
    }

    /// The radius at `t`, which may lie a little outside 0 to 1.
    fn radius(&self, t: f32) -> f32 {
        let [base, end] = self.radii;
        match self.taper {
            Taper::Linear => base + (end - base) * t,
            Taper::Dome => end + (base - end) * (1.0 - (t * t).min(1.0)).sqrt(),
        }
    }
}

/// A closed stone: a cube blown up to a sphere, then cut by planes. One grid draws one side of the cube.
#[derive(Clone, Copy, Debug)]
pub struct Stone {
    /// Its middle.
    pub center: Vec3,
    /// Half its size in metres along each axis.
    pub size: Vec3,
    /// Which side of the cube, 0 to 5.
    pub side: u32,
    /// Quads along an edge of the cube, 2 to 15.
    pub quads: u32,
    /// Seed of the cuts.
    pub seed: u32,
}

/// Planes that cut a stone.
const CUTS: usize = 11;

impl Stone {
    /// Draws the side.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let mut rng = Rng::new(self.seed);
        let cuts: [(Vec3, f32); CUTS] =
            std::array::from_fn(|_| (unit_or(rng.vec3(), Vec3::X), rng.range(0.52, 0.85)));
        let mut lattice = [Vec3::ZERO; 18 * 18];
        let pitch = self.quads as usize + 3;
        for row in 0..pitch {
            for column in 0..pitch {
                let at = |i: usize| 2.0 * (i as f32 - 1.0) / self.quads as f32 - 1.0;
                let direction = unit_or(self.cube_point(at(column), at(row)), Vec3::Y);
                lattice[row * pitch + column] = self.center + direction * self.size * cut(&cuts, direction);
            }
        }
        let topology = Topology::sheet(self.quads, self.quads);
        pen.smooth(topology, &lattice[..pitch * pitch]);
        topology
    }

    /// A point of this side of the cube; columns cross rows outward.
    fn cube_point(&self, u: f32, v: f32) -> Vec3 {
        // Equal angles rather than equal lengths, so that quads near the cube's corners are not small.
        let (u, v) = (widen(u), widen(v));
        match self.side {
            0 => Vec3::new(1.0, u, v),
            1 => Vec3::new(-1.0, v, u),
            2 => Vec3::new(v, 1.0, u),
            3 => Vec3::new(u, -1.0, v),
            4 => Vec3::new(u, v, 1.0),
            _ => Vec3::new(v, u, -1.0),
        }
    }
}

/// An odd polynomial near tan(u π/4), exact at ±1.
fn widen(u: f32) -> f32 {
    u * (0.75 + 0.25 * u * u)
}

/// How far the stone reaches in a direction: the nearest of the planes, blended so that edges are worn.
fn cut(cuts: &[(Vec3, f32); CUTS], direction: Vec3) -> f32 {
    let mut sum = 1.0f32;
    for (normal, distance) in cuts {
        let toward = normal.dot(direction).max(0.0) / distance;
        // A 16-norm of the planes' reciprocal distances: nearly the nearest one.
        let p2 = toward * toward;
        let p4 = p2 * p2;
        let p8 = p4 * p4;
        sum += p8 * p8;
    }
    // The sixteenth root, by four square roots: the same bits everywhere.
    1.0 / sum.sqrt().sqrt().sqrt().sqrt()
}
