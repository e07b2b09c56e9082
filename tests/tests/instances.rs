//! Copies that share bricks against the same copies expanded: the same light, from a fraction of the bytes.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use engine::ErrorKind;
use engine::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
use engine::cut::Lod;
use engine::scene::{Procedural, ProceduralKind, ShOcclusion};
use engine::stream::adapt::{Instance, MatrixList};
use engine::stream::procedural::ProceduralStream;
use engine::stream::schema::UpAxis;
use engine::trace::{Backend, Device, TraceOptions};
use glam::{DMat4, DVec3, Vec3};
use tests::{MemoryStream, Setup, points_of, trace};

/// Copies of a prototype: turned, mirrored, sheared, small and large ones, about `origin`.
fn copies(origin: DVec3, count: usize, spacing: f64) -> Vec<DMat4> {
    let copy = |i: usize| {
        let at = DVec3::new((i % 6) as f64, ((i / 6) % 3) as f64 * 0.2, (i / 6) as f64) * spacing;
        let turn = DMat4::from_axis_angle(DVec3::new(0.3, 1.0, 0.2).normalize(), 1.7 * i as f64);
        let scale = [1.0, 0.4, 2.5][i % 3];
        let size = DVec3::splat(scale) * if i % 4 == 1 { DVec3::new(-1.0, 1.0, 1.0) } else { DVec3::ONE };
        let mut shear = DMat4::IDENTITY;
        if i % 5 == 2 {
            shear.y_axis.x = 0.5;
            shear.z_axis.z = 0.7;
        }
        DMat4::from_translation(origin + at) * turn * shear * DMat4::from_scale(size)
    };
    (0..count).map(copy).collect()
}

fn jungle(seed: u32, micropolygons: u64) -> ProceduralStream {
    let kind = Procedural { kind: ProceduralKind::Jungle, seed: seed.into(), micropolygons };
    ProceduralStream::new(&kind, 1.0, UpAxis::Y).unwrap()
}

fn ground(origin: DVec3) -> MemoryStream {
    let mut ground = MemoryStream::new();
    ground.push_sheet(origin - DVec3::new(50.0, 3.0, 50.0), DVec3::Z * 200.0, DVec3::X * 200.0, 60, 1.0);
    ground
}

struct Machine {
    far_field: FarField,
    threads: usize,
    memory_bytes: u64,
    /// Calls of progress in the stage of building after which the build is cancelled.
    cancel_after: u32,
}

const PLAIN: Machine =
    Machine { far_field: FarField::Directional, threads: 2, memory_bytes: 1 << 29, cancel_after: u32::MAX };

/// Builds a ground and copies of two prototypes, shared or expanded.
fn build_scene(origin: DVec3, shares: bool, machine: &Machine, target: &Path) -> engine::Result<()> {
    let scratch = tempfile::tempdir().unwrap();
    let options = BuildOptions {
        memory_bytes: machine.memory_bytes,
        threads: machine.threads,
        scratch: scratch.path().to_path_buf(),
        far_field: machine.far_field,
    };
    let (cancel, calls) = (AtomicBool::new(false), AtomicU32::new(0));
    let progress = |stage: &str, _: f64| {
        if stage == "build" && calls.fetch_add(1, Ordering::Relaxed) >= machine.cancel_after {
            cancel.store(true, Ordering::Relaxed);
        }
    };
    let mut sources = [(1, 0.0), (2, 20.0)].map(|(seed, aside)| {
        (jungle(seed, 60_000), MatrixList::new(copies(origin + DVec3::X * aside, 20, 17.0)))
    });
    let mut ground = ground(origin);
    if shares {
        let mut occluders = vec![OccluderStream::once(&mut ground)];
        for (stream, matrices) in &mut sources {
            occluders.push(OccluderStream { stream, instances: Some(matrices), continues: false });
        }
        return build(&mut occluders, &options, target, &progress, &cancel).map(|_| ());
    }
    let mut expanded = sources.map(|(stream, matrices)| Instance::new(stream, matrices).unwrap());
    let mut occluders = vec![OccluderStream::once(&mut ground)];
    expanded.iter_mut().for_each(|stream| occluders.push(OccluderStream::once(stream)));
    build(&mut occluders, &options, target, &progress, &cancel).map(|_| ())
}

fn open_scene(origin: DVec3, shares: bool, far_field: FarField) -> (tempfile::TempDir, Arc<BrickMap>) {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("map");
    build_scene(origin, shares, &Machine { far_field, ..PLAIN }, &target).unwrap();
    let map = Arc::new(BrickMap::open(&target).unwrap());
    assert_eq!(map.manifest().instances, if shares { 40 } else { 0 });
    (folder, map)
}

/// Points on the copies and on the ground.
fn points(origin: DVec3) -> Vec<(DVec3, Vec3)> {
    let matrices = MatrixList::new(copies(origin, 20, 17.0));
    let mut points = points_of(&mut Instance::new(jungle(1, 60_000), matrices).unwrap(), 400);
    points.extend((0..100).map(|i| {
        let at = DVec3::new(f64::from(i % 10) * 9.1, -3.0, f64::from(i / 10) * 7.3);
        (origin + at, Vec3::Y)
    }));
    points
}

/// Mean of `a - b` over the coefficients of band 0, and the root of the mean square over all, as shares of the mean of `a`.
fn difference(a: &[Vec<f32>], b: &[Vec<f32>]) -> (f64, f64) {
    let mean = a.iter().map(|v| f64::from(v[0])).sum::<f64>() / a.len() as f64;
    let bias = a.iter().zip(b).map(|(a, b)| f64::from(a[0] - b[0])).sum::<f64>() / a.len() as f64;
    let squares = a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2));
    (bias / mean, (squares.sum::<f64>() / a.len() as f64).sqrt() / mean)
}

/// Catches a copy that is missing, at the wrong place, turned or lit wrongly, shadows itself, or is closed too early; near the
/// origin and a thousand kilometres away, with either far field.
#[test]
fn shared_copies_bake_as_expanded_ones() {
    for (origin, far_field) in
        [(DVec3::ZERO, FarField::Directional), (DVec3::new(1e6, 2e5, -1e6), FarField::Paper)]
    {
        let (_shared_folder, shared) = open_scene(origin, true, far_field);
        let (_expanded_folder, expanded) = open_scene(origin, false, far_field);
        assert!(shared.manifest().micropolygons.abs_diff(expanded.manifest().micropolygons) < 1000);
        assert!(8 * shared.bytes() < expanded.bytes(), "{} of {}", shared.bytes(), expanded.bytes());
        let (points, shader) = (points(origin), ShOcclusion { samples: 256, ..ShOcclusion::default() });
        let of = |map: &Arc<BrickMap>, lod| {
            trace(map, &points, &shader, Some(1), Setup { lod, threads: 2, ..Setup::default() })
        };
        let (full, full_expanded) = (of(&shared, Lod::Off), of(&expanded, Lod::Off));
        let (bias, error) = difference(&full_expanded, &full);
        eprintln!("{far_field:?}, full detail: bias {bias:.5}, error {error:.5}");
        assert!(bias.abs() < 0.003 && error < 0.03, "{far_field:?}: {bias}, {error}");

        let lod = Lod::Footprint { quality: 1.0 };
        let (own_bias, own_error) = difference(&full, &of(&shared, lod));
        let (flat_bias, flat_error) = difference(&full_expanded, &of(&expanded, lod));
        eprintln!("{far_field:?}, footprint: {own_bias:.4}, {own_error:.4}; {flat_bias:.4}, {flat_error:.4}");
        assert!(own_error < 1.25 * flat_error + 0.01, "{far_field:?}: {own_error} and {flat_error}");
        assert!(own_bias.abs() < flat_bias.abs() + 0.01, "{far_field:?}: {own_bias} and {flat_bias}");
    }
}

/// Catches rays that lose their instance, or a cut that lacks a brick, when the arena is smaller than the cut; and bytes or bakes
/// that depend on threads or memory.
#[test]
fn neither_arena_nor_threads_nor_memory_change_anything() {
    let folder = tempfile::tempdir().unwrap();
    let paths = [(1, 256 << 20), (3, 1 << 30)].map(|(threads, memory_bytes)| {
        let target = folder.path().join(threads.to_string());
        build_scene(DVec3::ZERO, true, &Machine { threads, memory_bytes, ..PLAIN }, &target).unwrap();
        target
    });
    for name in ["manifest.json", "directory", "segment.0000"] {
        assert!(
            std::fs::read(paths[0].join(name)).unwrap() == std::fs::read(paths[1].join(name)).unwrap(),
            "{name}"
        );
    }
    let map = Arc::new(BrickMap::open(&paths[0]).unwrap());
    let (points, shader) = (points(DVec3::ZERO), ShOcclusion { samples: 64, ..ShOcclusion::default() });
    for lod in [Lod::Off, Lod::Footprint { quality: 1.0 }, Lod::Paper] {
        let of = |arena_bytes, threads| {
            trace(&map, &points, &shader, Some(1), Setup { lod, threads, arena_bytes, ..Setup::default() })
        };
        assert!(map.bytes() > 1 << 20);
        assert_eq!(of(1 << 28, 1), of(1 << 20, 2), "{lod}");
    }
}

/// Catches a build with prototypes that does not continue where it was cancelled, or comes out otherwise.
#[test]
fn an_interrupted_build_continues() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    build_scene(DVec3::ZERO, true, &PLAIN, &whole).unwrap();
    let target = folder.path().join("parted");
    for cancel_after in 1..4 {
        let error = build_scene(DVec3::ZERO, true, &Machine { cancel_after, ..PLAIN }, &target);
        assert!(error.is_ok() || error.unwrap_err().kind() == ErrorKind::Cancelled);
    }
    build_scene(DVec3::ZERO, true, &PLAIN, &target).unwrap();
    for name in ["manifest.json", "directory", "segment.0000"] {
        assert!(
            std::fs::read(whole.join(name)).unwrap() == std::fs::read(target.join(name)).unwrap(),
            "{name}"
        );
    }
}

/// Catches a device that would trace such a map wrongly in silence.
#[test]
fn devices_leave_shared_copies_to_the_cpu() {
    let (_folder, map) = open_scene(DVec3::ZERO, true, FarField::Paper);
    let options = || TraceOptions {
        lod: Lod::Off,
        seed: 1,
        threads: 1,
        instructions: engine::brick::lanes::InstructionSet::detect(),
    };
    let backend = Backend::new(Device::Auto, map.clone(), 1 << 28, options(), 1.0).unwrap();
    assert_eq!(backend.name, "cpu");
    assert!(backend.reason.contains("share bricks"), "{}", backend.reason);
    let error = Backend::new("gpu:0".parse().unwrap(), map, 1 << 28, options(), 1.0).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Unsupported);
}
