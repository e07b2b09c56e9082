//! One grid's way into a frame: placed before the camera, shaded where it may be seen, and drawn face by face.

use glam::Vec3;

use super::raster::{Brush, FaceId, Paint, Rows};
use super::transfer::Transfer;
use super::view::{STEPS, Vertex, View};
use crate::Result;
use crate::math::hash::combine;
use crate::scene::Domain;
use crate::shade::sh::COEFFICIENTS_MAX;
use crate::stream::microgrid::decode;
use crate::stream::schema::names;
use crate::stream::{Microgrid, MicrogridStream, Rate, Schema};

/// Grids that are read before they are prepared and drawn by all threads.
const GRIDS_PER_BATCH: usize = 256;

/// Reflectance of streams that carry none (design, section 8).
pub const ALBEDO_DEFAULT: f32 = 0.5;

/// Radiance beyond this comes from broken coefficients, and sums of it would overflow.
const RADIANCE_MAX: f32 = 1e30;

/// Points are drawn at least this wide, so that a cloud of them is a surface: pixels of radius.
const POINT_RADIUS_MIN_PIXELS: f32 = 1.0;

/// Lines are drawn at least this wide: pixels of radius.
const LINE_RADIUS_MIN_PIXELS: f32 = 0.5;

/// How vertices get their colour.
pub enum Shading {
    /// By the light that they reflect.
    Lit(Lit),
    /// By an attribute's own values, of this column: one is a grey, the first three of several are a colour.
    Shown(usize),
}

impl Shading {
    /// The column of the attribute that is drawn.
    pub fn column(&self) -> usize {
        match self {
            Self::Lit(lit) => lit.column,
            Self::Shown(column) => *column,
        }
    }
}

/// How light becomes colour.
pub struct Lit {
    /// From visibility to radiance.
    pub transfer: Transfer,
    /// The column of visibility coefficients.
    pub column: usize,
    /// Where visibility was sampled: over the sphere, faces are lit from the side that the camera sees.
    pub domain: Domain,
}

/// Which columns of a stream matter to a picture.
pub struct Columns {
    normal: Option<usize>,
    radius: Option<usize>,
    opacity: Option<usize>,
    albedo: Option<usize>,
    baked: Option<usize>,
}

impl Columns {
    /// Finds the standard attributes.
    pub fn new(schema: &Schema) -> Self {
        Self {
            normal: schema.find(names::NORMAL),
            radius: schema.find(names::RADIUS),
            opacity: schema.find(names::OPACITY),
            albedo: schema.find(names::ALBEDO),
            baked: schema.find(names::BAKED),
        }
    }

    /// Whether a vertex holds what was baked; all do unless the stream marks some.
    pub fn is_baked(&self, schema: &Schema, grid: &Microgrid, vertex: usize) -> bool {
        self.baked.is_none_or(|column| grid.value(schema, column, vertex, 0) != 0.0)
    }
}

/// A grid and what drawing it needs. Keeps its memory from grid to grid.
#[derive(Default)]
struct Slot {
    grid: Microgrid,
    number: u32,
    seen: bool,
    vertices: Vec<Vertex>,
    baked: Vec<bool>,
    radii: Vec<f32>,
    normals: Vec<Vec3>,
    /// First and last row that the grid may touch.
    rows: [usize; 2],
}

/// What was drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Drawn {
    /// Grids read.
    pub grids: u64,
    /// Grids that the camera's view may hold.
    pub grids_in_view: u64,
    /// Faces of those.
    pub faces: u64,
    /// Faces left out because a vertex of theirs was not baked.
    pub faces_unbaked: u64,
}

/// Draws the whole stream into `samples`, a frame of the view's size, on all threads of the current pool.
///
/// # Errors
/// When the stream cannot be read.
pub fn draw<P: Paint>(
    stream: &mut dyn MicrogridStream,
    view: &View,
    shading: Option<&Shading>,
    samples: &mut [super::raster::Sample<P>],
    progress: &mut dyn FnMut(f64),
) -> Result<Drawn> {
    use rayon::prelude::*;
    let schema = stream.schema().clone();
    let columns = Columns::new(&schema);
    let mut slots: Vec<Slot> = (0..GRIDS_PER_BATCH).map(|_| Slot::default()).collect();
    let mut drawn = Drawn::default();
    let threads = rayon::current_num_threads();
    // More runs than threads, since the scene is not spread evenly over the picture.
    let runs = if threads == 1 { 1 } else { 3 * threads };
    let rows_per_run = view.height.div_ceil(runs);
    loop {
        // Read a batch
        let mut count = 0;
        while count < slots.len() && stream.next(&mut slots[count].grid)? {
            slots[count].number = drawn.grids as u32;
            drawn.grids += 1;
            count += 1;
        }
        if count == 0 {
            return Ok(drawn);
        }
        let batch = &mut slots[..count];

        // Place and shade
        batch.par_iter_mut().for_each(|slot| slot.prepare(&schema, &columns, view, shading));

        // Draw into runs of rows, each in the stream's order
        samples.par_chunks_mut(rows_per_run * view.width).enumerate().for_each(|(run, samples)| {
            let mut rows = Rows { first: run * rows_per_run, width: view.width, samples };
            let mut scratch = Scratch::default();
            for slot in batch.iter().filter(|slot| slot.seen) {
                slot.draw(&schema, &columns, view, &mut rows, &mut scratch);
            }
        });
        for slot in batch.iter() {
            let faces = slot.grid.face_count() as u64;
            drawn.grids_in_view += u64::from(slot.seen);
            drawn.faces += if slot.seen { faces } else { 0 };
            if slot.seen && columns.baked.is_some() {
                let unbaked = |face: &&[u8]| face.iter().any(|&v| !slot.baked[usize::from(v)]);
                drawn.faces_unbaked += slot.grid.faces().filter(unbaked).count() as u64;
            }
        }
        progress(stream.progress());
    }
}

/// A radiance that can be drawn: negative values are the basis ringing; what is not finite would spread to whole pixels.
fn drawable(value: f32) -> f32 {
    if value > 0.0 && value < RADIANCE_MAX { value } else { 0.0 }
}

/// Memory for clipping.
#[derive(Default)]
struct Scratch {
    polygon: Vec<Vertex>,
    spare: Vec<Vertex>,
}

impl Slot {
    /// Places the vertices before the camera and, when any may be seen, colours them.
    fn prepare(&mut self, schema: &Schema, columns: &Columns, view: &View, shading: Option<&Shading>) {
        let grid = &self.grid;
        let count = grid.vertex_count();
        let (axes, origin) = view.place(grid.anchor);
        self.vertices.clear();
        self.vertices
            .extend(grid.positions.iter().map(|&p| Vertex { at: axes * p + origin, ..Vertex::default() }));
        self.radii.clear();
        if let Some(column) = columns.radius {
            self.radii.extend((0..count).map(|vertex| {
                let radius = grid.value(schema, column, vertex, 0);
                if radius.is_finite() { radius.max(0.0) } else { 0.0 }
            }));
        }

        // Leave when all vertices are beyond the same side of the view
        let radius = self.radii.iter().copied().fold(0.0, f32::max);
        let outside = self.vertices.iter().fold(u8::MAX, |all, vertex| all & view.outside(vertex.at, radius));
        self.seen = outside == 0 && count > 0;
        if !self.seen {
            return;
        }
        self.baked.clear();
        self.baked.extend((0..count).map(|vertex| columns.is_baked(schema, grid, vertex)));
        self.vertices.iter_mut().for_each(|vertex| view.project(vertex));
        self.find_rows(view, radius);
        match shading {
            Some(Shading::Lit(lit)) => self.shade(schema, columns, view, lit),
            Some(Shading::Shown(column)) => self.show(schema, *column),
            None => {}
        }
    }

    /// The rows that the grid may touch: all of them once a vertex has to be clipped.
    fn find_rows(&mut self, view: &View, radius: f32) {
        let (mut low, mut high) = (i64::MAX, i64::MIN);
        for vertex in &self.vertices {
            if vertex.inverse_depth == 0.0 {
                self.rows = [0, view.height];
                return;
            }
            let splat = (radius * view.samples_per_unit(vertex.inverse_depth)).min(1e6);
            let reach = (splat + 2.0 + POINT_RADIUS_MIN_PIXELS * view.supersampling as f32) as i64;
            let row = i64::from(vertex.screen[1] / STEPS);
            (low, high) = (low.min(row - reach), high.max(row + reach));
        }
        self.rows = [low.max(0) as usize, high.max(0) as usize];
    }

    /// Colours vertices by the values of a column.
    fn show(&mut self, schema: &Schema, column: usize) {
        let components = usize::from(schema.attributes[column].components);
        for (index, vertex) in self.vertices.iter_mut().enumerate().filter(|(index, _)| self.baked[*index]) {
            vertex.rgb = std::array::from_fn(|i| {
                let component = if components == 1 { 0 } else { i };
                let is_there = component < components;
                drawable(if is_there { self.grid.unit_value(schema, column, index, component) } else { 0.0 })
            });
        }
    }

    fn shade(&mut self, schema: &Schema, columns: &Columns, view: &View, shading: &Lit) {
        let grid = &self.grid;
        let to_world = view.axes();
        if columns.normal.is_none() {
            face_normals(grid, &mut self.normals);
        }
        let attribute = &schema.attributes[shading.column];
        let (bytes, components) = (&grid.columns[shading.column], usize::from(attribute.components));
        let mut visibility = [0.0; COEFFICIENTS_MAX];
        for (index, vertex) in self.vertices.iter_mut().enumerate() {
            if !self.baked[index] {
                continue;
            }
            let first = if attribute.rate == Rate::Vertex { index * components } else { 0 };
            for (i, value) in visibility[..components].iter_mut().enumerate() {
                *value = decode(attribute.value_type, bytes, first + i);
            }
            let normal = match columns.normal {
                Some(column) => grid.vec3(schema, column, index),
                None => self.normals[index],
            };
            let length = normal.length();
            // Lengths are 1 but for rounding in half precision; a zero vector says that there is no normal.
            let normal = (length.is_finite() && length > 1e-3).then(|| normal / length);
            let normal = normal.map(|n| {
                let away = shading.domain == Domain::Sphere && n.dot(to_world * vertex.at) > 0.0;
                if away { -n } else { n }
            });
            let albedo = match columns.albedo {
                Some(column) => grid.vec3(schema, column, index).to_array(),
                None => [ALBEDO_DEFAULT; 3],
            };
            let white = shading.transfer.radiance(normal, &visibility);
            vertex.rgb = std::array::from_fn(|i| drawable(white[i] * albedo[i]));
        }
    }

    fn draw<P: Paint>(
        &self,
        schema: &Schema,
        columns: &Columns,
        view: &View,
        rows: &mut Rows<P>,
        scratch: &mut Scratch,
    ) {
        let last = rows.first + rows.samples.len() / rows.width;
        if self.rows[0] >= last || self.rows[1] < rows.first {
            return;
        }
        for (number, face) in self.grid.faces().enumerate() {
            if columns.baked.is_some() && face.iter().any(|&v| !self.baked[usize::from(v)]) {
                continue;
            }
            let opacity = match columns.opacity {
                Some(column) => {
                    let value = |&v: &u8| self.grid.unit_value(schema, column, usize::from(v), 0);
                    face.iter().map(value).sum::<f32>() / face.len() as f32
                }
                None => 1.0,
            };
            if opacity <= 0.0 || opacity.is_nan() {
                continue;
            }
            let salt = if opacity < 1.0 { combine(self.number, number as u32) } else { 0 };
            let id = FaceId { grid: self.number, face: number as u32 };
            let brush = Brush { id, salt, opacity };
            let vertex = |corner: usize| &self.vertices[usize::from(face[corner])];
            match face.len() {
                1 => self.draw_point(usize::from(face[0]), POINT_RADIUS_MIN_PIXELS, brush, view, rows),
                2 => self.draw_line([face[0], face[1]].map(usize::from), brush, view, rows, scratch),
                3 => draw_polygon([vertex(0), vertex(1), vertex(2)], brush, view, rows, scratch),
                _ => {
                    // Quads are split v0-v2 (design, section 6).
                    draw_polygon([vertex(0), vertex(1), vertex(2)], brush, view, rows, scratch);
                    draw_polygon([vertex(0), vertex(2), vertex(3)], brush, view, rows, scratch);
                }
            }
        }
    }

    fn radius(&self, vertex: usize) -> f32 {
        self.radii.get(vertex).copied().unwrap_or(0.0)
    }

    fn draw_point<P: Paint>(
        &self,
        at: usize,
        pixels_min: f32,
        brush: Brush,
        view: &View,
        rows: &mut Rows<P>,
    ) {
        let vertex = &self.vertices[at];
        if vertex.inverse_depth > 0.0 {
            let radius = self.radius(at) * view.samples_per_unit(vertex.inverse_depth);
            rows.disc(vertex, radius.max(pixels_min * view.supersampling as f32), brush);
        }
    }

    /// Draws a line as the quad that its round cone shows to the camera, with discs at thick ends.
    fn draw_line<P: Paint>(
        &self,
        ends: [usize; 2],
        brush: Brush,
        view: &View,
        rows: &mut Rows<P>,
        scratch: &mut Scratch,
    ) {
        let [a, b] = ends.map(|end| &self.vertices[end]);
        let across = (b.at - a.at).cross(0.5 * (a.at + b.at)).normalize_or_zero();
        let thinnest = LINE_RADIUS_MIN_PIXELS * view.supersampling as f32;
        let half = |end: usize, vertex: &Vertex| {
            let thin = thinnest / view.samples_per_unit(1.0 / -vertex.at.z.min(-f32::MIN_POSITIVE));
            across * self.radius(end).max(thin)
        };
        let side = |vertex: &Vertex, offset: Vec3| {
            let mut moved = Vertex { at: vertex.at + offset, ..*vertex };
            view.project(&mut moved);
            moved
        };
        let (at_a, at_b) = (half(ends[0], a), half(ends[1], b));
        let quad = [side(a, at_a), side(a, -at_a), side(b, -at_b), side(b, at_b)];
        draw_polygon([&quad[0], &quad[1], &quad[2]], brush, view, rows, scratch);
        draw_polygon([&quad[0], &quad[2], &quad[3]], brush, view, rows, scratch);
        for end in ends {
            let vertex = &self.vertices[end];
            if self.radius(end) * view.samples_per_unit(vertex.inverse_depth) > 2.0 * thinnest {
                self.draw_point(end, 0.0, brush, view, rows);
            }
        }
    }
}

fn draw_polygon<P: Paint>(
    corners: [&Vertex; 3],
    brush: Brush,
    view: &View,
    rows: &mut Rows<P>,
    scratch: &mut Scratch,
) {
    if corners.iter().all(|corner| corner.inverse_depth > 0.0) {
        rows.triangle(corners, brush);
        return;
    }
    scratch.polygon.clear();
    scratch.polygon.extend(corners.into_iter().copied());
    view.clip(&mut scratch.polygon, &mut scratch.spare);
    for pair in scratch.polygon.windows(2).skip(1) {
        rows.triangle([&scratch.polygon[0], &pair[0], &pair[1]], brush);
    }
}

/// Normals for a grid that carries none: of the faces around a vertex, weighted by area. Zero for points and lines.
fn face_normals(grid: &Microgrid, normals: &mut Vec<Vec3>) {
    normals.clear();
    normals.resize(grid.vertex_count(), Vec3::ZERO);
    for face in grid.faces().filter(|face| face.len() >= 3) {
        let at = |corner: usize| grid.positions[usize::from(face[corner])];
        let last = face.len() - 1;
        let normal = if last == 2 {
            (at(1) - at(0)).cross(at(2) - at(0))
        } else {
            (at(2) - at(0)).cross(at(3) - at(1))
        };
        face.iter().for_each(|&v| normals[usize::from(v)] += normal);
    }
    normals.iter_mut().for_each(|normal| *normal = normal.normalize_or_zero());
}
