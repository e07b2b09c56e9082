//! Limit surfaces against closed forms and against each other.

use std::collections::BTreeMap;

use glam::{DVec3, Vec3};
use proptest::prelude::*;

use super::cage::Cage;
use super::*;

/// A cage of polygons.
fn cage(positions: &[[f64; 3]], faces: &[&[u32]]) -> Cage {
    let mut cage = Cage { positions: positions.iter().map(|&p| p.into()).collect(), ..Cage::default() };
    for face in faces {
        cage.corners.extend_from_slice(face);
        cage.ends.push(cage.corners.len() as u32);
    }
    cage.sharp_corners = true;
    cage
}

fn cube() -> Cage {
    let positions: Vec<[f64; 3]> =
        (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|b| f64::from(2 * b - 1))).collect();
    cage(
        &positions,
        &[&[0, 2, 3, 1], &[4, 5, 7, 6], &[0, 1, 5, 4], &[2, 6, 7, 3], &[0, 4, 6, 2], &[1, 3, 7, 5]],
    )
}

/// A closed shape of triangles, quads and pentagons: a cube with a corner cut off, and that face split.
fn cut_cube() -> Cage {
    let mut positions = cube().positions.iter().map(|p| p.to_array()).collect::<Vec<_>>();
    positions[7] = [0.2, 1.0, 1.0];
    positions.extend([[1.0, 0.2, 1.0], [1.0, 1.0, 0.2]]);
    cage(
        &positions,
        &[
            &[0, 2, 3, 1],
            &[4, 5, 8, 7, 6],
            &[0, 1, 5, 4],
            &[2, 6, 7, 9, 3],
            &[0, 4, 6, 2],
            &[1, 3, 9, 8, 5],
            &[7, 8, 9],
        ],
    )
}

fn dice(cage: &Cage, size: f64) -> Diced {
    let all: Vec<u32> = (0..cage.ends.len() as u32).collect();
    cage.prepare(&Rate::world(size).unwrap()).dice(&all)
}

fn count(face: &[u32; 4]) -> usize {
    if face[3] == NO_POINT { 3 } else { 4 }
}

/// Checks that the faces of all parts together close without crack or overlap, by the exact positions of their vertices.
fn assert_closed(parts: &[Diced]) {
    let mut edges: BTreeMap<[[u64; 3]; 2], i32> = BTreeMap::new();
    for diced in parts {
        for face in &diced.faces {
            let n = count(face);
            for i in 0..n {
                let [a, b] = [face[i], face[(i + 1) % n]]
                    .map(|v| diced.positions[v as usize].to_array().map(f64::to_bits));
                *edges.entry([a.min(b), a.max(b)]).or_default() += if a < b { 1 } else { -1 };
            }
        }
    }
    let open = edges.values().filter(|&&balance| balance != 0).count();
    assert_eq!(open, 0, "{open} of {} edges", edges.len());
}

/// Catches wrong masks of vertices, edges or faces: the cage's points have known places on the limit of a cube.
#[test]
fn the_limit_of_a_cube_is_known() {
    let cage = cube();
    let diced = dice(&cage, 0.3);
    // At a corner of three faces: (9 v + 4 Σ e + Σ f) / 24 with neighbours' sums (1, 1, 1) and (-1, -1, -1): 12/24
    for (vertex, &point) in diced.points.iter().enumerate().filter(|(_, point)| **point != NO_POINT) {
        let expected = cage.positions[point as usize] * (9.0 + 4.0 - 1.0) / 24.0;
        assert!((diced.positions[vertex] - expected).length() < 1e-14, "{}", diced.positions[vertex]);
        let normal = diced.normals[vertex].as_dvec3();
        assert!((normal - expected.normalize()).length() < 1e-6, "{normal}");
    }
    assert_eq!(diced.points.iter().filter(|&&point| point != NO_POINT).count(), 8);
    assert_closed(&[diced]);
}

/// Catches normals that are not those of the surface: they must fit the diced faces, ever better as these get finer.
#[test]
fn normals_are_those_of_the_limit() {
    let mut worst = [0.0_f64; 2];
    for (size, worst) in [0.1, 0.025].into_iter().zip(&mut worst) {
        let diced = dice(&cut_cube(), size);
        for face in diced.faces.iter().filter(|face| count(face) == 4) {
            let [a, b, c, d] = face.map(|v| diced.positions[v as usize]);
            let flat = (c - a).cross(d - b).normalize();
            for &vertex in face {
                let normal = diced.normals[vertex as usize].as_dvec3();
                assert!((normal.length() - 1.0).abs() < 1e-6);
                *worst = worst.max(normal.distance(flat));
            }
        }
    }
    assert!(worst[0] < 0.15 && worst[1] < worst[0] / 2.0, "{worst:?}");
}

/// Catches cracks between patches of different rates, quads and other polygons, and chunks that are diced apart.
#[test]
fn surfaces_close_whatever_the_rates_and_the_chunks() {
    let mut cage = cut_cube();
    // One long side gives neighbours different rates
    cage.positions.iter_mut().filter(|p| p.x > 0.5).for_each(|p| p.x *= 7.0);
    cage.creases.insert([0, 1], 2.5);
    cage.creases.insert([1, 5], SHARP);
    for size in [0.2, 0.7, 3.0, 100.0] {
        assert_closed(&[dice(&cage, size)]);
        let rate = Rate::world(size).unwrap();
        let prepared = cage.prepare(&rate);
        let parts: Vec<Diced> =
            [&[0_u32, 6][..], &[3], &[5, 1], &[2, 4]].iter().map(|part| prepared.dice(part)).collect();
        assert_closed(&parts);
    }
}

/// Catches a level that does not lie on the surface: finer dicing must pass through the vertices of coarser.
#[test]
fn coarse_vertices_lie_on_the_fine_surface() {
    let mut cage = cut_cube();
    cage.creases.insert([2, 3], 1.6);
    let (coarse, fine) = (dice(&cage, 0.5), dice(&cage, 0.05));
    for p in &coarse.positions {
        let nearest = fine.positions.iter().map(|q| p.distance(*q)).fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-3, "{p} {nearest}");
    }
}

/// Catches borders that shrink or wander, corners that are rounded, and creases that are smooth or bend.
#[test]
fn borders_and_creases_hold_their_curves() {
    let positions: Vec<[f64; 3]> = (0..16).map(|i| [f64::from(i % 4), f64::from(i / 4), 0.0]).collect();
    let faces: Vec<[u32; 4]> =
        (0..9).map(|i| i / 3 * 4 + i % 3).map(|at| [at, at + 1, at + 5, at + 4]).collect();
    let faces: Vec<&[u32]> = faces.iter().map(|face| &face[..]).collect();
    let mut sheet = cage(&positions, &faces);
    // A flat sheet stays flat, square and its own size
    let diced = dice(&sheet, 0.25);
    let max = diced.positions.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let min = diced.positions.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    assert!((max - DVec3::new(3.0, 3.0, 0.0)).length() < 1e-12 && min.length() < 1e-12);
    assert!(diced.normals.iter().all(|n| (*n - Vec3::Z).length() < 1e-6));
    // Folded along an infinitely sharp crease at x = 1, it keeps two planes and their normals
    sheet.positions.iter_mut().for_each(|p| p.z = (1.0 - p.x).max(0.0));
    for j in 0..3 {
        sheet.creases.insert([4 * j + 1, 4 * j + 5], SHARP);
    }
    let diced = dice(&sheet, 0.25);
    let slope = Vec3::new(1.0, 0.0, 1.0).normalize();
    for (p, n) in diced.positions.iter().zip(&diced.normals) {
        assert!((p.z - (1.0 - p.x).max(0.0)).abs() < 1e-12, "{p}");
        let fits = |plane: Vec3| (*n - plane).length() < 1e-5;
        assert!(
            if p.x < 0.999 {
                fits(slope)
            } else if p.x > 1.001 {
                fits(Vec3::Z)
            } else {
                fits(slope) || fits(Vec3::Z)
            },
            "{p} {n}"
        );
    }
    let on_crease = diced.positions.iter().filter(|p| (p.x - 1.0).abs() < 1e-9).count();
    assert_eq!(on_crease, 2 * 13, "a crease has a vertex for each side");
}

/// Catches values that stay behind the surface, and linear ones that are smoothed.
#[test]
fn values_follow_the_surface_or_the_face() {
    let mut cage = cut_cube();
    cage.smooth_width = 3;
    cage.smooth = cage.positions.iter().flat_map(|p| p.as_vec3().to_array()).collect();
    cage.linear_width = 1;
    cage.linear =
        (0..cage.ends.len() as u32).flat_map(|face| cage.face(face).map(move |_| face as f32)).collect();
    let diced = dice(&cage, 0.2);
    for (p, values) in diced.positions.iter().zip(diced.values.chunks_exact(4)) {
        assert!((p.as_vec3() - Vec3::from_slice(values)).length() < 1e-5);
    }
    for (face, &source) in diced.faces.iter().zip(&diced.sources) {
        assert!(
            face[..count(face)]
                .iter()
                .all(|&v| (diced.values[4 * v as usize + 3] - source as f32).abs() < 1e-5)
        );
    }
}

/// Catches weights that do not sum to one where the rules of smooth surfaces say nothing: points that cubes share, alone or
/// at the end of an edge, stay; along the edge of three sheets the surface follows its curve.
#[test]
fn where_sheets_meet_the_surface_holds() {
    let far = DVec3::new(1e6, -3e6, 2e6);
    let shifted =
        |by: DVec3| cube().positions.iter().map(move |p| (*p + by + far).to_array()).collect::<Vec<_>>();
    let faces = |other: [u32; 8]| {
        let cube = cube();
        let own = cube.corners.chunks(4).map(|face| face.to_vec());
        let others = cube.corners.chunks(4).map(|face| face.iter().map(|&c| other[c as usize]).collect());
        own.chain(others).collect::<Vec<Vec<u32>>>()
    };
    for (by, other, shared) in [
        (DVec3::splat(2.0), [7, 9, 10, 11, 12, 13, 14, 15], vec![7]),
        (DVec3::new(2.0, 2.0, 0.0), [3, 9, 10, 11, 7, 13, 14, 15], vec![3, 7]),
    ] {
        let positions = [shifted(DVec3::ZERO), shifted(by)].concat();
        let faces = faces(other);
        let cage = cage(&positions, &faces.iter().map(Vec::as_slice).collect::<Vec<_>>());
        let diced = dice(&cage, 0.3);
        assert_closed(&[dice(&cage, 0.3)]);
        for (&position, &point) in diced.positions.iter().zip(&diced.points) {
            assert!((position - far - 0.5 * by).abs().max_element() < 2.0, "{position}");
            if shared.contains(&point) {
                assert_eq!(position, cage.positions[point as usize]);
            }
        }
    }
    // Three sheets of two quads each, on a line along y that bends
    let mut positions = vec![[0.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.0, 2.0, 0.0]];
    let mut sheets = Vec::new();
    for (x, z) in [(1.0, 0.0), (-1.0, 0.5), (0.0, 1.0)] {
        let first = positions.len() as u32;
        positions.extend([0.0, 1.0, 2.0].map(|y| [x, y, z]));
        sheets.extend([[0, first, first + 1, 1], [1, first + 1, first + 2, 2]]);
    }
    let cage = cage(&positions, &sheets.iter().map(|sheet| &sheet[..]).collect::<Vec<_>>());
    let diced = dice(&cage, 0.2);
    let middle = diced.points.iter().position(|&point| point == 1).unwrap();
    let expected = (4.0 * cage.positions[1] + cage.positions[0] + cage.positions[2]) / 6.0;
    assert!((diced.positions[middle] - expected).length() < 1e-12, "{}", diced.positions[middle]);
}

/// Catches work or memory that grows with the square of the faces around a point.
#[test]
fn a_point_of_many_faces_ends_soon() {
    let n = 40_000;
    let mut cage = Cage { positions: vec![DVec3::ZERO], ..Cage::default() };
    for i in 0..2 * n {
        let (cos, sin) = crate::math::trig::cos_sin_turns(f64::from(i) / f64::from(2 * n));
        cage.positions.push(DVec3::new(cos, sin, 0.0));
    }
    for i in 0..n {
        cage.corners.extend([0, 2 * i + 1, 2 * i + 2, (2 * i + 2) % (2 * n) + 1]);
        cage.ends.push(cage.corners.len() as u32);
    }
    let diced = dice(&cage, 0.6);
    assert_eq!(diced.points.iter().filter(|&&point| point == 0).count(), 1);
    assert!(diced.faces.len() > n as usize && diced.positions.iter().all(|p| p.length() < 1.0 + 1e-12));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Catches a cage, however its faces meet, that panics, leaves its own box, or has other vertices in parts.
    #[test]
    fn any_cage_is_diced_inside_its_box(
        faces in prop::collection::vec(prop::sample::subsequence((0..8_u32).collect::<Vec<_>>(), 3..6).prop_shuffle(), 1..9),
        creases in prop::collection::vec((0..8_u32, 0..8_u32, 0.0..SHARP), 0..6),
        points in prop::collection::vec((0..8_u32, 0.0..SHARP), 0..2),
    ) {
        let mut cage = cage(&[], &faces.iter().map(Vec::as_slice).collect::<Vec<_>>());
        let far = DVec3::new(4e6, -1e6, 2e6);
        cage.positions = cube().positions.iter().enumerate().map(|(i, p)| *p * (1.0 + 0.1 * i as f64) + far).collect();
        cage.creases = creases.iter().map(|&(a, b, sharpness)| ([a.min(b), a.max(b)], sharpness)).collect();
        cage.sharp_points = points.iter().copied().collect();
        let whole = dice(&cage, 0.7);
        for (position, normal) in whole.positions.iter().zip(&whole.normals) {
            prop_assert!((*position - far).abs().max_element() < 1.7 + 1e-8, "{}", *position - far);
            prop_assert!(*normal == Vec3::ZERO || (normal.length() - 1.0).abs() < 1e-5);
        }
        let rate = Rate::world(0.7).unwrap();
        let prepared = cage.prepare(&rate);
        let parts: Vec<Diced> = (0..faces.len() as u32).map(|face| prepared.dice(&[face])).collect();
        let places = |parts: &[Diced]| {
            let all = parts.iter().flat_map(|diced| &diced.positions);
            all.map(|p| p.to_array().map(f64::to_bits)).collect::<std::collections::BTreeSet<_>>()
        };
        prop_assert!(places(&[whole]) == places(&parts));
    }
}
