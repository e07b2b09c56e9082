//! Real geometry: scenes made of files that nobody here made, baked small, and what must hold of every such bake.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use engine::bake::{BakeOptions, Control, Quiet, bake};
use engine::cut::Lod;
use engine::import::{ImportOptions, import_parts};
use engine::scene;
use engine::stats::Report;
use engine::stream::file::{MgsReader, MgsWriter};
use engine::stream::schema::UpAxis;
use engine::stream::{Microgrid, MicrogridStream};
use glam::{DMat4, DVec3};
use tests::assets;

/// V_00 of the open hemisphere, sqrt(pi): what nothing on a surface exceeds by more than its sampling.
const OPEN: f64 = 1.772_453_850_905_516;

/// A scene being written into a folder of its own.
struct Case {
    folder: tempfile::TempDir,
    assets: PathBuf,
    xml: String,
}

impl Case {
    /// Begins a scene, unless there is no real geometry on this machine.
    fn new(units: &str, up: &str) -> Option<Self> {
        let assets = assets()?.canonicalize().expect("the folder of real geometry");
        let xml = format!(
            r#"<scene version="1" units="{units}" up="{up}"><shaders><shader name="occlusion" type="sh_occlusion"/></shaders><geometries>"#
        );
        Some(Self { folder: tempfile::tempdir().expect("a temporary folder"), assets, xml })
    }

    /// Adds an occluder that is also baked, from files below the assets (or absolute paths), with instances if any.
    fn geometry(mut self, name: &str, files: &[&str], instances: &[DMat4]) -> Self {
        let write = "writing to a string";
        write!(self.xml, r#"<geometry name="{name}" occluder="true">"#).expect(write);
        for file in files {
            let path = self.assets.join(file);
            write!(self.xml, r#"<stream file="{}"/>"#, path.display()).expect(write);
        }
        if !instances.is_empty() {
            let mut csv = String::new();
            for matrix in instances {
                csv += &matrix.to_cols_array().map(|number| number.to_string()).join(",");
                csv.push('\n');
            }
            std::fs::write(self.folder.path().join(format!("{name}.csv")), csv).expect("the instance file");
            write!(self.xml, r#"<instances file="{name}.csv"/>"#).expect(write);
        }
        self.xml += &format!(
            r#"<bakeset name="{name}"><attribute name="v" shader="occlusion"/></bakeset></geometry>"#
        );
        self
    }

    /// Bakes it, with about `points_max` points of each set if given.
    fn bake(&self, samples: u32, points_max: Option<u64>) -> Report {
        let path = self.folder.path().join("scene.xml");
        std::fs::write(&path, format!("{}</geometries></scene>", self.xml)).expect("the scene file");
        let scene = scene::load(&path).expect("the scene loads");
        let options = BakeOptions {
            memory_bytes: 256 << 20,
            threads: 2,
            lod: Lod::Off,
            samples: Some(samples),
            points_max,
            ..BakeOptions::default()
        };
        let cancel = AtomicBool::new(false);
        let control = Control { progress: &Quiet, cancel: &cancel };
        bake(&scene, &options, &self.folder.path().join("out"), control).expect("the bake succeeds")
    }

    /// The coefficients of a bake set's baked points, in the stream's order.
    fn coefficients(&self, set: &str) -> Coefficients {
        read(&self.folder.path().join("out").join(format!("{set}.mgs")))
    }
}

/// What a bake set's points got.
struct Coefficients {
    /// Nine numbers a point.
    values: Vec<[f32; 9]>,
    /// Vertices of the stream, baked or not.
    vertices: u64,
    /// Faces of the stream.
    faces: u64,
    /// How many grids carry each number of `instance`.
    instances: Vec<u64>,
}

fn read(path: &Path) -> Coefficients {
    let mut stream = MgsReader::open(path).expect("the result opens");
    let schema = stream.schema().clone();
    let column = schema.find("v").expect("the new attribute");
    let (baked, instance) = (schema.find("baked"), schema.find("instance"));
    assert_eq!(schema.attributes[column].components, 9);
    let mut out = Coefficients { values: Vec::new(), vertices: 0, faces: 0, instances: Vec::new() };
    let mut grid = Microgrid::default();
    while stream.next(&mut grid).expect("the result reads") {
        out.vertices += grid.vertex_count() as u64;
        out.faces += grid.face_count() as u64;
        if let Some(instance) = instance {
            let number = grid.value(&schema, instance, 0, 0) as usize;
            out.instances.resize(out.instances.len().max(number + 1), 0);
            out.instances[number] += 1;
        }
        for vertex in 0..grid.vertex_count() {
            if baked.is_none_or(|baked| grid.value(&schema, baked, vertex, 0) != 0.0) {
                out.values.push(std::array::from_fn(|i| grid.value(&schema, column, vertex, i)));
            }
        }
    }
    out
}

impl Coefficients {
    /// Asserts what holds of every bake, and that V_00 as a share of the open hemisphere's lies in `open` on average
    /// and is nothing at a share of at most `dark` of the points.
    fn assert_sane(&self, what: &str, open: std::ops::Range<f64>, dark: f64) {
        assert!(!self.values.is_empty(), "{what}: nothing was baked");
        for v in &self.values {
            assert!(v.iter().all(|c| c.is_finite()), "{what}: {v:?}");
            // No band can hold more than an indicator of the hemisphere's whole energy, 2 pi
            assert!(v[0] >= 0.0 && f64::from(v[0]) < OPEN * 1.0001, "{what}: V_00 is {}", v[0]);
            assert!(v.iter().map(|c| c * c).sum::<f32>() < 6.4, "{what}: {v:?}");
        }
        let count = self.values.len() as f64;
        let mean = self.values.iter().map(|v| f64::from(v[0])).sum::<f64>() / count / OPEN;
        let zero = self.values.iter().filter(|v| v[0] == 0.0).count() as f64 / count;
        eprintln!("{what}: {count} points, open {mean:.4}, dark {zero:.4}");
        assert!(open.contains(&mean), "{what}: {mean:.4} open on average, expected in {open:?}");
        assert!(zero <= dark, "{what}: {zero:.4} are dark, expected at most {dark}");
    }
}

/// A copy at `place`, turned about the up axis.
fn copy(up: DVec3, place: DVec3, degrees: f64) -> DMat4 {
    DMat4::from_translation(place) * DMat4::from_axis_angle(up, degrees.to_radians())
}

/// The matrices of a list of row-major 3 x 4 matrices, one a line; those of no volume left out.
fn matrices(path: &Path) -> Vec<DMat4> {
    let text = std::fs::read_to_string(path).expect("a list of matrices");
    let rows = text.lines().filter(|line| !line.starts_with('#') && !line.trim().is_empty());
    let matrix = |line: &str| {
        let mut all: Vec<f64> = line.split_whitespace().map(|n| n.parse().expect("a number")).collect();
        all.extend([0.0, 0.0, 0.0, 1.0]);
        DMat4::from_cols_array(&all.try_into().expect("12 numbers")).transpose()
    };
    rows.map(matrix).filter(|matrix| matrix.determinant() != 0.0).collect()
}

/// Catches leaf cards that turn opaque or vanish: crowns are neither as dark as slabs nor as open as bare twigs.
#[test]
fn leaf_cards_of_a_tree() {
    let Some(case) = Case::new("m", "y") else { return };
    let case = case.geometry("oak", &["trees_eztree/oak_small.glb"], &[]);
    let report = case.bake(64, None);
    assert_eq!((report.micropolygons, report.bake.points), (6_775, 13_492));
    assert_eq!(report.skipped, [("occluding faces without area".to_string(), 31)]);
    case.coefficients("oak").assert_sane("oak", 0.45..0.65, 0.02);
}

/// Catches blended cards that occlude fully or not at all, and a gltf whose missing picture stops the bake.
#[test]
fn blended_cards_of_a_pine() {
    let Some(case) = Case::new("m", "y") else { return };
    let case = case.geometry("pine", &["pine_gltf/scene.gltf"], &[]);
    let report = case.bake(128, None);
    assert_eq!(report.bake.points, 4_406);
    case.coefficients("pine").assert_sane("pine", 0.55..0.75, 0.06);
}

/// Catches instances that are lost, doubled or misplaced between an instance file and the result.
#[test]
fn a_forest_of_instances() {
    let Some(case) = Case::new("m", "y") else { return };
    let forest = case.assets.join("forest_embree");
    let trees = matrices(&forest.join("trees_on_ground.txt"));
    let twigs = matrices(&forest.join("twigs_in_tree.txt"));
    assert_eq!((trees.len(), twigs.len()), (15, 4_917));
    let placed: Vec<DMat4> =
        trees[..3].iter().flat_map(|&tree| twigs.iter().step_by(40).map(move |&twig| tree * twig)).collect();
    let case = case
        .geometry("ground", &["forest_embree/ground.obj"], &[])
        .geometry("trees", &["forest_embree/tree.obj"], &trees[..3])
        .geometry("twigs", &["forest_embree/twig.obj"], &placed);
    let report = case.bake(32, Some(20_000));
    let faces = [1_408, 3 * 34_482, 1_561 * placed.len() as u64];
    assert_eq!(report.micropolygons, faces.iter().sum::<u64>());
    for ((set, count), (open, dark)) in ["ground", "trees", "twigs"].into_iter().zip(faces).zip([
        (0.93..1.0, 0.0),
        (0.4..0.6, 0.02),
        (0.35..0.55, 0.12),
    ]) {
        let found = case.coefficients(set);
        assert_eq!(found.faces, count, "{set}");
        found.assert_sane(set, open, dark);
        let copies = match set {
            "ground" => 0,
            "trees" => 3,
            _ => placed.len(),
        };
        assert_eq!(found.instances.len(), copies, "{set}");
        assert!(found.instances.iter().all(|&grids| grids == found.instances[0]), "{set}");
    }
}

/// Catches polygons of many corners and open bodies that bake to black, in centimetres.
#[test]
fn a_crowd_of_characters() {
    let Some(case) = Case::new("cm", "y") else { return };
    let places: Vec<DMat4> = (0..9)
        .map(|i| {
            let place = DVec3::new(f64::from(i % 3) * 700.0, 0.0, f64::from(i / 3) * 500.0);
            copy(DVec3::Y, place, f64::from(i * 47))
        })
        .collect();
    let case = case.geometry("knights", &["quaternius_obj/KnightCharacter.obj"], &places).geometry(
        "suit",
        &["quaternius_obj/Smooth_Male_Suit.obj"],
        &[copy(DVec3::Y, DVec3::new(350.0, 0.0, 250.0), 10.0)],
    );
    case.bake(64, None);
    let knights = case.coefficients("knights");
    assert_eq!(knights.instances.len(), 9);
    knights.assert_sane("knights", 0.7..0.87, 0.02);
    case.coefficients("suit").assert_sane("suit", 0.5..0.75, 0.2);
}

/// Catches hard surfaces of long thin triangles, in metres with z up, that shadow themselves.
#[test]
fn a_row_of_robot_parts() {
    let Some(case) = Case::new("m", "z") else { return };
    let places: Vec<DMat4> =
        (0..4).map(|i| copy(DVec3::Z, DVec3::new(0.4 * f64::from(i), 0.0, 0.2), f64::from(i * 37))).collect();
    let case = case.geometry("parts", &["robots_obj/hand.obj", "robots_obj/link6.obj"], &places);
    let report = case.bake(32, Some(40_000));
    // Two of link6's triangles have no area, and it has a line that belongs to no face
    assert_eq!(report.micropolygons, 4 * (7_078 + 21_620 - 2 + 1));
    assert_eq!(report.skipped, [("degenerate faces (a repeated vertex or no area)".to_string(), 2)]);
    let parts = case.coefficients("parts");
    assert_eq!(parts.instances.len(), 4);
    parts.assert_sane("parts", 0.5..0.75, 0.15);
}

/// Catches lost precision: a terrain 4,100 km from the origin bakes to the same numbers as the same at the origin.
#[test]
fn terrain_far_from_the_origin() {
    let Some(far) = Case::new("m", "z") else { return };
    let far = far.geometry("terrain", &["terrain_dem/terrain_far_quads.obj"], &[]);
    let report = far.bake(32, Some(30_000));
    assert_eq!((report.micropolygons, report.skipped.len()), (137_886, 0));

    // The same import moved by whole steps of any lattice that is not coarser than a kilometre
    let near = Case::new("m", "z").expect("as before");
    let (source, moved) = (near.folder.path().join("far.mgs"), near.folder.path().join("near.mgs"));
    let options = ImportOptions { up: UpAxis::Z, ..ImportOptions::default() };
    import_parts(&near.assets.join("terrain_dem/terrain_far_quads.obj"), &source, &options, &mut |_| Ok(()))
        .unwrap();
    let mut reader = MgsReader::open(&source).unwrap();
    let mut writer = MgsWriter::create(&moved, reader.schema(), &[]).unwrap();
    let mut grid = Microgrid::default();
    while reader.next(&mut grid).unwrap() {
        grid.anchor -= DVec3::new(728.0, 3_992.0, 0.0) * 1_024.0;
        writer.write(&grid).unwrap();
    }
    writer.finish().unwrap();
    let near = near.geometry("terrain", &[moved.to_str().expect("a plain path")], &[]);
    near.bake(32, Some(30_000));

    let (far, near) = (far.coefficients("terrain"), near.coefficients("terrain"));
    far.assert_sane("terrain", 0.84..0.91, 0.0);
    assert_eq!(far.values.len(), near.values.len());
    let pairs = far.values.iter().flatten().zip(near.values.iter().flatten());
    let largest = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(largest < 1e-5, "coefficients differ by {largest}");
}

/// Catches a radius, chosen for points that have none, at which a cloud bakes to black or sees through itself.
#[test]
fn a_cloud_of_points_without_radius() {
    let Some(case) = Case::new("m", "y") else { return };
    let case = case.geometry("pond", &["points/pond.0.ply"], &[]);
    let report = case.bake(32, None);
    assert_eq!(report.micropolygons, 70_051);
    assert!(report.warnings.iter().any(|warning| warning.contains("without a radius")));
    let pond = case.coefficients("pond");
    assert_eq!(pond.vertices, 70_051);
    pond.assert_sane("pond", 0.35..0.65, 0.02);
}
