//! Tests of large meshes: what goes through files is what stays in memory.

use glam::{DVec3, Vec3};

use super::*;
use crate::import::assets::Collect;
use crate::import::mesh::Face;
use crate::stream::schema::names;

/// A bumpy sheet of `n` by `n` faces at a place, some of them broken, others polygons, with a few points and lines.
fn fill(elements: &mut Elements<'_>, n: u32, place: DVec3) -> ImportReport {
    let mut report = ImportReport::default();
    elements.mesh.single_precision = place == DVec3::ZERO;
    for i in 0..(n + 1) * (n + 1) {
        let (x, y) = (f64::from(i % (n + 1)), f64::from(i / (n + 1)));
        let z = 0.25 * ((x * 7.0 + y * 3.0) % 5.0);
        elements.mesh.positions.push(if i == 77 { DVec3::NAN } else { DVec3::new(x, y, z) + place });
        elements.mesh.colors.push([(i % 251) as u8, 3, 4]);
        elements.relieve().unwrap();
    }
    let normals = [Vec3::X, Vec3::Y];
    elements.mesh.normals.extend(normals);
    for i in 0..n * n {
        let at = i / n * (n + 1) + i % n;
        let quad = [at, at + 1, at + n + 2, at + n + 1];
        let face = Face {
            start: 0,
            arity: 0,
            material: 0,
            object: i % 3,
            opacity: if i.is_multiple_of(5) { 9 } else { 255 },
            hole: false,
        };
        let corners = match i % 11 {
            0 => &quad[..3],
            1 => &[at, at + 1, at + 1 + (n + 1), at + n + 1, at + (n + 1) - 1][..],
            2 => &quad[..2],
            3 => &quad[..1],
            _ => &quad[..],
        };
        elements.mesh.push_face(face, corners, &mut report).unwrap();
        let given = [0, NONE, 1, 0, NONE];
        elements.mesh.corner_normals.extend_from_slice(&given[..corners.len()]);
        elements.relieve().unwrap();
    }
    report
}

const NONE: u32 = crate::import::mesh::NO_NORMAL;

fn run(bytes_max: u64, n: u32, place: DVec3) -> (Collect, ImportReport) {
    let options = ImportOptions::default();
    let mut elements = Elements::new(Path::new("a.obj"), &options);
    (elements.bytes_max, elements.chunk_faces_max) = (bytes_max, 500);
    let mut report = fill(&mut elements, n, place);
    assert_eq!(elements.spill.is_some(), bytes_max < MESH_BYTES_MAX);
    let mut sink = Collect::default();
    elements.emit(&mut sink, &mut report).unwrap();
    (sink, report)
}

/// Every face with all that its vertices carry but the radius, sorted.
fn faces(sink: &Collect) -> Vec<Vec<[u64; 3]>> {
    let column = |name| sink.schema.find(name).unwrap();
    let columns = [names::NORMAL, names::ALBEDO].map(column);
    let opacity = column(names::OPACITY);
    let mut all = Vec::new();
    for grid in &sink.grids {
        for face in grid.faces() {
            let vertex = |&v: &u8| {
                let v = usize::from(v);
                let place = grid.position(v).to_array().map(f64::to_bits);
                let rest = columns.map(|column| grid.vec3(&sink.schema, column, v));
                let opacity = grid.value(&sink.schema, opacity, v, 0);
                let rest = rest.map(|v| v.to_array().map(|x| u64::from(x.to_bits())));
                [place, rest[0], rest[1], [u64::from(opacity.to_bits()), 0, 0]]
            };
            all.push(face.iter().flat_map(vertex).collect());
        }
    }
    all.sort();
    all
}

/// Catches a face, normal, colour, object or count that is lost, made up or changed on its way through the files.
#[test]
fn files_change_nothing() {
    let (whole, report) = run(MESH_BYTES_MAX, 60, DVec3::ZERO);
    let (parts, same) = run(20_000, 60, DVec3::ZERO);
    assert_eq!(whole.schema, parts.schema);
    assert_eq!(faces(&whole), faces(&parts));
    assert!(parts.grids.len() > 8);
    assert_eq!((report.source, &report.skipped), (same.source, &same.skipped));
    assert_eq!(report.micropolygons, same.micropolygons);
    let ids = |sink: &Collect| {
        let mut ids = [0; 3];
        for grid in &sink.grids {
            let column = sink.schema.find(names::ID).unwrap();
            ids[grid.value(&sink.schema, column, 0, 0) as usize] += grid.face_count();
        }
        ids
    };
    assert_eq!(ids(&whole), ids(&parts));
}

/// Catches shared vertices that differ between chunks, or move by more than a step.
#[test]
fn chunks_agree_far_from_the_origin() {
    let place = DVec3::new(4.1e6, 3.3e5, -12.0) + DVec3::splat(0.1);
    let (sink, _) = run(20_000, 60, place);
    let mut known = std::collections::BTreeMap::new();
    for grid in &sink.grids {
        for vertex in 0..grid.vertex_count() {
            let p = grid.position(vertex);
            let near = ((p - place) * 100.0).round().to_array().map(|x| x as i64);
            assert_eq!(*known.entry(near).or_insert(p), p);
            let off = ((p - place) * 4.0 - ((p - place) * 4.0).round()).abs().max_element() / 4.0;
            assert!(off < 1e-5, "{off}");
        }
    }
    assert!(known.len() > 3000 && sink.grids.len() > 8);
}

/// Catches a mesh that needs more than allowed and is read, or refused without a way out.
#[test]
fn too_little_memory_is_refused() {
    let options = ImportOptions { memory_bytes: 60_000, ..ImportOptions::default() };
    let mut elements = Elements::new(Path::new("a.obj"), &options);
    elements.mesh.positions = vec![DVec3::ZERO; 1000];
    let error = elements.relieve().unwrap_err();
    assert!(error.kind() == crate::ErrorKind::Limit && error.hint_text().is_some());
}
