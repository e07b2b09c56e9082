//! How good the brick map's trees are, and how fast the parts of the builder.
//!
//! `cargo bench -p engine --bench trees [-- MICROPOLYGONS]`. Per scene: the surface-area cost of the map (nodes and leaves,
//! the tree over the partitions included) against one global tree by a full sweep over the same leaves, and over single
//! faces; how full leaves and nodes are; bytes; nanoseconds per micropolygon of every part, in one thread.

mod map;
mod phases;
mod scenes;
mod sweep;

use std::sync::atomic::AtomicBool;

use engine::brick::leaf::FACES_MAX;
use engine::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};

fn main() {
    let count = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(1_000_000);
    let only = std::env::args().skip(1).find(|argument| argument.starts_with(|c: char| c.is_alphabetic()));
    println!(
        "{:20} {:>9} {:>6} {:>7} {:>7} {:>7} {:>7} {:>7} {:>6} {:>6} {:>6}",
        "scene", "faces", "cost", "nodes", "leaves", "stored", "/leaves", "/faces", "fill", "width", "bytes"
    );
    for mut scene in scenes::all(count) {
        if only.as_ref().is_some_and(|only| *only != scene.name) {
            continue;
        }
        let folder = std::env::temp_dir().join(format!("pantaray-trees.{}", std::process::id()));
        let options = BuildOptions {
            memory_bytes: 1 << 30,
            threads: 1,
            scratch: folder.join("scratch"),
            far_field: FarField::Paper,
        };
        let target = folder.join("map");
        let report = build(
            &mut [OccluderStream::once(&mut scene)],
            &options,
            &target,
            &|_, _| {},
            &AtomicBool::new(false),
        )
        .expect("the scene builds");
        let tree = map::tree(&BrickMap::open(&target).expect("the map opens"));
        let cost = tree.nodes + tree.leaves;
        let faces = tree.face_boxes.len();
        let yard = sweep::cost(&tree.leaf_boxes, 1).0;
        let (yard_faces, _) = sweep::cost(&tree.face_boxes, FACES_MAX);
        println!(
            "{:20} {faces:>9} {cost:>6.1} {:>7.1} {:>7.1} {:>7.1} {:>7.3} {:>7.3} {:>6.2} {:>6.2} {:>6.2}",
            scene.name,
            tree.nodes,
            tree.leaves,
            tree.stored,
            cost / yard,
            cost / yard_faces,
            faces as f64 / tree.leaf_boxes.len() as f64,
            (tree.leaf_boxes.len() + tree.node_count - 1) as f64 / tree.node_count as f64,
            report.bytes as f64 / faces as f64,
        );
        phases::report(&mut scene);
        std::fs::remove_dir_all(&folder).expect("the folder is ours");
    }
}
