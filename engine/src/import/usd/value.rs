//! Values of USD as numbers: arrays of any precision, matrices, tokens.

use glam::{DMat4, DQuat, DVec3};
use openusd::sdf::Value;

/// The numbers of a scalar, a tuple or an array of either, one after the other; none for anything else.
pub(super) fn numbers(value: &Value) -> Option<Vec<f64>> {
    let from_f32 = |values: &[f32]| values.iter().map(|&x| f64::from(x)).collect();
    Some(match value {
        Value::Half(x) => vec![f64::from(x.to_f32())],
        Value::Float(x) => vec![f64::from(*x)],
        Value::Double(x) => vec![*x],
        Value::Int(x) => vec![f64::from(*x)],
        Value::Uint(x) => vec![f64::from(*x)],
        Value::Uchar(x) => vec![f64::from(*x)],
        Value::Bool(x) => vec![f64::from(u8::from(*x))],
        Value::Int64(x) => vec![*x as f64],
        Value::Uint64(x) => vec![*x as f64],
        Value::Vec2h(x) => [x.x, x.y].map(|x| f64::from(x.to_f32())).to_vec(),
        Value::Vec3h(x) => [x.x, x.y, x.z].map(|x| f64::from(x.to_f32())).to_vec(),
        Value::Vec4h(x) => [x.x, x.y, x.z, x.w].map(|x| f64::from(x.to_f32())).to_vec(),
        Value::Vec2f(x) => [x.x, x.y].map(f64::from).to_vec(),
        Value::Vec3f(x) => [x.x, x.y, x.z].map(f64::from).to_vec(),
        Value::Vec4f(x) => [x.x, x.y, x.z, x.w].map(f64::from).to_vec(),
        Value::Vec2d(x) => vec![x.x, x.y],
        Value::Vec3d(x) => vec![x.x, x.y, x.z],
        Value::Vec4d(x) => vec![x.x, x.y, x.z, x.w],
        Value::Vec2i(x) => [x.x, x.y].map(f64::from).to_vec(),
        Value::Vec3i(x) => [x.x, x.y, x.z].map(f64::from).to_vec(),
        Value::Vec4i(x) => [x.x, x.y, x.z, x.w].map(f64::from).to_vec(),
        Value::HalfVec(values) => values.iter().map(|x| f64::from(x.to_f32())).collect(),
        Value::FloatVec(values) => from_f32(values),
        Value::DoubleVec(values) => values.clone(),
        Value::IntVec(values) => values.iter().map(|&x| f64::from(x)).collect(),
        Value::UintVec(values) => values.iter().map(|&x| f64::from(x)).collect(),
        Value::UcharVec(values) => values.iter().map(|&x| f64::from(x)).collect(),
        Value::BoolVec(values) => values.iter().map(|&x| f64::from(u8::from(x))).collect(),
        Value::Int64Vec(values) => values.iter().map(|&x| x as f64).collect(),
        Value::Uint64Vec(values) => values.iter().map(|&x| x as f64).collect(),
        Value::Vec2hVec(values) => {
            values.iter().flat_map(|x| [x.x, x.y].map(|x| f64::from(x.to_f32()))).collect()
        }
        Value::Vec3hVec(values) => {
            values.iter().flat_map(|x| [x.x, x.y, x.z].map(|x| f64::from(x.to_f32()))).collect()
        }
        Value::Vec4hVec(values) => {
            values.iter().flat_map(|x| [x.x, x.y, x.z, x.w].map(|x| f64::from(x.to_f32()))).collect()
        }
        Value::Vec2fVec(values) => from_f32(bytemuck::cast_slice(values)),
        Value::Vec3fVec(values) => from_f32(bytemuck::cast_slice(values)),
        Value::Vec4fVec(values) => from_f32(bytemuck::cast_slice(values)),
        Value::Vec2dVec(values) => bytemuck::cast_slice(values).to_vec(),
        Value::Vec3dVec(values) => bytemuck::cast_slice(values).to_vec(),
        Value::Vec4dVec(values) => bytemuck::cast_slice(values).to_vec(),
        Value::Vec2iVec(values) => values.iter().flat_map(|x| [x.x, x.y].map(f64::from)).collect(),
        Value::Vec3iVec(values) => values.iter().flat_map(|x| [x.x, x.y, x.z].map(f64::from)).collect(),
        Value::Vec4iVec(values) => values.iter().flat_map(|x| [x.x, x.y, x.z, x.w].map(f64::from)).collect(),
        _ => return None,
    })
}

/// Numbers of a type of attribute: of a value, array or not; none for types that are no numbers.
pub(super) fn components(type_name: &str) -> Option<usize> {
    Some(match type_name.strip_suffix("[]").unwrap_or(type_name) {
        "half" | "float" | "double" | "int" | "uint" | "int64" | "uint64" | "uchar" | "bool" => 1,
        "half2" | "float2" | "double2" | "int2" | "texCoord2h" | "texCoord2f" | "texCoord2d" => 2,
        "half3" | "float3" | "double3" | "int3" => 3,
        "half4" | "float4" | "double4" | "int4" => 4,
        name => match name.strip_suffix(['h', 'f', 'd'])? {
            "texCoord2" => 2,
            "texCoord3" | "color3" | "point3" | "vector3" | "normal3" => 3,
            "color4" => 4,
            _ => return None,
        },
    })
}

/// The numbers of an array of vectors.
pub(super) fn vectors(value: &Value) -> Option<Vec<DVec3>> {
    let numbers = numbers(value)?;
    numbers.len().is_multiple_of(3).then(|| numbers.chunks_exact(3).map(DVec3::from_slice).collect())
}

/// Whole numbers of an array.
pub(super) fn integers(value: &Value) -> Option<Vec<i64>> {
    Some(match value {
        Value::IntVec(values) => values.iter().map(|&x| i64::from(x)).collect(),
        Value::UintVec(values) => values.iter().map(|&x| i64::from(x)).collect(),
        Value::Int64Vec(values) => values.clone(),
        _ => return None,
    })
}

/// A matrix. USD multiplies rows from the left: its numbers in order are the columns here.
pub(super) fn matrix(value: &Value) -> Option<DMat4> {
    match value {
        Value::Matrix4d(matrix) => Some(DMat4::from_cols_array(&matrix.0)),
        _ => None,
    }
}

/// A rotation of unit length; none where there is no direction.
pub(super) fn rotations(value: &Value) -> Option<Vec<DQuat>> {
    let quat = |w: f64, x: f64, y: f64, z: f64| {
        let q = DQuat::from_xyzw(x, y, z, w);
        // The root of a sum of squares: the same bits on every machine
        let length = q.dot(q).sqrt();
        if length > 1e-12 { q * (1.0 / length) } else { DQuat::IDENTITY }
    };
    let half = |q: &openusd::gf::Quath| quat(q.w.into(), q.x.into(), q.y.into(), q.z.into());
    let single = |q: &openusd::gf::Quatf| quat(q.w.into(), q.x.into(), q.y.into(), q.z.into());
    let double = |q: &openusd::gf::Quatd| quat(q.w, q.x, q.y, q.z);
    Some(match value {
        Value::Quath(q) => vec![half(q)],
        Value::Quatf(q) => vec![single(q)],
        Value::Quatd(q) => vec![double(q)],
        Value::QuathVec(all) => all.iter().map(half).collect(),
        Value::QuatfVec(all) => all.iter().map(single).collect(),
        Value::QuatdVec(all) => all.iter().map(double).collect(),
        _ => return None,
    })
}

/// A token or a string.
pub(super) fn text(value: &Value) -> Option<String> {
    match value {
        Value::Token(token) => Some(token.as_str().to_owned()),
        Value::String(text) => Some(text.clone()),
        _ => None,
    }
}
