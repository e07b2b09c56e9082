//! What is computed at a point: the mathematics of spherical harmonics and the shaders that use it.

pub mod sh;
