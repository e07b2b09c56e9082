//! One level of a subdivision: faces over vertices, with the edges between them and how sharp they are.
//!
//! Sums run over neighbours in the order of their numbers, and numbers keep their order from level to level and from the
//! whole cage to a part of it. So a vertex has the same bits in whatever part of the cage it is computed.

use std::collections::HashMap;

/// No edge, no face.
pub(super) const NONE: u32 = u32::MAX;

/// As sharp as can be: it stays so at all levels.
pub const SHARP: f32 = 10.0;

/// Faces, edges and vertices of a level.
#[derive(Debug, Default)]
pub(super) struct Level {
    /// Values of each vertex, `width` each: the position first.
    pub rows: Vec<f64>,
    /// Values of a vertex.
    pub width: usize,
    /// Corners of all faces.
    pub corners: Vec<u32>,
    /// Where the corners of each face end.
    pub ends: Vec<u32>,
    /// Sharpness per vertex.
    pub vertex_sharpness: Vec<f32>,
    /// Per corner the edge to the next corner.
    pub corner_edges: Vec<u32>,
    /// Edges by the numbers of their ends, the lower one first; in order.
    pub edges: Vec<[u32; 2]>,
    /// Per edge up to two faces, and how many there are.
    pub edge_faces: Vec<([u32; 2], u32)>,
    /// Sharpness per edge; borders are sharp.
    pub edge_sharpness: Vec<f32>,
    /// Per vertex where its corners end in `vertex_corners`.
    pub vertex_ends: Vec<u32>,
    /// Corners by vertex, in order.
    pub vertex_corners: Vec<u32>,
    /// Per corner its face.
    pub corner_faces: Vec<u32>,
    /// Per vertex where its edges end in `vertex_edges`.
    pub vertex_edge_ends: Vec<u32>,
    /// Edges by vertex, in order.
    pub vertex_edges: Vec<u32>,
}

impl Level {
    /// Finds edges and neighbours of faces over `vertices` vertices; `creases` gives the sharpness of edges by their ends.
    pub fn connect(&mut self, creases: &HashMap<[u32; 2], f32>) {
        let vertices = self.vertex_sharpness.len();
        self.corner_faces = vec![0; self.corners.len()];
        let mut sides = Vec::with_capacity(self.corners.len());
        for face in 0..self.ends.len() as u32 {
            let range = self.face(face);
            for corner in range.clone() {
                self.corner_faces[corner] = face;
                let next = if corner + 1 == range.end { range.start } else { corner + 1 };
                let (a, b) = (self.corners[corner], self.corners[next]);
                sides.push(([a.min(b), a.max(b)], corner as u32));
            }
        }
        sides.sort_unstable();
        self.corner_edges = vec![0; self.corners.len()];
        // How many more faces have an edge in the direction of its lower end than in the other
        let mut balances = Vec::new();
        for (ends, corner) in sides {
            if self.edges.last() != Some(&ends) {
                self.edges.push(ends);
                self.edge_faces.push(([NONE; 2], 0));
                balances.push(0);
            }
            let edge = self.edges.len() - 1;
            balances[edge] += if self.corners[corner as usize] == ends[0] { 1 } else { -1 };
            self.corner_edges[corner as usize] = edge as u32;
            let (faces, count) = &mut self.edge_faces[edge];
            if let Some(slot) = faces.get_mut(*count as usize) {
                *slot = self.corner_faces[corner as usize];
            }
            *count += 1;
        }
        let sharp = |(edge, ends): (usize, &[u32; 2])| match (self.edge_faces[edge].1, balances[edge]) {
            (2, 0) => creases.get(ends).copied().unwrap_or(0.0),
            // A border, a place where more than two faces meet, or two that face opposite ways
            _ => SHARP,
        };
        self.edge_sharpness = self.edges.iter().enumerate().map(sharp).collect();
        let corners = self.corners.iter().enumerate().map(|(corner, &vertex)| (vertex, corner as u32));
        (self.vertex_ends, self.vertex_corners) = by_vertex(vertices, corners);
        let ends = self.edges.iter().enumerate().flat_map(|(e, ends)| ends.map(|vertex| (vertex, e as u32)));
        (self.vertex_edge_ends, self.vertex_edges) = by_vertex(vertices, ends);
    }

    /// The corners of a face.
    pub fn face(&self, face: u32) -> std::ops::Range<usize> {
        let start = face.checked_sub(1).map_or(0, |before| self.ends[before as usize]);
        start as usize..self.ends[face as usize] as usize
    }

    /// The corner before or behind one in its face.
    pub fn turn(&self, corner: u32, by: isize) -> u32 {
        let range = self.face(self.corner_faces[corner as usize]);
        let count = range.len() as isize;
        (range.start as isize + (corner as isize - range.start as isize + by).rem_euclid(count)) as u32
    }

    /// The values of a vertex.
    pub fn row(&self, vertex: u32) -> &[f64] {
        &self.rows[vertex as usize * self.width..(vertex as usize + 1) * self.width]
    }

    /// The corners of the faces around a vertex.
    pub fn corners_of(&self, vertex: u32) -> &[u32] {
        run(&self.vertex_ends, &self.vertex_corners, vertex)
    }

    /// The edges around a vertex.
    pub fn edges_of(&self, vertex: u32) -> &[u32] {
        run(&self.vertex_edge_ends, &self.vertex_edges, vertex)
    }

    /// The other end of an edge.
    pub fn other(&self, edge: u32, vertex: u32) -> u32 {
        let [a, b] = self.edges[edge as usize];
        if a == vertex { b } else { a }
    }

    /// The edges around a vertex that are sharp at all: how many, and the first two.
    pub fn sharp_edges(&self, vertex: u32) -> (usize, [u32; 2]) {
        let mut found = ([NONE; 2], 0);
        for &edge in self.edges_of(vertex).iter().filter(|&&edge| self.edge_sharpness[edge as usize] > 0.0) {
            if let Some(slot) = found.0.get_mut(found.1) {
                *slot = edge;
            }
            found.1 += 1;
        }
        (found.1, found.0)
    }
}

fn run<'a>(ends: &[u32], items: &'a [u32], vertex: u32) -> &'a [u32] {
    let start = vertex.checked_sub(1).map_or(0, |before| ends[before as usize]);
    &items[start as usize..ends[vertex as usize] as usize]
}

/// Sorts items by their vertex, in their own order; returns where those of each vertex end.
fn by_vertex(vertices: usize, items: impl Iterator<Item = (u32, u32)> + Clone) -> (Vec<u32>, Vec<u32>) {
    let mut ends = vec![0_u32; vertices];
    items.clone().for_each(|(vertex, _)| ends[vertex as usize] += 1);
    let mut sum = 0;
    for end in &mut ends {
        sum += *end;
        *end = sum - *end;
    }
    let mut sorted = vec![0; sum as usize];
    // After this pass each start has moved to its end
    for (vertex, item) in items {
        sorted[ends[vertex as usize] as usize] = item;
        ends[vertex as usize] += 1;
    }
    (ends, sorted)
}
