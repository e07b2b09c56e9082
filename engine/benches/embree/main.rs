//! The tracer beside Embree: same scene, points, directions and threads, alternating in one run.
//!
//! `cargo bench -p engine --bench embree -- [--scene NAME]... [--lod LOD]... [--embree PATH] [--farfield KIND] [--threads N]
//! [--repeats N] [--maps FOLDER]`
//!
//! Embree 4 is found at run time (`libembree4.so.4` by default; the library inside the Python wheel `embreex` serves as
//! well); without it only the tracer is timed. Points are whole batches: 2048 neighbours around each of a few places,
//! along the Hilbert curve. Embree's time has neither the making of rays nor their projection in it, the tracer's
//! has both. Rates are per second of CPU time, so that other work on the machine counts only where it takes caches and
//! clock. Files are looked for in `$PANTARAY_ASSETS`; brick maps stay in the folder given by `--maps`.

mod library;
mod scenes;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use engine::batch::{HilbertCurve, Point};
use engine::brick::bundle::Bundle;
use engine::brick::lanes::InstructionSet;
use engine::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
use engine::cut::{Arena, Lod};
use engine::math::Bounds;
use engine::scene::ShOcclusion;
use engine::shade::sample::{Sampler, Spread};
use engine::shade::sh_occlusion::half_split_error;
use engine::stream::{Microgrid, MicrogridStream};
use engine::trace::{BatchCounts, Shading, SphericalTracer, TraceOptions, bake_set_hash};
use glam::{DVec3, Vec3};
use library::{QUERIES, Scene};

/// Points of a batch.
const BATCH_POINTS: usize = 2048;
/// Seed of the rays, and the name that they depend on.
const SEED: u64 = 1;
const NAME: &str = "bench";

struct Arguments {
    scenes: Vec<String>,
    lods: Vec<Lod>,
    embree: String,
    threads: usize,
    repeats: usize,
    batches: usize,
    rays: u32,
    errors: bool,
    maps: Option<PathBuf>,
    far_field: FarField,
}

impl Arguments {
    fn read() -> Self {
        let mut read = Self {
            scenes: Vec::new(),
            lods: Vec::new(),
            embree: "libembree4.so.4".into(),
            threads: 1,
            repeats: 3,
            batches: 3,
            rays: 512,
            errors: false,
            maps: None,
            far_field: FarField::Paper,
        };
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            let mut value = || words.next().unwrap_or_else(|| panic!("{word} needs a value"));
            match word.as_str() {
                "--scene" => read.scenes.push(value()),
                "--lod" => read.lods.push(Lod::parse(&value()).expect("a level of detail")),
                "--embree" => read.embree = value(),
                "--threads" => read.threads = value().parse().expect("a number"),
                "--repeats" => read.repeats = value().parse().expect("a number"),
                "--batches" => read.batches = value().parse().expect("a number"),
                "--rays" => read.rays = value().parse().expect("a number"),
                "--farfield" => read.far_field = value().parse().expect("a far field"),
                "--maps" => read.maps = Some(value().into()),
                "--errors" => read.errors = true,
                "--bench" => {}
                _ => panic!("`{word}` is no option"),
            }
        }
        if read.scenes.is_empty() {
            read.scenes = scenes::SCENES.iter().map(|(name, _)| (*name).into()).collect();
            read.scenes.retain(|name| name != "foliage50m");
        }
        if read.lods.is_empty() {
            read.lods = ["off", "footprint"].map(|lod| Lod::parse(lod).expect("a level of detail")).into();
        }
        read
    }
}

fn main() {
    let arguments = Arguments::read();
    let assets = std::env::var_os("PANTARAY_ASSETS").map(PathBuf::from);
    println!(
        "| scene | micropolygons | bytes each | what | M rays/s/core | x Embree | V_00 | RMSE to off | RMSE to 16k | half-split error | visits a ray: nodes, leaves | tests a ray: nodes, leaves |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    for name in &arguments.scenes {
        match scenes::scene(name, assets.as_deref()) {
            Some(mut stream) => compare(name, stream.as_mut(), &arguments),
            None => println!("| {name} | not there | | | | | | | | | | |"),
        }
    }
}

/// What is compared on one scene.
struct Bench {
    map: Arc<BrickMap>,
    batches: Vec<Vec<Point>>,
    shader: ShOcclusion,
    threads: usize,
}

fn compare(name: &str, stream: &mut dyn MicrogridStream, arguments: &Arguments) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let batches = batches(stream, arguments.batches);
    let kept = arguments.maps.as_ref().map(|maps| maps.join(format!("{name}-{:?}", arguments.far_field)));
    let map = build_map(stream, kept.as_deref().unwrap_or(folder.path()), arguments.far_field);
    let (triangles, embree) = embree(stream, &arguments.embree);
    let shader = ShOcclusion { samples: arguments.rays, ..ShOcclusion::default() };
    let bench = Bench { map, batches, shader, threads: arguments.threads };
    let rays: u64 = bench.batches.iter().map(|b| b.len() as u64 * u64::from(arguments.rays)).sum();

    // All in turn, so that what else the machine does meets all of them
    let mut tracers: Vec<_> = arguments.lods.iter().map(|&lod| bench.tracer(lod)).collect();
    let mut seconds = vec![Vec::new(); QUERIES.len() + tracers.len()];
    let mut found = vec![(Vec::new(), BatchCounts::default()); tracers.len()];
    for _ in 0..arguments.repeats {
        if let Some(embree) = &embree {
            for (query, seconds) in QUERIES.iter().zip(&mut seconds) {
                seconds.push(bench.embree(embree, *query));
            }
        }
        for (i, tracer) in tracers.iter_mut().enumerate() {
            let start = cpu_seconds(Clock::Process);
            found[i] = bench.trace(tracer);
            seconds[QUERIES.len() + i].push(cpu_seconds(Clock::Process) - start);
        }
    }

    let rate = |seconds: &[f64]| {
        let mut sorted = seconds.to_vec();
        sorted.sort_by(f64::total_cmp);
        rays as f64 / sorted[sorted.len() / 2] * 1e-6
    };
    let polygons = bench.map.manifest().micropolygons;
    let bytes = bench.map.bytes() as f64 / polygons as f64;
    let best = embree.as_ref().map(|_| {
        let rates = QUERIES.iter().zip(&seconds).map(|(query, seconds)| (rate(seconds), query));
        let (best, query) = rates.max_by(|a, b| a.0.total_cmp(&b.0)).expect("there are queries");
        println!("| {name} | {triangles} triangles | | Embree, {query:?} | {best:.2} | 1 | | | | | | |");
        best
    });
    let reference = arguments.errors.then(|| bench.reference());
    for (i, lod) in arguments.lods.iter().enumerate() {
        let (rate, (values, counts)) = (rate(&seconds[QUERIES.len() + i]), &found[i]);
        let ratio = best.map_or("-".into(), |best| format!("{:.2}", rate / best));
        let mean = values.iter().step_by(9).map(|&v| f64::from(v)).sum::<f64>() / (values.len() / 9) as f64;
        let to = |other: Option<&Vec<f32>>| {
            other.map_or("-".into(), |other| format!("{:.4}", rmse(values, other)))
        };
        println!(
            "| {name} | {polygons} | {bytes:.1} | `--lod {lod}` | {rate:.2} | {ratio} | {mean:.4} | {} | {} | {} | {:.2}, {:.2} | {:.1}, {:.1} |",
            to((i > 0).then_some(&found[0].0)),
            to(reference.as_ref()),
            if arguments.errors {
                format!("{:.4}", bench.half_split_error(&mut tracers[i]))
            } else {
                "-".into()
            },
            counts.walk.nodes as f64 / rays as f64,
            counts.walk.leaves as f64 / rays as f64,
            counts.walk.node_rays as f64 / rays as f64,
            counts.walk.leaf_rays as f64 / rays as f64,
        );
    }
}

/// What a processor's time is measured of.
#[derive(Clone, Copy)]
enum Clock {
    Process = 2,
    Thread = 3,
}

/// Seconds of CPU time so far.
fn cpu_seconds(clock: Clock) -> f64 {
    unsafe extern "C" {
        fn clock_gettime(clock: i32, time: *mut [i64; 2]) -> i32;
    }
    let mut time = [0; 2];
    // SAFETY: two 64-bit numbers are what 64-bit Linux writes
    unsafe { clock_gettime(clock as i32, &mut time) };
    time[0] as f64 + time[1] as f64 * 1e-9
}

fn rmse(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    (sum / a.len() as f64).sqrt()
}

impl Bench {
    fn tracer(&self, lod: Lod) -> SphericalTracer {
        let arena = Arena::new(self.map.clone(), self.map.bytes() + (64 << 20), lod == Lod::Off);
        let instructions = InstructionSet::detect();
        let options = TraceOptions { lod, seed: SEED, threads: self.threads, instructions };
        SphericalTracer::new(arena.expect("the arena fits"), options, 1.0)
    }

    /// Coefficients of all points, and what was counted.
    fn trace(&self, tracer: &mut SphericalTracer) -> (Vec<f32>, BatchCounts) {
        self.trace_with(tracer, &self.shader)
    }

    fn trace_with(&self, tracer: &mut SphericalTracer, shader: &ShOcclusion) -> (Vec<f32>, BatchCounts) {
        self.shade(tracer, &Shading::new(shader, SEED, NAME, self.map.shift(0)))
    }

    /// The root mean square of what the points' own rays say about their error.
    fn half_split_error(&self, tracer: &mut SphericalTracer) -> f64 {
        let shading = Shading::new(&self.shader, SEED, NAME, self.map.shift(0)).with_halves();
        let (values, _) = self.shade(tracer, &shading);
        let points = values.chunks_exact(shading.values());
        let squares = points
            .clone()
            .map(|values| f64::from(half_split_error(&values[shading.coefficients()..])).powi(2));
        (squares.sum::<f64>() / points.len() as f64).sqrt()
    }

    fn shade(&self, tracer: &mut SphericalTracer, shading: &Shading) -> (Vec<f32>, BatchCounts) {
        let (mut all, mut counts) = (Vec::new(), BatchCounts::default());
        for batch in &self.batches {
            let start = all.len();
            all.resize(start + batch.len() * shading.values(), 0.0);
            let batch = tracer.trace(batch, shading, &AtomicBool::new(false), &mut all[start..]);
            let batch = batch.expect("the batch traces");
            counts.walk += batch.walk;
            counts.select_seconds += batch.select_seconds;
        }
        (all, counts)
    }

    /// Coefficients by 16,384 rays a point, everything opened.
    fn reference(&self) -> Vec<f32> {
        let shader = ShOcclusion { samples: 16_384, ..self.shader.clone() };
        self.trace_with(&mut self.tracer(Lod::Off), &shader).0
    }

    /// CPU seconds that all points take with a query of Embree's, on as many threads.
    fn embree(&self, scene: &Scene, query: library::Query) -> f64 {
        let sampler = Sampler::new(self.shader.samples, SEED, bake_set_hash(NAME));
        let points: Vec<&Point> = self.batches.iter().flatten().collect();
        let next = AtomicUsize::new(0);
        let work = || {
            let (mut bundle, mut hit, mut seconds) =
                (Bundle::new(), vec![false; sampler.samples() as usize], 0.0);
            loop {
                let at = next.fetch_add(16, Ordering::Relaxed);
                if at >= points.len() {
                    return seconds;
                }
                for point in &points[at..points.len().min(at + 16)] {
                    bundle.clear(f32::INFINITY, 0.0);
                    bundle.push_origin(glam::IVec3::ZERO);
                    let spread = Spread::new(&self.shader, true);
                    sampler.push_rays(point.index, point.normal, spread, 0..sampler.samples(), &mut bundle);
                    let origin = (point.position + 1e-4 * point.normal.as_dvec3()).as_vec3().to_array();
                    let start = cpu_seconds(Clock::Thread);
                    scene.occluded(query, origin, 1e-4, &bundle.directions, &mut hit);
                    seconds += cpu_seconds(Clock::Thread) - start;
                    std::hint::black_box(&hit);
                }
            }
        };
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..self.threads).map(|_| scope.spawn(work)).collect();
            threads.into_iter().map(|t| t.join().expect("a thread ends")).sum()
        })
    }
}

fn build_map(
    stream: &mut dyn MicrogridStream,
    folder: &std::path::Path,
    far_field: FarField,
) -> Arc<BrickMap> {
    let options = BuildOptions {
        memory_bytes: 1 << 30,
        threads: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        scratch: folder.join("scratch"),
        far_field,
    };
    let target = folder.join("map");
    if target.exists() {
        return Arc::new(BrickMap::open(&target).expect("the map opens"));
    }
    std::fs::create_dir_all(&options.scratch).expect("a folder can be made");
    let mut streams = [OccluderStream::once(stream)];
    build(&mut streams, &options, &target, &|_, _| {}, &AtomicBool::new(false)).expect("the map builds");
    Arc::new(BrickMap::open(&target).expect("the map opens"))
}

/// Reads all of a stream.
fn for_each(stream: &mut dyn MicrogridStream, mut each: impl FnMut(&Microgrid)) {
    let mut grid = Microgrid::default();
    stream.rewind().expect("the stream starts again");
    while stream.next(&mut grid).expect("the stream can be read") {
        each(&grid);
    }
}

/// How many triangles there are, and Embree's tree over them.
fn embree(stream: &mut dyn MicrogridStream, library: &str) -> (usize, Option<Scene>) {
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for_each(stream, |grid| {
        let base = vertices.len() as u32;
        vertices.extend((0..grid.vertex_count()).map(|v| grid.position(v).as_vec3().to_array()));
        for face in grid.faces() {
            let corner = |i: usize| base + u32::from(face[i]);
            triangles.push([corner(0), corner(1), corner(2)]);
            if face.len() == 4 {
                triangles.push([corner(0), corner(2), corner(3)]);
            }
        }
    });
    // Embree reads a little past the last vertex
    vertices.push([0.0; 3]);
    (triangles.len(), Scene::build(library, &vertices, &triangles))
}

/// Whole batches around some vertices, each with its faces' normal.
fn batches(stream: &mut dyn MicrogridStream, count: usize) -> Vec<Vec<Point>> {
    // Pick places evenly along the stream
    let mut grids = 0_usize;
    for_each(stream, |_| grids += 1);
    let mut places = Vec::new();
    let mut number = 0;
    for_each(stream, |grid| {
        if (1..=count).any(|place| number == grids * place / (count + 1)) {
            places.push(grid.position(grid.vertex_count() / 2));
        }
        number += 1;
    });

    // Keep the nearest vertices of each place
    let mut near: Vec<Vec<(f64, Point)>> = vec![Vec::new(); places.len()];
    let mut index = 0;
    for_each(stream, |grid| {
        let normals = normals(grid);
        for (vertex, &normal) in normals.iter().enumerate() {
            let position = grid.position(vertex);
            for (place, near) in places.iter().zip(&mut near) {
                let distance: f64 = position.distance_squared(*place);
                near.push((distance, Point { index, position, normal }));
                if near.len() == 4 * BATCH_POINTS {
                    near.select_nth_unstable_by(BATCH_POINTS, |a, b| a.0.total_cmp(&b.0));
                    near.truncate(BATCH_POINTS);
                }
            }
            index += 1;
        }
    });
    near.into_iter()
        .map(|mut near| {
            near.sort_by(|a, b| a.0.total_cmp(&b.0));
            near.truncate(BATCH_POINTS);
            let mut bounds = Bounds::EMPTY;
            near.iter().for_each(|(_, point)| bounds.add(point.position));
            let curve = HilbertCurve::new(&bounds);
            let mut points: Vec<Point> = near.into_iter().map(|(_, point)| point).collect();
            points.sort_by_key(|point| (curve.key(point.position), point.index));
            points
        })
        .collect()
}

/// Normals of a grid's vertices: of the first face that has them, as its corners turn.
fn normals(grid: &Microgrid) -> Vec<Vec3> {
    let mut normals = vec![Vec3::Z; grid.vertex_count()];
    for face in grid.faces() {
        let [a, b, c] = [0, 1, 2].map(|i| grid.position(usize::from(face[i])));
        let normal: DVec3 = (b - a).cross(c - a).normalize_or(DVec3::Z);
        face.iter().for_each(|&v| normals[usize::from(v)] = normal.as_vec3());
    }
    normals
}
