//! From the microgrids of a partition to full leaves: what the tree is built over.
//!
//! A micropolygon is never a primitive of its own. Regular patches are cut into tiles of up to eight quads; other faces are
//! cut by balanced splits at multiples of eight, grid by grid, and the faces of tiny grids are pooled first, so that soups
//! fill their leaves too.

use glam::{I64Vec3, IVec3};

use super::bucket::longest_axis;
use super::farfield;
use super::pack::{Content, Primitive};
use super::patch::{self, Patch, Tile};
use super::spill::Quantised;
use crate::brick::LatticeBox;
use crate::brick::leaf::{self, FACES_MAX, Face, OPAQUE};

/// A grid with fewer loose faces than this gives them to the partition's pool.
const LOOSE_FACES_MIN: usize = 4 * FACES_MAX;

/// A face whose box is `2^this` times as long as the median of its pool does not share a leaf with smaller ones.
const LARGE_LOG2: u32 = 4;

/// What was left out of a partition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Skipped {
    /// Faces of no area.
    pub degenerate: u64,
    /// Points and lines without a radius.
    pub no_radius: u64,
    /// Fully transparent faces.
    pub transparent: u64,
}

impl std::ops::AddAssign for Skipped {
    fn add_assign(&mut self, other: Self) {
        self.degenerate += other.degenerate;
        self.no_radius += other.no_radius;
        self.transparent += other.transparent;
    }
}

/// A face on its way into a leaf.
#[derive(Clone, Copy, Debug)]
struct Loose {
    face: Face,
    /// Twice the middle of what it should stay together with.
    center: IVec3,
    shift: u8,
}

/// The leaves of a partition. Its memory serves the next partition after [`clear`](Self::clear).
#[derive(Debug, Default)]
pub struct Chunk {
    /// One primitive a leaf.
    pub clusters: Vec<Primitive>,
    /// Their encoded leaves.
    pub leaves: Vec<u8>,
    /// What was left out.
    pub skipped: Skipped,
    /// Faces of tiny grids and tiles.
    pool: Vec<Loose>,
    loose: Vec<Loose>,
    patches: Vec<Patch>,
    order: Vec<(IVec3, u32)>,
}

impl Chunk {
    /// Empties it, keeping memory.
    pub fn clear(&mut self) {
        self.clusters.clear();
        self.leaves.clear();
        self.pool.clear();
        self.skipped = Skipped::default();
    }

    /// Adds a grid.
    pub fn add(&mut self, grid: &Quantised) {
        let mut loose = std::mem::take(&mut self.loose);
        let mut patches = std::mem::take(&mut self.patches);
        loose.clear();
        if grid.arities.iter().all(|&arity| arity == 4) {
            patch::find(grid, &mut patches, |face| loose.extend(self.face(grid, face, 4 * face)));
            for patch in &patches {
                let [across, down] = quad_sides(grid, patch);
                patch.tiles(across, down, &mut |tile| self.add_tile(grid, patch, tile, &mut loose));
            }
        } else {
            let mut at = 0;
            for face in 0..grid.arities.len() {
                loose.extend(self.face(grid, face, at));
                at += usize::from(grid.arities[face]);
            }
        }
        if loose.len() < LOOSE_FACES_MIN {
            self.pool.extend_from_slice(&loose);
        } else {
            self.split(&mut loose);
        }
        (self.loose, self.patches) = (loose, patches);
    }

    /// Makes leaves of the pooled faces. Call it once, at the end.
    pub fn finish(&mut self) {
        let mut pool = std::mem::take(&mut self.pool);
        self.split(&mut pool);
        pool.clear();
        self.pool = pool;
    }

    /// A tile becomes a leaf if it is full and sound; otherwise its faces are loose, but stay together if they can.
    fn add_tile(&mut self, grid: &Quantised, patch: &Patch, tile: Tile, loose: &mut Vec<Loose>) {
        if tile.is_full() && self.push_tile(grid, patch, tile) {
            return;
        }
        let first = loose.len();
        for row in tile.at[1]..tile.at[1] + tile.size[1] {
            for column in tile.at[0]..tile.at[0] + tile.size[0] {
                let face = patch.first_face + row * patch.columns + column;
                loose.extend(self.face(grid, face, 4 * face));
            }
        }
        let part = &mut loose[first..];
        let bounds = part.iter().fold(LatticeBox::EMPTY, |all, loose| all.union(loose.face.bounds()));
        part.iter_mut().for_each(|loose| loose.center = bounds.min + bounds.max);
    }

    /// Encodes a tile; false if a face is degenerate or transparent. Its quads go across before they go down: a patch that
    /// does otherwise has its quads turned over, which changes neither their diagonal nor what they hide.
    fn push_tile(&mut self, grid: &Quantised, patch: &Patch, tile: Tile) -> bool {
        let [wide, high] = tile.size.map(|quads| quads + 1);
        let mut vertices = [IVec3::ZERO; leaf::VERTICES_MAX];
        let mut bounds = LatticeBox::EMPTY;
        for row in 0..high {
            let from = patch.first_vertex + (tile.at[1] + row) * patch.wide() + tile.at[0];
            for (to, &vertex) in
                vertices[row * wide..(row + 1) * wide].iter_mut().zip(&grid.vertices[from..from + wide])
            {
                *to = vertex;
                bounds.add(vertex);
            }
        }
        let mut extinctions = [OPAQUE; FACES_MAX];
        let (mut area, mut opaque_area) = (0.0, 0.0);
        for (quad, stored) in extinctions[..tile.quads()].iter_mut().enumerate() {
            let (row, column) = (quad / tile.size[0], quad % tile.size[0]);
            let a = row * wide + column;
            let corners = [a, a + 1, a + wide + 1, a + wide].map(|corner| vertices[corner]);
            let Some(quad_area) = sound_quad_area(corners) else { return false };
            let face = patch.first_face + (tile.at[1] + row) * patch.columns + tile.at[0] + column;
            let extinction = grid.extinctions.get(face).copied().unwrap_or(OPAQUE);
            if extinction == 0 {
                return false;
            }
            area += quad_area;
            opaque_area += quad_area * farfield::opacity(extinction);
            *stored = extinction;
        }
        let (quads, offset) = (tile.quads(), self.leaves.len());
        leaf::encode_tile(
            &vertices[..wide * high],
            tile.size[0],
            &extinctions[..quads],
            grid.shift,
            &mut self.leaves,
        );
        self.push_primitive(bounds, area, opaque_area, quads, offset);
        true
    }

    /// A face of a grid whose indices start at `at`; none if it is degenerate, counted.
    fn face(&mut self, grid: &Quantised, face: usize, at: usize) -> Option<Loose> {
        let arity = usize::from(grid.arities[face]);
        let indices = &grid.indices[at..at + arity];
        let extinction = grid.extinctions.get(face).copied().unwrap_or(OPAQUE);
        if extinction == 0 {
            self.skipped.transparent += 1;
            return None;
        }
        let vertex = |corner: usize| grid.vertices[usize::from(indices[corner])];
        let radius = |corner: usize| grid.radii.get(usize::from(indices[corner])).copied().unwrap_or(0.0);
        let mut radii = [0.0; 2];
        let (vertices, arity) = match arity {
            1 | 2 => {
                let (a, b) = (vertex(0), vertex(arity - 1));
                radii = [radius(0), radius(arity - 1)];
                if radii == [0.0; 2] {
                    self.skipped.no_radius += 1;
                    return None;
                }
                if arity == 2 && a == b {
                    // A line of no length is the larger sphere
                    radii = [radii[0].max(radii[1]); 2];
                }
                ([a, b, b, b], if a == b { 1 } else { 2 })
            }
            3 => sound_triangle(vertex(0), vertex(1), vertex(2)).unwrap_or_default(),
            _ => sound_quad([0, 1, 2, 3].map(vertex)).unwrap_or_default(),
        };
        if arity == 0 {
            self.skipped.degenerate += 1;
            return None;
        }
        let face = Face { vertices, arity, extinction, radii };
        let bounds = face.bounds();
        Some(Loose { face, center: bounds.min + bounds.max, shift: grid.shift })
    }

    /// Makes leaves of loose faces of any kind.
    fn split(&mut self, loose: &mut [Loose]) {
        if loose.is_empty() {
            return;
        }
        // Leaves do not mix round and flat faces, lattice shifts, or large faces with small ones
        let length_log2 = |loose: &Loose| {
            let bounds = loose.face.bounds();
            32 - (bounds.max - bounds.min).max_element().leading_zeros()
        };
        let mut lengths = [0; 33];
        loose.iter().for_each(|loose| lengths[length_log2(loose) as usize] += 1);
        let mut below = 0;
        let median = lengths.iter().position(|&count| {
            below += count;
            below > loose.len() / 2
        });
        let large = median.unwrap_or(32) as u32 + LARGE_LOG2;
        let kind = |loose: &Loose| (loose.shift, loose.face.is_round(), length_log2(loose) >= large);
        let first = kind(&loose[0]);
        if loose.iter().any(|loose| kind(loose) != first) {
            loose.sort_by_key(kind);
        }
        for run in loose.chunk_by(|a, b| kind(a) == kind(b)) {
            self.split_kind(run);
        }
    }

    /// Makes leaves of faces of one kind, by balanced splits at multiples of eight along the longest axis.
    fn split_kind(&mut self, loose: &[Loose]) {
        let mut order = std::mem::take(&mut self.order);
        order.clear();
        order.extend(loose.iter().enumerate().map(|(i, loose)| (loose.center, i as u32)));
        let mut stack = Vec::from([0..order.len()]);
        while let Some(range) = stack.pop() {
            let part = &mut order[range.clone()];
            if part.len() <= FACES_MAX {
                part.sort_unstable_by_key(|&(_, i)| i);
                let mut faces = [loose[part[0].1 as usize].face; FACES_MAX];
                part.iter().zip(&mut faces).for_each(|(&(_, i), face)| *face = loose[i as usize].face);
                self.push(&faces[..part.len()], loose[0].shift);
                continue;
            }
            let (low, high) =
                part.iter().fold((IVec3::MAX, IVec3::MIN), |(low, high), &(c, _)| (low.min(c), high.max(c)));
            let axis = longest_axis((high - low).to_array());
            let middle = (part.len() / 2).next_multiple_of(FACES_MAX);
            part.select_nth_unstable_by_key(middle, |&(center, i)| (center[axis], i));
            stack.push(range.start + middle..range.end);
            stack.push(range.start..range.start + middle);
        }
        self.order = order;
    }

    /// Encodes a leaf.
    fn push(&mut self, faces: &[Face], shift: u8) {
        let offset = self.leaves.len();
        leaf::encode(faces, shift, &mut self.leaves);
        let (mut bounds, mut area, mut opaque_area) = (LatticeBox::EMPTY, 0.0, 0.0);
        for face in faces {
            bounds = bounds.union(face.bounds());
            let face_area = farfield::area(face);
            area += face_area;
            opaque_area += face_area * farfield::opacity(face.extinction);
        }
        self.push_primitive(bounds, area, opaque_area, faces.len(), offset);
    }

    fn push_primitive(
        &mut self,
        bounds: LatticeBox,
        area: f32,
        opaque_area: f32,
        faces: usize,
        offset: usize,
    ) {
        self.clusters.push(Primitive {
            bounds,
            area,
            opaque_area,
            micropolygons: faces as u64,
            content: Content::Leaf { offset: offset as u32, bytes: (self.leaves.len() - offset) as u32 },
        });
    }
}

/// Twice the area vector of a triangle, exactly: coordinates have 30 bits.
fn double_area(a: IVec3, b: IVec3, c: IVec3) -> I64Vec3 {
    let (u, v) = ((b - a).as_i64vec3(), (c - a).as_i64vec3());
    u.cross(v)
}

/// The vertices and arity of a triangle, unless it has no area.
fn sound_triangle(a: IVec3, b: IVec3, c: IVec3) -> Option<([IVec3; 4], u8)> {
    (double_area(a, b, c) != I64Vec3::ZERO).then_some(([a, b, c, c], 3))
}

/// The vertices and arity of a quad, unless neither of its triangles has an area. A quad of three distinct corners is a
/// triangle.
fn sound_quad([a, b, c, d]: [IVec3; 4]) -> Option<([IVec3; 4], u8)> {
    match [double_area(a, b, c), double_area(a, c, d)].map(|area| area != I64Vec3::ZERO) {
        [false, false] => None,
        [true, _] if d == a || d == b || d == c => Some(([a, b, c, c], 3)),
        [_, true] if b == a || b == c => Some(([a, c, d, d], 3)),
        _ => Some(([a, b, c, d], 4)),
    }
}

/// The area of a quad both of whose triangles have one.
fn sound_quad_area([a, b, c, d]: [IVec3; 4]) -> Option<f32> {
    let (first, second) = (double_area(a, b, c), double_area(a, c, d));
    if first == I64Vec3::ZERO || second == I64Vec3::ZERO || b == d {
        return None;
    }
    Some((0.5 * (first.as_dvec3().length() + second.as_dvec3().length())) as f32)
}

/// Lengths of a patch's quad across and down, from its middle.
fn quad_sides(grid: &Quantised, patch: &Patch) -> [f32; 2] {
    let at =
        |row: usize, column: usize| grid.vertices[patch.first_vertex + row * patch.wide() + column].as_vec3();
    let (row, column) = (patch.rows / 2, patch.columns / 2);
    let across = at(row, 0).distance(at(row, column)) + at(row, column).distance(at(row, patch.columns));
    let down = at(0, column).distance(at(row, column)) + at(row, column).distance(at(patch.rows, column));
    [across / patch.columns as f32, down / patch.rows as f32].map(|length| length.max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: IVec3 = IVec3::ZERO;
    const B: IVec3 = IVec3::new(4, 0, 0);
    const C: IVec3 = IVec3::new(4, 4, 0);
    const D: IVec3 = IVec3::new(0, 4, 0);

    /// Catches a degenerate face that is kept, or a triangle in a quad's clothes that is lost.
    #[test]
    fn quads_are_reduced_to_what_they_are() {
        assert_eq!(sound_quad([A, B, C, D]), Some(([A, B, C, D], 4)));
        assert_eq!(sound_quad([A, A, C, D]), Some(([A, C, D, D], 3)));
        assert_eq!(sound_quad([A, B, B, D]), Some(([A, B, D, D], 3)));
        assert_eq!(sound_quad([A, B, C, C]), Some(([A, B, C, C], 3)));
        assert_eq!(sound_quad([A, B, C, A]), Some(([A, B, C, C], 3)));
        assert_eq!(sound_quad([A, B, C, B]), Some(([A, B, C, C], 3)));
        assert_eq!(sound_quad([A, B, A, D]), None);
        assert_eq!(sound_quad([A, B, B * 2, B * 3]), None);
        assert_eq!(sound_quad([A, B, B * 2, D]), Some(([A, B, B * 2, D], 4)));
        let far = IVec3::splat((1 << 29) - 1);
        assert!(sound_triangle(-far, far, far - IVec3::X).is_some(), "a sliver has an area");
    }
}
