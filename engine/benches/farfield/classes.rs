//! Nine classes of geometry, from aggregates to solids, as microgrids on the lattice.

use engine::brickmap::spill::Quantised;
use engine::math::hash::{hash32, unit_f32};
use glam::{Mat3, Vec3};

/// Lattice steps of a quad's edge, about.
const EDGE: f32 = 64.0;

/// The classes' names.
pub const NAMES: [&str; 9] = [
    "leaves sparse",
    "leaves medium",
    "leaves dense",
    "grass",
    "canopy, leaves up",
    "wall",
    "wall at 45°",
    "closed rocks",
    "bumpy terrain",
];

/// The geometry of a class, about `quads` quads.
pub fn generate(class: usize, quads: usize, seed: u32) -> Vec<Quantised> {
    let mut random = Random(seed);
    match class {
        0 => leaves(&mut random, quads, 3.5, false),
        1 => leaves(&mut random, quads, 2.0, false),
        2 => leaves(&mut random, quads, 1.2, false),
        3 => grass(&mut random, quads),
        4 => leaves(&mut random, quads, 2.0, true),
        5 => sheet(quads, Mat3::IDENTITY, |_, _| 0.0),
        6 => sheet(
            quads,
            Mat3::from_rotation_x(std::f32::consts::FRAC_PI_4) * Mat3::from_rotation_y(0.3),
            |_, _| 0.0,
        ),
        7 => rocks(&mut random, quads),
        _ => {
            let bumps = |x: f32, y: f32| {
                4.0 * (x * 0.11).sin() * (y * 0.13).cos() + 0.8 * (x * 0.9 + y * 0.3).sin() * (y * 1.1).cos()
            };
            sheet(quads, Mat3::from_rotation_x(0.2), bumps)
        }
    }
}

/// A hash as a stream of numbers.
pub struct Random(pub u32);

impl Random {
    /// From 0 to 1.
    pub fn unit(&mut self) -> f32 {
        self.0 = hash32(self.0.wrapping_add(0x9e37_79b9));
        unit_f32(self.0)
    }

    /// Evenly in a cube of side 1 around zero.
    pub fn point(&mut self) -> Vec3 {
        Vec3::new(self.unit(), self.unit(), self.unit()) - 0.5
    }

    /// A rotation.
    pub fn rotation(&mut self) -> Mat3 {
        let mut axis = self.point();
        while axis.length() < 0.1 || axis.length() > 0.5 {
            axis = self.point();
        }
        let z = axis.normalize();
        let x = z.any_orthonormal_vector();
        Mat3::from_cols(x, z.cross(x), z) * Mat3::from_rotation_z(std::f32::consts::TAU * self.unit())
    }
}

/// A regular grid of quads.
pub fn grid(columns: usize, rows: usize, at: impl Fn(f32, f32) -> Vec3) -> Quantised {
    let mut grid = Quantised::default();
    for row in 0..=rows {
        for column in 0..=columns {
            let position = at(column as f32, row as f32) * EDGE;
            grid.vertices.push(position.round().as_ivec3());
        }
    }
    for row in 0..rows {
        for column in 0..columns {
            let a = row * (columns + 1) + column;
            grid.arities.push(4);
            grid.indices.extend([a, a + 1, a + columns + 2, a + columns + 1].map(|i| i as u8));
        }
    }
    grid.find_columns();
    grid
}

/// Curved leaves of 4 x 8 quads, `spacing` leaf lengths apart.
fn leaves(random: &mut Random, quads: usize, spacing: f32, face_up: bool) -> Vec<Quantised> {
    let count = quads.div_ceil(32);
    let side = (count as f32).cbrt() * spacing * 8.0;
    (0..count)
        .map(|_| {
            let (center, mut turn) = (random.point() * side, random.rotation());
            if face_up {
                let tilt = Mat3::from_rotation_x(0.5 * (random.unit() - 0.5))
                    * Mat3::from_rotation_y(0.5 * (random.unit() - 0.5));
                turn = tilt * Mat3::from_rotation_z(std::f32::consts::TAU * random.unit());
            }
            grid(4, 8, |x, y| {
                let narrow = 0.2 + (y / 8.0 * std::f32::consts::PI).sin();
                let bent = 0.06 * (y - 4.0) * (y - 4.0) + 0.1 * (x - 2.0).abs();
                center + turn * Vec3::new((x - 2.0) * narrow, y - 4.0, bent)
            })
        })
        .collect()
}

/// Blades of 2 x 8 quads that stand up and bend.
fn grass(random: &mut Random, quads: usize) -> Vec<Quantised> {
    let count = quads.div_ceil(16);
    let side = (count as f32).sqrt() * 1.6;
    (0..count)
        .map(|_| {
            let root = Vec3::new(side * random.unit(), side * random.unit(), 0.0);
            let (sin, cos) = (std::f32::consts::TAU * random.unit()).sin_cos();
            let (bend, height) = (0.06 * random.unit(), 0.7 + 0.6 * random.unit());
            grid(2, 8, |x, y| {
                let width = 0.25 * (x - 1.0) * (1.0 - y / 8.5);
                root + Vec3::new(
                    cos * width - sin * bend * y * y,
                    sin * width + cos * bend * y * y,
                    height * y,
                )
            })
        })
        .collect()
}

/// A square sheet cut into grids of 8 x 8.
fn sheet(quads: usize, turn: Mat3, height: impl Fn(f32, f32) -> f32) -> Vec<Quantised> {
    let side = ((quads as f32).sqrt() / 8.0).ceil() as usize;
    let middle = 4.0 * side as f32;
    (0..side * side)
        .map(|i| ((i % side * 8) as f32 - middle, (i / side * 8) as f32 - middle))
        .map(|(x0, y0)| grid(8, 8, |x, y| turn * Vec3::new(x0 + x, y0 + y, height(x0 + x, y0 + y))))
        .collect()
}

/// Closed lumps of 24 x 24 quads, touching here and there.
fn rocks(random: &mut Random, quads: usize) -> Vec<Quantised> {
    const CELLS: usize = 24;
    let count = quads.div_ceil(CELLS * CELLS);
    let side = (count as f32).cbrt() * 16.0;
    let mut grids = Vec::new();
    for _ in 0..count {
        let (center, turn) = (random.point() * side, random.rotation());
        let lump = |u: f32, v: f32| {
            let (theta, phi) = (std::f32::consts::PI * v, std::f32::consts::TAU * u);
            let on_sphere = Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            let bump = 1.0
                + 0.12 * (5.0 * on_sphere.x).sin() * (4.0 * on_sphere.y).cos()
                + 0.08 * (7.0 * on_sphere.z).sin();
            center + turn * (on_sphere * Vec3::new(6.0, 5.0, 4.0) * bump)
        };
        for part in 0..CELLS * CELLS / 64 {
            let (u0, v0) = ((part % (CELLS / 8) * 8) as f32, (part / (CELLS / 8) * 8) as f32);
            grids.push(grid(8, 8, |x, y| lump((u0 + x) / CELLS as f32, (v0 + y) / CELLS as f32)));
        }
    }
    grids
}
