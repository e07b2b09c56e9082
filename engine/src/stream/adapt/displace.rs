//! The hook for displacement: a stream whose grids another stage moves.

use crate::stream::{Microgrid, MicrogridStream, Schema};
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

impl<D: Displacement + ?Sized> Displacement for std::sync::Arc<D> {
    fn displace(&self, grid: &mut Microgrid, schema: &Schema) -> Result<()> {
        (**self).displace(grid, schema)
    }
}

/// A stream with every grid displaced.
pub struct Displace<S, D> {
    inner: S,
    displacement: D,
}

impl<S: MicrogridStream, D: Displacement> Displace<S, D> {
    /// `inner`, displaced.
    pub fn new(inner: S, displacement: D) -> Self {
        Self { inner, displacement }
    }
}

impl<S: MicrogridStream, D: Displacement> MicrogridStream for Displace<S, D> {
    fn schema(&self) -> &Schema {
        self.inner.schema()
    }

    fn rewind(&mut self) -> Result<()> {
        self.inner.rewind()
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        if !self.inner.next(grid)? {
            return Ok(false);
        }
        let counts = (grid.vertex_count(), grid.face_count());
        self.displacement.displace(grid, self.inner.schema())?;
        if counts != (grid.vertex_count(), grid.face_count()) {
            return Err(Error::invalid("a displacement changed the number of vertices or faces"));
        }
        recenter(grid);
        grid.validate(self.inner.schema())?;
        Ok(true)
    }

    fn progress(&self) -> f64 {
        self.inner.progress()
    }
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
