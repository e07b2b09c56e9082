//! `pantaray devices`: what can trace on this machine, and how fast.

use clap::Args;
use engine::Result;
use engine::brick::lanes::InstructionSet;
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::figures;

/// List what can trace on this machine
#[derive(Debug, Args)]
pub struct Arguments {
    /// Measure each device: copied bytes, box tests and rays per second; takes a few seconds each
    #[arg(long)]
    bench: bool,
}

#[derive(Debug, Serialize)]
struct Devices {
    devices: Vec<Device>,
    /// What `--device auto` would use, and why.
    auto: String,
}

/// A device as `bake --device` names it.
#[derive(Debug, Serialize)]
struct Device {
    name: String,
    model: String,
    /// The processor's architecture, or the driver.
    architecture: String,
    /// Threads that run at once; none for GPUs.
    #[serde(skip_serializing_if = "Option::is_none")]
    threads: Option<usize>,
    /// The inner loops that it can run, the best last; none for GPUs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    instruction_sets: Vec<&'static str>,
    /// The one that `bake` uses.
    #[serde(skip_serializing_if = "Option::is_none")]
    instructions: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    limits: Option<Limits>,
    #[serde(skip_serializing_if = "Option::is_none")]
    measured: Option<Measured>,
}

/// What a GPU can do.
#[derive(Debug, Serialize)]
struct Limits {
    /// discrete, integrated, virtual, other or software.
    kind: &'static str,
    /// Lanes of a subgroup, smallest and largest.
    subgroup: Option<[u32; 2]>,
    double_precision: bool,
    /// Bytes of an arena that it can hold, if its memory does.
    arena_bytes: u64,
    /// Why it cannot trace.
    problem: Option<String>,
}

/// Ceilings of a device.
#[derive(Debug, Serialize)]
struct Measured {
    copy_bytes_per_second: Option<f64>,
    box_tests_per_second: f64,
    coherent_rays_per_second: f64,
    incoherent_rays_per_second: Option<f64>,
}

/// Lists the devices, and measures them if asked to.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let mut devices = vec![cpu()];
    let auto = add_gpus(&mut devices)?;
    if arguments.bench {
        bench::measure(&mut devices, console.control())?;
    }
    let mut text: Vec<String> = devices.iter().map(Device::describe).collect();
    text.push(format!("auto: {auto}"));
    Answer::new(&Devices { devices, auto }, text.join("\n"))
}

fn cpu() -> Device {
    let mut sets = InstructionSet::available();
    sets.sort();
    Device {
        name: "cpu".into(),
        model: cpu_model().unwrap_or_else(|| "unknown".into()),
        architecture: std::env::consts::ARCH.into(),
        threads: Some(std::thread::available_parallelism().map_or(1, usize::from)),
        instruction_sets: sets.into_iter().map(InstructionSet::name).collect(),
        instructions: Some(InstructionSet::detect().name()),
        limits: None,
        measured: None,
    }
}

/// Adds the GPUs and says what `auto` means.
#[cfg(feature = "gpu")]
fn add_gpus(devices: &mut Vec<Device>) -> Result<String> {
    use engine::trace::gpu::{AdapterKind, adapters, choose};
    for (number, adapter) in adapters().into_iter().enumerate() {
        let is_software = adapter.kind == AdapterKind::Software;
        devices.push(Device {
            name: if is_software { "software".into() } else { format!("gpu:{number}") },
            model: adapter.name.clone(),
            architecture: adapter.driver.clone(),
            threads: None,
            instruction_sets: Vec::new(),
            instructions: None,
            limits: Some(Limits {
                kind: adapter.kind.name(),
                subgroup: adapter.subgroup,
                double_precision: adapter.has_double,
                arena_bytes: u64::from(adapter.pages_max()) * adapter.page_bytes(),
                problem: adapter.problem,
            }),
            measured: None,
        });
    }
    Ok(choose(engine::trace::Device::Auto)?.reason)
}

#[cfg(not(feature = "gpu"))]
fn add_gpus(_: &mut Vec<Device>) -> Result<String> {
    Ok("the CPU traces, since this program was built without GPUs".into())
}

impl Device {
    fn describe(&self) -> String {
        let mut text = format!("{}  {} ({})", self.name, self.model, self.architecture);
        if let (Some(threads), Some(instructions)) = (self.threads, self.instructions) {
            let sets = self.instruction_sets.join(" ");
            text += &format!(", {threads} threads, inner loops: {sets}; `bake` uses {instructions}");
        }
        if let Some(limits) = &self.limits {
            text += &format!(", {}", limits.kind);
            match limits.subgroup {
                Some([least, most]) if least == most => text += &format!(", subgroups of {most}"),
                Some([least, most]) => text += &format!(", subgroups of {least} to {most}"),
                None => text += ", no subgroups",
            }
            text += if limits.double_precision { ", double precision" } else { ", single precision" };
            text += &format!(", arenas of up to {}", figures::bytes(limits.arena_bytes));
            if let Some(problem) = &limits.problem {
                text += &format!("; cannot trace: {problem}");
            }
        }
        if let Some(measured) = &self.measured {
            text += &format!(
                "\n     {} rays/s, {} box tests/s",
                figures::short(measured.coherent_rays_per_second),
                figures::short(measured.box_tests_per_second)
            );
            if let (Some(copy), Some(rays)) =
                (measured.copy_bytes_per_second, measured.incoherent_rays_per_second)
            {
                let (rays, copy) = (figures::short(rays), figures::bytes(copy as u64));
                text += &format!(", {rays} rays/s incoherent, memory copied at {copy}/s");
            }
        }
        text
    }
}

/// The processor's name, where Linux says it.
fn cpu_model() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim().to_string())
}

/// The benchmark: one batch of points on a jungle, traced for a second by each device.
mod bench {
    use std::sync::Arc;
    use std::sync::atomic::AtomicBool;
    use std::time::Instant;

    use engine::bake::Control;
    use engine::batch::Point;
    use engine::brick::lanes::InstructionSet;
    use engine::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
    use engine::cut::{Arena, Lod};
    use engine::scene::{Procedural, ProceduralKind, ShOcclusion};
    use engine::stream::procedural::ProceduralStream;
    use engine::stream::schema::UpAxis;
    use engine::stream::{Microgrid, MicrogridStream};
    use engine::trace::{Shading, SphericalTracer, TraceOptions};
    use engine::{Error, Result};
    use glam::Vec3;

    use super::{Device, Measured};

    /// Faces of the jungle.
    const MICROPOLYGONS: u64 = 2_000_000;
    /// Points of the batch: 1 M rays.
    const POINTS: usize = 2048;

    /// Measures all devices that can trace.
    pub fn measure(devices: &mut [Device], control: Control<'_>) -> Result<()> {
        let folder = tempfile::tempdir()
            .map_err(|error| Error::io("create a folder in", std::env::temp_dir(), error))?;
        let scene = Procedural { kind: ProceduralKind::Jungle, seed: 7, micropolygons: MICROPOLYGONS };
        let mut stream = ProceduralStream::new(&scene, 1.0, UpAxis::Y)?;
        let points = points(&mut stream)?;
        let options = BuildOptions {
            memory_bytes: 512 << 20,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            scratch: folder.path().to_path_buf(),
            far_field: FarField::Paper,
        };
        let path = folder.path().join("map");
        let progress = |stage: &str, done: f64| control.progress.update(stage, done, "");
        build(&mut [OccluderStream::once(&mut stream)], &options, &path, &progress, control.cancel)?;
        let map = Arc::new(BrickMap::open(&path)?);
        let shading = Shading::new(&ShOcclusion::default(), 0, "bench", map.shift(0));
        for device in devices {
            control.progress.update("measure", 0.0, &device.name);
            device.measured = match &device.limits {
                None => Some(measure_cpu(&map, &points, &shading)?),
                Some(limits) if limits.problem.is_some() => None,
                Some(_) => measure_gpu(device, &map, &points, &shading)?,
            };
        }
        Ok(())
    }

    fn tracer(map: &Arc<BrickMap>) -> Result<SphericalTracer> {
        let arena = Arena::new(map.clone(), 1 << 30, true)?;
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let instructions = InstructionSet::detect();
        Ok(SphericalTracer::new(arena, TraceOptions { lod: Lod::Off, seed: 0, threads, instructions }, 1.0))
    }

    fn measure_cpu(map: &Arc<BrickMap>, points: &[Point], shading: &Shading) -> Result<Measured> {
        let mut tracer = tracer(map)?;
        let mut out = vec![0.0; points.len() * shading.coefficients()];
        let mut trace = || tracer.trace(points, shading, &AtomicBool::new(false), &mut out);
        trace()?;
        let (start, mut rays, mut boxes) = (Instant::now(), 0, 0);
        while rays == 0 || start.elapsed().as_secs_f64() < 1.0 {
            let counts = trace()?;
            rays += counts.rays;
            boxes += 8 * counts.walk.node_rays;
        }
        let seconds = start.elapsed().as_secs_f64();
        Ok(Measured {
            copy_bytes_per_second: None,
            box_tests_per_second: boxes as f64 / seconds,
            coherent_rays_per_second: rays as f64 / seconds,
            incoherent_rays_per_second: None,
        })
    }

    #[cfg(feature = "gpu")]
    fn measure_gpu(
        device: &Device,
        map: &Arc<BrickMap>,
        points: &[Point],
        shading: &Shading,
    ) -> Result<Option<Measured>> {
        use engine::trace::gpu::{adapters, bench};
        let Some(adapter) = adapters().into_iter().find(|adapter| adapter.name == device.model) else {
            return Ok(None);
        };
        let ceilings = bench::measure(&adapter, points, shading, || tracer(map))?;
        Ok(Some(Measured {
            copy_bytes_per_second: Some(ceilings.copy_bytes_per_second),
            box_tests_per_second: ceilings.box_tests_per_second,
            coherent_rays_per_second: ceilings.coherent_rays_per_second,
            incoherent_rays_per_second: Some(ceilings.incoherent_rays_per_second),
        }))
    }

    #[cfg(not(feature = "gpu"))]
    fn measure_gpu(_: &Device, _: &Arc<BrickMap>, _: &[Point], _: &Shading) -> Result<Option<Measured>> {
        Ok(None)
    }

    /// The vertices of the first grids: they lie together, as a batch's do.
    fn points(stream: &mut dyn MicrogridStream) -> Result<Vec<Point>> {
        let (mut grid, mut points) = (Microgrid::default(), Vec::new());
        while points.len() < POINTS && stream.next(&mut grid)? {
            for &offset in grid.positions.iter().take(POINTS - points.len()) {
                let position = grid.anchor + offset.as_dvec3();
                points.push(Point { index: points.len() as u64, position, normal: Vec3::Y });
            }
        }
        stream.rewind()?;
        Ok(points)
    }
}
