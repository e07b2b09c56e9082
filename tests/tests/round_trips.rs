//! What is exported, read back by the formats' own libraries: OpenUSD, OpenEXR, plyfile.
//!
//! `tests/run` installs them and names their Python in `PANTARAY_READERS`; without that the tests say that they are skipped.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;

use engine::bake::{BakeOptions, Control, Quiet, bake};
use engine::output::export::{ExportOptions, export};
use engine::stream::file::MgsReader;
use engine::stream::{Microgrid, MicrogridStream};
use serde_json::Value;

const ASSET: &str = r#"#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World" {
    def Mesh "floor" {
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        point3f[] points = [(0,0,0), (0,0,1), (0,0,2), (1,0,0), (1,0,1), (1,0,2), (9,9,9)]
        uniform token subdivisionScheme = "none"
        texCoord2f[] primvars:st = [(0,0), (0.5,0), (1,0), (0,1), (0.5,1), (1,1), (0,0)] ( interpolation = "vertex" )
    }
    def Xform "up" {
        double3 xformOp:translate = (0.25, 0.5, 0.25)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Mesh "roof" {
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 2, 1]
            point3f[] points = [(0,0,0), (1,0,0), (0,0,1)]
            uniform token subdivisionScheme = "none"
        }
    }
}
"#;

/// Python with the readers, or none with a note.
fn python() -> Option<PathBuf> {
    let found = std::env::var_os("PANTARAY_READERS").map(PathBuf::from).filter(|path| path.is_file());
    if found.is_none() {
        eprintln!("skipped: no independent readers; PANTARAY_READERS names a Python that has them");
    }
    found
}

fn read(python: &Path, arguments: &[&str]) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("readers/read.py");
    let output = Command::new(python).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A baked asset in a folder of its own.
fn baked() -> (tempfile::TempDir, String, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let asset = folder.path().join("asset.usda");
    std::fs::write(&asset, ASSET).unwrap();
    let text = r#"<scene version="1" units="m" up="y">
        <shaders><shader name="o" type="sh_occlusion"><param name="samples" value="64"/></shader></shaders>
        <geometries><geometry name="a" occluder="true"><stream file="asset.usda"/>
            <bakeset name="a"><attribute name="sh_occlusion" shader="o"/></bakeset>
        </geometry></geometries></scene>"#;
    let path = folder.path().join("scene.xml");
    std::fs::write(&path, text).unwrap();
    let scene = engine::scene::load(&path).unwrap();
    let control = Control { progress: &Quiet, cancel: &AtomicBool::new(false) };
    bake(&scene, &BakeOptions::default(), &folder.path().join("out"), control).unwrap();
    let stream = folder.path().join("out/a.mgs");
    (folder, asset.to_str().unwrap().into(), stream)
}

/// Exports, and returns the file's name.
fn export_to(folder: &Path, stream: &Path, name: &str, over: bool) -> String {
    let mut reader = MgsReader::open(stream).unwrap();
    let metadata = reader.metadata().to_vec();
    let path = folder.join(name);
    let options =
        ExportOptions { over, resolution: [32, 16], metadata: &metadata, ..ExportOptions::default() };
    export(&mut reader, &path, &options).unwrap();
    path.to_str().unwrap().into()
}

/// What was baked, by prim and point, and every vertex in order: position and coefficients.
#[derive(Default)]
struct Baked {
    points: BTreeMap<(u32, u32), Vec<f32>>,
    vertices: Vec<([f64; 3], Vec<f32>)>,
}

fn all(stream: &Path) -> Baked {
    let mut reader = MgsReader::open(stream).unwrap();
    let schema = reader.schema().clone();
    let [id, point, sh] = ["id", "point", "sh_occlusion"].map(|name| schema.find(name).unwrap());
    let (mut grid, mut found) = (Microgrid::default(), Baked::default());
    while reader.next(&mut grid).unwrap() {
        for vertex in 0..grid.vertex_count() {
            let key = [id, point].map(|column| grid.value(&schema, column, vertex, 0) as u32);
            let row: Vec<f32> = (0..9).map(|i| grid.value(&schema, sh, vertex, i)).collect();
            found.vertices.push((grid.position(vertex).to_array(), row.clone()));
            found.points.insert(key.into(), row);
        }
    }
    found
}

fn floats(value: &Value) -> Vec<f32> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap() as f32).collect()
}

/// Catches an over-layer that OpenUSD does not open, or whose values stand on another prim, point or component than baked.
#[test]
fn an_over_layer_brings_the_bake_to_its_prims() {
    let Some(python) = python() else { return };
    let (folder, asset, stream) = baked();
    let expected = all(&stream).points;
    for name in ["over.usda", "over.usd"] {
        let over = export_to(folder.path(), &stream, name, true);
        let prims = read(&python, &["usd", &asset, &over]);
        for (id, path, points) in [(0, "/World/floor", 7), (1, "/World/up/roof", 3)] {
            let prim = &prims[path];
            assert_eq!(prim["type"], "Mesh", "{name}: {path}");
            let primvar = &prim["primvars"]["sh_occlusion"];
            assert_eq!((&primvar["interpolation"], &primvar["elementSize"]), (&"vertex".into(), &9.into()));
            let values = floats(&primvar["values"]);
            assert_eq!(values.len(), 9 * points);
            for (point, row) in values.chunks_exact(9).enumerate() {
                match expected.get(&(id, point as u32)) {
                    Some(baked) => assert_eq!(row, &baked[..], "{name}: {path} {point}"),
                    // The point that no face uses
                    None => assert!(point == 6 && row == [0.0; 9]),
                }
            }
        }
        let alone = read(&python, &["usd", "", &over]);
        assert!(alone["/World/floor"]["points"].is_null(), "an over holds what was baked and nothing else");
    }
}

/// Catches points that move, or values that are other points', on the way to USD and PLY.
#[test]
fn points_arrive_in_usd_and_ply() {
    let Some(python) = python() else { return };
    let (folder, _, stream) = baked();
    let expected = all(&stream).vertices;
    let near = |a: &[f32], b: &[f64; 3]| a.iter().zip(b).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6);
    for name in ["points.usda", "points.usd"] {
        let prims = read(&python, &["usd", "", &export_to(folder.path(), &stream, name, false)]);
        let prim = &prims["/Points"];
        assert_eq!(prim["type"], "Points");
        let primvar = &prim["primvars"]["sh_occlusion"];
        assert_eq!(primvar["elementSize"], 9);
        let values = floats(&primvar["values"]);
        let points: Vec<Vec<f32>> = prim["points"].as_array().unwrap().iter().map(floats).collect();
        assert_eq!((points.len(), values.len()), (expected.len(), 9 * expected.len()));
        for (i, (position, row)) in expected.iter().enumerate() {
            assert!(near(&points[i], position) && values[9 * i..9 * i + 9] == row[..], "{name}: {i}");
        }
    }
    let file = read(&python, &["ply", &export_to(folder.path(), &stream, "points.ply", false)]);
    let names: Vec<&str> =
        file["names"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    let first = names.iter().position(|name| *name == "sh_occlusion_0").unwrap();
    for (row, (position, baked)) in file["values"].as_array().unwrap().iter().zip(&expected) {
        let row = floats(row);
        assert!(near(&row[..3], position) && row[first..first + 9] == baked[..]);
    }
}

/// Catches layers that are missing, swapped or upside down.
#[test]
fn coefficients_are_layers_of_an_exr() {
    let Some(python) = python() else { return };
    let (folder, _, stream) = baked();
    let expected = all(&stream).points;
    let layers = read(&python, &["exr", &export_to(folder.path(), &stream, "map.exr", false)]);
    let layers = layers.as_array().unwrap();
    assert_eq!(layers.len(), 9);
    for (i, layer) in layers.iter().enumerate() {
        assert_eq!(layer["name"], format!("sh_occlusion_{i}"));
        let lines: Vec<Vec<f32>> = layer["channels"]["Y"].as_array().unwrap().iter().map(floats).collect();
        assert_eq!((lines.len(), lines[0].len()), (16, 32));
        // A texel in the middle of the lower left eighth lies at s = 1/8, t = 1/4 on the first quad, which is parted
        // into triangles from its first corner
        let (column, line) = (3, 11);
        let (s, t) = (2.0 * (column as f32 + 0.5) / 32.0, 1.0 - (line as f32 + 0.5) / 16.0);
        let at = |point: u32| expected[&(0, point)][i];
        let value = match s > t {
            true => at(0) + (s - t) * (at(1) - at(0)) + t * (at(4) - at(0)),
            false => at(0) + s * (at(4) - at(3)) + t * (at(3) - at(0)),
        };
        assert!((lines[line][column] - value).abs() < 1e-5, "{i}: {} {value}", lines[line][column]);
    }
}
