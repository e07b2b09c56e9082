//! Tests of the whole builder: nothing lost, nothing doubled, the same bytes whatever the machine, no trust in files.

mod scenes;

use std::collections::BTreeMap;
use std::sync::Mutex;

use glam::{DVec3, Vec3};
use scenes::{Grids, Random, Shape, expected, message, mixed, shape};

use super::*;
use crate::brick::leaf::{Layout, READ_PAST_BYTES};
use crate::brick::{BYTES_MAX, Brick, Child, LatticeBox};
use crate::stream::Microgrid;

fn build_in(
    folder: &Path,
    scene: &mut [Grids],
    limits: &Limits,
    threads: usize,
    memory_mib: u64,
) -> Result<BuildReport> {
    let mut occluders: Vec<OccluderStream<'_>> =
        scene.iter_mut().map(|grids| OccluderStream { stream: grids }).collect();
    let options = BuildOptions {
        memory_bytes: memory_mib << 20,
        threads,
        scratch: folder.join("scratch"),
        far_field: FarField::Paper,
    };
    let cancel = AtomicBool::new(false);
    build_within(&mut occluders, &options, limits, &folder.join("map"), &|_, _| {}, &cancel)
}

/// Limits that make many partitions, bricks and segments of a small scene.
fn tiny() -> Limits {
    Limits {
        partition_micropolygons: 700,
        partitions_max: 4,
        cells_max: 64,
        treelet_bytes: 1 << 10,
        roots_max: 5,
        segment_bytes: BYTES_MAX as u64,
    }
}

/// What a walk over a whole map finds.
#[derive(Default)]
struct Found {
    shapes: BTreeMap<Shape, u32>,
    leaf_faces: Vec<usize>,
    /// Of every brick, how many there are.
    parents: Vec<u32>,
    micropolygons: u64,
}

/// Reads a map brick by brick and checks everything that a tracer relies on.
fn walk(map: &BrickMap) -> Found {
    let mut found = Found { parents: vec![0; map.brick_count() as usize], ..Found::default() };
    let everything = LatticeBox { min: glam::IVec3::MIN, max: glam::IVec3::MAX };
    let mut stack = vec![(map.root(), everything)];
    while let Some((number, outer)) = stack.pop() {
        let length = map.brick_bytes(number) as usize;
        let mut bytes = vec![0; length];
        map.read(number, 1, &mut bytes).unwrap();
        bytes.resize(length + READ_PAST_BYTES, 0);
        // Nodes are read in place
        let mut aligned = vec![0_u64; bytes.len().div_ceil(8)];
        bytemuck::cast_slice_mut::<u64, u8>(&mut aligned)[..bytes.len()].copy_from_slice(&bytes);
        let brick = Brick::check(bytemuck::cast_slice(&aligned), length, number).unwrap();
        found.micropolygons += u64::from(brick.micropolygons());
        let mut nodes = vec![(0, outer)];
        while let Some((index, outer)) = nodes.pop() {
            let node = brick.node(index);
            for slot in 0..usize::from(node.count) {
                let decoded = node.child_box(slot);
                let inner = LatticeBox { min: decoded.min.max(outer.min), max: decoded.max.min(outer.max) };
                match node.child(slot).unwrap() {
                    Child::Node(offset) => nodes.push((brick.child_node(index, offset), inner)),
                    Child::Brick(offset) => {
                        let child = brick.child_brick_at(index, offset);
                        found.parents[child as usize] += 1;
                        stack.push((child, inner));
                    }
                    Child::Leaf(offset) => {
                        let leaf = brick.at(index, offset);
                        let layout = Layout::read(leaf).unwrap();
                        found.leaf_faces.push(layout.faces);
                        for face in (0..layout.faces).map(|face| layout.face(leaf, face)) {
                            let bounds = face.bounds();
                            assert!(
                                inner.min.cmple(bounds.min).all() && inner.max.cmpge(bounds.max).all(),
                                "{bounds:?} is not inside {inner:?}"
                            );
                            let vertices = &face.vertices[..usize::from(face.arity)];
                            let shape = shape(vertices, face.extinction, &face.radii).unwrap();
                            *found.shapes.entry(shape).or_default() += 1;
                        }
                    }
                }
            }
        }
    }
    found
}

/// Builds a scene, walks the map and compares it with the scene.
fn check_scene(scene: &mut [Grids], limits: &Limits) -> (BuildReport, Found) {
    let folder = tempfile::tempdir().unwrap();
    let report = build_in(folder.path(), scene, limits, 2, 256).unwrap();
    let map = BrickMap::open(&folder.path().join("map")).unwrap();
    map.verify().unwrap();
    let found = walk(&map);
    let (shapes, nothing) = expected(scene, &map.lattice(), &report.shifts);
    let faces: u64 = scene.iter().map(Grids::faces).sum();
    let skipped = report.degenerate + report.no_radius + report.transparent;
    assert_eq!((report.micropolygons + skipped, skipped), (faces, nothing));
    assert_eq!(found.micropolygons, report.micropolygons);
    let differing: Vec<_> = shapes.iter().filter(|(shape, n)| found.shapes.get(*shape) != Some(*n)).collect();
    assert!(differing.is_empty(), "{} shapes differ, the first is {:?}", differing.len(), differing[0]);
    assert_eq!(found.shapes.len(), shapes.len());
    let root = map.root() as usize;
    assert!(found.parents[..root].iter().all(|&n| n == 1) && found.parents[root] == 0);
    assert_eq!(report.tree.leaves, found.leaf_faces.len() as u64);
    assert!(std::fs::read_dir(folder.path().join("scratch")).unwrap().next().is_none());
    (report, found)
}

/// Catches a micropolygon that is lost, doubled, moved or outside its boxes, in scenes of every kind of face.
#[test]
fn every_micropolygon_is_in_one_leaf() {
    let (report, _) = check_scene(&mut [mixed(200, 30.0)], &Limits::default());
    assert!(report.degenerate > 0 && report.no_radius > 0 && report.transparent > 0, "{report:?}");
    // Two streams of different detail; partitions that are cut again; many bricks and segments
    let mut coarse = Grids::new();
    let mut random = Random(5);
    (0..40).for_each(|_| coarse.push_patch(random.place(30.0), 4.0, 9, 5, false, 1.0));
    let (report, _) = check_scene(&mut [mixed(300, 30.0), coarse], &tiny());
    assert!(report.partitions > 30 && report.shifts[1] > report.shifts[0], "{report:?}");
    assert!(report.bytes > 2 * tiny().segment_bytes, "{report:?}");
}

/// Catches an endless loop, or a loss, where no cell can part what lies in one place.
#[test]
fn coincident_micropolygons_are_cut_by_number() {
    let mut scene = Grids::new();
    (0..300).for_each(|_| scene.push_patch(DVec3::splat(3.3), 0.1, 8, 4, false, 1.0));
    let (report, _) = check_scene(&mut [scene], &tiny());
    assert!(report.partitions >= 9600 / 700, "{report:?}");
}

/// Catches cells that cannot part a tiny cluster from a vast scene: the teapot in the stadium.
#[test]
fn a_teapot_in_a_stadium_is_cut_again() {
    let mut scene = Grids::new();
    let mut random = Random(9);
    (0..200).for_each(|_| scene.push_patch(random.place(1.0), 0.01, 8, 8, false, 1.0));
    (0..50).for_each(|_| scene.push_patch(random.place(1e6) - 5e5, 0.01, 8, 8, false, 1.0));
    let (report, found) = check_scene(&mut [scene], &tiny());
    assert!(report.partitions > 18, "{report:?}");
    assert!(found.leaf_faces.len() * 8 < 17_000, "{} leaves", found.leaf_faces.len());
}

/// Catches leaves that are half empty, which costs bytes and time everywhere.
#[test]
fn leaves_are_full() {
    let fill = |scene: Grids| {
        let (report, _) = check_scene(&mut [scene], &Limits::default());
        report.micropolygons as f64 / report.tree.leaves as f64
    };
    let mut random = Random(3);
    let mut full = Grids::new();
    (0..50).for_each(|_| full.push_patch(random.place(10.0), 0.1, 8, 8, false, 1.0));
    assert!(fill(full) > 7.99);
    let mut odd = Grids::new();
    (0..50).for_each(|_| odd.push_patch(random.place(10.0), 0.1, 15, 15, true, 1.0));
    assert!(fill(odd) > 7.4);
    let mut soup = Grids::new();
    (0..1000)
        .for_each(|_| soup.push_patch(random.place(10.0), 0.1, 1, 1 + random.below(4) as u8, false, 1.0));
    assert!(fill(soup) > 7.9);
}

/// Catches a huge polygon that shares a leaf with small ones, so that every ray tests them all.
#[test]
fn a_huge_polygon_has_a_leaf_of_its_own() {
    let mut scene = Grids::new();
    let mut random = Random(3);
    (0..500).for_each(|_| scene.push_patch(random.place(10.0), 0.1, 1, 1, false, 1.0));
    let (small, _) = check_scene(&mut [scene.clone()], &Limits::default());
    let corners = [Vec3::ZERO, Vec3::X, Vec3::ONE, Vec3::new(0.0, 1.0, 1.0)].map(|corner| 10.0 * corner);
    scene.push(DVec3::ZERO, &corners, &[&[0, 1, 2, 3]], |_| [0.0, 1.0]);
    let (with_huge, _) = check_scene(&mut [scene], &Limits::default());
    assert_eq!(with_huge.tree.leaves, small.tree.leaves + 1);
}

/// Catches bytes that depend on threads or memory: then no cache and no farm could trust a map.
#[test]
fn bytes_are_the_same_for_all_threads_and_memory() {
    let folder = tempfile::tempdir().unwrap();
    let mut hashes = Vec::new();
    for (threads, memory_mib) in [(1, 256), (2, 256), (3, 16 << 10)] {
        build_in(folder.path(), &mut [mixed(500, 30.0)], &tiny(), threads, memory_mib).unwrap();
        let map = BrickMap::open(&folder.path().join("map")).unwrap();
        map.verify().unwrap();
        hashes.push(map.manifest().manifest_hash.clone());
    }
    assert!(hashes.iter().all(|hash| *hash == hashes[0]), "{hashes:?}");
}

/// Catches a cancelled build that goes on, or leaves something behind.
#[test]
fn a_cancelled_build_leaves_nothing() {
    for stage in ["count", "fill", "build"] {
        let folder = tempfile::tempdir().unwrap();
        let cancel = AtomicBool::new(false);
        let seen = Mutex::new(Vec::new());
        let progress = |now: &str, _: f64| {
            seen.lock().unwrap().push(now.to_owned());
            cancel.fetch_or(now == stage, Ordering::Relaxed);
        };
        let mut scene = mixed(600, 30.0);
        let options = BuildOptions {
            memory_bytes: 0,
            threads: 2,
            scratch: folder.path().join("scratch"),
            far_field: FarField::Paper,
        };
        let occluders = &mut [OccluderStream { stream: &mut scene }];
        let target = folder.path().join("map");
        let error = build_within(occluders, &options, &tiny(), &target, &progress, &cancel).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Cancelled);
        assert_eq!(seen.lock().unwrap().last().unwrap(), stage);
        let left: Vec<_> =
            std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(left.iter().all(|name| name == "scratch"), "{left:?}");
        let scratch = std::fs::read_dir(folder.path().join("scratch"));
        assert!(scratch.map_or(true, |mut entries| entries.next().is_none()));
    }
}

/// Catches bad input that ends in a panic, a map of nonsense or a message that does not say where.
#[test]
fn bad_occluders_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let build = |scene: Grids| message(build_in(folder.path(), &mut [scene], &Limits::default(), 1, 256));
    assert_eq!(build(Grids::new()), "no occluder geometry");
    assert!(message(build_in(folder.path(), &mut [], &Limits::default(), 1, 256)).contains("no occluder"));
    let break_grid = |change: &dyn Fn(&mut Microgrid)| {
        let mut scene = mixed(8, 5.0);
        change(&mut scene.grids[3]);
        build(scene)
    };
    for bad in [f32::NAN, f32::INFINITY] {
        let text = break_grid(&|grid| grid.positions[1].y = bad);
        assert_eq!(text, "microgrid 3 of occluder stream 0: a position is not a finite number");
    }
    assert!(break_grid(&|grid| grid.anchor.x = 1e300).contains("microgrid 3"));
    assert!(break_grid(&|grid| grid.indices[0] = 250).contains("face index 250"));
    assert!(break_grid(&|grid| grid.arities[0] = 7).contains("a face of 7 vertices"));
    assert!(break_grid(&|grid| grid.columns[1].truncate(4)).contains("`opacity`"));
    assert!(
        break_grid(&|grid| grid.columns[1][..4].copy_from_slice(&f32::NAN.to_le_bytes()))
            .contains("an opacity is not a number")
    );
    let mut points = Grids::new();
    points.push(DVec3::ZERO, &[Vec3::ZERO], &[&[0]], |_| [0.0, 1.0]);
    assert!(build(points).starts_with("no occluder geometry: no face with an area"));
    let mut changing = mixed(20, 5.0);
    changing.missing_later = 1;
    assert!(build(changing).contains("changed between two readings"));
    assert!(std::fs::read_dir(folder.path()).unwrap().all(|entry| entry.unwrap().file_name() == "scratch"));
}

/// Catches a build that throws away what is not a brick map, or cannot renew what is one.
#[test]
fn only_brick_maps_are_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("map");
    std::fs::create_dir(&target).unwrap();
    build_in(folder.path(), &mut [mixed(20, 5.0)], &Limits::default(), 1, 256).unwrap();
    let second = build_in(folder.path(), &mut [mixed(30, 5.0)], &Limits::default(), 1, 256).unwrap();
    let map = BrickMap::open(&target).unwrap();
    assert_eq!(map.manifest().micropolygons, second.micropolygons);
    let hash = |scene: &mut Grids| {
        hash_occluders(&mut [OccluderStream { stream: scene }], &AtomicBool::new(false)).unwrap()
    };
    assert!(map.matches(hash(&mut mixed(30, 5.0)), FarField::Paper));
    assert!(!map.matches(hash(&mut mixed(20, 5.0)), FarField::Paper));
    std::fs::remove_file(target.join("manifest.json")).unwrap();
    let refused = build_in(folder.path(), &mut [mixed(20, 5.0)], &Limits::default(), 1, 256);
    assert!(message(refused).contains("something else than a brick map"));
    assert!(target.join("segment.0000").exists());
}

/// Catches any damaged file that is believed: every byte of manifest and directory, samples of the segments.
#[test]
fn damaged_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    build_in(folder.path(), &mut [mixed(200, 10.0)], &tiny(), 1, 256).unwrap();
    let target = folder.path().join("map");
    let open = || BrickMap::open(&target).and_then(|map| map.verify());
    open().unwrap();
    for name in ["manifest.json", "directory", "segment.0000", "segment.0001"] {
        let path = target.join(name);
        let whole = std::fs::read(&path).unwrap();
        let places = if name.starts_with("segment") { 23 } else { whole.len() };
        for place in 0..places {
            let at = place * whole.len() / places;
            let mut damaged = whole.clone();
            damaged[at] ^= 1 << (place % 8);
            std::fs::write(&path, &damaged).unwrap();
            assert!(open().is_err(), "{name}: byte {at}");
        }
        for length in [0, 1, whole.len() / 2, whole.len() - 1] {
            std::fs::write(&path, &whole[..length]).unwrap();
            let error = BrickMap::open(&target).unwrap_err();
            assert!(error.place().is_some(), "{error}");
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!(BrickMap::open(&target).unwrap_err().kind(), ErrorKind::NotFound);
        std::fs::write(&path, &whole).unwrap();
    }
    open().unwrap();
    let text = std::fs::read_to_string(target.join("manifest.json")).unwrap();
    let old = text.replace("\"version\": 2", "\"version\": 1");
    std::fs::write(target.join("manifest.json"), old).unwrap();
    assert!(message(BrickMap::open(&target)).ends_with("brick map of version 1, version 2 wanted"));
}

/// Catches a read of many bricks that stumbles where one segment ends and the next begins.
#[test]
fn bricks_are_read_across_segments() {
    let folder = tempfile::tempdir().unwrap();
    build_in(folder.path(), &mut [mixed(500, 10.0)], &tiny(), 1, 256).unwrap();
    let map = BrickMap::open(&folder.path().join("map")).unwrap();
    assert!(map.manifest().segments.len() > 2);
    let bytes = |brick: u32| map.brick_bytes(brick) as usize;
    let mut all = vec![0; (0..map.brick_count()).map(bytes).sum()];
    map.read(0, map.brick_count(), &mut all).unwrap();
    let mut at = 0;
    for brick in 0..map.brick_count() {
        let mut one = vec![0; bytes(brick)];
        map.read(brick, 1, &mut one).unwrap();
        assert!(one == all[at..at + one.len()], "brick {brick}");
        at += one.len();
    }
    assert!(map.read(0, 2, &mut all[..64]).is_err());
}
