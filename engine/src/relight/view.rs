//! Where things fall in the picture: camera space, fixed-point screen coordinates, clipping, automatic framing.
//!
//! Positions are subtracted from the eye in double precision and only then rounded, so a camera millions of units
//! from the origin sees what one at the origin sees.

use glam::{DMat3, DMat4, DVec3, Mat3, Vec3};

use crate::math::Bounds;
use crate::scene::{Camera, UpAxis};
use crate::{Error, ErrorKind, Result};

/// Steps of a screen coordinate per sample: 8 bits below the sample, as on GPUs.
pub const STEPS: i32 = 256;

/// Samples from the picture's middle beyond which triangles are clipped, so that products of screen coordinates fit
/// in 64 bits with room to spare.
const GUARD: f32 = 100_000.0;

/// Nothing nearer than this is drawn, metres.
const NEAR_METERS: f64 = 1e-3;

/// Samples of a picture, at most: 16 bytes each make 2 GiB.
pub const SAMPLES_MAX: u64 = 1 << 27;

/// Samples per pixel along each axis, at most.
pub const SUPERSAMPLING_MAX: u32 = 4;

/// A vertex in camera space and on the screen.
#[derive(Clone, Copy, Debug, Default)]
pub struct Vertex {
    /// Camera space, scene units: the camera looks along -z.
    pub at: Vec3,
    /// Outgoing radiance.
    pub rgb: [f32; 3],
    /// Screen position in steps of 1/256 sample, from the corner above left.
    pub screen: [i32; 2],
    /// 1 over the distance along the viewing axis; 0 when the vertex must be clipped first.
    pub inverse_depth: f32,
}

/// A pinhole camera over a grid of samples.
#[derive(Clone, Debug)]
pub struct View {
    eye: DVec3,
    camera_from_world: DMat3,
    /// Samples across.
    pub width: usize,
    /// Samples down.
    pub height: usize,
    /// Samples per pixel along each axis.
    pub supersampling: usize,
    /// Samples per unit of tangent.
    focal: f32,
    near: f32,
}

impl View {
    /// For a camera and so many samples per pixel along each axis.
    ///
    /// # Errors
    /// When the camera has no pixels, more than 2^27 samples, an impossible field of view or a matrix that does not
    /// span space.
    pub fn new(camera: &Camera, supersampling: u32, meters_per_unit: f64) -> Result<Self> {
        if !(1..=SUPERSAMPLING_MAX).contains(&supersampling) {
            return Err(Error::invalid(format!(
                "supersampling of `{supersampling}`, 1 to {SUPERSAMPLING_MAX} are possible"
            )));
        }
        let [width, height] = camera.resolution;
        if width == 0 || height == 0 {
            return Err(Error::invalid(format!("a picture of {width} × {height} pixels")));
        }
        let [width, height] = [width, height].map(|n| u64::from(n) * u64::from(supersampling));
        if width > 1 << 16 || height > 1 << 16 || width * height > SAMPLES_MAX {
            let message = format!("a picture of {width} × {height} samples, at most 2^27 are possible");
            return Err(
                Error::new(ErrorKind::Limit, message).hint("ask for fewer pixels or less supersampling")
            );
        }
        let fov = camera.fov_degrees;
        if !(fov > 0.0 && fov < 180.0) {
            return Err(Error::invalid(format!("a field of view of `{fov}` degrees"))
                .hint("it is vertical, more than 0 and less than 180"));
        }
        let matrix = camera.world_from_camera;
        let axes = DMat3::from_mat4(matrix);
        let columns = [axes.x_axis, axes.y_axis, axes.z_axis].map(DVec3::normalize_or_zero);
        let unit = DMat3::from_cols_array_2d(&columns.map(|column| column.to_array()));
        if !matrix.is_finite() || unit.determinant().abs() < 1e-6 {
            return Err(Error::invalid(format!("the matrix of camera `{}` cannot be inverted", camera.name)));
        }
        let focal = 0.5 * height as f64 / (0.5 * fov.to_radians()).tan();
        Ok(Self {
            eye: matrix.w_axis.truncate(),
            // Scale in a camera's matrix has no meaning for a picture; depths stay in scene units without it.
            camera_from_world: unit.inverse(),
            width: width as usize,
            height: height as usize,
            supersampling: supersampling as usize,
            focal: focal as f32,
            near: (NEAR_METERS / meters_per_unit) as f32,
        })
    }

    /// What brings offsets from `anchor` to camera space: a matrix and the anchor's own place.
    pub fn place(&self, anchor: DVec3) -> (Mat3, Vec3) {
        (self.camera_from_world.as_mat3(), (self.camera_from_world * (anchor - self.eye)).as_vec3())
    }

    /// What turns vectors of camera space into the scene's frame.
    pub fn axes(&self) -> Mat3 {
        self.camera_from_world.inverse().as_mat3()
    }

    /// The unit vector from the eye through a sample position, in the scene's frame.
    pub fn ray(&self, x: f32, y: f32) -> DVec3 {
        let at = Vec3::new(x - 0.5 * self.width as f32, 0.5 * self.height as f32 - y, -self.focal);
        (self.camera_from_world.inverse() * at.as_dvec3()).normalize()
    }

    /// Samples that a length in scene units spans at an inverse depth.
    pub fn samples_per_unit(&self, inverse_depth: f32) -> f32 {
        self.focal * inverse_depth
    }

    /// Computes a vertex's screen position and depth from its place in camera space.
    pub fn project(&self, vertex: &mut Vertex) {
        let depth = -vertex.at.z;
        let inverse = 1.0 / depth;
        let scale = self.focal * inverse;
        let (x, y) = (vertex.at.x * scale, -vertex.at.y * scale);
        // Comparisons are false for NaN, which clipping then drops.
        if depth >= self.near && x.abs() <= GUARD && y.abs() <= GUARD {
            let step = STEPS as f32;
            vertex.screen = [
                ((x + 0.5 * self.width as f32) * step).round_ties_even() as i32,
                ((y + 0.5 * self.height as f32) * step).round_ties_even() as i32,
            ];
            vertex.inverse_depth = inverse;
        } else {
            vertex.inverse_depth = 0.0;
        }
    }

    /// Which planes of the view a point within `radius` lies wholly outside of, a bit each: left, right, top,
    /// bottom, near. A grid whose vertices share a bit is not seen.
    pub fn outside(&self, at: Vec3, radius: f32) -> u8 {
        let depth = -at.z;
        // A splat is at least a few samples wide.
        let margin = |half: usize| {
            let tangent = (0.5 * half as f32 + 4.0 * self.supersampling as f32) / self.focal;
            (tangent * depth) + radius * (1.0 + tangent)
        };
        let (x, y) = (margin(self.width), margin(self.height));
        u8::from(at.x < -x)
            | u8::from(at.x > x) << 1
            | u8::from(at.y > y) << 2
            | u8::from(at.y < -y) << 3
            | u8::from(depth + radius < self.near) << 4
    }

    /// Clips a convex polygon of at most 4 corners by the near plane and the guard band (Sutherland and Hodgman
    /// 1974); what remains is in `polygon`, projected.
    pub fn clip(&self, polygon: &mut Vec<Vertex>, spare: &mut Vec<Vertex>) {
        // A little inside of what `project` accepts, so that rounding cannot put a corner outside again. Distances are
        // taken in double precision: an edge may be 1e7 times as long as the near plane is far.
        let side = 0.999 * f64::from(GUARD / self.focal);
        let near = 1.001 * f64::from(self.near);
        let distances: [fn(DVec3, f64, f64) -> f64; 5] = [
            |at, _, near| -at.z - near,
            |at, side, _| side * -at.z - at.x,
            |at, side, _| side * -at.z + at.x,
            |at, side, _| side * -at.z - at.y,
            |at, side, _| side * -at.z + at.y,
        ];
        if !polygon.iter().all(|corner| corner.at.is_finite()) {
            polygon.clear();
        }
        for distance in distances {
            spare.clear();
            for (i, corner) in polygon.iter().enumerate() {
                let next = &polygon[(i + 1) % polygon.len()];
                let (a, b) =
                    (distance(corner.at.as_dvec3(), side, near), distance(next.at.as_dvec3(), side, near));
                if a >= 0.0 {
                    spare.push(*corner);
                }
                if (a >= 0.0) != (b >= 0.0) {
                    spare.push(between(corner, next, a / (a - b)));
                }
            }
            std::mem::swap(polygon, spare);
        }
        polygon.iter_mut().for_each(|corner| self.project(corner));
        if polygon.iter().any(|corner| corner.inverse_depth == 0.0) {
            polygon.clear();
        }
    }
}

/// The point at `t` between two vertices, not projected yet.
fn between(a: &Vertex, b: &Vertex, t: f64) -> Vertex {
    let rgb = std::array::from_fn(|i| a.rgb[i] + t as f32 * (b.rgb[i] - a.rgb[i]));
    Vertex { at: a.at.as_dvec3().lerp(b.at.as_dvec3(), t).as_vec3(), rgb, ..Vertex::default() }
}

/// A camera that sees all of `bounds`, from the front, a little from the right and above.
///
/// # Errors
/// When the bounds are empty.
pub fn frame(bounds: &Bounds, up: UpAxis, resolution: [u32; 2]) -> Result<Camera> {
    if bounds.is_empty() {
        return Err(Error::invalid("there is nothing to frame: no vertex was baked"));
    }
    let fov_degrees: f64 = 35.0;
    let half = 0.5 * fov_degrees.to_radians();
    // The narrower direction decides.
    let aspect = f64::from(resolution[0].max(1)) / f64::from(resolution[1].max(1));
    let narrow = if aspect < 1.0 { (half.tan() * aspect).atan() } else { half };
    let radius = (0.5 * bounds.size().length()).max(1e-6);
    let (up_axis, back) = match up {
        UpAxis::Y => (DVec3::Y, DVec3::new(0.45, 0.4, 1.0)),
        UpAxis::Z => (DVec3::Z, DVec3::new(0.45, -1.0, 0.4)),
    };
    let z = back.normalize();
    let x = up_axis.cross(z).normalize();
    let eye = bounds.center() + z * (radius / narrow.sin());
    Ok(Camera {
        name: "automatic".into(),
        fov_degrees,
        resolution,
        world_from_camera: DMat4::from_cols(
            x.extend(0.0),
            z.cross(x).extend(0.0),
            z.extend(0.0),
            eye.extend(1.0),
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(eye: DVec3) -> Camera {
        Camera {
            name: "test".into(),
            fov_degrees: 90.0,
            resolution: [200, 100],
            world_from_camera: DMat4::from_translation(eye),
        }
    }

    fn project(view: &View, world: DVec3) -> Vertex {
        let (axes, origin) = view.place(world);
        let mut vertex = Vertex { at: axes * Vec3::ZERO + origin, ..Vertex::default() };
        view.project(&mut vertex);
        vertex
    }

    /// Catches a picture that is mirrored, upside down, or has its field of view across instead of down.
    #[test]
    fn points_fall_where_a_camera_sees_them() {
        let view = View::new(&camera(DVec3::ZERO), 1, 1.0).expect("a view");
        for (world, x, y) in
            [((0.0, 0.0, -5.0), 100, 50), ((2.0, 1.0, -2.0), 150, 25), ((-1.0, -1.0, -1.0), 50, 100)]
        {
            let vertex = project(&view, DVec3::from(world));
            assert_eq!(vertex.screen, [x * STEPS, y * STEPS], "{world:?}");
        }
        assert_eq!(project(&view, DVec3::new(0.0, 0.0, 1.0)).inverse_depth, 0.0);
        let ray = view.ray(150.0, 25.0);
        assert!((ray - DVec3::new(2.0, 1.0, -2.0).normalize()).length() < 1e-7, "{ray}");
    }

    /// Catches single precision where it does harm: 4,000 km from the origin a millimetre must still move a point.
    #[test]
    fn far_from_the_origin_nothing_is_lost() {
        let far = DVec3::new(4e6, 5e5, -4e6);
        let view = View::new(&camera(far), 1, 1.0).expect("a view");
        let home = View::new(&camera(DVec3::ZERO), 1, 1.0).expect("a view");
        for offset in [DVec3::new(0.101, 0.05, -1.0), DVec3::new(0.102, 0.05, -1.0)] {
            assert_eq!(project(&view, far + offset).screen, project(&home, offset).screen);
        }
    }

    /// Catches clipping that loses the visible part, or leaves corners that cannot be projected.
    #[test]
    fn a_triangle_through_the_eye_is_clipped() {
        let view = View::new(&camera(DVec3::ZERO), 1, 1.0).expect("a view");
        let corner = |x: f32, y: f32, z: f32| Vertex { at: Vec3::new(x, y, z), ..Vertex::default() };
        let mut polygon = vec![corner(-1.0, -1.0, 5.0), corner(1.0, -1.0, 5.0), corner(0.0, -1.0, -50.0)];
        view.clip(&mut polygon, &mut Vec::new());
        assert!(polygon.len() >= 3 && polygon.iter().all(|v| v.inverse_depth > 0.0), "{polygon:?}");
        let mut behind = vec![corner(-1.0, 0.0, 1.0), corner(1.0, 0.0, 1.0), corner(0.0, 1.0, 2.0)];
        view.clip(&mut behind, &mut Vec::new());
        assert!(behind.is_empty());
        let mut broken = vec![corner(f32::NAN, 0.0, -1.0), corner(1.0, 0.0, -1.0), corner(0.0, 1.0, -1.0)];
        view.clip(&mut broken, &mut Vec::new());
        assert!(broken.is_empty());
    }

    /// Catches framing that cuts the scene off or stands on its side.
    #[test]
    fn framing_shows_every_corner_of_the_bounds() {
        for (up, resolution) in [(UpAxis::Y, [160, 90]), (UpAxis::Z, [90, 160])] {
            let bounds = Bounds { min: DVec3::new(1e6, 2.0, 3.0), max: DVec3::new(1e6 + 4.0, 9.0, 5.0) };
            let view = View::new(&frame(&bounds, up, resolution).expect("framed"), 1, 1.0).expect("a view");
            let mut heights = Vec::new();
            for corner in 0..8 {
                let pick =
                    |axis: usize| if corner >> axis & 1 == 0 { bounds.min[axis] } else { bounds.max[axis] };
                let world = DVec3::new(pick(0), pick(1), pick(2));
                let vertex = project(&view, world);
                let [x, y] = vertex.screen.map(|s| s / STEPS);
                let inside =
                    (0..=resolution[0] as i32).contains(&x) && (0..=resolution[1] as i32).contains(&y);
                assert!(vertex.inverse_depth > 0.0 && inside, "{up:?}: {world} at {x} {y}");
                heights.push((if up == UpAxis::Y { world.y } else { world.z }, y));
            }
            let mean = |low: bool| -> f64 {
                let middle = if up == UpAxis::Y { 5.0 } else { 4.0 };
                let chosen = heights.iter().filter(|(h, _)| (*h < middle) == low);
                chosen.map(|(_, y)| f64::from(*y)).sum::<f64>() / 4.0
            };
            assert!(mean(true) > mean(false), "up is down: {heights:?}");
        }
        assert!(frame(&Bounds::EMPTY, UpAxis::Y, [8, 8]).is_err());
    }

    /// Catches impossible cameras that reach the rasteriser.
    #[test]
    fn impossible_cameras_are_refused() {
        let good = camera(DVec3::ZERO);
        let flat = DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0));
        for bad in [
            Camera { resolution: [0, 100], ..good.clone() },
            Camera { resolution: [100_000, 100_000], ..good.clone() },
            Camera { resolution: [u32::MAX, 1], ..good.clone() },
            Camera { fov_degrees: 180.0, ..good.clone() },
            Camera { fov_degrees: f64::NAN, ..good.clone() },
            Camera { world_from_camera: flat, ..good.clone() },
        ] {
            assert!(View::new(&bad, 2, 1.0).is_err(), "{bad:?}");
        }
        assert!(View::new(&good, 0, 1.0).is_err() && View::new(&good, 9, 1.0).is_err());
    }
}
