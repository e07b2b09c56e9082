//! Writing leaves.

use glam::IVec3;

use super::contents::{Contents, Gathered};
use super::layout::Kind;
use super::predict::{self, PREDICTED_VERTICES_MAX};
use super::{ALIGNMENT, BITS_MAX, Face, HEADER_BYTES, TRIANGLES_MAX, VERTICES_MAX};

/// Bytes of a leaf at most: what follows the header, indices, coordinates of 30 bits, extinctions, radii.
const LEAF_BYTES_MAX: usize =
    HEADER_BYTES + 2 + 40 + 3 * VERTICES_MAX * BITS_MAX as usize / 8 + 2 * TRIANGLES_MAX + 4 * VERTICES_MAX;

/// Appends a leaf of `faces`, see [`Gathered::of`] and [`Contents::encode`].
pub fn encode(faces: &[Face], shift: u8, corner: IVec3, out: &mut Vec<u8>) {
    Gathered::of(faces, shift).contents().encode(corner, out);
}

impl Contents<'_> {
    /// Appends the leaf to `out`, padded to [`ALIGNMENT`]. Coordinates lie within
    /// [`COORDINATE_MAX`](crate::brick::lattice::COORDINATE_MAX), at or above `corner`, the lower corner of the leaf's box.
    pub fn encode(&self, corner: IVec3, out: &mut Vec<u8>) {
        let columns = Columns::of(self, corner);
        let rest = (self.kind == Kind::Tile).then(|| Rest::of(self, &columns)).flatten();

        // The fixed part
        let mut to = Writer { bytes: [0; LEAF_BYTES_MAX + 8], at: 0, word: 0, filled: 0 };
        let (first, second, variant) = match self.kind {
            Kind::Tile => (self.vertices.len() / self.stride - 2, self.stride - 2, rest.is_some()),
            Kind::Triangles => ((self.faces - 1) % 8, self.vertices.len() - 1, self.faces > 8),
            _ => (self.faces - 1, self.vertices.len() - 1, self.stride > 0),
        };
        let counts = first as u32 | (second as u32) << 3 | u32::from(self.shift) << 8;
        let [x, y, z] = columns.bits.map(u32::from);
        let flags = (self.kind as u32) << 28
            | u32::from(!self.extinctions.is_empty()) << 30
            | u32::from(variant) << 31;
        to.put(counts | x << 13 | y << 18 | z << 23 | flags, 32);
        if let Some(rest) = &rest {
            rest.bits.iter().for_each(|&bits| to.put(u32::from(bits), 5));
            to.flush();
        } else if self.kind == Kind::Quads && variant {
            to.put(self.stride as u32, 8);
        }
        let index_bits = 4 + u32::from(self.vertices.len() > 16);
        for column in self.indices.chunks(self.faces) {
            column.iter().for_each(|&index| to.put(u32::from(index), index_bits));
            to.flush();
        }

        // The coordinates, then what few leaves have
        match &rest {
            Some(rest) => rest.write(&columns, &mut to),
            None => columns.write(&mut to),
        }
        self.extinctions.iter().for_each(|&extinction| to.put(u32::from(extinction), 16));
        self.radii.iter().for_each(|radius| to.put(radius.to_bits(), 32));
        out.extend_from_slice(&to.bytes[..to.at.next_multiple_of(ALIGNMENT)]);
    }
}

/// Vertices relative to what they are packed relative to, per axis.
struct Columns {
    packed: [[i32; VERTICES_MAX]; 3],
    count: usize,
    /// Bits of the largest.
    bits: [u8; 3],
}

impl Columns {
    #[inline(always)]
    fn of(contents: &Contents<'_>, corner: IVec3) -> Self {
        let shift = i32::from(contents.shift);
        let origin = corner >> shift << shift;
        let mut packed = [[0; VERTICES_MAX]; 3];
        let mut all = IVec3::ZERO;
        for (i, &vertex) in contents.vertices.iter().enumerate().take(VERTICES_MAX) {
            let relative = (vertex - origin) >> shift;
            all |= relative;
            (0..3).for_each(|axis| packed[axis][i] = relative[axis]);
        }
        debug_assert!(all.cmpge(IVec3::ZERO).all(), "a vertex below its box");
        let bits = all.to_array().map(|all| (32 - all.leading_zeros()) as u8);
        debug_assert!(bits.iter().all(|&bits| bits <= BITS_MAX));
        Self { packed, count: contents.vertices.len(), bits }
    }

    fn bytes(&self) -> usize {
        self.bits.iter().map(|&bits| (self.count * usize::from(bits)).div_ceil(8)).sum()
    }

    #[inline(always)]
    fn write(&self, to: &mut Writer) {
        for (packed, &bits) in self.packed.iter().zip(&self.bits) {
            packed[..self.count].iter().for_each(|&x| to.put(x as u32, u32::from(bits)));
            to.flush();
        }
    }
}

/// How a tile's vertices between its corners differ from what is expected of them.
struct Rest {
    corners: [usize; 4],
    /// In the order of the vertices, without the corners.
    differences: [[i32; PREDICTED_VERTICES_MAX]; 3],
    count: usize,
    bits: [u8; 3],
}

impl Rest {
    /// None where the tile is smaller as it is.
    #[inline(always)]
    fn of(tile: &Contents<'_>, columns: &Columns) -> Option<Self> {
        let (stride, vertices) = (tile.stride, columns.count);
        if !(5..=PREDICTED_VERTICES_MAX).contains(&vertices) {
            return None;
        }
        let corners = predict::corners(stride, vertices);
        let mut weights = [[0; 3]; PREDICTED_VERTICES_MAX];
        for (vertex, weights) in weights[..vertices].iter_mut().enumerate() {
            *weights = predict::weights(vertex, stride - 1, vertices / stride - 1);
        }
        let mut rest = Self {
            corners,
            differences: [[0; PREDICTED_VERTICES_MAX]; 3],
            count: vertices - 4,
            bits: [0; 3],
        };
        for axis in 0..3 {
            let packed = &columns.packed[axis];
            let at_corners = corners.map(|corner| packed[corner]);
            let (mut place, mut all) = (0, 0);
            for vertex in (0..vertices).filter(|vertex| !corners.contains(vertex)) {
                let difference = packed[vertex].wrapping_sub(predict::predict(at_corners, weights[vertex]));
                rest.differences[axis][place] = difference;
                place += 1;
                all |= difference ^ difference >> 31;
            }
            rest.bits[axis] = if all == 0 && rest.differences[axis].iter().all(|&difference| difference == 0)
            {
                0
            } else {
                (33 - all.leading_zeros()) as u8
            };
        }
        let fits =
            rest.bits.iter().all(|&bits| u32::from(bits) + u32::from(tile.shift) <= u32::from(BITS_MAX));
        let padded = |bytes: usize| bytes.next_multiple_of(ALIGNMENT);
        (fits && padded(2 + rest.bytes(columns)) < padded(columns.bytes())).then_some(rest)
    }

    fn bytes(&self, columns: &Columns) -> usize {
        let bits =
            |axis: usize| 4 * usize::from(columns.bits[axis]) + self.count * usize::from(self.bits[axis]);
        (0..3).map(|axis| bits(axis).div_ceil(8)).sum()
    }

    #[inline(always)]
    fn write(&self, columns: &Columns, to: &mut Writer) {
        for axis in 0..3 {
            let (bits, rest_bits) = (u32::from(columns.bits[axis]), u32::from(self.bits[axis]));
            self.corners.iter().for_each(|&corner| to.put(columns.packed[axis][corner] as u32, bits));
            let mask = ((1_u64 << rest_bits) - 1) as u32;
            let differences = &self.differences[axis][..self.count];
            differences.iter().for_each(|&difference| to.put(difference as u32 & mask, rest_bits));
            to.flush();
        }
    }
}

/// Bits, the least significant first.
struct Writer {
    bytes: [u8; LEAF_BYTES_MAX + 8],
    at: usize,
    word: u64,
    filled: u32,
}

impl Writer {
    /// Adds a number of at most `bits` bits, at most 32.
    #[inline(always)]
    fn put(&mut self, number: u32, bits: u32) {
        self.word |= u64::from(number) << self.filled;
        self.filled += bits;
        self.bytes[self.at..self.at + 8].copy_from_slice(&self.word.to_le_bytes());
        self.at += (self.filled / 8) as usize;
        self.word >>= self.filled / 8 * 8;
        self.filled %= 8;
    }

    /// Goes on at the next byte.
    #[inline(always)]
    fn flush(&mut self) {
        self.at += usize::from(self.filled > 0);
        (self.word, self.filled) = (0, 0);
    }
}
