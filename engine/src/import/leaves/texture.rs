//! Textures that let light through: decoding within bounds, and colour and opacity averaged over the area of a face.

use std::collections::HashMap;
use std::io::Cursor;
use std::sync::Arc;

use glam::Vec2;
use image::{ImageFormat, ImageReader, Limits};

use crate::import::srgb;
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

/// How alpha is read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::import) enum AlphaMode {
    Opaque,
    /// Opaque from this alpha up, absent below.
    Mask(f32),
    Blend,
}

/// A decoded image: sRGB bytes with alpha, row by row from the top.
#[derive(Debug)]
pub(in crate::import) struct Image {
    width: u32,
    height: u32,
    texels: Vec<u8>,
}

impl Image {
    /// Decodes a PNG or JPEG, which may take `memory_bytes`.
    pub fn decode(bytes: &[u8], memory_bytes: u64) -> Result<Self> {
        let mut limits = Limits::default();
        limits.max_image_width = Some(EDGE_MAX);
        limits.max_image_height = Some(EDGE_MAX);
        // The decoder's own form and the bytes made of it stand side by side
        limits.max_alloc = Some(memory_bytes / 3);
        let mut reader = reader(bytes)?;
        reader.limits(limits);
        let decoded =
            reader.decode().map_err(|e| Error::invalid(format!("the image cannot be decoded: {e}")))?;
        let rgba = decoded.into_rgba8();
        let (width, height) = rgba.dimensions();
        if width == 0 || height == 0 {
            return Err(Error::invalid("the image is empty"));
        }
        Ok(Self { width, height, texels: rgba.into_raw() })
    }

    /// What decoding takes at its peak, in bytes, by the image's own header.
    pub fn need(bytes: &[u8]) -> Result<u64> {
        let size = reader(bytes)?.into_dimensions();
        let (width, height) =
            size.map_err(|e| Error::invalid(format!("the image cannot be decoded: {e}")))?;
        Ok(12 * u64::from(width) * u64::from(height))
    }

    /// Bytes that it takes.
    pub fn bytes(&self) -> u64 {
        self.texels.len() as u64
    }
}

fn reader(bytes: &[u8]) -> Result<ImageReader<Cursor<&[u8]>>> {
    let reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| Error::invalid("the image cannot be read").caused_by(e))?;
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg) => Ok(reader),
        _ => Err(Error::unsupported("the image is neither PNG nor JPEG")),
    }
}

/// What lies outside of 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::import) enum Wrap {
    Repeat,
    Mirror,
    Clamp,
}

impl Wrap {
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
#[derive(Clone, Debug)]
pub(in crate::import) struct Texture {
    pub image: Arc<Image>,
    pub wrap: [Wrap; 2],
    /// Offset, rotation as cosine and sine, and scale of coordinates.
    pub transform: Option<(Vec2, Vec2, Vec2)>,
    /// Whether the second coordinate points up in the picture.
    pub upward: bool,
    /// The channel that is read as alpha, and what it is multiplied by and then increased by.
    pub alpha: (usize, [f32; 2]),
    /// Whether it colours what it covers.
    pub colored: bool,
}

#[cfg(test)]
impl Texture {
    /// A square image of texels row by row, repeated.
    pub fn square(size: u32, texels: Vec<u8>) -> Self {
        let image = Arc::new(Image { width: size, height: size, texels });
        Self {
            image,
            wrap: [Wrap::Repeat; 2],
            transform: None,
            upward: false,
            alpha: (3, [1.0, 0.0]),
            colored: true,
        }
    }
}

impl Texture {
    /// Texture coordinates as the image is looked up with.
    pub fn place(&self, uv: Vec2) -> Vec2 {
        let uv = match self.transform {
            // A rotation turns counter-clockwise in a picture whose v axis points down
            Some((offset, turn, scale)) => {
                let p = uv * scale;
                offset + Vec2::new(turn.x * p.x + turn.y * p.y, turn.x * p.y - turn.y * p.x)
            }
            None => uv,
        };
        if self.upward { Vec2::new(uv.x, 1.0 - uv.y) } else { uv }
    }

    /// The size of the image in texels.
    pub fn size(&self) -> Vec2 {
        Vec2::new(self.image.width as f32, self.image.height as f32)
    }

    /// The texel at a place, and its alpha.
    fn texel(&self, x: u32, y: u32) -> (&[u8], f32) {
        let start = 4 * (y as usize * self.image.width as usize + x as usize);
        let texel = &self.image.texels[start..start + 4];
        let (channel, [scale, bias]) = self.alpha;
        (texel, f32::from(texel[channel]) * (1.0 / 255.0) * scale + bias)
    }
}

/// Cosine and sine by their series, whose bits are the same on every machine; no rotation for an angle beyond reason.
pub(in crate::import) fn direction(angle: f64) -> Vec2 {
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

/// What is seen of a face from afar.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::import) struct Average {
    /// Linear colour of what is covered.
    pub rgb: [f32; 3],
    /// The share of light that is stopped, 0 to 1.
    pub opacity: f32,
}

/// Averages a texture over faces.
pub(in crate::import) struct Averager<'a> {
    texture: &'a Texture,
    alpha: AlphaMode,
    factor: f32,
    pattern_max: u32,
    memory: HashMap<[u32; 6], Average>,
}

impl<'a> Averager<'a> {
    /// For `faces` faces of one material, whose alpha factor is `factor`.
    pub fn new(texture: &'a Texture, alpha: AlphaMode, factor: f32, faces: usize) -> Self {
        let share = (SAMPLES_MAX / faces.max(1) as u64).max(16);
        let pattern_max = (share.isqrt() as u32).min(PATTERN_MAX);
        Self { texture, alpha, factor, pattern_max, memory: HashMap::new() }
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

    /// Texture coordinates on the image, in texels.
    pub fn on_image(&self, uv: [Vec2; 3]) -> [Vec2; 3] {
        uv.map(|uv| self.texture.place(uv) * self.texture.size())
    }

    /// The longest edge of a triangle of given texture coordinates, in texels.
    pub fn longest_edge(&self, uv: [Vec2; 3]) -> f32 {
        let at = self.on_image(uv);
        (0..3).map(|i| at[i].distance(at[(i + 1) % 3])).fold(0.0, f32::max)
    }

    /// Whether coverage is the same, but for rounding, at every texel of the box about a triangle.
    pub fn is_even(&self, uv: [Vec2; 3], alphas: [f32; 3]) -> bool {
        let size = [self.texture.image.width, self.texture.image.height];
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
                let alpha = self.texture.texel(x, y).1 * self.factor;
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
        let size = self.texture.size();
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
        let Texture { wrap, image, .. } = self.texture;
        let (texel, alpha) =
            self.texture.texel(wrap[0].texel(uv.x, image.width), wrap[1].texel(uv.y, image.height));
        let vertex_alpha = alphas[0] * a + alphas[1] * b + alphas[2] * c;
        let cover = coverage(self.alpha, alpha * self.factor * vertex_alpha);
        for (channel, &byte) in texel[..3].iter().enumerate() {
            let linear = if self.texture.colored { srgb::linear(byte) } else { 1.0 };
            sums.plain[channel] += linear;
            sums.covered[channel] += linear * cover;
        }
        sums.cover += cover;
        sums.count += 1.0;
    }
}

/// How much light an alpha value stops.
pub(in crate::import) fn coverage(mode: AlphaMode, alpha: f32) -> f32 {
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

    fn checker(size: u32) -> Texture {
        // The left half is opaque red, the right half clear green
        let texel = |i: u32| if i % size < size / 2 { [255, 0, 0, 255] } else { [0, 255, 0, 0] };
        Texture::square(size, (0..size * size).flat_map(texel).collect())
    }

    const LOWER: [Vec2; 3] = [Vec2::ZERO, Vec2::X, Vec2::ONE];
    const UPPER: [Vec2; 3] = [Vec2::ZERO, Vec2::ONE, Vec2::Y];

    /// Catches an average that is not by area, and clear texels that bleed their colour into the leaf.
    #[test]
    fn coverage_is_the_share_of_the_area() {
        let texture = checker(256);
        let mut averager = Averager::new(&texture, AlphaMode::Mask(0.5), 1.0, 2);
        let [lower, upper] = [averager.triangle(LOWER, [1.0; 3]), averager.triangle(UPPER, [1.0; 3])];
        // x < 1/2 holds on a quarter of the lower triangle and three quarters of the upper one
        assert!((lower.opacity - 0.25).abs() < 0.01, "{lower:?}");
        assert!((upper.opacity - 0.75).abs() < 0.01, "{upper:?}");
        assert_eq!([lower.rgb, upper.rgb], [[1.0, 0.0, 0.0]; 2]);
    }

    /// Catches a cut-off that ignores the factor or the vertices' alpha, and blending that is cut off.
    #[test]
    fn alpha_is_texture_times_factor_times_vertex() {
        let texture = checker(64);
        let left = [Vec2::ZERO, Vec2::new(0.4, 0.0), Vec2::new(0.0, 0.9)];
        let opacity = |mode, factor, vertex: f32| {
            Averager::new(&texture, mode, factor, 1).triangle(left, [vertex; 3]).opacity
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
        let placed = Texture { transform, ..checker(2) }.place(Vec2::new(1.0, 1.0));
        assert!((placed - Vec2::new(13.0, 18.0)).length() < 1e-5, "{placed}");
    }

    /// Catches an image that decides how much memory it takes.
    #[test]
    fn images_beyond_the_memory_are_refused() {
        let mut png = Vec::new();
        let image = image::RgbaImage::new(2000, 2000);
        image.write_to(&mut Cursor::new(&mut png), ImageFormat::Png).unwrap();
        assert!(Image::decode(&png, 1 << 30).is_ok());
        assert!(Image::decode(&png, 1 << 20).is_err());
        assert!(
            Image::decode(&png[..100], 1 << 30).is_err() && Image::decode(b"RIFF....WEBP", 1 << 30).is_err()
        );
    }
}
