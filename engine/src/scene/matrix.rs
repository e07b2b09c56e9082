//! Numbers in text and the transforms they make: 16 numbers, translation in the last four, affine and invertible.

use glam::{DMat4, DVec3};

use super::xml::cut;
use crate::{Error, ErrorKind};

/// What is wrong with a text, and at which of its bytes.
#[derive(Debug, PartialEq)]
pub(super) struct Fault {
    /// Offset into the text.
    pub offset: usize,
    /// What is wrong.
    pub message: String,
    /// What to do about it.
    pub hint: Option<&'static str>,
}

impl Fault {
    fn new(offset: usize, message: impl Into<String>) -> Self {
        Self { offset, message: message.into(), hint: None }
    }

    fn hint(mut self, hint: &'static str) -> Self {
        self.hint = Some(hint);
        self
    }

    /// The error, without its place.
    pub fn into_error(self) -> Error {
        let error = Error::new(ErrorKind::Invalid, self.message);
        match self.hint {
            Some(hint) => error.hint(hint),
            None => error,
        }
    }
}

/// The fields of `text` with their offsets: separated by white space, a comma, or a comma amid white space.
///
/// Two commas enclose an empty field, so does a comma at either end.
pub(super) fn fields(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut at = 0;
    let mut after_comma = false;
    std::iter::from_fn(move || {
        at += text[at..].len() - text[at..].trim_start().len();
        if at >= text.len() && !std::mem::take(&mut after_comma) {
            return None;
        }
        let start = at;
        let length = text[at..].find(|c: char| c == ',' || c.is_whitespace()).unwrap_or(text.len() - at);
        at += length;
        let rest = text[at..].trim_start();
        after_comma = rest.starts_with(',');
        if after_comma {
            at = text.len() - rest.len() + 1;
        }
        Some((start, &text[start..start + length]))
    })
}

/// Reads a transform: 16 finite numbers, each four of them the image of an axis, the last four the translation.
///
/// This is the order of RenderMan, USD and glTF, and of [`DMat4::from_cols_array`].
pub(super) fn parse(text: &str) -> Result<DMat4, Fault> {
    let mut numbers = [0.0; 16];
    let mut count = 0;
    for (offset, field) in fields(text) {
        if let Some(slot) = numbers.get_mut(count) {
            *slot = finite(offset, field)?;
        }
        count += 1;
    }
    if count != 16 {
        return Err(Fault::new(0, format!("matrix of {count} numbers, expected 16")));
    }
    affine(&mut numbers)?;
    invertible(&numbers)?;
    Ok(DMat4::from_cols_array(&numbers))
}

/// Magnitude of a matrix entry at most: beyond it squares of distances no longer fit doubles with any precision left.
const ENTRY_MAX: f64 = 1e12;

fn finite(offset: usize, field: &str) -> Result<f64, Fault> {
    if field.is_empty() {
        return Err(Fault::new(offset, "expected a number, found nothing"));
    }
    let number: f64 =
        field.parse().map_err(|_| Fault::new(offset, format!("`{}` is not a number", cut(field))))?;
    if !number.is_finite() {
        return Err(Fault::new(offset, format!("`{}` is not a finite number", cut(field))));
    }
    if number.abs() > ENTRY_MAX {
        let message = format!("`{}` is out of range, expected -1e12 to 1e12", cut(field));
        return Err(Fault::new(offset, message));
    }
    Ok(number)
}

/// Checks that every fourth number is 0, 0, 0, 1, and rids them of the rounding that an inversion may have left.
fn affine(numbers: &mut [f64; 16]) -> Result<(), Fault> {
    const ROUNDING_MAX: f64 = 1e-12;
    for (index, exact) in [(3, 0.0), (7, 0.0), (11, 0.0), (15, 1.0)] {
        if (numbers[index] - exact).abs() > ROUNDING_MAX {
            let message = "matrix is not affine, expected numbers 4, 8, 12 to be 0 and number 16 to be 1";
            let hint = "the translation is in the last four numbers; is the matrix transposed?";
            return Err(Fault::new(0, message).hint(hint));
        }
        numbers[index] = exact;
    }
    Ok(())
}

/// Checks that the images of the axes span a volume. Scales may differ much between axes; angles may not vanish.
fn invertible(numbers: &[f64; 16]) -> Result<(), Fault> {
    const AXIS_MIN: f64 = 1e-12;
    const VOLUME_MIN: f64 = 1e-9;
    let axes = [0, 4, 8].map(|first| DVec3::new(numbers[first], numbers[first + 1], numbers[first + 2]));
    let lengths = axes.map(DVec3::length);
    let volume = || {
        let [x, y, z] = [axes[0] / lengths[0], axes[1] / lengths[1], axes[2] / lengths[2]];
        x.cross(y).dot(z).abs()
    };
    if lengths.iter().any(|&length| length < AXIS_MIN) || volume() < VOLUME_MIN {
        return Err(Fault::new(0, "matrix is not invertible")
            .hint("its three axes must span a volume: is a scale 0?"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a separator that is missed or an empty field that is swallowed.
    #[test]
    fn fields_are_split_at_spaces_and_commas() {
        let split = |text| fields(text).collect::<Vec<_>>();
        assert_eq!(split(" 1  2,3 , 4\n5"), [(1, "1"), (4, "2"), (6, "3"), (10, "4"), (12, "5")]);
        assert_eq!(split("1,,2"), [(0, "1"), (2, ""), (3, "2")]);
        assert_eq!(split("1, "), [(0, "1"), (3, "")]);
        assert_eq!(split(",1"), [(0, ""), (1, "1")]);
        assert_eq!(split(" \t"), []);
        assert_eq!(split(","), [(0, ""), (1, "")]);
        assert_eq!(split("é,ü"), [(0, "é"), (3, "ü")]);
    }

    /// Catches a transposed reading: the last four numbers are the translation.
    #[test]
    fn the_translation_is_in_the_last_four_numbers() {
        let matrix = parse("0 2 0 0, -2 0 0 0, 0 0 2 0, 10 20 30 1").unwrap();
        assert_eq!(matrix.transform_point3(DVec3::new(1.0, 0.0, 0.0)), DVec3::new(10.0, 22.0, 30.0));
        let rounded = parse("1 0 0 1e-17 0 1 0 0 0 0 1 -0 5 6 7 0.9999999999999999").unwrap();
        assert_eq!(rounded, DMat4::from_translation(DVec3::new(5.0, 6.0, 7.0)));
    }

    /// Catches a wrong count, number or transform that passes, and a wrong place for it.
    #[test]
    fn bad_matrices_are_refused() {
        for (text, offset, message) in [
            ("", 0, "matrix of 0 numbers, expected 16"),
            ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0", 0, "matrix of 15 numbers, expected 16"),
            ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 x", 0, "matrix of 17 numbers, expected 16"),
            ("1 0 0 0 0 one 0 0 0 0 1 0 0 0 0 1", 10, "`one` is not a number"),
            ("1 0 0 0 0 nan 0 0 0 0 1 0 0 0 0 1", 10, "`nan` is not a finite number"),
            ("1 0 0 0 0 1 0 0 0 0 1 0 0 -inf 0 1", 26, "`-inf` is not a finite number"),
            ("1e999 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", 0, "`1e999` is not a finite number"),
            ("1 0 0 0 0 1 0 0 0 0 1 0 1e13 0 0 1", 24, "`1e13` is out of range, expected -1e12 to 1e12"),
            ("1,0,,0 0 1 0 0 0 0 1 0 0 0 0 1", 4, "expected a number, found nothing"),
            ("1 0 0 0 0 0 0 0 0 0 1 0 0 0 0 1", 0, "matrix is not invertible"),
            ("1 2 3 0 2 4 6 0 0 0 1 0 0 0 0 1", 0, "matrix is not invertible"),
            ("1 2 3 0 4 5 6 0 7 8 9 0 0 0 0 1", 0, "matrix is not invertible"),
        ] {
            let fault = parse(text).expect_err(text);
            assert_eq!((fault.offset, fault.message.as_str()), (offset, message), "{text}");
        }
        let transposed = parse("1 0 0 5 0 1 0 6 0 0 1 7 0 0 0 1").unwrap_err();
        assert!(transposed.message.starts_with("matrix is not affine") && transposed.hint.is_some());
    }

    /// Catches a test for invertibility that depends on scale: small, large and uneven scales are fine.
    #[test]
    fn uneven_scales_and_reflections_are_invertible() {
        for scales in [[1e-6, 1e-6, 1e-6], [1e9, 1.0, 1e-6], [-1.0, 1.0, 1.0]] {
            let [x, y, z] = scales;
            parse(&format!("{x} 0 0 0 0 {y} 0 0 0 0 {z} 0 1e9 0 0 1")).expect("invertible");
        }
    }
}
