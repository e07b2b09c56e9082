//! The kernels against their twins and the CPU: text and layout without a device, results on software Vulkan.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::{DVec3, IVec3, Vec3};

use super::shader::{Dialect, Pages};
use super::{Adapter, AdapterKind, Gpu, GpuTracer, adapters};
use crate::batch::Point;
use crate::brick::BYTES_MAX;
use crate::brick::bundle::Bundle;
use crate::brick::lanes::InstructionSet;
use crate::brick::walk::{Scratch, Start, walk};
use crate::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
use crate::cut::{Arena, Lod};
use crate::math::hash::{hash32, unit_f32};
use crate::scene::{Domain, Procedural, ProceduralKind, ShOcclusion, Weight};
use crate::shade::sample::Spread;
use crate::stream::procedural::ProceduralStream;
use crate::stream::schema::UpAxis;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Schema, ValueType};
use crate::trace::kernel::{Item, KernelRay, trace};
use crate::trace::{BatchCounts, Shading, SphericalTracer, TraceOptions};
use crate::{ErrorKind, Result};

/// All dialects.
fn dialects() -> Vec<Dialect> {
    let mut all = Vec::new();
    for wide in [false, true] {
        for (has_double, is_exact) in [(false, false), (true, false), (true, true)] {
            all.push(Dialect { wide, has_double, is_exact });
        }
    }
    all
}

fn parsed(source: &str) -> naga::Module {
    naga::front::wgsl::parse_str(source).unwrap_or_else(|error| panic!("{}", error.emit_to_string(source)))
}

/// Catches a shader that some adapter would refuse: every one there is, parsed and validated without a device.
#[test]
fn every_shader_is_valid() {
    use naga::valid::{Capabilities, SubgroupOperationSet, ValidationFlags, Validator};
    for dialect in dialects() {
        let mut capabilities = Capabilities::empty();
        capabilities.set(Capabilities::FLOAT64, dialect.has_double);
        capabilities.set(Capabilities::SUBGROUP, dialect.wide);
        let mut sources = vec![dialect.projection()];
        sources.extend([1, 2, 8].map(|count| dialect.kernel(Pages { count, bytes: 1 << 20 })));
        for source in sources {
            let module = parsed(&source);
            let mut validator = Validator::new(ValidationFlags::all(), capabilities);
            validator.subgroup_stages(naga::valid::ShaderStages::COMPUTE);
            validator.subgroup_operations(SubgroupOperationSet::all());
            if let Err(error) = validator.validate(&module) {
                panic!("{dialect:?}: {}", error.emit_to_string(&source));
            }
        }
    }
}

/// Catches a record that host and kernels read differently: every member's offset, every size.
#[test]
fn records_have_the_offsets_of_the_shaders() {
    use std::mem::offset_of;

    use super::records::{BatchRecord, GroupRecord, ItemRecord, PointRecord};
    macro_rules! offsets {
        ($record:ty: $($member:ident)*) => {
            (size_of::<$record>(), vec![$((stringify!($member), offset_of!($record, $member))),*])
        };
    }
    let records = [
        (
            "Batch",
            offsets!(BatchRecord: open2 reach reach2 near step measure_hemisphere measure_cosine measure_sphere is_limited
                samples slices first points items capacity budget bands root zero unused),
        ),
        ("Point", offsets!(PointRecord: origin group normal hash cosine sine frame spread)),
        ("Group", offsets!(GroupRecord: reference unused_a lower unused_b upper unused_c)),
        ("Item", offsets!(ItemRecord: ray line order)),
    ];
    let dialect = Dialect { wide: false, has_double: false, is_exact: false };
    let module = parsed(&dialect.kernel(Pages { count: 1, bytes: 1 << 20 }));
    for (name, (size, offsets)) in records {
        let ty = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name)).expect(name).1;
        let naga::TypeInner::Struct { members, span } = &ty.inner else { panic!("{name} is no struct") };
        assert_eq!(*span as usize, size, "{name}");
        let found: Vec<_> =
            members.iter().map(|m| (m.name.as_deref().unwrap_or_default(), m.offset as usize)).collect();
        assert_eq!(found, offsets, "{name}");
    }
}

/// A stream of grids in memory, with radius and opacity.
struct Grids {
    schema: Schema,
    grids: Vec<Microgrid>,
    next: usize,
}

impl MicrogridStream for Grids {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.next = 0;
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        let Some(source) = self.grids.get(self.next) else { return Ok(false) };
        grid.clone_from(source);
        self.next += 1;
        Ok(true)
    }
}

impl Grids {
    /// Points, lines, veils and soups of triangles in a box of some metres.
    fn mixed() -> Self {
        let attributes =
            ["radius", "opacity"].map(|name| Attribute::vertex(name, ValueType::F32, 1)).to_vec();
        let schema = Schema { attributes, ..Schema::default() };
        let mut seed = 17;
        let mut unit = || {
            seed = hash32(seed);
            f64::from(unit_f32(seed))
        };
        let mut grids = Vec::new();
        for number in 0..100_usize {
            let mut grid = Microgrid::default();
            grid.clear(2);
            grid.anchor = DVec3::new(3.0 * unit(), 2.0 * unit(), 3.0 * unit());
            let faces: Vec<Vec<u8>> = match number % 4 {
                0 => (0..9).map(|i| vec![i]).collect(),
                1 => (0..8).map(|i| vec![i, i + 1]).collect(),
                2 => (0..7).map(|i| vec![i, i + 1, i + 2]).collect(),
                _ => vec![vec![0, 1, 4, 3], vec![1, 2, 5, 4], vec![3, 4, 7, 6], vec![4, 5, 8, 7]],
            };
            for vertex in 0..9 {
                let (x, z) = ((vertex % 3) as f32 * 0.1, (vertex / 3) as f32 * 0.1);
                grid.positions.push(Vec3::new(x, 0.1 * unit() as f32, z));
            }
            faces.iter().for_each(|face| grid.push_face(face));
            let opacity = if number % 3 == 0 { 1.0 } else { 0.2 + 0.6 * unit() as f32 };
            let radii: Vec<f32> = (0..9).map(|_| 0.005 + 0.03 * unit() as f32).collect();
            grid.push_values(&schema.attributes[0], 0, &radii);
            grid.push_values(&schema.attributes[1], 1, &[opacity; 9]);
            grid.validate(&schema).unwrap();
            grids.push(grid);
        }
        Self { schema, grids, next: 0 }
    }
}

/// A map and points on its surfaces, some without a normal.
fn scene(folder: &Path, far_field: FarField) -> (Arc<BrickMap>, Vec<Point>) {
    let jungle = Procedural { kind: ProceduralKind::Jungle, seed: 3, micropolygons: 30_000 };
    let mut jungle = ProceduralStream::new(&jungle, 1.0, UpAxis::Y).unwrap();
    let mut mixed = Grids::mixed();
    let options =
        BuildOptions { memory_bytes: 256 << 20, threads: 2, scratch: folder.join("scratch"), far_field };
    std::fs::create_dir_all(&options.scratch).unwrap();
    let mut streams = [OccluderStream::once(&mut jungle), OccluderStream::once(&mut mixed)];
    build(&mut streams, &options, &folder.join("map"), &|_, _| {}, &AtomicBool::new(false)).unwrap();
    let mut grid = Microgrid::default();
    let mut points = Vec::new();
    mixed.rewind().unwrap();
    while mixed.next(&mut grid).unwrap() {
        for vertex in (0..9).step_by(2) {
            let index = points.len() as u64 * 0x1_0000_0001;
            let normal = match index % 5 {
                0 => Vec3::ZERO,
                1 => Vec3::new(0.3, -0.8, 0.1),
                _ => Vec3::Y,
            };
            let position = grid.anchor + grid.positions[vertex].as_dvec3();
            points.push(Point { index, position, normal });
        }
    }
    (Arc::new(BrickMap::open(&folder.join("map")).unwrap()), points)
}

/// The software adapter; says so if there is none, and fails where there must be one.
fn software() -> Option<Adapter> {
    let found = adapters().into_iter().find(|adapter| adapter.kind == AdapterKind::Software);
    if found.is_none() {
        assert!(std::env::var_os("PANTARAY_NEEDS_VULKAN").is_none(), "no software Vulkan on this machine");
        eprintln!("skipped: no software Vulkan; install mesa-vulkan-drivers and libvulkan1");
    }
    found
}

const SHADER: ShOcclusion = ShOcclusion {
    bands: 4,
    samples: 100,
    domain: Domain::Hemisphere,
    weight: Weight::Uniform,
    max_distance: None,
    storage: ValueType::F32,
};

fn cpu(map: &Arc<BrickMap>, lod: Lod, arena_bytes: u64) -> SphericalTracer {
    let arena = Arena::new(map.clone(), arena_bytes, lod == Lod::Off).unwrap();
    let options = TraceOptions { lod, seed: 1, threads: 2, instructions: InstructionSet::detect() };
    SphericalTracer::new(arena, options, 1.0)
}

/// A case of the parity tests: far field, level of detail, shader, bytes of a page, steps of a dispatch.
struct Case {
    far_field: FarField,
    lod: Lod,
    shader: ShOcclusion,
    page_bytes: u64,
    steps: u32,
}

fn cases() -> Vec<Case> {
    let far_field = FarField::Directional;
    let whole = |lod, shader| Case { far_field, lod, shader, page_bytes: 1 << 30, steps: 1 << 14 };
    let near = Lod::Footprint { quality: 1.0 };
    vec![
        whole(Lod::Off, SHADER),
        whole(near, SHADER),
        Case { far_field: FarField::Paper, ..whole(near, SHADER) },
        whole(Lod::Off, ShOcclusion { max_distance: Some(0.4), weight: Weight::Cosine, ..SHADER }),
        Case { page_bytes: 1 << 19, ..whole(Lod::Paper, ShOcclusion { domain: Domain::Sphere, ..SHADER }) },
        Case { steps: 7, ..whole(Lod::Footprint { quality: 2.0 }, ShOcclusion { bands: 6, ..SHADER }) },
    ]
}

/// What every ray of a batch loses, by the walk of bundles and by the kernel's twin; ended rays are all the same.
fn extinctions(cpu: &mut SphericalTracer, points: &[Point], shading: &Shading) -> [Vec<u32>; 2] {
    let open2 = cpu.prepare(points, shading).unwrap();
    let (setup, root) = (&open2.setup, cpu.arena_mut().map().root());
    assert!(open2.is_resident);
    let arena = &*cpu.arena_mut();
    let (mut walked, mut twins) = (Vec::new(), Vec::new());
    for piece in &setup.pieces {
        let mut bundle = Bundle::new();
        bundle.clear(setup.reach, setup.near);
        for point in piece.points.clone() {
            bundle.push_rounded_origin(setup.origins[point], setup.exact[point]);
            let (normal, spread) = shading.spread(points[point].normal);
            shading.sampler.push_rays(
                points[point].index,
                normal,
                spread,
                piece.samples.clone(),
                &mut bundle,
            );
        }
        let ended = |extinction: u32, limit: u32| if extinction > limit { u32::MAX } else { extinction };
        for ray in 0..bundle.len() {
            let (mut items, mut sum) = (vec![Item::Brick(root)], 0);
            while let Some(item) = items.pop() {
                let kernel_ray = KernelRay { bundle: &bundle, ray, open2: setup.open2, budget: 1 << 14 };
                let traced = trace(arena, kernel_ray, item, sum);
                sum += traced.extinction;
                items.extend(traced.items);
                if sum > bundle.limit[ray] {
                    break;
                }
            }
            twins.push(ended(sum, bundle.limit[ray]));
        }
        let rays: Vec<u16> = (0..bundle.len() as u16).collect();
        let instructions = InstructionSet::detect();
        let start = Start { brick: root, entrance: None };
        walk(arena, &start, &rays, setup.open2, &mut bundle, &mut Scratch::new(), instructions);
        walked.extend((0..bundle.len()).map(|ray| ended(bundle.extinction[ray], bundle.limit[ray])));
    }
    [walked, twins]
}

/// A tracer on software Vulkan, and the coefficients that the CPU gives.
fn pair(
    map: &Arc<BrickMap>,
    points: &[Point],
    lod: Lod,
    arena: u64,
    gpus: usize,
) -> Option<(GpuTracer, Vec<f32>)> {
    let adapter = software()?;
    let gpus = (0..gpus).map(|_| Gpu::open(&adapter, true).unwrap()).collect();
    let tracer = GpuTracer::new(cpu(map, lod, arena), gpus).unwrap();
    let shading = Shading::new(&SHADER, 1, "parity", 0);
    let mut expected = vec![0.0; points.len() * shading.coefficients()];
    cpu(map, lod, 1 << 28).trace(points, &shading, &AtomicBool::new(false), &mut expected).unwrap();
    Some((tracer, expected))
}

fn traced(tracer: &mut GpuTracer, points: &[Point], next: Option<&[Point]>) -> (BatchCounts, Vec<f32>) {
    let shading = Shading::new(&SHADER, 1, "parity", 0);
    let mut found = vec![0.0; points.len() * shading.coefficients()];
    let next = next.map(|points| (points, &shading));
    let counts = tracer.trace(points, &shading, next, &AtomicBool::new(false), &mut found).unwrap();
    (counts, found)
}

/// Catches rays that are lost when their bricks do not fit the arena, and bricks that the device does not learn of.
#[test]
fn a_cut_larger_than_the_arena_gives_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let (map, points) = scene(folder.path(), FarField::Directional);
    // The least arena that there can be
    let bytes = (16 * BYTES_MAX as u64).min(map.bytes());
    let Some((mut tracer, expected)) = pair(&map, &points, Lod::Off, bytes, 1) else { return };
    let (counts, found) = traced(&mut tracer, &points, None);
    assert!(counts.is_device && found == expected, "{:?}", tracer.troubles);
    assert!(map.bytes() <= bytes || counts.resumed > 0, "nothing waited: the test is empty");
}

/// Catches a share of a batch that is lost or computed twice when several devices have it, and a cut that is selected ahead
/// and used for another batch.
#[test]
fn devices_share_a_batch_and_look_ahead() {
    let folder = tempfile::tempdir().unwrap();
    let (map, points) = scene(folder.path(), FarField::Directional);
    let lod = Lod::Footprint { quality: 1.0 };
    let (first, second) = points.split_at(points.len() / 2);
    for gpus in [1, 2] {
        let Some((mut tracer, expected)) = pair(&map, first, lod, 1 << 28, gpus) else { return };
        let (counts, found) = traced(&mut tracer, first, Some(second));
        assert!(counts.is_device && found == expected, "{:?}", tracer.troubles);
        let (_, found) = traced(&mut tracer, second, Some(second));
        let (_, again) = traced(&mut tracer, first, None);
        let (_, expected_second) = pair(&map, second, lod, 1 << 28, 1).unwrap();
        assert!(found == expected_second && again == expected, "{gpus} devices");
    }
}

/// Catches a lost device that fails the bake, or whose half-done batch is taken for a result.
#[test]
fn a_lost_device_is_opened_again_and_then_given_up() {
    let folder = tempfile::tempdir().unwrap();
    let (map, points) = scene(folder.path(), FarField::Directional);
    let Some((mut tracer, expected)) = pair(&map, &points[..40], Lod::Off, 1 << 28, 1) else { return };
    tracer.gpu().unwrap().destroy();
    let (counts, found) = traced(&mut tracer, &points[..40], None);
    assert!(counts.is_device && found == expected, "{:?}", tracer.troubles);
    assert!(tracer.troubles.iter().any(|trouble| trouble.contains("lost")), "{:?}", tracer.troubles);

    // No room for what is left of rays: the batch stays incomplete, and the CPU traces it
    let runner = tracer.runner().unwrap();
    (runner.steps_max, runner.items_max) = (3, Some(2));
    let (counts, found) = traced(&mut tracer, &points[..45], None);
    assert!(!counts.is_device && found[..expected.len()] == expected, "{:?}", tracer.troubles);
    assert!(tracer.troubles.iter().any(|trouble| trouble.contains("incomplete")));
}

/// Catches a cancel that waits for the end of the batch.
#[test]
fn a_cancel_ends_a_batch() {
    let folder = tempfile::tempdir().unwrap();
    let (map, points) = scene(folder.path(), FarField::Directional);
    let Some((mut tracer, _)) = pair(&map, &points[..8], Lod::Off, 1 << 28, 1) else { return };
    let shading = Shading::new(&SHADER, 1, "parity", 0);
    let mut found = vec![0.0; points.len() * shading.coefficients()];
    let error = tracer.trace(&points, &shading, None, &AtomicBool::new(true), &mut found).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Cancelled);
}

/// Catches kernels that depend on the number of lanes of a subgroup: the parity test again, in processes whose driver has
/// other ones.
#[test]
fn kernels_do_not_depend_on_the_size_of_subgroups() {
    let Some(Adapter { subgroup: Some([_, normal]), .. }) = software() else { return };
    let mut sizes = vec![normal];
    for bits in ["128", "512"] {
        let test = "trace::gpu::tests::kernels_meet_what_the_cpu_meets";
        let run = |name: &str| {
            std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", name, "--nocapture"])
                .env("LP_NATIVE_VECTOR_WIDTH", bits)
                .output()
                .unwrap()
        };
        let output = run(test);
        let text =
            String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && text.contains("1 passed"), "{bits} bits: {text}");
        let size = text.split("lanes of a subgroup: ").nth(1).and_then(|rest| rest.split_whitespace().next());
        sizes.push(size.and_then(|size| size.parse().ok()).expect("the test says its size"));
    }
    sizes.sort_unstable();
    sizes.dedup();
    eprintln!("sizes of subgroups: {sizes:?}");
    assert!(sizes.len() > 1, "the driver has one size only: the test is empty");
}

/// Catches a twin, or a kernel of any dialect, that meets anything else than the walk of bundles on the CPU, ray by ray, and
/// coefficients that differ in a single bit.
#[test]
fn kernels_meet_what_the_cpu_meets() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let paper = scene(folders[0].path(), FarField::Paper);
    let directional = scene(folders[1].path(), FarField::Directional);
    let adapter = software();
    let subgroup = adapter.as_ref().and_then(|adapter| adapter.subgroup);
    eprintln!("lanes of a subgroup: {}", subgroup.map_or(0, |[_, largest]| largest));
    for (number, case) in cases().into_iter().enumerate() {
        let (map, points) = if case.far_field == FarField::Paper { &paper } else { &directional };
        let shading = Shading::new(&case.shader, 1, "parity", 0);
        let samples = case.shader.samples as usize;
        let mut reference = cpu(map, case.lod, 1 << 28);
        let [walked, twins] = extinctions(&mut reference, points, &shading);
        let mut expected = vec![0.0; points.len() * shading.coefficients()];
        reference.trace(points, &shading, &AtomicBool::new(false), &mut expected).unwrap();
        let hits = walked.iter().filter(|&&extinction| extinction > 0).count();
        assert!(
            hits > walked.len() / 10 && hits < walked.len(),
            "case {number}: {hits} hits, the test is empty"
        );
        let different = |other: &[u32]| walked.iter().zip(other).filter(|(a, b)| a != b).count();
        assert_eq!(different(&twins), 0, "case {number}: the twin");
        let Some(adapter) = &adapter else { continue };
        for wide in [false, true] {
            let gpu = Gpu::open(adapter, wide).unwrap();
            let mut tracer =
                GpuTracer::with_pages(cpu(map, case.lod, 1 << 28), vec![gpu], case.page_bytes).unwrap();
            tracer.runner().unwrap().steps_max = case.steps;
            let mut found = vec![0.0; expected.len()];
            let counts = tracer.trace(points, &shading, None, &AtomicBool::new(false), &mut found).unwrap();
            assert!(counts.is_device, "{:?}", tracer.troubles);
            let limit = |ray: usize| {
                let mut bundle = Bundle::new();
                bundle.push_origin(IVec3::ZERO);
                let (sample, index) = ((ray % samples) as u32, points[ray / samples].index);
                let one = sample..sample + 1;
                shading.sampler.push_rays(index, Vec3::Y, Spread::Sphere, one, &mut bundle);
                bundle.limit[0]
            };
            let rays: Vec<u32> = tracer
                .extinctions(walked.len() as u64)
                .unwrap()
                .into_iter()
                .enumerate()
                .map(|(ray, extinction)| if extinction > limit(ray) { u32::MAX } else { extinction })
                .collect();
            assert_eq!(different(&rays), 0, "case {number}, wide {wide}: {} rays", walked.len());
            let same = expected.iter().zip(&found).filter(|(a, b)| a.to_bits() == b.to_bits()).count();
            assert_eq!(same, expected.len(), "case {number}, wide {wide}: coefficients");
            assert_eq!(case.steps < 100, counts.resumed > 0, "case {number}: rays that go on");
        }
    }
}
