//! Leaves through encoder and plain decoder.

use super::*;
use crate::math::hash::hash32;

fn random_face(seed: &mut u32, arity: u8, extent: u32, shift: u8, corner: IVec3) -> Face {
    let mut next = || {
        *seed = hash32(*seed);
        *seed
    };
    let mut vertices: [IVec3; 4] = std::array::from_fn(|_| {
        corner + IVec3::from_array(std::array::from_fn(|_| ((next() % extent) << shift) as i32))
    });
    // Neighbouring corners differ: the last one repeated is how a triangle is told from a quad
    if vertices[3] == vertices[2] {
        vertices[3].x += 1 << shift;
    }
    if vertices[1] == vertices[0] {
        vertices[1].x += 1 << shift;
    }
    for i in usize::from(arity)..4 {
        vertices[i] = vertices[usize::from(arity) - 1];
    }
    let extinction = if next() % 2 == 0 { OPAQUE } else { (next() % 60_000) as u16 };
    let radii = if arity > 2 { [0.0; 2] } else { [1.5, if arity == 1 { 1.5 } else { 0.25 }] };
    Face { vertices, arity, extinction, radii }
}

fn decode(bytes: &mut Vec<u8>, corner: IVec3) -> Vec<Face> {
    let length = bytes.len();
    bytes.resize(length + READ_PAST_BYTES, 0);
    let layout = Layout::read(bytes, corner).unwrap();
    assert!(layout.is_sound(bytes));
    assert_eq!(layout.bytes, length);
    let faces = (0..layout.faces).map(|i| layout.face(bytes, i)).collect();
    bytes.truncate(length);
    faces
}

/// Catches any bit lost between encoding and the plain decoder, whatever the corner: vertices must stay exact.
#[test]
fn leaves_round_trip() {
    let mut seed = 7;
    for case in 0..3000_u32 {
        let (shift, extent) = ((case % 4) as u8, [1, 3, 300, 1 << 20][case as usize % 4]);
        let corner = IVec3::new(-(8 << shift), 1 << 20, (case as i32 % 7) << shift);
        let kind = case % 5;
        let count = 1 + case as usize % if kind == 1 { 10 } else { FACES_MAX };
        let faces: Vec<Face> = (0..count)
            .map(|i| {
                let mixed = ((i as u32 + case) % 2) as u8;
                let arity = [1 + mixed, 3, 3 + mixed, 4, 2][kind as usize];
                random_face(&mut seed, arity, extent, shift, corner)
            })
            .collect();
        let mut bytes = Vec::new();
        encode(&faces, shift, corner, &mut bytes);
        assert_eq!(decode(&mut bytes, corner), faces, "case {case}");
        let lower = corner - IVec3::new(1, 13, case as i32 % 50);
        let mut lower_bytes = Vec::new();
        encode(&faces, shift, lower, &mut lower_bytes);
        assert_eq!(decode(&mut lower_bytes, lower), faces, "from a lower corner, case {case}");
    }
}

/// Catches a leaf of many triangles, which fill two groups of eight lanes, that loses the second.
#[test]
fn sixteen_triangles_fit() {
    let corner = IVec3::splat(-9);
    let at = |i: i32| corner + IVec3::new(i % 5, i / 5, i * i % 7) * 4;
    let faces: Vec<Face> = (0..16)
        .map(|i| i + i / 4)
        .map(|i| Face {
            vertices: [at(i), at(i + 1), at(i + 6), at(i + 6)],
            arity: 3,
            extinction: OPAQUE,
            radii: [0.0; 2],
        })
        .collect();
    let mut bytes = Vec::new();
    encode(&faces, 0, corner, &mut bytes);
    assert_eq!(decode(&mut bytes, corner), faces);
}

/// The faces of rows of quads over vertices in rows of `wide`, from vertex `first` on.
fn rows(vertices: &[IVec3], first: usize, [columns, rows, wide]: [usize; 3]) -> Vec<Face> {
    let at = |i: usize| vertices[i];
    let firsts = (0..columns * rows).map(|face| first + face / columns * wide + face % columns);
    let face = |a: usize| Face {
        vertices: [at(a), at(a + 1), at(a + wide + 1), at(a + wide)],
        arity: 4,
        extinction: 1000 + a as u16,
        radii: [0.0; 2],
    };
    firsts.map(face).collect()
}

/// Catches a tile that decodes to other faces than the same faces with indices, predicted or not, and one that is not
/// predicted though it is smooth.
#[test]
fn tiles_equal_their_faces() {
    for (columns, height) in [(4, 2), (2, 4), (8, 1), (1, 8), (3, 2), (1, 1), (7, 1)] {
        for roughness in [7, 200, 1 << 20] {
            let wide = columns + 1;
            let bend = |i: usize| (hash32(i as u32) % roughness) as i32;
            let vertices: Vec<IVec3> = (0..wide * (height + 1))
                .map(|i| IVec3::new((i % wide) as i32 * 300, (i / wide) as i32 * 290, 0) + bend(i) * 8)
                .map(|vertex| vertex / 8 * 8)
                .collect();
            let faces = rows(&vertices, 0, [columns, height, wide]);
            let extinctions: Vec<u16> = faces.iter().map(|face| face.extinction).collect();
            let corner = IVec3::new(-3, 0, -11);
            let mut bytes = Vec::new();
            let tile = Contents {
                kind: Kind::Tile,
                faces: faces.len(),
                stride: wide,
                shift: 3,
                vertices: &vertices,
                indices: &[],
                extinctions: &extinctions,
                radii: &[],
            };
            tile.encode(corner, &mut bytes);
            assert_eq!(decode(&mut bytes, corner), faces, "{columns} {height} {roughness}");
            let is_smooth = roughness == 7 && (9..=16).contains(&vertices.len());
            assert!(!is_smooth || bytes[3] & 0x80 != 0, "{columns} {height} is not predicted");
        }
    }
}

/// Catches short strips that store an index for every corner, or that decode to other faces.
#[test]
fn strips_are_stored_in_rows() {
    let random = |i: u32| IVec3::from_array([0, 1, 2].map(|axis| (hash32(3 * i + axis) % 5000) as i32));
    let vertices: Vec<IVec3> = (0..40).map(random).collect();
    let two_strips = [rows(&vertices, 0, [1, 4, 2]), rows(&vertices, 20, [1, 4, 2])].concat();
    let patches = [rows(&vertices, 0, [2, 2, 3]), rows(&vertices, 9, [2, 2, 3])].concat();
    let last_is_missing = rows(&vertices, 0, [2, 3, 3])[..5].to_vec();
    let fan: Vec<Face> = (0..4).map(|i| rows(&vertices, 7 * i, [1, 1, 2])[0]).collect();
    for (faces, in_rows) in [(two_strips, true), (patches, true), (last_is_missing, true), (fan, false)] {
        let mut bytes = Vec::new();
        encode(&faces, 0, IVec3::ZERO, &mut bytes);
        assert_eq!(bytes[3] & 0x80 != 0, in_rows);
        assert_eq!(decode(&mut bytes, IVec3::ZERO), faces);
    }
}

/// Catches a header that promises more than a leaf can be.
#[test]
fn impossible_leaves_are_refused() {
    let read = |header: u32| {
        let mut bytes = header.to_le_bytes().to_vec();
        bytes.resize(1024, 0);
        Layout::read(&bytes, IVec3::ZERO).is_some()
    };
    let tile = |rows: u32, columns: u32| (rows - 1) | (columns - 1) << 3 | 3 << 28;
    assert!(read(tile(2, 4)) && read(tile(8, 1)) && !read(tile(3, 3)) && !read(tile(1, 9)));
    assert!(read(30 << 13) && !read(31 << 13), "bits of a coordinate");
    assert!(read(20 << 8) && !read(21 << 8), "shift");
    assert!(read(1 << 28 | 1 << 31), "more than eight faces");
    assert!(!read(1 << 31), "rows without a stride");
    assert!(read(tile(2, 3) | 1 << 31) && !read(tile(8, 1) | 1 << 31), "vertices of a predicted tile");
}

/// Catches extinction that does not multiply as opacity does.
#[test]
fn extinctions_add_as_transmittances_multiply() {
    assert_eq!(extinction_from_opacity(0.5), 4096);
    assert_eq!(extinction_from_opacity(0.75), 8192);
    assert_eq!(extinction_from_opacity(0.0), 0);
    assert_eq!(extinction_from_opacity(1.0), OPAQUE);
}
