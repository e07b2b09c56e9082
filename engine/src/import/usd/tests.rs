//! USD files of a few lines, each against what it must become; broken ones against what must not happen.

use std::path::{Path, PathBuf};

use glam::{DVec3, Vec3};

use crate::import::assets::Collect;
use crate::import::{ImportOptions, ImportReport, Parts, import, import_parts};
use crate::stream::schema::{UpAxis, names};
use crate::stream::{Microgrid, MicrogridStream, Schema};
use crate::{ErrorKind, Result};

pub(super) struct Desk(pub tempfile::TempDir);

impl Desk {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// Writes a text layer.
    pub fn layer(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, format!("#usda 1.0\n{text}")).unwrap();
        path
    }
}

/// In metres, which the layers here are in as well.
pub(super) const HEAD: &str = "(\n    metersPerUnit = 1\n)\n";

pub(super) fn read(path: &Path, options: &ImportOptions) -> Result<(Collect, ImportReport)> {
    let mut sink = Collect::default();
    let report = import(path, options, &mut sink)?;
    Ok((sink, report))
}

fn read_text(text: &str) -> (Collect, ImportReport) {
    let desk = Desk::new();
    read(&desk.layer("a.usda", &format!("{HEAD}{text}")), &ImportOptions::default()).unwrap()
}

/// All grids of a file, copies included.
fn expand(path: &Path) -> (Schema, Vec<Microgrid>, Parts) {
    let folder = tempfile::tempdir().unwrap();
    let (parts, _) =
        import_parts(path, &folder.path().join("a.mgs"), &ImportOptions::default(), &mut |_| Ok(())).unwrap();
    let mut stream: Box<dyn MicrogridStream> = parts.open().unwrap();
    let (mut grids, mut grid) = (Vec::new(), Microgrid::default());
    while stream.next(&mut grid).unwrap() {
        grids.push(grid.clone());
    }
    (stream.schema().clone(), grids, parts)
}

const SQUARE: &str = "int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]
    uniform token subdivisionScheme = \"none\"\n";

pub(super) fn mesh(name: &str, more: &str) -> String {
    format!("def Mesh \"{name}\" {{\n    {SQUARE}{more}\n}}\n")
}

/// Catches a primvar that lands on another vertex, is lost, or merges vertices that differ in it.
#[test]
fn primvars_of_all_interpolations_become_attributes() {
    let text = r#"
def Xform "up" {
    float primvars:weight = 3
    color3f[] primvars:displayColor = [(1, 0, 0)] ( interpolation = "constant" )
    def Mesh "m" {
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
        point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]
        uniform token subdivisionScheme = "none"
        float[] primvars:face = [5, 6] ( interpolation = "uniform" )
        float[] primvars:point = [0, 1, 2, 3] ( interpolation = "vertex" )
        float[] primvars:height = [0, 1, 2, 3] ( interpolation = "varying" )
        texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (9,9)] ( interpolation = "faceVarying" )
        int[] primvars:st:indices = [0, 1, 2, 0, 3, 2]
        float[] primvars:sh = [1, 2, 3, 4] ( elementSize = 4  interpolation = "constant" )
        float[] primvars:displayOpacity = [1, 0.5] ( interpolation = "uniform" )
        string primvars:note = "left"
    }
}"#;
    let (sink, report) = read_text(text);
    let found: Vec<(&str, u16)> =
        sink.schema.attributes.iter().map(|a| (a.name.as_str(), a.components)).collect();
    // `point` is the engine's own name
    let expected =
        [("N", 3), ("albedo", 3), ("opacity", 1), ("face", 1), ("height", 1), ("sh", 4), ("st", 2)];
    assert_eq!(found, [&expected[..], &[("weight", 1), ("point", 1), ("id", 1)]].concat());
    assert_eq!(report.skipped.len(), 1, "{:?}", report.skipped);
    let grid = &sink.grids[0];
    assert_eq!((sink.grids.len(), grid.vertex_count()), (1, 6));
    let value = |name: &str, vertex: usize, i: usize| {
        grid.unit_value(&sink.schema, sink.schema.find(name).unwrap(), vertex, i)
    };
    for (number, face) in grid.faces().enumerate() {
        for &vertex in face {
            let vertex = usize::from(vertex);
            let point = value("height", vertex, 0);
            assert_eq!(point, value("point", vertex, 0));
            assert_eq!(value("face", vertex, 0), 5.0 + number as f32);
            assert_eq!((value("weight", vertex, 0), value("sh", vertex, 3)), (3.0, 4.0));
            assert_eq!(grid.vec3(&sink.schema, 1, vertex), Vec3::X);
            assert!((value("opacity", vertex, 0) - [1.0, 0.5][number]).abs() < 0.003);
            let st = [value("st", vertex, 0), value("st", vertex, 1)];
            let expected = match (number, point as u32) {
                (_, 0) => [0.0, 0.0],
                (0, 1) => [1.0, 0.0],
                (1, 2) => [9.0, 9.0],
                _ => [1.0, 1.0],
            };
            assert_eq!(st, expected);
        }
    }
}

/// Catches a prim that is shown though it is hidden in one of USD's many ways, or hidden though it is to be seen.
#[test]
fn only_what_is_to_be_seen_is_read() {
    let invisible = "token visibility = \"invisible\"";
    let text = [
        mesh("plain", ""),
        mesh("render", "uniform token purpose = \"render\""),
        mesh("proxy", "uniform token purpose = \"proxy\""),
        mesh("guide", "uniform token purpose = \"guide\""),
        mesh("invisible", invisible),
        format!("def Xform \"below\" {{ {invisible}\n {} }}", mesh("a", "")),
        mesh("abstract", "").replace("def Mesh", "class Mesh"),
        mesh("over", "").replace("def Mesh", "over Mesh"),
        format!("def Xform \"off\" (active = false) {{ {} }}", mesh("a", "")),
        "def Sphere \"ball\" {}\ndef Material \"m\" { def Shader \"s\" {} }\ndef DistantLight \"sun\" {}"
            .into(),
    ]
    .concat();
    let (sink, report) = read_text(&text);
    assert_eq!((sink.grids.len(), report.source.quads), (2, 2));
    let mut skipped: Vec<(&str, u64)> = report.skipped.iter().map(|(what, n)| (what.as_str(), *n)).collect();
    skipped.sort_unstable();
    let expected = [
        ("invisible prims, with what is below them", 2),
        ("prims of purpose `guide`", 1),
        ("prims of purpose `proxy`", 1),
        ("prims of type `DistantLight`", 1),
        ("prims of type `Material`", 1),
        ("prims of type `Sphere`", 1),
    ];
    assert_eq!(skipped, expected);
    assert_eq!(
        sink.metadata.iter().find(|(key, _)| key == super::PRIMS_KEY).unwrap().1,
        "4 /plain\n4 /render"
    );
}

/// Catches units or axes that are not converted, transforms in the wrong order, and a reset that does not reset.
#[test]
fn transforms_units_and_axes_are_applied() {
    let text = format!(
        "(\n metersPerUnit = 0.01\n upAxis = \"Z\"\n)\ndef Xform \"a\" {{
    double3 xformOp:translate = (0, 0, 100)
    float xformOp:rotateX:lift = 90
    float xformOp:rotateX:back = 90
    uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:rotateX:lift\", \"!invert!xformOp:rotateX:back\"]
    {} {} }}",
        mesh("b", "float3 xformOp:scale = (200, 100, 100)\n uniform token[] xformOpOrder = [\"xformOp:scale\"]"),
        mesh("c", "uniform token[] xformOpOrder = [\"!resetXformStack!\"]"),
    );
    let desk = Desk::new();
    let (sink, _) = read(&desk.layer("a.usda", &text), &ImportOptions::default()).unwrap();
    let [b, c] = [0, 1].map(|grid| sink.grids[grid].bounds());
    let close = |a: DVec3, b: [f64; 3]| assert!((a - DVec3::from(b)).length() < 1e-6, "{a} {b:?}");
    // z points up there, y here: what lies at height 100 cm stays at 1 m
    close(b.min, [0.0, 1.0, -1.0]);
    close(b.max, [2.0, 1.0, 0.0]);
    close(c.max, [0.01, 0.0, 0.0]);
    assert_eq!((sink.schema.up, sink.schema.meters_per_unit), (UpAxis::Y, 1.0));
    let normal = sink.grids[0].vec3(&sink.schema, 0, 0);
    assert!((normal - Vec3::Y).length() < 1e-6, "{normal}");
}

/// Catches samples that are not interpolated, a frame that is ignored, and a file of samples alone that reads as empty.
#[test]
fn a_frame_picks_its_samples() {
    let text = format!(
        "{HEAD}def Xform \"a\" {{ double3 xformOp:translate.timeSamples = {{ 1: (0,0,0), 3: (4,0,0) }}
    uniform token[] xformOpOrder = [\"xformOp:translate\"]\n {} }}",
        mesh("b", "")
    );
    let desk = Desk::new();
    let path = desk.layer("a.usda", &text);
    let left = |frame| {
        let options = ImportOptions { frame, ..ImportOptions::default() };
        read(&path, &options).unwrap().0.bounds().min.x
    };
    assert_eq!([None, Some(1.0), Some(2.0), Some(9.0)].map(left), [0.0, 0.0, 2.0, 4.0]);
}

/// Catches copies that are lost, doubled or misplaced where instances nest, and prototypes that are shown themselves.
#[test]
fn instances_nest_and_point_instancers_place() {
    let at = |x: i32, more: &str| {
        format!(
            "double3 xformOp:translate = ({x}, 0, 0)\n uniform token[] xformOpOrder = [\"xformOp:translate\"]\n{more}"
        )
    };
    let twig = |name: &str, x| {
        format!(
            "def Xform \"{name}\" (instanceable = true references = </_protos/Twig>) {{ {} }}\n",
            at(x, "")
        )
    };
    let tree = |name: &str, x| {
        format!(
            "def Xform \"{name}\" (instanceable = true references = </_protos/Tree>) {{ {} }}\n",
            at(x, "")
        )
    };
    let text = format!(
        "{HEAD}def Xform \"World\" {{ {} {}
    def PointInstancer \"scatter\" {{
        rel prototypes = [</World/scatter/p/Stone>]
        int[] protoIndices = [0, 0, 0, 7]
        point3f[] positions = [(1000,0,0), (2000,0,0), (3000,0,0), (0,0,0)]
        float3[] scales = [(1,1,1), (1,1,1), (2,2,2), (1,1,1)]
        quath[] orientations = [(1,0,0,0), (0,0,0,1), (1,0,0,0), (1,0,0,0)]
        int64[] invisibleIds = [0]
        def Scope \"p\" {{ def Xform \"Stone\" {{ {} }} }}
    }} }}
over \"_protos\" {{ def Xform \"Twig\" {{ {} }}
    def Xform \"Tree\" {{ {} {} {} }} }}",
        tree("t0", 100),
        tree("t1", 200),
        at(10, &mesh("m", "")),
        mesh("m", ""),
        twig("a", 1),
        twig("b", 2),
        mesh("trunk", ""),
    );
    let desk = Desk::new();
    let (schema, grids, parts) = expand(&desk.layer("a.usda", &text));
    let mut spans: Vec<(f64, f64)> = grids.iter().map(|g| (g.bounds().min.x, g.bounds().max.x)).collect();
    spans.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let trees = [100.0, 101.0, 102.0, 200.0, 201.0, 202.0].map(|x| (x, x + 1.0));
    // The second stone is turned about z, together with the place it has in its prototype
    assert_eq!(spans, [&trees[..], &[(1989.0, 1990.0), (3020.0, 3022.0)]].concat());
    let instance = schema.find(names::INSTANCE).unwrap();
    assert!(grids.iter().any(|grid| grid.value(&schema, instance, 0, 0) == 3.0));
    assert_eq!(parts.parts.len(), 3);
    let report = read(&desk.0.path().join("a.usda"), &ImportOptions::default()).unwrap().1;
    assert_eq!(report.source.quads, 7, "copies of instances count, those of an instancer once");
    let skipped: u64 = report.skipped.iter().map(|skip| skip.1).sum();
    assert_eq!(skipped, 2, "{:?}", report.skipped);
}

/// Catches diameters that are taken for radii, and curves that leave their points or their basis.
#[test]
fn curves_and_points_have_radii() {
    let text = r#"
def Points "p" { point3f[] points = [(0,0,0), (1,0,0)]  float[] widths = [0.5, 1] }
def BasisCurves "linear" {
    uniform token type = "linear"
    int[] curveVertexCounts = [3, 2]
    point3f[] points = [(0,1,0), (1,1,0), (2,1,0), (0,2,0), (1,2,0)]
    float[] widths = [0.2, 0.4] ( interpolation = "uniform" )
}
def BasisCurves "bezier" {
    uniform token type = "cubic"
    int[] curveVertexCounts = [4]
    point3f[] points = [(0,3,0), (0,4,0), (1,4,0), (1,3,0)]
    float[] widths = [0.02, 0.04] ( interpolation = "varying" )
    float[] primvars:heat = [0, 0, 3, 3] ( interpolation = "vertex" )
}"#;
    let (sink, report) = read_text(text);
    assert_eq!(report.source.points, 2);
    let radius = sink.schema.find(names::RADIUS).unwrap();
    let heat = sink.schema.find("heat").unwrap();
    let id = sink.schema.find(names::ID).unwrap();
    let mut lines = [0; 3];
    for grid in &sink.grids {
        let number = grid.value(&sink.schema, id, 0, 0) as usize;
        lines[number] += grid.face_count();
        for vertex in 0..grid.vertex_count() {
            let (p, r) = (grid.position(vertex), grid.value(&sink.schema, radius, vertex, 0));
            let expected = match number {
                0 => 0.25 + 0.25 * p.x as f32,
                1 => 0.1 * p.y as f32,
                // x = 3t² - 2t³, heat = 9t² - 6t³, and the width goes with t
                _ => {
                    assert!((grid.value(&sink.schema, heat, vertex, 0) - 3.0 * p.x as f32).abs() < 1e-5);
                    let t = (0..=1000).map(|i| f64::from(i) / 1000.0);
                    let near = |t: &f64| (t * t * (3.0 - 2.0 * t) - p.x).abs();
                    let t = t.min_by(|a, b| near(a).total_cmp(&near(b))).unwrap();
                    assert!((3.0 + 3.0 * t * (1.0 - t) - p.y).abs() < 5e-3);
                    0.01 * (1.0 + t as f32)
                }
            };
            assert!((r - expected).abs() < 1e-4, "{number} {p} {r} {expected}");
        }
    }
    assert_eq!(lines[..2], [2, 3]);
    // The second derivative is 6 √2 at its largest: sqrt(6 √2 / (8 · 0.005)) = 14.6
    assert_eq!(lines[2], 15);
}

/// Catches layers that are not composed: sublayers, references with their variants, payloads, and packages.
#[test]
fn layers_compose() {
    let desk = Desk::new();
    let part = format!(
        "(\n defaultPrim = \"A\"\n)\ndef Xform \"A\" (
    variants = {{ string lod = \"high\" }}
    prepend variantSets = \"lod\"
) {{ variantSet \"lod\" = {{ \"low\" {{ {} }} \"high\" {{ {} {} }} }} }}",
        mesh("l", ""),
        mesh("h", ""),
        mesh("i", "")
    );
    desk.layer("part.usda", &part);
    desk.layer("sub.usda", &format!("def Xform \"S\" (payload = @./part.usda@) {{}}\n{}", mesh("plain", "")));
    let root = "(\n metersPerUnit = 1\n subLayers = [@./sub.usda@]\n)
def Xform \"R\" (references = @./part.usda@ variants = { string lod = \"low\" }) {}
def Xform \"gone\" (references = @./nothing.usda@) {}";
    let path = desk.layer("root.usda", root);
    let (sink, report) = read(&path, &ImportOptions::default()).unwrap();
    assert_eq!((report.source.quads, sink.grids.len()), (4, 4));
    assert!(report.warnings.iter().any(|warning| warning.contains("nothing.usda")), "{:?}", report.warnings);
}

/// Catches a broken prim that takes the file with it, or passes.
#[test]
fn a_broken_prim_ends_its_geometry_alone() {
    let wrong = [
        ("index", "[0, 1, 2, 3]", "[0, 1, 2, 4]"),
        ("negative", "[0, 1, 2, 3]", "[0, 1, 2, -1]"),
        ("count", "[4]", "[5]"),
        ("minus", "[4]", "[-4]"),
        ("many", "[4]", "[2147483647, 2147483647]"),
    ];
    let broken: String = wrong.iter().map(|(name, from, to)| mesh(name, "").replace(from, to)).collect();
    let (sink, report) = read_text(&(broken + &mesh("good", "")));
    assert_eq!((sink.grids.len(), report.source.quads), (1, 1));
    assert_eq!(report.skipped, [("prims that cannot be read".to_string(), 5)]);
    assert!(
        report.warnings[0].contains("prim `/index`: corner 3 is point 4 of 4 points"),
        "{:?}",
        report.warnings
    );
}

/// Catches files that take memory, time or stack without end: each must end with an error of a stated limit, or as if the
/// bad part were not there.
#[test]
fn bombs_hit_a_limit() {
    let desk = Desk::new();
    let options = ImportOptions { patience_seconds: 10, memory_bytes: 64 << 20, ..ImportOptions::default() };
    let outcome = |name: &str, text: &str| read(&desk.layer(name, text), &options).map(|(_, report)| report);
    // Nested deeper than any stack
    let error =
        outcome("deep.usda", &format!("def \"a\" {{ int[] a = {} }}", "[".repeat(500_000))).unwrap_err();
    assert!(error.message().contains("nested"), "{error}");
    // Prims below prims below prims
    let deep = "def \"a\" { ".repeat(900) + &"}".repeat(900);
    assert_eq!(outcome("prims.usda", &deep).unwrap_err().kind(), ErrorKind::Limit);
    // A file that refers to itself, and two that refer to each other
    for (name, other) in [("self.usda", "self.usda"), ("one.usda", "two.usda"), ("two.usda", "one.usda")] {
        let text =
            format!("(defaultPrim = \"A\")\ndef \"A\" (references = @./{other}@) {{ {} }}", mesh("m", ""));
        desk.layer(name, &text);
    }
    for name in ["self.usda", "two.usda"] {
        let outcome = read(&desk.0.path().join(name), &options);
        assert!(outcome.is_err() || outcome.unwrap().1.source.quads <= 2, "{name}");
    }
    // Thirty files, each of which has the next one twice
    for i in 0..30 {
        let next = i + 1;
        let text = format!(
            "(defaultPrim = \"A\")\ndef \"A\" {{ def \"l\" (references = @./{next}.usda@) {{}}\n def \"r\" (references = @./{next}.usda@) {{}} }}"
        );
        desk.layer(&format!("{i}.usda"), &text);
    }
    desk.layer("30.usda", &format!("(defaultPrim = \"A\")\ndef \"A\" {{ {} }}", mesh("m", "")));
    let error = read(&desk.0.path().join("0.usda"), &options).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::Limit, "{error}");
    // Classes in a circle, reached from outside
    let circle = "class \"A\" (specializes = </B>) {}\nclass \"B\" (inherits = </A>) {}\ndef \"m\" (inherits = </A>) {}";
    let error = outcome("circle.usda", circle).unwrap_err();
    assert!(error.message().contains("in a circle"), "{error}");
    // A layer larger than the memory allowed
    let options = ImportOptions { memory_bytes: 1 << 20, ..options };
    let error = read(&desk.layer("large.usda", &" ".repeat(2 << 20)), &options).err().unwrap();
    assert_eq!((error.kind(), error.hint_text().is_some()), (ErrorKind::Limit, true), "{error}");
}

/// Catches a surface that is diced as its cage, in the wrong space, with cracks between its grids, or with results that
/// cannot be brought back to its points.
#[test]
fn subdivision_surfaces_are_diced_in_the_world() {
    let text = r#"
def Mesh "ball" {
    int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0,2,3,1, 4,5,7,6, 0,1,5,4, 2,6,7,3, 0,4,6,2, 1,3,7,5]
    point3f[] points = [(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-1,-1,1), (1,-1,1), (-1,1,1), (1,1,1)]
    float[] primvars:height = [-1, -1, -1, -1, 1, 1, 1, 1] ( interpolation = "vertex" )
    float3 xformOp:scale = (10, 10, 10)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}"#;
    let desk = Desk::new();
    let path = desk.layer("a.usda", &format!("{HEAD}{text}"));
    let dice = Some(crate::dice::Rate::world(0.5).unwrap());
    let (sink, report) = read(&path, &ImportOptions { dice, ..ImportOptions::default() }).unwrap();
    assert_eq!(report.source.quads, 6);
    assert_eq!(report.micropolygons, 6 * 64 * 64);
    let [point, height] = [names::POINT, "height"].map(|name| sink.schema.find(name).unwrap());
    let mut edges = std::collections::BTreeMap::<[[u64; 3]; 2], i32>::new();
    let mut points = std::collections::BTreeSet::new();
    for grid in &sink.grids {
        let at = |vertex: u8| grid.position(usize::from(vertex));
        for face in grid.faces() {
            for i in 0..face.len() {
                let ends = [at(face[i]), at(face[(i + 1) % face.len()])];
                assert!(ends[0].distance(ends[1]) < 0.51);
                let [a, b] = ends.map(|p| p.to_array().map(f64::to_bits));
                *edges.entry([a.min(b), a.max(b)]).or_default() += if a < b { 1 } else { -1 };
            }
        }
        for vertex in 0..grid.vertex_count() {
            // Half of the corner's place, see the dicer's own tests
            let p = grid.position(vertex);
            assert!((4.9..9.0).contains(&p.length()), "{p}");
            assert!((f64::from(grid.value(&sink.schema, height, vertex, 0)) - p.z / 10.0).abs() < 1e-5);
            assert!(grid.vec3(&sink.schema, 0, vertex).as_dvec3().dot(p.normalize()) > 0.7);
            let bytes = &grid.columns[point][4 * vertex..4 * vertex + 4];
            points.insert(u32::from_le_bytes(bytes.try_into().unwrap()));
        }
    }
    assert!(edges.values().all(|&balance| balance == 0));
    assert_eq!(points.into_iter().collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5, 6, 7, u32::MAX]);
}

/// Catches curves that are lost, doubled or misplaced where a prim is read in parts, far from the origin too.
#[test]
fn many_curves_are_read_in_parts() {
    let count = super::curves::PART_POINTS / 2 + 1000;
    let place = |i: usize| (i % 600, i / 600);
    let points = (0..count).map(|i| {
        let (x, y) = place(i);
        format!("({x},{y},0),({x},{y},1)")
    });
    let points = points.collect::<Vec<_>>().join(",");
    let widths = (0..count).map(|i: usize| if i.is_multiple_of(2) { "0.5,0.125" } else { "0.25,0.0625" });
    let widths = widths.collect::<Vec<_>>().join(",");
    let counts = vec!["2"; count].join(",");
    let text = format!(
        r#"{HEAD}def Xform "far" {{
    double3 xformOp:translate = (4194304, 0, -1048576)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def BasisCurves "hair" {{
        uniform token type = "linear"
        int[] curveVertexCounts = [{counts}]
        point3f[] points = [{points}]
        float[] widths = [{widths}] ( interpolation = "vertex" )
    }}
}}
"#
    );
    let desk = Desk::new();
    let (sink, report) = read(&desk.layer("a.usda", &text), &ImportOptions::default()).unwrap();
    assert_eq!((report.source.vertices, report.source.lines), (2 * count as u64, count as u64));
    assert_eq!(report.micropolygons, count as u64);
    let radius = sink.schema.find(names::RADIUS).unwrap();
    let mut seen = vec![false; count];
    for grid in &sink.grids {
        for face in grid.faces() {
            let [root, tip] = [face[0], face[1]].map(usize::from);
            let p = grid.position(root) - DVec3::new(4_194_304.0, 0.0, -1_048_576.0);
            assert_eq!(p, p.round());
            let i = p.y as usize * 600 + p.x as usize;
            assert!(!std::mem::replace(&mut seen[i], true));
            let wide = if i.is_multiple_of(2) { 0.25 } else { 0.125 };
            let radii = [root, tip].map(|v| grid.value(&sink.schema, radius, v, 0));
            assert_eq!(radii, [wide, wide / 4.0]);
        }
    }
    assert!(seen.into_iter().all(|seen| seen));
}
