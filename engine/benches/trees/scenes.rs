//! What the trees are measured on.

use engine::math::hash::{hash32, unit_f32};
use engine::scene::{Procedural, ProceduralKind};
use engine::stream::procedural::ProceduralStream;
use engine::stream::schema::UpAxis;
use engine::stream::{Microgrid, MicrogridStream, Schema};
use glam::{DVec3, Vec3};

/// A scene of the benchmark: a stream in memory, without attributes.
pub struct Scene {
    /// Its name in the table.
    pub name: &'static str,
    schema: Schema,
    grids: Vec<Microgrid>,
    next: usize,
}

impl MicrogridStream for Scene {
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

/// Makes the grids of a scene of about so many micropolygons.
type Maker = fn(u64) -> Vec<Microgrid>;

/// All scenes, of about `micropolygons` each.
pub fn all(micropolygons: u64) -> impl Iterator<Item = Scene> {
    let makers: [(&str, Maker); 8] = [
        ("foliage", |n| procedural(ProceduralKind::Jungle, n)),
        ("terrain", |n| procedural(ProceduralKind::Terrain, n)),
        ("meadow", |n| procedural(ProceduralKind::Grass, n)),
        ("4-quad grids", |n| quarters(&procedural(ProceduralKind::Jungle, n))),
        ("soup", |n| soup(&procedural(ProceduralKind::Jungle, n / 2), 1 << 13)),
        ("soup, all shuffled", |n| soup(&procedural(ProceduralKind::Jungle, n / 2), usize::MAX)),
        ("needles", |n| quads(n / 4, |random| [Vec3::splat(30.0) * random(), Vec3::splat(0.02)])),
        ("overlapping", |n| quads(n / 4, |random| [Vec3::splat(0.1 / (0.01 + random().x)); 2])),
    ];
    makers.into_iter().map(move |(name, make)| Scene {
        name,
        schema: Schema::default(),
        grids: make(micropolygons),
        next: 0,
    })
}

/// A procedural stream without its attributes.
fn procedural(kind: ProceduralKind, micropolygons: u64) -> Vec<Microgrid> {
    let parameters = Procedural { kind, seed: 7, micropolygons };
    let mut stream = ProceduralStream::new(&parameters, 1.0, UpAxis::Y).expect("a procedural stream");
    let (mut grids, mut grid) = (Vec::new(), Microgrid::default());
    while stream.next(&mut grid).expect("no I/O") {
        grid.columns.clear();
        grids.push(grid.clone());
    }
    grids
}

/// Calls `each` with the corners of every face.
fn for_each_face(grids: &[Microgrid], mut each: impl FnMut(&[DVec3])) {
    for grid in grids {
        for face in grid.faces() {
            let corners: Vec<DVec3> = face.iter().map(|&v| grid.position(usize::from(v))).collect();
            each(&corners);
        }
    }
}

/// Grids of two by two quads, and of what is left of each grid.
fn quarters(grids: &[Microgrid]) -> Vec<Microgrid> {
    let mut out = Vec::new();
    for grid in grids {
        let faces: Vec<[u8; 4]> = grid.faces().filter_map(|face| face.try_into().ok()).collect();
        let by_edge = |edge: [u8; 2]| faces.iter().position(|face| [face[0], face[1]] == edge);
        let by_side = |side: [u8; 2]| faces.iter().position(|face| [face[0], face[3]] == side);
        let mut taken = vec![false; faces.len()];
        let mut rest = Vec::new();
        for (i, &[_, b, c, d]) in faces.iter().enumerate() {
            if taken[i] {
                continue;
            }
            let block = by_side([b, c]).zip(by_edge([d, c])).and_then(|(right, below)| {
                let corner = by_edge([faces[right][3], faces[right][2]])?;
                let block = [i, right, below, corner];
                block.iter().all(|&face| !taken[face]).then_some(block)
            });
            if let Some(block) = block {
                block.iter().for_each(|&face| taken[face] = true);
                out.push(sub_grid(grid, &block.map(|face| faces[face])));
            } else {
                taken[i] = true;
                rest.push(faces[i]);
            }
        }
        out.extend(rest.chunks(4).map(|faces| sub_grid(grid, faces)));
    }
    out
}

fn sub_grid(grid: &Microgrid, faces: &[[u8; 4]]) -> Microgrid {
    let mut used: Vec<u8> = faces.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    let mut out = Microgrid { anchor: grid.anchor, ..Microgrid::default() };
    out.positions.extend(used.iter().map(|&v| grid.positions[usize::from(v)]));
    for face in faces {
        out.push_face(&face.map(|v| used.binary_search(&v).expect("it is used") as u8));
    }
    out
}

/// The triangles of all quads in a random order within windows of so many, none sharing a vertex.
fn soup(grids: &[Microgrid], window: usize) -> Vec<Microgrid> {
    let mut triangles = Vec::new();
    for_each_face(grids, |corners| {
        triangles.push([corners[0], corners[1], corners[2]]);
        if let [a, _, c, d] = *corners {
            triangles.push([a, c, d]);
        }
    });
    let (mut out, window) = (Vec::new(), window.min(triangles.len()));
    for (number, part) in triangles.chunks_mut(window).enumerate() {
        for i in (1..part.len()).rev() {
            part.swap(i, hash32(i as u32 ^ (number as u32).rotate_left(20)) as usize % (i + 1));
        }
        for triangles in part.chunks(85) {
            let mut grid = Microgrid { anchor: triangles[0][0], ..Microgrid::default() };
            for triangle in triangles {
                let base = grid.positions.len() as u8;
                grid.positions.extend(triangle.map(|corner| (corner - grid.anchor).as_vec3()));
                grid.push_face(&[base, base + 1, base + 2]);
            }
            out.push(grid);
        }
    }
    out
}

/// Quads in a cube of 100 units: `size` gives length and width per axis from random numbers.
fn quads(count: u64, size: impl Fn(&mut dyn FnMut() -> Vec3) -> [Vec3; 2]) -> Vec<Microgrid> {
    let mut state = 0;
    let mut random = || {
        let mut next = || {
            state += 1;
            unit_f32(hash32(state))
        };
        Vec3::new(next(), next(), next())
    };
    let mut out: Vec<Microgrid> = Vec::new();
    for i in 0..count {
        if i % 32 == 0 {
            out.push(Microgrid::default());
        }
        let grid = out.last_mut().expect("pushed above");
        let place = random() * 100.0;
        let direction = (random() - 0.5).normalize();
        let side = direction.cross(random() - 0.5).normalize();
        let [length, width] = size(&mut random);
        let (along, across) = (direction * length, side * width);
        let base = grid.positions.len() as u8;
        grid.positions.extend([place, place + along, place + along + across, place + across]);
        grid.push_face(&[base, base + 1, base + 2, base + 3]);
    }
    out
}
