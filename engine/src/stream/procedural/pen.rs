//! The pen: lattices of vertices in, one microgrid in scene units out.

use glam::{DVec3, Vec3};

use crate::stream::schema::{Attribute, Schema, UpAxis, ValueType, names};
use crate::stream::{Microgrid, VERTICES_MAX};

/// The space a stream is written in. The generator itself works in metres with y up.
#[derive(Clone, Copy, Debug)]
pub struct Space {
    /// Scene units per metre, rounded to 20 bits.
    ///
    /// With quads of a power of two of a metre, every vertex of a terrain patch is then an exact f32 offset from an
    /// exact f64 anchor: neighbouring patches have the same corners to the last bit in any unit.
    pub units_per_meter: f64,
    /// The scene's up axis.
    pub up: UpAxis,
}

impl Space {
    /// The space of a scene of `meters_per_unit`, which is positive and finite.
    pub fn new(meters_per_unit: f64, up: UpAxis) -> Self {
        let exact = 1.0 / meters_per_unit;
        let low_bits = (1u64 << 33) - 1;
        let rounded = f64::from_bits((exact.to_bits() + (low_bits >> 1)) & !low_bits);
        Self { units_per_meter: rounded, up }
    }

    /// A point in metres, y up, as a point of the scene.
    pub fn point(&self, p: DVec3) -> DVec3 {
        let p = p * self.units_per_meter;
        match self.up {
            UpAxis::Y => p,
            UpAxis::Z => DVec3::new(p.x, -p.z, p.y),
        }
    }

    /// A direction with y up as a direction of the scene.
    fn direction(&self, d: Vec3) -> Vec3 {
        match self.up {
            UpAxis::Y => d,
            UpAxis::Z => Vec3::new(d.x, -d.z, d.y),
        }
    }
}

/// The schema of every procedural stream: `N`, `albedo` and `id`.
pub fn schema(meters_per_unit: f64, up: UpAxis) -> Schema {
    Schema {
        meters_per_unit,
        up,
        attributes: vec![
            Attribute::vertex(names::NORMAL, ValueType::F32, 3),
            Attribute::grid(names::ALBEDO, ValueType::F16, 3),
            Attribute::grid(names::ID, ValueType::U32, 1),
        ],
    }
}

/// How vertices make quads: `strips` separate lattices of `columns` by `rows` quads each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topology {
    /// Disconnected lattices, one after the other.
    pub strips: u32,
    /// Quads across.
    pub columns: u32,
    /// Quads along.
    pub rows: u32,
    /// Whether the last column joins the first: a tube.
    pub closed: bool,
}

impl Topology {
    /// A single open lattice.
    pub const fn sheet(columns: u32, rows: u32) -> Self {
        Self { strips: 1, columns, rows, closed: false }
    }

    /// Vertices per row of a strip.
    const fn across(&self) -> u32 {
        if self.closed { self.columns } else { self.columns + 1 }
    }

    /// Vertices.
    pub const fn vertices(&self) -> u32 {
        self.strips * self.across() * (self.rows + 1)
    }

    /// Quads.
    pub const fn quads(&self) -> u32 {
        self.strips * self.columns * self.rows
    }
}

/// Collects the vertices of one grid, in metres relative to its anchor, and writes them in scene units.
#[derive(Clone, Debug)]
pub struct Pen {
    positions: [Vec3; VERTICES_MAX],
    normals: [Vec3; VERTICES_MAX],
    count: usize,
}

impl Default for Pen {
    fn default() -> Self {
        Self { positions: [Vec3::ZERO; VERTICES_MAX], normals: [Vec3::Y; VERTICES_MAX], count: 0 }
    }
}

impl Pen {
    /// Starts a grid.
    pub fn start(&mut self) {
        self.count = 0;
    }

    /// Adds a vertex with a unit normal.
    #[inline]
    pub fn vertex(&mut self, position: Vec3, normal: Vec3) {
        self.positions[self.count] = position;
        self.normals[self.count] = normal;
        self.count += 1;
    }

    /// Adds the vertices of a sheet or tube that is smooth: normals come from differences of neighbours.
    ///
    /// `lattice` holds `rows + 3` rows of `across` vertices (tube) or `across + 2` (sheet): one more on every open
    /// side, so that normals agree where two grids meet.
    pub fn smooth(&mut self, topology: Topology, lattice: &[Vec3]) {
        let across = topology.across() as usize;
        let pitch = if topology.closed { across } else { across + 2 };
        for row in 1..topology.rows as usize + 2 {
            for column in 0..across {
                let (left, here, right) = if topology.closed {
                    ((column + across - 1) % across, column, (column + 1) % across)
                } else {
                    (column, column + 1, column + 2)
                };
                let dx = lattice[row * pitch + right] - lattice[row * pitch + left];
                let dz = lattice[(row + 1) * pitch + here] - lattice[(row - 1) * pitch + here];
                self.vertex(lattice[row * pitch + here], unit_or(dx.cross(dz), Vec3::Y));
            }
        }
    }

    /// Writes the grid. `anchor` is in metres.
    pub fn finish(
        &self,
        grid: &mut Microgrid,
        space: &Space,
        anchor: DVec3,
        topology: Topology,
        paint: &Paint,
    ) {
        debug_assert_eq!(self.count, topology.vertices() as usize);
        grid.clear(3);
        grid.anchor = space.point(anchor);
        let scale = space.units_per_meter as f32;
        let (positions, normals) = (&self.positions[..self.count], &self.normals[..self.count]);
        grid.positions.extend(positions.iter().map(|&p| space.direction(p * scale)));
        grid.columns[0].resize(12 * self.count, 0);
        for (bytes, &normal) in grid.columns[0].chunks_exact_mut(12).zip(normals) {
            let normal = space.direction(normal);
            bytes[0..4].copy_from_slice(&normal.x.to_le_bytes());
            bytes[4..8].copy_from_slice(&normal.y.to_le_bytes());
            bytes[8..12].copy_from_slice(&normal.z.to_le_bytes());
        }
        for component in paint.albedo.to_array() {
            grid.columns[1].extend_from_slice(&half::f16::from_f32(component).to_le_bytes());
        }
        grid.columns[2].extend_from_slice(&paint.id.to_le_bytes());
        push_quads(grid, topology);
    }
}

/// What a whole grid carries.
#[derive(Clone, Copy, Debug)]
pub struct Paint {
    /// Diffuse reflectance, linear RGB.
    pub albedo: Vec3,
    /// The plant's number, 0 for the ground.
    pub id: u32,
}

/// Adds the faces of `topology`, row by row.
fn push_quads(grid: &mut Microgrid, topology: Topology) {
    let quads = topology.quads() as usize;
    grid.arities.resize(quads, 4);
    grid.indices.resize(4 * quads, 0);
    let across = topology.across();
    let mut faces = grid.indices.chunks_exact_mut(4);
    for strip in 0..topology.strips {
        for row in 0..topology.rows {
            let first = (strip * (topology.rows + 1) + row) * across;
            for (column, face) in (0..topology.columns).zip(&mut faces) {
                let next = if column + 1 == across { 0 } else { column + 1 };
                let corners = [first + column, first + next, first + across + next, first + across + column];
                face.copy_from_slice(&corners.map(|corner| corner as u8));
            }
        }
    }
}

/// `v` at unit length, or `fallback` where it has none.
#[inline]
pub fn unit_or(v: Vec3, fallback: Vec3) -> Vec3 {
    let squared = v.dot(v);
    if squared > 1e-24 { v * (1.0 / squared.sqrt()) } else { fallback }
}

/// The unit vector perpendicular to the unit vector `axis` that is nearest to `hint`.
#[inline]
pub fn perpendicular(axis: Vec3, hint: Vec3) -> Vec3 {
    let across = hint - axis * axis.dot(hint);
    if across.dot(across) > 1e-5 {
        return unit_or(across, Vec3::X);
    }
    // The hint lies along the axis: any perpendicular will do.
    let other = if axis.x * axis.x < 0.5 { Vec3::X } else { Vec3::Z };
    unit_or(other - axis * axis.dot(other), Vec3::X)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a unit conversion that rounds, or one that is not the unit asked for.
    #[test]
    fn units_are_rounded_to_twenty_bits() {
        assert_eq!(Space::new(0.01, UpAxis::Y).units_per_meter, 100.0);
        for meters in [0.3048, 0.0254, 1.0, 7.7e-5, 1234.5] {
            let scale = Space::new(meters, UpAxis::Y).units_per_meter;
            assert!((scale * meters - 1.0).abs() < 2e-6);
            for i in 0..16 {
                let offset = f64::from(i) * 0.25 * scale;
                assert_eq!(f64::from(offset as f32), offset);
            }
        }
    }

    /// Catches a tube whose seam is open or whose faces look inward.
    #[test]
    fn a_tube_closes_and_faces_outward() {
        let topology = Topology { strips: 1, columns: 6, rows: 2, closed: true };
        let mut grid = Microgrid::default();
        grid.clear(3);
        push_quads(&mut grid, topology);
        assert_eq!(grid.face_count(), 12);
        assert_eq!(&grid.indices[20..24], [5, 0, 6, 11]);
    }
}
