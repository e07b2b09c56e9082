//! Streams made of streams: other units, many copies, several sources in a row, displaced surfaces.
//!
//! Every adapter streams: it holds one grid, or a prototype of at most [`PROTOTYPE_BYTES_MAX`] bytes, whatever the
//! size of what passes through.

mod concat;
mod convert;
mod displace;
mod instance;
mod place;

pub use concat::Concat;
pub use convert::Convert;
pub use displace::{Displace, Displacement};
pub use instance::{Instance, MatrixList, MatrixSource, PROTOTYPE_BYTES_MAX};
pub(crate) use place::{Placement, cube_root};

#[cfg(test)]
mod tests;
