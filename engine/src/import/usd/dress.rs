//! Primvars onto a mesh: `displayColor` to albedo, `displayOpacity` to opacity, the rest to attributes of their names.

use std::collections::HashMap;

use super::primvar::{self, Interpolation, Primvar, Values};
use super::read::Stage;
use super::walk::Prim;
use crate::import::emit::opacity_byte;
use crate::import::mesh::{Extra, ExtraRate, Mesh};
use crate::import::{ImportReport, srgb};
use crate::stream::schema::names;
use crate::stream::{Attribute, ValueType};

/// Primvars that become attributes at most; the engine's own and what a bake adds need room too.
const EXTRAS_MAX: usize = 40;

/// Primvars with a meaning of their own.
const KNOWN: [&str; 4] = ["displayColor", "displayOpacity", "normals", "widths"];

/// Names of attributes that a primvar cannot take.
const TAKEN: [&str; 10] = [
    "P",
    names::NORMAL,
    names::RADIUS,
    names::OPACITY,
    names::ALBEDO,
    names::RADIANCE,
    names::ID,
    names::INSTANCE,
    names::BAKED,
    names::POINT,
];

/// The attributes that the primvars of all prims become, by name.
pub(super) fn attributes(prims: &[Prim], report: &mut ImportReport) -> Vec<Attribute> {
    let mut found: Vec<Attribute> = Vec::new();
    for primvar in prims.iter().flat_map(|prim| &prim.primvars) {
        let name = primvar.name.as_str();
        if KNOWN.contains(&name) {
            continue;
        }
        let legal = |c: char| c.is_ascii_alphanumeric() || "_.:-".contains(c);
        let fits = name.len() <= 64 && name.chars().all(legal) && primvar.components <= 256;
        if !fits || TAKEN.contains(&name) {
            report.skip("primvars whose name is taken or too long, or whose values are too large", 1);
            continue;
        }
        match found.binary_search_by(|known| known.name.as_str().cmp(name)) {
            Ok(at) if usize::from(found[at].components) == primvar.components => {}
            Ok(_) => report.skip("primvars that another prim has in another size", 1),
            Err(_) if found.len() == EXTRAS_MAX => report.skip("primvars beyond the first 40 names", 1),
            Err(at) => {
                found.insert(at, Attribute::vertex(name, ValueType::F32, primvar.components as u16));
            }
        }
    }
    found
}

/// The elements of a prim as its primvars count them, and the mesh's as the prim's.
pub(super) struct Elements<'a> {
    /// Faces of the prim.
    pub faces: usize,
    /// Points of the prim.
    pub points: usize,
    /// Corners of all faces of the prim.
    pub corners: usize,
    /// Per corner of the mesh the face and the corner of the prim; empty where no face has an area.
    pub corner_sources: &'a [(u32, u32)],
}

impl Elements<'_> {
    fn count(&self, interpolation: Interpolation) -> usize {
        match interpolation {
            Interpolation::Constant => 1,
            Interpolation::Uniform => self.faces,
            Interpolation::Varying | Interpolation::Vertex => self.points,
            Interpolation::FaceVarying => self.corners,
        }
    }
}

/// Gives a mesh its colours, opacities and further attributes.
pub(super) fn dress(
    stage: &Stage,
    prim: &Prim,
    attributes: &[Attribute],
    elements: &Elements<'_>,
    // Brings values to the mesh's own points where those are not the prim's
    resample: &dyn Fn(Values) -> Option<Values>,
    mesh: &mut Mesh,
    report: &mut ImportReport,
) {
    let mut read = |name: &str, components: usize| -> Option<Values> {
        let found: &Primvar = prim.primvars.iter().find(|primvar| primvar.name == name)?;
        if found.components != components {
            return None;
        }
        let values = primvar::read(stage, found).and_then(resample);
        let fits = |values: &Values| values.len() >= elements.count(values.interpolation);
        if !values.as_ref().is_some_and(fits) {
            report.skip("primvars without a value for every element", 1);
            return None;
        }
        values
    };
    let (color, opacity) = (read("displayColor", 3), read("displayOpacity", 1));
    let extras: Vec<Option<Values>> =
        attributes.iter().map(|attribute| read(&attribute.name, usize::from(attribute.components))).collect();

    // Number what differs between the corners of a point
    let all = || color.iter().chain(&opacity).chain(extras.iter().flatten());
    let split: Vec<&Values> = all()
        .filter(|values| matches!(values.interpolation, Interpolation::Uniform | Interpolation::FaceVarying))
        .collect();
    let firsts = if elements.corner_sources.is_empty() { Vec::new() } else { number(&split, elements, mesh) };

    let byte = |value: &[f32]| opacity_byte(value[0]);
    let rgb = |value: &[f32]| [value[0], value[1], value[2]].map(srgb::unit_byte);
    let extra = |values: &Values| as_extra(values, elements, &firsts);
    if let Some(Extra { rate, values, .. }) = color.as_ref().map(extra) {
        let colors = values.chunks_exact(3).map(rgb).collect();
        match rate {
            ExtraRate::Constant => mesh.palette = colors,
            ExtraRate::Position => mesh.colors = colors,
            ExtraRate::Variant => mesh.variant_colors = colors,
        }
    }
    if let Some(Extra { rate, values, .. }) = opacity.as_ref().map(extra) {
        let opacities: Vec<u8> = values.chunks_exact(1).map(byte).collect();
        match rate {
            ExtraRate::Constant => mesh.faces.iter_mut().for_each(|face| face.opacity = opacities[0]),
            ExtraRate::Position => mesh.opacities = opacities,
            ExtraRate::Variant => mesh.variant_opacities = opacities,
        }
    }
    mesh.extras = extras.iter().map(|values| values.as_ref().map(extra).unwrap_or_default()).collect();
}

/// Values as the mesh holds them; `firsts` has a corner of the mesh for each variant.
fn as_extra(values: &Values, elements: &Elements<'_>, firsts: &[u32]) -> Extra {
    let components = values.components;
    let (rate, values) = match values.interpolation {
        Interpolation::Constant => (ExtraRate::Constant, values.expand(1)),
        Interpolation::Varying | Interpolation::Vertex => {
            (ExtraRate::Position, values.expand(elements.points))
        }
        Interpolation::Uniform | Interpolation::FaceVarying => {
            let mut rows = Vec::with_capacity(firsts.len() * components);
            for &corner in firsts {
                let element = element(values.interpolation, elements.corner_sources[corner as usize]);
                match values.get(element) {
                    Some(value) => rows.extend_from_slice(value),
                    None => rows.resize(rows.len() + components, 0.0),
                }
            }
            (ExtraRate::Variant, rows)
        }
    };
    Extra { components, rate, values }
}

fn element(interpolation: Interpolation, (face, corner): (u32, u32)) -> usize {
    match interpolation {
        Interpolation::Uniform => face as usize,
        _ => corner as usize,
    }
}

/// Numbers the mesh's corners so that equal numbers mean equal values of all primvars in `split`. Returns a corner for
/// each number.
fn number(split: &[&Values], elements: &Elements<'_>, mesh: &mut Mesh) -> Vec<u32> {
    if split.is_empty() {
        return Vec::new();
    }
    let mut variants = vec![0_u32; elements.corner_sources.len()];
    let mut firsts = Vec::new();
    for values in split {
        let rows = distinct(values);
        let mut known: HashMap<(u32, u32), u32> = HashMap::new();
        firsts.clear();
        for (corner, variant) in variants.iter_mut().enumerate() {
            let element = element(values.interpolation, elements.corner_sources[corner]);
            let row = values.indices.as_ref().map_or(element, |indices| indices[element] as usize);
            let next = known.len() as u32;
            *variant = *known.entry((*variant, rows[row])).or_insert_with(|| {
                firsts.push(corner as u32);
                next
            });
        }
    }
    mesh.corner_variants = variants;
    firsts
}

/// For each value the first one that is equal to it.
fn distinct(values: &Values) -> Vec<u32> {
    let bits: &[u32] = bytemuck::cast_slice(&values.values);
    let mut known: HashMap<&[u32], u32> = HashMap::new();
    let rows = bits.chunks_exact(values.components).enumerate();
    rows.map(|(row, value)| *known.entry(value).or_insert(row as u32)).collect()
}
