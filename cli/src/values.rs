//! The values that arguments take: sizes, counts, places, units.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use engine::error::nearest;
use engine::scene::UNITS;
use engine::stream::schema::UpAxis;

/// Bytes: `268435456`, `256MiB`, `1.5GB`. `K`, `M`, `G` and `T` alone are binary, as for Docker and systemd.
pub fn size(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, u64); 13] = [
        ("", 1),
        ("b", 1),
        ("k", 1 << 10),
        ("kib", 1 << 10),
        ("kb", 1_000),
        ("m", 1 << 20),
        ("mib", 1 << 20),
        ("mb", 1_000_000),
        ("g", 1 << 30),
        ("gib", 1 << 30),
        ("gb", 1_000_000_000),
        ("t", 1 << 40),
        ("tib", 1 << 40),
    ];
    scaled(text, &UNITS).ok_or_else(|| "expected a size such as `256MiB`, `1GiB` or `1.5GB`".into())
}

/// A count: `10000000`, `10_000_000`, `10M`, `1.5G`.
pub fn count(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, u64); 4] = [("", 1), ("k", 1_000), ("m", 1_000_000), ("g", 1_000_000_000)];
    match scaled(&text.replace('_', ""), &UNITS) {
        Some(count) if count > 0 => Ok(count),
        _ => Err("expected a whole number above 0, such as `10000000` or `10M`".into()),
    }
}

/// A number, or the word that there is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OrNone(pub Option<i64>);

/// `none`, or a whole number from 0 on.
pub fn number_or_none(text: &str) -> Result<OrNone, String> {
    match (text, text.parse::<i64>()) {
        ("none", _) => Ok(OrNone(None)),
        (_, Ok(number)) if number >= 0 => Ok(OrNone(Some(number))),
        _ => Err("expected a whole number, or `none`".into()),
    }
}

/// A decimal number and a unit, as a whole number of the smallest unit.
fn scaled(text: &str, units: &[(&str, u64)]) -> Option<u64> {
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = (&text[..end], text[end..].trim_start().to_ascii_lowercase());
    let &(_, factor) = units.iter().find(|(name, _)| *name == unit)?;
    if let Ok(whole) = number.parse::<u64>() {
        return whole.checked_mul(factor);
    }
    let value = number.parse::<f64>().ok()? * factor as f64;
    // Fractions of a byte are nobody's intention; beyond 2^53 a fraction of a unit is not exact
    (value.fract() == 0.0 && (0.0..9e15).contains(&value)).then_some(value as u64)
}

/// Three finite numbers: `0,1.7,6`.
pub fn vector(text: &str) -> Result<glam::DVec3, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    match numbers[..] {
        [x, y, z] if text.split(',').count() == 3 && numbers.iter().all(|n| n.is_finite()) => {
            Ok(glam::DVec3::new(x, y, z))
        }
        _ => Err("expected three numbers such as `0,1.7,6`".into()),
    }
}

/// A number that is one.
pub fn finite(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite());
    number.ok_or_else(|| "expected a number".into())
}

/// Pixels across and down: `1280x720`.
pub fn resolution(text: &str) -> Result<[u32; 2], String> {
    let side = |side: &str| side.parse::<u32>().ok().filter(|pixels| (1..=65_536).contains(pixels));
    let sides = text.split_once('x').and_then(|(width, height)| Some([side(width)?, side(height)?]));
    sides.ok_or_else(|| "expected pixels across and down such as `1280x720`".into())
}

/// A unit as scenes name it, or metres per unit as a number.
pub fn meters_per_unit(text: &str) -> Result<f64, String> {
    if let Some((_, meters)) = UNITS.iter().find(|(name, _)| *name == text) {
        return Ok(*meters);
    }
    match text.parse::<f64>() {
        Ok(meters) if meters.is_finite() && meters > 0.0 => Ok(meters),
        _ => {
            let names = UNITS.map(|(name, _)| name);
            let near = nearest(text, names).map_or(String::new(), |near| format!("; did you mean `{near}`?"));
            Err(format!("expected one of {} or metres per unit{near}", names.join(", ")))
        }
    }
}

/// The path of a microgrid stream to write. Another extension is a slip of the hand: nothing else reads the format.
pub fn stream_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mgs")) {
        true => Ok(path),
        false => Err("expected a file that ends in `.mgs`".into()),
    }
}

/// The space that a written stream stands in.
#[derive(Clone, Copy, Debug, Args)]
pub struct Space {
    /// The stream's unit: m, cm, mm, km, in, ft, yd, or metres per unit as a number
    #[arg(long, value_name = "UNIT", default_value = "m", value_parser = meters_per_unit)]
    pub units: f64,
    /// The axis that points up
    #[arg(long, value_name = "AXIS", default_value = "y")]
    pub up: Up,
}

/// The up axis as an argument.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Up {
    /// +y.
    Y,
    /// +z.
    Z,
}

impl From<Up> for UpAxis {
    fn from(up: Up) -> Self {
        match up {
            Up::Y => Self::Y,
            Up::Z => Self::Z,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches binary units taken for decimal ones, overflow, and nonsense that passes.
    #[test]
    fn sizes_are_what_they_say() {
        let good =
            [("0", 0), ("4096", 4096), ("256MiB", 256 << 20), ("1GiB", 1 << 30), ("1.5GB", 1_500_000_000)];
        let more = [("1.5 gib", 3 << 29), ("2G", 2 << 30), ("64kb", 64_000), ("3TiB", 3 << 40), ("7B", 7)];
        for (text, bytes) in good.into_iter().chain(more) {
            assert_eq!(size(text), Ok(bytes), "{text}");
        }
        for text in
            ["", "GiB", "-1", "1PiBB", "0.3", "1e9", "99999999999999999999", "99999999TiB", "1..5G", "∞"]
        {
            assert!(size(text).is_err(), "{text}");
        }
    }

    /// Catches counts in binary units and counts of nothing.
    #[test]
    fn counts_are_decimal_and_positive() {
        assert_eq!(count("10M"), Ok(10_000_000));
        assert_eq!(count("10_000"), Ok(10_000));
        assert_eq!(count("0.5k"), Ok(500));
        for text in ["0", "", "1.5", "ten", "10MiB"] {
            assert!(count(text).is_err(), "{text}");
        }
    }

    /// Catches places and pictures of the wrong shape, and numbers that are none.
    #[test]
    fn places_and_pictures_have_all_their_numbers() {
        assert_eq!(vector("0, 1.7,-6"), Ok(glam::DVec3::new(0.0, 1.7, -6.0)));
        assert_eq!(resolution("1280x720"), Ok([1280, 720]));
        for text in ["1,2", "1,2,3,4", "1,2,x", "1,x,2,3", "1,2,inf", ""] {
            assert!(vector(text).is_err(), "{text}");
        }
        for text in ["1280", "0x720", "1280x", "-1x5", "1280x720x3", "99999x1"] {
            assert!(resolution(text).is_err(), "{text}");
        }
    }

    /// Catches a unit that scenes know and arguments do not, and units of no length.
    #[test]
    fn units_are_those_of_scenes() {
        assert_eq!(meters_per_unit("cm"), Ok(0.01));
        assert_eq!(meters_per_unit("0.3048"), Ok(0.3048));
        for text in ["0", "-1", "nan", "inf", "furlong"] {
            assert!(meters_per_unit(text).is_err(), "{text}");
        }
    }
}
