//! A picture and its two files: PNG for eyes, EXR for compositing.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use exr::prelude::{Encoding, Image, Layer, LayerAttributes, SpecificChannels, Vec2, WritableImage};
use image::ImageEncoder;
use image::codecs::png::PngEncoder;

use super::RelightStats;
use crate::{Error, ErrorKind, Result};

/// A relit picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// Linear radiance with sRGB primaries, three values per pixel, rows from the top, premultiplied with `alpha`,
    /// before exposure.
    pub rgb: Vec<f32>,
    /// Covered share of each pixel; 1 everywhere when the environment was drawn behind the scene.
    pub alpha: Vec<f32>,
    /// What [`save`](Self::save) brightens a PNG by, in stops.
    pub exposure_stops: f32,
    /// What was drawn.
    pub stats: RelightStats,
}

impl Picture {
    /// Writes the picture: `.png` as 8-bit sRGB after exposure (with alpha where some is below 1), `.exr` as linear
    /// single precision RGBA before exposure. The file appears under its name when it is complete.
    ///
    /// # Errors
    /// When the extension is neither, or the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        let write = match extension.as_str() {
            "png" => Self::write_png,
            "exr" => Self::write_exr,
            other => {
                let message =
                    format!("`.{}` is not a type of picture that can be written", other.escape_debug());
                return Err(Error::unsupported(message).at(path).hint("use .png or .exr"));
            }
        };
        write_then_rename(path, |out| write(self, out))
    }

    fn write_png(&self, out: &mut BufWriter<File>) -> Result<()> {
        let opaque = self.alpha.iter().all(|&alpha| alpha >= 1.0);
        let channels = if opaque { 3 } else { 4 };
        let exposure = self.exposure_stops.exp2();
        let mut bytes = Vec::with_capacity(self.alpha.len() * channels);
        for (rgb, &alpha) in self.rgb.chunks_exact(3).zip(&self.alpha) {
            // PNG has straight alpha.
            let scale = if alpha > 0.0 { exposure / alpha } else { 0.0 };
            bytes.extend(rgb.iter().map(|value| srgb_byte(value * scale)));
            if !opaque {
                bytes.push((alpha.clamp(0.0, 1.0) * 255.0).round() as u8);
            }
        }
        let color = if opaque { image::ExtendedColorType::Rgb8 } else { image::ExtendedColorType::Rgba8 };
        PngEncoder::new(out).write_image(&bytes, self.width, self.height, color).map_err(|error| {
            Error::new(ErrorKind::Io, format!("cannot write the PNG: {error}")).caused_by(error)
        })
    }

    fn write_exr(&self, out: &mut BufWriter<File>) -> Result<()> {
        let size = Vec2(self.width as usize, self.height as usize);
        let channels = SpecificChannels::rgba(|at: Vec2<usize>| {
            let pixel = at.y() * size.width() + at.x();
            let [r, g, b] = [0, 1, 2].map(|i| self.rgb[3 * pixel + i]);
            (r, g, b, self.alpha[pixel])
        });
        let attributes = LayerAttributes {
            software_name: Some(concat!("pantaray ", env!("CARGO_PKG_VERSION")).into()),
            ..LayerAttributes::default()
        };
        Image::from_layer(Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, channels))
            .write()
            .non_parallel()
            .to_buffered(SeekOnly(out))
            .map_err(|error| {
                Error::new(ErrorKind::Io, format!("cannot write the EXR: {error}")).caused_by(error)
            })
    }
}

/// Lets the EXR writer borrow the file.
struct SeekOnly<'a>(&'a mut BufWriter<File>);

impl Write for SeekOnly<'_> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

impl std::io::Seek for SeekOnly<'_> {
    fn seek(&mut self, to: std::io::SeekFrom) -> std::io::Result<u64> {
        self.0.seek(to)
    }
}

/// Writes beside `path`, syncs and renames; leaves nothing behind when `write` fails.
fn write_then_rename(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".{}.tmp", std::process::id()));
    let temporary: PathBuf = path.with_file_name(name);
    let finish = || {
        let file = File::create(&temporary).map_err(|error| Error::io("create", path, error))?;
        let mut out = BufWriter::new(file);
        write(&mut out).map_err(|error| error.at(path))?;
        let file = out.into_inner().map_err(|error| Error::io("write", path, error.into_error()))?;
        file.sync_all().map_err(|error| Error::io("write", path, error))?;
        fs::rename(&temporary, path).map_err(|error| Error::io("write", path, error))
    };
    finish().inspect_err(|_| {
        // The first error is the one to report.
        let _ = fs::remove_file(&temporary);
    })
}

/// A linear value as an sRGB byte (IEC 61966-2-1).
pub fn srgb_byte(linear: f32) -> u8 {
    let encoded = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (encoded.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// The linear value of an sRGB byte.
pub fn srgb_linear(byte: u8) -> f32 {
    let encoded = f32::from(byte) / 255.0;
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relight::Environment;

    fn picture() -> Picture {
        Picture {
            width: 3,
            height: 2,
            rgb: (0..18).map(|i| i as f32 / 8.0).collect(),
            alpha: vec![1.0, 1.0, 1.0, 1.0, 0.5, 1.0],
            exposure_stops: -1.0,
            stats: RelightStats::default(),
        }
    }

    /// Catches a transfer curve that does not invert: every byte must survive the round trip.
    #[test]
    fn srgb_survives_the_round_trip() {
        for byte in 0..=255 {
            assert_eq!(srgb_byte(srgb_linear(byte)), byte);
        }
        assert_eq!([srgb_byte(0.5), srgb_byte(-1.0), srgb_byte(9.0), srgb_byte(f32::NAN)], [188, 0, 255, 0]);
    }

    /// Catches an EXR that is exposed, clamped, transposed or without its alpha.
    #[test]
    fn an_exr_reads_back_as_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("picture.exr");
        picture().save(&path).expect("written");
        let image = exr::prelude::read_first_rgba_layer_from_file(
            &path,
            |size, _| (size.width(), vec![[0.0_f32; 4]; size.area()]),
            |(width, pixels), at, (r, g, b, a): (f32, f32, f32, f32)| {
                pixels[at.y() * *width + at.x()] = [r, g, b, a];
            },
        )
        .expect("read back");
        let (width, pixels) = image.layer_data.channel_data.pixels;
        assert_eq!((width, pixels.len()), (3, 6));
        for (i, pixel) in pixels.iter().enumerate() {
            let expected = picture();
            assert_eq!(pixel[..3], expected.rgb[3 * i..3 * i + 3]);
            assert_eq!(pixel[3], expected.alpha[i]);
        }
        // Our own reader takes it as an environment.
        assert!(Environment::load(&path).is_ok());
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1, "a temporary file is left");
    }

    /// Catches a PNG without exposure or with premultiplied colours.
    #[test]
    fn a_png_is_exposed_and_has_straight_alpha() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("picture.PNG");
        picture().save(&path).expect("written");
        let read = image::ImageReader::open(&path).expect("opened").decode().expect("decoded").to_rgba8();
        assert_eq!(read.dimensions(), (3, 2));
        assert_eq!(
            read.get_pixel(1, 0).0,
            [srgb_byte(3.0 / 16.0), srgb_byte(0.25), srgb_byte(5.0 / 16.0), 255]
        );
        assert_eq!(read.get_pixel(1, 1).0, [255, 255, 255, 128]);
    }

    /// Catches a type that is guessed, and a file left behind by a failure.
    #[test]
    fn other_types_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = picture().save(&folder.path().join("picture.jpg")).expect_err("refused");
        assert_eq!((error.kind(), error.hint_text()), (ErrorKind::Unsupported, Some("use .png or .exr")));
        let error = picture().save(&folder.path().join("none/picture.png")).expect_err("no such folder");
        assert_eq!(error.kind(), ErrorKind::NotFound);
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 0);
    }
}
