//! The command line from outside: answers, exit codes, errors, and files that appear whole or not at all.

#[cfg(unix)]
mod building;
mod command;
#[cfg(unix)]
mod interruption;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use command::{fails, json, names, pantaray, repository, run};
use serde_json::Value;
use tempfile::TempDir;

/// Paths in a folder of its own.
struct Desk(TempDir);

impl Desk {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_string_lossy().into_owned()
    }

    fn write(&self, name: &str, text: &str) -> String {
        std::fs::write(self.at(name), text).expect("written");
        self.at(name)
    }

    fn stream(&self, name: &str, kind: &str, micropolygons: u32) -> String {
        let path = self.at(name);
        json(["generate", kind, "-o", &path, "--micropolygons", &micropolygons.to_string(), "--seed", "5"]);
        path
    }
}

fn number(value: &Value, path: &str) -> f64 {
    value.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} in {value}"))
}

/// Catches a stream that is not what was asked for, changes with the run, or gets lost in export and import.
#[test]
fn a_generated_stream_is_inspected_exported_and_imported_again() {
    let desk = Desk::new();
    let path = desk.stream("meadow.mgs", "grass", 20_000);
    let summary = json(["inspect", &path]);
    let micropolygons = number(&summary, "/micropolygons");
    assert!((10_000.0..40_000.0).contains(&micropolygons), "{summary}");
    assert_eq!(summary["attributes"][0]["name"], "N");
    let keys: Vec<&String> = summary.as_object().expect("an object").keys().collect();
    assert_eq!(keys, ["attributes", "bounds", "grids", "micropolygons", "vertices"]);
    let fast = json(["inspect", "--fast", &path]);
    assert_eq!((&fast["bounds"], &fast["vertices"]), (&summary["bounds"], &summary["vertices"]));

    let again = desk.stream("again.mgs", "grass", 20_000);
    assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());

    let exported = json(["export", &path, "-o", &desk.at("meadow.ply")]);
    assert_eq!(exported["vertices"], summary["vertices"]);
    assert_eq!(number(&exported, "/bytes"), std::fs::metadata(desk.at("meadow.ply")).unwrap().len() as f64);
    let back = desk.at("back.mgs");
    let imported = json(["import", &desk.at("meadow.ply"), "-o", &back]);
    assert_eq!(imported["micropolygons"], summary["micropolygons"]);
    assert_eq!(names(desk.0.path()), ["again.mgs", "back.mgs", "meadow.mgs", "meadow.ply"]);
}

/// Catches inputs that are dropped or left in another unit when several become one, and scratch files that stay.
#[test]
fn several_files_become_one_stream_in_one_unit() {
    let desk = Desk::new();
    let obj = desk.write("one.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n");
    let meters = desk.stream("ground.mgs", "terrain", 5_000);
    let joined = desk.at("joined.mgs");
    let report = json(["import", &obj, &meters, "-o", &joined, "--units", "cm", "--up", "z"]);
    let [ground, both] = [&meters, &joined].map(|path| json(["inspect", path.as_str()]));
    assert_eq!(number(&both, "/micropolygons"), number(&ground, "/micropolygons") + 1.0);
    assert_eq!(report["inputs"][0]["micropolygons"], 1);
    // y up in metres becomes z up in centimetres: (x, y, z) goes to 100 (x, -z, y)
    let [x, y] = [number(&ground, "/bounds/max/0"), number(&ground, "/bounds/max/1")];
    assert!((number(&both, "/bounds/max/0") - 100.0 * x).abs() < 0.1, "{ground} {both}");
    assert!((number(&both, "/bounds/max/2") - 100.0 * y).abs() < 0.1, "{ground} {both}");
    assert_eq!(names(desk.0.path()), ["ground.mgs", "joined.mgs", "one.obj"]);
}

/// Catches an example that does not bake, a report that misses a figure, a baked stream that nobody can use, and a
/// comparison that does not see a difference.
#[test]
fn an_example_is_baked_compared_and_lit() {
    let desk = Desk::new();
    let scene = repository("examples/terrain.xml").to_string_lossy().into_owned();
    let bake = |folder: &str, seed: &str| {
        let sizes = ["--max-points", "6000", "--samples", "64", "--memory", "256MiB"];
        json(["bake", &scene, "-o", &desk.at(folder), "--seed", seed].into_iter().chain(sizes))
    };
    let report = bake("a", "0");
    assert!(number(&report, "/bake/points") >= 1_000.0, "{report}");
    assert_eq!(number(&report, "/bake/rays"), 64.0 * number(&report, "/bake/points"));
    for figure in [
        "/micropolygons",
        "/grids",
        "/brickmap/bricks",
        "/brickmap/bytes",
        "/brickmap/bytes_per_micropolygon",
        "/brickmap/seconds",
        "/brickmap/micropolygons_per_second",
        "/bake/batches",
        "/bake/seconds",
        "/bake/rays_per_second",
        "/bake/threads",
        "/bake/io_bytes_per_ray",
        "/bake/io_bytes_per_batch",
        "/bake/device_bytes_per_ray",
        "/bake/cache_hit_ratio",
        "/bake/double_precision_ratio",
        "/peak_rss_bytes",
        "/seconds",
    ] {
        number(&report, figure);
    }
    assert_eq!(report, json(["inspect", &desk.at("a")]));

    bake("b", "1");
    let [a, b] = ["a/ground.mgs", "b/ground.mgs"].map(|name| desk.at(name));
    let difference = |a: &str, b: &str| {
        let comparison = json(["compare", a, b]);
        let attributes = comparison["attributes"].as_array().expect("attributes").clone();
        attributes.into_iter().find(|attribute| attribute["name"] == "sh_occlusion").expect("sh_occlusion")
    };
    assert_eq!(number(&difference(&a, &a), "/max/0"), 0.0);
    let other = difference(&a, &b);
    assert!((1e-6..0.2).contains(&number(&other, "/rmse/0")), "{other}");
    assert_eq!(other["bands"].as_array().map(Vec::len), Some(3));

    for (name, magic) in [("picture.png", &b"\x89PNG"[..]), ("picture.exr", b"\x76\x2f\x31\x01")] {
        let arguments = ["--size", "64x36", "--camera", "hill", "--scene", &scene, "--env", "overcast"];
        let relit = json(["relight", &a, "-o", &desk.at(name)].into_iter().chain(arguments));
        assert_eq!((relit["width"].as_u64(), relit["attribute"].as_str()), (Some(64), Some("sh_occlusion")));
        assert!(std::fs::read(desk.at(name)).unwrap().starts_with(magic));
    }
    let map = std::fs::read_dir(desk.at("a/brickmap")).unwrap().next().expect("a map").unwrap().path();
    let manifest = json([Path::new("inspect"), &map]);
    assert_eq!(manifest["micropolygons"], report["micropolygons"]);
}

/// Catches an output that is not what its shader computes, is traced once more, or cannot be looked at.
#[test]
fn shaders_have_outputs() {
    let desk = Desk::new();
    let scene = repository("examples/shaders.xml").to_string_lossy().into_owned();
    let sizes = ["--max-points", "4096", "--samples", "64", "--memory", "256MiB"];
    let report = json(["bake", &scene, "-o", &desk.at("out")].into_iter().chain(sizes));
    assert_eq!(number(&report, "/bake/rays"), 64.0 * number(&report, "/bake/points"), "{report}");
    let baked = desk.at("out/ground.mgs");
    let summary = json(["inspect", &baked]);
    let of = |name: &str| {
        let mut attributes = summary["attributes"].as_array().expect("attributes").iter();
        attributes.find(|attribute| attribute["name"] == name).cloned().expect(name)
    };
    // Over the hemisphere band 1 points to what is open, and points that were not baked are zero
    assert_eq!((&of("ambient")["components"], &of("bent_normal")["components"]), (&1.into(), &3.into()));
    assert!((0.3..=1.0).contains(&number(&of("ambient"), "/max/0")), "{summary}");
    assert!(number(&of("bent_normal"), "/max/1") > 0.8, "{summary}");
    // 64 rays leave a few hundredths where something occludes
    assert!((0.005..0.3).contains(&number(&of("sh_occlusion_error"), "/max/0")), "{summary}");
    json(["relight", &baked, "-o", &desk.at("ambient.png"), "--show", "ambient", "--size", "64x36"]);
    assert!(std::fs::read(desk.at("ambient.png")).unwrap().starts_with(b"\x89PNG"));
}

/// Catches a brick map that `build` leaves where `bake` does not find it.
#[test]
fn a_bake_reuses_what_build_has_built() {
    let desk = Desk::new();
    let scene = repository("examples/instances.xml").to_string_lossy().into_owned();
    let built = json(["build", &scene, "-o", &desk.at("out")]);
    assert_eq!(built["brickmap"]["reused"], false);
    let arguments = ["--max-points", "1", "--samples", "16"];
    let baked = json(["bake", &scene, "-o", &desk.at("out")].into_iter().chain(arguments));
    assert_eq!(baked["brickmap"]["reused"], true);
    assert_eq!(baked["micropolygons"], built["micropolygons"]);
}

/// Catches a demo that works at one size only, pictures that are not there, and a scene file that cannot be rerun.
#[test]
fn the_demo_leaves_pictures_and_a_scene_to_rerun() {
    let desk = Desk::new();
    let size = ["--micropolygons", "200000", "--size", "64x36", "--points", "2000"];
    let made = json(["demo", "--out", &desk.at("demo")].into_iter().chain(size));
    assert!(number(&made, "/report/bake/points") >= 2000.0, "{made}");
    for name in ["sky", "overcast", "sunset"] {
        let picture = std::fs::read(desk.at(&format!("demo/{name}.png"))).expect("a picture");
        assert!(picture.starts_with(b"\x89PNG"));
    }
    let [scene, out] = ["demo/scene.xml", "again"].map(|name| desk.at(name));
    json(["bake", &scene, "-o", &out]);
    let [first, again] =
        ["demo/baked/seen.mgs", "again/seen.mgs"].map(|name| std::fs::read(desk.at(name)).unwrap());
    assert!(first == again, "baking the demo's scene again gives other bytes");
}

/// Catches devices that are made up.
#[test]
fn devices_are_what_the_machine_has() {
    let devices = json(["devices"]);
    assert_eq!(devices["devices"][0]["name"], "cpu");
    let sets = devices["devices"][0]["instruction_sets"].as_array().expect("a list");
    assert_eq!(sets.first().and_then(Value::as_str), Some("plain"));
    assert!(sets.contains(&devices["devices"][0]["instructions"]));
}

/// Catches wrong usage that is taken for failed work, or worse, for right usage.
#[test]
fn wrong_usage_exits_with_2() {
    for line in [
        "",
        "frobnicate",
        "bake",
        "bake scene.xml",
        "bake scene.xml -o out --memory 1PB",
        "bake scene.xml -o out --device abacus",
        "bake scene.xml -o out --samples 5",
        "bake scene.xml -o out --threads 0",
        "bake scene.xml -o out --lod sometimes",
        "bake scene.xml -o out --farfield near",
        "bake scene.xml -o out --max-points 0",
        "generate forest -o out.mgs",
        "generate grass -o out.ply",
        "import -o out.mgs",
        "import a.ply -o out.mgs --units furlong",
        "compare a.mgs",
        "relight a.mgs -o a.png --eye 1,2",
        "relight a.mgs -o a.png --eye 1,2,3",
        "relight a.mgs -o a.png --camera shot",
        "relight a.mgs -o a.png --size 12",
    ] {
        let run = run(line.split_whitespace());
        assert_eq!((run.code, run.out.as_str()), (2, ""), "`{line}`: {run:?}");
        assert!(!run.err.is_empty(), "`{line}`");
    }
}

/// Catches a failure that leaves something behind, says nothing helpful, or says it twice.
#[test]
fn failed_work_says_why_and_leaves_nothing() {
    let desk = Desk::new();
    let stream = desk.stream("ground.mgs", "terrain", 2_000);
    let broken = desk.write("broken.obj", "v 0 0 zero\nf 1 2 3\n");
    let empty = desk.write("empty.obj", "v 0 0 0\n");
    let [out, ply, png] = ["out.mgs", "out.ply", "out.png"].map(|name| desk.at(name));
    let before = names(desk.0.path());

    fails(["import", &broken, "-o", &out], "broken.obj:1", None);
    fails(["import", &empty, "-o", &out], "no geometry", None);
    fails(["import", &desk.at("none.ply"), "-o", &out], "none.ply", None);
    fails(["import", &stream, &broken, "-o", &out], "broken.obj:1", None);
    fails(["import", &stream, "-o", &out, "--dice", "world:x"], "no way to dice", Some("world:0.01"));
    fails(["import", &desk.at("a.fbx"), "-o", &out], "not a format", Some(".gltf"));
    fails(["inspect", &desk.at("none.mgs")], "none.mgs", None);
    fails(["inspect", &broken], "broken.obj", Some("pantaray import"));
    fails([Path::new("inspect"), desk.0.path()], "nothing to inspect", Some("bake's folder"));
    fails(["export", &stream, "-o", &desk.at("out.abc")], "cannot export", Some(".usda"));
    fails(["export", &stream, "--over", "-o", &desk.at("out.usda")], "which prims", Some("bake a USD file"));
    fails(["export", &desk.at("none.mgs"), "-o", &ply], "none.mgs", None);
    fails(["relight", &stream, "-o", &png], "sh_occlusion", Some("bake it first"));
    fails(["relight", &stream, "-o", &png, "--env", "sunst"], "sunst", Some("`sunset`"));
    fails(["compare", &stream, &desk.at("none.mgs")], "none.mgs", None);

    let truncated = desk.at("truncated.mgs");
    let bytes = std::fs::read(&stream).unwrap();
    std::fs::write(&truncated, &bytes[..bytes.len() / 2]).unwrap();
    fails(["inspect", &truncated], "truncated.mgs: byte", Some("truncated"));
    fails(["export", &truncated, "-o", &ply], "truncated.mgs: byte", None);
    std::fs::remove_file(&truncated).unwrap();
    assert_eq!(names(desk.0.path()), before);
}

/// Catches a mistake in a scene that is reported without its place, its nearest right name, or after work was begun.
#[test]
fn a_wrong_scene_is_refused_with_line_and_column() {
    let desk = Desk::new();
    let xml = std::fs::read_to_string(repository("examples/terrain.xml")).unwrap();
    let scene = desk.write("scene.xml", &xml.replace("geometries>", "geometrys>"));
    let line = 1 + xml.lines().position(|line| line.contains("<geometries>")).expect("the element");
    let out = desk.at("out");
    fails(["bake", &scene, "-o", &out], &format!("scene.xml:{line}:"), Some("geometries"));
    fails(["build", &scene, "-o", &out], &format!("scene.xml:{line}:"), Some("geometries"));

    let scene = desk.write("scene.xml", &xml);
    let relight = ["relight", &scene, "-o", "a.png", "--scene", &scene, "--camera", "hil"];
    fails(relight, "scene.xml", None);
    assert_eq!(names(desk.0.path()), ["scene.xml"]);
    fails(["bake", &scene, "-o", &out, "--memory", "100MiB"], "memory", Some("256MiB"));
    // More GPUs than any machine has
    fails(["bake", &scene, "-o", &out, "--device", "gpu:4000"], "no GPU", Some("--device cpu"));
}

/// Catches two bakes that write into one folder.
#[test]
fn a_folder_in_use_is_refused() {
    let desk = Desk::new();
    let folder = PathBuf::from(desk.at("out"));
    let held = engine::bake::folder::Folder::open(&folder).expect("the folder");
    let scene = repository("examples/terrain.xml").to_string_lossy().into_owned();
    fails(["bake", &scene, "-o", &desk.at("out")], "another bake", Some("wait"));
    drop(held);
}

/// Catches a panic when whoever reads the answer goes away.
#[test]
fn a_closed_pipe_is_no_error() {
    let desk = Desk::new();
    let stream = desk.stream("ground.mgs", "terrain", 2_000);
    let mut child = pantaray()
        .args(["inspect", &stream, "--quiet"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("pantaray runs");
    drop(child.stdout.take());
    let mut said = String::new();
    child.stderr.take().expect("piped").read_to_string(&mut said).expect("text");
    assert_eq!((child.wait().unwrap().code(), said.as_str()), (Some(0), ""));
}

/// Catches progress on standard output, and none at all.
#[test]
fn progress_goes_to_standard_error() {
    let desk = Desk::new();
    let run = run(["generate", "grass", "-o", &desk.at("a.mgs"), "--json"]);
    assert_eq!(run.code, 0, "{run:?}");
    assert!(serde_json::from_str::<Value>(&run.out).is_ok(), "{run:?}");
    assert!(run.err.contains("generate done in"), "{run:?}");
}
