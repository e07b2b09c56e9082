//! An adapter's measured ceilings: memory, node tests, rays.

use std::sync::atomic::AtomicBool;
use std::time::Instant;

use wgpu::BufferUsages;

use super::{Adapter, Gpu, GpuTracer};
use crate::Result;
use crate::batch::Point;
use crate::trace::setup::Shading;
use crate::trace::stream::SphericalTracer;

/// Bytes that the copy moves at a time.
const COPY_BYTES: u64 = 64 << 20;
/// Seconds that each figure is measured for, about.
const SECONDS: f64 = 1.0;

/// What was measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Ceilings {
    /// Bytes read and written per second when memory is copied.
    pub copy_bytes_per_second: f64,
    /// Child boxes tested per second while tracing.
    pub box_tests_per_second: f64,
    /// Rays per second whose neighbours go the same way, projection included.
    pub coherent_rays_per_second: f64,
    /// Rays per second in the samples' own order.
    pub incoherent_rays_per_second: f64,
}

/// Measures an adapter on a batch of points whose bricks fit the arena of `cpu`; each figure takes about a second.
///
/// # Errors
/// [`ErrorKind::Device`](crate::ErrorKind::Device) when the device fails.
pub fn measure(
    adapter: &Adapter,
    points: &[Point],
    shading: &Shading,
    cpu: impl Fn() -> Result<SphericalTracer>,
) -> Result<Ceilings> {
    let mut ceilings = Ceilings { copy_bytes_per_second: copy_rate(adapter)?, ..Ceilings::default() };
    for is_coherent in [true, false] {
        let mut tracer = GpuTracer::new(cpu()?, vec![Gpu::open(adapter, true)?])?;
        if let Some(runner) = tracer.runner() {
            runner.is_coherent = is_coherent;
        }
        let mut out = vec![0.0; points.len() * shading.coefficients()];
        let mut trace = || tracer.trace(points, shading, None, &AtomicBool::new(false), &mut out);
        // The first batches compile, load, and find the size of dispatches
        (0..2).try_for_each(|_| trace().map(drop))?;
        let (start, mut rays, mut nodes) = (Instant::now(), 0, 0);
        while rays == 0 || start.elapsed().as_secs_f64() < SECONDS {
            let counts = trace()?;
            rays += counts.rays;
            nodes += counts.walk.nodes;
        }
        let seconds = start.elapsed().as_secs_f64();
        if is_coherent {
            ceilings.coherent_rays_per_second = rays as f64 / seconds;
            ceilings.box_tests_per_second = 8.0 * nodes as f64 / seconds;
        } else {
            ceilings.incoherent_rays_per_second = rays as f64 / seconds;
        }
    }
    Ok(ceilings)
}

fn copy_rate(adapter: &Adapter) -> Result<f64> {
    let gpu = Gpu::open(adapter, false)?;
    let from = gpu.buffer("copy from", COPY_BYTES, BufferUsages::STORAGE)?;
    let to = gpu.buffer("copy to", COPY_BYTES, BufferUsages::STORAGE)?;
    let copy = |times: u32| {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        (0..times).for_each(|_| encoder.copy_buffer_to_buffer(&from, 0, &to, 0, COPY_BYTES));
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()
    };
    copy(1)?;
    let (start, mut copies) = (Instant::now(), 0);
    while copies == 0 || start.elapsed().as_secs_f64() < SECONDS {
        copy(8)?;
        copies += 8;
    }
    // Every byte is read and written
    Ok(2.0 * f64::from(copies) * COPY_BYTES as f64 / start.elapsed().as_secs_f64())
}
