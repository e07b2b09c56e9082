//! Which faces of a stream a camera sees, and the stream of just these: a z-buffer of face numbers.

use super::draw::draw;
use super::raster::{FaceId, Sample};
use super::view::View;
use crate::scene::Camera;
use crate::stream::{Microgrid, MicrogridStream, Rate, Schema};
use crate::{Error, ErrorKind, Result};

/// The faces that a camera sees.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VisibleFaces {
    /// In the stream's order, each once.
    faces: Vec<FaceId>,
    grids: u64,
}

impl VisibleFaces {
    /// The faces of the grid of this number, counted from 0 in the stream's order, that are seen, in order.
    pub fn of_grid(&self, grid: u64) -> &[FaceId] {
        let first = self.faces.partition_point(|id| u64::from(id.grid) < grid);
        let rest = &self.faces[first..];
        &rest[..rest.partition_point(|id| u64::from(id.grid) == grid)]
    }

    /// Grids of the stream.
    pub fn grid_count(&self) -> u64 {
        self.grids
    }

    /// Faces that are seen.
    pub fn face_count(&self) -> usize {
        self.faces.len()
    }
}

/// Finds the faces that at least one sample of `camera`'s picture shows: in view, and not hidden.
///
/// One pass over the stream, which is rewound before and after; memory is 12 bytes per sample
/// (pixels × `supersampling`²), whatever the stream's size. Faces cover a share of the samples equal to their opacity,
/// so what stands behind a sparse leaf is seen too. The same faces are found by any number of threads.
///
/// # Errors
/// When the camera is impossible, the stream unreadable, or has 2^32 - 1 grids and more.
pub fn visible_faces(
    stream: &mut dyn MicrogridStream,
    camera: &Camera,
    supersampling: u32,
    progress: &mut dyn FnMut(f64),
) -> Result<VisibleFaces> {
    let view = View::new(camera, supersampling, stream.schema().meters_per_unit)?;
    let mut samples = vec![Sample::<FaceId>::EMPTY; view.width * view.height];
    stream.rewind()?;
    let drawn = draw(stream, &view, None, &mut samples, progress)?;
    stream.rewind()?;
    if drawn.grids >= u64::from(u32::MAX) {
        let message = format!("{} grids, at most 2^32 - 2 are possible", drawn.grids);
        return Err(Error::new(ErrorKind::Limit, message));
    }
    let mut faces: Vec<FaceId> =
        samples.into_iter().filter(|sample| sample.inverse_depth > 0.0).map(|sample| sample.paint).collect();
    faces.sort_unstable();
    faces.dedup();
    Ok(VisibleFaces { faces, grids: drawn.grids })
}

/// A stream's visible faces and the vertices that they need; grids of which nothing is seen are left out.
pub struct Visible<S> {
    inner: S,
    faces: VisibleFaces,
    /// The next grid's number, and the next of its visible faces.
    grid: u64,
    face: usize,
    source: Microgrid,
}

impl<S: MicrogridStream> Visible<S> {
    /// The part of `inner` that [`visible_faces`] found in it.
    ///
    /// # Errors
    /// When the stream cannot be rewound.
    pub fn new(mut inner: S, faces: VisibleFaces) -> Result<Self> {
        inner.rewind()?;
        Ok(Self { inner, faces, grid: 0, face: 0, source: Microgrid::default() })
    }
}

impl<S: MicrogridStream> MicrogridStream for Visible<S> {
    fn schema(&self) -> &Schema {
        self.inner.schema()
    }

    fn rewind(&mut self) -> Result<()> {
        (self.grid, self.face) = (0, 0);
        self.inner.rewind()
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        loop {
            if self.face == self.faces.faces.len() || !self.inner.next(&mut self.source)? {
                return Ok(false);
            }
            let rest = &self.faces.faces[self.face..];
            let count = rest.partition_point(|id| u64::from(id.grid) == self.grid);
            (self.grid, self.face) = (self.grid + 1, self.face + count);
            if count > 0 {
                keep(&self.source, self.inner.schema(), &rest[..count], grid);
                return Ok(true);
            }
        }
    }

    fn progress(&self) -> f64 {
        self.inner.progress()
    }
}

/// Copies the faces `kept` of a grid and the vertices that they need, in the grid's order.
fn keep(source: &Microgrid, schema: &Schema, kept: &[FaceId], out: &mut Microgrid) {
    out.clear(schema.attributes.len());
    out.anchor = source.anchor;

    // Mark the vertices that are needed, then number them
    let mut numbers = [None; crate::stream::VERTICES_MAX];
    let mut wanted = kept.iter().peekable();
    let mut is_kept = |face: usize| wanted.next_if(|id| id.face as usize == face).is_some();
    for (_, face) in source.faces().enumerate().filter(|(number, _)| is_kept(*number)) {
        out.arities.push(face.len() as u8);
        out.indices.extend_from_slice(face);
        face.iter().for_each(|&vertex| numbers[usize::from(vertex)] = Some(0));
    }
    let needed = numbers.iter_mut().enumerate().filter(|(_, number)| number.is_some());
    for (count, (vertex, number)) in needed.enumerate() {
        *number = Some(count as u8);
        out.positions.push(source.positions[vertex]);
        for (attribute, (from, to)) in
            schema.attributes.iter().zip(source.columns.iter().zip(&mut out.columns))
        {
            if attribute.rate == Rate::Vertex {
                let bytes = attribute.value_bytes();
                to.extend_from_slice(&from[vertex * bytes..(vertex + 1) * bytes]);
            }
        }
    }
    out.indices.iter_mut().for_each(|index| *index = numbers[usize::from(*index)].expect("marked above"));
    for (attribute, (from, to)) in schema.attributes.iter().zip(source.columns.iter().zip(&mut out.columns)) {
        if attribute.rate == Rate::Grid {
            to.extend_from_slice(from);
        }
    }
}
