//! Checks a document before anything is loaded: every reference leads somewhere, every range lies inside its parent.

use super::accessor::fault;
use super::container::missing;
use super::document::{Accessor, Document, Mesh, Primitive};
use crate::{Error, Result};

/// Checks what the import relies on.
pub(super) fn check(document: &Document) -> Result<()> {
    check_buffers(document)?;
    document
        .accessors
        .iter()
        .enumerate()
        .try_for_each(|(i, accessor)| check_accessor(document, i, accessor))?;
    document.meshes.iter().enumerate().try_for_each(|(i, mesh)| check_mesh(document, i, mesh))?;
    check_materials(document)?;
    check_nodes(document)
}

fn within(what: &str, index: Option<usize>, count: usize) -> Result<()> {
    match index {
        Some(index) if index >= count => Err(missing(what, index, count)),
        _ => Ok(()),
    }
}

fn check_buffers(document: &Document) -> Result<()> {
    for (i, buffer) in document.buffers.iter().enumerate() {
        if buffer.byte_length == 0 {
            return Err(Error::invalid(format!("buffer {i} has no bytes")));
        }
    }
    for (i, view) in document.buffer_views.iter().enumerate() {
        within("buffer", Some(view.buffer), document.buffers.len())?;
        let length = document.buffers[view.buffer].byte_length;
        let fits = view.byte_offset.checked_add(view.byte_length).is_some_and(|end| end <= length);
        if !fits || view.byte_length == 0 {
            return Err(Error::invalid(format!(
                "buffer view {i} has {} bytes from byte {}, buffer {} has {length}",
                view.byte_length, view.byte_offset, view.buffer
            )));
        }
        if let Some(stride) = view.byte_stride
            && !((4..=252).contains(&stride) && stride.is_multiple_of(4))
        {
            return Err(Error::invalid(format!(
                "buffer view {i} has a stride of {stride} bytes, multiples of 4 from 4 to 252 are possible"
            )));
        }
    }
    Ok(())
}

fn check_accessor(document: &Document, index: usize, accessor: &Accessor) -> Result<()> {
    let views = &document.buffer_views;
    within("buffer view", accessor.buffer_view, views.len())?;
    let view = accessor.buffer_view.map(|view| (views[view].byte_length, views[view].byte_stride));
    if let Some(fault) = fault(accessor, view) {
        return Err(Error::invalid(format!("accessor {index} {fault}")));
    }
    if let Some(sparse) = &accessor.sparse {
        within("buffer view", Some(sparse.indices.buffer_view), views.len())?;
        within("buffer view", Some(sparse.values.buffer_view), views.len())?;
        if sparse.count == 0 || sparse.count > accessor.count {
            return Err(Error::invalid(format!(
                "accessor {index} replaces {} of {} elements",
                sparse.count, accessor.count
            )));
        }
    }
    Ok(())
}

fn check_mesh(document: &Document, index: usize, mesh: &Mesh) -> Result<()> {
    for (i, primitive) in mesh.primitives.iter().enumerate() {
        if let Some(fault) = primitive_fault(document, primitive) {
            return Err(Error::invalid(format!("mesh {index}, primitive {i}: {fault}")));
        }
    }
    Ok(())
}

/// Says what is wrong with a primitive, by its references alone.
fn primitive_fault(document: &Document, primitive: &Primitive) -> Option<String> {
    let accessors = &document.accessors;
    let unknown = |index: usize| Some(missing("accessor", index, accessors.len()).message().to_string());
    let mut vertices = None;
    for (name, &index) in &primitive.attributes {
        let Some(accessor) = accessors.get(index) else { return unknown(index) };
        let expected = match name.as_str() {
            "POSITION" | "NORMAL" => ["VEC3", "VEC3"],
            "COLOR_0" => ["VEC3", "VEC4"],
            _ if name.starts_with("TEXCOORD_") => ["VEC2", "VEC2"],
            _ => continue,
        };
        if !expected.contains(&accessor.shape.as_str()) {
            return Some(format!("`{name}` has the type `{}`", accessor.shape.escape_debug()));
        }
        if *vertices.get_or_insert(accessor.count) != accessor.count {
            return Some(format!("`{name}` has {} elements, others have another number", accessor.count));
        }
    }
    if let Some(index) = primitive.indices {
        let Some(accessor) = accessors.get(index) else { return unknown(index) };
        let is_unsigned = [5121, 5123, 5125].contains(&accessor.component_type);
        if accessor.shape != "SCALAR" || !is_unsigned {
            return Some(format!("the indices, accessor {index}, are not unsigned integers"));
        }
    }
    let materials = document.materials.len();
    if let Some(material) = primitive.material.filter(|&material| material >= materials) {
        return Some(missing("material", material, materials).message().to_string());
    }
    primitive.mode.filter(|&mode| mode > 6).map(|mode| format!("mode `{mode}`, 0 to 6 are possible"))
}

fn check_materials(document: &Document) -> Result<()> {
    for material in &document.materials {
        let texture = material.base().base_color_texture.map(|info| info.index);
        within("texture", texture, document.textures.len())?;
    }
    for texture in &document.textures {
        within("image", texture.source, document.images.len())?;
        within("sampler", texture.sampler, document.samplers.len())?;
    }
    let views = document.buffer_views.len();
    document.images.iter().try_for_each(|image| within("buffer view", image.buffer_view, views))
}

/// Every node has one parent at most, and none is its own ancestor.
fn check_nodes(document: &Document) -> Result<()> {
    let nodes = document.nodes.len();
    let mut parents = vec![usize::MAX; nodes];
    for (index, node) in document.nodes.iter().enumerate() {
        within("mesh", node.mesh, document.meshes.len())?;
        for &child in &node.children {
            within("node", Some(child), nodes)?;
            if std::mem::replace(&mut parents[child], index) != usize::MAX {
                return Err(Error::invalid(format!(
                    "node {child} is reached twice: the nodes are not a tree"
                ))
                .hint("a node may have one parent; copies are made by nodes that share a mesh"));
            }
        }
    }
    // With one parent each, nodes that no root reaches form cycles: take away what hangs from roots, see what is left
    let mut reached: Vec<usize> = (0..nodes).filter(|&node| parents[node] == usize::MAX).collect();
    let mut at = 0;
    while let Some(&node) = reached.get(at) {
        reached.extend(&document.nodes[node].children);
        at += 1;
    }
    if reached.len() < nodes {
        return Err(Error::invalid("a node is its own ancestor: the nodes are not a tree"));
    }
    within("scene", document.scene, document.scenes.len())?;
    document
        .scenes
        .iter()
        .flat_map(|scene| &scene.nodes)
        .try_for_each(|&node| within("node", Some(node), nodes))
}
