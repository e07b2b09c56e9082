//! Reading a leaf: where its columns lie, whether it is sound, and the plain decoder.

use glam::IVec3;

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

    /// Columns of indices, one a corner.
    #[inline(always)]
    pub fn corners(self) -> usize {
        match self {
            Self::Quads => 4,
            Self::Triangles => 3,
            Self::Round => 2,
            Self::Tile => 0,
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
    /// Bits of a coordinate per axis.
    pub bits: [u8; 3],
    /// Left shift of packed coordinates.
    pub shift: u8,
    /// Whether every face is opaque.
    pub opaque: bool,
    /// What packed coordinates are relative to, in lattice coordinates: a multiple of `2^shift`.
    pub origin: IVec3,
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
        if leaf.len() < HEADER_BYTES {
            return None;
        }
        let layout = Self::read_trusted(leaf, corner);
        let sane = (1..=VERTICES_MAX).contains(&layout.vertices)
            && layout.bits.iter().all(|&bits| bits <= BITS_MAX && bits + layout.shift <= BITS_MAX + 1)
            && layout.shift <= SHIFT_MAX
            && (layout.kind == Kind::Triangles || leaf[3] & 0x80 == 0 && layout.faces <= FACES_MAX)
            && layout.bytes <= leaf.len();
        sane.then_some(layout)
    }

    /// [`read`](Self::read) for a leaf that was checked when its brick was loaded.
    #[inline(always)]
    pub fn read_trusted(leaf: &[u8], corner: IVec3) -> Self {
        let header = u32::from_le_bytes([leaf[0], leaf[1], leaf[2], leaf[3]]);
        let field = |bit: u32, bits: u32| header >> bit & ((1 << bits) - 1);
        let kind = Kind::from_bits(header >> 28);
        let (first, second) = (field(0, 3) as usize + 1, field(3, 5) as usize + 1);
        let (faces, vertices, columns) = match kind {
            Kind::Tile => (first * second, (first + 1) * (second + 1), second),
            Kind::Triangles => (first + 8 * (header >> 31) as usize, second, 0),
            _ => (first, second, 0),
        };
        let shift = field(8, 5);
        let bits = [field(13, 5) as u8, field(18, 5) as u8, field(23, 5) as u8];
        let index_bits = 4 + usize::from(vertices > 16);
        let index_bytes = (faces * index_bits).div_ceil(8);
        let mut at = HEADER_BYTES + kind.corners() * index_bytes;
        // A loop, since a closure would be a call where the walk has vector instructions enabled
        let mut coordinates = [0; 3];
        for (coordinates, &bits) in coordinates.iter_mut().zip(&bits) {
            *coordinates = at;
            at += (vertices * usize::from(bits)).div_ceil(8);
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
            bits,
            shift: shift as u8,
            opaque,
            origin: corner >> (shift as i32) << (shift as i32),
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
        if self.columns > 0 {
            let wide = self.columns + 1;
            return face + face / self.columns + [0, 1, wide + 1, wide][corner];
        }
        let bit = face * self.index_bits;
        let at = HEADER_BYTES + corner * self.index_bytes + bit / 8;
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
        let axis = |axis: usize| {
            let bit = vertex * usize::from(self.bits[axis]);
            let at = self.coordinates[axis] + bit / 8;
            let word = u64::from_le_bytes(leaf[at..at + 8].try_into().expect("8 bytes"));
            let packed = (word >> (bit % 8)) as u32 & ((1_u32 << self.bits[axis]) - 1);
            self.origin[axis].wrapping_add((packed << self.shift) as i32)
        };
        IVec3::new(axis(0), axis(1), axis(2))
    }

    /// The radius of a vertex in lattice steps.
    #[inline(always)]
    pub fn radius(&self, leaf: &[u8], vertex: usize) -> f32 {
        let at = self.radii + 4 * vertex;
        f32::from_le_bytes(leaf[at..at + 4].try_into().expect("4 bytes"))
    }

    /// A face, decoded plainly. `leaf` must run at least 8 bytes past the leaf's end.
    pub fn face(&self, leaf: &[u8], face: usize) -> Face {
        let corners = if self.columns > 0 { 4 } else { self.kind.corners() };
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
