//! Lines through a box: the same directions for every box, evenly over the hemisphere and over what the box shows to each.
//!
//! Directions are a spherical Fibonacci set; where a line enters is a point of the R2 sequence (Roberts, "The Unreasonable
//! Effectiveness of Quasirandom Sequences", 2018), moved by a hash of the box, on the faces that the box shows to the
//! direction. So a line is as likely through any piece of the box's outline, and the share of lines that meet something is its
//! opacity, averaged over directions.

use std::sync::OnceLock;

use glam::{DVec3, IVec3, Vec3};

use crate::brick::LatticeBox;
use crate::math::hash::{combine, unit_f32};
use crate::math::trig::cos_sin_turns;

/// Lines of a set at most: bits of a mask.
pub const LINES_MAX: usize = 64;

/// A number of every line.
pub type Column = [f32; LINES_MAX];

/// Directions, and what follows from them.
#[derive(Debug)]
pub struct Directions {
    /// Lines in use, a multiple of 16.
    pub count: usize,
    /// Unit vectors, per axis.
    pub along: [Column; 3],
    /// Reciprocals, per axis.
    pub inverse: [Column; 3],
    /// A unit vector across, per axis.
    pub right: [Column; 3],
    /// Another one, across both.
    pub up: [Column; 3],
    /// Where the line enters a box, before the box's own shift: two numbers from 0 to 1.
    entry: [Column; 2],
}

impl Directions {
    fn new(count: usize, direction: impl Fn(usize) -> Vec3) -> Self {
        let empty = [[0.0; LINES_MAX]; 3];
        let mut set = Self {
            count,
            along: empty,
            inverse: empty,
            right: empty,
            up: empty,
            entry: [[0.0; LINES_MAX]; 2],
        };
        const R2: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_2];
        for line in 0..LINES_MAX {
            let i = (line % count) as f64;
            let along = direction(line % count);
            let right = along.any_orthonormal_vector();
            let up = along.cross(right);
            for axis in 0..3 {
                let d = along[axis];
                set.along[axis][line] = d;
                set.inverse[axis][line] = 1.0 / if d.abs() < 1e-9 { 1e-9 } else { d };
                set.right[axis][line] = right[axis];
                set.up[axis][line] = up[axis];
            }
            for (entry, step) in set.entry.iter_mut().zip(R2) {
                entry[line] = ((i + 0.5) * step).fract() as f32;
            }
        }
        set
    }

    /// The same direction for all lines.
    pub fn parallel(direction: Vec3) -> Self {
        Self::new(LINES_MAX, |_| direction)
    }

    /// Sixty-four directions.
    pub fn many() -> &'static Self {
        static SET: OnceLock<Directions> = OnceLock::new();
        SET.get_or_init(|| Self::new(64, |i| fibonacci(i, 64)))
    }

    /// Sixteen directions.
    pub fn few() -> &'static Self {
        static SET: OnceLock<Directions> = OnceLock::new();
        SET.get_or_init(|| Self::new(16, |i| fibonacci(i, 16)))
    }
}

/// The direction numbered `i` of `count` ones, evenly over the hemisphere.
pub fn fibonacci(i: usize, count: usize) -> Vec3 {
    const GOLDEN: f64 = 0.618_033_988_749_894_8;
    let z = (i as f64 + 0.5) / count as f64;
    let (cos, sin) = cos_sin_turns(i as f64 * GOLDEN);
    let flat = (1.0 - z * z).sqrt();
    DVec3::new(flat * cos, flat * sin, z).as_vec3()
}

/// Lines through a box. Coordinates are lattice steps from [`center`](Self::center).
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Lines<'d> {
    /// Their directions.
    pub directions: &'d Directions,
    /// What coordinates are relative to.
    pub center: IVec3,
    /// A point of each line, where it enters the box, per axis.
    pub start: [Column; 3],
    /// Start times reciprocal direction, per axis.
    pub offset: [Column; 3],
    /// Start along [`Directions::right`], [`Directions::up`] and the line itself.
    pub across: [Column; 3],
    /// Where the line leaves the box, in steps from its start.
    pub leave: Column,
    /// Only hits from here on count, in steps from the start.
    pub from: Column,
    /// Only hits up to here count.
    pub to: Column,
    /// The area that the box shows to the direction.
    pub shown: Column,
    /// Bit i: line i is in use.
    pub all: u64,
    /// Half extents of the box.
    pub half: Vec3,
}

impl<'d> Lines<'d> {
    /// No lines.
    pub fn new(directions: &'d Directions) -> Self {
        let empty = [[0.0; LINES_MAX]; 3];
        Self {
            directions,
            center: IVec3::ZERO,
            start: empty,
            offset: empty,
            across: empty,
            leave: [0.0; LINES_MAX],
            from: [0.0; LINES_MAX],
            to: [0.0; LINES_MAX],
            shown: [0.0; LINES_MAX],
            all: 0,
            half: Vec3::ZERO,
        }
    }

    /// Lines through `bounds`. Another `round` gives other ones.
    #[inline(always)]
    pub fn fill(&mut self, bounds: &LatticeBox, directions: &'d Directions, round: u32) {
        let corners = [bounds.min, bounds.max].map(|corner| corner.to_array());
        let hash = corners.iter().flatten().fold(round, |hash, &c| combine(hash, c as u32));
        let shift = [unit_f32(hash), unit_f32(combine(hash, 1))];
        self.center = (bounds.min >> 1) + (bounds.max >> 1);
        let middle = ((bounds.min - self.center) + (bounds.max - self.center)).as_vec3() * 0.5;
        self.half = (bounds.max - bounds.min).as_vec3() * 0.5;
        self.directions = directions;
        self.all = if directions.count == LINES_MAX { u64::MAX } else { (1 << directions.count) - 1 };
        let h = self.half;
        let faces = [h.y * h.z, h.z * h.x, h.x * h.y];
        // Bounded, so that no index is checked and the loops become vectors
        let count = directions.count.min(LINES_MAX);
        for i in 0..count {
            let d = [directions.along[0][i], directions.along[1][i], directions.along[2][i]];
            let shares = [faces[0] * d[0].abs(), faces[1] * d[1].abs(), faces[2] * d[2].abs()];
            let total = (shares[0] + shares[1]) + shares[2];
            let moved = |axis: usize| {
                let sum = directions.entry[axis][i] + shift[axis];
                if sum >= 1.0 { sum - 1.0 } else { sum }
            };
            let (a, b) = (moved(0) * total, 2.0 * moved(1) - 1.0);
            // Which face, and where on it
            let (in_x, in_y) = (a < shares[0], a < shares[0] + shares[1]);
            let share = if in_x {
                shares[0]
            } else if in_y {
                shares[1]
            } else {
                shares[2]
            };
            let below = if in_x {
                0.0
            } else if in_y {
                shares[0]
            } else {
                shares[0] + shares[1]
            };
            let a = 2.0 * ((a - below) / share.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0) - 1.0;
            let front = [-h.x.copysign(d[0]), -h.y.copysign(d[1]), -h.z.copysign(d[2])];
            let x = if in_x {
                front[0]
            } else if in_y {
                b * h.x
            } else {
                a * h.x
            };
            let y = if in_x {
                a * h.y
            } else if in_y {
                front[1]
            } else {
                b * h.y
            };
            let z = if in_x {
                b * h.z
            } else if in_y {
                a * h.z
            } else {
                front[2]
            };
            let start = [x, y, z];
            let mut leave = f32::MAX;
            for axis in 0..3 {
                let inverse = directions.inverse[axis][i];
                let distance = (h[axis] * inverse.abs()) - start[axis] * inverse;
                leave = if distance < leave { distance } else { leave };
                let start = start[axis] + middle[axis];
                self.start[axis][i] = start;
                self.offset[axis][i] = start * inverse;
            }
            self.leave[i] = leave;
            self.shown[i] = 4.0 * total;
        }
        for (across, by) in self.across.iter_mut().zip([&directions.right, &directions.up, &directions.along])
        {
            for i in 0..count {
                across[i] =
                    (self.start[0][i] * by[0][i] + self.start[1][i] * by[1][i]) + self.start[2][i] * by[2][i];
            }
        }
    }

    /// The direction of a line.
    pub fn direction(&self, line: usize) -> Vec3 {
        let along = &self.directions.along;
        Vec3::new(along[0][line], along[1][line], along[2][line])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches lines that miss their box, or that favour a part of what it shows.
    #[test]
    fn lines_cover_the_box_evenly() {
        let bounds = LatticeBox { min: IVec3::new(-31, 10, 1000), max: IVec3::new(70, 60, 1009) };
        let mut lines = Lines::new(Directions::many());
        let (mut inside, mut total) = ([0.0; 8], 0.0);
        for round in 0..1600 {
            lines.fill(&bounds, Directions::many(), round);
            for i in 0..LINES_MAX {
                let at = |t: f32| {
                    let start = Vec3::new(lines.start[0][i], lines.start[1][i], lines.start[2][i]);
                    start + lines.direction(i) * t + lines.center.as_vec3()
                };
                for point in [at(0.0), at(lines.leave[i])] {
                    let (low, high) = (bounds.min.as_vec3() - 0.01, bounds.max.as_vec3() + 0.01);
                    assert!(point.cmpge(low).all() && point.cmple(high).all(), "{point}");
                }
                // Length in each octant, weighted by the line's share of the outline: the octant's volume
                let steps = 16;
                for step in 0..steps {
                    let point = at(lines.leave[i] * (step as f32 + 0.5) / steps as f32);
                    let octant = (0..3)
                        .map(|a| usize::from(2.0 * point[a] > (bounds.min + bounds.max)[a] as f32) << a)
                        .sum::<usize>();
                    let weight = f64::from(lines.shown[i] * lines.leave[i]);
                    inside[octant] += weight;
                    total += weight;
                }
            }
        }
        // Of 102,400 independent lines an octant's share would have a standard deviation of 0.001
        assert!(inside.iter().all(|&sum| (sum / total - 0.125).abs() < 0.004), "{inside:?} of {total}");
    }
}
