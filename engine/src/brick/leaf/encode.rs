//! Writing leaves.

use glam::IVec3;

use super::layout::{Kind, Layout};
use super::{ALIGNMENT, BITS_MAX, FACES_MAX, Face, HEADER_BYTES, OPAQUE, TRIANGLES_MAX, VERTICES_MAX};

/// Appends a leaf of `faces` to `out`, padded to [`ALIGNMENT`]: 1 to [`FACES_MAX`], all flat or all round, or up to
/// [`TRIANGLES_MAX`] triangles of no more than [`VERTICES_MAX`] vertices. `shift` is that of the faces' geometry: all
/// coordinates are multiples of `2^shift` and lie within [`COORDINATE_MAX`](crate::brick::lattice::COORDINATE_MAX), at
/// or above `corner`, the lower corner of the leaf's box.
pub fn encode(faces: &[Face], shift: u8, corner: IVec3, out: &mut Vec<u8>) {
    let kind = match () {
        () if faces[0].is_round() => Kind::Round,
        () if faces.iter().all(|face| face.arity == 3) => Kind::Triangles,
        () => Kind::Quads,
    };
    let faces_max = if kind == Kind::Triangles { TRIANGLES_MAX } else { FACES_MAX };
    debug_assert!((1..=faces_max).contains(&faces.len()));
    let corners = kind.corners();

    // Number the distinct vertices
    let mut vertices = [(IVec3::ZERO, 0.0_f32); VERTICES_MAX];
    let mut count = 0;
    let mut indices = [0_u8; 4 * TRIANGLES_MAX];
    for (f, face) in faces.iter().enumerate() {
        debug_assert_eq!(face.is_round(), kind == Kind::Round);
        for corner in 0..corners {
            let used = corner.min(usize::from(face.arity) - 1);
            let radius = if kind == Kind::Round { face.radii[used] } else { 0.0 };
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
    let start = out.len();
    let positions = vertices.map(|vertex| vertex.0);
    let pack = Packing::of(&positions[..count], shift, corner);
    let many = faces.len() > 8;
    pack.write_header(faces.len() - if many { 9 } else { 1 }, count - 1, kind, !opaque, many, out);
    let index_bits = 4 + u32::from(count > 16);
    for corner in 0..corners {
        let word = (0..faces.len()).fold(0_u128, |word, face| {
            word | u128::from(indices[face * corners + corner]) << (face as u32 * index_bits)
        });
        out.extend_from_slice(&word.to_le_bytes()[..(faces.len() * index_bits as usize).div_ceil(8)]);
    }

    // Then the columns
    pack.write_coordinates(out);
    if !opaque {
        faces.iter().for_each(|face| out.extend_from_slice(&face.extinction.to_le_bytes()));
    }
    if kind == Kind::Round {
        vertices[..count].iter().for_each(|v| out.extend_from_slice(&v.1.to_le_bytes()));
    }
    pad(out, start);
}

/// Appends a tile: `columns` quads across, their vertices in rows, their extinctions likewise. See [`encode`].
pub fn encode_tile(
    vertices: &[IVec3],
    columns: usize,
    extinctions: &[u16],
    shift: u8,
    corner: IVec3,
    out: &mut Vec<u8>,
) {
    debug_assert!((1..=FACES_MAX).contains(&extinctions.len()) && vertices.len() <= VERTICES_MAX);
    let opaque = extinctions.iter().all(|&extinction| extinction == OPAQUE);
    let start = out.len();
    let pack = Packing::of(vertices, shift, corner);
    pack.write_header(extinctions.len() / columns - 1, columns - 1, Kind::Tile, !opaque, false, out);
    pack.write_coordinates(out);
    if !opaque {
        extinctions.iter().for_each(|extinction| out.extend_from_slice(&extinction.to_le_bytes()));
    }
    pad(out, start);
}

/// Appends a leaf that was encoded relative to the lower corner `from`, now relative to `to`, at or below its vertices too.
/// `leaf` starts at the leaf and may end with it.
pub fn rebase(leaf: &[u8], from: IVec3, to: IVec3, out: &mut Vec<u8>) {
    // The plain decoder reads a little further
    let mut copy = [0; LEAF_BYTES_MAX + 8];
    let length = leaf.len().min(LEAF_BYTES_MAX);
    copy[..length].copy_from_slice(&leaf[..length]);
    let layout = Layout::read_trusted(&copy, from);
    let mut vertices = [IVec3::ZERO; VERTICES_MAX];
    for (vertex, position) in vertices[..layout.vertices].iter_mut().enumerate() {
        *position = layout.vertex(&copy, vertex);
    }
    let start = out.len();
    let pack = Packing::of(&vertices[..layout.vertices], layout.shift, to);
    let header = u32::from_le_bytes(leaf[..4].try_into().expect("4 bytes"));
    out.extend_from_slice(&(header & !(0x7fff << 13) | pack.bits_field()).to_le_bytes());
    out.extend_from_slice(&copy[HEADER_BYTES..layout.coordinates[0]]);
    pack.write_coordinates(out);
    let end = layout.radii + if layout.kind == Kind::Round { 4 * layout.vertices } else { 0 };
    out.extend_from_slice(&copy[layout.extinctions..end]);
    pad(out, start);
}

/// Bytes of a leaf at most: indices, coordinates of 30 bits, extinctions, radii.
const LEAF_BYTES_MAX: usize =
    HEADER_BYTES + 40 + 3 * VERTICES_MAX * BITS_MAX as usize / 8 + 2 * TRIANGLES_MAX + 4 * VERTICES_MAX;

/// Fills the leaf that starts at `start` up to a multiple of the alignment.
fn pad(out: &mut Vec<u8>, start: usize) {
    out.resize(start + (out.len() - start).next_multiple_of(ALIGNMENT), 0);
}

/// Vertices and how many bits their coordinates take.
struct Packing<'a> {
    vertices: &'a [IVec3],
    shift: u8,
    origin: IVec3,
    bits: [u8; 3],
}

impl<'a> Packing<'a> {
    fn of(vertices: &'a [IVec3], shift: u8, corner: IVec3) -> Self {
        let origin = corner >> i32::from(shift) << i32::from(shift);
        debug_assert!(vertices.iter().all(|vertex| vertex.cmpge(origin).all()));
        let high = vertices.iter().fold(IVec3::MIN, |high, &v| high.max(v));
        let bits = ((high - origin) >> i32::from(shift)).to_array().map(|e| (32 - e.leading_zeros()) as u8);
        debug_assert!(bits.iter().all(|&bits| bits <= BITS_MAX));
        Self { vertices, shift, origin, bits }
    }

    /// The bits per axis where the header has them.
    fn bits_field(&self) -> u32 {
        let [x, y, z] = self.bits.map(u32::from);
        x << 13 | y << 18 | z << 23
    }

    fn write_header(
        &self,
        first: usize,
        second: usize,
        kind: Kind,
        extinctions: bool,
        many: bool,
        out: &mut Vec<u8>,
    ) {
        let flags = (kind as u32) << 28 | u32::from(extinctions) << 30 | u32::from(many) << 31;
        let counts = first as u32 | (second as u32) << 3 | u32::from(self.shift) << 8;
        out.extend_from_slice(&(counts | self.bits_field() | flags).to_le_bytes());
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
