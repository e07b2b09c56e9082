//! How much area geometry has and which way it faces: sums that add up from faces to nodes.
//!
//! With A the area of the faces and N the mean of n n' over it, the geometry shows about sqrt(d'Sd) to a direction d, with
//! S = A² (5/8 N + 3/8 N²): exact for what is flat, for what faces all ways equally, and for a cylinder.

use glam::{Mat3, Vec3};
use serde::{Deserialize, Serialize};

use super::kernel::Kernel;
use super::opacity;
use super::shapes::{Shape, Shapes, TRIANGLES};
use crate::brick::leaf::{FACES_MAX, Kind};

/// Sums over faces, each weighted by its opacity. Areas are squared lattice steps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Moments {
    /// Area. A solid counts half its surface, since a line that meets it does so twice.
    pub area: f32,
    /// Sum of area times n n': xx, yy, zz, xy, yz, xz.
    pub facing: [f32; 6],
    /// Whether some face lets light through.
    pub is_transparent: bool,
}

impl Moments {
    /// Adds other geometry.
    pub fn add(&mut self, other: &Self) {
        self.area += other.area;
        self.facing.iter_mut().zip(&other.facing).for_each(|(sum, value)| *sum += value);
        self.is_transparent |= other.is_transparent;
    }

    /// The sums of a leaf.
    ///
    /// # Safety
    /// The instruction set of `K` is available.
    #[inline(always)]
    pub unsafe fn of<K: Kernel>(shapes: &Shapes, shape: &Shape) -> Self {
        match shapes.special(shape) {
            // SAFETY: the caller's
            None => unsafe { Self::of_triangles::<K>(shapes, shape, [1.0; TRIANGLES]) },
            Some(special) => {
                let weights = special.extinctions.map(opacity);
                let mut sums = if shape.kind == Kind::Round {
                    Self::of_round(shapes, shape, &special.radii, weights)
                } else {
                    let mut lanes = weights;
                    if shape.kind != Kind::Triangles {
                        lanes.copy_within(..FACES_MAX, FACES_MAX);
                    }
                    // SAFETY: the caller's
                    unsafe { Self::of_triangles::<K>(shapes, shape, lanes) }
                };
                sums.is_transparent = weights[..usize::from(shape.faces)].iter().any(|&weight| weight < 1.0);
                sums
            }
        }
    }

    #[inline(always)]
    unsafe fn of_triangles<K: Kernel>(shapes: &Shapes, shape: &Shape, weights: [f32; TRIANGLES]) -> Self {
        let blocks = [shapes.block(shape), shapes.second_block(shape)];
        let reference = [0, 1, 2].map(|axis| blocks[0][axis][0]);
        let mut corners = [[[0.0_f32; TRIANGLES]; 3]; 3];
        // SAFETY: the caller's
        unsafe { K::corners(shape, blocks, reference, &mut corners) };
        let [a, b, c] = &corners;
        let mut terms = [[0.0_f32; TRIANGLES]; 7];
        for lane in 0..TRIANGLES {
            let u = [0, 1, 2].map(|axis| b[axis][lane] - a[axis][lane]);
            let v = [0, 1, 2].map(|axis| c[axis][lane] - a[axis][lane]);
            let (x, y, z) = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]);
            let double = ((x * x + y * y) + z * z).sqrt();
            let weight = if shape.present >> lane & 1 != 0 { weights[lane] } else { 0.0 };
            // Area times n n' is half of m m' / |m|, with m the cross product
            let scale = 0.5 * weight / double.max(f32::MIN_POSITIVE);
            let all = [
                0.5 * double * weight,
                x * x * scale,
                y * y * scale,
                z * z * scale,
                x * y * scale,
                y * z * scale,
                x * z * scale,
            ];
            for (term, value) in terms.iter_mut().zip(all) {
                term[lane] = value;
            }
        }
        let sum = |term: usize| {
            let t = &terms[term];
            let mut four = [0.0; 4];
            (0..4).for_each(|i| four[i] = (t[i] + t[i + 4]) + (t[i + 8] + t[i + 12]));
            (four[0] + four[1]) + (four[2] + four[3])
        };
        let facing = [sum(1), sum(2), sum(3), sum(4), sum(5), sum(6)];
        Self { area: sum(0), facing, is_transparent: false }
    }

    /// Spheres and round cones: the mantle counts as an open half of it, which shows as much as the whole.
    fn of_round(shapes: &Shapes, shape: &Shape, radii: &[f32], weights: [f32; TRIANGLES]) -> Self {
        let mut sums = Self::default();
        for face in 0..usize::from(shape.faces) {
            let ends = [shape.corners[0][face], shape.corners[1][face]];
            let [ra, rb] = ends.map(|end| radii[usize::from(end)]);
            let axis = (shapes.vertex(shape, ends[1]) - shapes.vertex(shape, ends[0])).as_vec3();
            let length = axis.length();
            let mantle = 0.5 * std::f32::consts::PI * (ra + rb) * length * weights[face];
            let cap = std::f32::consts::PI * (ra * ra + rb * rb) * weights[face];
            let a = axis / length.max(f32::MIN_POSITIVE);
            sums.area += mantle + cap;
            let across =
                [1.0 - a.x * a.x, 1.0 - a.y * a.y, 1.0 - a.z * a.z, -a.x * a.y, -a.y * a.z, -a.x * a.z];
            for (i, (sum, across)) in sums.facing.iter_mut().zip(across).enumerate() {
                *sum += 0.5 * mantle * across + if i < 3 { cap / 3.0 } else { 0.0 };
            }
        }
        sums
    }

    /// N: the mean of n n' over the area.
    fn mean(&self) -> Mat3 {
        let [xx, yy, zz, xy, yz, xz] = self.facing.map(|sum| sum / self.area.max(f32::MIN_POSITIVE));
        Mat3::from_cols(Vec3::new(xx, xy, xz), Vec3::new(xy, yy, yz), Vec3::new(xz, yz, zz))
    }

    /// S: xx, yy, zz, xy, yz, xz.
    pub fn shown(&self) -> [f32; 6] {
        let mean = self.mean();
        let square = mean * mean;
        let s = |column: usize, row: usize| {
            (0.625 * mean.col(column)[row] + 0.375 * square.col(column)[row]) * (self.area * self.area)
        };
        [s(0, 0), s(1, 1), s(2, 2), s(0, 1), s(1, 2), s(0, 2)]
    }

    /// The direction that most of the area faces, and which share of n n' lies along it: 1 for what is flat, 1/3 for what faces
    /// all ways.
    pub fn normal(&self) -> (Vec3, f32) {
        let mean = self.mean();
        // Powers of the matrix leave its largest axis; the largest column has it
        let mut power = mean;
        for _ in 0..5 {
            let trace = power.col(0).x + power.col(1).y + power.col(2).z;
            power *= 1.0 / trace.max(f32::MIN_POSITIVE);
            power = power * power;
        }
        let columns = [power.col(0), power.col(1), power.col(2)];
        let largest = columns.into_iter().fold(Vec3::ZERO, |best, column| {
            if column.length_squared() > best.length_squared() { column } else { best }
        });
        let normal = largest.normalize_or(Vec3::Z);
        (normal, normal.dot(mean * normal))
    }
}
