//! Tests of the walk through instances.

use glam::{DMat3, DVec3, IVec3, Vec3};

use super::tests::{Loaded, Random, random_map};
use super::{Bricks, Entrance, Location, Scratch, Start, walk};
use crate::brick::bundle::{Bundle, EXTINCTION_OPAQUE};
use crate::brick::instance::{self, Instance};
use crate::brick::lanes::InstructionSet;
use crate::brick::leaf::{self, Face, OPAQUE, READ_PAST_BYTES};
use crate::brick::node::{LOCATION_BYTES, Node};
use crate::brick::{Child, INSTANCE_BYTES, LatticeBox, assemble, intersect};

/// A prototype placed in the map: p = linear (x - at) + middle.
#[derive(Clone, Copy)]
struct Placed {
    linear: DMat3,
    at: DVec3,
    middle: DVec3,
}

impl Placed {
    fn in_map(&self, point: DVec3) -> DVec3 {
        self.linear.inverse() * (point - self.middle) + self.at
    }

    fn bounds(&self, low: IVec3, high: IVec3) -> LatticeBox {
        let mut bounds = LatticeBox::EMPTY;
        for corner in 0..8 {
            let of = |axis: usize| if corner >> axis & 1 == 0 { low[axis] } else { high[axis] };
            let point = self.in_map(IVec3::new(of(0), of(1), of(2)).as_dvec3());
            bounds.add(point.floor().as_ivec3());
            bounds.add(point.ceil().as_ivec3());
        }
        bounds
    }
}

/// Appends brick `number` to a map, one node whose children are instances of brick `prototype`. Returns its entrances.
fn add_instances(
    map: &mut Loaded,
    number: u32,
    prototype: u32,
    box_of_prototype: LatticeBox,
    placed: &[Placed],
) -> Vec<Entrance> {
    let boxes: Vec<LatticeBox> =
        placed.iter().map(|p| p.bounds(box_of_prototype.min, box_of_prototype.max)).collect();
    let mut node = Node::over(&boxes);
    let (mut records, mut entrances) = (Vec::new(), Vec::new());
    for (slot, p) in placed.iter().enumerate() {
        let corner = node.lower_corner(slot);
        let offset = p.linear * (corner.as_dvec3() - p.at) + p.middle;
        let instance = Instance::new(prototype, p.linear, offset).unwrap();
        node.children[slot] = Child::Instance((records.len() / LOCATION_BYTES) as u16).encode();
        records.extend_from_slice(bytemuck::bytes_of(&instance));
        entrances.push(Entrance { instance, corner });
    }
    assert_eq!(records.len(), placed.len() * INSTANCE_BYTES);
    let mut brick = Vec::new();
    assemble(number, &mut [node], &[], &records, 0, &mut brick);
    map.memory.truncate(map.memory.len() - READ_PAST_BYTES);
    map.starts.push(map.memory.len() as u32);
    map.memory.extend(brick);
    map.memory.resize(map.memory.len() + READ_PAST_BYTES, 0);
    entrances
}

fn vector(random: &mut Random) -> DVec3 {
    DVec3::new(random.unit().into(), random.unit().into(), random.unit().into()) * 2.0 - 1.0
}

fn rotation(random: &mut Random) -> DMat3 {
    let x = vector(random).normalize();
    let y = vector(random).cross(x).normalize();
    DMat3::from_cols(x, y, x.cross(y))
}

/// Similarities, mirrored ones, and, unless `similar`, sheared and squashed ones.
fn random_linear(random: &mut Random, case: usize, similar: bool) -> DMat3 {
    let scale = [1.0, 0.2, 7.0, 1.0 / 3.0][random.next(4) as usize];
    let turned = rotation(random) * scale;
    match case % 4 {
        0 => turned,
        1 => turned * DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)),
        _ if similar => turned,
        2 => turned * DMat3::from_diagonal(DVec3::new(0.4, 1.0, 2.0)),
        _ => turned * DMat3::from_cols(DVec3::X, DVec3::new(0.7, 1.0, 0.0), DVec3::new(0.0, -0.4, 1.0)),
    }
}

fn all(faces: &[Face]) -> LatticeBox {
    faces.iter().fold(LatticeBox::EMPTY, |bounds, face| bounds.union(face.bounds()))
}

/// What a ray meets inside an instance, by brute force on the prototype's lattice.
fn expected(faces: &[Face], entrance: &Entrance, exact: DVec3, direction: Vec3, reach: f64) -> u64 {
    let Entrance { instance, corner } = entrance;
    let origin = instance::round(instance.point(exact - corner.as_dvec3()));
    let direction = instance.linear() * direction.as_dvec3();
    let length = direction.length();
    let met = |face: &&Face| intersect::meets(face, origin, direction / length, reach * length);
    let stored =
        |face: &Face| if face.extinction == OPAQUE { EXTINCTION_OPAQUE } else { face.extinction.into() };
    faces.iter().filter(met).map(|face| u64::from(stored(face))).sum()
}

const ROOT: Start = Start { brick: 9, entrance: None };

fn random_bundle(random: &mut Random, extent: u32, vertex: DVec3, reach: f32) -> Bundle {
    let mut bundle = Bundle::new();
    bundle.clear(reach, 20.0);
    for point in 0..4 {
        let exact = if point == 0 { vertex } else { vertex + random.vertex(extent).as_dvec3() * 0.37 };
        bundle.push_rounded_origin(exact.round().as_ivec3(), exact);
        for _ in 0..64 {
            bundle.push_ray(vector(random).as_vec3().normalize_or(Vec3::Y), u32::MAX);
        }
    }
    bundle
}

/// A random map whose brick 9 has instances of its brick 0, the faces of that, and one vertex in the map.
fn random_scene(random: &mut Random, case: usize, extent: u32) -> (Loaded, Vec<Face>, Vec<Entrance>, DVec3) {
    let (mut map, faces) = random_map(random, extent, (extent / 3).max(4));
    let placed: Vec<Placed> = (0..8)
        .map(|slot| Placed {
            linear: random_linear(random, slot, case.is_multiple_of(2)),
            at: vector(random) * f64::from(extent) * 3.0,
            middle: random.vertex(extent).as_dvec3(),
        })
        .collect();
    let entrances = add_instances(&mut map, 9, 0, all(&faces), &placed);
    let vertex = placed[case % 8].in_map(faces[case % faces.len()].vertices[0].as_dvec3());
    (map, faces, entrances, vertex)
}

/// Catches a face that is missed or invented inside an instance, however it is turned, mirrored, scaled or sheared, and rays
/// that come out of it changed: every ray against every face of every instance in double precision is the truth.
#[test]
fn instances_agree_with_brute_force() {
    for instructions in InstructionSet::available() {
        let mut random = Random(21);
        let (mut hits, mut rays, mut differences) = (0_u64, 0_u64, 0_u64);
        for case in 0..40 {
            let extent = [500, 20_000, 1 << 20, 1 << 24][case % 4];
            let (map, faces, entrances, vertex) = random_scene(&mut random, case, extent);
            let reach = if case % 3 == 0 { extent as f32 * 2.0 } else { f32::INFINITY };
            let mut bundle = random_bundle(&mut random, extent, vertex, reach);
            let ids: Vec<u16> = (0..bundle.len() as u16).collect();
            let mut scratch = Scratch::new();
            walk(&map, &ROOT, &ids, 0.0, &mut bundle, &mut scratch, instructions);
            assert!(scratch.counts.instances > 0 && scratch.counts.instances <= 8);
            for ray in 0..bundle.len() {
                let exact = bundle.origins[ray / 64].exact;
                let direction = Vec3::from_slice(&bundle.directions[ray][..3]);
                let one = |entrance| expected(&faces, entrance, exact, direction, f64::from(reach));
                let expected: u64 = entrances.iter().map(one).sum();
                (rays, hits) = (rays + 1, hits + u64::from(expected > 0));
                let opaque = u64::from(EXTINCTION_OPAQUE);
                let met = u64::from(bundle.extinction[ray]);
                differences += u64::from(met.min(opaque) != expected.min(opaque));
            }
        }
        assert!(hits > rays / 20, "{instructions:?}: {hits} of {rays} rays hit, the test is empty");
        assert!(differences <= rays / 2000, "{instructions:?}: {differences} of {rays} rays differ");
    }
}

/// Catches an instruction set that gives other bits than the plain loops inside instances.
#[test]
fn every_instruction_set_gives_the_same_bits() {
    let mut random = Random(22);
    for case in 0..24 {
        let extent = [500, 20_000, 1 << 24][case % 3];
        let (map, _, _, vertex) = random_scene(&mut random, case, extent);
        let seed = random.0;
        let of = |instructions| {
            let mut bundle = random_bundle(&mut Random(seed), extent, vertex, f32::INFINITY);
            let ids: Vec<u16> = (0..bundle.len() as u16).collect();
            let mut scratch = Scratch::new();
            let open2 = 0.05 * (case % 2) as f32;
            walk(&map, &ROOT, &ids, open2, &mut bundle, &mut scratch, instructions);
            (bundle.extinction, bundle.alive, scratch.counts)
        };
        let plain = of(InstructionSet::Plain);
        for instructions in InstructionSet::available() {
            assert_eq!(of(instructions), plain, "{instructions:?}, case {case}");
        }
    }
}

/// An octahedron of eight triangles, and its vertices.
fn octahedron(radius: i32) -> (Vec<Face>, [IVec3; 6]) {
    let axes = [IVec3::X, IVec3::Y, IVec3::Z];
    let vertices = std::array::from_fn(|i| axes[i / 2] * if i % 2 == 0 { radius } else { -radius });
    let face = |i: usize| {
        let [a, b, c] = [0, 1, 2].map(|axis| vertices[2 * axis + (i >> axis & 1)]);
        Face { vertices: [a, b, c, c], arity: 3, extinction: OPAQUE, radii: [0.0; 2] }
    };
    ((0..8).map(face).collect(), vertices)
}

/// Catches an instance that shadows its own points: at a vertex of a convex one, exactly the rays into it are blocked, though
/// positions in the map are nowhere on either lattice, from tiny instances to huge ones.
#[test]
fn a_convex_instance_blocks_exactly_what_it_covers() {
    let radius = 3 << 17;
    let (faces, vertices) = octahedron(radius);
    let bounds = all(&faces);
    let mut node = Node::over(&[bounds]);
    let mut leaves = Vec::new();
    leaf::encode(&faces, 0, node.lower_corner(0), &mut leaves);
    node.children[0] = Child::Leaf(0).encode();
    let mut random = Random(23);
    let (mut blocked, mut free) = (0, 0);
    for case in 0..48 {
        let mut map = Loaded { memory: Vec::new(), starts: vec![0; 9] };
        assemble(0, &mut [node], &[], &leaves, 8, &mut map.memory);
        map.memory.resize(map.memory.len() + READ_PAST_BYTES, 0);
        let scale = [1.0, 300.0, 0.02][case % 3];
        let linear = random_linear(&mut random, case / 3, false) * scale;
        let placed = Placed { linear, at: vector(&mut random) * 2e8, middle: DVec3::ZERO };
        add_instances(&mut map, 9, 0, bounds, &[placed]);

        let mut bundle = Bundle::new();
        bundle.clear(f32::INFINITY, 20.0);
        for vertex in vertices {
            let exact = placed.in_map(vertex.as_dvec3());
            bundle.push_rounded_origin(exact.round().as_ivec3(), exact);
            (0..200).for_each(|_| bundle.push_ray(vector(&mut random).as_vec3().normalize(), 1));
        }
        let ids: Vec<u16> = (0..bundle.len() as u16).collect();
        walk(&map, &ROOT, &ids, 0.0, &mut bundle, &mut Scratch::new(), InstructionSet::detect());
        for ray in 0..bundle.len() {
            let direction = linear * Vec3::from_slice(&bundle.directions[ray][..3]).as_dvec3();
            // Into the octahedron: towards its middle more than aside
            let inward = -direction.dot(vertices[ray / 200].as_dvec3()) / f64::from(radius);
            let aside = direction.abs().element_sum() - inward.abs();
            if (inward - aside).abs() < 1e-5 * direction.length() {
                continue;
            }
            assert_eq!(bundle.extinction[ray] > 0, inward > aside, "case {case}, ray {ray}");
            if inward > aside { blocked += 1 } else { free += 1 }
        }
    }
    assert!(blocked > 1000 && free > 1000);
}

/// A map of which some bricks are not in memory.
struct Partly<'a>(&'a Loaded, u32);

impl Bricks for Partly<'_> {
    fn memory(&self) -> &[u8] {
        self.0.memory()
    }

    fn locate(&self, brick: u32) -> Location {
        if self.1 >> brick & 1 == 0 { Location::Missing } else { self.0.locate(brick) }
    }
}

/// Catches rays that lose their instance while they wait for its bricks, whether for its root or for one below.
#[test]
fn rays_that_wait_inside_an_instance_go_on_there() {
    let (mut random, mut hits) = (Random(24), 0);
    for case in 0..20 {
        let (map, _, _, vertex) = random_scene(&mut random, case, 20_000);
        let bundle = || random_bundle(&mut Random(case as u32), 20_000, vertex, 1e5);
        let (mut whole, mut parted, mut scratch) = (bundle(), bundle(), Scratch::new());
        let ids: Vec<u16> = (0..whole.len() as u16).collect();
        walk(&map, &ROOT, &ids, 0.0, &mut whole, &mut scratch, InstructionSet::detect());

        // The root of the map first, then of the prototype, then four of its bricks, then the others
        let mut waiting = vec![(ROOT, ids)];
        for resident in [1 << 9, 1 << 9 | 1, 0b1_1111, 0b1_1110_0001] {
            let mut next = Vec::new();
            scratch.waiting.clear();
            scratch.waiting_rays.clear();
            for (start, rays) in waiting {
                let bricks = Partly(&map, resident);
                walk(&bricks, &start, &rays, 0.0, &mut parted, &mut scratch, InstructionSet::detect());
            }
            for wait in &scratch.waiting {
                let rays = &scratch.waiting_rays[wait.first as usize..][..wait.count as usize];
                next.push((wait.start, rays.to_vec()));
                assert!(wait.start.entrance.is_some());
            }
            waiting = next;
        }
        assert!(waiting.is_empty());
        assert_eq!(parted.extinction, whole.extinction, "case {case}");
        hits += whole.extinction.iter().filter(|&&extinction| extinction > 0).count();
    }
    assert!(hits > 200, "{hits} hits: the test is empty");
}
