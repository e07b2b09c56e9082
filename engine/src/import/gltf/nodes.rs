//! The node hierarchy: where each mesh stands, in double precision.

use std::collections::BTreeMap;

use glam::{DMat4, DQuat, DVec3, DVec4};

use super::container::{Container, missing};
use super::document::Node;
use crate::import::emit::Placement;
use crate::import::{ImportOptions, ImportReport};
use crate::stream::schema::UpAxis;
use crate::{Error, ErrorKind, Result};

/// Depth of the hierarchy at most; rigs reach some hundred.
const DEPTH_MAX: usize = 1024;

const INSTANCING: &str = "EXT_mesh_gpu_instancing";

/// The copies of every mesh that the scene shows, by mesh: a number for each copy, and where it stands.
pub(super) type Copies = BTreeMap<usize, Vec<(u32, Placement)>>;

/// Walks the document's scene.
pub(super) fn copies(
    container: &mut Container,
    options: &ImportOptions,
    report: &mut ImportReport,
) -> Result<Copies> {
    let mut copies = Copies::new();
    let mut next_id = 0;
    let nodes = container.document.nodes.len();
    let mut seen = vec![false; nodes];
    let mut stack: Vec<(usize, usize, DMat4)> = Vec::new();
    let world = world_from_gltf(options);
    stack.extend(roots(container, report)?.into_iter().rev().map(|node| (node, 0, world)));
    while let Some((index, depth, world_from_parent)) = stack.pop() {
        let node = container.document.nodes.get(index).ok_or_else(|| missing("node", index, nodes))?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(Error::invalid(format!("node {index} is reached twice: the nodes are not a tree"))
                .hint("a node may have one parent; copies are made by nodes that share a mesh"));
        }
        if depth > DEPTH_MAX {
            return Err(Error::new(ErrorKind::Limit, format!("nodes nested more than {DEPTH_MAX} deep")));
        }
        if is_hidden(node) {
            report.skip("nodes that are hidden, with what is below them", 1);
            continue;
        }
        let world_from_node = world_from_parent * local(node, index)?;
        stack.extend(node.children.iter().rev().map(|&child| (child, depth + 1, world_from_node)));
        let Some(mesh) = node.mesh else { continue };
        if node.skin.is_some() {
            report.warn("skins are not applied: meshes stand as modelled".into());
        }
        let instances = match node.extensions.get(INSTANCING) {
            Some(extension) => instances(container, index, &extension.clone())?,
            None => vec![DMat4::IDENTITY],
        };
        let bytes = instances.len() as u64 * (size_of::<Placement>() as u64 + 8);
        container.budget.take(bytes, "the instances")?;
        let list = copies.entry(mesh).or_default();
        for node_from_copy in instances {
            match Placement::new(world_from_node * node_from_copy) {
                Some(placement) => list.push((next_id, placement)),
                None => report.skip("copies whose transform is flat or not finite", 1),
            }
            next_id += 1;
        }
    }
    Ok(copies)
}

/// World from glTF's metres with +y up.
fn world_from_gltf(options: &ImportOptions) -> DMat4 {
    let scale = 1.0 / options.meters_per_unit;
    let axes = match options.up {
        UpAxis::Y => [DVec3::X, DVec3::Y, DVec3::Z],
        UpAxis::Z => [DVec3::X, DVec3::Z, DVec3::NEG_Y],
    };
    let [x, y, z] = axes.map(|axis| (axis * scale).extend(0.0));
    DMat4::from_cols(x, y, z, DVec4::W)
}

/// The nodes that the scene begins with. A document without scenes shows every node that has no parent.
fn roots(container: &Container, report: &mut ImportReport) -> Result<Vec<usize>> {
    let document = &container.document;
    if let Some(scene) = document.scene.or((!document.scenes.is_empty()).then_some(0)) {
        let found =
            document.scenes.get(scene).ok_or_else(|| missing("scene", scene, document.scenes.len()))?;
        return Ok(found.nodes.clone());
    }
    let mut is_child = vec![false; document.nodes.len()];
    for &child in document.nodes.iter().flat_map(|node| &node.children) {
        if let Some(flag) = is_child.get_mut(child) {
            *flag = true;
        }
    }
    if !is_child.is_empty() {
        report.warn("the document has no scene: all its nodes are shown".into());
    }
    Ok((0..is_child.len()).filter(|&node| !is_child[node]).collect())
}

/// Whether `KHR_node_visibility` hides a node.
fn is_hidden(node: &Node) -> bool {
    let visible = node.extensions.get("KHR_node_visibility").and_then(|value| value.get("visible"));
    visible.and_then(serde_json::Value::as_bool) == Some(false)
}

/// Parent from node.
fn local(node: &Node, index: usize) -> Result<DMat4> {
    let has_parts = node.translation.is_some() || node.rotation.is_some() || node.scale.is_some();
    if let Some(matrix) = &node.matrix {
        if has_parts {
            return Err(Error::invalid(format!("node {index} has both a matrix and its parts")));
        }
        let matrix = DMat4::from_cols_array(matrix);
        if matrix.row(3) != DVec4::W {
            return Err(Error::invalid(format!("node {index} has a matrix whose last row is not 0 0 0 1")));
        }
        return Ok(matrix);
    }
    if !has_parts {
        return Ok(DMat4::IDENTITY);
    }
    let rotation = match node.rotation {
        Some(rotation) => unit_rotation(rotation)
            .ok_or_else(|| Error::invalid(format!("node {index} has a rotation that is no rotation")))?,
        None => DQuat::IDENTITY,
    };
    let scale = node.scale.map_or(DVec3::ONE, DVec3::from);
    let translation = node.translation.map_or(DVec3::ZERO, DVec3::from);
    Ok(DMat4::from_scale_rotation_translation(scale, rotation, translation))
}

/// A quaternion of unit length; none where there is no direction at all.
fn unit_rotation(rotation: [f64; 4]) -> Option<DQuat> {
    let length = DVec4::from(rotation).length();
    (length.is_finite() && length > 1e-6).then(|| DQuat::from_array(rotation.map(|value| value / length)))
}

/// The matrices of `EXT_mesh_gpu_instancing`: node from copy.
fn instances(container: &mut Container, node: usize, extension: &serde_json::Value) -> Result<Vec<DMat4>> {
    let wrong = |what: &str| Error::invalid(format!("node {node}: {INSTANCING} {what}"));
    let attributes = extension.get("attributes").and_then(|value| value.as_object());
    let attributes = attributes.ok_or_else(|| wrong("has no attributes"))?;
    let mut read = |name: &str, components: usize| -> Result<Option<Vec<f32>>> {
        let Some(accessor) = attributes.get(name) else { return Ok(None) };
        let accessor = accessor.as_u64().and_then(|index| usize::try_from(index).ok());
        let accessor = accessor.ok_or_else(|| wrong("names something that is not an accessor"))?;
        Ok(Some(container.floats(accessor, &[components])?.0))
    };
    let parts = [(read("TRANSLATION", 3)?, 3), (read("ROTATION", 4)?, 4), (read("SCALE", 3)?, 3)];
    let counts: Vec<usize> =
        parts.iter().filter_map(|(part, n)| part.as_ref().map(|part| part.len() / n)).collect();
    let count = *counts.first().ok_or_else(|| wrong("has no translation, rotation or scale"))?;
    if counts.iter().any(|&other| other != count) {
        return Err(wrong("has attributes of different lengths"));
    }
    container.budget.take((count * size_of::<DMat4>()) as u64, "the instances")?;
    let [(translations, _), (rotations, _), (scales, _)] = &parts;
    let three = |values: &Option<Vec<f32>>, i: usize, default: DVec3| match values {
        Some(values) => DVec3::from_array(std::array::from_fn(|k| f64::from(values[3 * i + k]))),
        None => default,
    };
    let matrices = (0..count)
        .map(|i| {
            let rotation =
                rotations.as_ref().map(|values| std::array::from_fn(|k| f64::from(values[4 * i + k])));
            // A rotation of no direction makes the copy's matrix not finite, and so a counted skip
            let rotation = rotation.map_or(DQuat::IDENTITY, |r| unit_rotation(r).unwrap_or(DQuat::NAN));
            let (scale, translation) = (three(scales, i, DVec3::ONE), three(translations, i, DVec3::ZERO));
            let [x, y, z] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| rotation * axis);
            DMat4::from_cols(
                (x * scale.x).extend(0.0),
                (y * scale.y).extend(0.0),
                (z * scale.z).extend(0.0),
                translation.extend(1.0),
            )
        })
        .collect();
    container.budget.give((count * size_of::<DMat4>()) as u64);
    for part in parts.into_iter().filter_map(|(part, _)| part) {
        container.release(part);
    }
    Ok(matrices)
}
