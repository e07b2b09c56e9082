//! The leaf: up to eight micropolygons as bit-packed lattice vertices.
//!
//! ```text
//! byte 0  faces        u8       1 to 8
//!      1  vertices     u8       1 to 32
//!      2  bits         3 x u8   bits of a vertex coordinate, per axis, 0 to 30
//!      5  shift        u8       coordinates are origin + (packed << shift)
//!      6  flags        u8       1: indices of 5 bits, not 4; 2: extinctions follow; 4: round faces; 8: tile
//!      7  short        u8       bit i: face i is a triangle (flat leaves) or a point (round leaves);
//!                               in a tile, quads across
//!      8  origin       3 x i32  lattice coordinates of the vertices' lower corner
//!     20  indices      first corners of 8 faces, then second ones, up to fourth (second in round leaves), each
//!                      corner's 8 indices in 4 or 5 bytes; none in a tile
//!         coordinates  per axis ceil(vertices * bits / 8) bytes, least significant bit first
//!         extinctions  u16 per face, if flagged
//!         radii        f32 per vertex in lattice steps, round leaves only
//! ```
//!
//! Flat leaves hold triangles and quads, round leaves points (spheres) and lines (round cones). A triangle repeats
//! its last index, a point its only one. A tile is a piece of a regular grid, faces and vertices in rows.

use glam::IVec3;

use super::node::LatticeBox;

/// Faces of a leaf at most.
pub const FACES_MAX: usize = 8;
/// Vertices of a leaf at most.
pub const VERTICES_MAX: usize = 32;
/// Bits of a packed coordinate at most: lattice coordinates stay within ±2^29.
pub const BITS_MAX: u8 = 30;
/// Bytes before the indices.
pub const HEADER_BYTES: usize = 20;
/// Readable bytes a decoder may touch past a leaf's end.
pub const READ_PAST_BYTES: usize = 64;

const FLAG_LONG_INDICES: u8 = 1;
const FLAG_EXTINCTIONS: u8 = 2;
const FLAG_ROUND: u8 = 4;
const FLAG_TILE: u8 = 8;

/// Extinction of a fully opaque face.
pub const OPAQUE: u16 = u16::MAX;

/// Units of extinction per halving of transmittance.
///
/// Transmittances multiply; extinctions, their logarithms, add. As integers they add exactly in any order, so a
/// ray's result does not depend on the order in which it meets things.
pub const EXTINCTION_PER_OCTAVE: f32 = 4096.0;

/// The extinction of an opacity from 0 to 1: `-4096 log2(1 - opacity)`; [`OPAQUE`] from 0.99998 up.
pub fn extinction_from_opacity(opacity: f32) -> u16 {
    let transmittance = f64::from(1.0 - opacity.clamp(0.0, 1.0));
    let extinction = -f64::from(EXTINCTION_PER_OCTAVE) * transmittance.log2();
    if extinction < 65_000.0 { extinction.round() as u16 } else { OPAQUE }
}

/// One face of a leaf as the builder gives it and the plain decoder returns it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Vertices, 1 to 4; unused ones repeat the last.
    pub vertices: [IVec3; 4],
    /// 1 point, 2 line, 3 triangle, 4 quad.
    pub arity: u8,
    /// Extinction, [`OPAQUE`] for a solid face.
    pub extinction: u16,
    /// Radii of the first two vertices in lattice steps; points and lines only.
    pub radii: [f32; 2],
}

impl Face {
    /// Whether it is a point or a line.
    pub fn is_round(&self) -> bool {
        self.arity <= 2
    }

    /// Its box, radius included.
    pub fn bounds(&self) -> LatticeBox {
        let mut bounds = LatticeBox::EMPTY;
        for (i, &vertex) in self.vertices[..usize::from(self.arity)].iter().enumerate() {
            let radius = if self.is_round() { self.radii[i].ceil() as i32 } else { 0 };
            bounds.add(vertex - radius);
            bounds.add(vertex + radius);
        }
        bounds
    }
}

/// The leaf's fixed part and where its columns lie.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Faces.
    pub faces: usize,
    /// Vertices.
    pub vertices: usize,
    /// Bits of a coordinate per axis.
    pub bits: [u8; 3],
    /// Left shift of packed coordinates.
    pub shift: u8,
    /// Bits of an index, which are the bytes of a corner's 8 indices: 4 or 5.
    pub index_bits: usize,
    /// Whether every face is opaque.
    pub opaque: bool,
    /// Whether faces are points and lines.
    pub round: bool,
    /// Quads across a tile; 0 if it is none.
    pub columns: usize,
    /// Bit i: face i is a triangle, or a point.
    pub short: u8,
    /// Lower corner of the vertices.
    pub origin: IVec3,
    /// Byte offsets of the coordinates, per axis.
    pub coordinates: [usize; 3],
    /// Byte offset of the extinctions.
    pub extinctions: usize,
    /// Byte offset of the radii.
    pub radii: usize,
    /// Bytes of the leaf, padded to 8.
    pub bytes: usize,
}

impl Layout {
    /// Reads the fixed part; none if it promises what cannot be. `leaf` starts at the leaf and may run on.
    #[inline(always)]
    pub fn read(leaf: &[u8]) -> Option<Self> {
        if leaf.len() < HEADER_BYTES {
            return None;
        }
        let layout = Self::read_trusted(leaf);
        let sane = (1..=FACES_MAX).contains(&layout.faces)
            && (1..=VERTICES_MAX).contains(&layout.vertices)
            && layout.bits.iter().all(|&bits| bits <= BITS_MAX)
            && u32::from(layout.shift) <= 29
            && (leaf[6] <= 7 || leaf[6] & !FLAG_EXTINCTIONS == FLAG_TILE && layout.is_whole_tile())
            && layout.bytes <= leaf.len();
        sane.then_some(layout)
    }

    /// [`read`](Self::read) for a leaf that was checked when its brick was loaded.
    #[inline(always)]
    pub fn read_trusted(leaf: &[u8]) -> Self {
        let word = |at: usize| i32::from_le_bytes(leaf[at..at + 4].try_into().expect("4 bytes"));
        let (faces, vertices, flags) = (usize::from(leaf[0]), usize::from(leaf[1]), leaf[6]);
        let bits = [leaf[2], leaf[3], leaf[4]];
        let (index_bits, round) = (4 + usize::from(flags & FLAG_LONG_INDICES != 0), flags & FLAG_ROUND != 0);
        let is_tile = flags & FLAG_TILE != 0;
        let corners = if is_tile {
            0
        } else if round {
            2
        } else {
            4
        };
        let mut at = HEADER_BYTES + corners * index_bits;
        let coordinates = bits.map(|bits| {
            let here = at;
            at += (vertices * usize::from(bits)).div_ceil(8);
            here
        });
        let extinctions = at;
        let opaque = flags & FLAG_EXTINCTIONS == 0;
        at += if opaque { 0 } else { 2 * faces };
        let radii = at;
        at += if round { 4 * vertices } else { 0 };
        Self {
            faces,
            vertices,
            bits,
            shift: leaf[5],
            index_bits,
            opaque,
            round,
            columns: if is_tile { usize::from(leaf[7]) } else { 0 },
            short: if is_tile { 0 } else { leaf[7] },
            origin: IVec3::new(word(8), word(12), word(16)),
            coordinates,
            extinctions,
            radii,
            bytes: at.next_multiple_of(8),
        }
    }

    /// Whether a tile's faces and vertices are rows of its columns.
    fn is_whole_tile(&self) -> bool {
        (1..=FACES_MAX).contains(&self.columns)
            && self.faces.is_multiple_of(self.columns)
            && self.vertices == (self.columns + 1) * (self.faces / self.columns + 1)
    }

    /// The vertex index of corner `corner` of face `face`.
    #[inline(always)]
    pub fn index(&self, leaf: &[u8], face: usize, corner: usize) -> usize {
        if self.columns > 0 {
            let wide = self.columns + 1;
            return face + face / self.columns + [0, 1, wide + 1, wide][corner];
        }
        let at = HEADER_BYTES + corner * self.index_bits;
        let word = u64::from_le_bytes(leaf[at..at + 8].try_into().expect("8 bytes"));
        (word >> (face * self.index_bits)) as usize & ((1 << self.index_bits) - 1)
    }

    /// The extinction of a face.
    #[inline(always)]
    pub fn extinction(&self, leaf: &[u8], face: usize) -> u16 {
        if self.opaque {
            return OPAQUE;
        }
        let at = self.extinctions + 2 * face;
        u16::from_le_bytes([leaf[at], leaf[at + 1]])
    }

    /// The lattice coordinates of a vertex. `leaf` must run at least 8 bytes past the leaf's end.
    #[inline(always)]
    pub fn vertex(&self, leaf: &[u8], vertex: usize) -> IVec3 {
        let axis = |axis: usize| {
            let bit = vertex * usize::from(self.bits[axis]);
            let at = self.coordinates[axis] + bit / 8;
            let word = u64::from_le_bytes(leaf[at..at + 8].try_into().expect("8 bytes"));
            let packed = (word >> (bit % 8)) as u32 & ((1_u32 << self.bits[axis]) - 1);
            (packed << self.shift) as i32
        };
        IVec3::new(
            self.origin.x.wrapping_add(axis(0)),
            self.origin.y.wrapping_add(axis(1)),
            self.origin.z.wrapping_add(axis(2)),
        )
    }

    /// The radius of a vertex in lattice steps.
    #[inline(always)]
    pub fn radius(&self, leaf: &[u8], vertex: usize) -> f32 {
        let at = self.radii + 4 * vertex;
        f32::from_le_bytes(leaf[at..at + 4].try_into().expect("4 bytes"))
    }

    /// A face, decoded plainly. `leaf` must run at least 8 bytes past the leaf's end.
    pub fn face(&self, leaf: &[u8], face: usize) -> Face {
        let corners = if self.round { 2 } else { 4 };
        let indices: [usize; 4] =
            std::array::from_fn(|corner| self.index(leaf, face, corner.min(corners - 1)));
        let short = self.short >> face & 1 != 0;
        Face {
            vertices: indices.map(|index| self.vertex(leaf, index)),
            arity: corners as u8 - u8::from(short),
            extinction: self.extinction(leaf, face),
            radii: if self.round { [0, 1].map(|i| self.radius(leaf, indices[i])) } else { [0.0; 2] },
        }
    }

    /// Whether indices and radii are such that decoding cannot fail. Checked once, when a brick is loaded.
    pub fn is_sound(&self, leaf: &[u8]) -> bool {
        let corners = if self.round { 2 } else { 4 };
        let indices =
            (0..self.faces).all(|face| (0..corners).all(|c| self.index(leaf, face, c) < self.vertices));
        let radii = !self.round || (0..self.vertices).all(|v| (0.0..1e9).contains(&self.radius(leaf, v)));
        indices && radii
    }
}

/// Appends a leaf of `faces` (1 to 8, all flat or all round) to `out`, padded to 8 bytes. `shift` is that of the
/// faces' geometry: all coordinates are congruent modulo `2^shift` and lie within
/// [`COORDINATE_MAX`](super::lattice::COORDINATE_MAX).
pub fn encode(faces: &[Face], shift: u8, out: &mut Vec<u8>) {
    debug_assert!((1..=FACES_MAX).contains(&faces.len()));
    let round = faces[0].is_round();
    let corners = if round { 2 } else { 4 };

    // Number the distinct vertices
    let mut vertices = [(IVec3::ZERO, 0.0_f32); VERTICES_MAX];
    let mut count = 0;
    let mut indices = [0_u8; 4 * FACES_MAX];
    for (f, face) in faces.iter().enumerate() {
        debug_assert_eq!(face.is_round(), round);
        for corner in 0..corners {
            let used = corner.min(usize::from(face.arity) - 1);
            let radius = if round { face.radii[used] } else { 0.0 };
            let vertex = (face.vertices[used], radius);
            let known = vertices[..count].iter().position(|v| *v == vertex);
            let index = known.unwrap_or_else(|| {
                vertices[count] = vertex;
                count += 1;
                count - 1
            });
            indices[f * corners + corner] = index as u8;
        }
    }

    // Write the fixed part and the indices
    let opaque = faces.iter().all(|face| face.extinction == OPAQUE);
    let long_indices = count > 16;
    let flags = u8::from(long_indices) * FLAG_LONG_INDICES
        | u8::from(!opaque) * FLAG_EXTINCTIONS
        | u8::from(round) * FLAG_ROUND;
    let short_arity = corners as u8 - 1;
    let short = faces.iter().enumerate().fold(0, |mask, (i, f)| mask | u8::from(f.arity == short_arity) << i);
    let start = out.len();
    let positions = vertices.map(|vertex| vertex.0);
    let pack = Packing::of(&positions[..count], shift);
    pack.write_header(faces.len(), flags, short, out);
    let index_bits = 4 + usize::from(long_indices);
    for corner in 0..corners {
        let word = (0..faces.len()).fold(0_u64, |word, face| {
            word | u64::from(indices[face * corners + corner]) << (face * index_bits)
        });
        out.extend_from_slice(&word.to_le_bytes()[..index_bits]);
    }

    // Then the columns
    pack.write_coordinates(out);
    if !opaque {
        faces.iter().for_each(|face| out.extend_from_slice(&face.extinction.to_le_bytes()));
    }
    if round {
        vertices[..count].iter().for_each(|v| out.extend_from_slice(&v.1.to_le_bytes()));
    }
    out.resize(start + (out.len() - start).next_multiple_of(8), 0);
}

/// Appends a tile: `columns` quads across, their vertices in rows, their extinctions likewise. See [`encode`].
pub fn encode_tile(vertices: &[IVec3], columns: usize, extinctions: &[u16], shift: u8, out: &mut Vec<u8>) {
    debug_assert!((1..=FACES_MAX).contains(&extinctions.len()) && vertices.len() <= VERTICES_MAX);
    let opaque = extinctions.iter().all(|&extinction| extinction == OPAQUE);
    let flags = FLAG_TILE | u8::from(!opaque) * FLAG_EXTINCTIONS;
    let start = out.len();
    let pack = Packing::of(vertices, shift);
    pack.write_header(extinctions.len(), flags, columns as u8, out);
    pack.write_coordinates(out);
    if !opaque {
        extinctions.iter().for_each(|extinction| out.extend_from_slice(&extinction.to_le_bytes()));
    }
    out.resize(start + (out.len() - start).next_multiple_of(8), 0);
}

/// Vertices and how many bits their coordinates take.
struct Packing<'a> {
    vertices: &'a [IVec3],
    shift: u8,
    origin: IVec3,
    bits: [u8; 3],
}

impl<'a> Packing<'a> {
    fn of(vertices: &'a [IVec3], shift: u8) -> Self {
        let origin = vertices.iter().fold(IVec3::MAX, |low, &v| low.min(v));
        let high = vertices.iter().fold(IVec3::MIN, |high, &v| high.max(v));
        let bits = ((high - origin) >> i32::from(shift)).to_array().map(|e| (32 - e.leading_zeros()) as u8);
        debug_assert!(bits.iter().all(|&bits| bits <= BITS_MAX));
        Self { vertices, shift, origin, bits }
    }

    fn write_header(&self, faces: usize, flags: u8, short: u8, out: &mut Vec<u8>) {
        let [x, y, z] = self.bits;
        out.extend_from_slice(&[faces as u8, self.vertices.len() as u8, x, y, z, self.shift, flags, short]);
        self.origin.to_array().iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
    }

    fn write_coordinates(&self, out: &mut Vec<u8>) {
        for axis in 0..3 {
            let (mut word, mut filled) = (0_u64, 0);
            for position in self.vertices {
                word |= (((position[axis] - self.origin[axis]) >> self.shift) as u64) << filled;
                filled += u32::from(self.bits[axis]);
                if filled >= 32 {
                    out.extend_from_slice(&(word as u32).to_le_bytes());
                    word >>= 32;
                    filled -= 32;
                }
            }
            out.extend_from_slice(&word.to_le_bytes()[..filled.div_ceil(8) as usize]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::hash::hash32;

    fn random_face(seed: &mut u32, arity: u8, extent: u32, shift: u8) -> Face {
        let mut next = || {
            *seed = hash32(*seed);
            *seed
        };
        let mut vertices: [IVec3; 4] = std::array::from_fn(|_| {
            IVec3::from_array(std::array::from_fn(|_| ((next() % extent) << shift) as i32))
        });
        for i in usize::from(arity)..4 {
            vertices[i] = vertices[usize::from(arity) - 1];
        }
        let extinction = if next() % 2 == 0 { OPAQUE } else { (next() % 60_000) as u16 };
        let radii = if arity > 2 { [0.0; 2] } else { [1.5, if arity == 1 { 1.5 } else { 0.25 }] };
        Face { vertices, arity, extinction, radii }
    }

    /// Catches any bit lost between encoding and the plain decoder: vertices must stay exact.
    #[test]
    fn leaves_round_trip() {
        let mut seed = 7;
        for case in 0..2000_u32 {
            let round = case % 3 == 0;
            let (shift, extent) = ((case % 4) as u8, [1, 3, 300, 1 << 20][case as usize % 4]);
            let count = 1 + case as usize % FACES_MAX;
            let faces: Vec<Face> = (0..count)
                .map(|i| {
                    let arity = (if round { 1 } else { 3 }) + ((i as u32 + case) % 2) as u8;
                    random_face(&mut seed, arity, extent, shift)
                })
                .collect();
            let mut bytes = Vec::new();
            encode(&faces, shift, &mut bytes);
            bytes.resize(bytes.len() + READ_PAST_BYTES, 0);
            let layout = Layout::read(&bytes).unwrap();
            assert!(layout.is_sound(&bytes));
            assert_eq!(layout.bytes + READ_PAST_BYTES, bytes.len());
            let decoded: Vec<Face> = (0..count).map(|i| layout.face(&bytes, i)).collect();
            assert_eq!(decoded, faces, "case {case}");
        }
    }

    /// Catches a tile that decodes to other faces than the same faces with indices.
    #[test]
    fn tiles_equal_their_faces() {
        for (columns, rows) in [(4, 2), (2, 4), (8, 1), (1, 8), (3, 2), (1, 1)] {
            let wide = columns + 1;
            let vertices: Vec<IVec3> =
                (0..wide * (rows + 1)).map(|i| IVec3::new(i % wide, i / wide, i * i % 7) * 40).collect();
            let at = |i: i32| vertices[i as usize];
            let faces: Vec<Face> = (0..columns * rows)
                .map(|face| face + face / columns)
                .map(|a| Face {
                    vertices: [at(a), at(a + 1), at(a + wide + 1), at(a + wide)],
                    arity: 4,
                    extinction: 1000 + a as u16,
                    radii: [0.0; 2],
                })
                .collect();
            let extinctions: Vec<u16> = faces.iter().map(|face| face.extinction).collect();
            let mut bytes = Vec::new();
            encode_tile(&vertices, columns as usize, &extinctions, 3, &mut bytes);
            let length = bytes.len();
            bytes.resize(length + READ_PAST_BYTES, 0);
            let layout = Layout::read(&bytes[..length]).unwrap();
            assert!(layout.is_sound(&bytes));
            assert_eq!((0..faces.len()).map(|i| layout.face(&bytes, i)).collect::<Vec<_>>(), faces);
        }
    }

    /// Catches extinction that does not multiply as opacity does.
    #[test]
    fn extinctions_add_as_transmittances_multiply() {
        assert_eq!(extinction_from_opacity(0.5), 4096);
        assert_eq!(extinction_from_opacity(0.75), 8192);
        assert_eq!(extinction_from_opacity(0.0), 0);
        assert_eq!(extinction_from_opacity(1.0), OPAQUE);
    }
}
