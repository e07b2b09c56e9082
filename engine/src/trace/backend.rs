//! What traces a bake's batches: the CPU, or GPUs with the CPU behind them.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::Device;
use super::setup::Shading;
use super::stream::{BatchCounts, SphericalTracer, TraceOptions};
use crate::Result;
use crate::batch::Point;
use crate::brickmap::BrickMap;
use crate::cut::arena::ArenaCounts;
use crate::cut::{Arena, Lod};

/// What traces.
#[derive(Debug)]
pub struct Backend {
    tracer: Tracer,
    /// Its name, as the report has it.
    pub name: String,
    /// One sentence on why it is this one.
    pub reason: String,
}

#[derive(Debug)]
enum Tracer {
    Cpu(Box<SphericalTracer>),
    #[cfg(feature = "gpu")]
    Gpu(Box<super::GpuTracer>),
}

impl Backend {
    /// What `device` means on this machine, over the bricks of `map` with an arena of at most `arena_bytes`.
    ///
    /// # Errors
    /// When a device is asked for by name that is not there or fails; when the arena cannot be made.
    pub fn new(
        device: Device,
        map: Arc<BrickMap>,
        arena_bytes: u64,
        options: TraceOptions,
        meters_per_unit: f64,
    ) -> Result<Self> {
        let cpu = |arena_bytes: u64| {
            let arena = Arena::new(map.clone(), arena_bytes, options.lod == Lod::Off)?;
            Ok(SphericalTracer::new(arena, options, meters_per_unit))
        };
        let on_cpu = |reason: String| {
            Ok(Self { tracer: Tracer::Cpu(Box::new(cpu(arena_bytes)?)), name: "cpu".into(), reason })
        };
        if device == Device::Cpu {
            return on_cpu("the CPU was asked for".into());
        }
        if map.manifest().instances > 0 {
            let why = "the occluders have copies that share bricks, which GPUs do not trace";
            return match device {
                Device::Auto => on_cpu(format!("the CPU traces, since {why}")),
                _ => Err(crate::Error::unsupported(format!("device `{device}`: {why}"))
                    .hint("use `--device cpu` or `--device auto`")),
            };
        }
        #[cfg(feature = "gpu")]
        {
            let chosen = super::gpu::choose(device)?;
            if chosen.adapters.is_empty() {
                return on_cpu(chosen.reason);
            }
            match on_devices(&chosen.adapters, arena_bytes, cpu) {
                Ok(tracer) => {
                    let name = tracer.name();
                    Ok(Self { tracer: Tracer::Gpu(Box::new(tracer)), name, reason: chosen.reason })
                }
                Err(error) if device == Device::Auto => on_cpu(format!("the CPU traces, since {error}")),
                Err(error) => Err(error),
            }
        }
        #[cfg(not(feature = "gpu"))]
        match device {
            Device::Auto => on_cpu("this program was built without GPUs".into()),
            _ => Err(crate::Error::unsupported(format!(
                "device `{device}`: this program was built without GPUs"
            ))
            .hint("build it with the feature `gpu`, or use `--device cpu`")),
        }
    }

    /// Traces a batch; see [`SphericalTracer::trace`]. `next` is the batch that comes after it, if that is known: a GPU's
    /// bricks for it are loaded meanwhile.
    ///
    /// # Errors
    /// As there.
    pub fn trace(
        &mut self,
        points: &[Point],
        shading: &Shading,
        next: Option<(&[Point], &Shading)>,
        cancel: &AtomicBool,
        out: &mut [f32],
    ) -> Result<BatchCounts> {
        let _ = next;
        match &mut self.tracer {
            Tracer::Cpu(tracer) => tracer.trace(points, shading, cancel, out),
            #[cfg(feature = "gpu")]
            Tracer::Gpu(tracer) => tracer.trace(points, shading, next, cancel, out),
        }
    }

    /// What the arena counted so far.
    pub fn arena_counts(&self) -> ArenaCounts {
        match &self.tracer {
            Tracer::Cpu(tracer) => tracer.arena_counts(),
            #[cfg(feature = "gpu")]
            Tracer::Gpu(tracer) => tracer.arena_counts(),
        }
    }

    /// What went wrong with devices so far.
    pub fn troubles(&self) -> &[String] {
        match &self.tracer {
            Tracer::Cpu(_) => &[],
            #[cfg(feature = "gpu")]
            Tracer::Gpu(tracer) => &tracer.troubles,
        }
    }
}

/// Opens adapters, and an arena that all of them can hold.
#[cfg(feature = "gpu")]
fn on_devices(
    adapters: &[super::gpu::Adapter],
    arena_bytes: u64,
    cpu: impl Fn(u64) -> Result<SphericalTracer>,
) -> Result<super::GpuTracer> {
    use super::gpu::{AdapterKind, Gpu, mirror::Mirror};
    let gpus = adapters.iter().map(|adapter| Gpu::open(adapter, true)).collect::<Result<Vec<_>>>()?;
    let least = gpus.iter().map(Mirror::capacity_bytes).min().unwrap_or(0);
    // A software adapter's copy is in this process's memory too
    let is_software = adapters.iter().any(|adapter| adapter.kind == AdapterKind::Software);
    let share = if is_software { arena_bytes / 2 } else { arena_bytes };
    let spare = crate::brick::leaf::READ_PAST_BYTES as u64;
    super::GpuTracer::new(cpu(share.min(least - spare))?, gpus)
}
