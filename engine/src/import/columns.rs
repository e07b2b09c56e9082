//! The values of a mesh that dicing interpolates, as columns: taken out of it, and put into what is diced.

use glam::Vec3;

use super::mesh::{Extra, ExtraRate, Face, Mesh};
use crate::dice::{Diced, NO_POINT};

/// What a column of values is in a mesh.
#[derive(Clone, Copy)]
enum Kind {
    Color,
    Opacity,
    Extra(usize),
}

/// A column of values that dicing interpolates.
pub(super) struct Column {
    kind: Kind,
    /// Numbers of a value.
    pub components: usize,
}

/// The values of a mesh that dicing interpolates: those of points, and those of corners.
pub(super) struct Columns {
    /// What belongs to points.
    pub smooth: Vec<Column>,
    /// What belongs to corners.
    pub linear: Vec<Column>,
}

impl Columns {
    /// Those of a mesh.
    pub fn of(mesh: &Mesh) -> Self {
        let mut columns = Self { smooth: Vec::new(), linear: Vec::new() };
        let (color, opacity) =
            (Column { kind: Kind::Color, components: 3 }, Column { kind: Kind::Opacity, components: 1 });
        if !mesh.variant_colors.is_empty() {
            columns.linear.push(color);
        } else if !mesh.colors.is_empty() {
            columns.smooth.push(color);
        }
        if !mesh.variant_opacities.is_empty() {
            columns.linear.push(opacity);
        } else if !mesh.opacities.is_empty() {
            columns.smooth.push(opacity);
        }
        for (number, extra) in mesh.extras.iter().enumerate() {
            let column = Column { kind: Kind::Extra(number), components: extra.components };
            match extra.rate {
                ExtraRate::Constant => {}
                ExtraRate::Position => columns.smooth.push(column),
                ExtraRate::Variant => columns.linear.push(column),
            }
        }
        columns
    }

    /// Diced faces as a mesh of their own.
    pub fn mesh(&self, from: &Mesh, diced: Diced, step: f64) -> Mesh {
        let mut mesh = Mesh {
            positions: diced.positions.iter().map(|p| (*p / step).round() * step).collect(),
            palette: from.palette.clone(),
            extras: from.extras.clone(),
            ..Mesh::default()
        };
        mesh.normals = diced.normals;
        if mesh.normals.contains(&Vec3::ZERO) {
            // A zero normal would pass for a given one
            let numbers = mesh.normals.iter().enumerate();
            let numbers: Vec<u32> = numbers
                .map(|(i, normal)| if *normal == Vec3::ZERO { super::mesh::NO_NORMAL } else { i as u32 })
                .collect();
            let used = diced.faces.iter().flat_map(|face| face.iter().filter(|&&v| v != NO_POINT));
            mesh.corner_normals = used.map(|&vertex| numbers[vertex as usize]).collect();
        }
        let number = |&point: &u32| match point {
            NO_POINT => NO_POINT,
            point => from.point_numbers.get(point as usize).copied().unwrap_or(point),
        };
        mesh.point_numbers = diced.points.iter().map(number).collect();
        for (face, &source) in diced.faces.iter().zip(&diced.sources) {
            let arity = face.iter().filter(|&&vertex| vertex != NO_POINT).count();
            let start = mesh.corners.len() as u32;
            mesh.corners.extend_from_slice(&face[..arity]);
            mesh.faces.push(Face { start, arity: arity as u32, ..from.faces[source as usize] });
        }
        self.spread(&diced.values, mesh.positions.len(), &mut mesh);
        mesh
    }

    /// Takes rows of values apart.
    fn spread(&self, values: &[f32], count: usize, mesh: &mut Mesh) {
        let width: usize = self.smooth.iter().chain(&self.linear).map(|column| column.components).sum();
        let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
        let mut first = 0;
        for Column { kind, components } in self.smooth.iter().chain(&self.linear) {
            let value = |row: usize, i: usize| values[row * width + first + i];
            match kind {
                Kind::Color => {
                    mesh.colors = (0..count).map(|row| [0, 1, 2].map(|i| byte(value(row, i)))).collect();
                }
                Kind::Opacity => mesh.opacities = (0..count).map(|row| byte(value(row, 0))).collect(),
                Kind::Extra(number) => {
                    let all = (0..count).flat_map(|row| (0..*components).map(move |i| (row, i)));
                    let values = all.map(|(row, i)| value(row, i)).collect();
                    mesh.extras[*number] =
                        Extra { components: *components, rate: ExtraRate::Position, values };
                }
            }
            first += components;
        }
    }
}

impl Column {
    /// Appends the value at a corner.
    pub fn push(&self, mesh: &Mesh, corner: usize, out: &mut Vec<f32>) {
        self.push_at(mesh, mesh.corners[corner] as usize, mesh.variant(corner), out);
    }

    /// Appends the value at a position and a variant.
    pub fn push_at(&self, mesh: &Mesh, position: usize, variant: Option<u32>, out: &mut Vec<f32>) {
        let variant_index = variant.map_or(usize::MAX, |variant| variant as usize);
        match self.kind {
            Kind::Color => {
                let own = mesh.variant_colors.get(variant_index).or_else(|| mesh.colors.get(position));
                out.extend(own.copied().unwrap_or([128; 3]).map(f32::from));
            }
            Kind::Opacity => {
                let own = mesh.variant_opacities.get(variant_index).or_else(|| mesh.opacities.get(position));
                out.push(f32::from(own.copied().unwrap_or(255)));
            }
            Kind::Extra(number) => match mesh.extras[number].at(position, variant) {
                Some(value) => out.extend_from_slice(value),
                None => out.resize(out.len() + self.components, 0.0),
            },
        }
    }
}
