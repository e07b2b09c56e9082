//! Tests on broken and hostile files: an error or a counted skip, never a panic, a hang, or memory that a file dictates.

use std::path::{Path, PathBuf};
use std::time::Instant;

use proptest::prelude::*;

use super::assets::{Collect, collect, folder};
use super::*;
use crate::ErrorKind;

/// The small broken files that live with the tests.
fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/import").join(name)
}

/// Catches a broken file that is read, or an error of the wrong kind or without its place.
#[test]
fn broken_files_are_refused_with_their_place() {
    let cases = [
        ("huge_count.ply", ErrorKind::Corrupt, "byte"),
        ("huge_list.ply", ErrorKind::Limit, "byte"),
        ("index_out_of_range.ply", ErrorKind::Invalid, ":11:7"),
        ("truncated.ply", ErrorKind::Corrupt, ":9:1"),
        ("empty.ply", ErrorKind::Corrupt, "byte 0"),
        ("index_out_of_range.obj", ErrorKind::Invalid, ":5:7"),
        ("negative_index.obj", ErrorKind::Invalid, ":4:3"),
        ("not_a_number.obj", ErrorKind::Invalid, ":2:5"),
        ("huge_accessor.gltf", ErrorKind::Invalid, "huge_accessor.gltf"),
        ("huge_zeros.gltf", ErrorKind::Limit, "huge_zeros.gltf"),
        ("cycle.gltf", ErrorKind::Invalid, "cycle.gltf"),
        ("escape.gltf", ErrorKind::Invalid, "escape.gltf"),
        ("draco.gltf", ErrorKind::Unsupported, "draco.gltf"),
        ("index_out_of_range.gltf", ErrorKind::Invalid, "index_out_of_range.gltf"),
        ("empty.gltf", ErrorKind::Invalid, ":1:1"),
    ];
    for (name, kind, place) in cases {
        let Err(error) = collect(&data(name)) else { panic!("{name} was read") };
        assert_eq!(error.kind(), kind, "{error}");
        assert!(error.to_string().contains(place), "{name}: {error} does not name {place}");
    }
    assert_eq!(collect(Path::new("nothing.ply")).err().unwrap().kind(), ErrorKind::NotFound);
    assert_eq!(collect(Path::new("a.fbx")).err().unwrap().kind(), ErrorKind::Unsupported);
}

/// Catches positions that are not finite and reach a grid, and files that are lost for one bad face.
#[test]
fn bad_faces_are_counted_and_the_rest_is_read() {
    for (name, left, skipped) in [("not_finite.ply", 1, 2), ("not_finite.obj", 1, 2), ("no_end.obj", 1, 0)] {
        let (sink, report) = collect(&data(name)).unwrap();
        assert_eq!(report.micropolygons, left, "{name}");
        assert_eq!(
            report.skipped.iter().map(|skip| skip.1).sum::<u64>(),
            skipped,
            "{name}: {:?}",
            report.skipped
        );
        assert!(sink.bounds().size().is_finite());
    }
}

/// Catches a file that needs more memory than allowed and is read, or refused without a way out.
#[test]
fn the_memory_limit_holds() {
    let Some(folder) = folder() else { return };
    for name in ["terrain_dem/terrain_far_quads.obj", "points/pond.0.ply", "trees_eztree/oak_medium.glb"] {
        let options = ImportOptions { memory_bytes: 1 << 20, ..ImportOptions::default() };
        let error = import(&folder.join(name), &options, &mut Collect::default()).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Limit, "{error}");
        assert!(error.hint_text().is_some());
    }
}

/// One small file of each format, and what is beside it.
fn samples() -> Vec<(&'static str, Vec<u8>)> {
    let read = |name| std::fs::read(data(name)).unwrap();
    vec![
        ("ply", read("quads_ascii.ply")),
        ("ply", read("quads_big_endian.ply")),
        ("obj", read("groups.obj")),
        ("gltf", read("triangles.gltf")),
        ("glb", binary(&read("triangles.gltf"))),
    ]
}

/// A GLB of a document with data URIs.
fn binary(json: &[u8]) -> Vec<u8> {
    let mut json = json.to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut file = b"glTF\x02\0\0\0".to_vec();
    file.extend(((20 + json.len()) as u32).to_le_bytes());
    file.extend((json.len() as u32).to_le_bytes());
    file.extend(b"JSON");
    file.extend(json);
    file
}

/// Imports bytes under a small limit. Broken or not, it must end soon.
fn import_bytes(extension: &str, bytes: &[u8]) -> Result<ImportReport> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sample").with_extension(extension);
    std::fs::write(&path, bytes).unwrap();
    let options = ImportOptions { memory_bytes: 16 << 20, ..ImportOptions::default() };
    let start = Instant::now();
    let outcome = import(&path, &options, &mut Collect::default());
    assert!(start.elapsed().as_secs() < 20, "took {:?}", start.elapsed());
    outcome
}

/// Catches a panic or a made-up face where a file is cut off.
#[test]
fn truncated_files_never_panic() {
    for (extension, bytes) in samples() {
        let whole = import_bytes(extension, &bytes).unwrap();
        for part in 0..50 {
            if let Ok(report) = import_bytes(extension, &bytes[..bytes.len() * part / 50]) {
                assert!(report.micropolygons <= whole.micropolygons);
                assert_eq!(extension, "obj", "only OBJ has no end that could be missed");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Catches a panic, a hang or a broken grid after bits have flipped anywhere.
    #[test]
    fn flipped_bits_never_panic(which in 0_usize..5, flips in prop::collection::vec((any::<prop::sample::Index>(), 0_u8..8), 1..6)) {
        let (extension, mut bytes) = samples().swap_remove(which);
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        let _ = import_bytes(extension, &bytes);
    }

    /// Catches numbers that overflow: any digit may become a run of nines.
    #[test]
    fn numbers_that_overflow_never_panic(which in 0_usize..4, at in any::<prop::sample::Index>(), nines in 1_usize..22) {
        let (extension, mut bytes) = samples().swap_remove(which);
        let digits: Vec<usize> = (0..bytes.len()).filter(|&i| bytes[i].is_ascii_digit()).collect();
        let at = digits[at.index(digits.len())];
        bytes.splice(at..=at, std::iter::repeat_n(b'9', nines));
        let _ = import_bytes(extension, &bytes);
    }
}

/// Catches a sample that is not read as written: objects, mixed arities, opacity and units.
#[test]
fn samples_are_read_as_written() {
    let (sink, report) = collect(&data("groups.obj")).unwrap();
    assert_eq!(
        (report.source.quads, report.source.ngons, report.source.lines, report.source.points),
        (2, 1, 2, 1)
    );
    let ids: std::collections::BTreeSet<u32> = sink.values("id").iter().map(|&id| id as u32).collect();
    assert_eq!(ids.len(), 2);
    assert_eq!(sink.values("radius").iter().filter(|&&radius| radius > 0.0).count(), 4);
    let (_, report) = collect(&data("quads_big_endian.ply")).unwrap();
    let (ascii, same) = collect(&data("quads_ascii.ply")).unwrap();
    assert_eq!(report, same);
    assert!(ascii.values("albedo").iter().any(|&red| red > 0.9));

    let options = ImportOptions { meters_per_unit: 0.01, up: UpAxis::Z, ..ImportOptions::default() };
    let mut sink = Collect::default();
    let report = import(&data("triangles.gltf"), &options, &mut sink).unwrap();
    assert_eq!((report.source.triangles, report.source.lines, report.source.points), (8, 4, 0));
    let bounds = sink.bounds();
    // The document's unit square stands 3 m up and is mirrored by one of its nodes
    assert!((bounds.max.z - 400.0).abs() < 1e-3, "{bounds:?}");
}
