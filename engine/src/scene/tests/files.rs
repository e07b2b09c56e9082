//! Files that scenes name, and the files that come with the project: examples, schema and documentation.

use std::fs::File;
use std::path::Path;

use crate::error::Place;
use crate::scene::*;

/// A folder with stream and instance files and a scene that names `stream` and `instances`.
fn with_files(stream: &str, instances: &str, frame: Option<i64>) -> (tempfile::TempDir, Result<Scene>) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("set.ply")).unwrap();
    for name in ["tree.obj", "tree.0007.GLB", "scatter.csv"] {
        std::fs::write(folder.path().join(name), "").unwrap();
    }
    let text = format!(
        "<scene version='1' units='m' up='y'>\n<geometries><geometry name='a' occluder='true'>\n<stream file='{stream}'/>\n<instances file='{instances}'/>\n</geometry></geometries></scene>"
    );
    let path = folder.path().join("scene.xml");
    std::fs::write(&path, text).unwrap();
    let scene = load_frame(&path, frame);
    (folder, scene)
}

/// Catches a path that is not taken relative to the scene file, a frame that is not filled in, or an absolute path that
/// is refused.
#[test]
fn files_are_found_beside_the_scene() {
    for (stream, frame, expected) in [
        ("tree.obj", None, "tree.obj"),
        ("./tree.obj", Some(3), "./tree.obj"),
        ("tree.####.GLB", Some(7), "tree.0007.GLB"),
        ("tree.%04d.GLB", Some(7), "tree.0007.GLB"),
    ] {
        let (folder, scene) = with_files(stream, "scatter.csv", frame);
        let geometry = &scene.unwrap().geometries[0];
        assert_eq!(geometry.streams, [StreamSource::File(folder.path().join(expected), None)]);
        assert_eq!(geometry.instances, [Instances::File(folder.path().join("scatter.csv"))]);
    }
    let elsewhere = tempfile::NamedTempFile::with_suffix(".mgs").unwrap();
    let (_folder, scene) = with_files(elsewhere.path().to_str().unwrap(), "scatter.csv", None);
    assert_eq!(scene.unwrap().geometries[0].streams, [StreamSource::File(elsewhere.path().into(), None)]);
}

/// Catches a scene from elsewhere that reads a file of this machine by an absolute path, by `..` or through a link.
#[test]
fn confined_scenes_stay_in_their_folders() {
    let outside = tempfile::tempdir().unwrap();
    std::fs::write(outside.path().join("secret.obj"), "").unwrap();
    let roots = Roots::from([("props".to_string(), outside.path().to_path_buf())]);
    let load = |stream: &str| {
        let (folder, _) = with_files(stream, "scatter.csv", None);
        #[cfg(unix)]
        std::os::unix::fs::symlink(outside.path(), folder.path().join("link")).unwrap();
        load_confined(&folder.path().join("scene.xml"), None, &roots).map(|scene| scene.geometries.len())
    };
    assert_eq!(load("tree.obj").unwrap() + load("root:props/secret.obj").unwrap(), 2);
    let absolute = outside.path().join("secret.obj");
    let up = format!("../{}/secret.obj", outside.path().file_name().unwrap().to_str().unwrap());
    for path in [absolute.to_str().unwrap(), &up, "root:props/../secret.obj", "link/secret.obj"] {
        let error = load(path).unwrap_err();
        assert!(error.message().contains("leads out"), "{path}: {error}");
    }
    assert_eq!(load("root:prop/secret.obj").unwrap_err().hint_text(), Some("did you mean `root:props/`?"));
}

/// Catches a file that is missing or of an unknown type and is noticed only hours into a bake.
#[test]
fn missing_and_unknown_files_are_refused() {
    for (stream, instances, kind, place, message, hint) in [
        (
            "treee.obj",
            "scatter.csv",
            ErrorKind::NotFound,
            "3:15",
            "is not there",
            "did you mean `tree.obj`, in the same folder?",
        ),
        (
            "tree.obj",
            "scater.csv",
            ErrorKind::NotFound,
            "4:18",
            "is not there",
            "did you mean `scatter.csv`, in the same folder?",
        ),
        (
            "no/zzz.obj",
            "scatter.csv",
            ErrorKind::NotFound,
            "3:15",
            "is not there",
            "paths are relative to the scene file",
        ),
        ("set.ply", "scatter.csv", ErrorKind::Invalid, "3:15", "is a folder, expected a file", ""),
        (
            "tree.glt",
            "scatter.csv",
            ErrorKind::Invalid,
            "3:15",
            "unknown file type `.glt`, expected one of `.mgs`, `.ply`, `.obj`, `.gltf`, `.glb`",
            "did you mean `.gltf`?",
        ),
        ("tree", "scatter.csv", ErrorKind::Invalid, "3:15", "file without a type, expected one of", ""),
        ("", "scatter.csv", ErrorKind::Invalid, "3:15", "path is empty", ""),
        ("tree&#10;.obj", "scatter.csv", ErrorKind::Invalid, "3:15", "path holds a control character", ""),
        (
            "tree.####.glb",
            "scatter.csv",
            ErrorKind::Invalid,
            "3:15",
            "path `tree.####.glb` has a frame pattern, but no frame was given",
            "choose one: `--frame N`",
        ),
        (
            "tree.obj",
            "scatter%d.csv",
            ErrorKind::Invalid,
            "4:18",
            "path `scatter%d.csv` has a frame pattern",
            "choose one",
        ),
    ] {
        let (folder, scene) = with_files(stream, instances, None);
        let error = scene.expect_err(stream);
        let path = folder.path().join("scene.xml");
        assert_eq!(error.place().unwrap().to_string(), format!("{}:{place}", path.display()), "{error}");
        assert_eq!(error.kind(), kind, "{error}");
        assert!(error.message().contains(message), "{error}");
        let found = error.hint_text().unwrap_or_default();
        assert!(found.starts_with(hint) && found.is_empty() == hint.is_empty(), "{error}: hint `{found}`");
    }
}

/// Catches a scene file that is absent, too long or in another encoding and is not called so.
#[test]
fn unreadable_scene_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.xml");
    let load_bytes = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        load(&path).unwrap_err()
    };
    let error = load(&path).unwrap_err();
    assert_eq!((error.kind(), error.place()), (ErrorKind::NotFound, Some(&Place::Path(path.clone()))));
    let error = load_bytes(b"\xef\xbb\xbf<scene>\n<\xc3\xa9 \xff");
    assert!(error.to_string().ends_with("scene.xml:2:4: text is not UTF-8"), "{error}");
    let error = load_bytes(b"\xff\xfe<\0");
    assert_eq!(error.hint_text(), Some("it looks like UTF-16: save the file as UTF-8"));
    File::create(&path).unwrap().set_len(1 << 40).unwrap();
    assert_eq!(load(&path).unwrap_err().kind(), ErrorKind::Limit);
}

/// Catches an example that the grammar has left behind, in a scene or in what its instance files hold.
#[test]
fn every_example_is_valid() {
    let mut count = 0;
    for entry in std::fs::read_dir(repository().join("examples")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "xml") {
            let scene = load(&path).unwrap_or_else(|error| panic!("{error}, hint: {:?}", error.hint_text()));
            for geometry in &scene.geometries {
                for_each_instance(&geometry.instances, |_, _| Ok(())).unwrap();
            }
            count += 1;
        }
    }
    assert!(count >= 3, "only {count} examples");
}

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap()
}

/// Catches documentation whose example the grammar has left behind.
#[test]
fn the_documented_example_is_valid() {
    let documentation = std::fs::read_to_string(repository().join("docs/scene.md")).unwrap();
    let (_, rest) = documentation.split_once("```xml\n").unwrap();
    let (example, _) = rest.split_once("```").unwrap();
    let folder = tempfile::tempdir().unwrap();
    for name in ["trees.glb", "scatter.csv"] {
        std::fs::write(folder.path().join(name), "").unwrap();
    }
    let scene = parse(&folder.path().join("scene.xml"), example).unwrap();
    assert_eq!(scene.geometries.len(), 2);
}

/// Catches a word that the engine knows and the schema or the documentation does not.
#[test]
fn schema_and_documentation_know_every_word() {
    let schema = std::fs::read_to_string(repository().join("docs/scene.xsd")).unwrap();
    let documentation = std::fs::read_to_string(repository().join("docs/scene.md")).unwrap();
    let units = UNITS.map(|(unit, _)| unit);
    let types = shader::TYPES.map(|(name, _)| name);
    let words = [&units[..], &types, &shader::SH_OCCLUSION, &geometry::FILTERS].concat();
    for word in words {
        assert!(schema.contains(&format!("<xs:enumeration value=\"{word}\"/>")), "`{word}` in the schema");
        assert!(documentation.contains(word), "`{word}` in the documentation");
    }
    for file_type in files::STREAM_TYPES {
        assert!(documentation.contains(&format!("`.{file_type}`")), "`.{file_type}` in the documentation");
    }
}
