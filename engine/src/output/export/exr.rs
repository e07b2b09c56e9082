//! What was baked on a mesh with texture coordinates as an EXR picture, a layer for each coefficient.

use std::io::{Cursor, Write};
use std::path::Path;

use exr::image::{AnyChannel, AnyChannels, FlatSamples, Image, Layer};
use exr::math::Vec2;
use exr::meta::header::{ImageAttributes, LayerAttributes};
use exr::prelude::{Encoding, Text, WritableImage};

use super::super::values;
use super::{ExportOptions, ExportReport, each_grid};
use crate::stream::file::AtomicFile;
use crate::stream::{MicrogridStream, Rate};
use crate::{Error, ErrorKind, Result};

/// Texels that the picture grows beyond its faces, so that filters find no black at seams.
const MARGIN: usize = 4;

/// Draws every attribute that a bake added, `NAME_i` by component, over the texture coordinates of the faces: v runs up. Each layer
/// has a channel `Y` of single floats. Texels beside faces take the value of the nearest ones; those far from all are zero.
///
/// # Errors
/// [`ErrorKind::Invalid`] without texture coordinates or baked attributes, [`ErrorKind::Limit`] beyond the memory allowed, those of
/// the stream, and what the system says.
pub(super) fn export_exr(
    stream: &mut dyn MicrogridStream,
    path: &Path,
    options: &ExportOptions<'_>,
) -> Result<ExportReport> {
    let schema = stream.schema().clone();
    let uv = schema.find(options.uv).filter(|&uv| {
        let attribute = &schema.attributes[uv];
        attribute.components == 2 && attribute.rate == Rate::Vertex
    });
    let Some(uv) = uv else {
        return Err(Error::invalid(format!("the stream has no texture coordinates `{}`", options.uv))
            .at(path)
            .hint("name an attribute of two numbers per vertex: `--uv NAME`"));
    };
    let is_baked = |column: &usize| {
        let name = &schema.attributes[*column].name;
        options.metadata.iter().any(|(key, _)| key.strip_suffix(".shader") == Some(name))
    };
    let baked: Vec<usize> = (0..schema.attributes.len()).filter(is_baked).collect();
    if baked.is_empty() {
        return Err(Error::invalid("a bake added nothing to this stream").at(path).hint("bake it first"));
    }
    let width = baked.iter().map(|&column| usize::from(schema.attributes[column].components)).sum();
    let [across, down] = options.resolution.map(|side| side as usize);
    let need = (across * down * width * 12) as u64;
    if need > options.memory_bytes {
        let (need, have) = (need >> 20, options.memory_bytes >> 20);
        let message = format!("the picture takes {need} MiB of memory, {have} MiB are allowed");
        return Err(Error::new(ErrorKind::Limit, message)
            .at(path)
            .hint("allow more (`--memory`), or a smaller `--size`"));
    }
    let mut sheet = Sheet::new(across, down, width);
    let mut report = ExportReport::default();
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); schema.attributes.len()];
    let mut rows: Vec<f32> = Vec::new();
    each_grid(stream, |grid| {
        for &column in baked.iter().chain([&uv]) {
            values::unit_values(&schema.attributes[column], &grid.columns[column], &mut columns[column]);
        }
        rows.clear();
        for vertex in 0..grid.vertex_count() {
            for &column in &baked {
                let n = usize::from(schema.attributes[column].components);
                rows.extend(columns[column][vertex * n..(vertex + 1) * n].iter().map(|&value| value as f32));
            }
        }
        let place = |vertex: u8| {
            let at = 2 * usize::from(vertex);
            [columns[uv][at] * across as f64, (1.0 - columns[uv][at + 1]) * down as f64]
        };
        for face in grid.faces().filter(|face| face.len() > 2) {
            for i in 1..face.len() - 1 {
                let corners = [face[0], face[i], face[i + 1]];
                let drawn = sheet.triangle(corners.map(place), &corners.map(usize::from), &rows);
                report.left_out += u64::from(!drawn);
            }
            report.faces += 1;
        }
        Ok(())
    })?;
    (0..MARGIN).for_each(|_| sheet.grow());

    let names = baked.iter().flat_map(|&column| {
        let attribute = &schema.attributes[column];
        (0..attribute.components).map(move |i| format!("{}_{i}", attribute.name))
    });
    report.bytes = write(&sheet, names, path)?;
    Ok(report)
}

fn write(sheet: &Sheet, names: impl Iterator<Item = String>, path: &Path) -> Result<u64> {
    let size = Vec2(sheet.across, sheet.down);
    let layers: Vec<Layer<AnyChannels<FlatSamples>>> = names
        .enumerate()
        .map(|(i, name)| {
            let samples = sheet.values.iter().skip(i).step_by(sheet.width).copied().collect();
            let channel = AnyChannel::new("Y", FlatSamples::F32(samples));
            let attributes = LayerAttributes::named(Text::from(name.as_str()));
            let channels = AnyChannels::sort(std::iter::once(channel).collect());
            Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, channels)
        })
        .collect();
    let attributes = ImageAttributes::new(exr::meta::attribute::IntegerBounds::from_dimensions(size));
    let mut bytes = Cursor::new(Vec::new());
    Image::from_layers(attributes, layers)
        .write()
        .non_parallel()
        .to_buffered(&mut bytes)
        .map_err(|error| Error::invalid(format!("cannot make the EXR: {error}")).at(path))?;
    let mut file = AtomicFile::create(path)?;
    file.write_all(bytes.get_ref()).map_err(|error| Error::io("write", path, error))?;
    file.commit()?;
    Ok(bytes.into_inner().len() as u64)
}

/// A picture of many values per texel, and which texels have them.
struct Sheet {
    across: usize,
    down: usize,
    width: usize,
    values: Vec<f32>,
    drawn: Vec<bool>,
}

impl Sheet {
    fn new(across: usize, down: usize, width: usize) -> Self {
        let texels = across * down;
        Self { across, down, width, values: vec![0.0; texels * width], drawn: vec![false; texels] }
    }

    /// Draws the texels whose middle lies in a triangle. False if it lies outside the picture, at least in part.
    fn triangle(&mut self, at: [[f64; 2]; 3], corners: &[usize; 3], rows: &[f32]) -> bool {
        let limit = [self.across as f64, self.down as f64];
        let inside = at.iter().all(|p| (0..2).all(|axis| (-1e-6..=limit[axis] + 1e-6).contains(&p[axis])));
        if !inside {
            return false;
        }
        let cross = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
            (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        };
        let area = cross(at[0], at[1], at[2]);
        let range = |axis: usize, size: usize| {
            let (low, high) =
                (0..3).fold((f64::INFINITY, 0.0_f64), |(l, h), i| (l.min(at[i][axis]), h.max(at[i][axis])));
            low.floor().max(0.0) as usize..(high.ceil() as usize).min(size)
        };
        if area == 0.0 {
            return true;
        }
        for y in range(1, self.down) {
            for x in range(0, self.across) {
                let p = [x as f64 + 0.5, y as f64 + 0.5];
                let weights = [cross(at[1], at[2], p), cross(at[2], at[0], p), cross(at[0], at[1], p)];
                let weights = weights.map(|weight| weight / area);
                if weights.iter().all(|&weight| weight >= -1e-9) {
                    self.draw(y * self.across + x, weights, corners, rows);
                }
            }
        }
        true
    }

    fn draw(&mut self, texel: usize, weights: [f64; 3], corners: &[usize; 3], rows: &[f32]) {
        self.drawn[texel] = true;
        for i in 0..self.width {
            let value =
                (0..3).map(|k| weights[k] * f64::from(rows[corners[k] * self.width + i])).sum::<f64>();
            self.values[texel * self.width + i] = value as f32;
        }
    }

    /// Gives texels beside drawn ones the mean of these.
    fn grow(&mut self) {
        let before = self.drawn.clone();
        let (across, down) = (self.across as isize, self.down as isize);
        let mut mean = vec![0.0; self.width];
        for texel in (0..before.len()).filter(|&texel| !before[texel]) {
            let (x, y) = (texel as isize % across, texel as isize / across);
            let beside = [(-1, 0), (1, 0), (0, -1), (0, 1)].map(|(dx, dy)| (x + dx, y + dy));
            let beside = beside.iter().filter(|(x, y)| (0..across).contains(x) && (0..down).contains(y));
            let near: Vec<usize> =
                beside.map(|(x, y)| (y * across + x) as usize).filter(|&texel| before[texel]).collect();
            if near.is_empty() {
                continue;
            }
            mean.fill(0.0);
            for &texel in &near {
                let own = &self.values[texel * self.width..(texel + 1) * self.width];
                mean.iter_mut().zip(own).for_each(|(mean, value)| *mean += value / near.len() as f32);
            }
            self.values[texel * self.width..(texel + 1) * self.width].copy_from_slice(&mean);
            self.drawn[texel] = true;
        }
    }
}
