//! Grids of a cut triangle: a pattern's vertices take the mean of what the triangle's corners carry.

use glam::{DVec3, Vec3};

use super::pattern::{Pattern, PatternGrid, Vertex, WHOLE};
use crate::Result;
use crate::dice::NO_POINT;
use crate::import::emit::{Emitter, Placement};
use crate::import::mesh::{Face, Mesh};
use crate::import::{ImportReport, srgb};
use crate::stream::microgrid::decode;
use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, Rate};

/// What the corners of a triangle carry: positions in the world, and a grid of three vertices with their attributes.
struct Corners {
    points: [DVec3; 3],
    grid: Microgrid,
}

impl Emitter<'_> {
    /// Writes the parts of a face of three corners. Positions are rounded to multiples of `step`.
    pub(super) fn emit_pattern(
        &mut self,
        (mesh, face): (&Mesh, &Face),
        placement: &Placement,
        pattern: &Pattern,
        (first_id, step): (u32, f64),
        report: &mut ImportReport,
    ) -> Result<()> {
        self.begin_grid();
        self.exponents.clear();
        for corner in 0..3 {
            self.push_vertex(mesh, face, face.start as usize + corner, placement, 0.0);
        }
        let points = std::array::from_fn(|i| self.points[i]);
        let corners = Corners { points, grid: std::mem::take(&mut self.grid) };
        for part in &pattern.grids {
            self.begin_grid();
            for vertex in &part.vertices {
                let [a, b, c] = vertex.weights.map(|weight| f64::from(weight) / f64::from(WHOLE));
                let point = corners.points[0] * a + corners.points[1] * b + corners.points[2] * c;
                self.points.push((point / step).round() * step);
            }
            self.fill_columns(part, &corners);
            for &[a, b, c] in &part.faces {
                self.grid.push_face(&if placement.mirrored { [a, c, b] } else { [a, b, c] });
            }
            self.place(true);
            self.hand_over(first_id.wrapping_add(face.object), report)?;
        }
        Ok(())
    }

    /// Fills the columns of vertices from those of the corners.
    fn fill_columns(&mut self, part: &PatternGrid, corners: &Corners) {
        let mut value = Vec::new();
        for (column, attribute) in self.schema.attributes.iter().enumerate() {
            if attribute.rate == Rate::Grid {
                continue;
            }
            match attribute.name.as_str() {
                names::OPACITY => {
                    let opacities = part.vertices.iter().map(|vertex| vertex.opacity);
                    self.grid.columns[column].extend(opacities);
                }
                names::POINT => {
                    let numbers = part.vertices.iter().map(|vertex| number(vertex, corners, column));
                    self.grid.columns[column].extend(numbers.flat_map(u32::to_le_bytes));
                }
                name => {
                    let rows = rows(&corners.grid.columns[column], attribute);
                    for vertex in &part.vertices {
                        value.clear();
                        value.extend((0..rows[0].len()).map(|i| mean(&rows, i, vertex)));
                        match name {
                            names::NORMAL => turn(&mut value, &rows[0]),
                            names::ALBEDO => tint(&mut value, vertex.rgb),
                            _ => {}
                        }
                        self.grid.push_values(attribute, column, &value);
                    }
                }
            }
        }
    }
}

/// Makes the mean of normals one again; where it has no direction, that of a corner.
fn turn(normal: &mut [f32], corner: &[f32]) {
    if let Some(unit) = Vec3::from_slice(normal).try_normalize() {
        return unit.write_to_slice(normal);
    }
    normal.copy_from_slice(corner);
}

/// Colours an albedo in bytes.
fn tint(albedo: &mut [f32], rgb: [f32; 3]) {
    for (value, share) in albedo.iter_mut().zip(rgb) {
        *value = f32::from(srgb::unit_byte(*value * (1.0 / 255.0) * share));
    }
}

/// The values of an attribute at the corners.
fn rows(column: &[u8], attribute: &Attribute) -> [Vec<f32>; 3] {
    let n = usize::from(attribute.components);
    let value = |at| decode(attribute.value_type, column, at);
    [0, 1, 2].map(|corner| (0..n).map(|i| value(corner * n + i)).collect())
}

/// A component of the mean that a vertex takes.
fn mean(rows: &[Vec<f32>; 3], i: usize, vertex: &Vertex) -> f32 {
    let [a, b, c] = vertex.weights.map(|weight| f32::from(weight) / f32::from(WHOLE));
    rows[0][i] * a + rows[1][i] * b + rows[2][i] * c
}

/// The number of the file's point that a vertex is, if it is a corner.
fn number(vertex: &Vertex, corners: &Corners, column: usize) -> u32 {
    let Some(corner) = vertex.weights.iter().position(|&weight| weight == WHOLE) else { return NO_POINT };
    let bytes = corners.grid.columns[column][4 * corner..4 * corner + 4].try_into();
    u32::from_le_bytes(bytes.expect("a slice of four bytes"))
}
