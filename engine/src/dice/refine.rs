//! A step of Catmull-Clark subdivision, with creases as DeRose, Kass and Truong (1998) have them.

use std::collections::HashMap;

use super::level::{Level, NONE};

/// Which faces a step keeps, and what became of the faces and vertices before it.
pub(super) struct Step {
    /// The level that the step makes.
    pub level: Level,
    /// Per face of the new level the face it is of, and which of its corners it has.
    pub parents: Vec<(u32, u32)>,
}

/// Refines the faces that are `kept`. A face of n corners becomes n quads, one for each corner: its vertices are the corner's,
/// those of the two edges there and the face's own, in an order that `turned` gives: by how many places they are turned.
pub(super) fn refine(level: &Level, kept: &[bool], turned: &dyn Fn(u32, u32) -> u32) -> Step {
    let faces = level.ends.len();
    let vertices = level.vertex_sharpness.len();
    let edges = level.edges.len();

    // Number what kept faces have, in the order vertices, edges, faces
    let mut numbers = vec![NONE; vertices + edges + faces];
    for face in (0..faces).filter(|&face| kept[face]) {
        numbers[vertices + edges + face] = 0;
        for corner in level.face(face as u32) {
            numbers[level.corners[corner] as usize] = 0;
            numbers[vertices + level.corner_edges[corner] as usize] = 0;
        }
    }
    let mut count = 0;
    for number in numbers.iter_mut().filter(|number| **number == 0) {
        *number = count;
        count += 1;
    }

    // Place them
    let width = level.width;
    let mut next = Level { width, rows: Vec::with_capacity(count as usize * width), ..Level::default() };
    let centers: Vec<f64> = (0..faces as u32).flat_map(|face| center(level, face)).collect();
    let center_of = |face: u32| &centers[face as usize * width..(face as usize + 1) * width];
    for (old, _) in numbers.iter().enumerate().filter(|(_, number)| **number != NONE) {
        if old < vertices {
            next.rows.extend(vertex_point(level, old as u32, &center_of));
            next.vertex_sharpness.push(softer(level.vertex_sharpness[old]));
        } else if old < vertices + edges {
            next.rows.extend(edge_point(level, (old - vertices) as u32, &center_of));
            next.vertex_sharpness.push(0.0);
        } else {
            next.rows.extend_from_slice(center_of((old - vertices - edges) as u32));
            next.vertex_sharpness.push(0.0);
        }
    }

    // Connect them
    let mut parents = Vec::new();
    let edge_number = |corner: u32| numbers[vertices + level.corner_edges[corner as usize] as usize];
    for face in (0..faces as u32).filter(|&face| kept[face as usize]) {
        let range = level.face(face);
        for corner in range.clone() {
            let quad = [
                numbers[level.corners[corner] as usize],
                edge_number(corner as u32),
                numbers[vertices + edges + face as usize],
                edge_number(level.turn(corner as u32, -1)),
            ];
            let child = (corner - range.start) as u32;
            let turn = turned(face, child) as usize;
            next.corners.extend((0..4).map(|i| quad[(i + turn) % 4]));
            next.ends.push(next.corners.len() as u32);
            parents.push((face, child));
        }
    }
    next.connect(&creases(level, &numbers));
    Step { level: next, parents }
}

/// Sharpness after a step; what is as sharp as can be stays.
fn softer(sharpness: f32) -> f32 {
    if sharpness >= super::level::SHARP { sharpness } else { (sharpness - 1.0).max(0.0) }
}

/// The halves of sharp edges that stay sharp.
fn creases(level: &Level, numbers: &[u32]) -> HashMap<[u32; 2], f32> {
    let vertices = level.vertex_sharpness.len();
    let mut creases = HashMap::new();
    for (edge, ends) in level.edges.iter().enumerate() {
        let sharpness = softer(level.edge_sharpness[edge]);
        let middle = numbers[vertices + edge];
        if sharpness > 0.0 && middle != NONE {
            for end in ends.map(|end| numbers[end as usize]).into_iter().filter(|&end| end != NONE) {
                creases.insert([end.min(middle), end.max(middle)], sharpness);
            }
        }
    }
    creases
}

/// The mean of a face's corners.
fn center(level: &Level, face: u32) -> Vec<f64> {
    let range = level.face(face);
    let mut sum = vec![0.0; level.width];
    // In the order of their numbers, wherever the face begins
    let mut corners = level.corners[range].to_vec();
    corners.sort_unstable();
    corners.iter().for_each(|&corner| add(&mut sum, level.row(corner), 1.0));
    scale(&mut sum, 1.0 / corners.len() as f64);
    sum
}

fn edge_point<'a>(level: &Level, edge: u32, center: &dyn Fn(u32) -> &'a [f64]) -> Vec<f64> {
    let [a, b] = level.edges[edge as usize];
    let mut middle = vec![0.0; level.width];
    add(&mut middle, level.row(a), 0.5);
    add(&mut middle, level.row(b), 0.5);
    let sharpness = f64::from(level.edge_sharpness[edge as usize]);
    if sharpness >= 1.0 {
        return middle;
    }
    let mut smooth = middle.clone();
    scale(&mut smooth, 0.5);
    let ([left, right], _) = level.edge_faces[edge as usize];
    add(&mut smooth, center(left), 0.25);
    add(&mut smooth, center(right), 0.25);
    mix(smooth, &middle, sharpness)
}

fn vertex_point<'a>(level: &Level, vertex: u32, center: &dyn Fn(u32) -> &'a [f64]) -> Vec<f64> {
    let own = level.row(vertex);
    let (count, creases) = level.sharp_edges(vertex);
    let corner_sharpness = f64::from(level.vertex_sharpness[vertex as usize]);
    if count > 2 || corner_sharpness >= 1.0 {
        return own.to_vec();
    }
    let smooth = || {
        let edges = level.edges_of(vertex);
        let n = edges.len() as f64;
        let mut sum = vec![0.0; level.width];
        for &edge in edges {
            add(&mut sum, level.row(level.other(edge, vertex)), 1.0 / (n * n));
        }
        for &corner in level.corners_of(vertex) {
            add(&mut sum, center(level.corner_faces[corner as usize]), 1.0 / (n * n));
        }
        add(&mut sum, own, (n - 2.0) / n);
        sum
    };
    let point = match count {
        2 => {
            let mut crease = vec![0.0; level.width];
            add(&mut crease, own, 0.75);
            creases.iter().for_each(|&edge| add(&mut crease, level.row(level.other(edge, vertex)), 0.125));
            // A crease that is about to end is half one already
            let sharpness = creases.map(|edge| f64::from(level.edge_sharpness[edge as usize]));
            let share = (0.5 * (sharpness[0] + sharpness[1])).min(1.0);
            if share < 1.0 { mix(smooth(), &crease, share) } else { crease }
        }
        _ => smooth(),
    };
    mix(point, own, corner_sharpness)
}

/// Adds `weight` times `row`.
pub(super) fn add(sum: &mut [f64], row: &[f64], weight: f64) {
    sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
}

fn scale(row: &mut [f64], by: f64) {
    row.iter_mut().for_each(|value| *value *= by);
}

/// `a`, and a `share` of `b` in its place.
fn mix(mut a: Vec<f64>, b: &[f64], share: f64) -> Vec<f64> {
    if share > 0.0 {
        scale(&mut a, 1.0 - share);
        add(&mut a, b, share);
    }
    a
}
