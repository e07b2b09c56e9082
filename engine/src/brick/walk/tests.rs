//! Tests of the walk over random bricks.

use glam::{IVec3, Vec3};

use super::leaf::face_extinction;
use super::*;
use crate::brick::bundle::EXTINCTION_OPAQUE;
use crate::brick::leaf::{Face, OPAQUE, READ_PAST_BYTES};
use crate::brick::node::{Child, LOCATION_BYTES};
use crate::brick::{ALIGNMENT, LatticeBox, Node, assemble, intersect, leaf};
use crate::math::hash::{hash32, unit_f32};

/// Bricks in plain memory: brick i starts at `starts[i]`.
pub struct Loaded {
    pub memory: Vec<u8>,
    pub starts: Vec<u32>,
}

impl Bricks for Loaded {
    fn memory(&self) -> &[u8] {
        &self.memory
    }

    fn locate(&self, brick: u32) -> Location {
        Location::Resident(self.starts[brick as usize] / ALIGNMENT as u32)
    }
}

const ROOT: Start = Start { brick: 0, entrance: None };

pub struct Random(pub u32);

impl Random {
    pub fn next(&mut self, range: u32) -> i32 {
        self.0 = hash32(self.0);
        (self.0 % range) as i32
    }

    pub fn unit(&mut self) -> f32 {
        self.0 = hash32(self.0);
        unit_f32(self.0)
    }

    pub fn vertex(&mut self, extent: u32) -> IVec3 {
        IVec3::new(self.next(extent), self.next(extent), self.next(extent)) - extent as i32 / 2
    }
}

/// A two-level map of random faces: 8 bricks of one node with 8 leaves each under a root brick.
pub fn random_map(random: &mut Random, extent: u32, size: u32) -> (Loaded, Vec<Face>) {
    let (mut memory, mut starts, mut all) = (Vec::new(), vec![0], Vec::new());
    let mut boxes = Vec::new();
    let mut bricks = Vec::new();
    for number in 1..=8 {
        let (mut leaves, mut leaf_faces, mut offsets) = (Vec::new(), Vec::new(), Vec::new());
        for leaf in 0..8 {
            let (round, triangles) = (leaf == 7, leaf == 6);
            let faces: Vec<Face> = (0..1 + random.next(if triangles { 10 } else { 8 }))
                .map(|_| {
                    let arity = match (round, triangles) {
                        (true, _) => 1 + random.next(2) as u8,
                        (_, true) => 3,
                        _ => 3 + random.next(2) as u8,
                    };
                    let center = random.vertex(extent);
                    let mut vertices = [center; 4];
                    for corner in 1..4 {
                        let last = vertices[corner - 1];
                        vertices[corner] =
                            if corner < usize::from(arity) { center + random.vertex(size) } else { last };
                    }
                    let extinction = if random.next(2) == 0 { OPAQUE } else { random.next(9000) as u16 };
                    let radii = if round { [0.01, 0.02].map(|r| r * size as f32) } else { [0.0; 2] };
                    Face {
                        vertices,
                        arity,
                        extinction,
                        radii: if arity == 1 { [radii[0]; 2] } else { radii },
                    }
                })
                .collect();
            leaf_faces.push(faces);
        }
        let bounds = |faces: &Vec<Face>| faces.iter().fold(LatticeBox::EMPTY, |b, f| b.union(f.bounds()));
        let leaf_boxes: Vec<LatticeBox> = leaf_faces.iter().map(bounds).collect();
        let mut node = Node::over(&leaf_boxes);
        for (slot, faces) in leaf_faces.into_iter().enumerate() {
            offsets.push((leaves.len() / LOCATION_BYTES) as u16);
            leaf::encode(&faces, 0, node.lower_corner(slot), &mut leaves);
            all.extend(faces);
        }
        for slot in 0..8 {
            node.children[slot] = Child::Leaf(offsets[slot]).encode();
            node.far[slot] = std::array::from_fn(|_| random.next(256) as u8);
        }
        boxes.push(leaf_boxes.iter().fold(LatticeBox::EMPTY, |b, &l| b.union(l)));
        let mut brick = Vec::new();
        assemble(number, &mut [node], &[], &leaves, 0, &mut brick);
        bricks.push(brick);
    }
    let mut root = Node::over(&boxes);
    (0..8).for_each(|slot| root.children[slot] = Child::Brick(slot as u16).encode());
    assemble(0, &mut [root], &[1, 2, 3, 4, 5, 6, 7, 8], &[], 0, &mut memory);
    for brick in bricks {
        starts.push(memory.len() as u32);
        memory.extend(brick);
    }
    memory.resize(memory.len() + READ_PAST_BYTES, 0);
    (Loaded { memory, starts }, all)
}

fn random_bundle(random: &mut Random, extent: u32, vertex: IVec3, reach: f32) -> Bundle {
    let mut bundle = Bundle::new();
    bundle.clear(reach, 20.0);
    for point in 0..4 {
        // One origin on a vertex of the scene, the others anywhere near it
        let offset = random.vertex(extent / 4);
        bundle.push_origin(if point == 0 { vertex } else { vertex + offset });
        for ray in 0..64 {
            let direction = match ray {
                0 => Vec3::X,
                1 => -Vec3::Z,
                _ => (Vec3::new(random.unit(), random.unit(), random.unit()) - 0.5).normalize_or(Vec3::Y),
            };
            bundle.push_ray(direction, u32::MAX);
        }
    }
    bundle
}

/// Catches any face that traversal misses or invents: every ray against every face in double precision is the truth.
#[test]
fn every_instruction_set_agrees_with_brute_force() {
    for instructions in InstructionSet::available() {
        let mut random = Random(11);
        let (mut hits, mut rays, mut differences) = (0_u64, 0_u64, 0_u64);
        for case in 0..60 {
            let extent = [100, 5000, 1 << 20, 1 << 27][case % 4];
            let (map, faces) = random_map(&mut random, extent, (extent / [2, 8][case % 2]).max(4));
            let reach = if case % 3 == 0 { extent as f32 / 3.0 } else { f32::INFINITY };
            let mut bundle = random_bundle(&mut random, extent, faces[0].vertices[0], reach);
            let ids: Vec<u16> = (0..bundle.len() as u16).collect();
            walk(&map, &ROOT, &ids, 0.0, &mut bundle, &mut Scratch::new(), instructions);
            for ray in 0..bundle.len() {
                let origin = bundle.origins[ray / 64].position;
                let direction = Vec3::from_slice(&bundle.directions[ray][..3]).as_dvec3();
                let expected: u64 = faces
                    .iter()
                    .filter(|face| intersect::meets(face, origin, direction, f64::from(reach)))
                    .map(|face| u64::from(face_extinction(face.extinction)))
                    .sum();
                rays += 1;
                hits += u64::from(expected > 0);
                // A leaf with an opaque face counts it once
                let opaque = u64::from(EXTINCTION_OPAQUE);
                let met = u64::from(bundle.extinction[ray]);
                differences += u64::from(met.min(opaque) != expected.min(opaque));
            }
        }
        // Single precision may decide a ray through an edge, or at the reach, differently
        assert!(hits > rays / 20, "{instructions:?}: {hits} of {rays} rays hit, the test is empty");
        assert!(differences <= rays / 5000, "{instructions:?}: {differences} of {rays} rays differ");
    }
}

/// Catches an instruction set that gives other bits than the plain loops.
#[test]
fn every_instruction_set_gives_the_same_bits() {
    let mut random = Random(12);
    for case in 0..40 {
        let extent = [60, 3000, 1 << 22, 1 << 28][case % 4];
        let (map, faces) = random_map(&mut random, extent, extent / 4);
        let seed = random.0;
        let of = |instructions| {
            let mut bundle = random_bundle(&mut Random(seed), extent, faces[3].vertices[1], f32::INFINITY);
            let ids: Vec<u16> = (0..bundle.len() as u16).collect();
            let mut scratch = Scratch::new();
            walk(&map, &ROOT, &ids, 0.05 * (case % 2) as f32, &mut bundle, &mut scratch, instructions);
            (bundle.extinction, bundle.alive, scratch.counts)
        };
        let plain = of(InstructionSet::Plain);
        for instructions in InstructionSet::available() {
            assert_eq!(of(instructions), plain, "{instructions:?}, case {case}");
        }
    }
}
