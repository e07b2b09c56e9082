//! The far field of small scenes against brute force and closed forms.

use glam::{IVec3, Mat3, Vec3};

use super::lines::{Directions, LINES_MAX, Lines};
use super::shapes::Shapes;
use super::shoot::Grove;
use super::{Others, Root, directional, lost};
use crate::brick::far::{self, Kind, Record, transmittance};
use crate::brick::intersect;
use crate::brick::lanes::InstructionSet;
use crate::brick::leaf::{Face, Layout, OPAQUE, READ_PAST_BYTES};
use crate::brick::node::{LatticeBox, Node, WIDTH};
use crate::brickmap::bvh::{self, WideChild, WideTree};
use crate::brickmap::chunk::Chunk;
use crate::brickmap::pack::Primitive;
use crate::brickmap::spill::Quantised;
use crate::math::hash::{hash32, unit_f32};

/// A tree over faces.
struct Forest {
    tree: WideTree,
    nodes: Vec<Node>,
    shapes: Shapes,
    faces: Vec<Face>,
}

impl Forest {
    fn plant(grids: &[Quantised]) -> Self {
        let mut chunk = Chunk::default();
        grids.iter().for_each(|grid| chunk.add(grid));
        chunk.finish();
        let boxes: Vec<LatticeBox> = chunk.clusters.iter().map(|cluster| cluster.bounds).collect();
        let tree = bvh::build(&boxes);
        let mut bounds = vec![LatticeBox::EMPTY; tree.nodes.len()];
        for (index, wide) in tree.nodes.iter().enumerate().rev() {
            bounds[index] =
                wide.children[..usize::from(wide.count)].iter().fold(LatticeBox::EMPTY, |all, child| {
                    all.union(match *child {
                        WideChild::Node(node) => bounds[node as usize],
                        WideChild::Primitive(leaf) => boxes[leaf as usize],
                    })
                });
        }
        let over = |wide: &bvh::WideNode| {
            let of = |child: &WideChild| match *child {
                WideChild::Node(node) => bounds[node as usize],
                WideChild::Primitive(leaf) => boxes[leaf as usize],
            };
            Node::over(&wide.children[..usize::from(wide.count)].iter().map(of).collect::<Vec<_>>())
        };
        let nodes = tree.nodes.iter().map(over).collect();
        let (mut shapes, mut faces) = (Shapes::default(), Vec::new());
        for (number, Primitive { bounds, .. }) in chunk.clusters.iter().enumerate() {
            let contents = chunk.leaves.get(number);
            shapes.push(&contents);
            let mut leaf = Vec::new();
            contents.encode(bounds.min, &mut leaf);
            leaf.extend([0; READ_PAST_BYTES]);
            let layout = Layout::read_trusted(&leaf, bounds.min);
            faces.extend((0..layout.faces).map(|face| layout.face(&leaf, face)));
        }
        Self { tree, nodes, shapes, faces }
    }

    fn far(&self, others: Others<'_>, instructions: InstructionSet) -> (Vec<[Record; WIDTH]>, Root) {
        directional(&self.tree, &self.nodes, &self.shapes, others, instructions)
    }

    /// Every child with its record.
    fn children(&self, records: &[[Record; WIDTH]]) -> Vec<(WideChild, LatticeBox, Record)> {
        let mut all = Vec::new();
        for (index, wide) in self.tree.nodes.iter().enumerate() {
            for slot in 0..usize::from(wide.count) {
                all.push((wide.children[slot], self.nodes[index].child_box(slot), records[index][slot]));
            }
        }
        all
    }

    fn grove(&self) -> Grove<'_> {
        Grove { tree: &self.tree.nodes, nodes: &self.nodes, shapes: &self.shapes }
    }
}

struct Random(u32);

impl Random {
    fn unit(&mut self) -> f32 {
        self.0 = hash32(self.0);
        unit_f32(self.0)
    }

    fn point(&mut self, side: f32) -> Vec3 {
        (Vec3::new(self.unit(), self.unit(), self.unit()) - 0.5) * side
    }
}

/// Points, lines, triangles and quads, half of them transparent if `transparent`.
fn litter(random: &mut Random, count: usize, side: f32, size: f32, transparent: bool) -> Vec<Quantised> {
    (0..count)
        .map(|i| {
            let (arity, at) = (1 + i % 4, random.point(side));
            let mut grid = Quantised::default();
            for corner in 0..arity {
                let offset = random.point(size) * if corner == 0 { 0.0 } else { 1.0 };
                grid.vertices.push((at + offset).round().as_ivec3());
                grid.indices.push(corner as u8);
            }
            grid.arities.push(arity as u8);
            if arity <= 2 {
                grid.radii = (0..arity).map(|_| 0.1 * size * random.unit() + 1.0).collect();
            }
            if transparent && i % 8 < 4 {
                grid.extinctions.push(500 + (3000.0 * random.unit()) as u16);
            }
            grid
        })
        .collect()
}

/// A sheet of `cells` x `cells` quads of side `edge`, turned, without those for which `hole` holds.
fn sheet(cells: i32, edge: f32, turn: Mat3, hole: impl Fn(i32, i32) -> bool) -> Vec<Quantised> {
    let mut grids = Vec::new();
    for row in 0..cells {
        for column in (0..cells).filter(|&column| !hole(column, row)) {
            let at = |x: i32, y: i32| {
                let flat = Vec3::new((2 * x - cells) as f32, (2 * y - cells) as f32, 0.0) * 0.5 * edge;
                (turn * flat).round().as_ivec3()
            };
            grids.push(Quantised {
                vertices: vec![
                    at(column, row),
                    at(column + 1, row),
                    at(column + 1, row + 1),
                    at(column, row + 1),
                ],
                arities: vec![4],
                indices: vec![0, 1, 2, 3],
                ..Quantised::default()
            });
        }
    }
    grids
}

fn tilt() -> Mat3 {
    Mat3::from_rotation_x(0.6) * Mat3::from_rotation_y(0.4)
}

/// Catches an instruction set that fits other bits than the plain loops.
#[test]
fn every_instruction_set_gives_the_same_bits() {
    for (seed, side) in [(1, 3e3), (2, 1e5), (3, 3e7)] {
        let mut random = Random(seed);
        let mut grids = litter(&mut random, 1500, side, side / 12.0, seed == 2);
        grids.extend(sheet(24, side / 40.0, tilt(), |_, _| false));
        let forest = Forest::plant(&grids);
        let plain = forest.far(&[], InstructionSet::Plain);
        for instructions in InstructionSet::available() {
            assert!(forest.far(&[], instructions) == plain, "{instructions:?}, seed {seed}");
        }
    }
}

/// Catches a shooter that misses faces or invents them: every line against every face in double precision is the truth.
#[test]
fn lines_meet_what_brute_force_meets() {
    let mut random = Random(7);
    let (mut differences, mut hits, mut total) = (0, 0, 0);
    for case in 0..6 {
        let side = [500.0, 1e4, 1e6][case % 3];
        let forest = Forest::plant(&litter(&mut random, 400, side, side / 8.0, case >= 3));
        let bounds =
            LatticeBox { min: IVec3::splat((-0.6 * side) as i32), max: IVec3::splat((0.6 * side) as i32) };
        let mut lines = Lines::new(Directions::many());
        for round in 0..8 {
            lines.fill(&bounds, Directions::many(), round);
            let lost = lost(forest.grove(), WideChild::Node(0), &lines);
            for (line, &lost) in lost.iter().enumerate() {
                let direction = lines.direction(line).as_dvec3().normalize();
                let start = Vec3::from_array(lines.start.each_ref().map(|column| column[line]));
                // Rays start on the lattice: from well outside, where rounding turns the line by little
                let far = 100.0 * f64::from(side);
                let origin = (start.as_dvec3() - direction * far).round().as_ivec3() + lines.center;
                let direction = ((start + lines.center.as_vec3()).as_dvec3() - origin.as_dvec3()).normalize();
                let expected: f32 = forest
                    .faces
                    .iter()
                    .filter(|face| intersect::meets(face, origin, direction, f64::INFINITY))
                    .map(|face| transmittance(face.extinction))
                    .product();
                total += 1;
                hits += usize::from(expected < 1.0);
                differences += usize::from((1.0 - lost - expected).abs() > 1e-3);
            }
        }
    }
    assert!(hits > total / 10 && hits < total, "{hits} of {total}: the test is empty");
    assert!(differences <= total / 200, "{differences} of {total} lines differ");
}

/// Catches a wall that lets light through at an angle: every part of it is an opaque plate or opened.
#[test]
fn a_tilted_wall_is_a_plate() {
    let forest = Forest::plant(&sheet(64, 70.0, tilt(), |_, _| false));
    let (records, root) = forest.far(&[], InstructionSet::detect());
    let children = forest.children(&records);
    let plates =
        children.iter().filter(|(_, _, r)| far::kind(r) == Kind::Plate && !far::must_open(r)).count();
    let open = children.iter().filter(|(_, _, record)| far::must_open(record)).count();
    assert!(plates + open >= children.len() * 99 / 100, "{plates} plates, {open} open of {}", children.len());
    assert!(plates > children.len() / 2, "{plates} of {}", children.len());
    let bounds = forest.children(&records)[0].1;
    let record = root.record(&LatticeBox { min: bounds.min - 9000, max: bounds.max + 9000 });
    assert!(far::kind(&record) == Kind::Plate || far::must_open(&record));
}

/// Catches a window that is closed: no plate may cover a hole as large as itself.
#[test]
fn a_window_stays_open() {
    let window = |x: i32, y: i32| (20..40).contains(&x) && (24..44).contains(&y);
    let forest = Forest::plant(&sheet(64, 70.0, tilt(), window));
    let (records, _) = forest.far(&[], InstructionSet::detect());
    let mut checked = 0;
    for (child, bounds, record) in forest.children(&records) {
        if far::must_open(&record) {
            continue;
        }
        // What the window's own quads lose to the record
        for (x, y) in [(22, 26), (30, 34), (37, 41)] {
            let center = tilt() * Vec3::new((2 * x - 63) as f32, (2 * y - 63) as f32, 0.0) * 35.0;
            let half = (bounds.max - bounds.min).as_vec3() * 0.5;
            let direction = tilt() * Vec3::Z;
            let middle = bounds.min.as_vec3() + half - center;
            let seen = far::SeenBox { center: middle + direction * 1e5, half };
            let (enter, leave) = far::pass(direction, &seen);
            if enter <= leave && leave > 0.0 {
                checked += 1;
                let lost = far::extinction(&record, direction, &seen);
                assert!(lost < 40_000, "{child:?} {bounds:?} closes the window at {x} {y}");
            }
        }
    }
    let _ = checked;
}

/// Catches a border between partitions that is taken for a gap: what other partitions hold is unknown, not empty.
#[test]
fn a_border_is_no_gap() {
    let half = sheet(64, 70.0, tilt(), |x, y| x + y >= 64);
    let forest = Forest::plant(&half);
    let other = sheet(64, 70.0, tilt(), |x, y| x + y < 64);
    let others = other.iter().flat_map(|grid| &grid.vertices).fold(LatticeBox::EMPTY, |mut all, &v| {
        all.add(v);
        all
    });
    // Along the border, away from the sheet's real edges: plates, and what is neither a plate nor opened
    let border = |others: Others<'_>| {
        let (records, _) = forest.far(others, InstructionSet::detect());
        let is_at_border = |(_, bounds, _): &(WideChild, LatticeBox, Record)| {
            let half = (bounds.max - bounds.min).as_vec3() * 0.5;
            let at = tilt().transpose() * (bounds.min.as_vec3() + half);
            (at.x + at.y).abs() < half.length() && at.x.abs().max(at.y.abs()) + half.length() < 32.0 * 70.0
        };
        let children: Vec<_> = forest.children(&records).into_iter().filter(is_at_border).collect();
        let closed = |kind: fn(Kind) -> bool| {
            children.iter().filter(|(_, _, r)| !far::must_open(r) && kind(far::kind(r))).count()
        };
        (closed(|kind| kind == Kind::Plate), closed(|kind| kind != Kind::Plate))
    };
    let (alone, among) = (border(&[]), border(&[others]));
    assert_eq!(among.1, 0, "{alone:?} alone, {among:?} among others");
    assert!(among.0 > alone.0, "{alone:?} alone, {among:?} among others: the test is empty");
}

/// Catches proxies that are on average more or less opaque than what they stand for.
#[test]
fn aggregates_are_unbiased() {
    let mut random = Random(9);
    for transparent in [false, true] {
        let forest = Forest::plant(&litter(&mut random, 20_000, 9e3, 700.0, transparent));
        let (records, root) = forest.far(&[], InstructionSet::detect());
        let (mut sum, mut truth, mut count) = (0.0, 0.0, 0.0);
        let mut all = forest.children(&records);
        let bounds = all.iter().fold(LatticeBox::EMPTY, |b, (_, child, _)| b.union(*child));
        all.push((WideChild::Node(0), bounds, root.record(&bounds)));
        for (child, bounds, record) in all {
            let half = (bounds.max - bounds.min).as_vec3() * 0.5;
            if matches!(child, WideChild::Primitive(_)) {
                continue;
            }
            let mut lines = Lines::new(Directions::many());
            for round in 1..5 {
                lines.fill(&bounds, Directions::many(), round);
                let lost = lost(forest.grove(), child, &lines);
                for line in 0..LINES_MAX {
                    let seen = far::SeenBox { center: lines.direction(line), half };
                    let stored =
                        far::extinction(&record, lines.direction(line), &seen).min(u32::from(OPAQUE));
                    sum += f64::from(1.0 - transmittance(stored as u16));
                    truth += f64::from(lost[line]);
                    count += 1.0;
                }
            }
        }
        let (mean, bias) = (truth / count, (sum - truth) / count);
        assert!(mean > 0.05 && mean < 0.95, "{mean}: the test is empty");
        assert!(bias.abs() < 0.01, "bias {bias} of {mean}");
    }
}
