//! PLY (Turk 1994): faces, or points with normals, radius and colour; text and binary of both orders.

mod body;
mod header;

use std::fs::File;
use std::path::Path;

use glam::{DVec3, Vec3};

use self::body::Body;
use self::header::{Element, Property, Scalar};
use super::large::Elements;
use super::mesh::{Face, Mesh};
use super::{GridSink, ImportOptions, ImportReport, emit, srgb};
use crate::{Error, ErrorKind, Result};

/// Corners of a polygon at most.
const POLYGON_MAX: u64 = 1 << 16;

/// A face of nothing in particular.
const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

/// Imports a PLY file.
pub(super) fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let mut report = ImportReport::default();
    let mut elements = Elements::new(path, options);
    read(path, &mut elements, &mut report)?;
    elements.emit(sink, &mut report)?;
    Ok(report)
}

fn read(path: &Path, elements: &mut Elements<'_>, report: &mut ImportReport) -> Result<()> {
    let mut file = File::open(path).map_err(|e| Error::io("open the file", path, e))?;
    let header = header::read(&mut file, path)?;
    let mut body = Body::open(file, &header, path)?;
    body.check(&header.elements, header.encoding)?;
    let count =
        |name: &str| header.elements.iter().find(|element| element.name == name).map_or(0, |e| e.count);
    let (vertices, faces, edges) = (count("vertex"), count("face"), count("edge"));
    if faces == 0 && count("tristrips") > 0 {
        return Err(Error::unsupported("triangle strips in PLY are not supported yet")
            .hint("convert them to faces with another program"));
    }
    let is_cloud = faces == 0 && edges == 0;
    if u32::try_from(vertices).is_err() {
        return Err(Error::new(
            ErrorKind::Limit,
            format!("{vertices} vertices, at most 4,294,967,295 are possible"),
        ));
    }
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" => read_vertices(&mut body, element, elements)?,
            "face" => read_faces(&mut body, element, vertices, elements, report)?,
            "edge" => read_edges(&mut body, element, vertices, elements, report)?,
            _ => body.skip(element)?,
        }
    }
    if is_cloud {
        for point in 0..vertices as u32 {
            elements.mesh.push_face(FACE, &[point], report)?;
            elements.relieve()?;
        }
    }
    report.source.vertices = vertices;
    Ok(())
}

/// What a property of a vertex means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    Position(usize),
    Normal(usize),
    Color(usize),
    Alpha,
    Radius,
    Diameter,
    Other,
}

impl Role {
    fn of(property: &Property) -> Self {
        if property.length.is_some() {
            return Self::Other;
        }
        match property.name.as_str() {
            "x" => Self::Position(0),
            "y" => Self::Position(1),
            "z" => Self::Position(2),
            "nx" | "normal_x" => Self::Normal(0),
            "ny" | "normal_y" => Self::Normal(1),
            "nz" | "normal_z" => Self::Normal(2),
            "red" | "r" | "diffuse_red" => Self::Color(0),
            "green" | "g" | "diffuse_green" => Self::Color(1),
            "blue" | "b" | "diffuse_blue" => Self::Color(2),
            "alpha" | "a" | "diffuse_alpha" => Self::Alpha,
            "radius" | "pscale" => Self::Radius,
            "width" | "diameter" => Self::Diameter,
            _ => Self::Other,
        }
    }
}

fn read_vertices(body: &mut Body, element: &Element, elements: &mut Elements<'_>) -> Result<()> {
    let roles: Vec<(&Property, Role)> = element.properties.iter().map(|p| (p, Role::of(p))).collect();
    let has = |role: Role| roles.iter().any(|&(_, known)| known == role);
    if let Some(axis) = (0..3).find(|&axis| !has(Role::Position(axis))) {
        return Err(Error::invalid(format!("vertices have no property `{}`", ["x", "y", "z"][axis])));
    }
    let normals = (0..3).all(|axis| has(Role::Normal(axis)));
    let colors = (0..3).all(|channel| has(Role::Color(channel)));
    let opacities = has(Role::Alpha);
    let radii = has(Role::Radius) || has(Role::Diameter);
    let single_precision = roles
        .iter()
        .all(|(property, role)| !matches!(role, Role::Position(_)) || property.scalar == Scalar::F32);
    elements.mesh.single_precision = single_precision;
    for _ in 0..element.count {
        body.begin_row()?;
        let (mut position, mut normal, mut color) = (DVec3::ZERO, Vec3::ZERO, [0; 3]);
        let (mut opacity, mut radius) = (255, 0.0);
        for &(property, role) in &roles {
            if let Some(length) = property.length {
                for _ in 0..body.length(length)? {
                    body.value(property.scalar)?;
                }
                continue;
            }
            let value = body.value(property.scalar)?;
            match role {
                // Text of a single precision file may hold more digits than the type it claims
                Role::Position(axis) if single_precision => position[axis] = f64::from(value as f32),
                Role::Position(axis) => position[axis] = value,
                Role::Normal(axis) => normal[axis] = value as f32,
                Role::Color(channel) => color[channel] = color_byte(value, property.scalar),
                Role::Alpha => {
                    let most = property.scalar.integer_max().unwrap_or(1.0);
                    opacity = emit::opacity_byte((value / most) as f32);
                }
                Role::Radius => radius = value as f32,
                Role::Diameter => radius = 0.5 * value as f32,
                Role::Other => {}
            }
        }
        let mesh: &mut Mesh = &mut elements.mesh;
        mesh.positions.push(position);
        if normals {
            mesh.normals.push(normal);
        }
        if colors {
            mesh.colors.push(color);
        }
        if opacities {
            mesh.opacities.push(opacity);
        }
        if radii {
            mesh.radii.push(radius);
        }
        elements.relieve()?;
    }
    Ok(())
}

/// Linear albedo of a colour: integers are sRGB of their type's full range, as scanners and modellers write them;
/// floating point is linear already.
fn color_byte(value: f64, scalar: Scalar) -> u8 {
    match scalar.integer_max() {
        Some(most) => srgb::unit_byte(srgb::decode(value / most) as f32),
        None => srgb::unit_byte(value as f32),
    }
}

fn read_faces(
    body: &mut Body,
    element: &Element,
    vertices: u64,
    elements: &mut Elements<'_>,
    report: &mut ImportReport,
) -> Result<()> {
    let is_indices = |p: &Property| {
        p.length.is_some() && ["vertex_indices", "vertex_index", "vertex_list"].contains(&p.name.as_str())
    };
    if element.count > 0 && !element.properties.iter().any(is_indices) {
        return Err(Error::invalid("faces have no list `vertex_indices`"));
    }
    let mut corners = Vec::new();
    for _ in 0..element.count {
        body.begin_row()?;
        for property in &element.properties {
            let length = property.length.map_or(Ok(1), |length| body.length(length))?;
            if !is_indices(property) {
                for _ in 0..length {
                    body.value(property.scalar)?;
                }
                continue;
            }
            if length > POLYGON_MAX {
                let message = format!("a polygon of {length} corners, at most {POLYGON_MAX} are possible");
                return Err(body.error(ErrorKind::Limit, message));
            }
            corners.clear();
            for _ in 0..length {
                corners.push(index(body, property.scalar, vertices)?);
            }
        }
        match corners.len() {
            0..3 => report.skip("faces of fewer than three corners", 1),
            _ => elements.mesh.push_face(FACE, &corners, report)?,
        }
        elements.relieve()?;
    }
    Ok(())
}

fn read_edges(
    body: &mut Body,
    element: &Element,
    vertices: u64,
    elements: &mut Elements<'_>,
    report: &mut ImportReport,
) -> Result<()> {
    let find = |name: &str| element.properties.iter().position(|p| p.name == name && p.length.is_none());
    let (Some(first), Some(second)) = (find("vertex1"), find("vertex2")) else {
        report.skip("edges without `vertex1` and `vertex2`", element.count);
        return body.skip(element);
    };
    for _ in 0..element.count {
        body.begin_row()?;
        let mut ends = [0; 2];
        for (i, property) in element.properties.iter().enumerate() {
            if i == first || i == second {
                ends[usize::from(i == second)] = index(body, property.scalar, vertices)?;
                continue;
            }
            let length = property.length.map_or(Ok(1), |length| body.length(length))?;
            for _ in 0..length {
                body.value(property.scalar)?;
            }
        }
        elements.mesh.push_face(FACE, &ends, report)?;
        elements.relieve()?;
    }
    Ok(())
}

/// Reads a vertex index and checks it.
fn index(body: &mut Body, scalar: Scalar, vertices: u64) -> Result<u32> {
    let value = body.value(scalar)?;
    if !(value >= 0.0 && value < vertices as f64 && value.fract() == 0.0) {
        let message = format!("vertex `{value}` of {vertices} vertices, which count from 0");
        return Err(body.error(ErrorKind::Invalid, message));
    }
    Ok(value as u32)
}
