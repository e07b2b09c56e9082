//! The tracer on wgpu: the whole batch in WGSL, on any Vulkan adapter (paper, section 4.4).
//!
//! [`adapter`] finds what the machine has, [`device`] opens it, [`shader`] joins the kernels from `shaders/`, [`records`] are
//! what host and kernels share, [`mirror`] copies the arena, [`points`] are a batch's points, [`kernels`] are compiled and bound, [`runner`] runs
//! dispatches of bounded time ([`pace`]), [`tracer`] drives a batch from its cut to its coefficients, and to the CPU where
//! the device fails. [`mod@bench`] measures an adapter's ceilings.

pub mod adapter;
pub mod bench;
pub mod device;
pub mod kernels;
pub mod mirror;
pub mod pace;
pub mod points;
pub mod records;
pub mod runner;
pub mod shader;
#[cfg(test)]
mod tests;
pub mod tracer;

pub use adapter::{Adapter, AdapterKind, Choice, adapters, choose};
pub use device::Gpu;
pub use tracer::GpuTracer;

use std::task::{Context, Poll, Waker};

/// The result of a future that is ready at once, as all of wgpu's are where there is no browser.
fn ready<T>(future: impl Future<Output = T>) -> Option<T> {
    let mut future = std::pin::pin!(future);
    match future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => Some(value),
        Poll::Pending => None,
    }
}
