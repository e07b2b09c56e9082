//! Tests of parts: what was encoded comes back, and nothing else is taken for a part.

use super::*;
use proptest::prelude::*;

/// A format with a single, a half and a byte attribute: 15 bytes a row.
pub fn format() -> PartFormat {
    let attributes = [
        Attribute::vertex("occlusion", ValueType::F32, 2),
        Attribute::vertex("error", ValueType::F16, 3),
        Attribute::vertex("flag", ValueType::U8, 1),
    ];
    PartFormat::new(0xfeed, &attributes, 512).expect("a format")
}

/// A part whose values follow from its points; points that `skip` chooses are not computed.
pub fn part(format: &PartFormat, batch: u32, indices: &[u64], skip: impl Fn(u64) -> bool) -> Part {
    let mut part = Part::default();
    part.start(batch, indices.iter().copied(), format);
    for (row, &index) in indices.iter().enumerate() {
        if !skip(index) {
            part.set_row(format, row, &values(index));
        }
    }
    part
}

/// The six values of a point in [`format`]; exact in half precision.
pub fn values(index: u64) -> [f32; 6] {
    let x = (index % 1000) as f32;
    [x, -0.25 * x, x + 1.0, 2.0 - x, 0.5, (index % 200) as f32]
}

fn decode(bytes: &[u8], format: &PartFormat) -> Result<Part> {
    let mut part = Part::default();
    part.decode(bytes, format, Path::new("7.part"), 100).map(|()| part)
}

fn encoded(format: &PartFormat) -> Vec<u8> {
    let mut bytes = Vec::new();
    let part = part(format, 7, &[40, 3, 1_000_000, 41, u64::MAX], |index| index == 41);
    part.encode(format, &mut bytes).expect("encoded");
    bytes
}

/// Catches rows that part from their points when sorted, and values that change type.
#[test]
fn a_part_comes_back_in_the_order_of_its_points() {
    let format = format();
    assert_eq!(format.row_bytes(), 15);
    let got = decode(&encoded(&format), &format).expect("decoded");
    assert_eq!(got.batch, 7);
    assert_eq!(got, part(&format, 7, &[3, 40, 41, 1_000_000, u64::MAX], |index| index == 41));
    let row = got.row(&format, 1);
    assert_eq!(row[..8], [40.0f32.to_le_bytes(), (-10.0f32).to_le_bytes()].concat());
    assert_eq!(row[8..10], half::f16::from_f32(41.0).to_le_bytes());
    assert_eq!(row[14], 40);
    assert!(encoded(&format).len() <= format.part_bytes_max());
}

/// Catches any flipped bit or cut that passes for a part: every bit, every length.
#[test]
fn damage_is_found_with_its_place() {
    let format = format();
    let sound = encoded(&format);
    for bit in 0..8 * sound.len() {
        let mut bytes = sound.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let error = decode(&bytes, &format).expect_err("damage");
        assert!(error.to_string().starts_with("7.part: byte "), "{error}");
    }
    for length in 0..sound.len() {
        decode(&sound[..length], &format).expect_err("a cut");
    }
}

/// Catches lengths and indices that a liar with the right checksum sends: reads past the end, overflow, wide rows.
#[test]
fn lies_with_a_good_checksum_are_found() {
    let format = format();
    let sound = encoded(&format);
    let reseal = |mut bytes: Vec<u8>| {
        let end = bytes.len() - 8;
        let checksum = xxh3_64(&bytes[..end]);
        bytes[end..].copy_from_slice(&checksum.to_le_bytes());
        bytes
    };
    decode(&reseal(sound.clone()), &format).expect("sound");
    for at in (8..sound.len() - 8).filter(|at| !(12..16).contains(at)) {
        for value in [0, 1, 0x7f, 0x80, 0xff] {
            let mut bytes = sound.clone();
            bytes[at] = value;
            // Rows may hold anything and small changes of an index make another sound part; nothing may panic.
            let _ = decode(&reseal(bytes), &format);
        }
    }
    for (at, lie) in [(24, u32::MAX), (24, 0), (28, u32::MAX), (32, u32::MAX), (36, u32::MAX), (36, 0)] {
        let mut bytes = sound.clone();
        bytes[at..at + 4].copy_from_slice(&lie.to_le_bytes());
        assert_eq!(decode(&reseal(bytes), &format).expect_err("a lie").kind(), ErrorKind::Corrupt);
    }
    let indices = HEADER_BYTES + format.layout().len();
    let mut bytes = sound.clone();
    bytes[indices + 2..][..6].fill(0xff);
    assert_eq!(decode(&reseal(bytes), &format).expect_err("too large an index").kind(), ErrorKind::Corrupt);
}

/// Catches results of another bake, or of other attributes, that are mixed in.
#[test]
fn a_part_of_another_bake_is_refused() {
    let bytes = encoded(&format());
    let other = PartFormat::new(0xbeef, format().attributes(), 512).expect("a format");
    assert_eq!(decode(&bytes, &other).expect_err("another bake").kind(), ErrorKind::Invalid);
    let mut attributes = format().attributes().to_vec();
    attributes[0].name = "visibility".into();
    let other = PartFormat::new(0xfeed, &attributes, 512).expect("a format");
    assert_eq!(decode(&bytes, &other).expect_err("other attributes").kind(), ErrorKind::Invalid);
    let smaller = PartFormat::new(0xfeed, format().attributes(), 4).expect("a format");
    assert_eq!(decode(&bytes, &smaller).expect_err("too many points").kind(), ErrorKind::Corrupt);
}

/// Catches NaN, infinity and halves that overflow on their way into a result, and points that are there twice.
#[test]
fn what_is_not_finite_or_twice_is_not_encoded() {
    let format = format();
    for (component, value) in [(1, f32::NAN), (0, f32::INFINITY), (3, 1e6)] {
        let mut part = part(&format, 7, &[5, 6], |_| false);
        let mut row = values(6);
        row[component] = value;
        part.set_row(&format, 1, &row);
        let error = part.encode(&format, &mut Vec::new()).expect_err("not finite");
        let name = if component < 2 { "occlusion" } else { "error" };
        assert_eq!(error.message(), format!("`{name}` of point `6` in batch `7` is not a finite number"));
    }
    part(&format, 7, &[5, 6, 5], |_| false).encode(&format, &mut Vec::new()).expect_err("twice");
    part(&format, 7, &[], |_| false).encode(&format, &mut Vec::new()).expect_err("empty");
}

/// Catches formats that no stream could hold.
#[test]
fn impossible_formats_are_refused() {
    let twice = [Attribute::vertex("a", ValueType::F32, 1), Attribute::vertex("a", ValueType::F16, 1)];
    let good = [Attribute::vertex("a", ValueType::F32, 9)];
    PartFormat::new(1, &good, 2048).expect("good");
    for (attributes, points_max) in
        [(&[][..], 2048), (&twice, 2048), (&[Attribute::grid("a", ValueType::F32, 1)], 2048), (&good, 0)]
    {
        PartFormat::new(1, attributes, points_max).expect_err("impossible");
    }
}

/// Catches a header for inspectors that says something else than the part.
#[test]
fn the_header_says_what_is_inside() {
    let format = format();
    let header = PartHeader::decode(&encoded(&format), Path::new("7.part"), 0).expect("a header");
    assert_eq!((header.batch, header.bake, header.points), (7, 0xfeed, 5));
    assert_eq!(header.attributes, format.attributes());
}

proptest! {
    /// Catches indices that the steps lose, for any set of points and any coverage.
    #[test]
    fn any_part_comes_back(
        indices in prop::collection::btree_set(prop_oneof![any::<u64>(), 0u64..300], 1..200),
        skip in any::<u64>(),
    ) {
        let format = format();
        let sorted: Vec<u64> = indices.into_iter().collect();
        let skipped = |index: u64| (index ^ skip).is_multiple_of(5);
        let expected = part(&format, 1, &sorted, skipped);
        let mut shuffled = sorted;
        shuffled.sort_by_key(|index| index.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mut bytes = Vec::new();
        part(&format, 1, &shuffled, skipped).encode(&format, &mut bytes).expect("encoded");
        prop_assert_eq!(decode(&bytes, &format).expect("decoded"), expected);
    }
}
