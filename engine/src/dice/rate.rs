//! How fine to dice: an edge length in the world, or pixels of a camera's picture.

use glam::{DMat4, DVec3};

use crate::scene::{Camera, Dice, Edge};
use crate::{Error, Result};

/// Segments of an edge are a power of two; this is the largest power.
pub const LEVEL_MAX: u8 = 8;

/// How fine to dice.
#[derive(Clone, Debug, PartialEq)]
pub enum Rate {
    /// No edge longer than so many scene units, about.
    World(f64),
    /// No edge longer than so many pixels of a picture, about.
    Camera(CameraRate),
}

/// A picture to dice for.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraRate {
    camera_from_world: DMat4,
    /// Half the picture's width and height at a distance of one.
    half: [f64; 2],
    /// World units per wanted edge at a distance of one.
    edge: f64,
}

/// Nearer than this part of the picture's height, at a distance of one, nothing gets finer: a million to one.
const NEAREST: f64 = 1e-6;

impl Rate {
    /// The rate that a scene or the command line asks for, if any.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for a camera that is not there.
    pub fn of(dice: &Dice, cameras: &[Camera]) -> Result<Option<Self>> {
        match (&dice.edge, dice.camera(cameras)?) {
            (Some(Edge::Camera { pixels, .. }), Some(camera)) => Self::camera(camera, *pixels).map(Some),
            (Some(Edge::World(size)), _) => Self::world(*size).map(Some),
            (Some(Edge::Camera { name, .. }), None) => Err(Error::invalid(format!("no camera `{name}`"))),
            (None, _) => Ok(None),
        }
    }

    /// A rate of `size` scene units.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when it is no positive number.
    pub fn world(size: f64) -> Result<Self> {
        if size.is_finite() && size > 0.0 {
            return Ok(Self::World(size));
        }
        Err(Error::invalid(format!("a dice size of `{size}`, expected more than 0")))
    }

    /// A rate of `pixels` of the picture of `camera`.
    ///
    /// Outside of the picture edges grow with the angle to it: at a whole picture's width beside it they are three times as
    /// long, behind the camera as long as at three widths. So what is not seen stays, as occluders must, and costs little
    /// (Kontkanen et al. 2010, section 3.1, tessellate it by a large overscan or a metric of the world).
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when `pixels` is no positive number.
    pub fn camera(camera: &Camera, pixels: f64) -> Result<Self> {
        if !(pixels.is_finite() && pixels > 0.0) {
            return Err(Error::invalid(format!("a dice size of `{pixels}` pixels, expected more than 0")));
        }
        let turns = camera.fov_degrees / 720.0;
        let (cos, sin) = crate::math::trig::cos_sin_turns(turns);
        let half_height = sin / cos;
        let [width, height] = camera.resolution.map(f64::from);
        Ok(Self::Camera(CameraRate {
            camera_from_world: camera.world_from_camera.inverse(),
            half: [half_height * width / height, half_height],
            edge: pixels * 2.0 * half_height / height,
        }))
    }

    /// The wanted length of an edge at a place, in scene units.
    pub fn edge_at(&self, place: DVec3) -> f64 {
        match self {
            Self::World(size) => *size,
            Self::Camera(rate) => rate.edge_at(place),
        }
    }

    /// The length that the parts of an edge must not exceed: the least of those wanted at its ends and its middle.
    fn wanted(&self, a: DVec3, b: DVec3) -> f64 {
        match self {
            Self::World(size) => *size,
            Self::Camera(_) => self.edge_at(a).min(self.edge_at(b)).min(self.edge_at(0.5 * (a + b))),
        }
    }

    /// How often an edge is halved: so that its parts are no longer than wanted, but not more than [`LEVEL_MAX`] times.
    pub fn level(&self, a: DVec3, b: DVec3) -> u8 {
        let wanted = self.wanted(a, b);
        // By doubling: a logarithm may differ between machines
        let (mut length, mut level) = (a.distance(b), 0);
        while length > wanted && level < LEVEL_MAX {
            length *= 0.5;
            level += 1;
        }
        level
    }

    /// Whether the parts of an edge are longer than wanted all the same.
    pub fn falls_short(&self, a: DVec3, b: DVec3) -> bool {
        a.distance(b) > self.wanted(a, b) * f64::from(1_u32 << LEVEL_MAX)
    }
}

impl CameraRate {
    fn edge_at(&self, place: DVec3) -> f64 {
        let p = self.camera_from_world.transform_point3(place);
        let distance = p.length();
        let depth = -p.z;
        // How far outside, in pictures: 0 inside, 1 a whole picture's half beside it
        let beside = |x: f64, half: f64| match depth > 0.0 {
            true => (x.abs() / (depth * half) - 1.0).clamp(0.0, 3.0),
            false => 3.0,
        };
        let outside = beside(p.x, self.half[0]).max(beside(p.y, self.half[1]));
        (self.edge * distance).max(self.edge * NEAREST) * (1.0 + outside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Rate {
        let world_from_camera = DMat4::from_translation(DVec3::new(0.0, 0.0, 10.0));
        let camera =
            Camera { name: "a".into(), fov_degrees: 90.0, resolution: [200, 100], world_from_camera };
        Rate::camera(&camera, 2.0).unwrap()
    }

    /// Catches an edge that is not as long as its pixels, or one that stays fine, or vanishes, outside the picture.
    #[test]
    fn edges_follow_pixels_and_fall_off_outside() {
        let rate = camera();
        // 100 pixels show 20 units at a distance of 10: two pixels are 0.4
        assert!((rate.edge_at(DVec3::ZERO) - 0.4).abs() < 1e-12);
        assert!((rate.edge_at(DVec3::new(0.0, 0.0, 5.0)) - 0.2).abs() < 1e-12);
        let relative = |p: DVec3| rate.edge_at(p) / (p - DVec3::new(0.0, 0.0, 10.0)).length() / 0.04;
        assert!((relative(DVec3::new(19.0, 0.0, 0.0)) - 1.0).abs() < 1e-12);
        assert!((relative(DVec3::new(40.0, 0.0, 0.0)) - 2.0).abs() < 1e-12);
        assert!((relative(DVec3::new(0.0, 400.0, 0.0)) - 4.0).abs() < 1e-12);
        assert!((relative(DVec3::new(0.0, 0.0, 20.0)) - 4.0).abs() < 1e-12);
        assert!(rate.edge_at(DVec3::new(0.0, 0.0, 10.0)) > 0.0);
    }

    /// Catches levels that depend on the direction of an edge, overshoot, or run away.
    #[test]
    fn levels_are_powers_of_two_that_are_just_fine_enough() {
        let rate = Rate::world(1.0).unwrap();
        let level = |length: f64| rate.level(DVec3::ZERO, DVec3::X * length);
        assert_eq!([0.5, 1.0, 1.1, 2.0, 2.1, 4.1].map(level), [0, 0, 1, 1, 2, 3]);
        assert_eq!(level(1e30), LEVEL_MAX);
        assert_eq!([256.0, 257.0].map(|x| rate.falls_short(DVec3::ZERO, DVec3::X * x)), [false, true]);
        let (a, b) = (DVec3::new(3.0, 1.0, -4.0), DVec3::new(-30.0, 0.0, 9.0));
        assert_eq!(camera().level(a, b), camera().level(b, a));
        assert!(Rate::world(0.0).is_err() && Rate::world(f64::NAN).is_err());
    }
}
