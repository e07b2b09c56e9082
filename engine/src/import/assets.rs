//! Tests on real files: every PLY, OBJ, glTF and USD file of the asset folder has the counts and the box of its inventory.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::*;
use crate::math::Bounds;
use crate::stream::schema::names;

/// Checks every grid and gathers what tests ask about.
#[derive(Default)]
pub(super) struct Collect {
    pub schema: Schema,
    pub metadata: Vec<(String, String)>,
    /// Where the prototypes begin in `grids`, and how they are placed.
    pub copies: Vec<(usize, Copies)>,
    pub grids: Vec<Microgrid>,
    pub begun: usize,
}

impl GridSink for Collect {
    fn begin(&mut self, schema: &Schema, metadata: &[(String, String)]) -> Result<()> {
        schema.validate()?;
        self.metadata = metadata.to_vec();
        self.schema = schema.clone();
        self.begun += 1;
        Ok(())
    }

    fn copies(&mut self, copies: &Copies) -> Result<()> {
        self.copies.push((self.grids.len(), copies.clone()));
        Ok(())
    }

    fn grid(&mut self, grid: &Microgrid) -> Result<()> {
        grid.validate(&self.schema)?;
        self.grids.push(grid.clone());
        Ok(())
    }
}

impl Collect {
    pub fn bounds(&self) -> Bounds {
        self.grids.iter().fold(Bounds::EMPTY, |bounds, grid| bounds.union(&grid.bounds()))
    }

    /// Values of a one-component attribute, per vertex.
    pub fn values(&self, name: &str) -> Vec<f32> {
        let Some(column) = self.schema.find(name) else { return Vec::new() };
        let value = |grid: &Microgrid| {
            (0..grid.vertex_count()).map(|v| grid.unit_value(&self.schema, column, v, 0)).collect::<Vec<_>>()
        };
        self.grids.iter().flat_map(value).collect()
    }
}

/// Imports with default options.
pub(super) fn collect(path: &Path) -> Result<(Collect, ImportReport)> {
    let mut sink = Collect::default();
    let report = import(path, &ImportOptions::default(), &mut sink)?;
    Ok((sink, report))
}

/// The folder of real assets, or none with a note.
pub(super) fn folder() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/assets");
    let folder = std::env::var_os("PANTARAY_ASSETS").map_or(beside, PathBuf::from);
    if !folder.join("INVENTORY.csv").is_file() {
        eprintln!("skipped: no real assets; PANTARAY_ASSETS names their folder");
        return None;
    }
    Some(folder)
}

/// A line of the inventory.
struct Listed {
    path: String,
    /// vertices, triangles, quads, n-gons, lines, points
    counts: [u64; 6],
    bounds: Option<Bounds>,
}

fn inventory(folder: &Path) -> Vec<Listed> {
    let text = std::fs::read_to_string(folder.join("INVENTORY.csv")).unwrap();
    let point = |text: &str| -> Option<DVec3> {
        let values: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
        (values.len() == 3).then(|| DVec3::from_slice(&values))
    };
    (text.lines().skip(1))
        .filter_map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            let counts: Vec<u64> = cells.get(2..8)?.iter().filter_map(|cell| cell.parse().ok()).collect();
            let bounds = point(cells[8]).zip(point(cells[9])).map(|(min, max)| Bounds { min, max });
            Some(Listed { path: cells[0].into(), counts: counts.try_into().ok()?, bounds })
        })
        .filter(|listed| !listed.path.starts_with("malformed") && is_importable(Path::new(&listed.path)))
        .collect()
}

/// Needs an extension that cannot be read; must say so.
const UNSUPPORTED: [(&str, &str); 4] = [
    ("rock1.glb", "KHR_draco_mesh_compression"),
    ("rock2.glb", "KHR_draco_mesh_compression"),
    ("rock3.glb", "KHR_draco_mesh_compression"),
    ("grass.glb", "EXT_texture_webp"),
];

/// Catches a face, vertex, line or point that is lost or made up in any real file, or one that moved.
#[test]
fn real_files_have_the_counts_of_their_inventory() {
    let Some(folder) = folder() else { return };
    let mut files = 0;
    let mut failures = Vec::new();
    for listed in inventory(&folder) {
        let path = folder.join(&listed.path);
        let outcome = collect(&path);
        files += 1;
        if let Some((_, extension)) = UNSUPPORTED.iter().find(|(name, _)| listed.path.ends_with(name)) {
            let Err(error) = outcome else { panic!("{}: {extension} was accepted", listed.path) };
            if error.kind() != crate::ErrorKind::Unsupported || !error.message().contains(extension) {
                failures.push(format!("{}: {error}", listed.path));
            }
            continue;
        }
        match outcome {
            Ok((sink, report)) => failures.extend(compare(&listed, &sink, &report)),
            Err(error) => failures.push(format!("{}: {error}", listed.path)),
        }
    }
    eprintln!("{files} real files");
    assert!(
        files > 150 && failures.is_empty(),
        "{} failures of {files}:\n{}",
        failures.len(),
        failures.join("\n")
    );
}

fn compare(listed: &Listed, sink: &Collect, report: &ImportReport) -> Vec<String> {
    let mut failures = Vec::new();
    let mut check = |what: &str, found: u64, expected: u64| {
        if found != expected {
            failures.push(format!("{}: {found} {what}, {expected} listed", listed.path));
        }
    };
    let source = report.source;
    let [vertices, triangles, quads, ngons, lines, points] = listed.counts;
    // The inventory's loader turned faces of PLY into triangles and does not list the vertices of point clouds
    if listed.path.ends_with(".ply") {
        check("triangles", source.triangles + 2 * source.quads, triangles);
        check("vertices", source.vertices, vertices.max(points));
    } else {
        check("vertices", source.vertices, vertices);
        check("triangles", source.triangles, triangles);
        check("quads", source.quads, quads);
    }
    check("n-gons", source.ngons, ngons);
    check("lines", source.lines, lines);
    check("points", source.points, points);
    let dropped: u64 = report.skipped.iter().map(|skip| skip.1).sum();
    if let Some(units) = sink.metadata.iter().find(|(key, _)| key == "usd.metersPerUnit") {
        return failures.into_iter().chain(compare_box(listed, sink, units.1.parse().unwrap())).collect();
    }
    if ngons == 0 {
        let faces = source.triangles + source.quads + source.lines + source.points;
        check("faces after import", report.micropolygons + dropped, faces);
    }
    let found = sink.bounds();
    if let Some(bounds) = listed.bounds {
        let off = (found.min - bounds.min).abs().max((found.max - bounds.max).abs()).max_element();
        // Six digits are listed
        let largest = bounds.min.abs().max(bounds.max.abs()).max_element();
        if dropped == 0 && off > 1e-5 * largest {
            failures.push(format!("{}: box {found:?}, {bounds:?} listed", listed.path));
        }
    }
    if sink.schema.find(names::NORMAL).is_some() && points == 0 && lines == 0 {
        let column = sink.schema.find(names::NORMAL).unwrap();
        let unit = |grid: &Microgrid, v| (grid.vec3(&sink.schema, column, v).length() - 1.0).abs() < 1e-4;
        if !sink.grids.iter().all(|grid| (0..grid.vertex_count()).all(|v| unit(grid, v))) {
            failures.push(format!("{}: normals that are not of unit length", listed.path));
        }
    }
    failures
}

/// Whether a USD file's box lies in the one listed, in the file's own units. That one is a box about the transformed boxes
/// of prims, or what they claim to be their extent.
fn compare_box(listed: &Listed, sink: &Collect, meters_per_unit: f64) -> Option<String> {
    use crate::stream::adapt::MatrixSource;
    let expected = listed.bounds?;
    let (mut found, mut rotated) = (Bounds::EMPTY, Bounds::EMPTY);
    let end = |i: usize| sink.copies.get(i).map_or(sink.grids.len(), |(start, _)| *start);
    let mut add = |p: DVec3| {
        found.add(p / meters_per_unit);
        // Stages with +z up are listed as they stand
        rotated.add(DVec3::new(p.x, -p.z, p.y) / meters_per_unit);
    };
    let vertices = |grid: &Microgrid| (0..grid.vertex_count()).map(|v| grid.position(v)).collect::<Vec<_>>();
    sink.grids[..end(0)].iter().flat_map(vertices).for_each(&mut add);
    for (i, (start, copies)) in sink.copies.iter().enumerate() {
        let prototype: Vec<DVec3> = sink.grids[*start..end(i + 1)].iter().flat_map(vertices).collect();
        let mut copies = copies.clone();
        while let Some(matrix) = copies.next().unwrap() {
            prototype.iter().for_each(|&p| add(matrix.transform_point3(p)));
        }
    }
    let largest = expected.min.abs().max(expected.max.abs()).max_element();
    let outside = |b: &Bounds| (expected.min - b.min).max(b.max - expected.max).max_element().max(0.0);
    let off = if found.is_empty() { 0.0 } else { outside(&found).min(outside(&rotated)) };
    // Files that test readers with wrong extents
    let lies = listed.path.contains("/extent/");
    (!lies && off > 1e-5 * largest).then(|| format!("{}: box {found:?}, {expected:?} listed", listed.path))
}

/// Catches coordinates millions of units from the origin that lose their decimals, or differ between grids.
#[test]
fn far_terrain_keeps_its_decimals() {
    let Some(folder) = folder() else { return };
    let path = folder.join("terrain_dem/terrain_far_quads.obj");
    let (sink, report) = collect(&path).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let vertices = text.lines().filter_map(|line| line.strip_prefix("v "));
    // Coordinates have three decimals: as integers of a tenth of a millimetre they can be looked up
    let key = |p: DVec3| (p * 1000.0).round().to_array().map(|x| x as i64);
    let listed: std::collections::BTreeMap<[i64; 3], DVec3> = vertices
        .map(|line| {
            let values: Vec<f64> = line.split_whitespace().map(|word| word.parse().unwrap()).collect();
            let p = DVec3::from_slice(&values);
            (key(p), p)
        })
        .collect();
    let mut stored = std::collections::BTreeMap::new();
    let mut worst = 0.0_f64;
    for grid in &sink.grids {
        for vertex in 0..grid.vertex_count() {
            let p = grid.position(vertex);
            let original = listed.get(&key(p)).unwrap_or_else(|| panic!("{p} is not in the file"));
            worst = worst.max((p - *original).abs().max_element());
            assert_eq!(*stored.entry(key(p)).or_insert(p), p, "a shared vertex differs between grids");
        }
    }
    let sizes: Vec<f64> = sink.grids.iter().map(|grid| grid.bounds().size().max_element()).collect();
    let mean = sizes.iter().sum::<f64>() / sizes.len() as f64;
    let largest = sizes.iter().fold(0.0_f64, |a, &b| a.max(b));
    eprintln!(
        "terrain: {} grids, edges {mean:.0} m, at most {largest:.0}, worst error {worst:.2e} m",
        report.grids
    );
    // Half of the step that a grid of up to 4,096 m is rounded to
    assert!(worst <= 0.5_f64.powi(13), "{worst}");
}

/// Catches leaf cards that turn opaque, vanish, or get the colour of their clear texels.
#[test]
fn leaf_cards_let_light_through() {
    let Some(folder) = folder() else { return };
    for name in ["trees_eztree/oak_medium.glb", "trees_eztree/pine_medium.glb", "pine_gltf/scene.gltf"] {
        let (sink, report) = collect(&folder.join(name)).unwrap();
        let opacities = sink.values(names::OPACITY);
        // Bark is opaque to the last bit: what is not is leaves, but for those of which a card shows all
        let leaves: Vec<f32> = opacities.iter().copied().filter(|&opacity| opacity < 1.0).collect();
        let mean = leaves.iter().sum::<f32>() / leaves.len() as f32;
        let clear = leaves.iter().filter(|&&opacity| opacity == 0.0).count();
        let green = green_share(&sink);
        let faces = report.micropolygons as f64 / report.grids as f64;
        eprintln!(
            "{name}: {} of {} vertices on leaves, opacity {mean:.3}, {clear} clear, {green:.2} green, \
             {} grids of {faces:.0} faces and {:.0} vertices, {:?}",
            leaves.len(),
            opacities.len(),
            report.grids,
            opacities.len() as f64 / report.grids as f64,
            report.warnings
        );
        assert!(leaves.len() > opacities.len() / 8, "{name}: {} leaves", leaves.len());
        assert!((0.1..0.9).contains(&mean), "{name}: {mean}");
        assert!(clear * 4 < leaves.len(), "{name}: {clear} clear");
    }
}

/// The share of vertices with opacity below one whose albedo is more green than blue.
fn green_share(sink: &Collect) -> f64 {
    let (albedo, opacity) =
        (sink.schema.find(names::ALBEDO).unwrap(), sink.schema.find(names::OPACITY).unwrap());
    let (mut leaves, mut green) = (0, 0);
    for grid in &sink.grids {
        for vertex in 0..grid.vertex_count() {
            if grid.unit_value(&sink.schema, opacity, vertex, 0) < 1.0 {
                let rgb = grid.vec3(&sink.schema, albedo, vertex);
                leaves += 1;
                green += u32::from(rgb.y > rgb.z);
            }
        }
    }
    f64::from(green) / f64::from(leaves)
}

/// Catches copies that are lost or doubled: the scenes have the triangles that their sources say, instances expanded.
#[test]
fn scenes_expand_to_what_their_sources_say() {
    let Some(folder) = folder() else { return };
    let twig = 1248 + 2 * 313;
    for (name, triangles, lost) in [
        // A twig of each of the 15 trees has a matrix of zeros
        ("forest_embree/forest_nested.usdc", 139_281_176, 15 * twig),
        // Trees have 222 triangles without area, which 3,000 copies multiply
        ("forest_eztree/forest_pi.usdc", 43_167_922, 39_156),
        // 352 faces of the pieces have no area, those of pawns in each of their copies
        ("chess_usd/chess_set.usda", 1_430_784, 896),
    ] {
        let (sink, report) = collect(&folder.join(name)).unwrap();
        let ends = sink.copies.iter().skip(1).map(|copies| copies.0).chain([sink.grids.len()]);
        let first = sink.copies.first().map_or(sink.grids.len(), |copies| copies.0);
        let count = |grids: &[Microgrid]| -> u64 {
            grids.iter().flat_map(Microgrid::faces).map(|face| face.len() as u64 - 2).sum()
        };
        let prototypes = sink
            .copies
            .iter()
            .zip(ends)
            .map(|((start, copies), end)| count(&sink.grids[*start..end]) * copies.count());
        let found = count(&sink.grids[..first]) + prototypes.sum::<u64>();
        eprintln!("{name}: {found} triangles, {:?}", report.skipped);
        assert_eq!(found + lost, triangles, "{name}: {:?}", report.skipped);
    }
}
