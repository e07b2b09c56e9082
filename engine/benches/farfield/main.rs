//! The far field against brute force: opacity of the proxies of nine classes of geometry, and what the fit costs.
//!
//! `cargo bench -p engine --bench farfield -- [--quads N] [--seed N] [--time]`

mod classes;

use std::time::Instant;

use engine::brick::LatticeBox;
use engine::brick::far::{self, Kind, SeenBox};
use engine::brick::lanes::InstructionSet;
use engine::brick::leaf::EXTINCTION_PER_OCTAVE;
use engine::brick::node::Node;
use engine::brickmap::bvh::{self, WideChild, WideTree};
use engine::brickmap::chunk::Chunk;
use engine::brickmap::farfield::lines::{Directions, LINES_MAX, Lines, fibonacci};
use engine::brickmap::farfield::shapes::Shapes;
use engine::brickmap::farfield::shoot::Grove;
use engine::brickmap::farfield::{directional, lost, paper};
use engine::brickmap::pack::Primitive;
use engine::brickmap::spill::Quantised;
use glam::Vec3;

/// Directions of a comparison.
const DIRECTIONS: usize = 200;
/// Rounds of 64 lines a direction.
const ROUNDS: u32 = 4;
/// Children compared, of each size, at most.
const CHILDREN_MAX: usize = 24;

/// A tree with its geometry, ready for the far field.
struct Forest {
    tree: WideTree,
    nodes: Vec<Node>,
    shapes: Shapes,
    primitives: Vec<Primitive>,
    /// Below every node: box, area, micropolygons.
    sums: Vec<(LatticeBox, f32, u64)>,
}

impl Forest {
    fn plant(grids: &[Quantised]) -> Self {
        let mut chunk = Chunk::default();
        grids.iter().for_each(|grid| chunk.add(grid));
        chunk.finish();
        let primitives = std::mem::take(&mut chunk.clusters);
        let boxes: Vec<LatticeBox> = primitives.iter().map(|p| p.bounds).collect();
        let tree = bvh::build(&boxes);
        let mut sums = vec![(LatticeBox::EMPTY, 0.0, 0); tree.nodes.len()];
        for (index, wide) in tree.nodes.iter().enumerate().rev() {
            for child in &wide.children[..usize::from(wide.count)] {
                let below = match *child {
                    WideChild::Node(node) => sums[node as usize],
                    WideChild::Primitive(p) => {
                        let p = &primitives[p as usize];
                        (p.bounds, p.area, p.micropolygons)
                    }
                };
                let sum = &mut sums[index];
                *sum = (sum.0.union(below.0), sum.1 + below.1, sum.2 + below.2);
            }
        }
        let nodes = tree
            .nodes
            .iter()
            .map(|wide| {
                let bounds = |child: &WideChild| match *child {
                    WideChild::Node(node) => sums[node as usize].0,
                    WideChild::Primitive(p) => primitives[p as usize].bounds,
                };
                Node::over(&wide.children[..usize::from(wide.count)].iter().map(bounds).collect::<Vec<_>>())
            })
            .collect();
        let mut shapes = Shapes::default();
        (0..chunk.leaves.len()).for_each(|leaf| shapes.push(&chunk.leaves.get(leaf)));
        Self { tree, nodes, shapes, primitives, sums }
    }

    fn quads(&self) -> u64 {
        self.sums[0].2
    }

    fn grove(&self) -> Grove<'_> {
        Grove { tree: &self.tree.nodes, nodes: &self.nodes, shapes: &self.shapes }
    }
}

/// Errors of many comparisons.
#[derive(Clone, Copy, Default)]
struct Errors {
    squares: f64,
    sum: f64,
    truth: f64,
    count: f64,
}

impl Errors {
    fn add(&mut self, truth: f64, got: f64) {
        self.squares += (got - truth).powi(2);
        self.sum += got - truth;
        self.truth += truth;
        self.count += 1.0;
    }

    fn text(&self) -> String {
        format!("{:.3} ({:+.3})", (self.squares / self.count).sqrt(), self.sum / self.count)
    }
}

/// Kinds of the children of one size.
#[derive(Clone, Copy, Default)]
struct Kinds {
    single: usize,
    layered: usize,
    plates: usize,
    must_open: usize,
}

/// The far field of children with a number of micropolygons in `sizes` against lines.
fn compare(
    forest: &Forest,
    records: &[[far::Record; 8]],
    sizes: std::ops::Range<u64>,
) -> Option<(Errors, Errors, Kinds)> {
    let mut candidates = Vec::new();
    let mut kinds = Kinds::default();
    for (index, wide) in forest.tree.nodes.iter().enumerate() {
        for (slot, child) in wide.children[..usize::from(wide.count)].iter().enumerate() {
            let quads = match *child {
                WideChild::Node(node) => forest.sums[node as usize].2,
                WideChild::Primitive(p) => forest.primitives[p as usize].micropolygons,
            };
            if !sizes.contains(&quads) {
                continue;
            }
            let record = &records[index][slot];
            match far::kind(record) {
                _ if far::must_open(record) => kinds.must_open += 1,
                Kind::Plate => kinds.plates += 1,
                Kind::Layered => kinds.layered += 1,
                _ => kinds.single += 1,
            }
            if !far::must_open(record) {
                candidates.push((index, slot));
            }
        }
    }
    let step = candidates.len().div_ceil(CHILDREN_MAX).max(1);
    let (mut errors, mut paper_errors) = (Errors::default(), Errors::default());
    for &(index, slot) in candidates.iter().step_by(step) {
        let (bounds, child) = (forest.nodes[index].child_box(slot), forest.tree.nodes[index].children[slot]);
        let area = match child {
            WideChild::Node(node) => forest.sums[node as usize].1,
            WideChild::Primitive(p) => forest.primitives[p as usize].area,
        };
        let paper = paper(&bounds, area, area);
        for i in 0..DIRECTIONS {
            let directions = Directions::parallel(fibonacci(i, DIRECTIONS));
            let mut lines = Lines::new(&directions);
            let (mut truth, mut got, mut papers) = (0.0, 0.0, 0.0);
            for round in 1..=ROUNDS {
                lines.fill(&bounds, &directions, round);
                let lost = lost(forest.grove(), child, &lines);
                for line in 0..LINES_MAX {
                    truth += f64::from(lost[line]);
                    got += opacity(&records[index][slot], &lines, line, &bounds);
                    papers += opacity(&paper, &lines, line, &bounds);
                }
            }
            let count = f64::from(ROUNDS) * LINES_MAX as f64;
            errors.add(truth / count, got / count);
            paper_errors.add(truth / count, papers / count);
        }
    }
    (errors.count > 0.0).then_some((errors, paper_errors, kinds)).or((kinds.must_open > 0).then_some((
        errors,
        paper_errors,
        kinds,
    )))
}

fn opacity(record: &far::Record, lines: &Lines<'_>, line: usize, bounds: &LatticeBox) -> f64 {
    let start = Vec3::new(lines.start[0][line], lines.start[1][line], lines.start[2][line]);
    let middle = ((bounds.min - lines.center) + (bounds.max - lines.center)).as_vec3() * 0.5;
    // Seen from well outside
    let origin = start - lines.direction(line) * lines.half.length();
    let extinction = far::extinction(
        record,
        lines.direction(line),
        &SeenBox { center: middle - origin, half: lines.half },
    );
    1.0 - (-f64::from(extinction) / f64::from(EXTINCTION_PER_OCTAVE)).exp2()
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value = |name: &str, default: u32| {
        let at = arguments.iter().position(|a| a == name);
        at.and_then(|at| arguments.get(at + 1)).and_then(|v| v.parse().ok()).unwrap_or(default)
    };
    let (quads, seed) = (value("--quads", 60_000) as usize, value("--seed", 1));
    let only_time = arguments.iter().any(|a| a == "--time");
    let compares_sets = arguments.iter().any(|a| a == "--sets");
    println!("{quads} quads, seed {seed}: RMSE (bias) of opacity");
    println!(
        "{:<20} {:>7} {:<10} {:<16} {:<16} {:<16}",
        "class", "ns/quad", "size", "directional", "paper", "single/layered/plates/open"
    );
    for class in 0..classes::NAMES.len() {
        let forest = Forest::plant(&classes::generate(class, quads, seed));
        let start = Instant::now();
        let far = |set| directional(&forest.tree, &forest.nodes, &forest.shapes, &[], set);
        let (records, _) = far(InstructionSet::detect());
        let cost = start.elapsed().as_secs_f64() * 1e9 / forest.quads() as f64;
        if compares_sets {
            for set in InstructionSet::available() {
                let same = far(set).0 == records;
                println!("    {}: {}", set.name(), if same { "same bits" } else { "OTHER BITS" });
            }
        }
        println!("{:<20} {cost:>7.0}", classes::NAMES[class]);
        if only_time {
            continue;
        }
        for (name, sizes) in
            [("leaf", 1..9), ("16-128", 16..128), ("brick", 256..1024), ("above", 2048..1 << 40)]
        {
            if let Some((errors, papers, kinds)) = compare(&forest, &records, sizes) {
                let Kinds { single, layered, plates, must_open } = kinds;
                let truth = errors.truth / errors.count;
                println!(
                    "{:<28} {name:<10} {:<16} {:<16} {single}/{layered}/{plates}/{must_open}  truth {truth:.2}",
                    "",
                    errors.text(),
                    papers.text()
                );
            }
        }
    }
}
