//! The tracers (paper, section 4.4): every ray of a batch through the batch's cut, with no further I/O.
//!
//! [`setup`] is what they have in common. [`stream`] is the one on the CPU: all rays of a few neighbouring points go
//! together. `gpu` is the one on wgpu, a lane a ray; [`kernel`] is that kernel's twin, the plain loop. [`device`] says
//! which of them is to trace, [`backend`] is the one that does.

pub mod backend;
pub mod device;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod kernel;
pub mod setup;
pub mod stream;

pub use backend::Backend;
pub use device::Device;
#[cfg(feature = "gpu")]
pub use gpu::GpuTracer;
pub use setup::{Shading, bake_set_hash};
pub use stream::{BatchCounts, SphericalTracer, TraceOptions};
