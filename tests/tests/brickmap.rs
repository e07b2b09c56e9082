//! The brick map as a whole: what goes in comes out, once, whatever the machine; and damage is found.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use engine::ErrorKind;
use engine::brick::leaf::Layout;
use engine::brick::{Brick, Child, LatticeBox};
use engine::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
use engine::stream::MicrogridStream;
use glam::DVec3;
use tests::MemoryStream;

/// A varied scene: two streams of different detail, quads, triangles, lines and points, one huge face among small ones.
fn scene() -> [MemoryStream; 2] {
    let (mut fine, mut coarse) = (MemoryStream::new(), MemoryStream::new());
    for i in 0..40 {
        fine.push_sphere(
            DVec3::new(f64::from(i % 7), f64::from(i / 7), 0.3),
            0.2,
            40,
            1.0 - 0.02 * f64::from(i) as f32,
        );
    }
    for i in 0..300 {
        let at = DVec3::new(f64::from(i % 17), f64::from(i / 17), f64::from(i % 5));
        let corners = [at, at + DVec3::X * 0.3, at + DVec3::Y * 0.2];
        coarse.push(&corners, &[&[0, 1, 2], &[0, 2], &[1]], 0.01, 1.0);
    }
    let far = DVec3::splat(500.0);
    coarse.push(
        &[-far, far * DVec3::new(1.0, -1.0, 0.1), far, far * DVec3::new(-1.0, 1.0, 0.1)],
        &[&[0, 1, 2, 3]],
        0.0,
        1.0,
    );
    [fine, coarse]
}

fn build_at(target: &Path, threads: usize, memory_bytes: u64, cancel: bool) -> engine::Result<()> {
    let scratch = tempfile::tempdir().unwrap();
    let options = BuildOptions {
        memory_bytes,
        threads,
        scratch: scratch.path().to_path_buf(),
        far_field: FarField::Directional,
    };
    let [mut fine, mut coarse] = scene();
    let streams: [&mut dyn MicrogridStream; 2] = [&mut fine, &mut coarse];
    let mut occluders = streams.map(OccluderStream::once);
    let result = build(&mut occluders, &options, target, &|_, _| {}, &AtomicBool::new(cancel)).map(|_| ());
    assert_eq!(std::fs::read_dir(scratch.path()).unwrap().count(), 0, "temporary data is left behind");
    result
}

/// Every file of a folder, by name.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let entries = std::fs::read_dir(folder).unwrap().map(Result::unwrap);
    let mut files: Vec<_> =
        entries.map(|e| (e.file_name().into_string().unwrap(), std::fs::read(e.path()).unwrap())).collect();
    files.sort();
    files
}

/// Calls `each` with every brick, checked.
fn for_each_brick(map: &BrickMap, mut each: impl FnMut(u32, Brick<'_>)) {
    let mut bytes = Vec::new();
    for number in 0..map.brick_count() {
        let length = map.brick_bytes(number) as usize;
        bytes.clear();
        bytes.resize(length + engine::brick::leaf::READ_PAST_BYTES, 0);
        map.read(number, 1, &mut bytes[..length]).unwrap();
        each(number, Brick::check(&bytes, length, number).unwrap());
    }
}

/// Catches a micropolygon that is lost, doubled, moved, or outside its leaf's box.
#[test]
fn every_micropolygon_is_there_once() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("map");
    build_at(&target, 2, 256 << 20, false).unwrap();
    let map = BrickMap::open(&target).unwrap();
    let (lattice, mut expected) = (map.lattice(), Vec::new());
    for (number, stream) in scene().iter().enumerate() {
        for grid in &stream.grids {
            for face in grid.faces() {
                let at = |&v: &u8| lattice.snap(grid.position(usize::from(v)), map.shift(number)).to_array();
                let mut corners: Vec<[i32; 3]> = face.iter().map(at).collect();
                corners.sort_unstable();
                corners.dedup();
                // A sphere's quads at the poles are triangles; what is left of a surface is one
                if corners.len() >= face.len().min(3) {
                    expected.push(corners);
                }
            }
        }
    }
    let mut found = Vec::new();
    for_each_brick(&map, |_, brick| {
        for index in 0..brick.node_count() {
            let node = brick.node(index);
            for slot in 0..usize::from(node.count) {
                let Some(Child::Leaf(offset)) = node.child(slot) else { continue };
                let bytes = brick.at(index, offset);
                let LatticeBox { min, max } = node.child_box(slot);
                let layout = Layout::read(bytes, min).unwrap();
                for face in (0..layout.faces).map(|face| layout.face(bytes, face)) {
                    let bounds = face.bounds();
                    assert!(min.cmple(bounds.min).all() && max.cmpge(bounds.max).all());
                    let mut corners: Vec<[i32; 3]> =
                        face.vertices[..usize::from(face.arity)].iter().map(|v| v.to_array()).collect();
                    corners.sort_unstable();
                    corners.dedup();
                    found.push(corners);
                }
            }
        }
    });
    expected.sort_unstable();
    found.sort_unstable();
    assert_eq!(found.len(), expected.len());
    assert!(found == expected, "the faces differ");
    assert_eq!(map.manifest().micropolygons, found.len() as u64);
}

/// Catches bytes that depend on the machine.
#[test]
fn threads_and_memory_do_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    build_at(&a, 1, 256 << 20, false).unwrap();
    build_at(&b, 3, 4 << 30, false).unwrap();
    assert!(files(&a) == files(&b), "the maps differ");
}

/// Catches a half-written map after a build that was stopped.
#[test]
fn a_cancelled_build_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let error = build_at(&folder.path().join("map"), 2, 256 << 20, true).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Cancelled);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Catches damage that would be traced: cut files, flipped bits, another version, counts that lie.
#[test]
fn damaged_maps_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("map");
    build_at(&target, 2, 256 << 20, false).unwrap();
    for (name, bytes) in files(&target) {
        let path = target.join(&name);
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        assert!(BrickMap::open(&target).is_err(), "{name} is cut");
        std::fs::remove_file(&path).unwrap();
        assert_eq!(BrickMap::open(&target).unwrap_err().kind(), ErrorKind::NotFound, "{name} is gone");
        std::fs::write(&path, &bytes).unwrap();
    }
    let directory = target.join("directory");
    let whole = std::fs::read(&directory).unwrap();
    let mut flipped = whole.clone();
    flipped[9] ^= 4;
    std::fs::write(&directory, flipped).unwrap();
    assert_eq!(BrickMap::open(&target).unwrap_err().kind(), ErrorKind::Corrupt);
    std::fs::write(&directory, whole).unwrap();

    let manifest = target.join("manifest.json");
    let text = std::fs::read_to_string(&manifest).unwrap();
    let lies = [
        ("\"version\": 4", "\"version\": 5", ErrorKind::Unsupported),
        ("\"bricks\": ", "\"bricks\": 4", ErrorKind::Corrupt),
        ("\"lattice_exponent\": ", "\"lattice_exponent\": 99", ErrorKind::Corrupt),
        ("{", "[", ErrorKind::Corrupt),
    ];
    for (from, to, kind) in lies {
        assert!(text.contains(from), "{from}");
        std::fs::write(&manifest, text.replacen(from, to, 1)).unwrap();
        assert_eq!(BrickMap::open(&target).unwrap_err().kind(), kind, "{to}");
    }
}
