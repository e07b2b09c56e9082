//! The scenes that are compared, by class.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use engine::import::{Copies, GridSink, ImportOptions, import};
use engine::scene::{Procedural, ProceduralKind, UpAxis};
use engine::stream::procedural::ProceduralStream;
use engine::stream::{Microgrid, MicrogridStream, Schema};
use glam::{DVec3, Vec3};

/// Every scene's name, and what it stands for.
pub const SCENES: [(&str, &str); 8] = [
    ("parts", "machine parts, unstructured triangles (robots_obj)"),
    ("tree", "a leafy tree of large triangles (trees_eztree)"),
    ("knot", "a dense closed surface: a bumpy knot of 400 k quads"),
    ("hall", "architecture: a hall of columns, closed"),
    ("terrain", "bare ground, 1 M quads"),
    ("foliage1m", "jungle, 0.5 M quads: 1 M triangles"),
    ("foliage10m", "jungle, 5 M quads: 10 M triangles"),
    ("foliage50m", "jungle, 25 M quads: 50 M triangles"),
];

/// A stream in memory.
#[derive(Default)]
pub struct MemoryStream {
    schema: Schema,
    grids: Vec<Microgrid>,
    next: usize,
}

impl MicrogridStream for MemoryStream {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> engine::Result<()> {
        self.next = 0;
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> engine::Result<bool> {
        let Some(source) = self.grids.get(self.next) else { return Ok(false) };
        grid.clone_from(source);
        self.next += 1;
        Ok(true)
    }
}

impl GridSink for MemoryStream {
    fn begin(&mut self, _: &Schema, _: &[(String, String)]) -> engine::Result<()> {
        Ok(())
    }

    /// The files that are compared place nothing twice.
    fn copies(&mut self, _: &Copies) -> engine::Result<()> {
        Err(engine::Error::unsupported("copies are not compared"))
    }

    /// Takes the triangles and quads: geometry alone, and opaque, since that is what both sides are given.
    fn grid(&mut self, grid: &Microgrid) -> engine::Result<()> {
        let mut bare =
            Microgrid { anchor: grid.anchor, positions: grid.positions.clone(), ..Microgrid::default() };
        grid.faces().filter(|face| face.len() >= 3).for_each(|face| bare.push_face(face));
        if bare.face_count() > 0 {
            self.grids.push(bare);
        }
        Ok(())
    }
}

impl MemoryStream {
    /// Adds the surface `at(i, j)` of `columns` x `rows` quads, in grids of at most 15 x 15.
    fn push_surface(&mut self, columns: usize, rows: usize, at: impl Fn(usize, usize) -> DVec3) {
        for (i0, j0) in (0..columns).step_by(15).flat_map(|i| (0..rows).step_by(15).map(move |j| (i, j))) {
            let (across, down) = ((columns - i0).min(15), (rows - j0).min(15));
            let mut grid = Microgrid { anchor: at(i0, j0), ..Microgrid::default() };
            for j in 0..=down {
                let row = (0..=across).map(|i| (at(i0 + i, j0 + j) - grid.anchor).as_vec3());
                let row: Vec<Vec3> = row.collect();
                grid.positions.extend(row);
            }
            let wide = across + 1;
            for first in (0..down).flat_map(|j| (0..across).map(move |i| j * wide + i)) {
                grid.push_face(&[first, first + 1, first + wide + 1, first + wide].map(|v| v as u8));
            }
            self.grids.push(grid);
        }
    }

    /// A rectangle of `cells` quads a side.
    fn push_sheet(&mut self, corner: DVec3, u: DVec3, v: DVec3, cells: [usize; 2]) {
        self.push_surface(cells[0], cells[1], |i, j| {
            corner + u * (i as f64 / cells[0] as f64) + v * (j as f64 / cells[1] as f64)
        });
    }
}

/// The scene of the given name; none if its files are not there.
pub fn scene(name: &str, assets: Option<&Path>) -> Option<Box<dyn MicrogridStream>> {
    let jungle = |quads| procedural(ProceduralKind::Jungle, quads);
    Some(match name {
        "parts" => Box::new(imported(&assets?.join("robots_obj"), "obj")?),
        "tree" => Box::new(imported(&assets?.join("trees_eztree"), "oak_large.glb")?),
        "knot" => Box::new(knot()),
        "hall" => Box::new(hall()),
        "terrain" => procedural(ProceduralKind::Terrain, 1_000_000),
        "foliage1m" => jungle(500_000),
        "foliage10m" => jungle(5_000_000),
        "foliage50m" => jungle(25_000_000),
        _ => return None,
    })
}

fn procedural(kind: ProceduralKind, micropolygons: u64) -> Box<dyn MicrogridStream> {
    let parameters = Procedural { kind, seed: 1, micropolygons };
    Box::new(ProceduralStream::new(&parameters, 1.0, UpAxis::Y).expect("the scene can be made"))
}

/// All files of a folder whose names end as given.
fn imported(folder: &Path, end: &str) -> Option<MemoryStream> {
    let mut files: Vec<_> = std::fs::read_dir(folder).ok()?.filter_map(|e| Some(e.ok()?.path())).collect();
    files.retain(|path| path.to_string_lossy().ends_with(end));
    files.sort();
    let mut stream = MemoryStream::default();
    for file in &files {
        import(file, &ImportOptions::default(), &mut stream).ok()?;
    }
    (!stream.grids.is_empty()).then_some(stream)
}

/// A torus knot with bumps: dense, closed, with much of itself in the way.
fn knot() -> MemoryStream {
    let mut stream = MemoryStream::default();
    let spine = |t: f64| {
        let (p, q) = (2.0 * t, 3.0 * t);
        DVec3::new((2.0 + q.cos()) * p.cos(), (2.0 + q.cos()) * p.sin(), q.sin())
    };
    let (around, along) = (200, 2000);
    stream.push_surface(around, along, |i, j| {
        let (a, t) = (TAU * (i % around) as f64 / around as f64, TAU * (j % along) as f64 / along as f64);
        let tangent = (spine(t + 1e-4) - spine(t - 1e-4)).normalize();
        let side = tangent.cross(DVec3::Z).normalize();
        let radius = 0.45 + 0.03 * (9.0 * a).sin() * (90.0 * t).cos();
        spine(t) + radius * (a.cos() * side + a.sin() * tangent.cross(side))
    });
    stream
}

/// A closed hall with two rows of fluted columns, at an angle to the axes.
fn hall() -> MemoryStream {
    let mut stream = MemoryStream::default();
    let (x, y) = (DVec3::new(0.8, 0.6, 0.0), DVec3::new(-0.6, 0.8, 0.0));
    let (length, width, height) = (30.0, 12.0, 8.0);
    let up = DVec3::Z * height;
    for z in [0.0, height] {
        stream.push_sheet(DVec3::Z * z, x * length, y * width, [300, 120]);
    }
    for offset in [0.0, width] {
        stream.push_sheet(y * offset, x * length, up, [300, 80]);
    }
    for offset in [0.0, length] {
        stream.push_sheet(x * offset, y * width, up, [120, 80]);
    }
    for column in 0..16 {
        let foot = x * (2.0 + 3.7 * f64::from(column / 2)) + y * (3.0 + 6.0 * f64::from(column % 2));
        stream.push_surface(120, 100, |i, j| {
            let angle = TAU * (i % 120) as f64 / 120.0;
            let radius = 0.5 + 0.04 * (20.0 * angle).cos() + 0.1 * (PI * j as f64 / 50.0).cos().powi(8);
            foot + radius * (angle.cos() * x + angle.sin() * y) + up * (j as f64 / 100.0)
        });
    }
    stream
}
