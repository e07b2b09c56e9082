//! Nanoseconds per micropolygon of every part of the builder, on one partition.

use std::time::Instant;

use engine::brick::LatticeBox;
use engine::brick::lattice::{Lattice, exponent_for_edge};
use engine::brickmap::bvh;
use engine::brickmap::chunk::Chunk;
use engine::brickmap::pack::{Far, Packed, pack};
use engine::brickmap::spill::Quantised;
use engine::math::Bounds;
use engine::stream::{Microgrid, MicrogridStream};

/// Micropolygons that are measured.
const MICROPOLYGONS: usize = 1 << 19;

/// Parts of the builder.
const PARTS: [&str; 5] = ["read", "read and tile", "gather", "tree", "pack"];

/// Prints a line: the least of three runs.
pub fn report(scene: &mut dyn MicrogridStream) {
    let (spill, faces) = spill(scene);
    let runs: [[f64; PARTS.len()]; 3] = std::array::from_fn(|_| run(&spill));
    let least = |part: usize| runs.iter().map(|run| run[part]).fold(f64::INFINITY, f64::min);
    let part = |(part, name)| format!("{name} {:.1}", least(part) * 1e9 / faces as f64);
    let parts: Vec<String> = PARTS.iter().enumerate().map(part).collect();
    println!("    ns per face: {}", parts.join(", "));
}

/// Seconds of every part.
fn run(spill: &[u8]) -> [f64; PARTS.len()] {
    let mut seconds = [0.0; PARTS.len()];
    let mut start = Instant::now();
    let mut lap = |part: usize| {
        seconds[part] = start.elapsed().as_secs_f64();
        start = Instant::now();
    };
    for_each_grid(spill, |_| ());
    lap(0);
    let mut chunk = Chunk::default();
    for_each_grid(spill, |grid| chunk.add(grid));
    lap(1);
    chunk.finish();
    lap(2);
    let boxes: Vec<LatticeBox> = chunk.clusters.iter().map(|leaf| leaf.bounds).collect();
    let tree = bvh::build(&boxes);
    lap(3);
    let mut packed = Packed::default();
    pack(&tree, &chunk.clusters, &chunk.leaves, 0, Far::Paper, &mut packed);
    lap(4);
    seconds
}

/// Calls `each` with the grids of a spill.
fn for_each_grid(mut spill: &[u8], mut each: impl FnMut(&Quantised)) {
    let mut grid = Quantised::default();
    while !spill.is_empty() {
        spill = grid.decode(spill);
        each(&grid);
    }
}

/// The first micropolygons of a stream as they are spilled.
fn spill(scene: &mut dyn MicrogridStream) -> (Vec<u8>, usize) {
    let mut spill = Vec::new();
    let mut grid = Microgrid::default();
    let (mut bounds, mut edges, mut faces) = (Bounds::EMPTY, 0.0, 0);
    scene.rewind().expect("in memory");
    while faces < MICROPOLYGONS && scene.next(&mut grid).expect("in memory") {
        bounds = bounds.union(&grid.bounds());
        edges += grid
            .faces()
            .map(|f| f64::from(grid.positions[usize::from(f[0])].distance(grid.positions[usize::from(f[1])])))
            .sum::<f64>();
        faces += grid.face_count();
    }
    let lattice = Lattice::new(exponent_for_edge(0.5 * edges / faces as f64), &bounds).expect("a lattice");
    scene.rewind().expect("in memory");
    let (mut seen, mut quantised) = (0, Quantised::default());
    while seen < faces && scene.next(&mut grid).expect("in memory") {
        quantised.clear();
        quantised.vertices.extend((0..grid.vertex_count()).map(|v| lattice.snap(grid.position(v), 0)));
        quantised.arities.extend_from_slice(&grid.arities);
        quantised.indices.extend_from_slice(&grid.indices);
        quantised.find_columns();
        quantised.encode(&mut spill);
        seen += grid.face_count();
    }
    (spill, faces)
}
