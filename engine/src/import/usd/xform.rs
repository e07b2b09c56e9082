//! A prim's own transform: the product of its `xformOpOrder`, in double precision.

use glam::{DMat3, DMat4, DVec3};
use openusd::sdf::Value;

use super::read::Stage;
use super::value;
use crate::math::trig::cos_sin_turns;

const RESET: &str = "!resetXformStack!";
const INVERT: &str = "!invert!";

/// Parent from prim, and whether the prim stands in the world instead of its parent. None for an operation that cannot be
/// read or inverted.
pub(super) fn local(stage: &Stage, prim: &str) -> Option<(DMat4, bool)> {
    let order = match stage.value(prim, "xformOpOrder") {
        Some(Value::TokenVec(tokens)) => tokens.iter().map(|token| token.as_str().to_owned()).collect(),
        Some(Value::StringVec(strings)) => strings,
        _ => Vec::new(),
    };
    let reset = order.first().is_some_and(|first| first == RESET);
    let mut parent_from_prim = DMat4::IDENTITY;
    for name in order.iter().skip(usize::from(reset)) {
        let (inverted, name) = match name.strip_prefix(INVERT) {
            Some(name) => (true, name),
            None => (false, name.as_str()),
        };
        let Some(value) = stage.value(prim, name) else { continue };
        let mut matrix = operation(name, &value)?;
        if inverted {
            if matrix.determinant() == 0.0 {
                return None;
            }
            matrix = matrix.inverse();
        }
        // The first operation is the outermost
        parent_from_prim *= matrix;
    }
    Some((parent_from_prim, reset))
}

/// The matrix of an operation by its name, `xformOp:KIND[:SUFFIX]`.
fn operation(name: &str, value: &Value) -> Option<DMat4> {
    let kind = name.strip_prefix("xformOp:")?.split(':').next()?;
    let numbers = || value::numbers(value);
    let scalar = || Some(*numbers()?.first()?);
    let vector = || numbers().filter(|numbers| numbers.len() == 3).map(|numbers| DVec3::from_slice(&numbers));
    Some(match kind {
        "translate" => DMat4::from_translation(vector()?),
        "translateX" => DMat4::from_translation(DVec3::X * scalar()?),
        "translateY" => DMat4::from_translation(DVec3::Y * scalar()?),
        "translateZ" => DMat4::from_translation(DVec3::Z * scalar()?),
        "scale" => DMat4::from_scale(vector()?),
        "scaleX" => DMat4::from_scale(DVec3::new(scalar()?, 1.0, 1.0)),
        "scaleY" => DMat4::from_scale(DVec3::new(1.0, scalar()?, 1.0)),
        "scaleZ" => DMat4::from_scale(DVec3::new(1.0, 1.0, scalar()?)),
        "orient" => DMat4::from_quat(*value::rotations(value)?.first()?),
        "rotateX" => turn(0, scalar()?),
        "rotateY" => turn(1, scalar()?),
        "rotateZ" => turn(2, scalar()?),
        "transform" => value::matrix(value)?,
        _ => {
            // The axis that is named first turns first, so it stands innermost
            let axes = kind.strip_prefix("rotate")?;
            let degrees = vector()?;
            if axes.len() != 3 {
                return None;
            }
            axes.bytes().try_fold(DMat4::IDENTITY, |matrix, axis| {
                let axis = usize::from(axis.checked_sub(b'X').filter(|axis| *axis < 3)?);
                Some(turn(axis, degrees[axis]) * matrix)
            })?
        }
    })
}

/// A turn about an axis, counter-clockwise for one who looks against it.
fn turn(axis: usize, degrees: f64) -> DMat4 {
    let (cos, sin) = cos_sin_turns(degrees / 360.0);
    let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut matrix = DMat3::IDENTITY;
    matrix.col_mut(next)[next] = cos;
    matrix.col_mut(next)[last] = sin;
    matrix.col_mut(last)[next] = -sin;
    matrix.col_mut(last)[last] = cos;
    DMat4::from_mat3(matrix)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches turns of the wrong sense or order.
    #[test]
    fn turns_are_right_handed_and_in_order() {
        let close = |a: DVec3, b: DVec3| assert!((a - b).length() < 1e-14, "{a} {b}");
        close(turn(0, 90.0).transform_vector3(DVec3::Y), DVec3::Z);
        close(turn(1, 90.0).transform_vector3(DVec3::Z), DVec3::X);
        close(turn(2, 90.0).transform_vector3(DVec3::X), DVec3::Y);
        let value = Value::Vec3d(openusd::gf::vec3d(90.0, 90.0, 0.0));
        // About x first: y goes to z, which the turn about y then takes to x
        close(operation("xformOp:rotateXYZ", &value).unwrap().transform_vector3(DVec3::Y), DVec3::X);
        close(operation("xformOp:rotateYXZ:a", &value).unwrap().transform_vector3(DVec3::Y), DVec3::Z);
        assert!(operation("xformOp:rotateXY", &value).is_none());
        assert!(operation("xformOp:shear", &value).is_none());
    }
}
