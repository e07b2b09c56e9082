//! From the microgrids of a partition to full leaves: what the tree is built over.
//!
//! A micropolygon is never a primitive of its own. Pieces of a grid whose faces lie in rows ([`block`](super::block)) are cut into tiles
//! of up to eight quads, as square as their cells allow. All other faces are gathered into full leaves ([`cluster`]):
//! those of a grid among themselves where they are many and close together, the rest of the partition together.

use glam::{IVec3, Vec3};

use super::block::{Block, blocks};
use super::cluster::{Item, cluster};
use super::farfield;
use super::leaves::Leaves;
use super::pack::{Content, Primitive};
use super::spill::Quantised;
use super::tiling::Tilings;
use crate::brick::LatticeBox;
use crate::brick::leaf::{self, Contents, FACES_MAX, Face, Gathered, Kind, OPAQUE};

/// Blocks of fewer quads than this are gathered with others.
const BLOCK_FACES_MIN: usize = 6;

/// Loose faces of a grid that make leaves of their own.
const LOOSE_FACES_MIN: usize = 4 * FACES_MAX;

/// How many times larger than its faces' boxes together the box of a grid may be for them to count as close together.
const SPARSE_MAX: f32 = 8.0;

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
    /// What the leaves hold, in the same order.
    pub leaves: Leaves,
    /// What was left out.
    pub skipped: Skipped,
    /// Faces that are in no tile: flat ones and round ones, of the grid at hand.
    loose: [Loose; 2],
    /// The same, of grids that have few or scattered ones.
    pools: [Loose; 2],
    blocks: Vec<Block>,
    tilings: Tilings,
}

/// Faces in items that stay together.
#[derive(Debug, Default)]
struct Loose {
    faces: Vec<Face>,
    /// Lattice shift of each face's geometry.
    shifts: Vec<u8>,
    items: Vec<Item>,
}

impl Loose {
    fn clear(&mut self) {
        self.faces.clear();
        self.shifts.clear();
        self.items.clear();
    }

    /// Makes one item of the faces from `first` on, or one of each.
    fn add_items(&mut self, first: usize, together: bool, shift: u8) {
        let step = if together { self.faces.len() - first } else { 1 };
        for (number, faces) in self.faces[first..].chunks(step.max(1)).enumerate() {
            self.items.push(Item::new((first + number * step) as u32, faces));
        }
        self.shifts.resize(self.faces.len(), shift);
    }

    /// Moves everything to `pool`.
    fn move_to(&mut self, pool: &mut Self) {
        let base = pool.faces.len() as u32;
        pool.items.extend(self.items.iter().map(|item| Item { first: item.first + base, ..*item }));
        pool.faces.append(&mut self.faces);
        pool.shifts.append(&mut self.shifts);
        self.items.clear();
    }

    /// Whether the faces are few, or far from each other for their size.
    fn is_scattered(&self) -> bool {
        if self.faces.len() < LOOSE_FACES_MIN {
            return true;
        }
        let bounds = self.items.iter().fold(LatticeBox::EMPTY, |all, item| all.union(item.bounds));
        let sum: f32 = self.items.iter().map(|item| half_area(&item.bounds)).sum();
        half_area(&bounds) > SPARSE_MAX * sum
    }
}

fn half_area(bounds: &LatticeBox) -> f32 {
    let size = (bounds.max - bounds.min).as_vec3();
    size.x * size.y + size.y * size.z + size.z * size.x
}

impl Chunk {
    /// Adds a grid.
    pub fn add(&mut self, grid: &Quantised) {
        let mut found = std::mem::take(&mut self.blocks);
        blocks(grid, &mut found);
        for block in &found {
            if block.faces() >= BLOCK_FACES_MIN {
                self.add_tiles(grid, block);
            } else {
                self.add_loose(grid, block);
            }
        }
        self.blocks = found;
        for kind in 0..2 {
            let mut loose = std::mem::take(&mut self.loose[kind]);
            if loose.is_scattered() {
                loose.move_to(&mut self.pools[kind]);
            } else {
                self.gather(&loose);
                loose.clear();
            }
            self.loose[kind] = loose;
        }
    }

    /// Makes leaves of the pooled faces. Call it once, at the end.
    pub fn finish(&mut self) {
        for pool in std::mem::take(&mut self.pools) {
            self.gather(&pool);
        }
    }

    /// Makes leaves of loose faces.
    fn gather(&mut self, loose: &Loose) {
        let mut faces = Vec::with_capacity(leaf::TRIANGLES_MAX);
        cluster(&loose.items, &loose.faces, |members| {
            faces.clear();
            faces.extend(members.iter().map(|&member| loose.faces[member as usize]));
            let shift = members.iter().map(|&member| loose.shifts[member as usize]).min();
            self.push(&faces, shift.expect("a leaf has a face"));
        });
    }

    /// Adds the faces of a block to those that are gathered: together if they are all quads, else one by one.
    fn add_loose(&mut self, grid: &Quantised, block: &Block) {
        let mut together = block.faces() > 1;
        let firsts = self.loose.each_ref().map(|loose| loose.faces.len());
        let mut at = block.corner;
        for number in block.face..block.face + block.faces() {
            if let Some(face) = self.face(grid, number, at) {
                together &= face.arity == 4;
                self.loose[usize::from(face.is_round())].faces.push(face);
            }
            at += usize::from(grid.arities[number]);
        }
        for (loose, first) in self.loose.iter_mut().zip(firsts) {
            loose.add_items(first, together, grid.shift);
        }
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
            if count < 3 || !(has_area(&vertices, 1) || count == 4 && has_area(&vertices, 2)) {
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

    /// Cuts a block into tiles of up to eight quads.
    fn add_tiles(&mut self, grid: &Quantised, block: &Block) {
        let mut tilings = std::mem::take(&mut self.tilings);
        for tile in tilings.tiles(block.columns, block.rows, block.cell(&grid.vertices)) {
            let tile = block.part(tile.columns(), tile.rows());
            if !self.push_tile(grid, &tile) {
                self.push_remains(grid, &tile);
            }
        }
        self.tilings = tilings;
    }

    /// Makes a leaf of a tile unless some of its faces are missing or no quads.
    fn push_tile(&mut self, grid: &Quantised, tile: &Block) -> bool {
        // Copy its rows of vertices
        let wide = tile.columns + 1;
        let (mut vertices, mut count) = ([IVec3::ZERO; leaf::VERTICES_MAX], 0);
        for row in 0..=tile.rows {
            let start = tile.vertex + row * tile.stride;
            vertices[count..count + wide].copy_from_slice(&grid.vertices[start..start + wide]);
            count += wide;
        }
        let vertices = &vertices[..count];
        let mut bounds = LatticeBox::EMPTY;
        vertices.iter().for_each(|&vertex| bounds.add(vertex));

        // Sum up areas; where rounding could hide that there is none, the faces are looked at one by one
        let size = (bounds.max - bounds.min).as_vec3();
        let least = 1e-6 * size.length_squared();
        let (mut extinctions, mut faces) = ([OPAQUE; FACES_MAX], 0);
        let (mut area, mut opaque_area) = (0.0, 0.0);
        for row in 0..tile.rows {
            for column in 0..tile.columns {
                let a = row * wide + column;
                let edge = |to: usize| (vertices[to] - vertices[a]).as_vec3();
                let (b, c, d) = (edge(a + 1), edge(a + wide + 1), edge(a + wide));
                let (lower, upper) = (triangle(b, c), triangle(c, d));
                if lower <= least || upper <= least {
                    return false;
                }
                let face_area = lower + upper;
                area += face_area;
                if grid.extinctions.is_empty() {
                    opaque_area += face_area;
                } else {
                    extinctions[faces] = grid.extinctions[tile.face_at(column, row)];
                    if extinctions[faces] == 0 {
                        return false;
                    }
                    opaque_area += face_area * farfield::opacity(extinctions[faces]);
                }
                faces += 1;
            }
        }
        let is_opaque = extinctions[..faces].iter().all(|&extinction| extinction == OPAQUE);
        let tile = Contents {
            kind: Kind::Tile,
            faces,
            stride: wide,
            shift: grid.shift,
            vertices,
            indices: &[],
            extinctions: if is_opaque { &[] } else { &extinctions[..faces] },
            radii: &[],
        };
        self.record(bounds, [area, opaque_area], &tile);
        true
    }

    /// Makes a leaf of those faces of a tile that are there.
    fn push_remains(&mut self, grid: &Quantised, tile: &Block) {
        let (mut faces, mut count) = ([None; FACES_MAX], 0);
        for row in 0..tile.rows {
            for column in 0..tile.columns {
                let face = tile.face_at(column, row);
                faces[count] = self.face(grid, face, tile.corner_of(face));
                count += usize::from(faces[count].is_some());
            }
        }
        if let Some(first) = faces[0] {
            self.push(&faces.map(|face| face.unwrap_or(first))[..count], grid.shift);
        }
    }

    /// Makes a leaf.
    fn push(&mut self, faces: &[Face], shift: u8) {
        let (mut bounds, mut area, mut opaque_area) = (LatticeBox::EMPTY, 0.0, 0.0);
        for face in faces {
            bounds = bounds.union(face.bounds());
            let face_area = farfield::area(face);
            area += face_area;
            opaque_area += face_area * farfield::opacity(face.extinction);
        }
        self.record(bounds, [area, opaque_area], &Gathered::of(faces, shift).contents());
    }

    /// Notes a leaf.
    fn record(&mut self, bounds: LatticeBox, [area, opaque_area]: [f32; 2], leaf: &Contents<'_>) {
        self.leaves.push(leaf);
        let (micropolygons, content) = (leaf.faces as u64, Content::Leaf);
        self.clusters.push(Primitive { bounds, area, opaque_area, micropolygons, content });
    }
}

/// Whether the triangle of the first, the `second` and the next vertex has an area. Exact: differences have 31 bits, so that
/// products and their rounded differences are zero only where the true ones are.
fn has_area(vertices: &[IVec3; 4], second: usize) -> bool {
    let edge = |to: usize| (vertices[to] - vertices[0]).as_i64vec3();
    let (u, v) = (edge(second), edge(second + 1));
    u.x * v.y != u.y * v.x || u.y * v.z != u.z * v.y || u.z * v.x != u.x * v.z
}

fn triangle(u: Vec3, v: Vec3) -> f32 {
    0.5 * u.cross(v).length()
}
