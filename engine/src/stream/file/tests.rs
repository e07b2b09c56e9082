//! Round trips, flipped bits and lies in `.mgs` files.

use std::path::Path;

use glam::{DVec3, Vec3};
use proptest::prelude::*;
use xxhash_rust::xxh3::{xxh3_64, xxh3_64_with_seed};

use super::*;
use crate::error::{ErrorKind, Place};
use crate::stream::{Attribute, MicrogridStream, Schema, ValueType};

fn schema() -> Schema {
    Schema {
        attributes: vec![
            Attribute::vertex("N", ValueType::F32, 3),
            Attribute::vertex("opacity", ValueType::F16, 1),
            Attribute::vertex("albedo", ValueType::U8, 3),
            Attribute::grid("id", ValueType::U32, 1),
        ],
        ..Schema::default()
    }
}

/// A strip of `quads` quads whose values differ with `seed`.
fn strip(schema: &Schema, seed: u32, quads: usize) -> Microgrid {
    let mut grid = Microgrid::default();
    grid.clear(schema.attributes.len());
    grid.anchor = DVec3::new(f64::from(seed), 1e6, -0.125);
    let mut state = seed;
    let mut random = move || {
        state = crate::math::hash::combine(state, 1);
        crate::math::hash::unit_f32(state)
    };
    for i in 0..2 * (quads + 1) {
        grid.positions.push(Vec3::new(i as f32 + random(), random(), -random()));
    }
    for quad in 0..quads as u8 {
        grid.push_face(&[2 * quad, 2 * quad + 1, 2 * quad + 3, 2 * quad + 2]);
    }
    for (index, attribute) in schema.attributes.iter().enumerate() {
        let values = if attribute.rate == crate::stream::Rate::Vertex { grid.vertex_count() } else { 1 };
        let values: Vec<f32> =
            (0..values * usize::from(attribute.components)).map(|_| 200.0 * random()).collect();
        grid.push_values(attribute, index, &values);
    }
    grid
}

fn write(path: &Path, schema: &Schema, grids: &[Microgrid]) -> StreamCounts {
    let mut writer = MgsWriter::create(path, schema, &[("sh".into(), "real, l(l+1)+m".into())]).unwrap();
    grids.iter().for_each(|grid| writer.write(grid).unwrap());
    writer.finish().unwrap()
}

/// Reads a file grid by grid, and sees that pieces give the same grids or the same error.
fn read(path: &Path) -> crate::Result<Vec<Microgrid>> {
    let grid_by_grid = || {
        let mut reader = MgsReader::open(path)?;
        let (mut grids, mut grid) = (Vec::new(), Microgrid::default());
        while reader.next(&mut grid)? {
            grids.push(grid.clone());
        }
        Ok(grids)
    };
    let in_pieces = || {
        let mut reader = MgsReader::open(path)?;
        let (mut grids, mut grid) = (Vec::new(), Microgrid::default());
        while let Some(piece) = reader.next_piece()? {
            let mut push = |grid: &Microgrid| {
                grids.push(grid.clone());
                Ok(())
            };
            piece.read(&mut grid, &mut push)?;
        }
        Ok(grids)
    };
    let (read, pieces): (crate::Result<Vec<Microgrid>>, crate::Result<_>) = (grid_by_grid(), in_pieces());
    match (&read, &pieces) {
        (Ok(read), Ok(pieces)) => assert!(read == pieces),
        (Err(read), Err(pieces)) => assert_eq!(read.to_string(), pieces.to_string()),
        _ => panic!("{read:?} but in pieces {pieces:?}"),
    }
    read
}

/// Catches a lost or mixed-up column, counts that do not fit, a rewind that does not, and block boundaries.
#[test]
fn grids_come_back_bit_exact() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mgs");
    let schema = schema();
    let grids: Vec<Microgrid> = (0..2000).map(|i| strip(&schema, i, 1 + i as usize % 100)).collect();
    let counts = write(&path, &schema, &grids);
    assert_eq!(counts.grids, 2000);
    let mut reader = MgsReader::open(&path).unwrap();
    assert_eq!(reader.schema(), &schema);
    assert_eq!(reader.metadata(), [("sh".to_string(), "real, l(l+1)+m".to_string())]);
    let footer = reader.footer().unwrap();
    assert_eq!(footer.counts, counts);
    assert!(footer.blocks > 3);
    let mut grid = Microgrid::default();
    for _ in 0..2 {
        for expected in &grids {
            assert!(reader.next(&mut grid).unwrap());
            assert_eq!(&grid, expected);
        }
        assert!(!reader.next(&mut grid).unwrap());
        assert!(!reader.next(&mut grid).unwrap());
        reader.rewind().unwrap();
    }
}

/// A reader that comes to an end: the grids, or the error.
fn read_bytes(folder: &Path, bytes: &[u8]) -> crate::Result<Vec<Microgrid>> {
    let path = folder.join("broken.mgs");
    std::fs::write(&path, bytes).unwrap();
    read(&path)
}

/// The error for these bytes; it must say at which byte.
fn refusal(folder: &Path, bytes: &[u8]) -> (ErrorKind, u64, String) {
    let error = read_bytes(folder, bytes).expect_err("broken bytes were read");
    match error.place() {
        Some(Place::Byte { offset, .. }) => (error.kind(), *offset, error.message().to_string()),
        place => panic!("no byte: {error} at {place:?}"),
    }
}

/// A small file: its bytes and where the first block begins.
fn small_file(folder: &Path) -> (Vec<u8>, usize) {
    let path = folder.join("small.mgs");
    let schema = schema();
    write(&path, &schema, &[strip(&schema, 1, 2), strip(&schema, 2, 1)]);
    let bytes = std::fs::read(path).unwrap();
    let header = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    (bytes, header)
}

/// Catches any bit that no checksum covers.
#[test]
fn every_flipped_bit_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let (mut bytes, _) = small_file(folder.path());
    for bit in 0..8 * bytes.len() {
        bytes[bit / 8] ^= 1 << (bit % 8);
        let (kind, offset, _) = refusal(folder.path(), &bytes);
        assert!(matches!(kind, ErrorKind::Corrupt | ErrorKind::Unsupported), "bit {bit}");
        assert!(offset <= bytes.len() as u64);
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
}

/// Catches two contents with one identity, and one that reading changes.
#[test]
fn identities_tell_contents_apart() {
    let folder = tempfile::tempdir().unwrap();
    let schema = schema();
    let path = folder.path().join("a.mgs");
    let identity = |grids: &[Microgrid]| {
        write(&path, &schema, grids);
        let mut reader = MgsReader::open(&path).unwrap();
        let identity = reader.identity().unwrap();
        let mut grid = Microgrid::default();
        assert!(reader.next(&mut grid).unwrap() && grid == grids[0], "a file is not at its start");
        assert_eq!(reader.identity().unwrap(), identity);
        identity
    };
    let many: Vec<Microgrid> = (0..2000).map(|seed| strip(&schema, seed, 50)).collect();
    let mut moved = many.clone();
    moved[1500].positions[3].x += 0.001;
    let identities = [identity(&many), identity(&moved), identity(&many[..1999]), identity(&many)];
    assert_eq!(identities[0], identities[3]);
    assert!(identities[0] != identities[1] && identities[0] != identities[2]);
}

/// Catches a file that ends early and is taken for a shorter one, at a block's border too; and bytes after the end.
#[test]
fn every_truncation_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let (bytes, _) = small_file(folder.path());
    for length in 0..bytes.len() {
        let (kind, offset, _) = refusal(folder.path(), &bytes[..length]);
        assert_eq!((kind, offset <= length as u64), (ErrorKind::Corrupt, true), "{length} bytes");
    }
    refusal(folder.path(), &[&bytes[..], &[0]].concat());
}

/// Catches a foreign file or another version that is reported as mere corruption.
#[test]
fn wrong_magic_and_version_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let (bytes, _) = small_file(folder.path());
    let mut foreign = bytes.clone();
    foreign[..4].copy_from_slice(b"ply\n");
    let (kind, offset, message) = refusal(folder.path(), &foreign);
    assert_eq!((kind, offset), (ErrorKind::Corrupt, 0));
    assert!(message.contains(r"`ply\n"), "{message}");
    let mut newer = bytes;
    newer[8] = 7;
    let (kind, offset, message) = refusal(folder.path(), &newer);
    assert_eq!((kind, offset), (ErrorKind::Unsupported, 8));
    assert_eq!(message, "found .mgs version 7, version 1 is wanted");
}

/// Puts a forged block header with a right checksum in front of a file's frames.
fn forge(bytes: &[u8], at: usize, word: usize, value: u32) -> Vec<u8> {
    let mut forged = bytes.to_vec();
    forged[at + word..at + word + 4].copy_from_slice(&value.to_le_bytes());
    sign_block(&mut forged, at);
    forged
}

/// Renews the checksum of the block header at `at`.
fn sign_block(bytes: &mut [u8], at: usize) {
    let seed = u64::from_le_bytes(bytes[at - 8..at].try_into().unwrap()).wrapping_add(at as u64);
    let checksum = xxh3_64_with_seed(&bytes[at..at + 56], seed);
    bytes[at + 56..at + 64].copy_from_slice(&checksum.to_le_bytes());
}

/// Catches counts and lengths that are believed because their checksum is right: each lie must be refused at the
/// header, before anything is allocated for it.
#[test]
fn a_block_that_claims_the_impossible_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (bytes, block) = small_file(folder.path());
    for word in (4..36).step_by(4) {
        for value in [0, 1 << 16, 9 << 20, 1 << 31, u32::MAX] {
            let (kind, offset, message) = refusal(folder.path(), &forge(&bytes, block, word, value));
            let within = (block as u64..block as u64 + 64).contains(&offset);
            assert!(kind == ErrorKind::Corrupt && within, "word {word} = {value}: byte {offset}, {message}");
        }
    }
    refusal(folder.path(), &forge(&bytes, block, 36, 1));
    // 2^32 - 1 vertices in one grid.
    let (_, offset, message) = refusal(folder.path(), &forge(&bytes, block, 8, u32::MAX));
    assert_eq!(offset, block as u64 + 8);
    assert_eq!(message, "a block of 4294967295 vertices, 2 to 512 are possible");
}

/// Rebuilds a file's only block with its frames changed by `change`, checksums and all.
fn with_frames(bytes: &[u8], block: usize, change: impl Fn(&mut Vec<u8>, &mut Vec<u8>)) -> Vec<u8> {
    let word = |at: usize| u32::from_le_bytes(bytes[block + at..block + at + 4].try_into().unwrap()) as usize;
    let unpack = |start: usize, plain: usize, stored: usize| {
        let stored = &bytes[start..start + stored];
        if stored.len() == plain {
            stored.to_vec()
        } else {
            lz4_flex::block::decompress(stored, plain).unwrap()
        }
    };
    let mut summary = unpack(block + 64, word(20), word(24));
    let mut payload = unpack(block + 64 + word(24), word(28), word(32));
    change(&mut summary, &mut payload);
    let mut out = bytes[..block + 64].to_vec();
    for (at, checksum_at, frame) in [(24, 40, &summary), (32, 48, &payload)] {
        out[block + at..block + at + 4].copy_from_slice(&(frame.len() as u32).to_le_bytes());
        out[block + checksum_at..block + checksum_at + 8].copy_from_slice(&xxh3_64(frame).to_le_bytes());
    }
    sign_block(&mut out, block);
    out.extend_from_slice(&summary);
    out.extend_from_slice(&payload);
    let seed = u64::from_le_bytes(bytes[block - 8..block].try_into().unwrap());
    let footer_at = bytes.len() - footer::BYTES;
    let footer = bytes[footer_at..].as_array().unwrap();
    let footer = Footer::decode(footer, footer_at as u64, seed, Path::new("small.mgs")).unwrap();
    out.extend_from_slice(&footer.encode(out.len() as u64, seed));
    out
}

/// Catches content that is wrong although every checksum is right: what a hostile writer would make.
#[test]
fn lies_inside_a_block_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (bytes, block) = small_file(folder.path());
    // Two grids of 2 and 1 quads, 6 and 4 vertices: 3 arities, 12 indices, then positions.
    let unchanged = with_frames(&bytes, block, |_, _| {});
    assert_eq!(read_bytes(folder.path(), &unchanged).unwrap().len(), 2);
    type Change = fn(&mut Vec<u8>, &mut Vec<u8>);
    let lies: [(&str, Change); 10] = [
        ("not a finite", |_, payload| payload[15..19].copy_from_slice(&f32::NAN.to_le_bytes())),
        ("not a finite", |_, payload| payload[31..35].copy_from_slice(&f32::NEG_INFINITY.to_le_bytes())),
        ("not a finite", |summary, _| summary[8..16].copy_from_slice(&f64::INFINITY.to_le_bytes())),
        ("has 6 vertices and a face index 6", |_, payload| payload[4] = 6),
        ("has 4 vertices and a face index 255", |_, payload| payload[14] = 255),
        ("do not add up", |_, payload| payload[0] = 5),
        ("do not add up", |_, payload| payload[..2].copy_from_slice(&[8, 0])),
        ("do not add up", |summary, _| summary[72] = 9),
        ("do not add up", |summary, _| summary[74] = 1),
        ("middle vertex", |summary, _| summary[48] ^= 1),
    ];
    for (expected, change) in lies {
        let (kind, _, message) = refusal(folder.path(), &with_frames(&bytes, block, change));
        assert!(kind == ErrorKind::Corrupt && message.contains(expected), "{message}");
    }
    // The corners of two faces exchanged: sums fit, but the first grid would take the second's.
    let moved = with_frames(&bytes, block, |_, payload| payload[..3].copy_from_slice(&[4, 3, 4]));
    refusal(folder.path(), &moved);
}

/// Catches a reader that goes on behind an error as if nothing had happened.
#[test]
fn nothing_follows_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let (bytes, block) = small_file(folder.path());
    let path = folder.path().join("broken.mgs");
    std::fs::write(&path, with_frames(&bytes, block, |_, payload| payload[4] = 6)).unwrap();
    let mut reader = MgsReader::open(&path).unwrap();
    let mut grid = Microgrid::default();
    assert!(reader.next(&mut grid).is_err() && reader.next(&mut grid).is_err());
    reader.rewind().unwrap();
    assert!(reader.next(&mut grid).is_err());
}

/// Catches a summary that differs from its grid, and alternating calls that lose their place.
#[test]
fn summaries_tell_what_the_grids_hold() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mgs");
    let schema = schema();
    let grids: Vec<Microgrid> = (0..1000).map(|i| strip(&schema, i, 1 + i as usize % 90)).collect();
    write(&path, &schema, &grids);
    let mut reader = MgsReader::open(&path).unwrap();
    let mut grid = Microgrid::default();
    for pattern in [0xffff_ffff_u32, 0x0f31_5a01] {
        for (index, expected) in grids.iter().enumerate() {
            if pattern >> (index % 32) & 1 == 0 {
                assert!(reader.next(&mut grid).unwrap());
                assert_eq!(&grid, expected);
                continue;
            }
            let summary = reader.next_summary().unwrap().unwrap();
            assert_eq!(summary.anchor, expected.anchor);
            assert_eq!(summary.middle, expected.positions[expected.vertex_count() / 2]);
            assert_eq!(summary.vertices as usize, expected.vertex_count());
            assert_eq!(summary.faces as usize, expected.face_count());
        }
        assert_eq!(reader.next_summary().unwrap(), None);
        reader.rewind().unwrap();
    }
}

/// Catches a file that appears before it is complete, or stays when its writer gives up; and broken grids written.
#[test]
fn an_unfinished_file_does_not_appear() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mgs");
    let schema = schema();
    let mut writer = MgsWriter::create(&path, &schema, &[]).unwrap();
    (0..500).for_each(|i| writer.write(&strip(&schema, i, 99)).unwrap());
    let mut broken = strip(&schema, 0, 2);
    broken.positions[1].y = f32::NAN;
    assert_eq!(writer.write(&broken).unwrap_err().kind(), ErrorKind::Invalid);
    assert!(!path.exists());
    drop(writer);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Catches limits that are not checked when a file is begun.
#[test]
fn a_header_beyond_the_limits_is_not_begun() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mgs");
    let create = |schema: &Schema, metadata: &[(&str, &str)]| {
        let metadata: Vec<_> = metadata.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect();
        MgsWriter::create(&path, schema, &metadata).err().map(|error| error.kind())
    };
    let wide = (0..64).map(|i| Attribute::vertex(&format!("a{i}"), ValueType::F32, 256)).collect();
    assert_eq!(create(&Schema { attributes: wide, ..Schema::default() }, &[]), Some(ErrorKind::Limit));
    let long = "x".repeat(HEADER_BYTES_MAX);
    assert_eq!(create(&Schema::default(), &[("a", &long)]), Some(ErrorKind::Limit));
    assert_eq!(create(&Schema::default(), &[("a", "1"), ("a", "2")]), Some(ErrorKind::Invalid));
    assert_eq!(create(&Schema::default(), &[("a", "1"), ("b", "")]), None);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Catches an empty stream that cannot be written or read.
#[test]
fn no_grids_are_a_stream_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("empty.mgs");
    assert_eq!(write(&path, &Schema::default(), &[]).grids, 0);
    assert!(read(&path).unwrap().is_empty());
    assert!(MgsReader::open(&path).unwrap().footer().unwrap().counts.bounds.is_empty());
}

prop_compose! {
    /// Any grid that fits the schema: points, lines, triangles and quads in any mixture.
    fn any_grid()(
        anchor in prop::array::uniform3(-1e12..1e12f64),
        positions in prop::collection::vec(prop::array::uniform3(any::<f32>().prop_filter("finite", |x| x.is_finite())), 1..=256),
        faces in prop::collection::vec((1..=4usize, any::<[u8; 4]>()), 0..60),
        fill in any::<u8>(),
    ) -> Microgrid {
        let mut grid = Microgrid::default();
        let count = positions.len();
        grid.anchor = DVec3::from_array(anchor);
        grid.positions = positions.into_iter().map(Vec3::from_array).collect();
        for (arity, corners) in faces {
            let corners = corners.map(|corner| (usize::from(corner) % count) as u8);
            grid.push_face(&corners[..arity]);
        }
        // Any bytes at all, NaNs included: attribute values are not judged.
        let column = |bytes: usize| (0..bytes).map(|i| (i as u8).wrapping_mul(fill)).collect();
        grid.columns = vec![column(12 * count), column(2 * count), column(3 * count), column(4)];
        grid
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Catches any grid that does not come back bit by bit.
    #[test]
    fn arbitrary_grids_come_back(grids in prop::collection::vec(any_grid(), 0..8)) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mgs");
        write(&path, &schema(), &grids);
        let bits = |grid: &Microgrid| {
            let positions: Vec<_> = grid.positions.iter().map(|p| p.to_array().map(f32::to_bits)).collect();
            (grid.anchor.to_array().map(f64::to_bits), positions, grid.arities.clone(), grid.indices.clone(), grid.columns.clone())
        };
        let back = read(&path).unwrap();
        prop_assert_eq!(back.iter().map(bits).collect::<Vec<_>>(), grids.iter().map(bits).collect::<Vec<_>>());
    }

    /// Catches a panic or an endless read for bytes that are no accident of a few bits.
    #[test]
    fn arbitrary_changes_never_pass(at in any::<prop::sample::Index>(), noise in prop::collection::vec(any::<u8>(), 1..80)) {
        let folder = tempfile::tempdir().unwrap();
        let (bytes, _) = small_file(folder.path());
        let mut changed = bytes.clone();
        let at = at.index(bytes.len());
        for (slot, noise) in changed[at..].iter_mut().zip(&noise) {
            *slot = *noise;
        }
        if changed != bytes {
            refusal(folder.path(), &changed);
        }
    }
}
