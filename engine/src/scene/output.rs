//! Outputs: what a shader computes at a point, by the names that attributes ask for.

use super::element::{Element, Value};
use super::{Result, ShOcclusion, Shader, ShaderKind};
use crate::stream::ValueType;

/// Some of the numbers that a shader computes at a point.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Output {
    /// Its name among the shader's outputs.
    pub name: String,
    /// Numbers.
    pub components: usize,
    /// How many numbers of the shader's come before it.
    pub first: usize,
}

impl ShaderKind {
    /// The type's name in scenes.
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::ShOcclusion(_) => "sh_occlusion",
        }
    }

    /// Everything that it computes at a point; the first is what an attribute holds that names none.
    pub fn outputs(&self) -> Vec<Output> {
        match self {
            Self::ShOcclusion(shader) => in_a_row(&[
                (ShOcclusion::COEFFICIENTS, (shader.bands * shader.bands) as usize),
                (ShOcclusion::AMBIENT_OCCLUSION, 1),
                (ShOcclusion::BENT_NORMAL, 3),
                (ShOcclusion::ERROR, 1),
            ]),
        }
    }

    /// How its numbers are stored: f32 or f16.
    pub fn storage(&self) -> ValueType {
        match self {
            Self::ShOcclusion(shader) => shader.storage,
        }
    }
}

/// Outputs of the given names and numbers of components, one after the other.
fn in_a_row(outputs: &[(&str, usize)]) -> Vec<Output> {
    let mut first = 0;
    let output = |&(name, components): &(&str, usize)| {
        first += components;
        Output { name: name.to_owned(), components, first: first - components }
    };
    outputs.iter().map(output).collect()
}

/// The output that `<attribute output="">` asks for, of the shader called `name`.
pub(super) fn asked_for(attribute: Element<'_>, shaders: &[Shader], name: &str) -> Result<String> {
    let outputs = shaders.iter().find(|shader| shader.name == name).map(|shader| shader.kind.outputs());
    let outputs = outputs.unwrap_or_default();
    let unknown = |value: &Value<'_>| value.unknown("output", outputs.iter().map(|output| &*output.name));
    match attribute.optional("output")? {
        Some(value) if outputs.iter().any(|output| output.name == value.text()) => {
            Ok(value.text().to_owned())
        }
        Some(value) => Err(unknown(&value)),
        None => Ok(outputs.first().map(|output| output.name.clone()).unwrap_or_default()),
    }
}
