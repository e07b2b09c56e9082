//! Points of a stream for its preview: chosen by a hash of their number, so the same on every machine.

use glam::{DVec3, Vec3};

use super::file::Header;
use crate::Result;
use crate::math::hash::combine;
use crate::relight::draw::{ALBEDO_DEFAULT, Columns};
use crate::relight::picture::srgb_byte;
use crate::stream::schema::names;
use crate::stream::{Microgrid, MicrogridStream, Schema};

/// Bytes of a position in a record, which depends on the node.
const POSITION_BYTES: usize = 6;
/// Where a normal is missing: no direction is coded so.
const NO_NORMAL: i16 = i16::MIN;

/// What to choose from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wanted {
    /// Vertices of the stream.
    pub vertices: u64,
    /// Points at most.
    pub points_max: u64,
    /// What positions are relative to.
    pub corner: DVec3,
}

/// The points, as columns.
#[derive(Debug, Default)]
pub(super) struct Points {
    /// What positions are relative to.
    pub corner: DVec3,
    /// Offsets from it.
    pub positions: Vec<Vec3>,
    /// What orders them: a hash of the vertex's number.
    pub hashes: Vec<u32>,
    /// Records without their positions, one after the other.
    pub records: Vec<u8>,
    /// Vertices of the stream that have a result.
    pub baked: u64,
}

impl Points {
    /// The rest of a point's record.
    pub fn record(&self, header: &Header, point: u32) -> &[u8] {
        let bytes = header.record_bytes() - POSITION_BYTES;
        &self.records[point as usize * bytes..][..bytes]
    }

    /// Adds a record without its position: normal, albedo, coefficients and, where there is one, their error.
    pub fn push_record(
        &mut self,
        header: &Header,
        normal: Vec3,
        albedo: Vec3,
        numbers: impl Iterator<Item = f32>,
    ) {
        let end = self.records.len() + header.record_bytes() - POSITION_BYTES;
        for value in octahedral(normal) {
            self.records.extend_from_slice(&value.to_le_bytes());
        }
        self.records.extend(albedo.to_array().map(srgb_byte));
        self.records.push(0);
        for number in numbers {
            self.records.extend_from_slice(&half::f16::from_f32(number).to_le_bytes());
        }
        self.records.resize(end, 0);
    }
}

/// Bytes that a point costs while the preview is made: itself, and its place in lists of the tree.
pub(super) fn bytes_per_point(header: &Header) -> u64 {
    (header.record_bytes() + size_of::<Vec3>() + 4 * size_of::<u32>()) as u64
}

/// What orders points, and chooses among them: the vertex's number, stirred.
pub(super) fn hash(vertex: u64) -> u32 {
    combine(combine(0x0070_7265, vertex as u32), (vertex >> 32) as u32)
}

/// Reads the stream once and keeps what the hash chooses.
pub(super) fn sample(
    stream: &mut dyn MicrogridStream,
    schema: &Schema,
    header: &Header,
    wanted: Wanted,
    progress: &mut dyn FnMut(f64),
) -> Result<Points> {
    let columns = Columns::new(schema);
    let (normal, albedo) = (schema.find(names::NORMAL), schema.find(names::ALBEDO));
    // A little less than fits, for the hash does not choose evenly
    let share = (0.99 * wanted.points_max as f64 / wanted.vertices.max(1) as f64).min(1.0);
    let threshold =
        if wanted.vertices <= wanted.points_max { u32::MAX } else { (share * 4_294_967_295.0) as u32 };
    let mut points = Points { corner: wanted.corner, ..Points::default() };
    let (mut grid, mut number) = (Microgrid::default(), 0_u64);
    stream.rewind()?;
    while stream.next(&mut grid)? {
        for vertex in 0..grid.vertex_count() {
            let hash = hash(number);
            number += 1;
            if !columns.is_baked(schema, &grid, vertex) {
                continue;
            }
            points.baked += 1;
            if hash > threshold || points.positions.len() as u64 >= wanted.points_max {
                continue;
            }
            points.positions.push((grid.position(vertex) - wanted.corner).as_vec3());
            points.hashes.push(hash);
            let unit = normal.map_or(Vec3::ZERO, |column| grid.vec3(schema, column, vertex));
            let color =
                albedo.map_or(Vec3::splat(ALBEDO_DEFAULT), |column| grid.vec3(schema, column, vertex));
            let (column, error) = header.columns;
            let numbers = (0..header.coefficients()).map(|number| grid.value(schema, column, vertex, number));
            let error = error.map(|error| grid.value(schema, error, vertex, 0));
            points.push_record(header, unit, color, numbers.chain(error));
        }
        progress(stream.progress());
    }
    Ok(points)
}

/// A unit vector on the octahedron unfolded to a square, 16 bits each way (Meyer et al., "On Floating-Point Normal
/// Vectors", 2010).
pub(super) fn octahedral(normal: Vec3) -> [i16; 2] {
    let sum = normal.abs().element_sum();
    if !sum.is_finite() || sum == 0.0 {
        return [NO_NORMAL; 2];
    }
    let p = normal / sum;
    let (mut x, mut y) = (p.x, p.y);
    if p.z < 0.0 {
        let sign = |value: f32| if value < 0.0 { -1.0 } else { 1.0 };
        (x, y) = ((1.0 - p.y.abs()) * sign(p.x), (1.0 - p.x.abs()) * sign(p.y));
    }
    [x, y].map(|value| (value.clamp(-1.0, 1.0) * 32_767.0).round() as i16)
}
