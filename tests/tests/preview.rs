//! Previews of small streams, written and read back.

use std::path::Path;

use engine::preview::{NODE_BYTES_MAX, Preview, write_preview};
use engine::scene::{Domain, UpAxis, Weight};
use engine::stream::file::{MgsReader, MgsWriter};
use engine::stream::{Attribute, Microgrid, Schema, ValueType};
use glam::{DVec3, Vec3};

/// A stream of `count` points on a wavy sheet 100 units wide, a kilometre from the origin, of which every `hole`-th has no
/// result. The first coefficient of a point is its x.
fn stream(path: &Path, count: usize, hole: usize) -> MgsReader {
    stream_with(path, count, hole, false)
}

/// The same; with `error`, its coefficients have one, which is a hundredth of x.
fn stream_with(path: &Path, count: usize, hole: usize, error: bool) -> MgsReader {
    let mut attributes = vec![
        Attribute::vertex("N", ValueType::F32, 3),
        Attribute::vertex("albedo", ValueType::F32, 3),
        Attribute::vertex("sky", ValueType::F32, 9),
        Attribute::vertex("baked", ValueType::U8, 1),
    ];
    if error {
        attributes.push(Attribute::vertex("sky_error", ValueType::F32, 1));
    }
    let schema = Schema { attributes, up: UpAxis::Z, ..Schema::default() };
    let noted = [("sky.shader", "sh_occlusion"), ("sky.weight", "cosine")];
    let metadata: Vec<_> = noted.map(|(key, value)| (key.to_string(), value.to_string())).into();
    let mut writer = MgsWriter::create(path, &schema, &metadata).unwrap();
    let mut grid = Microgrid::default();
    for first in (0..count).step_by(200) {
        grid.clear(schema.attributes.len());
        grid.anchor = DVec3::new(1_000.0, 0.0, 0.0);
        for at in first..(first + 200).min(count) {
            let (x, y) = (100.0 * (at as f32 * 0.618_034).fract(), 100.0 * at as f32 / count as f32);
            grid.push_face(&[grid.positions.len() as u8]);
            grid.positions.push(Vec3::new(x, y, (x * 0.1).sin()));
            grid.push_values(&schema.attributes[0], 0, &[0.0, 0.6, -0.8]);
            grid.push_values(&schema.attributes[1], 1, &[1.0, 0.5, 0.0]);
            grid.push_values(&schema.attributes[2], 2, &[x, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.25]);
            grid.push_values(&schema.attributes[3], 3, &[if at % hole == 0 { 0.0 } else { 1.0 }]);
            if error {
                grid.push_values(&schema.attributes[4], 4, &[0.01 * x]);
            }
        }
        writer.write(&grid).unwrap();
    }
    writer.finish().unwrap();
    MgsReader::open(path).unwrap()
}

/// A finite 16-bit float.
fn f16(bytes: &[u8]) -> f32 {
    let bits = u16::from_le_bytes(bytes.try_into().unwrap());
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023));
    let size = if exponent == 0 {
        fraction * 2f32.powi(-24)
    } else {
        (1.0 + fraction / 1024.0) * 2f32.powi(exponent - 15)
    };
    if bits >> 15 == 1 { -size } else { size }
}

/// A normal as a record has it.
fn normal(bytes: &[u8]) -> Vec3 {
    let at = |at: usize| f32::from(i16::from_le_bytes([bytes[at], bytes[at + 1]])) / 32_767.0;
    let (x, y) = (at(0), at(2));
    let z = 1.0 - x.abs() - y.abs();
    let fold = (-z).max(0.0);
    let inward = |value: f32| if value < 0.0 { value + fold } else { value - fold };
    Vec3::new(inward(x), inward(y), z).normalize()
}

/// Catches points that are lost, doubled or moved, coefficients that go to another point, and nodes that a viewer would
/// look for elsewhere.
#[test]
fn every_point_is_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = stream(&folder.path().join("in.mgs"), 30_000, 3);
    let target = folder.path().join("out.preview");
    let report = write_preview(&mut stream, &target, 1 << 30, &mut |_| {}).unwrap();
    assert_eq!((report.points, report.baked), (20_000, 20_000));
    assert_eq!(report.bytes, std::fs::metadata(&target).unwrap().len());

    let mut preview = Preview::open(&target).unwrap();
    let header = preview.header.clone();
    assert_eq!((header.up, header.bands, header.weight), (UpAxis::Z, 3, Weight::Cosine));
    assert_eq!((header.domain, header.has), (Domain::Hemisphere, [true, true]));
    assert_eq!((header.attribute.as_str(), header.record_bytes()), ("sky", 32));
    let (mut corners, mut next, mut bytes, mut seen) = (vec![header.corner], 1, Vec::new(), Vec::new());
    for number in 0..preview.nodes.len() {
        let node = preview.nodes[number];
        let edge = header.edge / f64::from(1 << node.level);
        for child in (0..8).filter(|child| node.children >> child & 1 == 1) {
            let half = DVec3::from_array(std::array::from_fn(|axis| f64::from(child >> axis & 1)));
            corners.push(corners[number] + 0.5 * edge * half);
            assert_eq!(preview.nodes[next].level, node.level + 1);
            next += 1;
        }
        preview.read(number, &mut bytes).unwrap();
        assert!(node.points > 0 && bytes.len() <= NODE_BYTES_MAX && node.spacing > 0.0);
        for record in bytes.chunks_exact(header.record_bytes()) {
            let at = |axis: usize| f64::from(u16::from_le_bytes([record[2 * axis], record[2 * axis + 1]]));
            let place = corners[number] + edge / 65_535.0 * DVec3::new(at(0), at(1), at(2));
            let x = place.x - 1_000.0;
            // Half a step of the quantisation, and half of one of the 16-bit float
            assert!((f64::from(f16(&record[14..16])) - x).abs() < edge / 131_000.0 + 0.04, "{x}");
            assert!((place.z - (x * 0.1).sin()).abs() < 0.01);
            assert_eq!((f16(&record[16..18]), f16(&record[30..32])), (1.5, -0.25));
            assert_eq!(record[10..14], [255, 188, 0, 0]);
            assert!((normal(&record[6..10]) - Vec3::new(0.0, 0.6, -0.8)).length() < 1e-4);
            seen.push((place.y * 1e4) as i64);
        }
    }
    assert_eq!(next, preview.nodes.len());
    seen.sort_unstable();
    seen.dedup();
    assert!(seen.len() > 19_900, "{} different places", seen.len());
    // 8,192 points of 32 bytes fill a node: the root's are a fair sample of all
    assert_eq!(preview.nodes[0].points, 8_192);
    assert!((preview.nodes[0].spacing - 1.1).abs() < 0.3, "{}", preview.nodes[0].spacing);
}

/// Catches an error that is not looked for, belongs to another point, or stands where a reader does not expect it; and files
/// of the version before that are refused.
#[test]
fn points_have_the_error_of_their_coefficients() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = stream_with(&folder.path().join("in.mgs"), 2_000, 3, true);
    let target = folder.path().join("out.preview");
    write_preview(&mut stream, &target, 1 << 30, &mut |_| {}).unwrap();
    let mut preview = Preview::open(&target).unwrap();
    assert_eq!((preview.header.has_error, preview.header.record_bytes()), (true, 36));
    let mut bytes = Vec::new();
    preview.read(0, &mut bytes).unwrap();
    for record in bytes.chunks_exact(36) {
        let (x, error) = (f16(&record[14..16]), f16(&record[32..34]));
        assert!((error - 0.01 * x).abs() < 0.002 && record[34..] == [0, 0], "{x} {error}");
    }

    // Version 1 is the same without it
    let mut stream = self::stream(&folder.path().join("old.mgs"), 2_000, 3);
    write_preview(&mut stream, &target, 1 << 30, &mut |_| {}).unwrap();
    let mut old = std::fs::read(&target).unwrap();
    old[8] = 1;
    let sum = u32::from_le_bytes(old[12..16].try_into().unwrap()) as usize - 4;
    let crc = crc32(&old[..sum]);
    old[sum..sum + 4].copy_from_slice(&crc.to_le_bytes());
    std::fs::write(&target, old).unwrap();
    assert!(!Preview::open(&target).unwrap().header.has_error);
}

/// CRC-32 (IEEE), bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let bit = |sum: u32| if sum & 1 == 1 { sum >> 1 ^ 0xedb8_8320 } else { sum >> 1 };
    !bytes.iter().fold(!0, |sum, &byte| (0..8).fold(sum ^ u32::from(byte), |sum, _| bit(sum)))
}

/// Catches a preview that outgrows its memory, and one that differs from run to run.
#[test]
fn memory_bounds_the_points() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = stream(&folder.path().join("in.mgs"), 30_000, usize::MAX);
    let target = |name: &str| folder.path().join(name);
    let report = write_preview(&mut stream, &target("a"), 300_000, &mut |_| {}).unwrap();
    assert_eq!(report.baked, 29_999);
    assert!((3_500..=5_000).contains(&report.points), "{}", report.points);
    write_preview(&mut stream, &target("b"), 300_000, &mut |_| {}).unwrap();
    assert!(std::fs::read(target("a")).unwrap() == std::fs::read(target("b")).unwrap());
}

/// Catches damage that goes unseen, anywhere in the file.
#[test]
fn damage_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = stream(&folder.path().join("in.mgs"), 10_000, 7);
    let target = folder.path().join("out.preview");
    write_preview(&mut stream, &target, 1 << 30, &mut |_| {}).unwrap();
    let good = std::fs::read(&target).unwrap();
    let broken = |bytes: &[u8]| {
        std::fs::write(&target, bytes).unwrap();
        let mut all = Vec::new();
        Preview::open(&target).and_then(|mut preview| {
            (0..preview.nodes.len()).try_for_each(|node| preview.read(node, &mut all))
        })
    };
    broken(&good).unwrap();
    for at in (0..good.len()).step_by(good.len() / 97) {
        let mut bad = good.clone();
        bad[at] ^= 0x10;
        assert!(broken(&bad).is_err(), "byte {at}");
    }
    for length in [0, 10, 151, 152, 170, good.len() / 2, good.len() - 1] {
        assert!(broken(&good[..length]).is_err(), "{length} bytes");
    }
    assert!(broken(&[&good[..], &[0]].concat()).is_err());
}

/// Catches a stream in one place, or with nothing baked, that ends in a panic or an endless descent.
#[test]
fn odd_streams_have_an_end() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("out.preview");
    let mut nothing = stream(&folder.path().join("a.mgs"), 200, 1);
    let error = write_preview(&mut nothing, &target, 1 << 30, &mut |_| {}).unwrap_err();
    assert_eq!(error.kind(), engine::ErrorKind::NotFound);
    let mut single = stream(&folder.path().join("b.mgs"), 2, 2);
    assert_eq!(write_preview(&mut single, &target, 1 << 30, &mut |_| {}).unwrap().points, 1);
    Preview::open(&target).unwrap();
}
