//! What the tests share: streams in memory, meshes with known answers, and the shortest way from both to coefficients.

pub mod postgres;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use engine::batch::Point;
use engine::brick::lanes::InstructionSet;
use engine::brickmap::{BrickMap, BuildOptions, FarField, OccluderStream, build};
use engine::cut::{Arena, Lod};
use engine::scene::ShOcclusion;
use engine::stream::{Attribute, Microgrid, MicrogridStream, Schema, ValueType};
use engine::trace::{Shading, SphericalTracer, TraceOptions};
use glam::{DMat3, DVec3, Vec3};

/// A stream in memory.
#[derive(Clone, Debug, Default)]
pub struct MemoryStream {
    /// Its schema.
    pub schema: Schema,
    /// Its grids.
    pub grids: Vec<Microgrid>,
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

impl MemoryStream {
    /// An empty stream with `radius` and `opacity` per vertex.
    pub fn new() -> Self {
        let attributes = vec![
            Attribute::vertex("radius", ValueType::F32, 1),
            Attribute::vertex("opacity", ValueType::F32, 1),
        ];
        Self { schema: Schema { attributes, ..Schema::default() }, grids: Vec::new(), next: 0 }
    }

    /// Adds a grid of vertices and faces, with one radius and one opacity for all vertices.
    pub fn push(&mut self, vertices: &[DVec3], faces: &[&[u8]], radius: f32, opacity: f32) {
        let mut grid = Microgrid::default();
        grid.clear(2);
        grid.anchor = vertices[0];
        grid.positions.extend(vertices.iter().map(|&v| (v - vertices[0]).as_vec3()));
        faces.iter().for_each(|face| grid.push_face(face));
        let count = vertices.len();
        grid.push_values(&self.schema.attributes[0], 0, &vec![radius; count]);
        grid.push_values(&self.schema.attributes[1], 1, &vec![opacity; count]);
        grid.validate(&self.schema).expect("a test's grid is valid");
        self.grids.push(grid);
    }

    /// Adds a parallelogram from `corner` along `u` and `v`, `cells` x `cells` quads, in grids of at most 15 x 15.
    pub fn push_sheet(&mut self, corner: DVec3, u: DVec3, v: DVec3, cells: usize, opacity: f32) {
        let at = |i: usize, j: usize| corner + u * (i as f64 / cells as f64) + v * (j as f64 / cells as f64);
        self.push_surface(cells, cells, opacity, at);
    }

    /// Adds the surface `at(i, j)`, 0 <= i <= `columns`, 0 <= j <= `rows`, in grids of at most 15 x 15 quads.
    pub fn push_surface(
        &mut self,
        columns: usize,
        rows: usize,
        opacity: f32,
        at: impl Fn(usize, usize) -> DVec3,
    ) {
        for i0 in (0..columns).step_by(15) {
            for j0 in (0..rows).step_by(15) {
                let (w, h) = ((columns - i0).min(15), (rows - j0).min(15));
                let vertices: Vec<DVec3> = (0..=h)
                    .flat_map(|j| (0..=w).map(move |i| (i, j)))
                    .map(|(i, j)| at(i0 + i, j0 + j))
                    .collect();
                let index = |i: usize, j: usize| (j * (w + 1) + i) as u8;
                let faces: Vec<[u8; 4]> = (0..h)
                    .flat_map(|j| (0..w).map(move |i| (i, j)))
                    .map(|(i, j)| [index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)])
                    .collect();
                let faces: Vec<&[u8]> = faces.iter().map(|face| &face[..]).collect();
                self.push(&vertices, &faces, 0.0, opacity);
            }
        }
    }

    /// Adds a sphere of `cells` x 2 `cells` quads.
    pub fn push_sphere(&mut self, center: DVec3, radius: f64, cells: usize, opacity: f32) {
        self.push_surface(2 * cells, cells, opacity, |i, j| {
            let (phi, theta) = (
                std::f64::consts::PI * (i % (2 * cells)) as f64 / cells as f64,
                std::f64::consts::PI * j as f64 / cells as f64,
            );
            center + radius * DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
        });
    }

    /// Adds a room of 2 units in each direction about the origin, its walls of `cells` x `cells` quads, turned by `tilt`
    /// radians about two axes; returns the turn.
    pub fn push_room(&mut self, tilt: f64, cells: usize) -> DMat3 {
        let turn = DMat3::from_rotation_z(tilt) * DMat3::from_rotation_x(0.7 * tilt);
        for axis in 0..3 {
            let (n, u, v) = (turn.col(axis), turn.col((axis + 1) % 3), turn.col((axis + 2) % 3));
            for side in [-1.0, 1.0] {
                self.push_sheet(side * n - u - v, 2.0 * u, 2.0 * v, cells, 1.0);
            }
        }
        turn
    }

    /// Moves everything.
    pub fn translate(&mut self, by: DVec3) {
        self.grids.iter_mut().for_each(|grid| grid.anchor += by);
    }
}

/// How a test traces; [`Default`] is full detail on all instruction sets' best with one thread.
#[derive(Clone, Copy, Debug)]
pub struct Setup {
    /// Level of detail.
    pub lod: Lod,
    /// Threads.
    pub threads: usize,
    /// Inner loops.
    pub instructions: InstructionSet,
    /// Bytes of the arena.
    pub arena_bytes: u64,
    /// Metres per unit.
    pub meters_per_unit: f64,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            lod: Lod::Off,
            threads: 1,
            instructions: InstructionSet::detect(),
            arena_bytes: 1 << 28,
            meters_per_unit: 1.0,
        }
    }
}

/// Builds the brick map of `occluders`, with the paper's far field, into `folder`.
pub fn build_map(occluders: &mut [&mut dyn MicrogridStream], folder: &Path) -> Arc<BrickMap> {
    build_map_with(occluders, FarField::Paper, folder)
}

/// Builds the brick map of `occluders` into `folder`.
pub fn build_map_with(
    occluders: &mut [&mut dyn MicrogridStream],
    far_field: FarField,
    folder: &Path,
) -> Arc<BrickMap> {
    let scratch = tempfile::tempdir().expect("a temporary folder");
    let options = BuildOptions {
        memory_bytes: 256 << 20,
        threads: 2,
        scratch: scratch.path().to_path_buf(),
        far_field,
    };
    let target = folder.join("map");
    let mut streams: Vec<OccluderStream<'_>> =
        occluders.iter_mut().map(|stream| OccluderStream::once(&mut **stream)).collect();
    build(&mut streams, &options, &target, &|_, _| {}, &AtomicBool::new(false)).expect("the map builds");
    Arc::new(BrickMap::open(&target).expect("the map opens"))
}

/// The coefficients at `points`, one vector a point. Points lie on occluder `geometry` of the map, if on any.
pub fn trace(
    map: &Arc<BrickMap>,
    points: &[(DVec3, Vec3)],
    shader: &ShOcclusion,
    geometry: Option<usize>,
    setup: Setup,
) -> Vec<Vec<f32>> {
    let arena = Arena::new(map.clone(), setup.arena_bytes, setup.lod == Lod::Off).expect("the arena fits");
    let options =
        TraceOptions { lod: setup.lod, seed: 1, threads: setup.threads, instructions: setup.instructions };
    let mut tracer = SphericalTracer::new(arena, options, setup.meters_per_unit);
    let shading = Shading::new(shader, 1, "test", geometry.map_or(0, |g| map.shift(g)));
    let points: Vec<Point> = points
        .iter()
        .enumerate()
        .map(|(index, &(position, normal))| Point { index: index as u64, position, normal })
        .collect();
    let mut out = vec![0.0; points.len() * shading.coefficients()];
    tracer.trace(&points, &shading, &AtomicBool::new(false), &mut out).expect("the batch traces");
    out.chunks(shading.coefficients()).map(<[f32]>::to_vec).collect()
}

/// About `count` points on the vertices of a stream, evenly spaced in its order, with its normals.
pub fn points_of(stream: &mut dyn MicrogridStream, count: usize) -> Vec<(DVec3, Vec3)> {
    let schema = stream.schema().clone();
    let normal = schema.attributes.iter().position(|attribute| attribute.name == "N").expect("normals");
    let (mut grid, mut points) = (Microgrid::default(), Vec::new());
    stream.rewind().expect("the stream rewinds");
    while stream.next(&mut grid).expect("the stream reads") {
        points.extend((0..grid.vertex_count()).map(|v| (grid.position(v), grid.vec3(&schema, normal, v))));
    }
    let step = (points.len() / count).max(1);
    points.into_iter().step_by(step).collect()
}

/// The folder of real geometry, if it is there; says so if it is not.
pub fn assets() -> Option<std::path::PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/assets");
    let folder = std::env::var_os("PANTARAY_ASSETS").map_or(beside, std::path::PathBuf::from);
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("skipped: no folder of real geometry; set PANTARAY_ASSETS");
    None
}
