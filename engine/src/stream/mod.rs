//! Microgrid streams: rewindable, strictly sequential sources of microgrids (paper, section 4).
//!
//! [`microgrid`] has the unit of data, [`schema`] says which attributes its vertices carry, [`mod@file`] is the `.mgs`
//! format, [`adapt`] turns one stream into another (instances, concatenation, displacement), [`procedural`] makes
//! streams from nothing, [`piece`] lets several threads read one stream.

pub mod adapt;
pub mod file;
pub mod microgrid;
pub mod piece;
pub mod procedural;
pub mod schema;

pub use microgrid::{Microgrid, VERTICES_MAX};
pub use piece::Piece;
pub use schema::{Attribute, Rate, Schema, ValueType};

use crate::Result;

/// A rewindable, strictly sequential source of microgrids: a file, a generator or an adapter over another stream.
///
/// Reading again after [`rewind`](Self::rewind) yields the same bytes. Nothing else may be assumed: no random access,
/// no counts known in advance.
pub trait MicrogridStream: Send {
    /// Which attributes the grids carry, and in what units they stand.
    fn schema(&self) -> &Schema;

    /// Starts again from the first grid.
    ///
    /// # Errors
    /// When the source cannot be opened again.
    fn rewind(&mut self) -> Result<()>;

    /// Reads the next grid into `grid`, reusing its memory. False at the end.
    ///
    /// # Errors
    /// When the source is unreadable or its content is broken; the error names file and byte.
    fn next(&mut self, grid: &mut Microgrid) -> Result<bool>;

    /// Hands out the next run of grids, to be decoded on any thread; none at the end. The pieces' grids, one after the
    /// other, are those of [`next`](Self::next), and where pieces end depends on the stream alone. After a rewind read
    /// either grids or pieces.
    ///
    /// # Errors
    /// As [`next`](Self::next).
    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        piece::gather(self)
    }

    /// About how much of the stream lies behind, from 0 to 1, for progress bars.
    fn progress(&self) -> f64 {
        0.0
    }
}

/// What points to a stream is one.
macro_rules! stream_through {
    ($($pointer:ty),*) => {$(
        impl<S: MicrogridStream + ?Sized> MicrogridStream for $pointer {
            fn schema(&self) -> &Schema {
                (**self).schema()
            }

            fn rewind(&mut self) -> Result<()> {
                (**self).rewind()
            }

            fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
                (**self).next(grid)
            }

            fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
                (**self).next_piece()
            }

            fn progress(&self) -> f64 {
                (**self).progress()
            }
        }
    )*};
}

stream_through!(&mut S, Box<S>);
