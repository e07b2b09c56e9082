//! Dicing: polygons and subdivision surfaces become faces of a given size.
//!
//! [`rate`] says how fine, by the world or by a camera; every edge of a mesh has a power of two of segments, by its ends alone.
//! [`polygons`] dices triangles and quads linearly; [`cage`] and `surface` dice Catmull-Clark surfaces on their limit, which
//! `level`, `refine` and `limit` find, and values of corners as its `skin`s. `patch` joins neighbours of different rates without cracks. Faces are diced in chunks; a
//! vertex that chunks share has the same bits in each.

pub mod cage;
mod level;
mod limit;
mod patch;
pub mod polygons;
pub mod rate;
mod refine;
mod skin;
mod surface;
#[cfg(test)]
mod tests;

pub use level::SHARP;
pub use patch::{Diced, NO_POINT};
pub use rate::Rate;
pub use skin::Seams;
