//! What lights a scene from afar: a latitude-longitude map and perhaps a sun, and its spherical harmonics.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::latlong::LatLong;
use super::sky::{self, Sky, SunPosition};
use super::{exr_map, rgbe};
use crate::error::nearest;
use crate::scene::UpAxis;
use crate::shade::sh::{self, COEFFICIENTS_MAX};
use crate::{Error, Result};

/// Light from infinitely far away, in a frame of its own: +y up, -z in the middle of the map, +x right of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Environment {
    map: LatLong,
    sun: Option<Sun>,
    repaired_pixels: u64,
}

/// A sun: too small for a map's pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sun {
    /// The unit vector towards it in the map's frame.
    pub direction: DVec3,
    /// Irradiance on a plane that faces it, linear sRGB.
    pub irradiance: [f32; 3],
    /// Half its angular diameter.
    pub radius_radians: f64,
}

/// What tapers the bands of the light, so that a sharp sun does not ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Window {
    /// Nothing does: the plain projection.
    None,
    /// Band l of n times (1 + cos(πl/n)) / 2.
    Hann,
    /// Band l of n times sin(πl/n) / (πl/n), softer than [`Hann`](Self::Hann).
    Lanczos,
}

impl Window {
    /// The factor of band `l` of `bands`.
    fn factor(self, l: usize, bands: usize) -> f64 {
        let x = std::f64::consts::PI * l as f64 / bands as f64;
        match self {
            Self::None => 1.0,
            Self::Hann => 0.5 * (1.0 + x.cos()),
            Self::Lanczos if l == 0 => 1.0,
            Self::Lanczos => x.sin() / x,
        }
    }
}

impl Environment {
    /// The sky of this name (`sky`, `overcast`, `sunset`), or else the file of this path.
    ///
    /// # Errors
    /// As [`load`](Self::load); a hint if the name is nearly a sky's.
    pub fn open(name_or_path: &str) -> Result<Self> {
        if let Some((_, sky)) = Sky::ALL.iter().find(|(name, _)| *name == name_or_path) {
            return Self::sky(*sky, None);
        }
        let path = Path::new(name_or_path);
        if path.extension().is_none() && !path.exists() {
            let error = Error::invalid(format!("there is no sky or file `{}`", name_or_path.escape_debug()));
            let names = Sky::ALL.map(|(name, _)| name);
            return Err(match nearest(name_or_path, names) {
                Some(name) => error.hint(format!("did you mean `{name}`")),
                None => {
                    error.hint(format!("the skies are `{}`; files end in .hdr or .exr", names.join("`, `")))
                }
            });
        }
        Self::load(path)
    }

    /// A latitude-longitude map from a Radiance (`.hdr`, `.pic`) or OpenEXR (`.exr`) file of at most 16,384 × 8,192
    /// pixels. Memory stays bounded: maps above 2048 × 1024 are averaged to that while they are read.
    ///
    /// # Errors
    /// When the file's type is unknown, or it is unreadable, truncated, broken or too large.
    pub fn load(path: &Path) -> Result<Self> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        let (map, repaired_pixels) = match extension.as_str() {
            "hdr" | "pic" | "rgbe" => rgbe::read(path)?,
            "exr" => exr_map::read(path)?,
            other => {
                let message = format!("`.{}` is not a type of environment map", other.escape_debug());
                return Err(Error::unsupported(message)
                    .at(path)
                    .hint("use a latitude-longitude .hdr or .exr file"));
            }
        };
        Ok(Self { map, sun: None, repaired_pixels })
    }

    /// A built-in sky, with its own sun position or another.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) unless the sun stands 1° to 90° above the horizon.
    pub fn sky(sky: Sky, sun: Option<SunPosition>) -> Result<Self> {
        let position = sun.unwrap_or_else(|| sky.sun_position());
        let elevation = position.elevation_degrees;
        if !(sky::ELEVATION_MIN_DEGREES..=90.0).contains(&elevation) || !position.azimuth_degrees.is_finite()
        {
            return Err(Error::invalid(format!("a sun `{elevation}` degrees above the horizon"))
                .hint("the sky's model holds from 1 to 90 degrees"));
        }
        let (map, sun) = sky::render(sky, position);
        Ok(Self { map, sun, repaired_pixels: 0 })
    }

    /// An environment of the same radiance everywhere.
    pub fn uniform(rgb: [f32; 3]) -> Self {
        Self::from_map(LatLong::from_fn(512, 256, |_| rgb))
    }

    /// An environment that is a map and nothing else.
    pub fn from_map(map: LatLong) -> Self {
        Self { map, sun: None, repaired_pixels: 0 }
    }

    /// Pixels of the file that were not finite or negative, and were replaced.
    pub fn repaired_pixels(&self) -> u64 {
        self.repaired_pixels
    }

    /// Its sun, where it has one.
    pub fn sun(&self) -> Option<&Sun> {
        self.sun.as_ref()
    }

    /// Radiance from the unit vector `direction` of the map's frame, sun included.
    pub fn radiance(&self, direction: DVec3) -> [f32; 3] {
        let mut radiance = self.map.radiance(direction);
        if let Some(sun) = &self.sun
            && direction.dot(sun.direction) > sun.radius_radians.cos()
        {
            let solid_angle = std::f64::consts::PI * sun.radius_radians * sun.radius_radians;
            for (sum, value) in radiance.iter_mut().zip(sun.irradiance) {
                *sum += (f64::from(value) / solid_angle) as f32;
            }
        }
        radiance
    }

    /// Its spherical harmonics in the scene's frame, per colour; coefficients past `bands`² are zero.
    ///
    /// # Panics
    /// When `bands` is not 1 to 6.
    pub fn project(
        &self,
        bands: usize,
        scene_from_map: DMat3,
        window: Window,
    ) -> [[f64; COEFFICIENTS_MAX]; 3] {
        let sun = self.sun.iter().map(|sun| (sun.direction, 1.0, sun.irradiance));
        let samples = self.map.samples().chain(sun);
        let turned =
            samples.map(|(direction, solid_angle, rgb)| (scene_from_map * direction, solid_angle, rgb));
        let mut light = sh::project(bands, turned);
        for color in &mut light {
            for l in 0..bands {
                let factor = window.factor(l, bands);
                color[l * l..(l + 1) * (l + 1)].iter_mut().for_each(|value| *value *= factor);
            }
        }
        light
    }
}

/// Turns the map's frame into the scene's: about the up axis by `rotation_degrees`, counter-clockwise seen from
/// above, then onto the scene's axes.
///
/// With y up, the map's axes are the scene's: -z is in the middle. With z up the map is turned by 90° about x, as
/// USD's converters do: the middle of the map is the scene's +y, right of it is +x.
pub fn scene_from_map(up: UpAxis, rotation_degrees: f64) -> DMat3 {
    let turn = DMat3::from_rotation_y(rotation_degrees.to_radians());
    match up {
        UpAxis::Y => turn,
        UpAxis::Z => DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y) * turn,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;

    fn spot(axis: DVec3) -> Environment {
        let glow = move |d: DVec3| [(50.0 * (d.dot(axis) - 1.0)).exp() as f32; 3];
        Environment::from_map(LatLong::from_fn(256, 128, glow))
    }

    /// Catches light that comes from the wrong side: a bright spot in the map's middle, to its right, or above
    /// must give the coefficients their signs, in both kinds of scene.
    #[test]
    fn a_bright_spot_has_the_right_signs() {
        for (axis, up, expected) in [
            (DVec3::NEG_Z, UpAxis::Y, [0.0, -1.0, 0.0]),
            (DVec3::X, UpAxis::Y, [0.0, 0.0, 1.0]),
            (DVec3::Y, UpAxis::Y, [1.0, 0.0, 0.0]),
            (DVec3::NEG_Z, UpAxis::Z, [1.0, 0.0, 0.0]),
            (DVec3::X, UpAxis::Z, [0.0, 0.0, 1.0]),
            (DVec3::Y, UpAxis::Z, [0.0, 1.0, 0.0]),
        ] {
            let light = spot(axis).project(2, scene_from_map(up, 0.0), Window::None)[1];
            for (i, sign) in expected.into_iter().enumerate() {
                // Coefficients 1, 2, 3 go with y, z, x.
                let ratio = light[i + 1] / light[0] / 3.0_f64.sqrt();
                assert!((ratio - 0.98 * sign).abs() < 0.03, "{axis} {up:?}: {ratio}, {sign} expected");
            }
        }
        // A quarter turn, counter-clockwise from above, brings what is ahead (-z) to the left (-x).
        let light = spot(DVec3::NEG_Z).project(2, scene_from_map(UpAxis::Y, 90.0), Window::None)[0];
        assert!(light[3] < -0.9 * 3.0_f64.sqrt() * light[0], "{light:?}");
    }

    /// Catches a sun that lights with the wrong strength: its first coefficient is irradiance × Y_00.
    #[test]
    fn a_sun_adds_its_irradiance() {
        let with = Environment::sky(Sky::Clear, None).expect("a sky");
        let without = Environment { sun: None, ..with.clone() };
        let identity = scene_from_map(UpAxis::Y, 0.0);
        let a = with.project(3, identity, Window::None);
        let b = without.project(3, identity, Window::None);
        let sun = with.sun().expect("a sun");
        for color in 0..3 {
            let expected = f64::from(sun.irradiance[color]);
            assert!((a[color][0] - b[color][0] - expected * 0.282_095).abs() < 1e-5);
            assert!((a[color][1] - b[color][1] - expected * 0.488_603 * sun.direction.y).abs() < 1e-5);
        }
    }

    /// Catches a window that touches the mean or does not fall off.
    #[test]
    fn windows_taper() {
        for window in [Window::Hann, Window::Lanczos] {
            let factors: Vec<f64> = (0..5).map(|l| window.factor(l, 5)).collect();
            assert_eq!(factors[0], 1.0);
            assert!(factors.windows(2).all(|pair| pair[0] > pair[1] && pair[1] > 0.0), "{factors:?}");
        }
        assert!((Window::Hann.factor(1, 2) - 0.5).abs() < 1e-12);
    }

    /// Catches a slip of the hand without a hint, and an impossible sun.
    #[test]
    fn wrong_names_get_a_hint() {
        let error = Environment::open("sunst").expect_err("no such sky");
        assert_eq!((error.kind(), error.hint_text()), (ErrorKind::Invalid, Some("did you mean `sunset`")));
        assert_eq!(Environment::open("a.jpg").expect_err("no map").kind(), ErrorKind::Unsupported);
        assert_eq!(Environment::open("none/such.hdr").expect_err("no file").kind(), ErrorKind::NotFound);
        for elevation_degrees in [-5.0, 91.0, f64::NAN] {
            let sun = SunPosition { elevation_degrees, azimuth_degrees: 0.0 };
            assert!(Environment::sky(Sky::Clear, Some(sun)).is_err(), "{elevation_degrees}");
        }
    }
}
