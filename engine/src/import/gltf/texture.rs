//! Base colour textures: decoding within bounds, and colour and opacity averaged over the area of a face.

use std::collections::HashMap;
use std::io::Cursor;

use glam::Vec2;
use image::{ImageFormat, ImageReader, Limits};

use super::container::{Container, missing};
use super::document::{AlphaMode, Extensions, TextureInfo};
use crate::import::{ImportReport, srgb};
use crate::{Error, Result};

/// Edge of an image at most, in pixels.
const EDGE_MAX: u32 = 16_384;

/// Edge of the triangular pattern of samples in a face at most: 128² samples cover a card of 16,384 texels.
const PATTERN_MAX: u32 = 128;

/// Samples taken for all faces of a primitive at most, about: a few seconds. Large meshes get fewer per face.
const SAMPLES_MAX: u64 = 1 << 29;

/// Coverage that differs by less is even: half the step of an opacity.
const EVEN: f32 = 0.5 / 255.0;

/// Faces remembered by their texture coordinates: copies of one leaf card share theirs.
const MEMORY_MAX: usize = 1 << 16;

/// A decoded image: sRGB bytes with alpha, row by row from the top.
pub(super) struct Image {
    width: u32,
    height: u32,
    texels: Vec<u8>,
}

/// What lies outside of 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Wrap {
    Repeat,
    Mirror,
    Clamp,
}

impl Wrap {
    fn of(code: Option<u32>) -> Self {
        match code {
            Some(33_071) => Self::Clamp,
            Some(33_648) => Self::Mirror,
            _ => Self::Repeat,
        }
    }

    /// The texel at a coordinate, of `size`.
    fn texel(self, coordinate: f32, size: u32) -> u32 {
        let inside = match self {
            Self::Repeat => coordinate - coordinate.floor(),
            Self::Clamp => coordinate.clamp(0.0, 1.0),
            Self::Mirror => {
                let turn = coordinate - 2.0 * (0.5 * coordinate).floor();
                if turn > 1.0 { 2.0 - turn } else { turn }
            }
        };
        // What is not a number becomes texel 0
        ((inside * size as f32) as u32).min(size - 1)
    }
}

/// A texture as a material refers to it.
pub(super) struct Texture {
    image: usize,
    wrap: [Wrap; 2],
    /// Which set of texture coordinates.
    pub set: u32,
    /// Offset, rotation as cosine and sine, and scale, of `KHR_texture_transform`.
    transform: Option<(Vec2, Vec2, Vec2)>,
}

/// The images decoded so far.
#[derive(Default)]
pub(super) struct Images {
    loaded: Vec<(usize, Image)>,
}

impl Images {
    /// Resolves a texture reference and decodes its image. None, with a warning, where that is not possible.
    pub fn load(
        &mut self,
        container: &mut Container,
        info: &TextureInfo,
        report: &mut ImportReport,
    ) -> Result<Option<Texture>> {
        let document = &container.document;
        let textures = document.textures.len();
        let texture =
            document.textures.get(info.index).ok_or_else(|| missing("texture", info.index, textures))?;
        let sampler = match texture.sampler {
            Some(sampler) => {
                let found = document.samplers.get(sampler);
                found.ok_or_else(|| missing("sampler", sampler, document.samplers.len()))?.clone()
            }
            None => Default::default(),
        };
        let Some(image) = texture.source else {
            report.warn(format!(
                "texture {} has no image that can be read: its material keeps its factor",
                info.index
            ));
            return Ok(None);
        };
        if !self.loaded.iter().any(|(known, _)| *known == image) {
            match decode(container, image) {
                Ok(decoded) => self.keep(container, image, decoded)?,
                Err(error) => {
                    report.warn(format!("image {image} is left out, its material keeps its factor: {error}"));
                    return Ok(None);
                }
            }
        }
        let (set, transform) = transform(info);
        Ok(Some(Texture {
            image,
            wrap: [Wrap::of(sampler.wrap_s), Wrap::of(sampler.wrap_t)],
            set,
            transform,
        }))
    }

    /// Keeps an image, and drops the oldest while all together take more than half of the memory allowed.
    fn keep(&mut self, container: &mut Container, index: usize, image: Image) -> Result<()> {
        let bytes = |image: &Image| image.texels.len() as u64;
        let new = bytes(&image);
        while !self.loaded.is_empty() && container.budget.left() < new {
            let (_, oldest) = self.loaded.remove(0);
            container.budget.give(bytes(&oldest));
        }
        container.budget.take(new, &format!("image {index}"))?;
        self.loaded.push((index, image));
        Ok(())
    }

    fn get(&self, texture: &Texture) -> &Image {
        let found = self.loaded.iter().find(|(known, _)| *known == texture.image);
        &found.expect("the image of a texture is loaded right before it is used").1
    }
}

#[cfg(test)]
impl Images {
    /// A square image of texels row by row, and a texture that repeats it.
    pub fn square(size: u32, texels: Vec<u8>) -> (Self, Texture) {
        let images = Self { loaded: vec![(0, Image { width: size, height: size, texels })] };
        (images, Texture { image: 0, wrap: [Wrap::Repeat; 2], set: 0, transform: None })
    }
}

/// Offset, rotation, scale and coordinate set of `KHR_texture_transform`.
fn transform(info: &TextureInfo) -> (u32, Option<(Vec2, Vec2, Vec2)>) {
    let extensions: &Extensions = &info.extensions;
    let Some(extension) = extensions.get("KHR_texture_transform") else { return (info.tex_coord, None) };
    let number = |value: Option<&serde_json::Value>| value.and_then(serde_json::Value::as_f64);
    let pair = |name: &str, default: f32| {
        let at = |i: usize| number(extension.get(name).and_then(|v| v.get(i))).map_or(default, |v| v as f32);
        Vec2::new(at(0), at(1))
    };
    let set = extension.get("texCoord").and_then(serde_json::Value::as_u64);
    let set = set.and_then(|set| u32::try_from(set).ok()).unwrap_or(info.tex_coord);
    let rotation = number(extension.get("rotation")).unwrap_or(0.0);
    (set, Some((pair("offset", 0.0), direction(rotation), pair("scale", 1.0))))
}

/// Cosine and sine by their series, whose bits are the same on every machine; no rotation for an angle beyond reason.
fn direction(angle: f64) -> Vec2 {
    let turn = std::f64::consts::TAU;
    let x = angle - (angle / turn).round() * turn;
    if !x.is_finite() || x.abs() > 4.0 {
        return Vec2::X;
    }
    let (mut cosine, mut sine, mut term) = (0.0, 0.0, 1.0);
    // Terms alternate: x^n / n! goes to the cosine for even n, to the sine for odd n; 4^30 / 30! is below 1e-14
    for n in 0..30 {
        let sign = if n % 4 < 2 { 1.0 } else { -1.0 };
        *(if n % 2 == 0 { &mut cosine } else { &mut sine }) += sign * term;
        term *= x / f64::from(n + 1);
    }
    Vec2::new(cosine as f32, sine as f32)
}

fn decode(container: &mut Container, index: usize) -> Result<Image> {
    let images = &container.document.images;
    let found = images.get(index).ok_or_else(|| missing("image", index, images.len()))?;
    match (found.uri.clone(), found.buffer_view) {
        (Some(uri), _) => {
            let bytes = container.image_uri(&uri, index)?;
            let image = decode_bytes(&bytes, container.budget.left());
            container.release(bytes);
            image
        }
        (None, Some(view)) => {
            let left = container.budget.left();
            decode_bytes(container.view(view)?.0, left)
        }
        (None, None) => Err(Error::invalid(format!("image {index} has no data"))),
    }
}

fn decode_bytes(bytes: &[u8], memory_bytes: u64) -> Result<Image> {
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| Error::invalid("the image cannot be read").caused_by(e))?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        return Err(Error::unsupported("the image is neither PNG nor JPEG"));
    }
    let mut limits = Limits::default();
    limits.max_image_width = Some(EDGE_MAX);
    limits.max_image_height = Some(EDGE_MAX);
    // The decoder's own form and the bytes made of it stand side by side
    limits.max_alloc = Some(memory_bytes / 3);
    reader.limits(limits);
    let decoded = reader.decode().map_err(|e| Error::invalid(format!("the image cannot be decoded: {e}")))?;
    let rgba = decoded.into_rgba8();
    let (width, height) = rgba.dimensions();
    if width == 0 || height == 0 {
        return Err(Error::invalid("the image is empty"));
    }
    Ok(Image { width, height, texels: rgba.into_raw() })
}

impl Texture {
    /// Texture coordinates as the image is looked up with.
    pub fn place(&self, uv: Vec2) -> Vec2 {
        match self.transform {
            // A rotation turns counter-clockwise in a picture whose v axis points down
            Some((offset, turn, scale)) => {
                let p = uv * scale;
                offset + Vec2::new(turn.x * p.x + turn.y * p.y, turn.x * p.y - turn.y * p.x)
            }
            None => uv,
        }
    }
}

/// What is seen of a face from afar.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Average {
    /// Linear colour of what is covered.
    pub rgb: [f32; 3],
    /// The share of light that is stopped, 0 to 1.
    pub opacity: f32,
}

/// Averages a texture over faces.
pub(super) struct Averager<'a> {
    texture: &'a Texture,
    image: &'a Image,
    alpha: AlphaMode,
    factor: f32,
    pattern_max: u32,
    memory: HashMap<[u32; 6], Average>,
}

impl<'a> Averager<'a> {
    /// For `faces` faces of one material, whose alpha factor is `factor`.
    pub fn new(
        images: &'a Images,
        texture: &'a Texture,
        alpha: AlphaMode,
        factor: f32,
        faces: usize,
    ) -> Self {
        let share = (SAMPLES_MAX / faces.max(1) as u64).max(16);
        let pattern_max = (share.isqrt() as u32).min(PATTERN_MAX);
        Self { texture, image: images.get(texture), alpha, factor, pattern_max, memory: HashMap::new() }
    }

    /// The average over a triangle of given texture coordinates and vertex alphas.
    pub fn triangle(&mut self, uv: [Vec2; 3], alphas: [f32; 3]) -> Average {
        if alphas != [1.0; 3] {
            return self.sample(uv, alphas);
        }
        let key = std::array::from_fn(|i| uv[i / 2][i % 2].to_bits());
        if let Some(&known) = self.memory.get(&key) {
            return known;
        }
        let average = self.sample(uv, alphas);
        if self.memory.len() >= MEMORY_MAX {
            self.memory.clear();
        }
        self.memory.insert(key, average);
        average
    }

    /// The longest edge of a triangle of given texture coordinates, in texels.
    pub fn longest_edge(&self, uv: [Vec2; 3]) -> f32 {
        let size = Vec2::new(self.image.width as f32, self.image.height as f32);
        let at = uv.map(|uv| self.texture.place(uv) * size);
        (0..3).map(|i| at[i].distance(at[(i + 1) % 3])).fold(0.0, f32::max)
    }

    /// Whether coverage is the same, but for rounding, at every texel of the box about a triangle.
    pub fn is_even(&self, uv: [Vec2; 3], alphas: [f32; 3]) -> bool {
        let size = [self.image.width, self.image.height];
        let at = uv.map(|uv| self.texture.place(uv));
        let range = |axis: usize| {
            let low = at.iter().map(|uv| uv[axis]).fold(f32::INFINITY, f32::min);
            let high = at.iter().map(|uv| uv[axis]).fold(f32::NEG_INFINITY, f32::max);
            // A box of the image's size and more has every texel
            let texels = ((high - low) * size[axis] as f32).ceil().clamp(0.0, size[axis] as f32) as u32;
            (0..=texels.min(size[axis] - 1))
                .map(move |i| self.texture.wrap[axis].texel(low + i as f32 / size[axis] as f32, size[axis]))
        };
        let vertex_low = alphas.into_iter().fold(f32::INFINITY, f32::min);
        let vertex_high = alphas.into_iter().fold(0.0, f32::max);
        let (mut low, mut high) = (f32::INFINITY, 0.0_f32);
        for y in range(1) {
            for x in range(0) {
                let texel = self.image.texels[4 * (y as usize * size[0] as usize + x as usize) + 3];
                let alpha = f32::from(texel) * (1.0 / 255.0) * self.factor;
                low = low.min(coverage(self.alpha, alpha * vertex_low));
                high = high.max(coverage(self.alpha, alpha * vertex_high));
                if high - low > EVEN {
                    return false;
                }
            }
        }
        true
    }

    /// Samples at the centroids of equal parts of the triangle, about three for two texels.
    pub fn sample(&self, uv: [Vec2; 3], alphas: [f32; 3]) -> Average {
        let size = Vec2::new(self.image.width as f32, self.image.height as f32);
        let uv = uv.map(|uv| self.texture.place(uv));
        let texels = 0.5 * ((uv[1] - uv[0]) * size).perp_dot((uv[2] - uv[0]) * size).abs();
        // A conversion of what is not a number gives 0, of what is too large the largest
        let n = ((1.5 * texels).sqrt().ceil() as u32).clamp(2, self.pattern_max.max(2));
        let step = 1.0 / (3.0 * n as f32);
        let mut sums = Sums::default();
        for i in 0..n {
            for j in 0..n - i {
                // The part that points up, and beside it the one that points down
                self.add((3 * i + 1, 3 * j + 1), step, &uv, alphas, &mut sums);
                if i + j + 1 < n {
                    self.add((3 * i + 2, 3 * j + 2), step, &uv, alphas, &mut sums);
                }
            }
        }
        sums.average()
    }

    fn add(&self, at: (u32, u32), step: f32, uv: &[Vec2; 3], alphas: [f32; 3], sums: &mut Sums) {
        let (b, c) = (at.0 as f32 * step, at.1 as f32 * step);
        let a = 1.0 - b - c;
        let uv = uv[0] * a + uv[1] * b + uv[2] * c;
        let x = self.texture.wrap[0].texel(uv.x, self.image.width) as usize;
        let y = self.texture.wrap[1].texel(uv.y, self.image.height) as usize;
        let start = 4 * (y * self.image.width as usize + x);
        let texel = &self.image.texels[start..start + 4];
        let vertex_alpha = alphas[0] * a + alphas[1] * b + alphas[2] * c;
        let alpha = f32::from(texel[3]) * (1.0 / 255.0) * self.factor * vertex_alpha;
        let cover = coverage(self.alpha, alpha);
        for (channel, &byte) in texel[..3].iter().enumerate() {
            let linear = srgb::linear(byte);
            sums.plain[channel] += linear;
            sums.covered[channel] += linear * cover;
        }
        sums.cover += cover;
        sums.count += 1.0;
    }
}

/// How much light an alpha value stops.
pub(super) fn coverage(mode: AlphaMode, alpha: f32) -> f32 {
    match mode {
        AlphaMode::Opaque => 1.0,
        AlphaMode::Mask(cutoff) => f32::from(u8::from(alpha >= cutoff)),
        AlphaMode::Blend => alpha.clamp(0.0, 1.0),
    }
}

#[derive(Default)]
struct Sums {
    plain: [f32; 3],
    covered: [f32; 3],
    cover: f32,
    count: f32,
}

impl Sums {
    /// The colour is that of the covered part: what a leaf card hides must not colour the leaf.
    fn average(&self) -> Average {
        let (sums, weight) =
            if self.cover > 0.0 { (self.covered, self.cover) } else { (self.plain, self.count) };
        Average { rgb: sums.map(|sum| sum / weight), opacity: self.cover / self.count }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checker(size: u32) -> Images {
        // The left half is opaque red, the right half clear green
        let texel = |i: u32| if i % size < size / 2 { [255, 0, 0, 255] } else { [0, 255, 0, 0] };
        let texels = (0..size * size).flat_map(texel).collect();
        Images { loaded: vec![(0, Image { width: size, height: size, texels })] }
    }

    const TEXTURE: Texture = Texture { image: 0, wrap: [Wrap::Repeat; 2], set: 0, transform: None };
    const LOWER: [Vec2; 3] = [Vec2::ZERO, Vec2::X, Vec2::ONE];
    const UPPER: [Vec2; 3] = [Vec2::ZERO, Vec2::ONE, Vec2::Y];

    /// Catches an average that is not by area, and clear texels that bleed their colour into the leaf.
    #[test]
    fn coverage_is_the_share_of_the_area() {
        let images = checker(256);
        let mut averager = Averager::new(&images, &TEXTURE, AlphaMode::Mask(0.5), 1.0, 2);
        let [lower, upper] = [averager.triangle(LOWER, [1.0; 3]), averager.triangle(UPPER, [1.0; 3])];
        // x < 1/2 holds on a quarter of the lower triangle and three quarters of the upper one
        assert!((lower.opacity - 0.25).abs() < 0.01, "{lower:?}");
        assert!((upper.opacity - 0.75).abs() < 0.01, "{upper:?}");
        assert_eq!([lower.rgb, upper.rgb], [[1.0, 0.0, 0.0]; 2]);
    }

    /// Catches a cut-off that ignores the factor or the vertices' alpha, and blending that is cut off.
    #[test]
    fn alpha_is_texture_times_factor_times_vertex() {
        let images = checker(64);
        let left = [Vec2::ZERO, Vec2::new(0.4, 0.0), Vec2::new(0.0, 0.9)];
        let opacity = |mode, factor, vertex: f32| {
            Averager::new(&images, &TEXTURE, mode, factor, 1).triangle(left, [vertex; 3]).opacity
        };
        assert_eq!(opacity(AlphaMode::Mask(0.5), 0.6, 1.0), 1.0);
        assert_eq!(opacity(AlphaMode::Mask(0.5), 0.6, 0.8), 0.0);
        assert!((opacity(AlphaMode::Blend, 0.5, 0.5) - 0.25).abs() < 1e-5);
        assert_eq!(opacity(AlphaMode::Opaque, 0.0, 0.0), 1.0);
    }

    /// Catches texture coordinates beyond the image, not finite or huge, that read outside it.
    #[test]
    fn wrapping_stays_inside() {
        for wrap in [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp] {
            for x in [-1e30, -3.25, -0.0, 0.999_999_94, 1.0, 1.75, 1e30, f32::INFINITY, f32::NAN] {
                assert!(wrap.texel(x, 8) < 8, "{wrap:?} {x}");
            }
        }
        assert_eq!(
            [Wrap::Repeat.texel(1.75, 8), Wrap::Mirror.texel(1.75, 8), Wrap::Clamp.texel(1.75, 8)],
            [6, 2, 7]
        );
    }

    /// Catches a texture transform in the wrong order or turning the wrong way (v points down).
    #[test]
    fn transforms_scale_then_turn_then_move() {
        for angle in [0.0, 0.5, -2.0, 3.1, 40.0] {
            assert!((direction(angle) - Vec2::from_angle(angle as f32)).length() < 1e-5, "{angle}");
        }
        let quarter = direction(std::f64::consts::FRAC_PI_2);
        let transform = Some((Vec2::new(10.0, 20.0), quarter, Vec2::new(2.0, 3.0)));
        let placed = Texture { transform, ..TEXTURE }.place(Vec2::new(1.0, 1.0));
        assert!((placed - Vec2::new(13.0, 18.0)).length() < 1e-5, "{placed}");
    }

    /// Catches an image that decides how much memory it takes.
    #[test]
    fn images_beyond_the_memory_are_refused() {
        let mut png = Vec::new();
        let image = image::RgbaImage::new(2000, 2000);
        image.write_to(&mut Cursor::new(&mut png), ImageFormat::Png).unwrap();
        assert!(decode_bytes(&png, 1 << 30).is_ok());
        assert!(decode_bytes(&png, 1 << 20).is_err());
        assert!(
            decode_bytes(&png[..100], 1 << 30).is_err() && decode_bytes(b"RIFF....WEBP", 1 << 30).is_err()
        );
    }
}
