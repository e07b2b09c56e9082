//! The tracers. [`stream`] is the spherical tracer on the CPU (paper, section 4.4; design: shared-origin ray streams).

pub mod stream;

pub use stream::{BatchCounts, Shading, SphericalTracer, TraceOptions, bake_set_hash};
