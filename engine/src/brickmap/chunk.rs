//! From the microgrids of a partition to full leaves: what the tree is built over.
//!
//! A micropolygon is never a primitive of its own. Regular grids are cut into tiles of up to eight quads, as square as
//! their cells allow; other grids by balanced splits at multiples of eight faces; the faces of tiny grids are pooled first,
//! so that soups fill their leaves too.

use glam::{IVec3, Vec3};

use super::pack::{Content, Primitive};
use super::spill::Quantised;
use crate::brick::LatticeBox;
use crate::brick::leaf::{self, FACES_MAX, Face, OPAQUE};

/// Grids of fewer faces than this are pooled.
const SMALL_GRID_FACES: usize = 2 * FACES_MAX;

/// What was left out of a partition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Skipped {
    /// Faces of no area.
    pub degenerate: u64,
    /// Points and lines without a radius.
    pub no_radius: u64,
    /// Fully transparent faces.
    pub transparent: u64,
}

/// The leaves of a partition.
#[derive(Debug, Default)]
pub struct Chunk {
    /// One primitive a leaf.
    pub clusters: Vec<Primitive>,
    /// Their encoded leaves.
    pub leaves: Vec<u8>,
    /// What was left out.
    pub skipped: Skipped,
    /// Faces of tiny grids: flat ones and round ones, each with its geometry's shift.
    pools: [Vec<(u8, Face)>; 2],
    faces: Vec<Face>,
    order: Vec<u32>,
    centers: Vec<Vec3>,
}

impl Chunk {
    /// Adds a grid.
    pub fn add(&mut self, grid: &Quantised) {
        if grid.columns > 0 && grid.arities.len() >= FACES_MAX {
            self.add_regular(grid);
            return;
        }
        let mut faces = std::mem::take(&mut self.faces);
        faces.clear();
        let mut at = 0;
        for face in 0..grid.arities.len() {
            faces.extend(self.face(grid, face, at));
            at += usize::from(grid.arities[face]);
        }
        if faces.len() < SMALL_GRID_FACES {
            faces.iter().for_each(|&face| self.pools[usize::from(face.is_round())].push((grid.shift, face)));
        } else {
            // Points and lines come last, so that leaves are all flat or all round
            faces.sort_by_key(Face::is_round);
            let flat = faces.partition_point(|face| !face.is_round());
            self.split(&faces[..flat], grid.shift);
            self.split(&faces[flat..], grid.shift);
        }
        self.faces = faces;
    }

    /// Makes leaves of the pooled faces, and room for those who read past the last leaf. Call it once, at the end.
    pub fn finish(&mut self) {
        for mut pool in std::mem::take(&mut self.pools) {
            pool.sort_by_key(|&(shift, _)| shift);
            for run in pool.chunk_by(|a, b| a.0 == b.0) {
                let faces: Vec<Face> = run.iter().map(|&(_, face)| face).collect();
                self.split(&faces, run[0].0);
            }
        }
        self.leaves.extend_from_slice(&[0; leaf::READ_PAST_BYTES]);
    }

    /// A face of a grid whose indices start at `at`; none if it is degenerate, counted.
    fn face(&mut self, grid: &Quantised, face: usize, at: usize) -> Option<Face> {
        let arity = usize::from(grid.arities[face]);
        let indices = &grid.indices[at..at + arity];
        let extinction = grid.extinctions.get(face).copied().unwrap_or(OPAQUE);
        if extinction == 0 {
            self.skipped.transparent += 1;
            return None;
        }
        let mut vertices = [IVec3::ZERO; 4];
        let mut count = 0;
        for &index in indices {
            let vertex = grid.vertices[usize::from(index)];
            if arity <= 2 || count == 0 || vertices[count - 1] != vertex {
                vertices[count] = vertex;
                count += 1;
            }
        }
        if arity > 2 {
            if count > 1 && vertices[count - 1] == vertices[0] {
                count -= 1;
            }
            let has_area = |a: usize, b: usize, c: usize| {
                let (u, v) = ((vertices[b] - vertices[a]).as_dvec3(), (vertices[c] - vertices[a]).as_dvec3());
                u.cross(v) != glam::DVec3::ZERO
            };
            if count < 3 || !(has_area(0, 1, 2) || count == 4 && has_area(0, 2, 3)) {
                self.skipped.degenerate += 1;
                return None;
            }
        }
        let mut radii = [0.0; 2];
        if arity <= 2 {
            let radius = |corner: usize| grid.radii.get(usize::from(indices[corner])).copied().unwrap_or(0.0);
            radii = [radius(0), radius(arity - 1)];
            if radii.iter().all(|&radius| radius <= 0.0) {
                self.skipped.no_radius += 1;
                return None;
            }
        }
        let last = vertices[count - 1];
        vertices[count..].fill(last);
        Some(Face { vertices, arity: count as u8, extinction, radii })
    }

    /// Cuts a regular grid into tiles of up to eight quads.
    fn add_regular(&mut self, grid: &Quantised) {
        let columns = usize::from(grid.columns);
        let rows = grid.arities.len() / columns;
        let (tile_columns, tile_rows) = tile_shape(grid, columns, rows);
        for row in (0..rows).step_by(tile_rows) {
            for column in (0..columns).step_by(tile_columns) {
                let (across, down) = ((columns - column).min(tile_columns), (rows - row).min(tile_rows));
                let (mut faces, mut count) = ([None; FACES_MAX], 0);
                for r in row..row + down {
                    for c in column..column + across {
                        let face = r * columns + c;
                        faces[count] = self.face(grid, face, 4 * face);
                        count += usize::from(faces[count].is_some());
                    }
                }
                let Some(first) = faces[0] else { continue };
                let faces = faces.map(|face| face.unwrap_or(first));
                let faces = &faces[..count];
                if count == across * down && faces.iter().all(|face| face.arity == 4) {
                    self.push_tile(grid, faces, [column, row, across, down]);
                } else {
                    self.push(faces, grid.shift);
                }
            }
        }
    }

    /// Encodes a whole tile of a regular grid: its first column and row, quads across and down.
    fn push_tile(&mut self, grid: &Quantised, faces: &[Face], [column, row, across, down]: [usize; 4]) {
        let wide = usize::from(grid.columns) + 1;
        let (mut vertices, mut count) = ([IVec3::ZERO; leaf::VERTICES_MAX], 0);
        for r in row..=row + down {
            let start = r * wide + column;
            vertices[count..count + across + 1].copy_from_slice(&grid.vertices[start..start + across + 1]);
            count += across + 1;
        }
        let (mut extinctions, offset) = ([0; FACES_MAX], self.leaves.len());
        faces.iter().zip(&mut extinctions).for_each(|(face, extinction)| *extinction = face.extinction);
        let (extinctions, bounds) = (&extinctions[..faces.len()], bounds(faces));
        leaf::encode_tile(&vertices[..count], across, extinctions, grid.shift, bounds.min, &mut self.leaves);
        self.record(faces, bounds, offset);
    }

    /// Cuts faces into leaves by balanced splits at multiples of eight along the longest axis.
    fn split(&mut self, faces: &[Face], shift: u8) {
        if faces.is_empty() {
            return;
        }
        let mut centers = std::mem::take(&mut self.centers);
        let mut order = std::mem::take(&mut self.order);
        centers.clear();
        centers.extend(faces.iter().map(|face| {
            let bounds = face.bounds();
            bounds.min.as_vec3() + bounds.max.as_vec3()
        }));
        order.clear();
        order.extend(0..faces.len() as u32);
        let mut stack = vec![0..faces.len()];
        while let Some(range) = stack.pop() {
            let part = &mut order[range.clone()];
            if part.len() <= FACES_MAX {
                part.sort_unstable();
                let mut leaf = [faces[part[0] as usize]; FACES_MAX];
                part.iter().enumerate().for_each(|(i, &face)| leaf[i] = faces[face as usize]);
                self.push(&leaf[..part.len()], shift);
                continue;
            }
            let corner = centers[part[0] as usize];
            let (low, high) = part
                .iter()
                .map(|&face| centers[face as usize])
                .fold((corner, corner), |(low, high), c| (low.min(c), high.max(c)));
            let size = high - low;
            let axis = if size.x >= size.y.max(size.z) {
                0
            } else if size.y >= size.z {
                1
            } else {
                2
            };
            let middle = (part.len() / 2).next_multiple_of(FACES_MAX);
            let key = |face: u32| (centers[face as usize][axis], face);
            part.select_nth_unstable_by(middle, |&a, &b| {
                key(a).partial_cmp(&key(b)).expect("lattice coordinates are numbers")
            });
            stack.push(range.start + middle..range.end);
            stack.push(range.start..range.start + middle);
        }
        (self.centers, self.order) = (centers, order);
    }

    /// Encodes a leaf.
    fn push(&mut self, faces: &[Face], shift: u8) {
        let offset = self.leaves.len();
        let bounds = bounds(faces);
        leaf::encode(faces, shift, bounds.min, &mut self.leaves);
        self.record(faces, bounds, offset);
    }

    /// Notes the leaf that was encoded from `offset` on.
    fn record(&mut self, faces: &[Face], bounds: LatticeBox, offset: usize) {
        let (mut area, mut opaque_area) = (0.0, 0.0);
        for face in faces {
            let face_area = super::farfield::area(face);
            area += face_area;
            opaque_area += face_area * super::farfield::opacity(face.extinction);
        }
        self.clusters.push(Primitive {
            bounds,
            area,
            opaque_area,
            micropolygons: faces.len() as u64,
            content: Content::Leaf { offset: offset as u32, bytes: (self.leaves.len() - offset) as u32 },
        });
    }
}

/// The box of a leaf's faces; until the leaf is packed, it is encoded relative to this box's lower corner.
fn bounds(faces: &[Face]) -> LatticeBox {
    faces.iter().fold(LatticeBox::EMPTY, |bounds, face| bounds.union(face.bounds()))
}

/// Quads across and down of a tile of eight, or fewer, that is nearly square and fills the grid well.
fn tile_shape(grid: &Quantised, columns: usize, rows: usize) -> (usize, usize) {
    let wide = columns + 1;
    let middle = (rows / 2) * wide + columns / 2;
    let at = |index: usize| grid.vertices[index].as_vec3();
    let last = grid.vertices.len() - 1;
    let across = at(middle).distance(at((middle + 1).min(last))).max(1.0);
    let down = at(middle).distance(at((middle + wide).min(last))).max(1.0);
    let cost = |&(c, r): &(usize, usize)| {
        let (width, height) = (across * c.min(columns) as f32, down * r.min(rows) as f32);
        let tiles = columns.div_ceil(c) * rows.div_ceil(r);
        // Perimeter of a tile for how square it is, times how many are needed
        (width + height) / (width * height).sqrt() * tiles as f32
    };
    let shapes = [(4, 2), (2, 4), (8, 1), (1, 8)];
    shapes.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b))).expect("there are four")
}
