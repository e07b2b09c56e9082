//! OpenEXR pictures as environments, read block by block so that memory stays bounded.

use std::fs::File;
use std::io::{BufReader, Seek};
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
    let mut reader = BufReader::new(file);
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
