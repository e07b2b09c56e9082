//! The ground: fractal noise on a lattice of whole vertices, cut into patches of 15 by 15 quads.

use glam::{DVec3, Vec3};

use super::noise::{NoiseLine, smoothstep};
use super::pen::{Pen, Topology};
use crate::math::hash::combine;
use crate::scene::ProceduralKind;

/// Quads along the side of a whole patch: 16 by 16 vertices fill a microgrid.
pub const PATCH_QUADS: i32 = 15;

/// Vertices along the side of a patch with one more on every side, for normals.
const PITCH_MAX: usize = PATCH_QUADS as usize + 3;

/// 0, 1, 2 ... as the compiler's vectors like them: it does not vectorise conversions of 64-bit counters.
const STEPS: [f32; PITCH_MAX] = {
    let mut steps = [0.0; PITCH_MAX];
    let mut i = 0;
    while i < PITCH_MAX {
        steps[i] = i as f32;
        i += 1;
    }
    steps
};

/// One octave of the ground's noise.
#[derive(Clone, Copy, Debug)]
struct Octave {
    seed: u32,
    /// Wavelength in quads, as a power of two.
    wavelength_log2: u32,
    /// Metres.
    amplitude: f32,
    /// Whether it makes ridges rather than hills.
    ridged: bool,
}

/// The height of the ground as a pure function of whole vertex numbers.
#[derive(Clone, Debug)]
pub struct Ground {
    /// Edge of a quad in metres, a power of two.
    pub quad_meters: f32,
    octaves: Vec<Octave>,
    /// How much slopes damp the finer octaves, as running water smooths valleys and leaves ridges rough.
    erosion: f32,
    /// Radius in metres of the flat clearing in the middle, if there is one; the ground rises around it.
    clearing: Option<f32>,
}

/// A rectangle of the ground's quads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PatchRange {
    /// First vertex in x and z.
    pub first: [i32; 2],
    /// Quads in x and z, 1 to 15 each.
    pub quads: [i32; 2],
}

/// The heights of one patch, with a border of one vertex.
#[derive(Clone, Debug)]
pub struct Patch {
    /// Which quads.
    pub range: PatchRange,
    quad_meters: f32,
    heights: [f32; PITCH_MAX * PITCH_MAX],
}

impl Ground {
    /// The ground of a procedural kind.
    pub fn new(kind: ProceduralKind, seed: u32, clearing: f32) -> Self {
        // Wavelength (log2 of quads), amplitude (m), ridged.
        let (quad_meters, erosion, octaves): (f32, f32, &[(u32, f32, bool)]) = match kind {
            ProceduralKind::Terrain => (
                0.25,
                1.6,
                &[
                    (10, 62.0, false),
                    (9, 30.0, true),
                    (8, 15.0, true),
                    (7, 7.0, true),
                    (6, 3.2, false),
                    (5, 1.5, false),
                    (4, 0.7, false),
                    (3, 0.3, false),
                    (2, 0.13, false),
                ],
            ),
            ProceduralKind::Jungle => (
                0.125,
                0.5,
                &[(8, 3.0, false), (6, 0.55, false), (4, 0.16, false), (3, 0.07, false), (1, 0.022, false)],
            ),
            ProceduralKind::Grass => {
                (0.125, 0.5, &[(9, 5.0, false), (7, 0.9, false), (5, 0.2, false), (2, 0.03, false)])
            }
        };
        let octaves = octaves.iter().map(|&(wavelength_log2, amplitude, ridged)| Octave {
            seed: combine(seed ^ 0x6e01_5e00, wavelength_log2),
            wavelength_log2,
            amplitude,
            ridged,
        });
        let clearing = (kind == ProceduralKind::Jungle).then_some(clearing);
        Self { quad_meters, octaves: octaves.collect(), erosion, clearing }
    }

    /// The heights in metres of the row of vertices `(x + i, z)`.
    fn row(&self, x: i32, z: i32, heights: &mut [f32]) {
        let count = heights.len();
        let (mut slope_x, mut slope_z) = ([0.0f32; PITCH_MAX], [0.0f32; PITCH_MAX]);
        heights.fill(0.0);
        for octave in &self.octaves {
            let wavelength = 1i32 << octave.wavelength_log2;
            let (scale, mask) = (1.0 / wavelength as f32, wavelength - 1);
            let mut i = 0;
            while i < count {
                // All vertices up to the next line of the lattice share the gradients.
                let vertex = x + i as i32;
                let end = (i + (wavelength - (vertex & mask)) as usize).min(count);
                let (cell_x, cell_z) = (vertex >> octave.wavelength_log2, z >> octave.wavelength_log2);
                let run = Run {
                    line: NoiseLine::new(octave.seed, cell_x, cell_z, (z & mask) as f32 * scale),
                    first: (vertex & mask) as f32,
                    scale,
                    amplitude: octave.amplitude,
                    slope: octave.amplitude * scale / self.quad_meters,
                    erosion: self.erosion,
                };
                let (sx, sz) = (&mut slope_x[i..end], &mut slope_z[i..end]);
                if octave.ridged {
                    run.add(&mut heights[i..end], sx, sz, ridge);
                } else {
                    run.add(&mut heights[i..end], sx, sz, |value| (value, 1.0));
                }
                i = end;
            }
        }
        if let Some(clearing) = self.clearing {
            for (i, height) in heights.iter_mut().enumerate() {
                let (mx, mz) = ((x + i as i32) as f32 * self.quad_meters, z as f32 * self.quad_meters);
                let radius = (mx * mx + mz * mz).sqrt();
                let flat = 0.3 + 0.7 * smoothstep(0.6 * clearing, clearing + 8.0, radius);
                *height = *height * flat + 5.0 * smoothstep(clearing, clearing + 26.0, radius);
            }
        }
    }

    /// Computes the heights of a patch.
    pub fn patch(&self, range: PatchRange, patch: &mut Patch) {
        patch.range = range;
        patch.quad_meters = self.quad_meters;
        let pitch = patch.pitch();
        for (row, z) in (range.first[1] - 1..=range.first[1] + range.quads[1] + 1).enumerate() {
            self.row(range.first[0] - 1, z, &mut patch.heights[row * pitch..(row + 1) * pitch]);
        }
    }

    /// The height in metres at a point, for the few who ask outside a patch.
    pub fn height(&self, x: f32, z: f32) -> f32 {
        let (vx, vz) = ((x / self.quad_meters).floor(), (z / self.quad_meters).floor());
        let (mut low, mut high) = ([0.0; 2], [0.0; 2]);
        self.row(vx as i32, vz as i32, &mut low);
        self.row(vx as i32, vz as i32 + 1, &mut high);
        bilinear([low, high], x / self.quad_meters - vx, z / self.quad_meters - vz)
    }
}

/// Vertices of a row that lie in one cell of an octave's lattice.
struct Run {
    line: NoiseLine,
    /// Quads from the cell's edge to the first vertex.
    first: f32,
    /// Cells per quad.
    scale: f32,
    /// Metres.
    amplitude: f32,
    /// Metres per metre for a derivative of 1 per cell.
    slope: f32,
    erosion: f32,
}

impl Run {
    /// Adds the octave, shaped by `form` (value, factor of the slope), to heights and slopes.
    #[inline]
    fn add(
        &self,
        heights: &mut [f32],
        slope_x: &mut [f32],
        slope_z: &mut [f32],
        form: impl Fn(f32) -> (f32, f32),
    ) {
        let sums = heights.iter_mut().zip(slope_x).zip(slope_z).zip(&STEPS);
        for (((height, slope_x), slope_z), step) in sums {
            let sample = self.line.sample((self.first + step) * self.scale);
            let (value, sign) = form(sample.value);
            let damping = 1.0 / (1.0 + self.erosion * (*slope_x * *slope_x + *slope_z * *slope_z));
            *height += self.amplitude * damping * value;
            *slope_x += self.slope * sign * sample.dx;
            *slope_z += self.slope * sign * sample.dz;
        }
    }
}

/// A sharp crest where the noise is zero, and the sign of its slope against the noise's.
fn ridge(value: f32) -> (f32, f32) {
    // A rounded |value|: a knife edge would alias at the quad's size.
    let rounded = (value * value + 0.0016).sqrt();
    (0.5 - 1.7 * rounded, -1.7 * value / rounded)
}

fn bilinear([low, high]: [[f32; 2]; 2], x: f32, z: f32) -> f32 {
    let near = low[0] + x * (low[1] - low[0]);
    let far = high[0] + x * (high[1] - high[0]);
    near + z * (far - near)
}

impl Default for Patch {
    fn default() -> Self {
        Self {
            range: PatchRange { first: [0; 2], quads: [1; 2] },
            quad_meters: 1.0,
            heights: [0.0; PITCH_MAX * PITCH_MAX],
        }
    }
}

impl Patch {
    /// Vertices per stored row.
    fn pitch(&self) -> usize {
        self.range.quads[0] as usize + 3
    }

    /// The corner that the patch's grid is anchored at, in metres. Exact: heights stay in the offsets.
    pub fn anchor(&self) -> DVec3 {
        let [x, z] = self.range.first;
        DVec3::new(f64::from(x), 0.0, f64::from(z)) * f64::from(self.quad_meters)
    }

    /// The height in metres at a point of the patch.
    pub fn height(&self, x: f32, z: f32) -> f32 {
        let local = |value: f32, axis: usize| {
            let quad = value / self.quad_meters - self.range.first[axis] as f32;
            let whole = (quad.floor() as i32).clamp(0, self.range.quads[axis] - 1);
            (whole as usize + 1, quad - whole as f32)
        };
        let ((column, fx), (row, fz)) = (local(x, 0), local(z, 1));
        let pitch = self.pitch();
        let pair = |row: usize| [self.heights[row * pitch + column], self.heights[row * pitch + column + 1]];
        bilinear([pair(row), pair(row + 1)], fx, fz)
    }

    /// Mean height (m) and steepness (rise over run) between the corners.
    pub fn lie(&self) -> (f32, f32) {
        let (pitch, [columns, rows]) = (self.pitch(), self.range.quads.map(|quads| quads as usize));
        let at = |row: usize, column: usize| self.heights[(row + 1) * pitch + column + 1];
        let (a, b, c, d) = (at(0, 0), at(0, columns), at(rows, 0), at(rows, columns));
        let dx = (b - a + d - c) / (2.0 * columns as f32 * self.quad_meters);
        let dz = (c - a + d - b) / (2.0 * rows as f32 * self.quad_meters);
        (0.25 * (a + b + c + d), (dx * dx + dz * dz).sqrt())
    }

    /// Draws the patch. Columns run along z and rows along x, so that faces look up.
    pub fn draw(&self, pen: &mut Pen) -> Topology {
        let pitch = self.pitch();
        let [rows, columns] = self.range.quads.map(|quads| quads as usize);
        let reciprocal = 1.0 / (2.0 * self.quad_meters);
        for row in 0..=rows {
            for column in 0..=columns {
                let here = (column + 1) * pitch + row + 1;
                let dx = (self.heights[here + 1] - self.heights[here - 1]) * reciprocal;
                let dz = (self.heights[here + pitch] - self.heights[here - pitch]) * reciprocal;
                let length = 1.0 / (1.0 + dx * dx + dz * dz).sqrt();
                let position = Vec3::new(
                    row as f32 * self.quad_meters,
                    self.heights[here],
                    column as f32 * self.quad_meters,
                );
                pen.vertex(position, Vec3::new(-dx * length, length, -dz * length));
            }
        }
        Topology::sheet(columns as u32, rows as u32)
    }
}
