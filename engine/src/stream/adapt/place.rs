//! Puts a grid elsewhere: positions, normals, radii and winding under an affine matrix.

use glam::{DMat3, DMat4, DVec3, Vec3};

use crate::stream::schema::names;
use crate::stream::{Microgrid, Piece, Schema, ValueType, microgrid};
use crate::{Error, Result};

/// An affine map, prepared for many grids.
#[derive(Clone, Copy, Debug)]
pub struct Placement {
    matrix: DMat4,
    linear: DMat3,
    normal: DMat3,
    radius_scale: f64,
    mirrored: bool,
}

impl Placement {
    /// Prepares a matrix, world from object.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when it is not finite, not affine or not invertible.
    pub fn new(matrix: DMat4) -> Result<Self> {
        if !matrix.is_finite() {
            return Err(Error::invalid("a matrix holds a number that is not finite"));
        }
        if matrix.row(3) != DVec3::ZERO.extend(1.0) {
            return Err(Error::invalid(
                "a matrix is not affine: columns 4, 8 and 12 are not 0 or column 16 is not 1",
            ));
        }
        let linear = DMat3::from_mat4(matrix);
        let determinant = linear.determinant();
        // The determinant is judged against the axes' lengths: a scale of a millionth is small, not singular.
        let volume = linear.x_axis.length() * linear.y_axis.length() * linear.z_axis.length();
        if !(determinant.abs() > 1e-12 * volume && determinant.is_normal()) {
            return Err(Error::invalid("a matrix is not invertible"));
        }
        let normal = linear.inverse().transpose();
        if !normal.is_finite() {
            return Err(Error::invalid("a matrix is not invertible"));
        }
        let radius_scale = cube_root(determinant.abs());
        Ok(Self { matrix, linear, normal, radius_scale, mirrored: determinant < 0.0 })
    }

    /// Writes `source` under the map to `out`. Positions are computed in double precision about a new anchor, the
    /// image of the old one, so that a copy far away loses nothing.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when a position leaves the range of numbers.
    pub fn apply(&self, source: &Microgrid, schema: &PlacedColumns, out: &mut Microgrid) -> Result<()> {
        out.clear(source.columns.len());
        out.anchor = self.matrix.transform_point3(source.anchor);
        out.positions.extend(source.positions.iter().map(|p| (self.linear * p.as_dvec3()).as_vec3()));
        if !out.anchor.is_finite() || !out.positions.iter().fold(true, |finite, p| finite & p.is_finite()) {
            return Err(Error::invalid("a matrix moves a position beyond the range of numbers"));
        }
        out.arities.extend_from_slice(&source.arities);
        out.indices.extend_from_slice(&source.indices);
        if self.mirrored {
            flip_winding(&out.arities, &mut out.indices);
        }
        for (index, (from, to)) in source.columns.iter().zip(&mut out.columns).enumerate() {
            match schema.normal {
                Some((column, value_type)) if column == index => self.turn_normals(value_type, from, to),
                _ => to.extend_from_slice(from),
            }
        }
        if let Some((column, value_type)) = schema.radius {
            scale_values(value_type, &mut out.columns[column], self.radius_scale);
        }
        Ok(())
    }

    fn turn_normals(&self, value_type: ValueType, from: &[u8], to: &mut Vec<u8>) {
        let value = |index| microgrid::decode(value_type, from, index);
        for first in (0..from.len() / value_type.bytes()).step_by(3) {
            let n = self.normal * Vec3::new(value(first), value(first + 1), value(first + 2)).as_dvec3();
            // A zero normal means none and stays zero.
            let n = n.try_normalize().unwrap_or(DVec3::ZERO).as_vec3();
            n.to_array().into_iter().for_each(|x| push(value_type, x, to));
        }
    }
}

/// A column that is the copy's number in every grid.
#[derive(Clone, Copy, Debug)]
pub(super) struct InstanceNumber {
    pub column: usize,
    pub number: u32,
}

impl InstanceNumber {
    /// Writes the number into its column, adding the column if it is the last.
    pub fn write(self, grid: &mut Microgrid) {
        if grid.columns.len() == self.column {
            grid.columns.push(Vec::new());
        }
        let column = &mut grid.columns[self.column];
        column.clear();
        column.extend_from_slice(&self.number.to_le_bytes());
    }
}

/// A piece with every grid put elsewhere.
pub(super) struct PlacedPiece {
    pub inner: Box<dyn Piece>,
    pub placement: Placement,
    pub columns: PlacedColumns,
    pub instance: Option<InstanceNumber>,
}

impl Piece for PlacedPiece {
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        let Self { inner, placement, columns, instance } = *self;
        let mut decoded = Microgrid::default();
        inner.read(&mut decoded, &mut |source| {
            placement.apply(source, &columns, grid)?;
            if let Some(instance) = instance {
                instance.write(grid);
            }
            each(grid)
        })
    }
}

/// The columns that a map changes besides positions.
#[derive(Clone, Copy, Debug)]
pub struct PlacedColumns {
    normal: Option<(usize, ValueType)>,
    radius: Option<(usize, ValueType)>,
}

impl PlacedColumns {
    /// None of them.
    pub const NONE: Self = Self { normal: None, radius: None };

    /// Finds them in a schema.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`](crate::ErrorKind::Unsupported) for normals or radii in integers, whose range a map
    /// would leave.
    pub fn of(schema: &Schema) -> Result<Self> {
        let find = |name| {
            let Some(column) = schema.find(name) else { return Ok(None) };
            match schema.attributes[column].value_type {
                value_type @ (ValueType::F32 | ValueType::F16) => Ok(Some((column, value_type))),
                ValueType::U8 | ValueType::U32 => Err(Error::unsupported(format!(
                    "attribute `{name}` is stored in integers and cannot be transformed"
                ))
                .hint("store it as f32 or f16")),
            }
        };
        Ok(Self { normal: find(names::NORMAL)?, radius: find(names::RADIUS)? })
    }
}

/// Reverses every face about its first vertex, which keeps the v0-v2 diagonal of quads.
fn flip_winding(arities: &[u8], indices: &mut [u8]) {
    let mut rest = indices;
    for &arity in arities {
        let (face, tail) = rest.split_at_mut(usize::from(arity));
        if face.len() > 2 {
            face[1..].reverse();
        }
        rest = tail;
    }
}

fn scale_values(value_type: ValueType, bytes: &mut [u8], scale: f64) {
    let width = value_type.bytes();
    for value in bytes.chunks_exact_mut(width) {
        let scaled = (f64::from(microgrid::decode(value_type, value, 0)) * scale) as f32;
        match value_type {
            ValueType::F16 => value.copy_from_slice(&half::f16::from_f32(scaled).to_le_bytes()),
            _ => value.copy_from_slice(&scaled.to_le_bytes()),
        }
    }
}

fn push(value_type: ValueType, value: f32, out: &mut Vec<u8>) {
    match value_type {
        ValueType::F16 => out.extend(half::f16::from_f32(value).to_le_bytes()),
        _ => out.extend(value.to_le_bytes()),
    }
}

/// The cube root of a positive number by Newton's method: `f64::cbrt` may differ in the last bit between machines.
pub fn cube_root(x: f64) -> f64 {
    // A third of the exponent gives a start within 20 %; the error then squares with every step.
    let mut root = f64::from_bits(x.to_bits() / 3 + (0x3ff0_0000_0000_0000 / 3) * 2);
    for _ in 0..6 {
        root -= (root - x / (root * root)) / 3.0;
    }
    root
}

#[cfg(test)]
mod unit_tests {
    use super::*;

    /// Catches a root that is off, above all for rigid maps, whose scale must be one exactly.
    #[test]
    fn cube_roots_are_right() {
        assert_eq!(cube_root(1.0), 1.0);
        assert_eq!(cube_root(8.0), 2.0);
        for exponent in -200..200 {
            let x = 1.7 * 10f64.powi(exponent);
            assert!((cube_root(x) / x.cbrt() - 1.0).abs() < 4e-16, "{x}");
        }
    }

    /// Catches a matrix that would turn a mesh into nothing or into infinities, and small scales taken for singular.
    #[test]
    fn impossible_matrices_are_refused() {
        assert!(Placement::new(DMat4::from_scale(DVec3::splat(1e-6))).is_ok());
        assert!(Placement::new(DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0))).is_err());
        assert!(Placement::new(DMat4::from_scale(DVec3::splat(f64::NAN))).is_err());
        let mut projective = DMat4::IDENTITY;
        projective.x_axis.w = 0.5;
        assert!(Placement::new(projective).is_err());
    }
}
