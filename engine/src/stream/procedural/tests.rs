//! Tests of whole streams.

use std::collections::HashMap;

use xxhash_rust::xxh3::Xxh3;

use super::*;
use plant::{PARTS_MAX, Species};

const KINDS: [ProceduralKind; 3] = [ProceduralKind::Jungle, ProceduralKind::Grass, ProceduralKind::Terrain];

fn parameters(kind: ProceduralKind, seed: u64, micropolygons: u64) -> Procedural {
    Procedural { kind, seed, micropolygons }
}

fn stream(kind: ProceduralKind, seed: u64, micropolygons: u64) -> ProceduralStream {
    ProceduralStream::new(&parameters(kind, seed, micropolygons), 1.0, UpAxis::Y).unwrap()
}

/// Hash of every byte of the next `grids` grids, and how many there were.
fn hash(stream: &mut ProceduralStream, grids: usize) -> (u64, usize) {
    let (mut hash, mut grid) = (Xxh3::new(), Microgrid::default());
    for number in 0..grids {
        if !stream.next(&mut grid).unwrap() {
            return (hash.digest(), number);
        }
        grid.anchor.to_array().iter().for_each(|x| hash.update(&x.to_le_bytes()));
        grid.positions.iter().flat_map(|p| p.to_array()).for_each(|x| hash.update(&x.to_le_bytes()));
        hash.update(&grid.arities);
        hash.update(&grid.indices);
        grid.columns.iter().for_each(|column| hash.update(column));
    }
    (hash.digest(), grids)
}

/// Catches different bytes for the same seed, on this machine or any other.
///
/// A deliberate change of the generator changes these numbers: print the new ones, look at pictures of the new
/// streams, then write them here and say so in the change's message, since every bake of a procedural scene changes.
#[test]
fn bytes_are_frozen() {
    let hashes = KINDS.map(|kind| hash(&mut stream(kind, 7, 1_000_000), 3000).0);
    let frozen = [0x19dc_f69b_a02e_a6ad, 0x0a22_9910_3b62_415b, 0x1f9d_b412_a389_17e4];
    assert_eq!(hashes, frozen, "now {hashes:#018x?}");
}

/// Catches state that survives a rewind, from the middle of a plant or from the end.
#[test]
fn rewind_gives_the_same_bytes() {
    for kind in KINDS {
        let mut stream = stream(kind, 3, 60_000);
        let (whole, grids) = hash(&mut stream, usize::MAX);
        for stop in [0, grids / 2, grids] {
            stream.rewind().unwrap();
            hash(&mut stream, stop);
            stream.rewind().unwrap();
            assert_eq!(hash(&mut stream, usize::MAX), (whole, grids));
        }
        assert_eq!(stream.progress(), 1.0);
    }
}

/// Catches pieces that leave something out, share something, or number plants anew.
#[test]
fn pieces_are_the_whole_stream() {
    for kind in KINDS {
        let mut stream = stream(kind, 3, 200_000);
        let (mut whole, mut grid) = (Vec::new(), Microgrid::default());
        while stream.next(&mut grid).unwrap() {
            whole.push(grid.clone());
        }
        stream.rewind().unwrap();
        let (mut pieces, mut grids) = (0, Vec::new());
        while let Some(piece) = stream.next_piece().unwrap() {
            pieces += 1;
            let mut push = |grid: &Microgrid| {
                grids.push(grid.clone());
                Ok(())
            };
            piece.read(&mut grid, &mut push).unwrap();
        }
        assert!(pieces > 3 && grids == whole, "{kind:?}: {pieces} pieces");
    }
}

/// Catches a seed that is ignored, wholly or in its upper half.
#[test]
fn seeds_differ() {
    let hashes = [1, 2, 1 << 32].map(|seed| hash(&mut stream(ProceduralKind::Terrain, seed, 5000), 20).0);
    assert!(hashes[0] != hashes[1] && hashes[0] != hashes[2] && hashes[1] != hashes[2]);
}

/// Catches broken grids, normals that are not unit, and faces that look the wrong way, in either up axis.
#[test]
fn grids_are_valid_and_face_where_normals_point() {
    for (kind, up, meters) in
        KINDS.into_iter().flat_map(|kind| [(kind, UpAxis::Y, 1.0), (kind, UpAxis::Z, 0.01)])
    {
        let mut stream = ProceduralStream::new(&parameters(kind, 11, 400_000), meters, up).unwrap();
        let (mut grid, schema) = (Microgrid::default(), stream.schema().clone());
        let (mut faces, mut against) = (0u32, 0u32);
        while stream.next(&mut grid).unwrap() {
            grid.validate(&schema).unwrap();
            let albedo = grid.vec3(&schema, 1, 0);
            assert!(albedo.cmpgt(Vec3::ZERO).all() && albedo.cmplt(Vec3::ONE).all());
            let normals: Vec<Vec3> = (0..grid.vertex_count()).map(|v| grid.vec3(&schema, 0, v)).collect();
            assert!(normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-4));
            for face in grid.faces() {
                let [a, b, c, d] = [0, 1, 2, 3].map(|corner| grid.positions[usize::from(face[corner])]);
                let mean: Vec3 = face.iter().map(|&v| normals[usize::from(v)]).sum();
                faces += 1;
                against += u32::from((c - a).cross(d - b).dot(mean) <= 0.0);
            }
        }
        assert!(f64::from(against) < 0.002 * f64::from(faces), "{kind:?}: {against} of {faces}");
    }
}

/// Catches a count that strays from the one asked for by more than is documented.
#[test]
fn counts_are_near_those_asked_for() {
    for kind in KINDS {
        for (count, seeds) in [(10_000, 0..12), (100_000, 0..12), (1_000_000, 0..6), (10_000_000, 0..2)] {
            for seed in seeds {
                let ProceduralStream { artist, extent, .. } = stream(kind, seed, count);
                let found = extent::exact(&artist.world, &extent);
                let error = found as f64 / count as f64 - 1.0;
                assert!(error.abs() < 0.1, "{kind:?} seed {seed}: {found} for {count}");
            }
        }
    }
}

/// Catches an estimate for squares too large to count that is off.
#[test]
fn large_counts_are_estimated_well() {
    for kind in [ProceduralKind::Jungle, ProceduralKind::Grass] {
        let ProceduralStream { artist, extent, .. } = stream(kind, 5, 60_000_000);
        let error = extent::exact(&artist.world, &extent) as f64 / 60e6 - 1.0;
        assert!(error.abs() < 0.1, "{kind:?}: {error}");
    }
}

/// Catches a planned count that is not what is drawn, and buffers that grow with the stream.
#[test]
fn counts_are_those_drawn_and_memory_is_constant() {
    for kind in KINDS {
        let mut stream = stream(kind, 2, 2_000_000);
        let (mut grid, mut quads, mut vertices) = (Microgrid::default(), 0, 0);
        while stream.next(&mut grid).unwrap() {
            quads += grid.face_count() as u64;
            vertices = vertices.max(grid.positions.capacity());
        }
        assert_eq!(quads, extent::exact(&stream.artist.world, &stream.extent));
        assert!(vertices <= 512);
        assert!(stream.artist.sites.capacity() <= 1024);
        assert!(stream.artist.plan.parts.capacity() <= PARTS_MAX);
    }
}

/// Catches a crack or an overlap between patches: in feet, where nothing is a round number, all vertices of a terrain
/// must fall on one lattice to the last bit.
#[test]
fn patches_share_their_edges_exactly() {
    let mut stream =
        ProceduralStream::new(&parameters(ProceduralKind::Terrain, 4, 250_000), 0.3048, UpAxis::Y).unwrap();
    let (mut heights, mut grid) = (HashMap::new(), Microgrid::default());
    let mut vertices = 0;
    while stream.next(&mut grid).unwrap() {
        for vertex in 0..grid.vertex_count() {
            let p = grid.position(vertex);
            let height = heights.entry([p.x.to_bits(), p.z.to_bits()]).or_insert(p.y);
            assert_eq!(height.to_bits(), p.y.to_bits());
            vertices += 1;
        }
    }
    assert_eq!(heights.len(), 501 * 501);
    assert!(vertices > heights.len());
}

/// Catches a crack along the edges of a stone's six sides.
#[test]
fn stones_are_closed() {
    let (mut plan, mut pen, mut grid) = (Plan::default(), Pen::default(), Microgrid::default());
    let space = Space::new(1.0, UpAxis::Y);
    plan.grow(&Site { species: Species::Stone, seed: 8, scale: 1.0, x: 0.0, z: 0.0 }, [0.0; 2]);
    let mut edges = HashMap::new();
    for part in &plan.parts {
        let topology = part.draw(&mut pen);
        pen.finish(&mut grid, &space, DVec3::ZERO, topology, &Paint { albedo: part.albedo, id: 1 });
        for face in grid.faces() {
            for corner in 0..4 {
                let bits = |corner: usize| {
                    grid.positions[usize::from(face[corner % 4])].to_array().map(f32::to_bits)
                };
                // Each edge is walked once in each direction.
                let (from, to) = (bits(corner), bits(corner + 1));
                *edges.entry((from.min(to), from.max(to))).or_insert(0) += if from < to { 1 } else { -1 };
            }
        }
    }
    assert_eq!(edges.len(), 2 * 864);
    assert!(edges.values().all(|&balance| balance == 0));
}

/// Catches a species that outgrows the bounds on memory, or whose plan and drawing disagree.
#[test]
fn every_species_grows_within_bounds() {
    assert!(size_of::<Part>() * PARTS_MAX <= 1 << 20);
    let (mut plan, mut pen) = (Plan::default(), Pen::default());
    for species in Species::ALL {
        for seed in 0..40 {
            plan.grow(&Site { species, seed, scale: 1.2, x: 0.0, z: 0.0 }, [0.3, -0.2]);
            assert!(!plan.parts.is_empty() && plan.parts.len() <= PARTS_MAX, "{species:?}");
            for part in plan.parts.iter().step_by(7) {
                let topology = part.draw(&mut pen);
                assert_eq!(u64::from(topology.quads()), part.quads());
                assert!(topology.vertices() <= 256, "{species:?}: {topology:?}");
            }
        }
    }
}

/// Catches counts and units that cannot be streamed, and tiny streams that are empty.
#[test]
fn hostile_parameters_are_refused_and_tiny_ones_served() {
    for kind in KINDS {
        for count in [0, MICROPOLYGONS_MAX + 1, u64::MAX] {
            let error = ProceduralStream::new(&parameters(kind, 1, count), 1.0, UpAxis::Y).unwrap_err();
            assert!(error.message().contains(&count.to_string()) && error.hint_text().is_some());
            assert!(demo_camera(&parameters(kind, 1, count), 1.0, UpAxis::Y).is_err());
        }
        for meters in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(ProceduralStream::new(&parameters(kind, 1, 100), meters, UpAxis::Y).is_err());
        }
        for count in [1, 2, 10, 100, 999] {
            let mut stream = stream(kind, 1, count);
            let (schema, mut grid, mut quads) = (stream.schema().clone(), Microgrid::default(), 0);
            while stream.next(&mut grid).unwrap() {
                grid.validate(&schema).unwrap();
                quads += grid.face_count() as u64;
            }
            assert!(quads >= 1 && quads <= 2 * count, "{kind:?}: {quads} for {count}");
        }
    }
}

/// Catches the largest streams failing to start, or running over the numbers of their vertices.
#[test]
fn the_largest_streams_start() {
    for kind in KINDS {
        let mut stream = stream(kind, 1, MICROPOLYGONS_MAX);
        let mut grid = Microgrid::default();
        for _ in 0..100 {
            assert!(stream.next(&mut grid).unwrap());
            grid.validate(&stream.schema).unwrap();
        }
    }
}

/// Catches a demo camera that stands in a leaf, under the ground, or that is not a rigid frame in the scene's units.
#[test]
fn the_demo_camera_stands_in_the_open() {
    for seed in 0..4 {
        let parameters = parameters(ProceduralKind::Jungle, seed, 2_000_000);
        let (camera, fov) = demo_camera(&parameters, 0.01, UpAxis::Z).unwrap();
        assert!((20.0..90.0).contains(&fov));
        assert!((camera.determinant() - 1.0).abs() < 1e-9);
        let eye = camera.w_axis.truncate();
        // The picture's up is the scene's, and the camera looks at the clearing in the middle.
        assert!(camera.y_axis.z > 0.8);
        assert!((-camera.z_axis.truncate()).dot(-eye.with_z(0.0)) > 0.0);
        let mut stream = ProceduralStream::new(&parameters, 0.01, UpAxis::Z).unwrap();
        let (mut grid, mut nearest) = (Microgrid::default(), f64::INFINITY);
        while stream.next(&mut grid).unwrap() {
            for vertex in 0..grid.vertex_count() {
                nearest = nearest.min((grid.position(vertex) - eye).length());
            }
        }
        assert!((60.0..=175.0).contains(&nearest), "seed {seed}: {nearest} cm");
    }
}
