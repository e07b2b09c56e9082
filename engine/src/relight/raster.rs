//! The z-buffer: triangles in exact fixed point with perspective-correct interpolation, discs, and the box filter.
//!
//! A frame is cut into runs of whole rows that threads fill independently; a sample's value does not depend on the
//! cut. Triangles that share an edge neither overlap nor leave gaps (the top-left rule on integers).

use super::view::{STEPS, Vertex};

/// What a frame stores per sample: colours for pictures, numbers for finding what is visible.
pub trait Paint: Copy + Send + Sync {
    /// An empty sample's value.
    const EMPTY: Self;

    /// The value inside a triangle, of corners' weights that sum to 1, of the face `id`.
    fn mix(corners: [&Vertex; 3], weights: [f32; 3], id: FaceId) -> Self;
}

impl Paint for [f32; 3] {
    const EMPTY: Self = [0.0; 3];

    #[inline]
    fn mix([a, b, c]: [&Vertex; 3], [wa, wb, wc]: [f32; 3], _: FaceId) -> Self {
        std::array::from_fn(|i| wa * a.rgb[i] + wb * b.rgb[i] + wc * c.rgb[i])
    }
}

impl Paint for FaceId {
    const EMPTY: Self = Self { grid: u32::MAX, face: u32::MAX };

    #[inline]
    fn mix(_: [&Vertex; 3], _: [f32; 3], id: Self) -> Self {
        id
    }
}

/// A face of a stream. The order is the stream's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct FaceId {
    /// The grid's number in the stream.
    pub grid: u32,
    /// The face's number in the grid.
    pub face: u32,
}

/// A sample: the nearest thing drawn there.
#[derive(Clone, Copy, Debug)]
pub struct Sample<P> {
    /// 1 over its depth; 0 while empty.
    pub inverse_depth: f32,
    /// Its value.
    pub paint: P,
}

impl<P: Paint> Sample<P> {
    /// Nothing, infinitely far.
    pub const EMPTY: Self = Self { inverse_depth: 0.0, paint: P::EMPTY };
}

/// A run of whole rows of a frame.
pub struct Rows<'a, P> {
    /// The first row's number.
    pub first: usize,
    /// Samples per row.
    pub width: usize,
    /// The samples, row by row.
    pub samples: &'a mut [Sample<P>],
}

/// Who is being drawn, and how much of it is there.
#[derive(Clone, Copy, Debug)]
pub struct Brush {
    /// The face.
    pub id: FaceId,
    /// Distinguishes faces for `opacity`.
    pub salt: u32,
    /// Share of samples that the face covers, chosen by a hash of face and sample.
    pub opacity: f32,
}

impl Brush {
    /// Whether the face covers this sample.
    fn covers(&self, x: usize, y: usize) -> bool {
        if self.opacity >= 1.0 {
            return true;
        }
        let seed = crate::math::hash::combine(self.salt, (y as u32) << 16 ^ x as u32);
        crate::math::hash::unit_f32(seed) < self.opacity
    }
}

impl<P: Paint> Rows<'_, P> {
    /// Draws a triangle, whichever way round.
    pub fn triangle(&mut self, corners: [&Vertex; 3], brush: Brush) {
        let [a, mut b, mut c] = corners;

        // Find the sample middles within the triangle's box; micropolygons mostly end here
        let xs = [a.screen[0], b.screen[0], c.screen[0]];
        let ys = [a.screen[1], b.screen[1], c.screen[1]];
        let (Some((x0, x1)), Some((y0, y1))) =
            (middles(&xs, 0, self.width), middles(&ys, self.first, self.samples.len() / self.width))
        else {
            return;
        };

        // Turn it so that the inside is where all three edge functions are positive
        let mut area = edge(a.screen, b.screen, c.screen);
        if area == 0 {
            return;
        }
        if area < 0 {
            std::mem::swap(&mut b, &mut c);
            area = -area;
        }
        let corners = [a, b, c];
        let start = [x0 as i32 * STEPS + STEPS / 2, y0 as i32 * STEPS + STEPS / 2];
        let edges: [[i64; 4]; 3] = std::array::from_fn(|i| {
            let (from, to) = (corners[(i + 1) % 3].screen, corners[(i + 2) % 3].screen);
            let (dx, dy) = (i64::from(to[0]) - i64::from(from[0]), i64::from(to[1]) - i64::from(from[1]));
            // A sample on an edge belongs to the triangle below or right of it.
            let owned = dy < 0 || (dy == 0 && dx > 0);
            let step = i64::from(STEPS);
            [edge(from, to, start) - i64::from(!owned), -dy * step, dx * step, i64::from(!owned)]
        });

        // Walk the box
        let scale = 1.0 / area as f32;
        let mut row_values = edges.map(|e| e[0]);
        for y in y0..=y1 {
            let mut values = row_values;
            let row = (y - self.first) * self.width;
            for x in x0..=x1 {
                if (values[0] | values[1] | values[2]) >= 0 {
                    let weights: [f32; 3] = std::array::from_fn(|i| {
                        (values[i] + edges[i][3]) as f32 * scale * corners[i].inverse_depth
                    });
                    let inverse_depth = weights[0] + weights[1] + weights[2];
                    let sample = &mut self.samples[row + x];
                    if inverse_depth > sample.inverse_depth && brush.covers(x, y) {
                        let depth = 1.0 / inverse_depth;
                        let paint = P::mix(corners, weights.map(|w| w * depth), brush.id);
                        *sample = Sample { inverse_depth, paint };
                    }
                }
                values = std::array::from_fn(|i| values[i] + edges[i][1]);
            }
            row_values = std::array::from_fn(|i| row_values[i] + edges[i][2]);
        }
    }

    /// Draws a disc of `radius` samples that faces the camera. The vertex must be projected.
    pub fn disc(&mut self, center: &Vertex, radius: f32, brush: Brush) {
        let [cx, cy] = center.screen.map(|s| s as f32 / STEPS as f32);
        let reach = (radius * STEPS as f32).min(1e9) as i32;
        let span = |c: i32| [c.saturating_sub(reach), c.saturating_add(reach)];
        let (Some((x0, x1)), Some((y0, y1))) = (
            middles(&span(center.screen[0]), 0, self.width),
            middles(&span(center.screen[1]), self.first, self.samples.len() / self.width),
        ) else {
            return;
        };
        let paint = P::mix([center; 3], [1.0, 0.0, 0.0], brush.id);
        for y in y0..=y1 {
            for x in x0..=x1 {
                let (dx, dy) = (x as f32 + 0.5 - cx, y as f32 + 0.5 - cy);
                let sample = &mut self.samples[(y - self.first) * self.width + x];
                let nearer = center.inverse_depth > sample.inverse_depth;
                if dx * dx + dy * dy <= radius * radius && nearer && brush.covers(x, y) {
                    *sample = Sample { inverse_depth: center.inverse_depth, paint };
                }
            }
        }
    }
}

/// Twice the signed area of a triangle in steps, positive when it turns clockwise on the screen. Coordinates are
/// below 2^26, so that products stay below 2^55.
fn edge(from: [i32; 2], to: [i32; 2], at: [i32; 2]) -> i64 {
    let d = |p: [i32; 2], i: usize| i64::from(p[i]) - i64::from(from[i]);
    d(to, 0) * d(at, 1) - d(to, 1) * d(at, 0)
}

/// The first and last sample among `count` from `first` on whose middle lies within the coordinates' range, if any.
fn middles(coordinates: &[i32], first: usize, count: usize) -> Option<(usize, usize)> {
    let (mut min, mut max) = (i32::MAX, i32::MIN);
    for &c in coordinates {
        (min, max) = (min.min(c), max.max(c));
    }
    let half = STEPS / 2;
    let low = (i64::from(min) - i64::from(half) + i64::from(STEPS) - 1).div_euclid(i64::from(STEPS));
    let high = (i64::from(max) - i64::from(half)).div_euclid(i64::from(STEPS));
    let (low, high) = (low.max(first as i64), high.min((first + count) as i64 - 1));
    (low <= high).then_some((low as usize, high as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BRUSH: Brush = Brush { id: FaceId { grid: 7, face: 0 }, salt: 1, opacity: 1.0 };

    fn corner(x: f32, y: f32, depth: f32, rgb: [f32; 3]) -> Vertex {
        let screen = [x, y].map(|c| (c * STEPS as f32) as i32);
        Vertex { screen, inverse_depth: 1.0 / depth, rgb, ..Vertex::default() }
    }

    fn frame(width: usize, height: usize) -> Vec<Sample<[f32; 3]>> {
        vec![Sample::EMPTY; width * height]
    }

    /// Catches a quad that covers too much, too little, or has a seam: each sample once, by count and by place.
    #[test]
    fn a_known_quad_covers_its_samples() {
        let mut samples = frame(16, 16);
        let mut rows = Rows { first: 0, width: 16, samples: &mut samples };
        let quad =
            [(2.5, 3.5), (10.5, 3.5), (10.5, 8.5), (2.5, 8.5)].map(|(x, y)| corner(x, y, 1.0, [1.0; 3]));
        rows.triangle([&quad[0], &quad[1], &quad[2]], BRUSH);
        let half = samples.iter().filter(|s| s.inverse_depth > 0.0).count();
        let mut rows = Rows { first: 0, width: 16, samples: &mut samples };
        rows.triangle([&quad[0], &quad[2], &quad[3]], BRUSH);
        for (at, sample) in samples.iter().enumerate() {
            let (x, y) = (at % 16, at / 16);
            // Sample middles lie on the quad's border here: left and top ones belong to it, right and bottom do not.
            let inside = (2..10).contains(&x) && (3..8).contains(&y);
            assert_eq!(sample.inverse_depth > 0.0, inside, "sample {x} {y}");
        }
        assert!((15..=25).contains(&half), "{half} of 40 samples in the first half");
    }

    /// Catches gaps and overlaps along shared edges: a fan of slivers must fill a square exactly once.
    #[test]
    fn a_fan_fills_a_square_exactly_once() {
        let ring: Vec<Vertex> = (0..64)
            .map(|i| {
                let t = i as f32;
                let (x, y) = match i / 16 {
                    0 => (2.0 * t, 0.0),
                    1 => (32.0, 2.0 * (t - 16.0)),
                    2 => (32.0 - 2.0 * (t - 32.0), 32.0),
                    _ => (0.0, 32.0 - 2.0 * (t - 48.0)),
                };
                corner(x, y, 1.0, [1.0; 3])
            })
            .collect();
        let center = corner(13.37, 21.01, 1.0, [1.0; 3]);
        let mut hits = vec![0; 32 * 32];
        for i in 0..64 {
            let mut samples = frame(32, 32);
            let mut rows = Rows { first: 0, width: 32, samples: &mut samples };
            let (a, b) = (&ring[i], &ring[(i + 1) % 64]);
            rows.triangle(if i % 2 == 0 { [&center, a, b] } else { [b, a, &center] }, BRUSH);
            hits.iter_mut().zip(&samples).for_each(|(n, s)| *n += usize::from(s.inverse_depth > 0.0));
        }
        assert!(hits.iter().all(|&n| n == 1), "{hits:?}");
    }

    /// Catches interpolation that is linear on the screen: at the middle of an edge from depth 1 to depth 3 the
    /// nearer end weighs three quarters.
    #[test]
    fn interpolation_is_perspective_correct() {
        let mut samples = frame(8, 8);
        let mut rows = Rows { first: 0, width: 8, samples: &mut samples };
        let (near, far) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
        let corners = [corner(0.5, 4.5, 1.0, near), corner(6.5, 4.5, 3.0, far), corner(0.5, 8.5, 1.0, near)];
        rows.triangle([&corners[0], &corners[1], &corners[2]], BRUSH);
        let sample = samples[4 * 8 + 3];
        assert!((sample.inverse_depth - 2.0 / 3.0).abs() < 1e-6, "{sample:?}");
        assert!((sample.paint[0] - 0.75).abs() < 1e-6 && (sample.paint[1] - 0.25).abs() < 1e-6, "{sample:?}");
    }

    /// Catches a depth test the wrong way round, and rows that differ when a frame is cut elsewhere.
    #[test]
    fn the_nearest_wins_however_the_frame_is_cut() {
        let draw = |cut: usize| {
            let mut samples = frame(20, 20);
            let (above, below) = samples.split_at_mut(cut * 20);
            let runs = [(0, above), (cut, below)].into_iter().filter(|(_, run)| !run.is_empty());
            for (first, run) in runs {
                let mut rows = Rows { first, width: 20, samples: run };
                for (depth, shift) in [(2.0, 0.0), (1.0, 3.3), (3.0, 5.1)] {
                    let rgb = [depth, 0.0, 0.0];
                    let corners = [
                        corner(-30.0 + shift, -5.0, depth, rgb),
                        corner(25.0, 3.0 + shift, depth, rgb),
                        corner(3.0, 28.0 - shift, depth, rgb),
                    ];
                    rows.triangle([&corners[0], &corners[1], &corners[2]], BRUSH);
                }
                rows.disc(&corner(15.0, 12.0, 0.5, [9.0; 3]), 2.0, BRUSH);
            }
            samples.iter().map(|s| s.paint[0]).collect::<Vec<_>>()
        };
        let whole = draw(0);
        assert!(whole.iter().filter(|&&p| (p - 1.0).abs() < 1e-5).count() > 50);
        assert_eq!(whole.iter().filter(|&&p| p == 9.0).count(), 12, "a disc of radius 2 covers 12 middles");
        for cut in [1, 10, 13, 19] {
            assert_eq!(draw(cut), whole, "cut at row {cut}");
        }
    }

    /// Catches opacity that covers the wrong share.
    #[test]
    fn half_transparent_faces_cover_half_the_samples() {
        let mut samples = frame(100, 100);
        let mut rows = Rows { first: 0, width: 100, samples: &mut samples };
        let corners = [(0.0, 0.0), (200.0, 0.0), (0.0, 200.0)].map(|(x, y)| corner(x, y, 1.0, [1.0; 3]));
        rows.triangle([&corners[0], &corners[1], &corners[2]], Brush { opacity: 0.3, ..BRUSH });
        let covered = samples.iter().filter(|s| s.inverse_depth > 0.0).count();
        assert!((2_800..3_200).contains(&covered), "{covered} of 10,000");
    }
}
