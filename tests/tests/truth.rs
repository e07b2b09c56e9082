//! Closed forms: what the tracer must find where the answer is known.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use engine::brick::intersect::meets;
use engine::brick::lanes::InstructionSet;
use engine::brick::leaf::{Face, OPAQUE, extinction_from_opacity};
use engine::brickmap::FarField;
use engine::cut::Lod;
use engine::scene::{Domain, ShOcclusion, Weight};
use engine::stream::MicrogridStream;
use engine::stream::adapt::{Instance, MatrixList};
use glam::{DMat4, DVec3, Vec3};
use tests::{MemoryStream, Setup, build_map, build_map_with, trace};

const Y00: f64 = 0.282_094_791_773_878_14;
const Y10: f64 = 0.488_602_511_902_919_9;

fn map_of(stream: &mut MemoryStream, folder: &Path) -> std::sync::Arc<engine::brickmap::BrickMap> {
    build_map(&mut [stream as &mut dyn MicrogridStream], folder)
}

fn assert_near(value: f32, expected: f64, tolerance: f64, what: &str) {
    assert!((f64::from(value) - expected).abs() <= tolerance, "{what}: {value}, {expected} expected");
}

/// Every vertex of a stream with one normal.
fn vertices(stream: &MemoryStream, normal: Vec3) -> Vec<(DVec3, Vec3)> {
    stream.grids.iter().flat_map(|g| (0..g.vertex_count()).map(|v| (g.position(v), normal))).collect()
}

/// Catches false self-hits: every vertex of a plane, at any angle to the axes, sees the whole hemisphere.
#[test]
fn an_unoccluded_plane_sees_everything() {
    let folder = tempfile::tempdir().unwrap();
    let mut plane = MemoryStream::new();
    plane.push_sheet(DVec3::new(-1.0, -1.0, 0.0), 2.0 * DVec3::X, 2.0 * DVec3::Y, 32, 1.0);
    let map = map_of(&mut plane, folder.path());
    for v in trace(&map, &vertices(&plane, Vec3::Z), &ShOcclusion::default(), Some(0), Setup::default()) {
        assert_near(v[0], 1.772_454, 1e-5, "V_00");
        // The lattice of 512 directions is shifted by up to half a step in z
        assert_near(v[2], 1.534_990, 0.5 / 512.0 * TAU * Y10 + 1e-5, "V_10");
        assert_near(v[6], 0.0, 0.01, "V_20");
    }
}

/// Catches bumps that rounding to the lattice gives to an oblique plane: they may hide no more than a thousandth.
#[test]
fn an_oblique_plane_hides_next_to_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let normal = DVec3::new(0.36, 0.48, 0.8);
    let u = normal.any_orthonormal_vector();
    let mut plane = MemoryStream::new();
    plane.push_sheet(DVec3::new(5.0, 6.0, 7.0), 3.0 * u, 2.0 * normal.cross(u), 40, 1.0);
    let map = map_of(&mut plane, folder.path());
    let found =
        trace(&map, &vertices(&plane, normal.as_vec3()), &ShOcclusion::default(), Some(0), Setup::default());
    let mean = found.iter().map(|v| f64::from(v[0])).sum::<f64>() / found.len() as f64;
    assert!(mean > 1.772_454 * 0.999, "{mean}");
}

/// Catches rays that see beyond their maximal distance, at faces and at what stands in for them.
#[test]
fn nothing_is_seen_beyond_the_maximal_distance() {
    let folder = tempfile::tempdir().unwrap();
    let mut scene = MemoryStream::new();
    scene.push_sphere(DVec3::ZERO, 2.0, 96, 1.0);
    let map = map_of(&mut scene, folder.path());
    for lod in [Lod::Off, Lod::Paper, Lod::Footprint { quality: 1.0 }] {
        for (distance, expected) in [(1.9, TAU * Y00), (2.05, 0.0)] {
            let shader = ShOcclusion { max_distance: Some(distance), ..ShOcclusion::default() };
            let v =
                &trace(&map, &[(DVec3::ZERO, Vec3::Z)], &shader, None, Setup { lod, ..Setup::default() })[0];
            // Far fields of the paper leak through a wall
            let tolerance = if lod == Lod::Off || distance < 2.0 { 1e-5 } else { 0.6 * TAU * Y00 };
            assert_near(v[0], expected, tolerance, &format!("{lod}, rays of {distance}"));
        }
    }
}

/// Catches wrong occlusion by a surface and by a point: a sphere straight above leaves a known cap out.
#[test]
fn a_sphere_above_a_point_hides_its_cap() {
    let (height, radius) = (2.0_f64, 0.8_f64);
    let cos = (1.0 - (radius / height).powi(2)).sqrt();
    for as_point in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let mut scene = MemoryStream::new();
        if as_point {
            scene.push(&[DVec3::new(0.0, 0.0, height)], &[&[0]], radius as f32, 1.0);
        } else {
            scene.push_sphere(DVec3::new(0.0, 0.0, height), radius, 128, 1.0);
        }
        let map = map_of(&mut scene, folder.path());
        let shader = ShOcclusion { samples: 16_384, ..ShOcclusion::default() };
        let v = &trace(&map, &[(DVec3::ZERO, Vec3::Z)], &shader, None, Setup::default())[0];
        assert_near(v[0], TAU * Y00 * cos, 2e-3, "V_00");
        assert_near(v[2], PI * Y10 * cos * cos, 2e-3, "V_10");
        let cosine = ShOcclusion { weight: Weight::Cosine, ..shader };
        let v = &trace(&map, &[(DVec3::ZERO, Vec3::Z)], &cosine, None, Setup::default())[0];
        assert_near(v[0], PI * Y00 * cos * cos, 2e-3, "cosine-weighted V_00");
    }
}

/// Catches a wrong radius of lines: a long one overhead hides a lune of known angle.
#[test]
fn a_line_overhead_hides_its_lune() {
    let folder = tempfile::tempdir().unwrap();
    let (height, radius) = (1.0, 0.25);
    let mut scene = MemoryStream::new();
    let ends: Vec<DVec3> = (0..=200).map(|i| DVec3::new(f64::from(i - 100) * 2.0, 0.0, height)).collect();
    let faces: Vec<[u8; 2]> = (0..200).map(|i| [i, i + 1]).collect();
    scene.push(&ends, &faces.iter().map(|f| &f[..]).collect::<Vec<_>>(), radius as f32, 1.0);
    let map = map_of(&mut scene, folder.path());
    let shader = ShOcclusion { samples: 16_384, ..ShOcclusion::default() };
    let v = &trace(&map, &[(DVec3::ZERO, Vec3::Z)], &shader, None, Setup::default())[0];
    assert_near(v[0], Y00 * (TAU - 4.0 * (radius / height).asin()), 0.01, "V_00");
}

/// Catches leaks through shared edges and corners: from inside a closed room nothing is seen, at any angle.
#[test]
fn a_closed_room_is_dark() {
    for tilt in [0.0, 0.4] {
        let folder = tempfile::tempdir().unwrap();
        let mut room = MemoryStream::new();
        let turn = room.push_room(tilt, 31);
        let map = map_of(&mut room, folder.path());
        let points: Vec<_> =
            (0..40).map(|i| (turn * DVec3::new(f64::from(i) * 0.04 - 0.8, 0.3, -0.2), Vec3::ZERO)).collect();
        let shader = ShOcclusion { samples: 4096, domain: Domain::Sphere, ..ShOcclusion::default() };
        for v in trace(&map, &points, &shader, None, Setup::default()) {
            assert!(v.iter().all(|&c| c == 0.0), "{v:?}");
        }
    }
}

/// Catches opacities that do not multiply along a ray.
#[test]
fn half_transparent_layers_multiply() {
    for (layers, opacity) in [(1, 0.5), (3, 0.5), (2, 0.3), (6, 0.5)] {
        let folder = tempfile::tempdir().unwrap();
        let mut scene = MemoryStream::new();
        for layer in 0..layers {
            // Spheres about the origin: every ray meets every layer once
            scene.push_sphere(DVec3::ZERO, 1.0 + 0.1 * f64::from(layer), 64, opacity as f32);
        }
        let map = map_of(&mut scene, folder.path());
        let shader = ShOcclusion { samples: 8192, ..ShOcclusion::default() };
        let v = &trace(&map, &[(DVec3::ZERO, Vec3::Z)], &shader, None, Setup::default())[0];
        let transmittance = (1.0_f64 - opacity).powi(layers);
        assert_near(v[0], TAU * Y00 * transmittance, 0.003 * TAU * Y00, "V_00");
    }
}

/// Catches instances that differ from copies that were baked in.
#[test]
fn an_instance_equals_its_copy() {
    let folder = tempfile::tempdir().unwrap();
    let mut object = MemoryStream::new();
    object.push_sphere(DVec3::new(0.3, 0.1, 1.0), 0.4, 24, 1.0);
    let places: Vec<DVec3> =
        (0..5).map(|i| DVec3::new(f64::from(i) - 2.0, 0.25 * f64::from(i * i), 0.5)).collect();
    let mut copies = MemoryStream::new();
    for &place in &places {
        let mut copy = object.clone();
        copy.translate(place);
        copies.grids.extend(copy.grids);
    }
    let matrices = places.iter().map(|&place| DMat4::from_translation(place)).collect();
    let mut instanced = Instance::new(object, MatrixList::new(matrices)).unwrap();
    let points: Vec<_> = (0..50).map(|i| (DVec3::new(f64::from(i) * 0.1 - 2.5, 0.4, 0.0), Vec3::Z)).collect();
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    let from_copies =
        trace(&map_of(&mut copies, &a), &points, &ShOcclusion::default(), None, Setup::default());
    let map = build_map(&mut [&mut instanced as &mut dyn MicrogridStream], &b);
    assert_eq!(trace(&map, &points, &ShOcclusion::default(), None, Setup::default()), from_copies);
}

/// Catches lost precision far from the origin: the same scene 500 m away, in centimetres, gives the same bits.
#[test]
fn five_hundred_meters_away_nothing_changes() {
    let scene_at = |offset: DVec3| {
        let folder = tempfile::tempdir().unwrap();
        let mut scene = MemoryStream::new();
        scene.push_surface(60, 60, 1.0, |i, j| {
            let (x, y) = (i as f64 * 0.5, j as f64 * 0.5);
            DVec3::new(x, y, (x * 0.9).sin() + (y * 0.7).cos())
        });
        scene.push_sphere(DVec3::new(12.0, 14.0, 6.0), 4.0, 32, 0.5);
        // Positions that exist at both places: offsets are single precision, anchors double
        scene.grids.iter_mut().for_each(|grid| grid.anchor = (grid.anchor * 1024.0).round() / 1024.0);
        scene.translate(offset);
        let map = map_of(&mut scene, folder.path());
        let setup = Setup { meters_per_unit: 0.01, ..Setup::default() };
        trace(&map, &vertices(&scene, Vec3::Z), &ShOcclusion::default(), Some(0), setup)
    };
    let near = scene_at(DVec3::ZERO);
    assert!(near.iter().any(|v| v[0] < 1.6) && near.iter().any(|v| v[0] > 1.2), "the scene should be varied");
    assert_eq!(near, scene_at(DVec3::new(50_000.0, -50_000.0, 50_000.0)));
}

/// Catches anything that goes wrong between a stream and a coefficient: every ray against every micropolygon, in double
/// precision, on random small scenes of all kinds of faces.
#[test]
fn random_scenes_agree_with_brute_force() {
    for seed in 0..6_u32 {
        let folder = tempfile::tempdir().unwrap();
        let mut state = seed.wrapping_mul(0x9e37_79b9) | 1;
        let mut unit = || {
            state = engine::math::hash::hash32(state);
            f64::from(engine::math::hash::unit_f32(state))
        };
        let mut scene = MemoryStream::new();
        let opacities = [1.0, 0.5, 0.25];
        for i in 0..300 {
            let center = DVec3::new(unit(), unit(), unit()) * 4.0 - 2.0;
            let arity = 1 + i % 4;
            let corners: Vec<DVec3> =
                (0..arity).map(|_| center + 0.3 * (DVec3::new(unit(), unit(), unit()) - 0.5)).collect();
            let face: Vec<u8> = (0..arity as u8).collect();
            scene.push(&corners, &[&face], 0.05, opacities[i % 3]);
        }
        let map = map_of(&mut scene, folder.path());
        let points: Vec<_> =
            (0..8).map(|_| (DVec3::new(unit(), unit(), unit()) * 4.0 - 2.0, Vec3::Z)).collect();
        // One band of few samples: the coefficient counts the rays that get through
        let shader = ShOcclusion { bands: 1, samples: 256, domain: Domain::Sphere, ..ShOcclusion::default() };
        let found = trace(&map, &points, &shader, None, Setup::default());

        let (lattice, shift) = (map.lattice(), map.shift(0));
        let faces: Vec<Face> = scene
            .grids
            .iter()
            .map(|grid| {
                let arity = grid.vertex_count();
                let corner = |c: usize| lattice.snap(grid.position(c.min(arity - 1)), shift);
                let radius = if arity <= 2 { (0.05_f32 as f64 / lattice.step()) as f32 } else { 0.0 };
                let opacity = grid.value(&scene.schema, 1, 0, 0);
                Face {
                    vertices: std::array::from_fn(corner),
                    arity: arity as u8,
                    extinction: extinction_from_opacity(opacity),
                    radii: [radius; 2],
                }
            })
            .collect();
        let sampler = engine::shade::sample::Sampler::new(256, 1, xxh("test"));
        for (index, &(position, normal)) in points.iter().enumerate() {
            let mut bundle = engine::brick::bundle::Bundle::new();
            let origin = lattice.snap(position, 0);
            bundle.push_origin(origin);
            sampler.push_rays(
                index as u64,
                normal,
                engine::shade::sample::Spread::Sphere,
                0..256,
                &mut bundle,
            );
            for ray in 0..256 {
                let direction = Vec3::from_slice(&bundle.directions[ray][..3]).as_dvec3();
                for face in faces.iter().filter(|face| meets(face, origin, direction, f64::INFINITY)) {
                    let extinction =
                        if face.extinction == OPAQUE { 1 << 24 } else { u32::from(face.extinction) };
                    bundle.extinguish(ray as u16, extinction);
                }
            }
            let through: f32 = (0..256).map(|ray| sampler.visibility(&bundle, ray)).sum();
            let expected = f64::from(through) / 256.0 * 4.0 * PI * Y00;
            // A ray through an edge may be decided differently: one in 256
            assert_near(found[index][0], expected, 1.01 / 256.0 * 4.0 * PI * Y00, &format!("scene {seed}"));
        }
    }
}

fn xxh(name: &str) -> u32 {
    engine::trace::bake_set_hash(name)
}

/// Catches results that depend on threads, on the size of the arena, or on the instruction set.
#[test]
fn the_same_bits_however_it_is_traced() {
    let folder = tempfile::tempdir().unwrap();
    let mut scene = MemoryStream::new();
    for i in 0..120 {
        let center = DVec3::new(f64::from(i % 8), f64::from(i / 8), f64::from(i % 5) * 0.3);
        scene.push_sphere(center, 0.45, 80, if i % 3 == 0 { 0.6 } else { 1.0 });
    }
    let points: Vec<_> = vertices(&scene, Vec3::Z).into_iter().step_by(1009).collect();
    let footprint = Lod::Footprint { quality: 1.0 };
    let cases = [Lod::Off, Lod::Paper, footprint].map(|lod| (FarField::Paper, lod));
    for (far_field, lod) in cases.into_iter().chain([(FarField::Directional, footprint)]) {
        let map =
            build_map_with(&mut [&mut scene], far_field, &folder.path().join(format!("{far_field:?}{lod}")));
        let of =
            |setup: Setup| trace(&map, &points, &ShOcclusion::default(), Some(0), Setup { lod, ..setup });
        let expected = of(Setup::default());
        assert_eq!(of(Setup { threads: 2, ..Setup::default() }), expected, "{lod}: two threads");
        for instructions in InstructionSet::available() {
            assert_eq!(of(Setup { instructions, ..Setup::default() }), expected, "{lod}: {instructions:?}");
        }
        let small = 2 << 20;
        assert!(small < map.bytes() / 2, "the arena should be too small for the map");
        assert_eq!(
            of(Setup { arena_bytes: small, ..Setup::default() }),
            expected,
            "{lod}: an arena of {small} bytes"
        );
    }
}

/// Catches a level of detail that is far off: it must stay near full detail on closed surfaces.
#[test]
fn level_of_detail_stays_near_full_detail() {
    let folder = tempfile::tempdir().unwrap();
    let mut scene = MemoryStream::new();
    for i in 0..30 {
        scene.push_sphere(DVec3::new(f64::from(i % 6), f64::from(i / 6), 1.5), 0.3, 64, 1.0);
    }
    let map = map_of(&mut scene, folder.path());
    let points: Vec<_> =
        (0..64).map(|i| (DVec3::new(f64::from(i % 8), f64::from(i / 8), 0.0), Vec3::Z)).collect();
    let of = |lod| trace(&map, &points, &ShOcclusion::default(), None, Setup { lod, ..Setup::default() });
    let full = of(Lod::Off);
    for (lod, bound) in [(Lod::Paper, 0.02), (Lod::Footprint { quality: 0.5 }, 0.1)] {
        let found = of(lod);
        let squares =
            full.iter().flatten().zip(found.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2));
        let rmse = (squares.sum::<f64>() / (9 * points.len()) as f64).sqrt();
        assert!(rmse < bound, "{lod}: {rmse}");
    }
}
