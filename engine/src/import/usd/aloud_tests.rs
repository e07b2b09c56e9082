//! What USD files say and an import cannot follow: counted or warned of, never passed over in silence.

use std::collections::BTreeSet;

use super::tests::{Desk, HEAD, mesh, read};
use crate::import::assets::Collect;
use crate::import::{ImportOptions, ImportReport};

const CUBE: &str = "int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0,2,3,1, 4,5,7,6, 0,1,5,4, 2,6,7,3, 0,4,6,2, 1,3,7,5]
    point3f[] points = [(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-1,-1,1), (1,-1,1), (-1,1,1), (1,1,1)]\n";

/// Reads a text, diced.
fn diced(text: &str) -> (Collect, ImportReport) {
    let desk = Desk::new();
    let dice = Some(crate::dice::Rate::world(0.25).unwrap());
    let options = ImportOptions { dice, ..ImportOptions::default() };
    read(&desk.layer("a.usda", &format!("{HEAD}{text}")), &options).unwrap()
}

/// How often something was left out, by the beginning of its name.
fn skipped(report: &ImportReport, what: &str) -> u64 {
    report.skipped.iter().filter(|(reason, _)| reason.starts_with(what)).map(|(_, count)| count).sum()
}

/// Catches creases and corners that are lost without a word, or taken for others.
#[test]
fn creases_that_fit_no_edge_are_counted() {
    let creases = |indices: &str, lengths: &str, sharpnesses: &str| {
        let text = format!(
            "def Mesh \"m\" {{ {CUBE} int[] creaseIndices = {indices}\n int[] creaseLengths = {lengths}
    float[] creaseSharpnesses = {sharpnesses}\n int[] cornerIndices = [7, 8]\n float[] cornerSharpnesses = [10] }}"
        );
        let (sink, report) = diced(&text);
        assert_eq!(skipped(&report, "sharp corners"), 1);
        (sink.bounds(), skipped(&report, "creases"))
    };
    let (sharp, none) = creases("[0, 1, 3, 2, 0]", "[5]", "[10]");
    assert_eq!((sharp.min.z, none), (-1.0, 0));
    assert_eq!(creases("[0, 1, 3, 2, 0]", "[5]", "[10, 10, 10, 10]"), (sharp, 0));
    // A diagonal, a point that is not there, a crease longer than its points, and one without sharpness
    assert_eq!(creases("[0, 1, 3, 2, 0, 7, 99]", "[5, 2]", "[10, 10]").1, 1);
    assert_eq!(creases("[0, 1, 3, 2, 0, 3]", "[5, 7]", "[10, 10]"), (sharp, 1));
    assert_eq!(creases("[0, 1, 3, 2, 0, 4, 5]", "[5, 2]", "[10]"), (sharp, 1));
    assert_eq!(creases("[0, 3]", "[2]", "[10]").1, 1);
}

/// Catches a hole whose surface is another than that of the whole mesh, or that is not open.
#[test]
fn a_hole_leaves_the_surface_as_it_is() {
    let places = |more: &str| {
        let mirrored =
            "float3 xformOp:scale = (-1, 1, 1)\n uniform token[] xformOpOrder = [\"xformOp:scale\"]";
        let (sink, report) = diced(&format!("def Mesh \"m\" {{ {CUBE} {more} {mirrored} }}"));
        let vertices = sink.grids.iter().flat_map(|grid| (0..grid.vertex_count()).map(|v| grid.position(v)));
        (vertices.map(|p| p.to_array().map(f64::to_bits)).collect::<BTreeSet<_>>(), report)
    };
    let ((whole, _), (open, report)) = (places(""), places("int[] holeIndices = [1]"));
    assert_eq!(skipped(&report, "faces that are holes"), 1);
    assert_eq!(report.micropolygons, 5 * 64);
    assert_eq!((whole.len(), open.len()), (386, 386 - 49));
    assert!(open.is_subset(&whole));
}

/// Catches schemes, bases, units and copies that are taken for others, and widths that vanish, without a word.
#[test]
fn what_is_not_known_is_said() {
    let (_, report) =
        diced(&format!("def Mesh \"m\" {{ {CUBE} uniform token subdivisionScheme = \"doo\" }}"));
    assert_eq!(skipped(&report, "meshes of an unknown subdivision scheme"), 1);
    let curves = |more: &str| {
        format!(
            "def BasisCurves \"c\" {{ int[] curveVertexCounts = [4] {more}
    point3f[] points = [(0,0,0), (1,0,0), (2,0,0), (3,0,0)] }}\n{}",
            mesh("m", "")
        )
    };
    for (more, message) in [
        ("uniform token basis = \"hermite\"", "curves of basis `hermite`"),
        ("uniform token type = \"quintic\"", "curves of type `quintic`"),
        ("uniform token wrap = \"twice\"", "curves of wrap `twice`"),
    ] {
        let (sink, report) = diced(&curves(more));
        assert_eq!((skipped(&report, "prims that cannot be read"), sink.bounds().max.x), (1, 1.0));
        assert!(report.warnings.iter().any(|warning| warning.contains(message)), "{:?}", report.warnings);
    }
    let (_, report) = diced(&curves("float[] widths = [1, 2, 3] ( interpolation = \"vertex\" )"));
    assert_eq!(skipped(&report, "widths without a value for every point"), 1);
    let desk = Desk::new();
    for odd in ["0", "-3", "nan"] {
        let text = format!("( metersPerUnit = {odd} )\n{}", mesh("m", ""));
        let (_, report) = read(&desk.layer("a.usda", &text), &ImportOptions::default()).unwrap();
        assert!(report.warnings[0].contains("centimetres are assumed"), "{odd}: {:?}", report.warnings);
    }
    let (_, report) = diced(&mesh(
        "m",
        "float3 xformOp:scale = (65, 1, 1)\n uniform token[] xformOpOrder = [\"xformOp:scale\"]\n uniform token subdivisionScheme = \"none\"",
    ));
    assert_eq!(skipped(&report, "finer parts of faces"), 1);
}

/// Catches copies that are shown though their instance is a proxy or inactive, a prototype that is not there, and values of
/// copies that are lost without a word.
#[test]
fn copies_heed_what_their_instances_say() {
    let text = format!(
        "def Xform \"W\" {{
    def Xform \"proxies\" {{ uniform token purpose = \"proxy\"
        def Xform \"a\" (instanceable = true references = </_c/T>) {{}} }}
    def Xform \"b\" (instanceable = true references = </_c/T>) {{ uniform token purpose = \"guide\" }}
    def Xform \"c\" (instanceable = true references = </_c/T>) {{ color3f[] primvars:displayColor = [(1,0,0)] }}
    def PointInstancer \"s\" (inactiveIds = [12]) {{
        rel prototypes = [</W/s/p/S>, </W/none>]
        int[] protoIndices = [0, 0, 0, 1]
        int64[] ids = [11, 12, 13, 14]
        point3f[] positions = [(1000,0,0), (2000,0,0), (3000,0,0), (4000,0,0)]
        float[] primvars:heat = [1, 2, 3, 4] ( interpolation = \"vertex\" )
        def Scope \"p\" {{ def Xform \"S\" {{ {} }} }}
    }}
}}
class \"_c\" {{ def Xform \"T\" {{ {} }} }}",
        mesh("stone", ""),
        mesh("m", "")
    );
    let desk = Desk::new();
    let (sink, report) =
        read(&desk.layer("a.usda", &format!("{HEAD}{text}")), &ImportOptions::default()).unwrap();
    let mut copies: Vec<u64> = sink.copies.iter().map(|(_, copies)| copies.count()).collect();
    copies.sort_unstable();
    assert_eq!((sink.grids.len(), copies), (2, vec![2]));
    for (what, count) in [
        ("prims of purpose `proxy`", 1),
        ("prims of purpose `guide`", 1),
        ("invisible and inactive copies", 1),
        ("copies of a prototype that is not there", 1),
        ("primvars of instances and instancers", 2),
    ] {
        assert_eq!(skipped(&report, what), count, "{what}: {:?}", report.skipped);
    }
}
