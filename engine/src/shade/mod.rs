//! Shaders: what is computed at the points of a bake set (paper, section 4.2).

pub mod ambient;
pub mod sample;
pub mod sh;
pub mod sh_occlusion;
