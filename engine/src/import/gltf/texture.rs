//! Base colour textures of a document: what a material refers to, and the images decoded so far.

use std::sync::Arc;

use glam::Vec2;

use super::container::{Container, missing};
use super::document::{Extensions, TextureInfo};
use crate::import::ImportReport;
use crate::import::leaves::texture::{Image, Texture, Wrap, direction};
use crate::{Error, Result};

/// The images decoded so far.
#[derive(Default)]
pub(super) struct Images {
    loaded: Vec<(usize, Arc<Image>)>,
}

impl Images {
    /// Resolves a texture reference and decodes its image; with it the set of coordinates that it is looked up with.
    /// None, with a warning, where that is not possible.
    pub fn load(
        &mut self,
        container: &mut Container,
        info: &TextureInfo,
        report: &mut ImportReport,
    ) -> Result<Option<(u32, Texture)>> {
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
        let decoded = match self.loaded.iter().find(|(known, _)| *known == image) {
            Some((_, decoded)) => decoded.clone(),
            None => match decode(container, image) {
                Ok(decoded) => self.keep(container, image, decoded)?,
                Err(error) => {
                    report.warn(format!("image {image} is left out, its material keeps its factor: {error}"));
                    return Ok(None);
                }
            },
        };
        let (set, transform) = transform(info);
        let wrap = [wrap(sampler.wrap_s), wrap(sampler.wrap_t)];
        let alpha = (3, [1.0, 0.0]);
        let texture = Texture { image: decoded, wrap, transform, upward: false, alpha, colored: true };
        Ok(Some((set, texture)))
    }

    /// Keeps an image, and drops the oldest while there is no room for it.
    fn keep(&mut self, container: &mut Container, index: usize, image: Image) -> Result<Arc<Image>> {
        while !self.loaded.is_empty() && container.budget.left() < image.bytes() {
            let (_, oldest) = self.loaded.remove(0);
            container.budget.give(oldest.bytes());
        }
        container.budget.take(image.bytes(), &format!("image {index}"))?;
        let image = Arc::new(image);
        self.loaded.push((index, image.clone()));
        Ok(image)
    }
}

/// What lies outside of 0 to 1, by its code.
fn wrap(code: Option<u32>) -> Wrap {
    match code {
        Some(33_071) => Wrap::Clamp,
        Some(33_648) => Wrap::Mirror,
        _ => Wrap::Repeat,
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

fn decode(container: &mut Container, index: usize) -> Result<Image> {
    let left = container.budget.left();
    with_bytes(container, index, |bytes| Image::decode(bytes, left))
}

/// What decoding a texture's image takes at its peak, in bytes; none for one that cannot be read.
pub(super) fn need(container: &mut Container, info: &TextureInfo) -> u64 {
    let texture = container.document.textures.get(info.index);
    let image = texture.and_then(|texture| texture.source);
    image.and_then(|image| with_bytes(container, image, Image::need).ok()).unwrap_or(0)
}

/// Calls `read` with the bytes of an image.
fn with_bytes<T>(
    container: &mut Container,
    index: usize,
    read: impl FnOnce(&[u8]) -> Result<T>,
) -> Result<T> {
    let images = &container.document.images;
    let found = images.get(index).ok_or_else(|| missing("image", index, images.len()))?;
    match (found.uri.clone(), found.buffer_view) {
        (Some(uri), _) => {
            let bytes = container.image_uri(&uri, index)?;
            let found = read(&bytes);
            container.release(bytes);
            found
        }
        (None, Some(view)) => read(container.view(view)?.0),
        (None, None) => Err(Error::invalid(format!("image {index} has no data"))),
    }
}
