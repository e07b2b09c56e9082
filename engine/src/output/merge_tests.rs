//! Tests of the merge: rows at their points whatever the order and the memory, and nothing invented.

use std::fs;

use glam::{DVec3, Vec3};
use proptest::prelude::*;

use super::super::PartLog;
use super::super::part::tests::{format, part, values};
use super::*;
use crate::batch::{GridMask, KeepAll, Point, PointFilter, SplitOptions, split};
use crate::stream::file::MgsReader;

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

/// Parts held in memory, in any order.
struct Parts {
    format: PartFormat,
    parts: Vec<Part>,
    next: usize,
}

impl PartSource for Parts {
    fn format(&self) -> &PartFormat {
        &self.format
    }

    fn rewind(&mut self) -> Result<()> {
        self.next = 0;
        Ok(())
    }

    fn next(&mut self, part: &mut Part) -> Result<bool> {
        let Some(next) = self.parts.get(self.next) else { return Ok(false) };
        part.clone_from(next);
        self.next += 1;
        Ok(true)
    }
}

/// A stream of `points` vertices in grids of 1 to 13, with an attribute per vertex and one per grid, its plan, and a
/// folder for everything.
struct Bake {
    folder: tempfile::TempDir,
    input: Grids,
    plan: BatchPlan,
}

fn bake(points: u64, filter: &mut dyn PointFilter) -> Bake {
    let attributes =
        vec![Attribute::vertex("opacity", ValueType::U8, 1), Attribute::grid("id", ValueType::U32, 1)];
    let schema = Schema { attributes, ..Schema::default() };
    let (mut grids, mut index) = (Vec::new(), 0);
    while index < points {
        let mut grid = Microgrid::default();
        grid.clear(2);
        grid.anchor = DVec3::splat(100.0);
        grid.push_values(&schema.attributes[1], 1, &[grids.len() as f32]);
        for _ in 0..(1 + grids.len() % 13).min((points - index) as usize) {
            let unit = |axis| crate::math::hash::unit_f32(crate::math::hash::combine(axis, index as u32));
            grid.positions.push(Vec3::new(unit(0), unit(1), unit(2)));
            grid.push_values(&schema.attributes[0], 0, &[(index % 251) as f32]);
            index += 1;
        }
        grid.push_face(&[0]);
        grids.push(grid);
    }
    let mut input = Grids { schema, grids, next: 0 };
    let folder = tempfile::tempdir().expect("a folder");
    let options = SplitOptions {
        bake_set: "trees".into(),
        points_per_batch_max: 32,
        scratch: folder.path().join("plan"),
        memory_bytes: 16 << 20,
    };
    fs::create_dir(&options.scratch).expect("a folder");
    let plan = split(&mut input, filter, &options, &mut |_| Ok(())).expect("a plan");
    Bake { folder, input, plan }
}

impl Bake {
    /// The parts of all batches; points that `skip` chooses are not computed.
    fn parts(&self, skip: impl Fn(u64) -> bool) -> Parts {
        let mut points: Vec<Point> = Vec::new();
        let parts = (0..self.plan.len()).map(|batch| {
            self.plan.read(batch, &mut points).expect("points");
            let indices: Vec<u64> = points.iter().map(|point| point.index).collect();
            part(&format(), batch as u32, &indices, &skip)
        });
        let parts = parts.collect();
        Parts { format: format(), parts, next: 0 }
    }

    /// Merges with ranges of `range_points` into `out.mgs`.
    fn merge(&mut self, parts: &mut dyn PartSource, partial: bool, range_points: u64) -> Result<MergeReport> {
        let options = MergeOptions {
            scratch: self.folder.path(),
            memory_bytes: 16 << 20,
            partial,
            metadata: &[("sh".into(), "real".into())],
        };
        let points = self.plan.stream_points();
        let row_bytes = parts.format().row_bytes();
        let division =
            Division { points, row_bytes, range_points: range_points.min(points), block_bytes: 200 };
        let target = self.folder.path().join("out.mgs");
        merge_with(&mut self.input, &self.plan, parts, &options, division, &target, &mut |_| Ok(()))
    }

    fn output(&self) -> Vec<u8> {
        fs::read(self.folder.path().join("out.mgs")).expect("an output")
    }

    /// Checks that the output is the input with the values of every point appended, `baked` where `marked`.
    fn check_output(&self, marked: bool, baked: impl Fn(u64) -> bool) {
        let mut reader = MgsReader::open(&self.folder.path().join("out.mgs")).expect("a stream");
        assert_eq!(reader.metadata(), [("sh".to_string(), "real".to_string())]);
        let schema = reader.schema().clone();
        assert_eq!(schema.attributes.len(), 5 + usize::from(marked));
        let (mut grid, mut index) = (Microgrid::default(), 0);
        for expected in &self.input.grids {
            assert!(reader.next(&mut grid).expect("read"), "fewer grids");
            assert_eq!(grid.columns[..2], expected.columns[..]);
            for vertex in 0..expected.vertex_count() {
                assert_eq!(grid.position(vertex), expected.position(vertex));
                let values = if baked(index) { values(index) } else { [0.0; 6] };
                let found = [(2, 0), (2, 1), (3, 0), (3, 1), (3, 2), (4, 0)]
                    .map(|(column, component)| grid.value(&schema, column, vertex, component));
                assert_eq!(found, values, "point {index}");
                if marked {
                    assert_eq!(grid.columns[5][vertex], u8::from(baked(index)), "point {index}");
                }
                index += 1;
            }
        }
        assert!(!reader.next(&mut grid).expect("read"), "more grids");
    }

    /// Checks that a failed merge left neither an output nor a temporary file.
    fn check_nothing_left(&self) {
        let names = fs::read_dir(self.folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
        assert_eq!(names.collect::<Vec<_>>(), ["plan"]);
    }
}

/// Catches rows at the wrong point, columns in the wrong order, and an input that is changed on the way.
#[test]
fn the_output_is_the_input_and_the_results() {
    let mut bake = bake(500, &mut KeepAll);
    let mut parts = bake.parts(|_| false);
    let report = bake.merge(&mut parts, false, u64::MAX).expect("merged");
    assert_eq!((report.points, report.baked, report.parts, report.scratch_bytes), (500, 500, 16, 0));
    assert_eq!(report.grids as usize, bake.input.grids.len());
    bake.check_output(false, |_| true);
}

/// Catches a public entry that divides the points otherwise than the tests do.
#[test]
fn the_memory_decides_the_division() {
    let mut bake = bake(500, &mut KeepAll);
    let mut parts = bake.parts(|_| false);
    bake.merge(&mut parts, false, 100).expect("merged");
    let expected = bake.output();
    let target = bake.folder.path().join("out.mgs");
    let metadata = [("sh".to_string(), "real".to_string())];
    let options = MergeOptions {
        scratch: bake.folder.path(),
        memory_bytes: 1 << 10,
        partial: false,
        metadata: &metadata,
    };
    let mut run =
        |options| merge(&mut bake.input, &bake.plan, &mut parts, &options, &target, &mut |_| Ok(()));
    assert_eq!(run(options).expect_err("too little").kind(), ErrorKind::Limit);
    run(MergeOptions { memory_bytes: 64 << 20, ..options }).expect("merged");
    assert!(fs::read(&target).expect("an output") == expected);
}

/// Catches a zero in place of a result: a batch without part, and a row that was not computed, named in the error.
#[test]
fn a_missing_result_is_an_error_that_names_it() {
    let mut bake = bake(500, &mut KeepAll);
    let mut parts = bake.parts(|_| false);
    let lost = parts.parts.remove(5);
    let first = lost.indices.iter().min().expect("a point");
    for range_points in [u64::MAX, 60] {
        let error = bake.merge(&mut parts, false, range_points).expect_err("a batch is missing");
        assert_eq!(error.message(), format!("point `{first}` in batch `5` has no result"));
        bake.check_nothing_left();
    }
    let point = lost.indices[7];
    let mut parts = bake.parts(|index| index == point);
    let error = bake.merge(&mut parts, false, 60).expect_err("a point is missing");
    assert_eq!(error.message(), format!("point `{point}` in batch `5` has no result"));
    bake.check_nothing_left();
}

/// Catches a partial bake that fails, or that marks other points than those computed.
#[test]
fn a_partial_merge_marks_what_is_baked() {
    let mut bake = bake(500, &mut KeepAll);
    let mut parts = bake.parts(|index| index % 9 == 4);
    parts.parts.retain(|part| part.batch % 4 == 1);
    let chosen: Vec<u64> = parts.parts.iter().flat_map(|part| part.indices.clone()).collect();
    let baked = |index: u64| chosen.contains(&index) && index % 9 != 4;
    for range_points in [u64::MAX, 60] {
        let report = bake.merge(&mut parts, true, range_points).expect("merged");
        assert_eq!(report.baked as usize, (0..500).filter(|&index| baked(index)).count());
        bake.check_output(true, baked);
    }
}

/// Catches a filtered bake set whose dropped points are errors, or whose kept points may be missing.
#[test]
fn a_filter_leaves_its_points_unmarked_and_no_others() {
    let mut mask = GridMask::new();
    (0..40).step_by(3).for_each(|grid| mask.insert(grid));
    let mut bake = bake(500, &mut mask);
    let mut parts = bake.parts(|_| false);
    let kept: Vec<u64> = parts.parts.iter().flat_map(|part| part.indices.clone()).collect();
    assert!(kept.len() as u64 == bake.plan.points() && bake.plan.points() < 500);
    bake.merge(&mut parts, false, 77).expect("merged");
    bake.check_output(true, |index| kept.contains(&index));
    parts.parts.pop();
    fs::remove_file(bake.folder.path().join("out.mgs")).expect("removed");
    bake.merge(&mut parts, false, 77).expect_err("a kept batch is missing");
    bake.check_nothing_left();
}

/// Catches results of which the later or the earlier silently wins, and a harmless repetition that fails.
#[test]
fn a_point_with_two_results_is_an_error() {
    let mut bake = bake(200, &mut KeepAll);
    let mut parts = bake.parts(|_| false);
    parts.parts.push(parts.parts[2].clone());
    bake.merge(&mut parts, false, 50).expect("the same twice");
    bake.check_output(false, |_| true);
    fs::remove_file(bake.folder.path().join("out.mgs")).expect("removed");
    let point = parts.parts[2].indices[3];
    parts.parts.last_mut().expect("a part").set_row(&format(), 3, &values(point + 1));
    for range_points in [u64::MAX, 50] {
        let error = bake.merge(&mut parts, false, range_points).expect_err("two results");
        assert_eq!(error.message(), format!("point `{point}` was baked twice with different results"));
        bake.check_nothing_left();
    }
}

/// Catches NaN in an output, parts of another plan, and names that are taken.
#[test]
fn what_does_not_fit_is_refused() {
    let mut bake = bake(200, &mut KeepAll);
    let sound = bake.parts(|_| false);
    let refused = |bake: &mut Bake, change: &dyn Fn(&mut Parts), message: &str| {
        let mut parts = Parts { format: sound.format.clone(), parts: sound.parts.clone(), next: 0 };
        change(&mut parts);
        let error = bake.merge(&mut parts, false, 50).expect_err(message);
        assert!(error.message().contains(message), "{error}");
        bake.check_nothing_left();
    };
    refused(&mut bake, &|p| p.parts[1].set_row(&format(), 0, &[f32::NAN; 6]), "is not a finite number");
    refused(&mut bake, &|p| p.parts[1].indices[0] = 200, "in a stream of 200 points");
    refused(&mut bake, &|p| p.parts[1].indices[0] = p.parts[2].indices[0], "baked twice");
    refused(&mut bake, &|p| p.parts[1].batch = 99, "0 in the plan");
    refused(&mut bake, &|p| p.parts[1] = part(&format(), 1, &[1, 2], |_| false), "2 points, 32 in the plan");
    bake.input.schema.attributes[0].name = "error".into();
    refused(&mut bake, &|_| {}, "already has an attribute `error`");
    bake.input.schema.attributes[0].name = "opacity".into();
    bake.input.grids.pop();
    refused(&mut bake, &|_| {}, "the stream has fewer than the 200 points");
    let grid = bake.input.grids[12].clone();
    bake.input.grids.extend([grid.clone(), grid]);
    refused(&mut bake, &|_| {}, "the stream has more than the 200 points");
}

/// Catches work that goes on after its caller cancelled it, and an output that appears all the same.
#[test]
fn a_cancelled_merge_leaves_nothing() {
    let mut bake = bake(20_000, &mut KeepAll);
    let target = bake.folder.path().join("out.mgs");
    for stop_at in [0.0, SCATTER_SHARE + 0.2] {
        let mut parts = bake.parts(|_| false);
        let options = MergeOptions {
            scratch: bake.folder.path(),
            memory_bytes: 16 << 20,
            partial: false,
            metadata: &[],
        };
        let mut cancel = |share: f64| {
            if share >= stop_at { Err(Error::new(ErrorKind::Cancelled, "cancelled")) } else { Ok(()) }
        };
        let error = merge(&mut bake.input, &bake.plan, &mut parts, &options, &target, &mut cancel);
        assert_eq!(error.expect_err("cancelled").kind(), ErrorKind::Cancelled);
        bake.check_nothing_left();
    }
}

/// Catches an interrupted bake that ends with another output: a log torn in the middle, continued, then merged.
#[test]
fn an_interrupted_bake_ends_like_a_quiet_one() {
    let mut bake = bake(1000, &mut KeepAll);
    let mut parts = bake.parts(|_| false);
    bake.merge(&mut parts, false, 300).expect("merged");
    let expected = bake.output();
    let path = bake.folder.path().join("trees.parts");
    let batches = bake.plan.len() as u32;
    let mut log = PartLog::open(&path, &format(), batches).expect("a log");
    parts.parts[..20].iter().for_each(|part| log.append(part).expect("appended"));
    drop(log);
    let bytes = fs::read(&path).expect("bytes");
    fs::write(&path, &bytes[..bytes.len() - 100]).expect("torn");

    let mut log = PartLog::open(&path, &format(), batches).expect("a log");
    assert_eq!(log.completed().first_missing(), Some(19));
    assert!(bake.merge(&mut log, false, 300).expect_err("unfinished").message().contains("batch `19`"));
    while let Some(batch) = log.completed().first_missing() {
        log.append(&parts.parts[batch as usize]).expect("appended");
    }
    bake.merge(&mut log, false, 300).expect("merged");
    assert!(bake.output() == expected);
}

/// Measures the merge of 4 M points of 36 bytes: `cargo test --release -- --ignored --nocapture output::`.
#[test]
#[ignore = "a measurement"]
fn throughput() {
    let count = 4_000_000;
    let mut bake = bake(count, &mut KeepAll);
    let format = PartFormat::new(1, &[Attribute::vertex("sh", ValueType::F32, 9)], 32).expect("a format");
    let path = bake.folder.path().join("trees.parts");
    let mut log = PartLog::open(&path, &format, bake.plan.len() as u32).expect("a log");
    let (mut points, mut part) = (Vec::new(), Part::default());
    let start = std::time::Instant::now();
    for batch in 0..bake.plan.len() {
        bake.plan.read(batch, &mut points).expect("points");
        part.start(batch as u32, points.iter().map(|point| point.index), &format);
        for (row, point) in points.iter().enumerate() {
            part.set_row(&format, row, &[point.position.x as f32; 9]);
        }
        log.append(&part).expect("appended");
    }
    log.sync().expect("on disk");
    let rate = |start: std::time::Instant| count as f64 / start.elapsed().as_secs_f64() / 1e6;
    eprintln!("log: {:.2} M points/s, {} bytes", rate(start), fs::metadata(&path).expect("a file").len());
    let target = bake.folder.path().join("out.mgs");
    for memory_bytes in [1 << 30, 64 << 20] {
        let options =
            MergeOptions { scratch: bake.folder.path(), memory_bytes, partial: false, metadata: &[] };
        let start = std::time::Instant::now();
        let report = merge(&mut bake.input, &bake.plan, &mut log, &options, &target, &mut |_| Ok(()));
        eprintln!(
            "merge in {memory_bytes} bytes: {:.2} M points/s, {:?}",
            rate(start),
            report.expect("merged")
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// Catches an output that depends on the order of parts or on the memory.
    #[test]
    fn the_order_of_parts_does_not_matter(
        points in 1u64..400,
        keys in prop::collection::vec(any::<u32>(), 16),
        range_points in 1u64..400,
        skipped in 0u64..5,
    ) {
        let mut bake = bake(points, &mut KeepAll);
        let mut parts = bake.parts(|index| index % 5 < skipped);
        bake.merge(&mut parts, true, u64::MAX).expect("merged");
        bake.check_output(true, |index| index % 5 >= skipped);
        let direct = bake.output();
        parts.parts.sort_by_key(|part| keys[part.batch as usize % keys.len()]);
        bake.merge(&mut parts, true, range_points).expect("merged");
        prop_assert!(bake.output() == direct);
    }
}
