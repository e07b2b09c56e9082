//! Primvars: which a prim has, and their values per mesh, face, point or corner.

use std::rc::Rc;

use super::read::Stage;
use super::value;

/// A primvar of a prim, by what it is called and where it is written.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Primvar {
    /// Its name, without `primvars:`.
    pub name: String,
    /// The prim that has it: an ancestor's constant primvars are its descendants' too.
    pub prim: String,
    /// Numbers of a value.
    pub components: usize,
}

/// What a value belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Interpolation {
    /// The prim.
    Constant,
    /// A face, or a curve.
    Uniform,
    /// A point; between points linear.
    Varying,
    /// A point; between points as the surface.
    Vertex,
    /// A face's corner.
    FaceVarying,
}

/// Values of a primvar, each `components` numbers.
#[derive(Clone, Debug)]
pub(super) struct Values {
    /// What a value belongs to.
    pub interpolation: Interpolation,
    /// Numbers of a value.
    pub components: usize,
    /// The distinct values, or simply all.
    pub values: Vec<f32>,
    /// For each element its value; none where they stand in order.
    pub indices: Option<Vec<u32>>,
}

impl Values {
    /// How many elements have a value.
    pub fn len(&self) -> usize {
        self.indices.as_ref().map_or(self.values.len() / self.components, Vec::len)
    }

    /// The value of an element; one that is not there is none.
    pub fn get(&self, element: usize) -> Option<&[f32]> {
        let row = match &self.indices {
            Some(indices) => *indices.get(element)? as usize,
            None => element,
        };
        self.values.get(row * self.components..(row + 1) * self.components)
    }

    /// The values of the first `count` elements in order, zero where there is none.
    pub fn expand(&self, count: usize) -> Vec<f32> {
        let mut values = Vec::with_capacity(count * self.components);
        for element in 0..count {
            match self.get(element) {
                Some(value) => values.extend_from_slice(value),
                None => values.resize(values.len() + self.components, 0.0),
            }
        }
        values
    }
}

/// The primvars that a prim writes itself.
fn own(stage: &Stage, prim: &str) -> Vec<Primvar> {
    let names = stage.stage.prim(prim).property_names().unwrap_or_default();
    let names = names.iter().filter_map(|name| name.as_str().strip_prefix("primvars:"));
    names
        .filter(|name| !name.ends_with(":indices"))
        .filter_map(|name| {
            let attribute = stage.stage.attribute(format!("{prim}.primvars:{name}"));
            let type_name = attribute.type_name().ok().flatten()?;
            let size = stage.field(prim, &format!("primvars:{name}"), "elementSize");
            let size = size.and_then(|value| value::numbers(&value)).map_or(1.0, |numbers| numbers[0]);
            let size = if (1.0..=4096.0).contains(&size) { size as usize } else { 1 };
            let components = value::components(type_name.as_str())? * size;
            Some(Primvar { name: name.into(), prim: prim.into(), components })
        })
        .collect()
}

/// All primvars of a prim: its own before inherited ones.
pub(super) fn of_prim(stage: &Stage, prim: &str, inherited: &[Primvar]) -> Vec<Primvar> {
    let mut primvars = own(stage, prim);
    for above in inherited {
        if !primvars.iter().any(|own| own.name == above.name) {
            primvars.push(above.clone());
        }
    }
    primvars
}

/// What the descendants of a prim inherit: its constant primvars, and what it inherits itself.
pub(super) fn inherit(stage: &Stage, prim: &str, inherited: &Rc<Vec<Primvar>>) -> Rc<Vec<Primvar>> {
    let mut own = own(stage, prim);
    own.retain(|primvar| interpolation(stage, primvar) == Interpolation::Constant);
    if own.is_empty() {
        return inherited.clone();
    }
    let above = inherited.iter().filter(|above| !own.iter().any(|own| own.name == above.name)).cloned();
    let above: Vec<_> = above.collect();
    own.extend(above);
    Rc::new(own)
}

fn interpolation(stage: &Stage, primvar: &Primvar) -> Interpolation {
    let value = stage.field(&primvar.prim, &format!("primvars:{}", primvar.name), "interpolation");
    value.and_then(|value| parse(&value::text(&value)?)).unwrap_or(Interpolation::Constant)
}

/// An interpolation by its token.
pub(super) fn parse(token: &str) -> Option<Interpolation> {
    Some(match token {
        "constant" => Interpolation::Constant,
        "uniform" => Interpolation::Uniform,
        "varying" => Interpolation::Varying,
        "vertex" => Interpolation::Vertex,
        "faceVarying" => Interpolation::FaceVarying,
        _ => return None,
    })
}

/// Reads a primvar. None when it has no value, or its indices are out of range.
pub(super) fn read(stage: &Stage, primvar: &Primvar) -> Option<Values> {
    let attribute = format!("primvars:{}", primvar.name);
    let values: Vec<f32> = stage.numbers(&primvar.prim, &attribute)?.iter().map(|&x| x as f32).collect();
    let components = primvar.components;
    let rows = (values.len() / components) as i64;
    let indices = match stage.integers(&primvar.prim, &format!("{attribute}:indices")) {
        Some(indices) if indices.iter().all(|index| (0..rows).contains(index)) => {
            Some(indices.iter().map(|&index| index as u32).collect())
        }
        Some(_) => return None,
        None => None,
    };
    let found = Values { interpolation: interpolation(stage, primvar), components, values, indices };
    (found.len() > 0 && found.values.len().is_multiple_of(components)).then_some(found)
}
