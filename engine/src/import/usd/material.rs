//! Materials as far as they let light through: the opacity of `UsdPreviewSurface`, a number or a texture, and its threshold.

use std::cell::RefCell;
use std::io::Read;
use std::sync::Arc;

use glam::Vec2;
use openusd::ar::{DefaultResolver, ResolvedPath, Resolver};
use openusd::sdf::Value;

use super::read::Stage;
use crate::import::ImportReport;
use crate::import::leaves::texture::{AlphaMode, Image, Texture, Wrap, direction};
use crate::{Error, Result};

/// Connections that are followed from an input to what it reads, at most.
const HOPS_MAX: usize = 8;

/// Images that are kept while a stage is read.
const IMAGES_MAX: usize = 16;

/// The coordinates of a texture, unless its reader says otherwise.
const UV_DEFAULT: &str = "st";

/// What covers the faces of a prim, or some of them.
#[derive(Clone, Debug)]
pub(super) struct Cover {
    /// The faces by their number in the prim; none is all that no other cover names.
    pub faces: Option<Vec<i64>>,
    pub alpha: AlphaMode,
    /// The opacity, or what the texture is multiplied by.
    pub opacity: f32,
    /// The texture, and the primvar that has its coordinates.
    pub texture: Option<(Texture, String)>,
}

/// Images by their resolved paths.
pub(super) type Images = RefCell<Vec<(String, Arc<Image>)>>;

/// The materials of a prim and of its subsets of faces that let light through: their surface shaders, and the subset.
pub(super) fn see_through(stage: &Stage, prim: &str) -> Vec<(String, Option<String>)> {
    let own = bound(stage, prim).and_then(|material| surface(stage, &material));
    let mut found: Vec<_> = own.map(|shader| (shader, None)).into_iter().collect();
    let names = stage.stage.prim(prim).child_names().unwrap_or_default();
    for name in &names {
        let child = format!("{prim}/{}", name.as_str());
        let type_name = stage.stage.prim(child.as_str()).type_name().ok().flatten();
        if type_name.is_none_or(|name| name.as_str() != "GeomSubset") {
            continue;
        }
        if let Some(shader) = direct(stage, &child).and_then(|material| surface(stage, &material)) {
            found.push((shader, Some(child)));
        }
    }
    let may = |shader: &str| {
        let input = format!("{shader}.inputs:opacity");
        source(stage, &input).1
            || stage
                .numbers(shader, "inputs:opacity")
                .and_then(|all| all.first().copied())
                .is_some_and(|x| x < 1.0)
    };
    // A subset of opaque faces counts too: its faces are not those of the prim's own material
    if !found.iter().any(|(shader, _)| may(shader)) {
        found.clear();
    }
    found
}

/// The material bound to a prim, by itself or by the nearest ancestor.
fn bound(stage: &Stage, prim: &str) -> Option<String> {
    let mut path = prim;
    while !path.is_empty() {
        if let Some(material) = direct(stage, path) {
            return Some(material);
        }
        path = path.rsplit_once('/')?.0;
    }
    None
}

/// The material that a prim binds itself: for final pictures, for all purposes, or for previews.
fn direct(stage: &Stage, prim: &str) -> Option<String> {
    let names = ["material:binding:full", "material:binding", "material:binding:preview"];
    let target = |name| {
        let targets = stage.stage.relationship(format!("{prim}.{name}")).targets().ok()?;
        targets.first().map(|target| target.as_str().to_owned())
    };
    names.into_iter().find_map(target)
}

/// The surface shader of a material, if it is a `UsdPreviewSurface`.
fn surface(stage: &Stage, material: &str) -> Option<String> {
    let (output, _) = source(stage, &format!("{material}.outputs:surface"));
    let shader = output.split_once('.')?.0.to_owned();
    (stage.text(&shader, "info:id")? == "UsdPreviewSurface").then_some(shader)
}

/// Follows connections from an attribute; whether there were any.
fn source(stage: &Stage, attribute: &str) -> (String, bool) {
    let (mut path, mut followed) = (attribute.to_owned(), false);
    for _ in 0..HOPS_MAX {
        let connections = stage.stage.attribute(path.as_str()).connections().unwrap_or_default();
        let Some(next) = connections.first() else { break };
        path = next.as_str().to_owned();
        followed = true;
    }
    (path, followed)
}

/// Reads what covers a prim.
pub(super) fn covers(
    stage: &Stage,
    shaders: &[(String, Option<String>)],
    report: &mut ImportReport,
) -> Vec<Cover> {
    let cover = |(shader, subset): &(String, Option<String>)| {
        let faces = subset.as_ref().map(|subset| stage.integers(subset, "indices").unwrap_or_default());
        let number = |name: &str| {
            let (path, _) = source(stage, &format!("{shader}.inputs:{name}"));
            let (prim, attribute) = path.split_once('.')?;
            stage.numbers(prim, attribute).and_then(|all| all.first().copied()).map(|x| x as f32)
        };
        let threshold = number("opacityThreshold").unwrap_or(0.0);
        let alpha = if threshold > 0.0 { AlphaMode::Mask(threshold) } else { AlphaMode::Blend };
        let texture = texture(stage, shader).unwrap_or_else(|error| {
            report.warn(format!("a texture of `{shader}` is left out, it is opaque: {error}"));
            None
        });
        let opacity = if texture.is_some() { 1.0 } else { number("opacity").unwrap_or(1.0) };
        Cover { faces, alpha, opacity, texture }
    };
    shaders.iter().map(cover).collect()
}

/// The texture that a shader's opacity is read from, if any.
fn texture(stage: &Stage, shader: &str) -> Result<Option<(Texture, String)>> {
    let (output, _) = source(stage, &format!("{shader}.inputs:opacity"));
    let Some((reader, channel)) = output.split_once(".outputs:") else { return Ok(None) };
    if stage.text(reader, "info:id").is_none_or(|id| id != "UsdUVTexture") {
        return Err(Error::unsupported("its opacity is read from something else than a `UsdUVTexture`"));
    }
    let channel = match channel {
        "r" | "rgb" => 0,
        "g" => 1,
        "b" => 2,
        _ => 3,
    };
    let nth = |name: &str, default: f64| {
        let all = stage.numbers(reader, name);
        all.and_then(|all| all.get(channel).copied()).unwrap_or(default) as f32
    };
    let wrap = |name: &str| match stage.text(reader, name).as_deref() {
        Some("repeat") => Wrap::Repeat,
        Some("mirror") => Wrap::Mirror,
        _ => Wrap::Clamp,
    };
    let (coordinates, transform) = coordinates(stage, reader);
    let texture = Texture {
        image: image(stage, reader)?,
        wrap: [wrap("inputs:wrapS"), wrap("inputs:wrapT")],
        transform,
        upward: true,
        alpha: (channel, [nth("inputs:scale", 1.0), nth("inputs:bias", 0.0)]),
        colored: false,
    };
    Ok(Some((texture, coordinates)))
}

type Transform = Option<(Vec2, Vec2, Vec2)>;

/// The primvar that a texture is looked up with, and how it is transformed.
fn coordinates(stage: &Stage, reader: &str) -> (String, Transform) {
    let id = |node: &str| stage.text(node, "info:id").unwrap_or_default();
    let node_of = |path: String| path.split_once('.').map(|(node, _)| node.to_owned()).unwrap_or_default();
    let mut node = node_of(source(stage, &format!("{reader}.inputs:st")).0);
    let mut transform = None;
    if id(&node) == "UsdTransform2d" {
        let pair = |name: &str, default: f32| {
            let all = stage.numbers(&node, name).unwrap_or_default();
            let at = |i: usize| all.get(i).map_or(default, |&x| x as f32);
            Vec2::new(at(0), at(1))
        };
        let degrees = stage.numbers(&node, "inputs:rotation").and_then(|all| all.first().copied());
        // Here the second axis points up: what turns counter-clockwise turns the other way
        let turn = direction(-degrees.unwrap_or(0.0).to_radians());
        transform = Some((pair("inputs:translation", 0.0), turn, pair("inputs:scale", 1.0)));
        node = node_of(source(stage, &format!("{node}.inputs:in")).0);
    }
    let (path, _) = source(stage, &format!("{node}.inputs:varname"));
    let name = path.split_once('.').and_then(|(prim, attribute)| stage.text(prim, attribute));
    (
        name.filter(|_| id(&node).starts_with("UsdPrimvarReader")).unwrap_or_else(|| UV_DEFAULT.into()),
        transform,
    )
}

/// The image of a texture, decoded once. Its name is relative to the layer that gives it.
fn image(stage: &Stage, reader: &str) -> Result<Arc<Image>> {
    let (path, _) = source(stage, &format!("{reader}.inputs:file"));
    let attribute = stage.stage.attribute(path.as_str());
    let name = attribute.get::<Value>().ok().flatten();
    let name = name.as_ref().and_then(Value::as_str).filter(|name| !name.is_empty());
    let name = name.ok_or_else(|| Error::invalid(format!("`{reader}` names no file")))?;
    let layers = attribute.property_stack().unwrap_or_default();
    let resolver = DefaultResolver::new();
    let found = layers.iter().find_map(|(layer, _)| {
        let anchor = ResolvedPath::new(layer.as_str());
        resolver.resolve(&resolver.create_identifier(name, Some(&anchor)))
    });
    let found = found.ok_or_else(|| Error::invalid(format!("there is no file `{}`", name.escape_debug())))?;
    let key = found.to_string_lossy().into_owned();
    let known = stage.images.borrow().iter().find(|(known, _)| *known == key).map(|(_, image)| image.clone());
    if let Some(image) = known {
        return Ok(image);
    }
    let image = Arc::new(decode(&resolver, &found, stage.memory_bytes)?);
    let mut images = stage.images.borrow_mut();
    if images.len() >= IMAGES_MAX {
        images.remove(0);
    }
    images.push((key, image.clone()));
    Ok(image)
}

fn decode(resolver: &DefaultResolver, path: &ResolvedPath, memory_bytes: u64) -> Result<Image> {
    let io = |error| Error::io("read the image", path, error);
    let mut asset = resolver.open_asset(path).map_err(io)?;
    let bytes = asset.size().map_err(io)?;
    // Some images are kept, and the mesh needs room too
    let share = memory_bytes / (2 * IMAGES_MAX as u64);
    if bytes > share {
        return Err(Error::invalid(format!("an image of {bytes} bytes, at most {share} are read")));
    }
    let mut all = Vec::new();
    asset.read_to_end(&mut all).map_err(io)?;
    Image::decode(&all, memory_bytes / 4)
}
