//! Tests of planning: every point in exactly one batch, whatever the points, the memory and the threads.

use std::fs;

use proptest::prelude::*;

use super::super::{GridMask, KeepAll};
use super::*;
use crate::stream::{Attribute, Schema, ValueType};

/// A stream of grids held in memory.
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
        let Some(next) = self.grids.get(self.next) else { return Ok(false) };
        grid.clone_from(next);
        self.next += 1;
        Ok(true)
    }
}

/// Grids of ten vertices each, and the last with the rest; normals where `normals` is set.
fn grids(positions: &[DVec3], normals: bool) -> Grids {
    let mut schema = Schema::default();
    if normals {
        schema.attributes.push(Attribute::vertex(names::NORMAL, ValueType::F32, 3));
    }
    let grids = positions.chunks(10).map(|vertices| {
        let mut grid = Microgrid::default();
        grid.clear(schema.attributes.len());
        grid.anchor = vertices[0];
        for &vertex in vertices {
            grid.positions.push((vertex - grid.anchor).as_vec3());
            if normals {
                grid.push_values(&schema.attributes[0], 0, &[0.0, 0.6, 0.8]);
            }
        }
        grid
    });
    let grids = grids.collect();
    Grids { schema, grids, next: 0 }
}

fn options(folder: &tempfile::TempDir, per_batch: u32) -> SplitOptions {
    SplitOptions {
        bake_set: "trees".into(),
        points_per_batch_max: per_batch,
        scratch: folder.path().into(),
        memory_bytes: 64 << 20,
    }
}

fn quiet(_: f64) -> Result<()> {
    Ok(())
}

fn read_all(plan: &BatchPlan) -> Vec<Vec<Point>> {
    (0..plan.len())
        .map(|i| {
            let mut points = Vec::new();
            plan.read(i, &mut points).expect("a sound plan");
            points
        })
        .collect()
}

/// Everything that must hold for any plan, with `in_memory` points in memory; returns the bytes of both files.
fn check(stream: &mut Grids, per_batch: u32, in_memory: usize) -> (Vec<u8>, Vec<u8>) {
    let folder = tempfile::tempdir().expect("a folder");
    let options = options(&folder, per_batch);
    let plan = split_with(stream, &mut KeepAll, &options, in_memory, &mut quiet).expect("a plan");
    let expected: Vec<DVec3> =
        stream.grids.iter().flat_map(|grid| (0..grid.vertex_count()).map(|v| grid.position(v))).collect();
    assert_eq!(plan.points(), expected.len() as u64);
    assert_eq!(plan.len(), expected.len().div_ceil(per_batch as usize), "batches are full but one");

    let mut seen = vec![false; expected.len()];
    for (i, points) in read_all(&plan).iter().enumerate() {
        let info = plan.batch(i);
        assert_eq!(points.len(), info.count as usize);
        assert!(info.count <= per_batch);
        assert_eq!(bounds_of(points), info.bounds);
        let curve = HilbertCurve::new(&info.bounds);
        assert!(points.is_sorted_by_key(|point| (curve.key(point.position), point.index)));
        for point in points {
            let index = point.index as usize;
            assert!(!std::mem::replace(&mut seen[index], true), "point {index} is in two batches");
            assert_eq!(point.position, expected[index]);
        }
    }
    assert!(seen.iter().all(|&seen| seen), "a point is in no batch");

    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "temporary files stay behind: {left:?}");
    let read = |name: &str| fs::read(folder.path().join(name)).expect("a file of the plan");
    (read("plan.bin"), read("points.bin"))
}

/// Points of a deterministic cloud, clustered and flat, with some repeated.
fn cloud(count: usize) -> Vec<DVec3> {
    let unit = |i: usize, axis: u32| {
        f64::from(crate::math::hash::unit_f32(crate::math::hash::combine(axis, i as u32 / 2 * 2)))
    };
    (0..count)
        .map(|i| DVec3::new(unit(i, 0).powi(3) * 80.0, unit(i, 1) * 3.0, unit(i, 2) * 50.0 - 25.0))
        .collect()
}

/// Catches a plan that depends on memory or threads: all in memory, on disk to various depths, one thread and four.
#[test]
fn the_plan_depends_on_neither_memory_nor_threads() {
    let mut stream = grids(&cloud(20_000), true);
    let reference = check(&mut stream, 64, usize::MAX);
    for in_memory in [64, 100, 1000, 10_000] {
        assert!(check(&mut stream, 64, in_memory) == reference, "{in_memory} points in memory");
    }
    for threads in [1, 4] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        assert!(pool.install(|| check(&mut stream, 64, 3000)) == reference, "{threads} threads");
    }
}

/// Catches an order of batches that jumps about: along the curve, consecutive centres are near one another.
#[test]
fn consecutive_batches_are_near() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut stream = grids(&cloud(20_000), false);
    let plan = split(&mut stream, &mut KeepAll, &options(&folder, 32), &mut quiet).expect("a plan");
    let centers: Vec<DVec3> = (0..plan.len()).map(|i| plan.batch(i).bounds.center()).collect();
    let mean = |distance: &dyn Fn(usize) -> f64| {
        (0..centers.len()).map(distance).sum::<f64>() / centers.len() as f64
    };
    let next = mean(&|i| centers[i].distance(centers[(i + 1) % centers.len()]));
    let any = mean(&|i| centers[i].distance(centers[(i + centers.len() / 2) % centers.len()]));
    assert!(next < 0.15 * any, "{next} to the next, {any} to any");
}

/// Catches normals that are lost, turned, or invented where the stream has none.
#[test]
fn normals_are_those_of_the_stream() {
    for (normals, expected) in [(true, Vec3::new(0.0, 0.6, 0.8)), (false, Vec3::ZERO)] {
        let folder = tempfile::tempdir().expect("a folder");
        let mut stream = grids(&cloud(100), normals);
        let plan = split(&mut stream, &mut KeepAll, &options(&folder, 30), &mut quiet).expect("a plan");
        assert!(read_all(&plan).iter().flatten().all(|point| point.normal == expected));
    }
}

/// Catches a filter that shifts the indices of the points after those it drops.
#[test]
fn a_mask_keeps_indices_and_the_length_of_the_stream() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut stream = grids(&cloud(95), false);
    let mut mask = GridMask::new();
    [1, 9].into_iter().for_each(|grid| mask.insert(grid));
    let plan = split(&mut stream, &mut mask, &options(&folder, 4), &mut quiet).expect("a plan");
    let mut indices: Vec<u64> = read_all(&plan).iter().flatten().map(|point| point.index).collect();
    indices.sort();
    assert_eq!(indices, (10..20).chain(90..95).collect::<Vec<u64>>());
    assert_eq!((plan.points(), plan.stream_points()), (15, 95));
}

/// Catches an empty bake set that becomes an empty plan, or an old plan that stays in place of it.
#[test]
fn no_points_is_an_error_that_names_the_bake_set() {
    let folder = tempfile::tempdir().expect("a folder");
    split(&mut grids(&cloud(10), false), &mut KeepAll, &options(&folder, 4), &mut quiet).expect("a plan");
    let error =
        split(&mut grids(&[], false), &mut KeepAll, &options(&folder, 4), &mut quiet).expect_err("no points");
    assert_eq!(error.message(), "bake set `trees` has no points");
    let mut stream = grids(&cloud(10), false);
    let error =
        split(&mut stream, &mut GridMask::new(), &options(&folder, 4), &mut quiet).expect_err("no points");
    assert_eq!(error.hint_text(), Some("its filter dropped all 10 vertices"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Catches NaN and infinity on their way into the tree, where comparing them would scatter points anywhere.
#[test]
fn what_is_not_finite_is_refused_with_its_place() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut stream = grids(&cloud(30), true);
    stream.grids[1].positions[3].y = f32::NAN;
    let error = split(&mut stream, &mut KeepAll, &options(&folder, 4), &mut quiet).expect_err("a NaN");
    assert_eq!(error.message(), "the position of vertex `3` of grid `1` is not a finite number");
    let mut stream = grids(&cloud(30), true);
    stream.grids[2].columns[0][..4].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let error = split(&mut stream, &mut KeepAll, &options(&folder, 4), &mut quiet).expect_err("an infinity");
    assert_eq!(error.message(), "the normal of vertex `0` of grid `2` is not a finite number");
}

/// Catches impossible options that divide by zero or run out of memory later.
#[test]
fn impossible_options_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut stream = grids(&cloud(30), false);
    for (per_batch, memory_bytes) in [(0, 1 << 30), (u32::MAX, 1 << 62), (4, 1 << 20), (1 << 20, 64 << 20)] {
        let options = SplitOptions { memory_bytes, ..options(&folder, per_batch) };
        split(&mut stream, &mut KeepAll, &options, &mut quiet).expect_err("impossible");
    }
}

/// Catches work that goes on after its caller cancelled it, or that leaves files behind.
#[test]
fn a_cancelled_split_leaves_nothing() {
    for stop_at in [0.0, GATHER_SHARE + 0.01] {
        let folder = tempfile::tempdir().expect("a folder");
        let mut stream = grids(&cloud(20_000), false);
        let mut cancel = |share: f64| {
            if share >= stop_at { Err(Error::new(ErrorKind::Cancelled, "cancelled")) } else { Ok(()) }
        };
        let error = split_with(&mut stream, &mut KeepAll, &options(&folder, 64), 2000, &mut cancel)
            .expect_err("cancelled");
        assert_eq!(error.kind(), ErrorKind::Cancelled);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}

/// Catches any damaged byte of a plan that is taken for good: every bit of the table, samples of the points.
#[test]
fn damage_is_found() {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = split(&mut grids(&cloud(100), false), &mut KeepAll, &options(&folder, 30), &mut quiet)
        .expect("a plan");
    drop(plan);
    for name in ["plan.bin", "points.bin"] {
        let path = folder.path().join(name);
        let sound = fs::read(&path).expect("a file");
        for at in 0..sound.len() {
            let mut bytes = sound.clone();
            bytes[at] ^= 1 << (at % 8);
            fs::write(&path, &bytes).expect("written");
            let mut points = Vec::new();
            let result = BatchPlan::open(folder.path())
                .and_then(|plan| (0..plan.len()).try_for_each(|i| plan.read(i, &mut points)));
            let error = result.expect_err("damage");
            assert!(
                matches!(error.kind(), ErrorKind::Corrupt | ErrorKind::Unsupported),
                "byte {at}: {error}"
            );
        }
        for length in 0..sound.len() {
            fs::write(&path, &sound[..length]).expect("written");
            BatchPlan::open(folder.path()).expect_err("too short");
        }
        fs::write(&path, &sound).expect("written");
    }
    BatchPlan::open(folder.path()).expect("whole again");
}

/// Catches a selection for tests that bunches up, repeats batches, or takes more points than asked for.
#[test]
fn chosen_batches_are_evenly_spaced() {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = split(&mut grids(&cloud(1000), false), &mut KeepAll, &options(&folder, 10), &mut quiet)
        .expect("a plan");
    assert_eq!(plan.table().evenly_spaced(1000).len(), 100);
    assert_eq!(plan.table().evenly_spaced(0), [50]);
    assert_eq!(plan.table().evenly_spaced(49), [12, 37, 62, 87]);
    for points_max in (10..1000).step_by(7) {
        let chosen = plan.table().evenly_spaced(points_max);
        assert_eq!(chosen.len() as u64, points_max / 10);
        let gaps = chosen.windows(2).map(|pair| pair[1] - pair[0]);
        let (least, most) = gaps.fold((u32::MAX, 0), |(least, most), gap| (least.min(gap), most.max(gap)));
        assert!(chosen.len() < 2 || (least > 0 && most - least <= 1), "{points_max}: {chosen:?}");
    }
}

/// Measures the split of 4 M points in memory and on disk: `cargo test --release -- --ignored --nocapture batch::`.
#[test]
#[ignore = "a measurement"]
fn throughput() {
    let count = 4_000_000;
    let mut stream = grids(&cloud(count), true);
    for in_memory in [usize::MAX, 350_000] {
        let folder = tempfile::tempdir().expect("a folder");
        let start = std::time::Instant::now();
        let options = options(&folder, 2048);
        split_with(&mut stream, &mut KeepAll, &options, in_memory, &mut quiet).expect("a plan");
        let seconds = start.elapsed().as_secs_f64();
        eprintln!("{in_memory} points in memory: {:.2} M points/s", count as f64 / seconds / 1e6);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Catches a point lost, doubled or outside its batch's box, a batch too large, and a plan that the way of
    /// splitting changes, for clouds with many equal coordinates and points.
    #[test]
    fn every_point_is_in_exactly_one_batch(
        positions in prop::collection::vec(
            prop_oneof![
                prop::array::uniform3(-100.0..100.0f64),
                prop::array::uniform3((-2..3i32).prop_map(f64::from)),
                Just([1.5, -0.0, 3.0]),
            ],
            1..400,
        ),
        per_batch in 1u32..40,
        in_memory in 1usize..200,
    ) {
        let positions: Vec<DVec3> = positions.into_iter().map(DVec3::from_array).collect();
        let mut stream = grids(&positions, false);
        let reference = check(&mut stream, per_batch, usize::MAX);
        prop_assert!(check(&mut stream, per_batch, in_memory.max(per_batch as usize)) == reference);
    }
}
