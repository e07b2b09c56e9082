//! Built-in skies: a clear day, a sunset, and an overcast one.
//!
//! The clear ones follow Preetham, Shirley and Smits, "A Practical Analytic Model for Daylight" (SIGGRAPH 1999): the
//! sky by their fit of Perez' formula, the sun by their atmosphere's transmittance at three wavelengths. The overcast
//! one is the CIE's (Moon and Spencer 1942). The ground below the horizon is a grey plain lit by all of it.
//! Everything is scaled as a photographer would expose it: a white plate turned to where it is brightest, and to
//! nothing but the environment, has the radiance 1.

use glam::DVec3;

use super::environment::Sun;
use super::latlong::LatLong;

/// The built-in skies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sky {
    /// Sun and blue sky.
    Clear,
    /// Evenly grey, three times as bright above as at the horizon.
    Overcast,
    /// A low warm sun under a blue zenith.
    Sunset,
}

impl Sky {
    /// Every sky with its name.
    pub const ALL: [(&str, Self); 3] =
        [("sky", Self::Clear), ("overcast", Self::Overcast), ("sunset", Self::Sunset)];

    /// Where its sun stands unless something else is asked for.
    pub fn sun_position(self) -> SunPosition {
        match self {
            Self::Clear | Self::Overcast => SunPosition { elevation_degrees: 48.0, azimuth_degrees: 230.0 },
            Self::Sunset => SunPosition { elevation_degrees: 7.0, azimuth_degrees: 245.0 },
        }
    }

    /// Preetham's turbidity: 2 is mountain air, 3 a clear day, 6 haze.
    fn turbidity(self) -> f64 {
        match self {
            Self::Clear | Self::Overcast => 2.5,
            Self::Sunset => 2.2,
        }
    }

    /// Perez' formula is held below this cosine to the zenith, where it divides by zero in the end. By day and in
    /// clear air the fit turns mauve in the last degrees above the horizon; at dusk that band is what glows.
    fn cosine_min(self) -> f64 {
        match self {
            Self::Clear | Self::Overcast => 0.15,
            Self::Sunset => 0.06,
        }
    }
}

/// Where a sun stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SunPosition {
    /// Above the horizon, degrees.
    pub elevation_degrees: f64,
    /// From the middle of the map (-z) to the right, degrees.
    pub azimuth_degrees: f64,
}

impl SunPosition {
    /// The unit vector towards the sun in the map's frame.
    pub fn direction(self) -> DVec3 {
        let (sin_e, cos_e) = self.elevation_degrees.to_radians().sin_cos();
        let (sin_a, cos_a) = self.azimuth_degrees.to_radians().sin_cos();
        DVec3::new(cos_e * sin_a, sin_e, -cos_e * cos_a)
    }
}

/// Lowest sun that the model stands for, degrees.
pub(super) const ELEVATION_MIN_DEGREES: f64 = 1.0;

/// Half the sun's angular diameter.
const SUN_RADIUS_RADIANS: f64 = 0.004_65;

/// Reflectance of the ground below the horizon.
const GROUND_ALBEDO: f64 = 0.18;

/// Size of the maps that skies are stored in: smooth but for the horizon, which lies between two rows.
const MAP_SIZE: [usize; 2] = [512, 256];

/// A sky as a map and, unless overcast, its sun.
pub(super) fn render(sky: Sky, position: SunPosition) -> (LatLong, Option<Sun>) {
    let towards_sun = position.direction();
    let preetham = Preetham::new(sky, towards_sun);
    let above = |d: DVec3| match sky {
        Sky::Overcast => [(1.0 + 2.0 * d.y) / 3.0; 3],
        Sky::Clear | Sky::Sunset => preetham.radiance(d),
    };
    let sun = match sky {
        Sky::Overcast => [0.0; 3],
        Sky::Clear | Sky::Sunset => preetham.sun_irradiance(),
    };

    // Light the ground
    let [width, height] = MAP_SIZE;
    let upper =
        LatLong::from_fn(width, height, |d| if d.y > 0.0 { above(d) } else { [0.0; 3] }.map(|v| v as f32));
    let ground =
        irradiance(&upper, sun, towards_sun, DVec3::Y).map(|v| v * GROUND_ALBEDO / std::f64::consts::PI);
    let whole =
        LatLong::from_fn(width, height, |d| if d.y > 0.0 { above(d) } else { ground }.map(|v| v as f32));

    // Scale to the brightest white plate, which leans towards the sun
    let brightest = (0..=18)
        .map(|step| SunPosition { elevation_degrees: 5.0 * f64::from(step), ..position }.direction())
        .map(|normal| luminance(irradiance(&whole, sun, towards_sun, normal)))
        .fold(0.0, f64::max);
    let scale = std::f64::consts::PI / brightest;
    let map = LatLong::from_fn(width, height, |d| {
        if d.y > 0.0 { above(d) } else { ground }.map(|value| (value * scale) as f32)
    });
    let sun = (sky != Sky::Overcast).then(|| Sun {
        direction: towards_sun,
        irradiance: sun.map(|value| (value * scale) as f32),
        radius_radians: SUN_RADIUS_RADIANS,
    });
    (map, sun)
}

/// What a plate that faces `normal` receives from a map and a sun.
fn irradiance(map: &LatLong, sun: [f64; 3], towards_sun: DVec3, normal: DVec3) -> [f64; 3] {
    let mut sum = sun.map(|value| value * normal.dot(towards_sun).max(0.0));
    for (direction, solid_angle, rgb) in map.samples() {
        let weight = solid_angle * normal.dot(direction).max(0.0);
        sum.iter_mut().zip(rgb).for_each(|(sum, value)| *sum += weight * f64::from(value));
    }
    sum
}

/// Luminance of linear sRGB (IEC 61966-2-1).
fn luminance([r, g, b]: [f64; 3]) -> f64 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// The model's coefficients for a turbidity and a sun. Radiances are in kcd/m², irradiances in klx.
struct Preetham {
    turbidity: f64,
    cosine_min: f64,
    towards_sun: DVec3,
    /// Perez' A to E for luminance Y and chromaticities x and y.
    perez: [[f64; 5]; 3],
    /// Y, x, y at the zenith, divided by Perez' formula there.
    zenith: [f64; 3],
}

impl Preetham {
    fn new(sky: Sky, towards_sun: DVec3) -> Self {
        let t = sky.turbidity();
        // Appendix A.2 of the paper: slopes and intercepts over the turbidity.
        let perez = [
            [
                0.1787 * t - 1.4630,
                -0.3554 * t + 0.4275,
                -0.0227 * t + 5.3251,
                0.1206 * t - 2.5771,
                -0.0670 * t + 0.3703,
            ],
            [
                -0.0193 * t - 0.2592,
                -0.0665 * t + 0.0008,
                -0.0004 * t + 0.2125,
                -0.0641 * t - 0.8989,
                -0.0033 * t + 0.0452,
            ],
            [
                -0.0167 * t - 0.2608,
                -0.0950 * t + 0.0092,
                -0.0079 * t + 0.2102,
                -0.0441 * t - 1.6537,
                -0.0109 * t + 0.0529,
            ],
        ];
        let s = towards_sun.y.clamp(0.0, 1.0).acos();
        let chi = (4.0 / 9.0 - t / 120.0) * (std::f64::consts::PI - 2.0 * s);
        let polynomial = |rows: [[f64; 4]; 3]| {
            let at = |row: [f64; 4]| ((row[0] * s + row[1]) * s + row[2]) * s + row[3];
            (at(rows[0]) * t + at(rows[1])) * t + at(rows[2])
        };
        let absolute = [
            (4.0453 * t - 4.9710) * chi.tan() - 0.2155 * t + 2.4192,
            polynomial([
                [0.00166, -0.00375, 0.00209, 0.0],
                [-0.02903, 0.06377, -0.03202, 0.00394],
                [0.11693, -0.21196, 0.06052, 0.25886],
            ]),
            polynomial([
                [0.00275, -0.00610, 0.00317, 0.0],
                [-0.04214, 0.08970, -0.04153, 0.00516],
                [0.15346, -0.26756, 0.06670, 0.26688],
            ]),
        ];
        let zenith = std::array::from_fn(|i| absolute[i] / formula(&perez[i], 1.0, s));
        Self { turbidity: t, cosine_min: sky.cosine_min(), towards_sun, perez, zenith }
    }

    /// Radiance of the sky in linear sRGB.
    fn radiance(&self, direction: DVec3) -> [f64; 3] {
        let cos_theta = direction.y.max(self.cosine_min);
        let gamma = direction.dot(self.towards_sun).clamp(-1.0, 1.0).acos();
        let [luminance, x, y] =
            std::array::from_fn(|i| self.zenith[i] * formula(&self.perez[i], cos_theta, gamma));
        let (big_x, big_z) = (x / y * luminance, (1.0 - x - y) / y * luminance);
        [
            3.2406 * big_x - 1.5372 * luminance - 0.4986 * big_z,
            -0.9689 * big_x + 1.8758 * luminance + 0.0415 * big_z,
            0.0557 * big_x - 0.2040 * luminance + 1.0570 * big_z,
        ]
        .map(|value| value.max(0.0))
    }

    /// Irradiance by the sun on a plane that faces it, in linear sRGB: what Rayleigh scattering, aerosols and ozone
    /// leave of 128 klx (appendix A.1 of the paper) at 610, 550 and 465 nm.
    fn sun_irradiance(&self) -> [f64; 3] {
        let elevation = self.towards_sun.y.clamp(0.0, 1.0).asin();
        let zenith_degrees = 90.0 - elevation.to_degrees();
        let mass = 1.0 / (elevation.sin() + 0.15 * (93.885 - zenith_degrees).powf(-1.253));
        let beta = 0.046_08 * self.turbidity - 0.045_86;
        [(0.610, 0.120), (0.550, 0.085), (0.465, 0.008)].map(|(micrometres, ozone): (f64, f64)| {
            let depth = 0.008_735 * micrometres.powf(-4.08) + beta * micrometres.powf(-1.3) + 0.35 * ozone;
            128.0 * (-depth * mass).exp()
        })
    }
}

/// Perez' formula for the sky at a cosine to the zenith and an angle γ to the sun.
fn formula([a, b, c, d, e]: &[f64; 5], cos_theta: f64, gamma: f64) -> f64 {
    let cos_gamma = gamma.cos();
    (1.0 + a * (b / cos_theta).exp()) * (1.0 + c * (d * gamma).exp() + e * cos_gamma * cos_gamma)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a sky that is not scaled: no plate may be brighter than 1, and one must nearly be.
    #[test]
    fn the_brightest_white_plate_has_radiance_one_under_every_sky() {
        for (name, sky) in Sky::ALL {
            let position = sky.sun_position();
            let (map, sun) = render(sky, position);
            let strength = sun.map_or([0.0; 3], |sun| sun.irradiance.map(f64::from));
            let radiance = |normal: DVec3| {
                luminance(irradiance(&map, strength, position.direction(), normal)) / std::f64::consts::PI
            };
            let all = LatLong::from_fn(16, 8, |d| [radiance(d) as f32; 3]);
            let most = all.samples().map(|(_, _, [value, ..])| value).fold(0.0, f32::max);
            assert!((0.95..1.01).contains(&most), "{name}: {most}");
            let under = radiance(DVec3::NEG_Y);
            assert!(under > 0.01 && under < 0.19, "{name}: {under} from the ground");
        }
    }

    /// Catches colours and directions that are wrong: the zenith is blue, the low sun red, and the sky brighter
    /// towards it; the paper's zenith luminance at turbidity 2.5 and 42° from the sun is 6.2 kcd/m².
    #[test]
    fn skies_look_like_skies() {
        let (map, sun) = render(Sky::Sunset, Sky::Sunset.sun_position());
        let sun = sun.expect("a sunset has a sun");
        let [r, _, b] = map.radiance(DVec3::Y);
        assert!(b > 1.3 * r, "zenith {r} {b}");
        assert!(sun.irradiance[0] > 2.0 * sun.irradiance[2], "{:?}", sun.irradiance);
        let near = DVec3::new(sun.direction.x, 0.1, sun.direction.z).normalize();
        let far = DVec3::new(-sun.direction.x, 0.1, -sun.direction.z).normalize();
        assert!(map.radiance(near)[0] > 3.0 * map.radiance(far)[0]);

        let preetham = Preetham::new(Sky::Clear, Sky::Clear.sun_position().direction());
        let [r, g, b] = preetham.radiance(DVec3::Y);
        assert!((luminance([r, g, b]) - 6.2).abs() < 0.4, "{}", luminance([r, g, b]));
        assert!(b > g && g > r, "{r} {g} {b}");
    }

    /// Catches an overcast sky that is not the CIE's: zenith to horizon 3 : 1.
    #[test]
    fn the_overcast_sky_is_three_times_as_bright_above() {
        let (map, sun) = render(Sky::Overcast, Sky::Overcast.sun_position());
        assert!(sun.is_none());
        let low = DVec3::new(0.3, 0.01, 0.9).normalize();
        let ratio = map.radiance(DVec3::Y)[1] / map.radiance(low)[1];
        assert!((2.8..3.05).contains(&ratio), "{ratio}");
    }
}
