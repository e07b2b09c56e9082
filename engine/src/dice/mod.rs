//! Dicing: polygons and subdivision surfaces become grids of micropolygons of a given size.
//!
//! Here will stand the dicer of imported polygons (`--dice world:SIZE` and `--dice camera:NAME`), which also takes over
//! textured alpha: faces are diced to two texels and less and averaged by area. Until then [`import`](crate::import)
//! keeps faces as they are and averages alpha over each.
