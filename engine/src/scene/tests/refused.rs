//! For each mistake in a scene its kind, place, words and hint.

use super::{SCENE, read};
use crate::error::Place;
use crate::scene::*;

/// Replaces `from` in [`SCENE`] by `to` and checks the error that follows: its kind, its place, which `to` marks with
/// `«`, and the start of its message and hint.
fn check(from: &str, to: &str, kind: ErrorKind, message: &str, hint: &str) {
    assert!(SCENE.contains(from), "`{from}` is not in the scene");
    let marked = SCENE.replacen(from, to, 1);
    let (before, after) = marked.split_once('«').expect("a marked place");
    let error = read(&format!("{before}{after}")).expect_err(to);
    let line = before.matches('\n').count() as u64 + 1;
    let column = before.chars().rev().take_while(|&c| c != '\n').count() as u64 + 1;
    let path = "folder/s.xml".into();
    assert_eq!(error.place(), Some(&Place::Text { path, line, column }), "{to}: {error}");
    assert_eq!(error.kind(), kind, "{to}: {error}");
    assert!(error.message().starts_with(message), "{to}: {error}, expected {message}");
    let found = error.hint_text().unwrap_or_default();
    assert!(
        found.starts_with(hint) && found.is_empty() == hint.is_empty(),
        "{to}: hint `{found}`, expected `{hint}`"
    );
}

/// Checks a table of errors of kind [`ErrorKind::Invalid`]: from, to, message and hint between bars, `⏎` for a new line.
fn check_invalid(table: &str) {
    for row in table.lines().filter(|row| !row.is_empty()) {
        let cells: Vec<String> = row.split('|').map(|cell| cell.trim().replace('⏎', "\n")).collect();
        let [from, to, message, hint] = &cells[..] else { panic!("row `{row}`") };
        check(from, to, ErrorKind::Invalid, message, hint);
    }
}

/// Catches an element or attribute that is not known and passes.
#[test]
fn unknown_elements_and_attributes_are_refused() {
    check_invalid(
        r#"
<camera n | «<camra n | unknown element `camra` in `scene`, expected one of `camera`,  | did you mean `camera`?
<stream p | «<steam p | unknown element `steam` in `geometry`, expected one of `stream`,  | did you mean `stream`?
<param n | «<zzz n | unknown element `zzz` in `shader`, expected `param` |
<bakeset name="probes"> | <bakeset name="probes"> «<é/> | unknown element `é` in `bakeset` |
<shaders> | <shaders>«<stream/> | unknown element `stream` in `shaders`, expected `shader` |
micropolygons="1000"/> | micropolygons="1000">«<a/></stream> | unknown element `a` in `stream`, expected none |
fov= | «fow= | unknown attribute `fow` of `camera`, expected one of `name`, `fov`,  | did you mean `fov`?
<shaders> | <shaders «x="1"> | unknown attribute `x` of `shaders`, expected none |
<scene v | <scene «xmlns="http://x" v | unknown attribute `xmlns` of `scene` | did you mean `xmlns:xsi`?
name="bands" | «nam="bands" | unknown attribute `nam` of `param` | did you mean `name`?
occluder="true" | «ocluder="true" | unknown attribute `ocluder` of `geometry` | did you mean `occluder`?
seed="7" | «sed="7" | unknown attribute `sed` of `stream` | did you mean `seed`?
shader="occlusion" | «Shader="occlusion" | unknown attribute `Shader` of `attribute` | did you mean `shader`?
"#,
    );
}

/// Catches a document of another kind that is taken for a scene.
#[test]
fn the_root_is_a_scene() {
    let error = read(" <svg version='1.1'><circle/></svg>").unwrap_err();
    assert_eq!(error.to_string(), "folder/s.xml:1:2: unknown root element `svg`, expected `scene`");
}

/// Catches something missing that is passed over, or blamed on another element.
#[test]
fn missing_attributes_and_elements_are_named() {
    check_invalid(
        r#"
<scene version="1" | «<scene | attribute `version` of `scene` is missing | add `version="..."`
<scene version="1" units="cm" | «<scene version="1" | attribute `units` of `scene` is missing | add
<scene version="1" units="cm" up="z" | «<scene version="1" units="m" | attribute `up` of `scene` is missing | add
<camera name="shot" | «<camera | attribute `name` of `camera` is missing | add
<camera name="shot" fov="40" | «<camera name="shot" | attribute `fov` of `camera` is missing | add
<param name="bands" value="4" | «<param name="bands" | attribute `value` of `param` is missing | add
<shader name="plain" type="sh_occlusion" | «<shader name="plain" | attribute `type` of `shader` is missing | add
<stream procedural="jungle" micropolygons="1000" | «<stream | attribute `file` or `procedural` of `stream` is missing |
<stream procedural="jungle" micropolygons="1000" | «<stream procedural="jungle" | attribute `micropolygons` of `stream` is missing | add
<stream procedural="jungle" m | <stream file="a.ply" «m | unknown attribute `micropolygons` of `stream`, expected one of `file`, `dice` |
procedural="jungle" | file="a.ply" procedural="«jungle" | stream has both `file` and `procedural`, expected one |
<geometry name="ground" | «<geometry name="empty" occluder="true"/><geometry name="ground" | geometry `empty` has no stream |
<bakeset name="probes"> <attribute name="sh" shader="plain"/> | «<bakeset name="probes"> | bake set `probes` has no attributes |
"#,
    );
    check(
        "<geometry name=\"ground\"",
        "«<geometry name=\"idle\"><stream procedural=\"grass\" micropolygons=\"9\"/></geometry><geometry name=\"ground\"",
        ErrorKind::Invalid,
        "geometry `idle` is neither an occluder nor has it a bake set",
        "add `occluder",
    );
    let none = SCENE.replace("occluder=\"true\"", "").replace(" occluders=\"trees ground\"", "");
    let error = read(&none).unwrap_err();
    let message = "folder/s.xml:2:1: scene has no occluder, expected a geometry with `occluder=\"true\"`";
    assert_eq!((error.to_string().as_str(), error.kind()), (message, ErrorKind::Invalid));
    let bare = read("<scene version='1' units='m' up='y'/>").unwrap_err();
    assert_eq!(bare.message(), error.message());
}

/// Catches a value out of its set or range that passes, and the nearest word that is not offered.
#[test]
fn bad_values_are_refused() {
    check_invalid(
        r#"
units="cm" | units="«xm" | unknown unit `xm`, expected one of `m`, `cm`, `mm`, `km`, `in`, `ft`, `yd` | did you mean `m`?
units="cm" | units="«" | unknown unit `` |
up="z" | up="«Z" | unknown up axis `Z`, expected one of `y`, `z` | did you mean `z`?
fov="40" | fov="«180" | `180` is out of range, expected degrees more than 0 and less than 180 |
fov="40" | fov="«nan" | `nan` is not a finite number, expected degrees |
fov="40" | fov="«1e400" | `1e400` is not a finite number |
"1920 1080" | "«1920" | resolution `1920`, expected width and height | write it as `1920 1080`
"1920 1080" | "«1 2 3" | resolution `1 2 3`, expected width and height | write it as
"1920 1080" | "«0 1080" | `0` is out of range, expected a whole number from 1 to 65536 |
"1920 1080" | "1920 «-1" | `-1` is out of range |
0 0 1 0  1 2 3 1 | 0 0 1 0  1 2 «three 1 | `three` is not a number |
0 0 1 0  1 2 3 1 | 0 0 1 0  «inf 2 3 1 | `inf` is not a finite number |
matrix="1 0 0 0  0 1 0 0  0 0 1 0  1 | matrix="«1 0 0 0  0 1 0 0  0 0 1 0 | matrix of 15 numbers, expected 16 |
matrix="1 0 0 0  0 1 | matrix="«1 0 0 0  0 0 | matrix is not invertible | its three axes
matrix="2,0,0,0 | matrix="«2,0,0,5 | matrix is not affine | the translation is in the last four
type="sh_occlusion"> | type="«sh_oclusion"> | unknown shader type `sh_oclusion`, expected one of `sh_occlusion`,  | did you mean `sh_occlusion`?
name="samples" | name="«sample" | unknown parameter `sample`, expected one of `bands`, `samples`,  | did you mean `samples`?
value="4" | value="«7" | `7` is out of range, expected a whole number from 1 to 6 |
value="1024" | value="«15" | `15` is out of range, expected a whole number from 16 to 65536 |
value="1024" | value="«1e3" | `1e3` is not a whole number, expected |
value="sphere" | value="«spere" | unknown domain `spere`, expected one of `hemisphere`, `sphere` | did you mean `sphere`?
value="cosine" | value="«cos" | unknown weight `cos`, expected one of `uniform`, `cosine` | did you mean `cosine`?
value="12.5" | value="«0" | `0` is out of range, expected a number more than 0 |
value="f16" | value="«f64" | unknown storage `f64`, expected one of `f32`, `f16` | did you mean `f32`?
occluder="true" | occluder="«yes" | unknown truth value `yes`, expected one of `true`, `false` |
procedural="jungle" | procedural="«jungel" | unknown procedural stream `jungel`, expected one of `jungle`,  | did you mean `jungle`?
micropolygons="1000" | micropolygons="«0" | `0` is out of range, expected a whole number from 1 to 1000000000000 |
micropolygons="1000" | micropolygons="«1000000000001" | `1000000000001` is out of range |
seed="7" | seed="«-7" | `-7` is out of range, expected a whole number from 0 to 18446744073709551615 |
seed="7" | seed="«18446744073709551616" | `18446744073709551616` is out of range |
fov="40" | fov="4«&lol;" | broken reference | only `&amp;`
fov="40" | fov="4«&0" | broken reference | only `&amp;`
fov="40" | fov="«&#0;" | broken reference | only `&amp;`
"#,
    );
    let pixels = "picture of 65536 by 65536 pixels, at most 268435456";
    check("\"1920 1080\"", "\"«65536 65536\"", ErrorKind::Limit, pixels, "");
}

/// Catches names that clash, cannot be file names, or refer to nothing.
#[test]
fn names_are_legal_unique_and_known() {
    check_invalid(
        r#"
<shader name="plain" | <shader name="«occlusion" | duplicate shader name `occlusion` | the first one is at line 5, column 19
<shaders> | <camera name="«shot" fov="1" resolution="1 1" matrix="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/><shaders> | duplicate camera name `shot` | the first one is at line 3, column 17
name="samples" | name="«bands" | duplicate parameter name `bands` | the first one is at line 6, column 20
<geometry name="ground" | <geometry name="«trees" | duplicate geometry name `trees` | the first one is at line 13, column 21
<bakeset name="probes" | <bakeset name="«Trees" | duplicate bake set name `Trees` | the first one is at line 16, column 22
name="shadow" | name="«sh" | duplicate attribute name `sh` | the first one is at line 17, column 26
name="shot" | name="«" | `` cannot name a camera |
name="plain" | name="«two words" | `two words` cannot name a shader |
<bakeset name="probes" | <bakeset name="«../probes" | `../probes` cannot name a bake set |
<bakeset name="probes" | <bakeset name="«.." | `..` cannot name a bake set |
name="shadow" | name="«sha/dow" | `sha/dow` cannot name an attribute |
name="shadow" | name="«opacity" | `opacity` is a standard attribute of streams |
shader="occlusion" | shader="«oclusion" | unknown shader `oclusion`, expected one of `occlusion`, `plain` | did you mean `occlusion`?
"trees ground" | "trees «grund" | unknown occluder `grund`, expected one of `ground`, `trees` | did you mean `ground`?
"trees ground" | "trees⏎ «probes" | geometry `probes` is no occluder | add `occluder="true"` to it, at line 26, column 21
"trees ground" | "trees ground «trees" | occluder `trees` is there twice |
output="ambient_occlusion" | output="«ambient_oclusion" | unknown output `ambient_oclusion`, expected one of `coefficients`,  | did you mean `ambient_occlusion`?
"trees ground" | "« " | list of occluders is empty | a bake set without `occluders` sees all
"#,
    );
    let long = format!("name=\"«{}\"", "n".repeat(65));
    check("name=\"shot\"", &long, ErrorKind::Invalid, "`nnn", "");
    assert!(read(&SCENE.replace("name=\"shadow\"", "name=\"my:attribute.1\"")).is_ok());
}

/// Catches a declaration that is ignored though this version cannot do it, or refused without looking at it.
#[test]
fn what_is_not_supported_yet_is_refused() {
    for (from, to, message) in [
        ("version=\"1\" u", "version=\"«2\" x=\"\" u", "scene version `2` found, `1` wanted"),
        (
            "type=\"sh_occlusion\">",
            "type=\"«irradiance\">",
            "shaders of type `irradiance` are not supported yet",
        ),
        (
            "type=\"sh_occlusion\">",
            "type=\"«area_light\">",
            "shaders of type `area_light` are not supported yet",
        ),
        (
            "type=\"sh_occlusion\">",
            "type=\"«reflection\">",
            "shaders of type `reflection` are not supported yet",
        ),
        (
            "<instance m",
            "«<displacement shader=\"plain\" bound=\"1\"/><instance m",
            "displacement is not supported yet",
        ),
        (
            "<attribute",
            "«<filter type=\"backface\" camera=\"shot\"/><attribute",
            "filters are not supported yet",
        ),
    ] {
        let hint = "";
        check(from, to, ErrorKind::Unsupported, message, hint);
    }
    check_invalid(
        r#"
<attribute | <filter type="«backfase"/><attribute | unknown filter type `backfase` | did you mean `backface`?
<attribute | <filter type="frustum" camera="«shoot"/><attribute | unknown camera `shoot`, expected `shot` | did you mean `shot`?
<instance m | <displacement shader="«plane" bound="1"/><instance m | unknown shader `plane` | did you mean `plain`?
<instance m | «<displacement shader="plain"/><instance m | attribute `bound` of `displacement` is missing | add
"#,
    );
}

/// Catches ill-formed XML whose error has lost its place on the way through the whole parser.
#[test]
fn ill_formed_scenes_are_refused_at_their_place() {
    check_invalid(
        r#"
</scene>⏎ | </scene>⏎«<scene/> | second root element |
</bakeset> | «</geometry> | `</geometry>` found, `</bakeset>` expected | `bakeset` was opened at line 16, column 7
<shaders> | <shaders> «text | text is not allowed here |
"#,
    );
    check(
        "<scene v",
        "«<!DOCTYPE scene [<!ENTITY a \"b\">]><scene v",
        ErrorKind::Unsupported,
        "document type declarations",
        "remove",
    );
    let open = SCENE.replace("</scene>", "");
    assert_eq!(read(&open).unwrap_err().to_string(), "folder/s.xml:2:1: element `scene` is never closed");
}

/// Catches a limit of the grammar that is not kept.
#[test]
fn counts_are_limited() {
    let count = |from: &str, unit: &dyn Fn(usize) -> String, count: usize| {
        let many: String = (0..count).map(unit).collect();
        read(&SCENE.replacen(from, &format!("{from}{many}"), 1))
    };
    let check = |from: &str, unit: &dyn Fn(usize) -> String, max: usize, message: &str| {
        count(from, unit, max).expect(message);
        let error = count(from, unit, max + 1).expect_err(message);
        assert_eq!((error.kind(), error.message()), (ErrorKind::Limit, message));
    };
    let shader = |i| format!("<shader name='s{i}' type='sh_occlusion'/>");
    check("<shaders>", &shader, parse::SHADERS_MAX - 2, "more than 4096 shaders");
    let matrix = |_| "<instance matrix='1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1'/>".to_owned();
    let instances_max = geometry::INLINE_INSTANCES_MAX - 1;
    check("micropolygons=\"1000\"/>", &matrix, instances_max, "more than 100000 matrices in a scene file");
    let geometry = |i| {
        format!(
            "<geometry name='g{i}' occluder='true'><stream procedural='grass' micropolygons='1'/></geometry>"
        )
    };
    check("<geometries>", &geometry, geometry::GEOMETRIES_MAX - 3, "more than 65536 geometries");
    let attribute = |i| format!("<attribute name='a{i}' shader='plain'/>");
    check("<bakeset name=\"probes\">", &attribute, 63, "more than 64 attributes in a bake set");
}
