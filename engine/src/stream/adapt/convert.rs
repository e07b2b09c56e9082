//! A stream in another file's units and up axis, brought to the scene's.

use glam::{DMat4, DVec3, DVec4};

use super::place::{PlacedColumns, PlacedPiece, Placement};
use crate::Result;
use crate::stream::schema::UpAxis;
use crate::stream::{Microgrid, MicrogridStream, Piece, Schema};

/// A stream under one affine map: units, up axis, or any matrix.
pub struct Convert<S> {
    inner: S,
    schema: Schema,
    /// None when nothing changes.
    placement: Option<Placement>,
    columns: PlacedColumns,
    scratch: Microgrid,
}

impl<S: MicrogridStream> Convert<S> {
    /// Brings a stream to `meters_per_unit` and `up`. A turn of +90° about x takes +y up to +z up; scale and turn act
    /// on anchors, positions, normals and radii. A stream that stands so already passes through untouched.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for a unit that is not a positive number.
    pub fn to_units(inner: S, meters_per_unit: f64, up: UpAxis) -> Result<Self> {
        let schema = Schema { meters_per_unit, up, ..inner.schema().clone() };
        schema.validate()?;
        let scale = inner.schema().meters_per_unit / meters_per_unit;
        let [x, y, z] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| {
            let turned = match (inner.schema().up, up) {
                (UpAxis::Y, UpAxis::Z) => DVec3::new(axis.x, -axis.z, axis.y),
                (UpAxis::Z, UpAxis::Y) => DVec3::new(axis.x, axis.z, -axis.y),
                _ => axis,
            };
            (scale * turned).extend(0.0)
        });
        Self::with(inner, schema, DMat4::from_cols(x, y, z, DVec4::W))
    }

    /// Puts a stream under `matrix` and leaves units and up axis as they are.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for a matrix that is not finite, affine and invertible.
    pub fn by_matrix(inner: S, matrix: DMat4) -> Result<Self> {
        let schema = inner.schema().clone();
        Self::with(inner, schema, matrix)
    }

    fn with(inner: S, schema: Schema, matrix: DMat4) -> Result<Self> {
        let placement = Some(Placement::new(matrix)?).filter(|_| matrix != DMat4::IDENTITY);
        let columns = match placement {
            Some(_) => PlacedColumns::of(&schema)?,
            None => PlacedColumns::NONE,
        };
        Ok(Self { inner, schema, placement, columns, scratch: Microgrid::default() })
    }
}

impl<S: MicrogridStream> MicrogridStream for Convert<S> {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.inner.rewind()
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        let Some(placement) = &self.placement else { return self.inner.next(grid) };
        let more = self.inner.next(&mut self.scratch)?;
        if more {
            placement.apply(&self.scratch, &self.columns, grid)?;
        }
        Ok(more)
    }

    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        let (Some(inner), columns) = (self.inner.next_piece()?, self.columns) else { return Ok(None) };
        Ok(Some(match self.placement {
            Some(placement) => Box::new(PlacedPiece { inner, placement, columns, instance: None }),
            None => inner,
        }))
    }

    fn progress(&self) -> f64 {
        self.inner.progress()
    }
}
