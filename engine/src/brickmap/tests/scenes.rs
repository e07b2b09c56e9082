//! Small scenes with everything that can go wrong in them, and what a brick map of them must hold.

use std::collections::BTreeMap;

use glam::{DVec3, IVec3, Vec3};

use crate::brick::lattice::Lattice;
use crate::brick::leaf::extinction_from_opacity;
use crate::math::hash::{hash32, unit_f32};
use crate::stream::schema::{Attribute, Schema, ValueType, names};
use crate::stream::{Microgrid, MicrogridStream};
use crate::{Error, Result};

/// A stream from memory.
#[derive(Clone, Debug)]
pub struct Grids {
    pub schema: Schema,
    pub grids: Vec<Microgrid>,
    at: usize,
    readings: usize,
    /// In the second reading, this many grids are missing.
    pub missing_later: usize,
}

impl MicrogridStream for Grids {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        (self.at, self.readings) = (0, self.readings + 1);
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        let missing = if self.readings > 1 { self.missing_later } else { 0 };
        let Some(next) = self.grids[..self.grids.len() - missing].get(self.at) else { return Ok(false) };
        self.at += 1;
        grid.clone_from(next);
        Ok(true)
    }
}

impl Grids {
    /// A stream with radius and opacity, and nothing in it.
    pub fn new() -> Self {
        let attributes = vec![
            Attribute::vertex(names::RADIUS, ValueType::F32, 1),
            Attribute::vertex(names::OPACITY, ValueType::F32, 1),
        ];
        let schema = Schema { attributes, ..Schema::default() };
        Self { schema, grids: Vec::new(), at: 0, readings: 0, missing_later: 0 }
    }

    /// Adds a grid; radii and opacities are given by vertex.
    pub fn push(
        &mut self,
        anchor: DVec3,
        positions: &[Vec3],
        faces: &[&[u8]],
        values: impl Fn(usize) -> [f32; 2],
    ) {
        let mut grid = Microgrid { anchor, positions: positions.to_vec(), ..Microgrid::default() };
        faces.iter().for_each(|face| grid.push_face(face));
        grid.columns.resize(2, Vec::new());
        for vertex in 0..positions.len() {
            for (column, value) in values(vertex).into_iter().enumerate() {
                grid.push_values(&self.schema.attributes[column], column, &[value]);
            }
        }
        self.grids.push(grid);
    }

    /// Adds a bent patch of quads, with its quads turned over or all its numbers reversed on request.
    pub fn push_patch(
        &mut self,
        anchor: DVec3,
        size: f32,
        columns: u8,
        rows: u8,
        turned: bool,
        opacity: f32,
    ) {
        let wide = columns + 1;
        let positions: Vec<Vec3> = (0..u16::from(wide) * (u16::from(rows) + 1))
            .map(|i| {
                let (u, v) = (f32::from(i % u16::from(wide)), f32::from(i / u16::from(wide)));
                Vec3::new(u, 0.1 * u * u - 0.03 * v * v, v) * size
            })
            .collect();
        let faces: Vec<[u8; 4]> = (0..columns * rows)
            .map(|face| {
                let a = face / columns * wide + face % columns;
                if turned { [a, a + wide, a + wide + 1, a + 1] } else { [a, a + 1, a + wide + 1, a + wide] }
            })
            .collect();
        let faces: Vec<&[u8]> = faces.iter().map(|face| &face[..]).collect();
        // One transparent corner, so that extinctions are not all alike
        self.push(anchor, &positions, &faces, |vertex| [0.0, if vertex == 0 { 0.5 } else { opacity }]);
    }

    pub fn faces(&self) -> u64 {
        self.grids.iter().map(|grid| grid.face_count() as u64).sum()
    }
}

/// Random numbers.
pub struct Random(pub u32);

impl Random {
    pub fn below(&mut self, n: u32) -> u32 {
        self.0 = self.0.wrapping_add(1);
        hash32(self.0) % n
    }

    pub fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(1);
        unit_f32(hash32(self.0))
    }

    pub fn place(&mut self, extent: f64) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| extent * f64::from(self.unit())))
    }
}

/// Patches of all shapes, soups, points, lines, degenerate and transparent faces, a huge polygon, long thin ones.
pub fn mixed(grids: u32, extent: f64) -> Grids {
    let mut scene = Grids::new();
    let mut random = Random(grids);
    for i in 0..grids {
        let anchor = random.place(extent);
        match i % 8 {
            0 => scene.push_patch(anchor, 0.1, 15, 15, false, 1.0),
            1 => {
                scene.push_patch(anchor, 0.1, 1 + random.below(8) as u8, 1 + random.below(8) as u8, true, 1.0)
            }
            2 => scene.push_patch(anchor, 0.1, 7, 3, false, 0.25 * random.below(5) as f32),
            3 | 4 => {
                // Triangles and quads that share nothing, some without area
                let count = 1 + random.below(40) as u8;
                let positions: Vec<Vec3> =
                    (0..4 * count).map(|_| (random.place(1.0) * 0.3).as_vec3()).collect();
                let faces: Vec<[u8; 4]> = (0..count).map(|f| [0, 1, 2, 3].map(|c| 4 * f + c)).collect();
                let faces: Vec<&[u8]> = faces
                    .iter()
                    .enumerate()
                    .map(|(f, face)| match f % 5 {
                        0 => &face[..3],
                        _ => &face[..],
                    })
                    .collect();
                scene.push(anchor, &positions, &faces, |vertex| {
                    [0.0, if vertex % 9 == 0 { 0.9 } else { 1.0 }]
                });
            }
            5 => {
                // Points and lines, some without a radius
                let positions: Vec<Vec3> = (0..60).map(|_| random.place(1.0).as_vec3()).collect();
                let faces: Vec<[u8; 2]> = (0..30).map(|f| [2 * f, 2 * f + u8::from(f % 4 != 0)]).collect();
                let faces: Vec<&[u8]> = faces
                    .iter()
                    .map(|face| if face[0] == face[1] { &face[..1] } else { &face[..] })
                    .collect();
                let radius = |vertex: usize| [0.0, 0.02, 0.05, -1.0, f32::NAN][vertex % 5];
                scene.push(anchor, &positions, &faces, |vertex| [radius(vertex), 1.0]);
            }
            6 => {
                // Quads that are triangles, lines and points in truth
                let p = [Vec3::ZERO, Vec3::X * 0.1, Vec3::new(0.1, 0.1, 0.0), Vec3::Y * 0.1, Vec3::X * 0.2];
                let faces: [&[u8]; 9] = [
                    &[0, 0, 2, 3],
                    &[0, 1, 1, 3],
                    &[0, 1, 2, 2],
                    &[0, 1, 2, 0],
                    &[0, 1, 2, 1],
                    &[0, 1, 0, 3],
                    &[0, 1, 4, 1],
                    &[0, 0, 0],
                    &[0, 1, 4, 3],
                ];
                scene.push(anchor, &p, &faces, |_| [0.0, 1.0]);
            }
            _ => {
                let thin = Vec3::new(0.001, 20.0, 0.0);
                let p = [Vec3::ZERO, Vec3::X * 0.001, thin, thin - Vec3::X * 0.001];
                scene.push(anchor, &p, &[&[0, 1, 2, 3]], |_| [0.0, 1.0]);
            }
        }
    }
    let e = extent as f32;
    let corners = [Vec3::ZERO, Vec3::X * e, Vec3::new(e, e, e), Vec3::new(0.0, e, e)];
    scene.push(DVec3::ZERO, &corners, &[&[0, 1, 2, 3]], |_| [0.0, 1.0]);
    scene
}

/// A face as a set of points: triangles with an area, each with sorted corners, or a point or line with its radii.
pub type Shape = (u16, Vec<[[i32; 3]; 3]>, Vec<([i32; 3], u32)>);

/// The shape of a face; none if there is nothing of it.
pub fn shape(vertices: &[IVec3], extinction: u16, radii: &[f32]) -> Option<Shape> {
    if extinction == 0 {
        return None;
    }
    if vertices.len() <= 2 {
        let mut ends: Vec<_> = vertices.iter().zip(radii).map(|(v, r)| (v.to_array(), r.to_bits())).collect();
        ends.sort_unstable();
        // A line of no length is a sphere of the larger radius, which is the last: bits of floats are in order
        if ends.len() == 2 && ends[0].0 == ends[1].0 {
            ends.remove(0);
        }
        return ends.iter().any(|&(_, bits)| bits != 0).then_some((extinction, Vec::new(), ends));
    }
    let mut triangles = Vec::new();
    for i in 2..vertices.len() {
        let mut corners = [vertices[0], vertices[i - 1], vertices[i]].map(|v| v.to_array());
        let [u, v] = [vertices[i - 1], vertices[i]].map(|p| (p - vertices[0]).to_array().map(i128::from));
        let cross = [1, 2, 0].map(|a| {
            let b = (a + 1) % 3;
            u[a] * v[b] - u[b] * v[a]
        });
        corners.sort_unstable();
        if cross != [0; 3] && !triangles.contains(&corners) {
            triangles.push(corners);
        }
    }
    triangles.sort_unstable();
    (!triangles.is_empty()).then_some((extinction, triangles, Vec::new()))
}

/// How often every shape is in the streams, on the lattice; and how many faces are nothing.
pub fn expected(scene: &[Grids], lattice: &Lattice, shifts: &[u8]) -> (BTreeMap<Shape, u32>, u64) {
    let (mut shapes, mut nothing) = (BTreeMap::new(), 0);
    for (grids, &shift) in scene.iter().zip(shifts) {
        for grid in &grids.grids {
            for face in grid.faces() {
                let vertices: Vec<IVec3> =
                    face.iter().map(|&v| lattice.snap(grid.position(usize::from(v)), shift)).collect();
                let value = |column: usize, v: u8| grid.unit_value(&grids.schema, column, usize::from(v), 0);
                let radii: Vec<f32> = face
                    .iter()
                    .map(|&v| f64::from(value(0, v)) / lattice.step())
                    .map(|r| if r > 0.0 { r as f32 } else { 0.0 })
                    .collect();
                let opacity: f32 = face.iter().map(|&v| value(1, v)).sum::<f32>() / face.len() as f32;
                match shape(&vertices, extinction_from_opacity(opacity), &radii) {
                    Some(shape) => *shapes.entry(shape).or_default() += 1,
                    None => nothing += 1,
                }
            }
        }
    }
    (shapes, nothing)
}

/// An error's message, for tests of texts.
pub fn message(result: Result<impl std::fmt::Debug>) -> String {
    result.map_err(|error: Error| error.to_string()).unwrap_err()
}
