//! Leaves: narrow blades in packs, and large curved surfaces in pieces.

use glam::Vec3;

use super::noise::Rng;
use super::pen::{Pen, Topology, perpendicular, unit_or};
use super::trig::{GOLDEN_ANGLE, sincos, turn};

/// Half widths along a blade, at 17 stations from base to tip, relative to the greatest. Never zero: quads stay quads.
pub type Outline = [f32; 17];

/// A lance: willow, mango, most trees.
pub const LANCE: Outline =
    [0.10, 0.34, 0.55, 0.72, 0.85, 0.94, 0.99, 1.00, 0.98, 0.92, 0.83, 0.71, 0.57, 0.42, 0.27, 0.14, 0.04];
/// An egg: broad at the base, with a drawn-out tip.
pub const OVATE: Outline =
    [0.12, 0.62, 0.87, 0.97, 1.00, 0.99, 0.95, 0.89, 0.81, 0.72, 0.62, 0.51, 0.40, 0.29, 0.19, 0.10, 0.04];
/// A blade of grass.
pub const GRASS: Outline =
    [0.75, 0.85, 0.93, 0.98, 1.00, 1.00, 0.98, 0.95, 0.90, 0.84, 0.76, 0.67, 0.56, 0.44, 0.31, 0.18, 0.05];
/// A leaflet of a frond: seated with its full width.
pub const LEAFLET: Outline =
    [0.55, 0.80, 0.93, 0.99, 1.00, 0.99, 0.97, 0.94, 0.90, 0.85, 0.78, 0.70, 0.60, 0.48, 0.35, 0.20, 0.06];
/// A petal: widest near the tip.
pub const PETAL: Outline =
    [0.16, 0.22, 0.30, 0.38, 0.47, 0.57, 0.67, 0.77, 0.86, 0.93, 0.98, 1.00, 0.98, 0.91, 0.78, 0.58, 0.30];
/// A long paddle: banana.
pub const PADDLE: Outline =
    [0.20, 0.66, 0.85, 0.93, 0.97, 0.99, 1.00, 1.00, 1.00, 0.99, 0.97, 0.94, 0.89, 0.81, 0.68, 0.46, 0.06];
/// A heart: elephant's ear. Its lobes lie behind the stalk.
pub const HEART: Outline =
    [0.42, 0.76, 0.92, 0.99, 1.00, 0.98, 0.94, 0.88, 0.81, 0.73, 0.64, 0.54, 0.44, 0.34, 0.23, 0.12, 0.03];

/// The outline between its stations.
fn width_at(outline: &Outline, v: f32) -> f32 {
    let station = v.clamp(0.0, 1.0) * 16.0;
    let whole = (station as usize).min(15);
    outline[whole] + (station - whole as f32) * (outline[whole + 1] - outline[whole])
}

/// Where a leaf starts, where it goes and which way it looks: both unit, at right angles.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// The base.
    pub origin: Vec3,
    /// From base to tip.
    pub forward: Vec3,
    /// Out of the upper side.
    pub normal: Vec3,
}

impl Frame {
    /// A frame that goes along the unit vector `forward` and faces `hint` as nearly as it can.
    pub fn facing(origin: Vec3, forward: Vec3, hint: Vec3) -> Self {
        Self { origin, forward, normal: perpendicular(forward, hint) }
    }

    /// To the right when looking along the leaf with its upper side up.
    pub fn side(&self) -> Vec3 {
        self.forward.cross(self.normal)
    }

    /// Bends the leaf down by the angle whose cosine and sine are given.
    #[inline]
    fn bend(&mut self, (cos, sin): (f32, f32)) {
        let forward = self.forward;
        self.forward = forward * cos - self.normal * sin;
        self.normal = forward * sin + self.normal * cos;
    }
}

/// A blade's form.
#[derive(Clone, Copy, Debug)]
pub struct Blade {
    /// Half widths.
    pub outline: &'static Outline,
    /// Length in metres.
    pub length: f32,
    /// Greatest half width in metres.
    pub half_width: f32,
    /// How far it bends down over its length, in radians.
    pub bend: f32,
    /// How far each half is folded up along the midrib: rise over run.
    pub fold: f32,
    /// 1 quad across (flat) or 2 (folded).
    pub columns: u32,
    /// Quads along: 1, 2, 4, 8 or 16.
    pub rows: u32,
}

impl Blade {
    /// Draws one strip.
    #[inline]
    pub fn draw(&self, pen: &mut Pen, mut frame: Frame) {
        let side = frame.side();
        let step = self.length / self.rows as f32;
        let (sin, cos) = sincos(self.bend / self.rows as f32);
        let fold = if self.columns == 2 { self.fold } else { 0.0 };
        let fold_cos = 1.0 / (1.0 + fold * fold).sqrt();
        let fold_sin = fold * fold_cos;
        let stations = 16 / self.rows as usize;
        let mut origin = frame.origin;
        for row in 0..=self.rows as usize {
            let width = self.half_width * self.outline[row * stations];
            let edge = side * (width * fold_cos);
            let lift = frame.normal * (width * fold_sin);
            let upright = frame.normal * fold_cos;
            let tilt = side * fold_sin;
            pen.vertex(origin - edge + lift, upright + tilt);
            if self.columns == 2 {
                pen.vertex(origin, frame.normal);
            }
            pen.vertex(origin + edge + lift, upright - tilt);
            frame.bend((cos, sin));
            origin += frame.forward * step;
        }
    }

    /// The topology of a pack of `strips` of these.
    pub const fn pack(&self, strips: u32) -> Topology {
        Topology { strips, columns: self.columns, rows: self.rows, closed: false }
    }
}

/// Leaves around a twig, turned by the golden angle from one to the next.
#[derive(Clone, Copy, Debug)]
pub struct Sprig {
    /// Foot of the twig.
    pub base: Vec3,
    /// Unit vector along the twig.
    pub axis: Vec3,
    /// Length of the twig in metres.
    pub length: f32,
    /// How many leaves.
    pub leaves: u32,
    /// The leaves' mean form.
    pub blade: Blade,
    /// How steeply leaves rise along the twig: 0 at right angles, 1 at 45 degrees.
    pub rise: f32,
    /// How far leaves lie in the plane of the horizon (1) or stand around the twig (0).
    pub level: f32,
    /// Seed of the leaves' differences.
    pub seed: u32,
}

impl Sprig {
    /// Draws all leaves into one grid.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let mut rng = Rng::new(self.seed);
        let first = perpendicular(self.axis, rng.vec3());
        let second = self.axis.cross(first);
        let (sin, cos) = sincos(GOLDEN_ANGLE);
        let mut azimuth = (1.0, 0.0);
        for leaf in 0..self.leaves {
            azimuth = turn(azimuth, (cos, sin));
            let along = (leaf as f32 + 0.6) / self.leaves as f32;
            let radial = first * azimuth.0 + second * azimuth.1;
            let mut forward = radial + self.axis * (self.rise + 0.7 * along * along) + rng.vec3() * 0.25;
            forward.y *= 1.0 - 0.75 * self.level;
            let forward = unit_or(forward, radial);
            let hint = Vec3::Y * (0.7 + 0.6 * self.level) + self.axis * 0.35 + rng.vec3() * 0.35;
            let origin = self.base + self.axis * (self.length * along);
            let mut blade = self.blade;
            let size = 0.78 + 0.42 * rng.unit();
            blade.length *= size;
            blade.half_width *= size;
            blade.bend *= 0.5 + rng.unit();
            blade.draw(pen, Frame::facing(origin, forward, hint));
        }
        self.blade.pack(self.leaves)
    }
}

/// Blades that rise from the ground: grass, rosettes, flowers' petals.
#[derive(Clone, Copy, Debug)]
pub struct Tuft {
    /// Its middle.
    pub base: Vec3,
    /// Metres from the middle to the feet of the outer blades.
    pub radius: f32,
    /// How many blades.
    pub blades: u32,
    /// The blades' mean form.
    pub blade: Blade,
    /// Angle from upright of the innermost and outermost blades, in radians.
    pub lean: [f32; 2],
    /// How much lengths vary, 0 to 1.
    pub uneven: f32,
    /// Seed of the blades' differences.
    pub seed: u32,
}

impl Tuft {
    /// Draws all blades into one grid.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let mut rng = Rng::new(self.seed);
        let (golden_sin, golden_cos) = sincos(GOLDEN_ANGLE);
        let (sin, cos) = sincos(rng.unit() * super::trig::TURN);
        let mut azimuth = (cos, sin);
        for index in 0..self.blades {
            azimuth = turn(azimuth, (golden_cos, golden_sin));
            let out = (index as f32 + 0.5) / self.blades as f32;
            let jitter = rng.vec3();
            let radial =
                unit_or(Vec3::new(azimuth.0 + 0.3 * jitter.x, 0.0, azimuth.1 + 0.3 * jitter.z), Vec3::X);
            let (lean_sin, lean_cos) =
                sincos(self.lean[0] + (self.lean[1] - self.lean[0]) * out + 0.12 * jitter.y);
            let forward = Vec3::Y * lean_cos + radial * lean_sin;
            let normal = Vec3::Y * lean_sin - radial * lean_cos;
            let mut blade = self.blade;
            blade.length *= 1.0 - self.uneven * rng.unit();
            blade.bend *= 0.6 + 0.8 * rng.unit();
            let origin = self.base + radial * (self.radius * out.sqrt());
            blade.draw(pen, Frame { origin, forward, normal });
        }
        self.blade.pack(self.blades)
    }
}

/// Pairs of leaflets along a part of a frond's rib.
#[derive(Clone, Copy, Debug)]
pub struct Leaflets {
    /// The rib at the first pair.
    pub rib: Frame,
    /// Metres from pair to pair.
    pub step: f32,
    /// Radians the rib bends down from pair to pair.
    pub bend: f32,
    /// How many pairs.
    pub pairs: u32,
    /// Where the first and the last pair stand on the frond, 0 at its base and 1 at its tip.
    pub span: [f32; 2],
    /// Leaflet lengths along the frond, relative to the blade's.
    pub outline: &'static Outline,
    /// The longest leaflet.
    pub blade: Blade,
    /// How far leaflets point to the tip: 0 at right angles to the rib, 1 at 45 degrees.
    pub sweep: f32,
    /// How far leaflets rise above the rib's plane: 0 flat, 1 at 45 degrees.
    pub lift: f32,
    /// Seed of the leaflets' differences.
    pub seed: u32,
}

impl Leaflets {
    /// Draws all leaflets into one grid.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let mut rng = Rng::new(self.seed);
        let (sin, cos) = sincos(self.bend);
        let mut rib = self.rib;
        let side = rib.side();
        for pair in 0..self.pairs {
            let along =
                self.span[0] + (self.span[1] - self.span[0]) * (pair as f32 / (self.pairs.max(2) - 1) as f32);
            let size = width_at(self.outline, along);
            let mut blade = self.blade;
            blade.half_width *= 0.45 + 0.55 * size;
            for sign in [-1.0, 1.0] {
                blade.length = self.blade.length * size * (0.9 + 0.2 * rng.unit());
                let sweep = self.sweep * (0.75 + 0.7 * along) + 0.12 * rng.signed();
                let forward = unit_or(
                    side * sign + rib.forward * sweep + rib.normal * (self.lift + 0.08 * rng.signed()),
                    side,
                );
                blade.draw(pen, Frame::facing(rib.origin, forward, rib.normal));
            }
            rib.bend((cos, sin));
            rib.origin += rib.forward * self.step;
        }
        self.blade.pack(2 * self.pairs)
    }
}

/// A large leaf, of which one grid draws the rows from `span[0]` to `span[1]`.
#[derive(Clone, Copy, Debug)]
pub struct BigLeaf {
    /// Its base.
    pub frame: Frame,
    /// Its form; the columns of the blade do not count here.
    pub blade: Blade,
    /// Part of the length drawn, each from 0 to 1.
    pub span: [f32; 2],
    /// Quads across and along.
    pub quads: [u32; 2],
    /// Height of the waves at the margin, relative to the half width.
    pub ripple: f32,
    /// Waves along the leaf.
    pub waves: f32,
    /// Depth of the cuts in the margin, relative to the half width: 0 for a whole leaf.
    pub cuts: f32,
    /// Phase of the waves in radians.
    pub phase: f32,
}

impl BigLeaf {
    /// Draws the rows of the span.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let [columns, rows] = self.quads;
        let mut lattice = [Vec3::ZERO; 18 * 18];
        let pitch = columns as usize + 3;
        let side = self.frame.side();
        for row in 0..rows + 3 {
            let along = (row as f32 - 1.0) / rows as f32;
            let v = self.span[0] + (self.span[1] - self.span[0]) * along;
            self.row(v, side, columns, &mut lattice[row as usize * pitch..(row as usize + 1) * pitch]);
        }
        let topology = Topology::sheet(columns, rows);
        pen.smooth(topology, &lattice[..pitch * (rows as usize + 3)]);
        topology
    }

    /// One row of vertices across the leaf, with one more on either side.
    fn row(&self, v: f32, side: Vec3, columns: u32, out: &mut [Vec3]) {
        let Blade { outline, length, half_width, bend, fold, .. } = self.blade;
        let (sin, cos) = sincos(bend * v);
        // An arc of constant curvature, by its chord.
        let (forward, down) =
            if bend > 1e-3 { (length * sin / bend, length * (1.0 - cos) / bend) } else { (length * v, 0.0) };
        let Frame { origin, forward: ahead, normal } = self.frame;
        let center = origin + ahead * forward - normal * down;
        let up = ahead * sin + normal * cos;
        let (wave_left, wave_right) =
            (sincos(self.phase + self.waves * v).0, sincos(2.3 * self.phase + 1.17 * self.waves * v).0);
        let tooth = self.waves * v * (1.0 / super::trig::TURN) + self.phase;
        let notch = 1.0 - self.cuts * (2.0 * (tooth - tooth.floor()) - 1.0).abs();
        let width = half_width * width_at(outline, v) * notch / (1.0 + fold * fold).sqrt();
        for (column, vertex) in out.iter_mut().enumerate() {
            let u = 2.0 * (column as f32 - 1.0) / columns as f32 - 1.0;
            let wave = if u < 0.0 { wave_left } else { wave_right };
            // Each half rises from the midrib, then arches down to the margin.
            let rise = u.abs() * fold - 0.45 * u * u * fold + self.ripple * wave * u * u;
            *vertex = center + side * (u * width) + up * (rise * width);
        }
    }
}
