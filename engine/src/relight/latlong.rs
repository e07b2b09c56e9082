//! Latitude-longitude maps: which direction a pixel looks in, its solid angle, and reading maps of any size.
//!
//! A map has its own frame: +y up, the middle of the picture looks along -z, and what is right of the middle along
//! +x, as a camera without rotation sees it. Row 0 is at the pole above.

use glam::DVec3;

/// Pixels across a file's map, at most.
pub const FILE_WIDTH_MAX: usize = 16_384;

/// Pixels down a file's map, at most.
pub const FILE_HEIGHT_MAX: usize = 8_192;

/// Larger maps are averaged to this width: finer than a background shows and far finer than 6 bands see.
const STORED_WIDTH_MAX: usize = 2_048;

/// Larger maps are averaged to this height.
const STORED_HEIGHT_MAX: usize = 1_024;

/// Brighter pixels count as infinite: the sun's disc is 1e5 times a bright sky, and sums must stay finite.
const RADIANCE_MAX: f32 = 1e12;

/// What takes the place of an infinite pixel: the largest half, which such pixels mostly exceeded.
const INFINITE_STANDS_FOR: f32 = 65_504.0;

/// Radiance over the sphere of directions.
#[derive(Clone, Debug, PartialEq)]
pub struct LatLong {
    width: usize,
    height: usize,
    pixels: Vec<[f32; 3]>,
}

impl LatLong {
    /// A map with `radiance` evaluated at the middles of its pixels.
    pub fn from_fn(width: usize, height: usize, mut radiance: impl FnMut(DVec3) -> [f32; 3]) -> Self {
        let mut map = Self { width, height, pixels: Vec::with_capacity(width * height) };
        for row in 0..height {
            for column in 0..width {
                let direction = map.direction(column as f64 + 0.5, row as f64 + 0.5);
                map.pixels.push(radiance(direction));
            }
        }
        map
    }

    /// Pixels across and down.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// The direction at `column`, `row` in pixels from the corner above left; a pixel's middle lies at + 0.5.
    pub fn direction(&self, column: f64, row: f64) -> DVec3 {
        let (sin_phi, cos_phi) = ((column / self.width as f64 - 0.5) * std::f64::consts::TAU).sin_cos();
        let (sin_theta, cos_theta) = (row / self.height as f64 * std::f64::consts::PI).sin_cos();
        DVec3::new(sin_theta * sin_phi, cos_theta, -sin_theta * cos_phi)
    }

    /// Direction, exact solid angle in steradian and radiance of every pixel.
    pub fn samples(&self) -> impl Iterator<Item = (DVec3, f64, [f32; 3])> + '_ {
        (0..self.height).flat_map(move |row| {
            let solid_angle = row_weight(row, self.height) * std::f64::consts::TAU / self.width as f64;
            (0..self.width).map(move |column| {
                let direction = self.direction(column as f64 + 0.5, row as f64 + 0.5);
                (direction, solid_angle, self.pixels[row * self.width + column])
            })
        })
    }

    /// Radiance along the unit vector `direction`, interpolated between pixels.
    pub fn radiance(&self, direction: DVec3) -> [f32; 3] {
        use std::f64::consts::{PI, TAU};
        let u = 0.5 + direction.x.atan2(-direction.z) / TAU;
        let v = direction.y.clamp(-1.0, 1.0).acos() / PI;
        let (x, y) = (u * self.width as f64 - 0.5, v * self.height as f64 - 0.5);
        let (fx, fy) = ((x - x.floor()) as f32, (y - y.floor()) as f32);
        let column = |offset: i64| (x.floor() as i64 + offset).rem_euclid(self.width as i64) as usize;
        let row = |offset: i64| (y.floor() as i64 + offset).clamp(0, self.height as i64 - 1) as usize;
        let at = |dx, dy| self.pixels[row(dy) * self.width + column(dx)];
        let (a, b, c, d) = (at(0, 0), at(1, 0), at(0, 1), at(1, 1));
        std::array::from_fn(|i| {
            (a[i] * (1.0 - fx) + b[i] * fx) * (1.0 - fy) + (c[i] * (1.0 - fx) + d[i] * fx) * fy
        })
    }
}

/// cos θ at the top of a row less that at its bottom: its solid angle is this times 2π.
fn row_weight(row: usize, height: usize) -> f64 {
    let edge = |row: usize| (row as f64 / height as f64 * std::f64::consts::PI).cos();
    edge(row) - edge(row + 1)
}

/// Averages a map of any size, pixel by pixel and in any order, to a [`LatLong`] of bounded size.
///
/// A pixel that crosses the border of two target pixels counts for both by its share, so that the radiance received
/// from any part of the sphere stays what it was.
pub struct LatLongBuilder {
    map: LatLong,
    weights: Vec<f32>,
    columns: Vec<Share>,
    rows: Vec<Share>,
    repaired: u64,
}

/// How a source row or column divides between two neighbouring target ones.
#[derive(Clone, Copy)]
struct Share {
    first: u32,
    weights: [f32; 2],
}

impl LatLongBuilder {
    /// For a source of this size, which must be within [`FILE_WIDTH_MAX`] and [`FILE_HEIGHT_MAX`].
    pub fn new(source_width: usize, source_height: usize) -> Self {
        assert!(
            (1..=FILE_WIDTH_MAX).contains(&source_width) && (1..=FILE_HEIGHT_MAX).contains(&source_height)
        );
        let (width, height) = (source_width.min(STORED_WIDTH_MAX), source_height.min(STORED_HEIGHT_MAX));
        Self {
            map: LatLong { width, height, pixels: vec![[0.0; 3]; width * height] },
            weights: vec![0.0; width * height],
            columns: shares(source_width, width, |_| 1.0),
            rows: shares(source_height, height, |row| row_weight(row, source_height) as f32),
            repaired: 0,
        }
    }

    /// Adds a source pixel. Components that are not numbers or negative become 0, those above 1e12 become 65,504.
    pub fn add(&mut self, column: usize, row: usize, rgb: [f32; 3]) {
        let sane = rgb.map(sanitised);
        self.repaired += u64::from(sane != rgb);
        let (columns, rows) = (self.columns[column], self.rows[row]);
        for (dy, weight_y) in rows.weights.into_iter().enumerate().filter(|&(_, weight)| weight > 0.0) {
            for (dx, weight_x) in columns.weights.into_iter().enumerate().filter(|&(_, weight)| weight > 0.0)
            {
                let at = (rows.first as usize + dy) * self.map.width + columns.first as usize + dx;
                let weight = weight_x * weight_y;
                self.weights[at] += weight;
                for (sum, value) in self.map.pixels[at].iter_mut().zip(sane) {
                    *sum += weight * value;
                }
            }
        }
    }

    /// The map, and how many source pixels were repaired.
    pub fn finish(mut self) -> (LatLong, u64) {
        for (pixel, weight) in self.map.pixels.iter_mut().zip(&self.weights) {
            if *weight > 0.0 {
                *pixel = pixel.map(|value| value / weight);
            }
        }
        (self.map, self.repaired)
    }
}

/// The component as a radiance: finite and not negative.
fn sanitised(value: f32) -> f32 {
    if value > RADIANCE_MAX {
        INFINITE_STANDS_FOR
    } else if value >= 0.0 {
        value
    } else {
        // Negative, or not a number.
        0.0
    }
}

/// How `source` rows or columns of a weight each divide among `target` ones, target <= source.
fn shares(source: usize, target: usize, weight: impl Fn(usize) -> f32) -> Vec<Share> {
    (0..source)
        .map(|at| {
            // Positions times `source` are integers, so that borders that coincide do so exactly.
            let (start, end) = (at * target, (at + 1) * target);
            let first = start / source;
            let border = (first + 1) * source;
            let second = end.saturating_sub(border) as f32 / target as f32;
            Share { first: first as u32, weights: [(1.0 - second) * weight(at), second * weight(at)] }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shade::sh;

    /// Catches a map that is mirrored, turned or upside down.
    #[test]
    fn the_middle_is_minus_z_and_right_of_it_plus_x() {
        let map = LatLong::from_fn(64, 32, |_| [0.0; 3]);
        for ((column, row), expected) in [
            ((32.0, 16.0), DVec3::NEG_Z),
            ((48.0, 16.0), DVec3::X),
            ((16.0, 16.0), DVec3::NEG_X),
            ((0.0, 16.0), DVec3::Z),
            ((10.0, 0.0), DVec3::Y),
        ] {
            let found = map.direction(column, row);
            assert!((found - expected).length() < 1e-12, "{column},{row}: {found}");
        }
    }

    /// Catches a lookup that does not undo `direction`: a smooth function must come back.
    #[test]
    fn looking_up_a_direction_finds_its_pixel() {
        let map = LatLong::from_fn(256, 128, |d| [d.x as f32, d.y as f32, d.z as f32]);
        for d in [DVec3::new(0.3, 0.5, -0.8), DVec3::new(-0.1, -0.9, 0.2), DVec3::new(0.01, 0.0, 1.0)] {
            let d = d.normalize();
            let found = DVec3::from_array(map.radiance(d).map(f64::from));
            assert!((found - d).length() < 2e-3, "{d}: {found}");
        }
    }

    /// Catches pixels whose solid angles do not fill the sphere.
    #[test]
    fn solid_angles_sum_to_the_sphere() {
        let map = LatLong::from_fn(37, 19, |_| [1.0; 3]);
        let sum: f64 = map.samples().map(|(_, solid_angle, _)| solid_angle).sum();
        assert!((sum - 4.0 * std::f64::consts::PI).abs() < 1e-12, "{sum}");
    }

    /// Catches a reduction that loses or moves light: projections of a map and its reduction must agree.
    #[test]
    fn reducing_a_map_keeps_its_light() {
        let (width, height) = (2_500, 1_100);
        let source = LatLong::from_fn(width, height, |d| {
            let spot = |axis: DVec3| (20.0 * (d.dot(axis) - 1.0)).exp() as f32;
            [spot(DVec3::NEG_Z), spot(DVec3::new(0.6, 0.8, 0.0)), 1.0]
        });
        let mut builder = LatLongBuilder::new(width, height);
        for row in 0..height {
            for column in 0..width {
                builder.add(column, row, source.pixels[row * width + column]);
            }
        }
        let (reduced, repaired) = builder.finish();
        assert_eq!((reduced.size(), repaired), ([2_048, 1_024], 0));
        let (a, b) = (sh::project(3, source.samples()), sh::project(3, reduced.samples()));
        for color in 0..3 {
            for i in 0..9 {
                let difference = (a[color][i] - b[color][i]).abs();
                assert!(difference < 2e-5, "colour {color}, {i}: {} {}", a[color][i], b[color][i]);
            }
        }
    }

    /// Catches NaN, infinite and negative pixels that spread into every coefficient, or go uncounted.
    #[test]
    fn broken_pixels_are_repaired_and_counted() {
        let mut builder = LatLongBuilder::new(2, 2);
        builder.add(0, 0, [f32::NAN, 1.0, 2.0]);
        builder.add(1, 0, [f32::INFINITY, f32::NEG_INFINITY, -1.0]);
        builder.add(0, 1, [1e10, 0.0, 0.5]);
        builder.add(1, 1, [0.25; 3]);
        let (map, repaired) = builder.finish();
        assert_eq!(repaired, 2);
        let close = |a: f32, b: f32| (a - b).abs() <= 1e-6 * b;
        let expected = [[0.0, 1.0, 2.0], [65_504.0, 0.0, 0.0], [1e10, 0.0, 0.5], [0.25; 3]];
        for (pixel, wanted) in map.pixels.iter().zip(expected) {
            assert!(pixel.iter().zip(wanted).all(|(&a, b)| close(a, b)), "{pixel:?}, {wanted:?} expected");
        }
    }
}
