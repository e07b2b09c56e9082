//! Radiance HDR pictures (`.hdr`, `.pic`), read row by row in constant memory.
//!
//! The format is that of Ward, "Real Pixels" (Graphics Gems II, 1991) and of Radiance's `color.c`: text lines, a line
//! of dimensions, then rows of shared-exponent pixels, run-length coded in one of two ways or not at all.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use super::latlong::{FILE_HEIGHT_MAX, FILE_WIDTH_MAX, LatLong, LatLongBuilder};
use crate::{Error, ErrorKind, Result};

/// Bytes of a header line, at most.
const LINE_BYTES_MAX: usize = 4_096;

/// Lines of a header, at most.
const LINES_MAX: usize = 256;

/// Reads a Radiance HDR file as a latitude-longitude map; also tells how many pixels had to be repaired.
///
/// # Errors
/// When the file is unreadable, truncated or broken, is in XYZ colour, or is larger than 16,384 × 8,192 pixels.
pub fn read(path: &Path) -> Result<(LatLong, u64)> {
    let file = File::open(path).map_err(|error| Error::io("open", path, error))?;
    decode(path, BufReader::with_capacity(1 << 16, file))
}

/// Reads from `bytes`, which should be buffered; `path` is for errors.
fn decode(path: &Path, bytes: impl Read) -> Result<(LatLong, u64)> {
    let mut reader = Reader { path, bytes, offset: 0 };
    let header = reader.header()?;
    let mut builder = LatLongBuilder::new(header.width, header.height);
    let (length, count) =
        if header.rows_first { (header.width, header.height) } else { (header.height, header.width) };
    let mut line = vec![[0_u8; 4]; length];
    for major in 0..count {
        reader.scan_line(&mut line)?;
        for (minor, &pixel) in line.iter().enumerate() {
            let (x, y) = if header.rows_first { (minor, major) } else { (major, minor) };
            let x = if header.x_increases { x } else { header.width - 1 - x };
            let y = if header.y_decreases { y } else { header.height - 1 - y };
            builder.add(x, y, to_rgb(pixel).map(|value| value * header.scale));
        }
    }
    Ok(builder.finish())
}

/// What the text at the head of the file says.
struct Header {
    width: usize,
    height: usize,
    rows_first: bool,
    x_increases: bool,
    y_decreases: bool,
    /// What to multiply pixels with for radiance: the inverse of all EXPOSURE lines.
    scale: f32,
}

/// A shared-exponent pixel as linear RGB.
fn to_rgb([r, g, b, exponent]: [u8; 4]) -> [f32; 3] {
    if exponent == 0 {
        return [0.0; 3];
    }
    let scale = 2.0_f32.powi(i32::from(exponent) - (128 + 8));
    [r, g, b].map(|value| f32::from(value) * scale)
}

struct Reader<'a, R> {
    path: &'a Path,
    bytes: R,
    offset: u64,
}

impl<R: Read> Reader<'_, R> {
    fn corrupt(&self, message: impl Into<String>) -> Error {
        Error::corrupt(self.path, self.offset, message)
    }

    fn fill(&mut self, buffer: &mut [u8]) -> Result<()> {
        match self.bytes.read_exact(buffer) {
            Ok(()) => {
                self.offset += buffer.len() as u64;
                Ok(())
            }
            Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                Err(self.corrupt("the file ends within the picture"))
            }
            Err(error) => Err(Error::io("read", self.path, error)),
        }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut buffer = [0; N];
        self.fill(&mut buffer)?;
        Ok(buffer)
    }

    fn line(&mut self) -> Result<String> {
        let mut line = Vec::new();
        loop {
            let [byte] = self.take()?;
            if byte == b'\n' {
                break;
            }
            if line.len() == LINE_BYTES_MAX {
                return Err(self.corrupt(format!("a header line of more than {LINE_BYTES_MAX} bytes")));
            }
            line.push(byte);
        }
        Ok(String::from_utf8_lossy(&line).trim_end().to_owned())
    }

    fn header(&mut self) -> Result<Header> {
        let magic = self.line()?;
        if !(magic.starts_with("#?RADIANCE") || magic.starts_with("#?RGBE")) {
            return Err(Error::corrupt(
                self.path,
                0,
                "not a Radiance HDR file: it does not begin with `#?RADIANCE`",
            ));
        }
        let mut scale = 1.0_f32;
        for _ in 0..LINES_MAX {
            let line = self.line()?;
            if line.is_empty() {
                return self.dimensions(scale);
            }
            match line.split_once('=') {
                Some(("FORMAT", format)) if format.trim() != "32-bit_rle_rgbe" => {
                    let message =
                        format!("pixels of format `{}` are not supported", format.trim().escape_default());
                    return Err(Error::unsupported(message)
                        .at_byte(self.path, self.offset)
                        .hint("convert it to 32-bit_rle_rgbe or to EXR"));
                }
                Some(("EXPOSURE", value)) => {
                    let exposure = value.trim().parse::<f32>().ok().filter(|v| v.is_normal() && *v > 0.0);
                    let Some(exposure) = exposure else {
                        return Err(self.corrupt("the EXPOSURE is not a positive number"));
                    };
                    scale /= exposure;
                }
                _ => {}
            }
        }
        Err(self.corrupt(format!("a header of more than {LINES_MAX} lines")))
    }

    fn dimensions(&mut self, scale: f32) -> Result<Header> {
        let line = self.line()?;
        let words: Vec<&str> = line.split_whitespace().collect();
        let number = |word: &str| word.parse::<usize>().ok().filter(|&n| n > 0);
        let parsed = match words[..] {
            [first, a, second, b] => number(a).zip(number(b)).map(|sizes| (first, second, sizes)),
            _ => None,
        };
        let Some((first, second, (a, b))) = parsed else {
            return Err(self.corrupt(format!("`{}` is not a line of dimensions", line.escape_default())));
        };
        let rows_first = first.ends_with('Y');
        let (y, x) = if rows_first { (first, second) } else { (second, first) };
        if !matches!(y, "-Y" | "+Y") || !matches!(x, "-X" | "+X") {
            return Err(self.corrupt(format!("`{}` is not a line of dimensions", line.escape_default())));
        }
        let (width, height) = if rows_first { (b, a) } else { (a, b) };
        check_dimensions(self.path, width, height)?;
        if !scale.is_normal() {
            return Err(self.corrupt("the EXPOSURE is out of range"));
        }
        Ok(Header { width, height, rows_first, x_increases: x == "+X", y_decreases: y == "-Y", scale })
    }

    fn scan_line(&mut self, line: &mut [[u8; 4]]) -> Result<()> {
        let first = self.take::<4>()?;
        let length = usize::from(first[2]) << 8 | usize::from(first[3]);
        if first[0] == 2 && first[1] == 2 && first[2] < 128 && (8..=0x7fff).contains(&line.len()) {
            if length != line.len() {
                return Err(self.corrupt(format!("a row of {length} pixels, {} expected", line.len())));
            }
            return (0..4).try_for_each(|component| self.component(line, component));
        }
        self.old_runs(first, line)
    }

    /// One component of a row, run-length coded by itself.
    fn component(&mut self, line: &mut [[u8; 4]], component: usize) -> Result<()> {
        let mut at = 0;
        while at < line.len() {
            let [count] = self.take()?;
            let run = count > 128;
            let length = usize::from(if run { count - 128 } else { count });
            if length == 0 || at + length > line.len() {
                return Err(self.corrupt(format!("a run of {length} pixels does not fit into its row")));
            }
            let mut values = [0; 128];
            if run {
                let [value] = self.take()?;
                values[..length].fill(value);
            } else {
                self.fill(&mut values[..length])?;
            }
            for (pixel, value) in line[at..at + length].iter_mut().zip(values) {
                pixel[component] = value;
            }
            at += length;
        }
        Ok(())
    }

    /// Whole pixels; (1, 1, 1, n) repeats the one before n times, and more often when several follow each other.
    fn old_runs(&mut self, first: [u8; 4], line: &mut [[u8; 4]]) -> Result<()> {
        let (mut pixel, mut at, mut shift) = (first, 0, 0);
        loop {
            if pixel[..3] == [1, 1, 1] {
                let length = usize::from(pixel[3]) << shift;
                if at == 0 || length > line.len() - at {
                    return Err(self.corrupt(format!("a run of {length} pixels does not fit into its row")));
                }
                let before = line[at - 1];
                line[at..at + length].fill(before);
                at += length;
                // Past 16 bits no row is long enough for anything but a run of 0.
                shift = (shift + 8).min(16);
            } else {
                line[at] = pixel;
                at += 1;
                shift = 0;
            }
            if at == line.len() {
                return Ok(());
            }
            pixel = self.take()?;
        }
    }
}

/// Refuses maps that are larger than any that are in use.
pub(super) fn check_dimensions(path: &Path, width: usize, height: usize) -> Result<()> {
    if width == 0 || height == 0 {
        return Err(Error::new(ErrorKind::Corrupt, "a picture without pixels").at(path));
    }
    if width > FILE_WIDTH_MAX || height > FILE_HEIGHT_MAX {
        let message = format!(
            "a picture of {width} × {height} pixels, at most {FILE_WIDTH_MAX} × {FILE_HEIGHT_MAX} are possible"
        );
        return Err(Error::new(ErrorKind::Limit, message)
            .at(path)
            .hint("scale the map down: 2048 × 1024 is plenty"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;
    use image::codecs::hdr::HdrEncoder;

    /// The picture that tests write: smooth enough for run-length coding, different in every pixel.
    fn pixels(width: usize, height: usize) -> Vec<Rgb<f32>> {
        let value = |at: usize| [(at / width) as f32 + 0.5, (at % width / 4) as f32, 100.0 * (at + 1) as f32];
        (0..width * height).map(|at| Rgb(value(at))).collect()
    }

    fn read_bytes(bytes: &[u8]) -> Result<(LatLong, u64)> {
        decode(Path::new("map.hdr"), bytes)
    }

    fn encoded(width: usize, height: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        HdrEncoder::new(&mut bytes).encode(&pixels(width, height), width, height).expect("encoded");
        bytes
    }

    fn rows(map: &LatLong) -> Vec<[f32; 3]> {
        map.samples().map(|(_, _, rgb)| rgb).collect()
    }

    /// Catches a wrong exponent, component order or run length: another encoder's file must come back to 1 in 128.
    #[test]
    fn files_of_another_encoder_are_read() {
        // Rows of fewer than 8 pixels are not run-length coded.
        for (width, height) in [(40, 6), (5, 3)] {
            let (map, repaired) = read_bytes(&encoded(width, height)).expect("read");
            assert_eq!((map.size(), repaired), ([width, height], 0));
            for (found, Rgb(wanted)) in rows(&map).iter().zip(pixels(width, height)) {
                let largest = wanted.iter().copied().fold(0.0, f32::max);
                let close = found.iter().zip(wanted).all(|(a, b)| (a - b).abs() <= largest / 128.0);
                assert!(close, "{found:?}, {wanted:?} expected");
            }
        }
    }

    /// Catches a reader that ignores the EXPOSURE, the order of rows and columns, or the old run-length code.
    #[test]
    fn orientations_exposures_and_old_runs_are_read() {
        let file = |dimensions: &str| {
            let mut bytes = b"#?RGBE\nEXPOSURE=2\nFORMAT=32-bit_rle_rgbe\n\n".to_vec();
            bytes.extend_from_slice(dimensions.as_bytes());
            // Exponent 136: mantissas are the values. The first pixel thrice, then two others.
            bytes.extend_from_slice(
                &[[2, 4, 6, 136], [1, 1, 1, 2], [8, 8, 8, 136], [10, 10, 10, 136]].concat(),
            );
            bytes
        };
        let reds = |dimensions: &str| -> Vec<f32> {
            let (map, _) = read_bytes(&file(dimensions)).expect("read");
            rows(&map).iter().map(|rgb| rgb[0]).collect()
        };
        assert_eq!(reds("-Y 1 +X 5\n"), [1.0, 1.0, 1.0, 4.0, 5.0]);
        assert_eq!(reds("-Y 1 -X 5\n"), [5.0, 4.0, 1.0, 1.0, 1.0]);
        assert_eq!(reds("+X 1 +Y 5\n"), [5.0, 4.0, 1.0, 1.0, 1.0]);
        assert_eq!(reds("+X 1 -Y 5\n"), [1.0, 1.0, 1.0, 4.0, 5.0]);
    }

    /// Catches a truncated file that is taken for whole, or a panic, at every length.
    #[test]
    fn every_truncation_is_an_error() {
        let whole = encoded(20, 4);
        for length in 0..whole.len() {
            let error = read_bytes(&whole[..length]).expect_err("truncated");
            assert_eq!(error.kind(), ErrorKind::Corrupt, "{length} bytes: {error}");
            assert!(error.place().is_some(), "{error}");
        }
    }

    /// Catches a panic or a hang on any flipped bit. Some flips only change a pixel; none may give a broken one.
    #[test]
    fn flipped_bits_never_panic() {
        let whole = encoded(20, 4);
        let mut refused = 0;
        for bit in 0..whole.len() * 8 {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            match read_bytes(&bytes) {
                Ok((map, _)) => assert!(rows(&map).iter().flatten().all(|v| v.is_finite() && *v >= 0.0)),
                Err(_) => refused += 1,
            }
        }
        assert!(refused > 100, "{refused}");
    }

    /// Catches memory that a header dictates, and headers without end.
    #[test]
    fn hostile_headers_are_refused() {
        let head = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n";
        for (rest, kind) in [
            ("\n-Y 4000000000 +X 4000000000\n", ErrorKind::Limit),
            ("\n-Y 99999999999999999999999 +X 1\n", ErrorKind::Corrupt),
            ("\n-Y 8193 +X 16\n", ErrorKind::Limit),
            ("\n-Y 0 +X 16\n", ErrorKind::Corrupt),
            ("\n-Y 16 +Y 16\n", ErrorKind::Corrupt),
            ("\n-Y 16\n", ErrorKind::Corrupt),
            ("EXPOSURE=0\n\n-Y 1 +X 1\n", ErrorKind::Corrupt),
            ("EXPOSURE=1e30\nEXPOSURE=1e30\n\n-Y 1 +X 1\n", ErrorKind::Corrupt),
            ("FORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n", ErrorKind::Unsupported),
            (&"a".repeat(10_000), ErrorKind::Corrupt),
            (&"a\n".repeat(1_000), ErrorKind::Corrupt),
        ] {
            let error = read_bytes(format!("{head}{rest}").as_bytes()).expect_err("refused");
            assert_eq!(error.kind(), kind, "{}: {error}", &rest[..rest.len().min(40)]);
        }
        assert_eq!(read_bytes(b"P6 1 1 255 abc\n").expect_err("no HDR").kind(), ErrorKind::Corrupt);
        // 64 bytes that promise the largest picture there is end at once.
        let lie = format!("{head}\n-Y 8192 +X 16384\n");
        assert_eq!(read_bytes(lie.as_bytes()).expect_err("empty").kind(), ErrorKind::Corrupt);
    }
}
