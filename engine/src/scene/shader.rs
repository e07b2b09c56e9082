//! Shaders and their parameters.

use super::element::{Element, Value};
use super::names::Names;
use super::{Domain, ErrorKind, Result, ShOcclusion, Shader, ShaderKind, Weight};
use crate::stream::ValueType;

/// The types of shaders, and whether this version has them.
pub(super) const TYPES: [(&str, bool); 6] = [
    ("sh_occlusion", true),
    ("irradiance", false),
    ("area_light", false),
    ("reflection", false),
    ("displacement", false),
    ("custom", false),
];

/// The parameters of `sh_occlusion`.
pub(super) const SH_OCCLUSION: [&str; 6] = ["bands", "samples", "domain", "weight", "maxdistance", "storage"];

/// `<shader name="" type=""> <param name="" value=""/>... </shader>`
pub(super) fn shader<'d>(element: Element<'d>, names: &mut Names<'d>) -> Result<Shader> {
    element.expect_only(&["name", "type"], &["param"])?;
    let name = names.declare(&element.required("name")?)?;
    let kind = element.required("type")?;
    if !kind.choice("shader type", &TYPES)? {
        let message = format!("shaders of type `{}` are not supported yet", kind.text());
        return Err(kind.error(ErrorKind::Unsupported, message));
    }
    Ok(Shader { name, kind: ShaderKind::ShOcclusion(sh_occlusion(element)?) })
}

fn sh_occlusion(element: Element<'_>) -> Result<ShOcclusion> {
    let mut shader = ShOcclusion::default();
    let mut seen = Names::new("parameter");
    for param in element.children_named("param") {
        param.expect_only(&["name", "value"], &[])?;
        let name = param.required("name")?;
        seen.declare_once(&name)?;
        set(&mut shader, &name, &param.required("value")?)?;
    }
    Ok(shader)
}

fn set(shader: &mut ShOcclusion, name: &Value<'_>, value: &Value<'_>) -> Result<()> {
    match name.text() {
        "bands" => shader.bands = value.whole(1..=6)? as u32,
        "samples" => shader.samples = value.whole(16..=65_536)? as u32,
        "domain" => {
            let domains = [("hemisphere", Domain::Hemisphere), ("sphere", Domain::Sphere)];
            shader.domain = value.choice("domain", &domains)?;
        }
        "weight" => {
            let weights = [("uniform", Weight::Uniform), ("cosine", Weight::Cosine)];
            shader.weight = value.choice("weight", &weights)?;
        }
        "maxdistance" => {
            let positive = |distance| distance > 0.0 && distance <= 1e12;
            shader.max_distance = Some(value.real("a number more than 0 and at most 1e12", positive)?);
        }
        "storage" => {
            let types = [("f32", ValueType::F32), ("f16", ValueType::F16)];
            shader.storage = value.choice("storage", &types)?;
        }
        _ => return Err(name.unknown("parameter", SH_OCCLUSION)),
    }
    Ok(())
}
