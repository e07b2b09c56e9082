//! The hook for displacement: a stream whose grids another stage moves.

use std::sync::Arc;

use crate::stream::{Microgrid, MicrogridStream, Piece, Schema};
use crate::{Error, Result};

/// Moves the vertices of grids; `shade` implements it.
pub trait Displacement: Send + Sync {
    /// Moves `grid`'s vertices, and turns its normals where the schema has any. Counts and faces stay.
    ///
    /// # Errors
    /// When the displacement cannot be computed.
    fn displace(&self, grid: &mut Microgrid, schema: &Schema) -> Result<()>;
}

impl<D: Displacement + ?Sized> Displacement for Box<D> {
    fn displace(&self, grid: &mut Microgrid, schema: &Schema) -> Result<()> {
        (**self).displace(grid, schema)
    }
}

impl<D: Displacement + ?Sized> Displacement for Arc<D> {
    fn displace(&self, grid: &mut Microgrid, schema: &Schema) -> Result<()> {
        (**self).displace(grid, schema)
    }
}

/// A stream with every grid displaced.
pub struct Displace<S, D> {
    inner: S,
    schema: Arc<Schema>,
    displacement: Arc<D>,
}

impl<S: MicrogridStream, D: Displacement> Displace<S, D> {
    /// `inner`, displaced.
    pub fn new(inner: S, displacement: D) -> Self {
        let schema = Arc::new(inner.schema().clone());
        Self { inner, schema, displacement: Arc::new(displacement) }
    }
}

impl<S: MicrogridStream, D: Displacement + 'static> MicrogridStream for Displace<S, D> {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.inner.rewind()
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        if !self.inner.next(grid)? {
            return Ok(false);
        }
        displace(self.displacement.as_ref(), &self.schema, grid)?;
        Ok(true)
    }

    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        let Some(inner) = self.inner.next_piece()? else { return Ok(None) };
        let (schema, displacement) = (self.schema.clone(), self.displacement.clone());
        Ok(Some(Box::new(DisplacedPiece { inner, schema, displacement })))
    }

    fn progress(&self) -> f64 {
        self.inner.progress()
    }
}

/// A piece with every grid displaced.
struct DisplacedPiece<D> {
    inner: Box<dyn Piece>,
    schema: Arc<Schema>,
    displacement: Arc<D>,
}

impl<D: Displacement> Piece for DisplacedPiece<D> {
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        let mut decoded = Microgrid::default();
        let Self { inner, schema, displacement } = *self;
        inner.read(&mut decoded, &mut |source| {
            grid.clone_from(source);
            displace(displacement.as_ref(), &schema, grid)?;
            each(grid)
        })
    }
}

/// Displaces a grid and checks what came of it.
fn displace(displacement: &impl Displacement, schema: &Schema, grid: &mut Microgrid) -> Result<()> {
    let counts = (grid.vertex_count(), grid.face_count());
    displacement.displace(grid, schema)?;
    if counts != (grid.vertex_count(), grid.face_count()) {
        return Err(Error::invalid("a displacement changed the number of vertices or faces"));
    }
    recenter(grid);
    grid.validate(schema)
}

/// Moves the anchor into a grid that has left it by more than its own size, so that offsets stay small and precise.
fn recenter(grid: &mut Microgrid) {
    let bounds = grid.bounds();
    let away = bounds.center() - grid.anchor;
    if away.abs().max_element() <= bounds.size().max_element() || !away.is_finite() {
        return;
    }
    let anchor = bounds.center();
    for position in &mut grid.positions {
        *position = (grid.anchor - anchor + position.as_dvec3()).as_vec3();
    }
    grid.anchor = anchor;
}
