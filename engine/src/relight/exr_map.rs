//! OpenEXR pictures as environments, read block by block so that memory stays bounded.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use exr::meta::MetaData;
use exr::prelude::{ReadChannels, ReadLayers, Vec2};

use super::latlong::{LatLong, LatLongBuilder};
use super::rgbe::check_dimensions;
use crate::{Error, ErrorKind, Result};

/// Decoded bytes of a block of rows or a tile, at most: a tile of 4096 × 4096 pixels of 4 floats.
const BLOCK_BYTES_MAX: usize = 256 << 20;

/// Reads the first layer with R, G and B of an OpenEXR file as a latitude-longitude map; also tells how many pixels
/// had to be repaired.
///
/// # Errors
/// When the file is unreadable, truncated or broken, has no such layer, or is larger than 16,384 × 8,192 pixels.
pub fn read(path: &Path) -> Result<(LatLong, u64)> {
    let file = File::open(path).map_err(|error| Error::io("open", path, error))?;
    decode(path, BufReader::new(file))
}

/// Reads from `reader`; `path` is for errors.
fn decode(path: &Path, mut reader: impl Read + Seek) -> Result<(LatLong, u64)> {
    check(path, &MetaData::read_from_buffered(&mut reader, false).map_err(|error| broken(path, error))?)?;
    reader.rewind().map_err(|error| Error::io("read", path, error))?;
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .rgb_channels(
            |size: Vec2<usize>, _| LatLongBuilder::new(size.width(), size.height()),
            |builder: &mut LatLongBuilder, at, (r, g, b): (f32, f32, f32)| {
                builder.add(at.x(), at.y(), [r, g, b])
            },
        )
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(reader)
        .map_err(|error| broken(path, error))?;
    Ok(image.layer_data.channel_data.pixels.finish())
}

/// Refuses what would take more memory than any sane map.
fn check(path: &Path, meta: &MetaData) -> Result<()> {
    for header in &meta.headers {
        let size = header.layer_size;
        check_dimensions(path, size.width(), size.height())?;
        let block = match header.blocks {
            exr::meta::BlockDescription::ScanLines => {
                header.compression.scan_lines_per_block().saturating_mul(size.width())
            }
            exr::meta::BlockDescription::Tiles(tiles) => {
                tiles.tile_size.width().saturating_mul(tiles.tile_size.height())
            }
        };
        if block.saturating_mul(header.channels.bytes_per_pixel) > BLOCK_BYTES_MAX {
            let message = format!("a block of more than {} MiB", BLOCK_BYTES_MAX >> 20);
            return Err(Error::new(ErrorKind::Limit, message)
                .at(path)
                .hint("store it in rows or smaller tiles"));
        }
    }
    Ok(())
}

/// The decoder's error as ours. It knows no byte offset.
fn broken(path: &Path, error: exr::error::Error) -> Error {
    match error {
        exr::error::Error::Io(error) if error.kind() != std::io::ErrorKind::UnexpectedEof => {
            Error::io("read", path, error)
        }
        exr::error::Error::NotSupported(what) => {
            Error::unsupported(format!("this kind of EXR is not supported: {what}")).at(path)
        }
        error => Error::new(ErrorKind::Corrupt, format!("not a readable EXR: {error}"))
            .at(path)
            .hint("an environment needs a flat layer with channels R, G and B"),
    }
}

#[cfg(test)]
mod tests {
    use exr::prelude::{Encoding, Image, SpecificChannels, WritableImage};

    use super::*;

    /// An EXR of 40 × 20 pixels, one of them broken, in rows or tiles.
    fn encoded(encoding: Encoding) -> Vec<u8> {
        let pixel = |at: Vec2<usize>| match (at.x(), at.y()) {
            (3, 4) => (f32::NAN, -1.0, f32::INFINITY),
            (x, y) => (x as f32, y as f32, 0.25),
        };
        let mut bytes = std::io::Cursor::new(Vec::new());
        Image::from_encoded_channels((40, 20), encoding, SpecificChannels::rgb(pixel))
            .write()
            .non_parallel()
            .to_buffered(&mut bytes)
            .expect("encoded");
        bytes.into_inner()
    }

    fn read_bytes(bytes: &[u8]) -> Result<(LatLong, u64)> {
        decode(Path::new("map.exr"), std::io::Cursor::new(bytes))
    }

    /// Catches transposed or swapped pixels, in rows and in tiles, and broken pixels that get through.
    #[test]
    fn rows_and_tiles_are_read() {
        for encoding in [Encoding::UNCOMPRESSED, Encoding::SMALL_LOSSLESS, Encoding::FAST_LOSSLESS] {
            let (map, repaired) = read_bytes(&encoded(encoding)).expect("read");
            assert_eq!((map.size(), repaired), ([40, 20], 1));
            for (at, (_, _, rgb)) in map.samples().enumerate() {
                let (x, y) = (at % 40, at / 40);
                let expected =
                    if (x, y) == (3, 4) { [0.0, 0.0, 65_504.0] } else { [x as f32, y as f32, 0.25] };
                let close = rgb.iter().zip(expected).all(|(a, b)| (a - b).abs() <= 1e-5 * b);
                assert!(close, "{x} {y}: {rgb:?}");
            }
        }
    }

    /// Catches a truncated file that is taken for whole, or a panic, at every length.
    #[test]
    fn every_truncation_is_an_error() {
        let whole = encoded(Encoding::SMALL_LOSSLESS);
        for length in 0..whole.len() {
            let error = read_bytes(&whole[..length]).expect_err("truncated");
            assert_eq!(error.kind(), ErrorKind::Corrupt, "{length} bytes: {error}");
        }
    }

    /// Catches a panic, a hang or a huge allocation on any flipped bit.
    #[test]
    fn flipped_bits_never_panic() {
        for encoding in [Encoding::UNCOMPRESSED, Encoding::SMALL_LOSSLESS, Encoding::FAST_LOSSLESS] {
            let whole = encoded(encoding);
            let mut refused = 0;
            // A step that meets every bit of a byte in turn.
            for bit in (0..whole.len() * 8).step_by(9) {
                let mut bytes = whole.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                match read_bytes(&bytes) {
                    Ok((map, _)) => {
                        assert!(
                            map.samples().all(|(_, _, rgb)| rgb.iter().all(|v| v.is_finite() && *v >= 0.0))
                        );
                    }
                    Err(_) => refused += 1,
                }
            }
            assert!(refused > 100, "{refused}");
        }
    }

    /// Catches dimensions that dictate memory: the data window is rewritten to cover 2^31 pixels, or too many rows.
    #[test]
    fn huge_dimensions_are_refused() {
        let whole = encoded(Encoding::UNCOMPRESSED);
        let window = b"dataWindow\0box2i\0\x10\0\0\0";
        let at = whole.windows(window.len()).position(|bytes| bytes == window).expect("a data window")
            + window.len();
        for (x, y) in [(i32::MAX - 1, i32::MAX - 1), (i32::MAX - 1, 19), (39, 8_192), (16_384, 19)] {
            let mut bytes = whole.clone();
            bytes[at + 8..at + 12].copy_from_slice(&x.to_le_bytes());
            bytes[at + 12..at + 16].copy_from_slice(&y.to_le_bytes());
            let error = read_bytes(&bytes).expect_err("refused");
            assert!(matches!(error.kind(), ErrorKind::Limit | ErrorKind::Corrupt), "{x} {y}: {error}");
        }
    }
}
