//! The tree becomes a scene: its head, its cameras, and its shaders and geometries in the order they need each other.

use super::element::{Element, Value};
use super::files::{Files, Roots};
use super::geometry::Geometries;
use super::names::Names;
use super::shader::shader;
use super::xml::{Document, cut};
use super::{Camera, ErrorKind, Result, Scene, UpAxis};

/// The version of the grammar that this code reads.
const VERSION: &str = "1";
/// Cameras of a scene at most.
pub const CAMERAS_MAX: usize = 4096;
/// Shaders of a scene at most.
pub const SHADERS_MAX: usize = 4096;
/// Pixels of a picture's side at most.
const SIDE_MAX: u64 = 65_536;
/// Pixels of a picture at most, 16,384².
const PIXELS_MAX: u64 = 1 << 28;

/// The units that a scene may stand in, and metres per unit.
pub const UNITS: [(&str, f64); 7] =
    [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("km", 1000.0), ("in", 0.0254), ("ft", 0.3048), ("yd", 0.9144)];

/// Makes a scene of a document.
pub(super) fn scene(document: &Document<'_>, frame: Option<i64>, roots: Option<&Roots>) -> Result<Scene> {
    let root = Element::root(document);
    check_head(root)?;
    let meters_per_unit = root.required("units")?.choice("unit", &UNITS)?;
    let up = root.required("up")?.choice("up axis", &[("y", UpAxis::Y), ("z", UpAxis::Z)])?;

    let mut camera_names = Names::new("camera");
    let mut cameras = Vec::new();
    for element in root.children_named("camera") {
        limited(element, cameras.len(), CAMERAS_MAX, "cameras")?;
        cameras.push(camera(element, &mut camera_names)?);
    }

    let mut shader_names = Names::new("shader");
    let mut shaders = Vec::new();
    for element in section(root, "shaders", "shader")? {
        limited(element, shaders.len(), SHADERS_MAX, "shaders")?;
        shaders.push(shader(element, &mut shader_names)?);
    }

    let elements = section(root, "geometries", "geometry")?;
    let base = document.path.parent().unwrap_or("".as_ref());
    let files = Files { base, frame, roots };
    let mut declared = Geometries::declare(&elements, files, &camera_names, (&shader_names, &shaders))?;
    if declared.occluders.is_empty() {
        let message = "scene has no occluder, expected a geometry with `occluder=\"true\"`";
        return Err(root.error(ErrorKind::Invalid, message));
    }
    let geometries = elements.iter().map(|&element| declared.geometry(element)).collect::<Result<_>>()?;
    let path = document.path.to_path_buf();
    Ok(Scene { path, frame, meters_per_unit, up, cameras, shaders, geometries })
}

/// Checks the root's name and version before anything else: another version may have another grammar.
fn check_head(root: Element<'_>) -> Result<()> {
    if root.name() != "scene" {
        let message = format!("unknown root element `{}`, expected `scene`", cut(root.name()));
        return Err(root.error(ErrorKind::Invalid, message));
    }
    if let Some(version) = root.optional("version")?
        && version.text() != VERSION
    {
        let message = format!("scene version `{}` found, `{VERSION}` wanted", cut(version.text()));
        return Err(version.error(ErrorKind::Unsupported, message));
    }
    // The last two let editors find the schema; they mean nothing here
    let attributes = ["version", "units", "up", "xmlns:xsi", "xsi:noNamespaceSchemaLocation"];
    root.expect_only(&attributes, &["camera", "shaders", "geometries"])?;
    root.required("version").map(drop)
}

/// The children of all sections of a name.
fn section<'d>(root: Element<'d>, name: &str, child: &str) -> Result<Vec<Element<'d>>> {
    let mut elements = Vec::new();
    for section in root.children_named(name) {
        section.expect_only(&[], &[child])?;
        elements.extend(section.children());
    }
    Ok(elements)
}

/// `<camera name="" fov="" resolution="" matrix=""/>`
fn camera<'d>(element: Element<'d>, names: &mut Names<'d>) -> Result<Camera> {
    element.expect_only(&["name", "fov", "resolution", "matrix"], &[])?;
    let is_angle = |degrees| degrees > 0.0 && degrees < 180.0;
    Ok(Camera {
        name: names.declare(&element.required("name")?)?,
        fov_degrees: element.required("fov")?.real("degrees more than 0 and less than 180", is_angle)?,
        resolution: resolution(&element.required("resolution")?)?,
        world_from_camera: element.required("matrix")?.matrix()?,
    })
}

/// Width and height.
fn resolution(value: &Value<'_>) -> Result<[u32; 2]> {
    let side = |word: &str| word.parse().ok().filter(|side| (1..=SIDE_MAX).contains(side));
    let words: Vec<(usize, &str)> = value.words().take(3).collect();
    let &[(_, width), (_, height)] = &words[..] else {
        let message = format!("resolution `{}`, expected width and height", cut(value.text()));
        return Err(value.error(ErrorKind::Invalid, message).hint("write it as `1920 1080`"));
    };
    let sides = [width, height].map(side);
    let [Some(width), Some(height)] = sides else {
        let (offset, word) = words[usize::from(sides[0].is_some())];
        let message =
            format!("`{}` is out of range, expected a whole number from 1 to {SIDE_MAX}", cut(word));
        return Err(value.error_at(offset, ErrorKind::Invalid, message));
    };
    if width * height > PIXELS_MAX {
        let message = format!("picture of {width} by {height} pixels, at most {PIXELS_MAX} are possible");
        return Err(value.error(ErrorKind::Limit, message));
    }
    Ok([width as u32, height as u32])
}

/// Refuses one more than `max` of something.
pub(super) fn limited(element: Element<'_>, count: usize, max: usize, what: &str) -> Result<()> {
    if count < max {
        return Ok(());
    }
    Err(element.error(ErrorKind::Limit, format!("more than {max} {what}")))
}
