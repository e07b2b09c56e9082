//! Reading a leaf: where its columns lie, whether it is sound, and the plain decoder.

use glam::IVec3;

use super::predict::{self, PREDICTED_VERTICES_MAX};
use super::{BITS_MAX, FACES_MAX, Face, HEADER_BYTES, OPAQUE, VERTICES_MAX};
use crate::brick::lattice::SHIFT_MAX;

/// What a leaf's faces are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Up to eight quads, or quads and triangles.
    Quads,
    /// Up to sixteen triangles.
    Triangles,
    /// Up to eight points and lines.
    Round,
    /// Up to eight quads of a regular grid.
    Tile,
}

impl Kind {
    /// From two bits.
    #[inline(always)]
    fn from_bits(bits: u32) -> Self {
        match bits & 3 {
            0 => Self::Quads,
            1 => Self::Triangles,
            2 => Self::Round,
            _ => Self::Tile,
        }
    }

    /// The faces of a leaf whose triangles in `lanes` are met: a quad's triangles are eight lanes apart.
    #[inline(always)]
    pub fn faces(self, lanes: u16) -> u16 {
        if self == Self::Triangles { lanes } else { (lanes | lanes >> 8) & 0xff }
    }

    /// Corners of a face.
    #[inline(always)]
    pub fn corners(self) -> usize {
        match self {
            Self::Quads | Self::Tile => 4,
            Self::Triangles => 3,
            Self::Round => 2,
        }
    }
}

/// The leaf's fixed part and where its columns lie.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// What the faces are.
    pub kind: Kind,
    /// Faces.
    pub faces: usize,
    /// Vertices.
    pub vertices: usize,
    /// Quads across a tile; 0 if it is none.
    pub columns: usize,
    /// Vertices from one row of quads to the next; 0 where faces have an index for every corner.
    pub stride: usize,
    /// Bits of a coordinate per axis; in a predicted tile, of those of its corners.
    pub bits: [u8; 3],
    /// Bits per axis of what other coordinates differ by from what is expected, if the tile is predicted.
    pub rest_bits: Option<[u8; 3]>,
    /// Left shift of packed coordinates.
    pub shift: u8,
    /// Whether every face is opaque.
    pub opaque: bool,
    /// What packed coordinates are relative to, in lattice coordinates: a multiple of `2^shift`.
    pub origin: IVec3,
    /// Byte offset of the indices.
    pub indices: usize,
    /// Bits of an index: 4 or 5.
    pub index_bits: usize,
    /// Bytes of a corner's indices.
    pub index_bytes: usize,
    /// Byte offsets of the coordinates, per axis.
    pub coordinates: [usize; 3],
    /// Byte offset of the extinctions.
    pub extinctions: usize,
    /// Byte offset of the radii.
    pub radii: usize,
    /// Bytes of the leaf, padded to [`ALIGNMENT`](super::ALIGNMENT).
    pub bytes: usize,
}

impl Layout {
    /// Reads the fixed part; none if it promises what cannot be. `leaf` starts at the leaf and may run on; `corner` is the
    /// lower corner of the leaf's box in its node.
    pub fn read(leaf: &[u8], corner: IVec3) -> Option<Self> {
        if leaf.len() < 2 * HEADER_BYTES {
            return None;
        }
        let layout = Self::read_trusted(leaf, corner);
        let variant = leaf[3] & 0x80 != 0;
        let are_few = layout.faces <= FACES_MAX;
        let is_known = match layout.kind {
            Kind::Triangles => true,
            Kind::Quads => are_few && (!variant || (2..VERTICES_MAX).contains(&layout.stride)),
            Kind::Round => are_few && !variant,
            Kind::Tile => are_few && (!variant || (5..=PREDICTED_VERTICES_MAX).contains(&layout.vertices)),
        };
        let is_narrow = |bits: u8| bits <= BITS_MAX && bits + layout.shift <= BITS_MAX + 1;
        let sane = is_known
            && (1..=VERTICES_MAX).contains(&layout.vertices)
            && layout.bits.iter().chain(layout.rest_bits.iter().flatten()).all(|&bits| is_narrow(bits))
            && layout.shift <= SHIFT_MAX
            && layout.bytes <= leaf.len();
        sane.then_some(layout)
    }

    /// [`read`](Self::read) for a leaf that was checked when its brick was loaded.
    #[inline(always)]
    pub fn read_trusted(leaf: &[u8], corner: IVec3) -> Self {
        let header = u32::from_le_bytes([leaf[0], leaf[1], leaf[2], leaf[3]]);
        let field = |bit: u32, bits: u32| header >> bit & ((1 << bits) - 1);
        let kind = Kind::from_bits(header >> 28);
        let variant = header >> 31 != 0;
        let (first, second) = (field(0, 3) as usize + 1, field(3, 5) as usize + 1);
        let (faces, vertices, columns) = match kind {
            Kind::Tile => (first * second, (first + 1) * (second + 1), second),
            Kind::Triangles => (first + 8 * usize::from(variant), second, 0),
            _ => (first, second, 0),
        };
        let shift = field(8, 5);
        let bits = [field(13, 5) as u8, field(18, 5) as u8, field(23, 5) as u8];
        let index_bits = 4 + usize::from(vertices > 16);
        let index_bytes = (faces * index_bits).div_ceil(8);
        // What follows the header
        let (mut stride, mut rest_bits, mut indices, mut index_columns) =
            (0, None, HEADER_BYTES, kind.corners());
        match kind {
            Kind::Tile => {
                (stride, index_columns) = (columns + 1, 0);
                if variant {
                    let word = u16::from_le_bytes([leaf[4], leaf[5]]);
                    rest_bits = Some([word & 31, word >> 5 & 31, word >> 10 & 31].map(|bits| bits as u8));
                    indices += 2;
                }
            }
            Kind::Quads if variant => {
                (stride, index_columns) = (usize::from(leaf[4]), 1);
                indices += 1;
            }
            _ => {}
        }
        let mut at = indices + index_columns * index_bytes;
        // A loop, since a closure would be a call where the walk has vector instructions enabled
        let mut coordinates = [0; 3];
        for axis in 0..3 {
            coordinates[axis] = at;
            let coordinate_bits = match rest_bits {
                None => vertices * usize::from(bits[axis]),
                Some(rest) => {
                    4 * usize::from(bits[axis]) + vertices.saturating_sub(4) * usize::from(rest[axis])
                }
            };
            at += coordinate_bits.div_ceil(8);
        }
        let extinctions = at;
        let opaque = field(30, 1) == 0;
        at += if opaque { 0 } else { 2 * faces };
        let radii = at;
        at += if kind == Kind::Round { 4 * vertices } else { 0 };
        Self {
            kind,
            faces,
            vertices,
            columns,
            stride,
            bits,
            rest_bits,
            shift: shift as u8,
            opaque,
            origin: corner >> (shift as i32) << (shift as i32),
            indices,
            index_bits,
            index_bytes,
            coordinates,
            extinctions,
            radii,
            bytes: at.next_multiple_of(super::ALIGNMENT),
        }
    }

    /// The vertex index of corner `corner` of face `face`.
    #[inline(always)]
    pub fn index(&self, leaf: &[u8], face: usize, corner: usize) -> usize {
        if self.stride == 0 {
            return self.stored_index(leaf, face, corner);
        }
        let first = match face.checked_div(self.columns) {
            Some(row) => face + row,
            None => self.stored_index(leaf, face, 0),
        };
        first + [0, 1, self.stride + 1, self.stride][corner]
    }

    #[inline(always)]
    fn stored_index(&self, leaf: &[u8], face: usize, column: usize) -> usize {
        let bit = face * self.index_bits;
        let at = self.indices + column * self.index_bytes + bit / 8;
        let word = u16::from_le_bytes([leaf[at], leaf[at + 1]]);
        usize::from(word >> (bit % 8)) & ((1 << self.index_bits) - 1)
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
        let mut position = self.origin;
        for axis in 0..3 {
            let packed = match self.rest_bits {
                None => {
                    let bits = self.bits[axis];
                    self.packed(leaf, axis, vertex * usize::from(bits), bits)
                }
                Some(rest) => self.predicted(leaf, axis, vertex, rest[axis]),
            };
            position[axis] = position[axis].wrapping_add((packed << self.shift) as i32);
        }
        position
    }

    /// The coordinates of all vertices along an axis, packed. `leaf` must run at least 8 bytes past the leaf's end.
    #[inline(always)]
    pub fn unpack(&self, leaf: &[u8], axis: usize, out: &mut [u32; VERTICES_MAX]) {
        let bits = self.bits[axis];
        let vertices = self.vertices.min(VERTICES_MAX);
        let Some(rest) = self.rest_bits else {
            for (vertex, out) in out[..vertices].iter_mut().enumerate() {
                *out = self.packed(leaf, axis, vertex * usize::from(bits), bits);
            }
            return;
        };
        let places = predict::corners(self.stride, vertices);
        let corners = [0, 1, 2, 3].map(|corner| self.packed(leaf, axis, corner * usize::from(bits), bits));
        let mut bit = 4 * usize::from(bits);
        for (vertex, out) in out[..vertices].iter_mut().enumerate() {
            *out = match places.iter().position(|&corner| corner == vertex) {
                Some(corner) => corners[corner],
                None => {
                    bit += usize::from(rest[axis]);
                    let difference = self.packed(leaf, axis, bit - usize::from(rest[axis]), rest[axis]);
                    self.expected(corners, vertex).wrapping_add(extended(difference, rest[axis])) as u32
                }
            };
        }
    }

    #[inline(always)]
    fn expected(&self, corners: [u32; 4], vertex: usize) -> i32 {
        let weights = predict::weights(vertex, self.columns, self.vertices / self.stride - 1);
        predict::predict(corners.map(|corner| corner as i32), weights)
    }

    /// The coordinate of a predicted tile's vertex.
    #[inline(always)]
    fn predicted(&self, leaf: &[u8], axis: usize, vertex: usize, rest_bits: u8) -> u32 {
        let bits = self.bits[axis];
        let corners = predict::corners(self.stride, self.vertices);
        let corner = |number: usize| self.packed(leaf, axis, number * usize::from(bits), bits);
        let Some(place) = predict::place(vertex, corners) else {
            return corner(corners.iter().position(|&corner| corner == vertex).unwrap_or(0));
        };
        let bit = 4 * usize::from(bits) + place * usize::from(rest_bits);
        let rest = self.packed(leaf, axis, bit, rest_bits);
        let corners = [0, 1, 2, 3].map(corner);
        self.expected(corners, vertex).wrapping_add(extended(rest, rest_bits)) as u32
    }

    /// The number of `bits` bits that starts at a bit of an axis' column.
    #[inline(always)]
    fn packed(&self, leaf: &[u8], axis: usize, bit: usize, bits: u8) -> u32 {
        let at = self.coordinates[axis] + bit / 8;
        let word = u64::from_le_bytes(leaf[at..at + 8].try_into().expect("8 bytes"));
        (word >> (bit % 8)) as u32 & ((1_u32 << bits) - 1)
    }

    /// The radius of a vertex in lattice steps.
    #[inline(always)]
    pub fn radius(&self, leaf: &[u8], vertex: usize) -> f32 {
        let at = self.radii + 4 * vertex;
        f32::from_le_bytes(leaf[at..at + 4].try_into().expect("4 bytes"))
    }

    /// A face, decoded plainly. `leaf` must run at least 8 bytes past the leaf's end.
    pub fn face(&self, leaf: &[u8], face: usize) -> Face {
        let corners = self.kind.corners();
        let indices: [usize; 4] =
            std::array::from_fn(|corner| self.index(leaf, face, corner.min(corners - 1)));
        let repeats = corners != 3 && indices[corners - 1] == indices[corners - 2];
        let round = self.kind == Kind::Round;
        Face {
            vertices: indices.map(|index| self.vertex(leaf, index)),
            arity: corners as u8 - u8::from(repeats),
            extinction: self.extinction(leaf, face),
            radii: if round { [0, 1].map(|i| self.radius(leaf, indices[i])) } else { [0.0; 2] },
        }
    }

    /// Whether indices and radii are such that decoding cannot fail. Checked once, when a brick is loaded.
    pub fn is_sound(&self, leaf: &[u8]) -> bool {
        let corners = self.kind.corners();
        let indices =
            (0..self.faces).all(|face| (0..corners).all(|c| self.index(leaf, face, c) < self.vertices));
        let round = self.kind == Kind::Round;
        let radii = !round || (0..self.vertices).all(|v| (0.0..1e9).contains(&self.radius(leaf, v)));
        indices && radii
    }
}

/// The signed number in the lower `bits` bits.
#[inline(always)]
fn extended(number: u32, bits: u8) -> i32 {
    let unused = 32 - u32::from(bits.max(1));
    (number << unused) as i32 >> unused
}
