//! A primitive of a mesh becomes an indexed mesh, with albedo per vertex and opacity per face.

use std::collections::BTreeSet;

use glam::{DVec3, Vec2, Vec3};

use super::container::{Container, missing, unsupported};
use super::document::Primitive;
use super::nodes::Copies;
use super::texture::{self, Images};
use crate::import::emit::opacity_byte;
use crate::import::leaves;
use crate::import::leaves::texture::{AlphaMode, Averager, Texture, coverage};
use crate::import::mesh::{Face, Mesh};
use crate::import::{ImportReport, polygon, srgb};
use crate::{Error, ErrorKind, Result};

const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

/// A material as far as it is read.
pub(super) struct Surface {
    pub factor: [f32; 4],
    /// The texture, and which set of coordinates it is looked up with.
    pub texture: Option<(u32, Texture)>,
    pub alpha: AlphaMode,
}

/// A primitive in memory.
pub(super) struct Read {
    pub mesh: Mesh,
    /// What was taken from the budget for it, to be given back.
    pub bytes: u64,
    /// What its faces are to be cut by; without it they are painted.
    pub leaves: Option<Cut>,
}

/// What the faces of a primitive are cut by.
pub(super) struct Cut {
    pub texture: Texture,
    pub alpha: AlphaMode,
    pub factor: f32,
    /// Two coordinates a vertex.
    uvs: Vec<f32>,
    /// Colours of vertices and their components, if there are any.
    colors: Option<(Vec<f32>, usize)>,
}

impl Cut {
    /// Texture coordinates and alpha of a corner of the mesh.
    pub fn corner(&self, mesh: &Mesh, corner: usize) -> (Vec2, f32) {
        let vertex = mesh.corners[corner] as usize;
        (Vec2::from_slice(&self.uvs[2 * vertex..]), vertex_color(self.colors.as_ref(), vertex)[3])
    }
}

impl Read {
    /// Gives back what it takes.
    pub fn release(self, container: &mut Container) {
        container.budget.give(self.bytes);
        if let Some(Cut { uvs, colors, .. }) = self.leaves {
            release(container, colors, Some(uvs));
        }
    }
}

/// Computes what the import will hold at once, in bytes, and refuses what is more than allowed, before any of it is taken.
pub(super) fn check_memory(container: &mut Container, copies: &Copies, wanted: Wanted) -> Result<u64> {
    let document = &container.document;
    // Buffers stay in memory once they are loaded
    let fixed = document.buffers.iter().map(|buffer| buffer.byte_length).fold(0, u64::saturating_add);
    let (mut largest, mut name) = (0_u64, String::new());
    for &mesh in copies.keys() {
        for (index, primitive) in document.meshes[mesh].primitives.iter().enumerate() {
            let count =
                |accessor: Option<usize>| accessor.and_then(|a| document.accessors.get(a)).map(|a| a.count);
            let vertices = count(primitive.attributes.get("POSITION").copied()).unwrap_or(0);
            let corners = count(primitive.indices).unwrap_or(vertices);
            let mode = primitive.mode.unwrap_or(4);
            // Beside the mesh stand its indices or its positions, and texture coordinates and colours
            let own =
                mesh_bytes(vertices, corners, mode).saturating_add(vertices.max(corners).saturating_mul(24));
            let leaves = if wanted.leaves && primitive.material.is_some() { leaves::BYTES } else { 0 };
            if own.saturating_add(leaves) > largest {
                (largest, name) = (own.saturating_add(leaves), format!("mesh {mesh}, primitive {index}"));
            }
        }
    }
    let need = container.budget.held().saturating_add(fixed).saturating_add(largest);
    container.budget.check(need, &name)?;

    // The images that are looked at; those not in use are dropped for others
    let primitives = copies.keys().flat_map(|&mesh| &document.meshes[mesh].primitives);
    let materials: BTreeSet<usize> = primitives.filter_map(|primitive| primitive.material).collect();
    let mut image = 0;
    for material in materials {
        let found = container.document.materials.get(material);
        if let Some(info) = found.and_then(|material| material.base().base_color_texture) {
            image = texture::need(container, &info).max(image);
        }
    }
    container.budget.check(need.saturating_add(image), "the largest image")?;
    Ok(need.saturating_add(image))
}

/// Bytes of a primitive's mesh. Strips and fans have a face for each index.
fn mesh_bytes(vertices: u64, corners: u64, mode: u32) -> u64 {
    let faces = if mode == 4 { corners / 3 } else { corners };
    Mesh::bytes(vertices, faces.saturating_mul(3), faces)
}

/// What is wanted of a primitive.
#[derive(Clone, Copy)]
pub(super) struct Wanted {
    pub albedo: bool,
    /// Whether faces whose texture lets light through are to be cut along it.
    pub leaves: bool,
}

/// Reads primitive `index` of mesh `mesh`. None when it has nothing to show.
pub(super) fn read(
    container: &mut Container,
    (mesh, index): (usize, usize),
    images: &mut Images,
    wanted: Wanted,
    report: &mut ImportReport,
) -> Result<Option<Read>> {
    let primitive = std::mem::take(&mut container.document.meshes[mesh].primitives[index].attributes);
    let outcome = read_attributes(container, (mesh, index), &primitive, images, wanted, report);
    container.document.meshes[mesh].primitives[index].attributes = primitive;
    outcome.map_err(|error| within(error, mesh, index))
}

/// Says in which primitive an error lies.
fn within(error: Error, mesh: usize, index: usize) -> Error {
    let message = format!("mesh {mesh}, primitive {index}: {}", error.message());
    let mut named = Error::new(error.kind(), message);
    if let Some(hint) = error.hint_text() {
        named = named.hint(hint);
    }
    match error.place() {
        Some(crate::error::Place::Path(path)) => named.at(path),
        Some(crate::error::Place::Byte { path, offset }) => named.at_byte(path, *offset),
        Some(crate::error::Place::Text { path, line, column }) => named.at_text(path, *line, *column),
        None => named,
    }
}

type Attributes = std::collections::BTreeMap<String, usize>;

fn read_attributes(
    container: &mut Container,
    place: (usize, usize),
    attributes: &Attributes,
    images: &mut Images,
    wanted: Wanted,
    report: &mut ImportReport,
) -> Result<Option<Read>> {
    let primitive: &Primitive = &container.document.meshes[place.0].primitives[place.1];
    let (indices, material, mode) = (primitive.indices, primitive.material, primitive.mode.unwrap_or(4));
    let compressed = primitive.extensions.keys().find(|name| name.contains("draco")).cloned();
    let Some(&positions) = attributes.get("POSITION") else {
        report.skip("primitives without positions", 1);
        return Ok(None);
    };
    // A fallback beside the compressed data is read as if that were not there
    if let Some(name) = compressed.filter(|_| !container.has_data(positions)) {
        return Err(unsupported(&name));
    }
    let vertices = container.count(positions)?;
    let corners = indices.map_or(Ok(vertices), |indices| container.count(indices))?;
    let bytes = mesh_bytes(vertices, corners, mode);
    container.budget.take(bytes, "the mesh")?;
    let mut mesh = Mesh { single_precision: true, ..Mesh::default() };
    let (values, _) = container.floats(positions, &[3])?;
    mesh.positions.extend(values.chunks_exact(3).map(|p| Vec3::from_slice(p).as_dvec3()));
    container.release(values);
    if let Some(&normals) = attributes.get("NORMAL") {
        let (values, _) = container.floats(normals, &[3])?;
        same_count(normals, values.len() / 3, &mesh)?;
        mesh.normals.extend(values.chunks_exact(3).map(Vec3::from_slice));
        container.release(values);
    }
    push_faces(container, indices, mode, &mut mesh, report)?;
    mesh.finish(report)?;
    let surface = surface(container, material, images, report)?;
    let colors = match attributes.get("COLOR_0") {
        Some(&colors) => Some((container.floats(colors, &[3, 4])?, colors)),
        None => None,
    };
    if let Some(((values, components), accessor)) = &colors {
        same_count(*accessor, values.len() / components, &mesh)?;
    }
    let mut uvs = match surface.texture.as_ref().map(|(set, _)| format!("TEXCOORD_{set}")) {
        Some(name) => match attributes.get(&name) {
            Some(&accessor) => {
                let (values, _) = container.floats(accessor, &[2])?;
                same_count(accessor, values.len() / 2, &mesh)?;
                Some(values)
            }
            None => {
                report.warn(format!("a textured primitive has no `{name}`: its material keeps its factor"));
                None
            }
        },
        None => None,
    };
    let mut colors = colors.map(|(colors, _)| colors);
    if wanted.leaves
        && surface.alpha != AlphaMode::Opaque
        && mesh.faces.iter().all(|face| face.arity == 3)
        && let Some((_, texture)) = &surface.texture
        && let Some(uvs) = uvs.take()
    {
        container.budget.take(leaves::BYTES, "cutting faces to texels")?;
        if wanted.albedo {
            color(&mut mesh, surface.factor, |_| [1.0; 3], |v| vertex_color(colors.as_ref(), v));
        }
        let (alpha, factor) = (surface.alpha, surface.factor[3]);
        let leaves = Cut { texture: texture.clone(), alpha, factor, uvs, colors };
        return Ok(Some(Read { mesh, bytes: bytes + leaves::BYTES, leaves: Some(leaves) }));
    }
    paint(&mut mesh, &surface, uvs.as_deref(), |v| vertex_color(colors.as_ref(), v), wanted.albedo);
    release(container, colors.take(), uvs);
    Ok(Some(Read { mesh, bytes, leaves: None }))
}

/// Gives back what the colours and the texture coordinates of vertices take.
fn release(container: &mut Container, colors: Option<(Vec<f32>, usize)>, uvs: Option<Vec<f32>>) {
    if let Some((values, _)) = colors {
        container.release(values);
    }
    if let Some(values) = uvs {
        container.release(values);
    }
}

/// The colour of a vertex, white where it has none.
fn vertex_color(colors: Option<&(Vec<f32>, usize)>, vertex: usize) -> [f32; 4] {
    match colors {
        Some((values, components)) => {
            std::array::from_fn(|i| if i < *components { values[vertex * components + i] } else { 1.0 })
        }
        None => [1.0; 4],
    }
}

fn same_count(accessor: usize, count: usize, mesh: &Mesh) -> Result<()> {
    let vertices = mesh.positions.len();
    if count == vertices {
        return Ok(());
    }
    Err(Error::invalid(format!("accessor {accessor} has {count} elements, {vertices} vertices expected")))
}

/// Makes faces of indices, or of the vertices in order.
fn push_faces(
    container: &mut Container,
    indices: Option<usize>,
    mode: u32,
    mesh: &mut Mesh,
    report: &mut ImportReport,
) -> Result<()> {
    let vertices = u32::try_from(mesh.positions.len())
        .map_err(|_| Error::new(ErrorKind::Limit, "a primitive of more than 4,294,967,295 vertices"))?;
    report.source.vertices += u64::from(vertices);
    let order = match indices {
        Some(accessor) => {
            let order = container.indices(accessor)?;
            if let Some((i, index)) = order.iter().enumerate().find(|&(_, &index)| index >= vertices) {
                let message =
                    format!("accessor {accessor}, element {i}: vertex {index} of {vertices} vertices");
                return Err(Error::invalid(message));
            }
            order
        }
        None => (0..vertices).collect(),
    };
    let n = order.len();
    let mut push = |corners: &[u32]| mesh.push_face(FACE, corners, report);
    match mode {
        0 => order.chunks_exact(1).try_for_each(push)?,
        1 => order.chunks_exact(2).try_for_each(push)?,
        2 | 3 => {
            order.windows(2).try_for_each(&mut push)?;
            if mode == 2 && n > 2 {
                push(&[order[n - 1], order[0]])?;
            }
        }
        4 => order.chunks_exact(3).try_for_each(push)?,
        // Every other triangle of a strip is turned, so that all face the same way (specification, section 3.7.2.1)
        5 => {
            for (i, t) in order.windows(3).enumerate() {
                push(&if i % 2 == 0 { [t[0], t[1], t[2]] } else { [t[0], t[2], t[1]] })?;
            }
        }
        6 => order.windows(2).skip(1).try_for_each(|pair| push(&[order[0], pair[0], pair[1]]))?,
        _ => return Err(Error::invalid(format!("mode `{mode}`, 0 to 6 are possible"))),
    }
    let rest = match mode {
        1 => n % 2,
        4 => n % 3,
        _ => 0,
    };
    report.skip("corners that are too few for another face", rest as u64);
    if indices.is_some() {
        container.release(order);
    }
    Ok(())
}

fn surface(
    container: &mut Container,
    material: Option<usize>,
    images: &mut Images,
    report: &mut ImportReport,
) -> Result<Surface> {
    let Some(index) = material else {
        return Ok(Surface { factor: [1.0; 4], texture: None, alpha: AlphaMode::Opaque });
    };
    let materials = &container.document.materials;
    let found = materials.get(index).ok_or_else(|| missing("material", index, materials.len()))?;
    let base = found.base();
    let alpha = found.alpha().unwrap_or_else(|| {
        report.warn(format!("material {index} has an unknown alpha mode: it is opaque"));
        AlphaMode::Opaque
    });
    let texture = match &base.base_color_texture {
        Some(info) => images.load(container, info, report)?,
        None => None,
    };
    Ok(Surface { factor: base.base_color_factor.unwrap_or([1.0; 4]), texture, alpha })
}

/// Gives faces their opacity and vertices their albedo. With a texture a vertex gets what the faces around it show on
/// average, weighted by what they cover: so vertices stay shared, and clear texels colour nothing.
fn paint(
    mesh: &mut Mesh,
    surface: &Surface,
    uvs: Option<&[f32]>,
    vertex_color: impl Fn(usize) -> [f32; 4],
    with_albedo: bool,
) {
    let factor = surface.factor;
    let mut averager = match (&surface.texture, uvs) {
        (Some((_, texture)), Some(uvs)) => {
            let averager = Averager::new(texture, surface.alpha, factor[3], mesh.faces.len());
            Some((averager, uvs))
        }
        _ => None,
    };
    let mut sums =
        vec![[0.0_f32; 4]; if averager.is_some() && with_albedo { mesh.positions.len() } else { 0 }];
    let mut faces = std::mem::take(&mut mesh.faces);
    for face in &mut faces {
        let corners = mesh.face_corners(face);
        let alphas = |i: usize| vertex_color(corners[i] as usize)[3];
        let opacity = match &mut averager {
            Some((averager, uvs)) if corners.len() == 3 => {
                let uv = |i: usize| {
                    let start = 2 * corners[i] as usize;
                    Vec2::new(uvs[start], uvs[start + 1])
                };
                let average = averager.triangle([uv(0), uv(1), uv(2)], [alphas(0), alphas(1), alphas(2)]);
                // Even what is clear has a colour, should all faces around a vertex be
                let weight = face_area(mesh, corners) * (average.opacity + 1e-3);
                for &corner in corners.iter().filter(|_| with_albedo) {
                    let sum = &mut sums[corner as usize];
                    (0..3).for_each(|i| sum[i] += average.rgb[i] * weight);
                    sum[3] += weight;
                }
                average.opacity
            }
            _ => {
                let mean = (0..corners.len()).map(alphas).sum::<f32>() / corners.len() as f32;
                coverage(surface.alpha, factor[3] * mean)
            }
        };
        face.opacity = opacity_byte(opacity);
    }
    mesh.faces = faces;
    if with_albedo {
        let texture = |vertex: usize| match sums.get(vertex) {
            Some(&[r, g, b, weight]) if weight > 0.0 => [r / weight, g / weight, b / weight],
            _ => [1.0; 3],
        };
        color(mesh, factor, texture, vertex_color);
    }
}

/// Gives vertices their albedo: factor, times texture, times their own colour.
fn color(
    mesh: &mut Mesh,
    factor: [f32; 4],
    texture: impl Fn(usize) -> [f32; 3],
    vertex_color: impl Fn(usize) -> [f32; 4],
) {
    let albedo = |vertex| {
        let (texture, own) = (texture(vertex), vertex_color(vertex));
        std::array::from_fn(|i| srgb::unit_byte(factor[i] * texture[i] * own[i]))
    };
    mesh.colors = (0..mesh.positions.len()).map(albedo).collect();
}

/// A weight in proportion to a triangle's area, which stays in single precision.
fn face_area(mesh: &Mesh, corners: &[u32]) -> f32 {
    let points: [DVec3; 3] = std::array::from_fn(|i| mesh.positions[corners[i] as usize]);
    polygon::area_normal(&points).length().clamp(1e-30, 1e30) as f32
}
