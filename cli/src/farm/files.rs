//! The files that a scene needs on a farm: those it names, and those that these name in turn.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use engine::scene::{Instances, Scene, StreamSource};
use engine::{Error, Result};
use protocol::{keys, limits};

/// Types of files that a USD file may name.
const USD_TYPES: [&str; 9] = ["usd", "usda", "usdc", "usdz", "png", "jpg", "jpeg", "exr", "hdr"];
/// Bytes of a file that is searched for names at most.
const SEARCH_BYTES_MAX: u64 = 1 << 30;

/// Files below the scene's folder, by relative path.
pub type Files = BTreeMap<String, PathBuf>;

/// Adds the files that `scene` needs to `files`, except those below the asset `roots`.
///
/// # Errors
/// When a file does not lie below the scene's folder, or cannot be read.
pub fn collect(scene: &Scene, roots: &[PathBuf], files: &mut Files) -> Result<()> {
    let base = scene.path.parent().unwrap_or(Path::new(""));
    let mut named: BTreeSet<PathBuf> = BTreeSet::new();
    for geometry in &scene.geometries {
        for stream in &geometry.streams {
            if let StreamSource::File(path, _) = stream {
                named.extend(named_by(path)?);
                named.insert(path.clone());
            }
        }
        for instances in &geometry.instances {
            if let Instances::File(path) = instances {
                named.insert(path.clone());
            }
        }
    }
    for path in named {
        if roots.iter().any(|root| path.starts_with(root)) {
            continue;
        }
        let relative =
            path.strip_prefix(base).ok().and_then(Path::to_str).map(|path| path.trim_start_matches("./"));
        let Some(relative) = relative.filter(|relative| keys::is_relative(relative)) else {
            return Err(Error::invalid("the file does not lie below the scene's folder")
                .at(&path)
                .hint("move it there, or name it below an asset root of the farm, `root:NAME/path`"));
        };
        files.insert(relative.into(), path);
    }
    if files.len() > limits::FILES_MAX {
        return Err(Error::invalid(format!(
            "the scene needs {} files, {} at most",
            files.len(),
            limits::FILES_MAX
        )));
    }
    Ok(())
}

/// The files that a geometry's file names.
fn named_by(path: &Path) -> Result<Vec<PathBuf>> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let there = |names: Vec<String>| {
        names.iter().map(|name| folder.join(name)).filter(|path| path.is_file()).collect()
    };
    match extension.as_str() {
        "gltf" => Ok(there(gltf_names(path)?)),
        "obj" => {
            let materials: Vec<PathBuf> = there(words_after(path, |word| word == "mtllib")?);
            let mut found = materials.clone();
            for material in &materials {
                found.extend::<Vec<_>>(there(words_after(material, |word| word.starts_with("map_"))?));
            }
            Ok(found)
        }
        // Layers may name each other in ways that only a composition knows
        "usd" | "usda" | "usdc" => below(folder, &USD_TYPES),
        _ => Ok(Vec::new()),
    }
}

/// The URIs of a glTF file that are no data.
fn gltf_names(path: &Path) -> Result<Vec<String>> {
    let io = |error| Error::io("read", path, error);
    let mut text = Vec::new();
    std::fs::File::open(path).map_err(io)?.take(SEARCH_BYTES_MAX).read_to_end(&mut text).map_err(io)?;
    let json: serde_json::Value = serde_json::from_slice(&text)
        .map_err(|error| Error::invalid("this is not a glTF file").at(path).caused_by(error))?;
    let uris = ["buffers", "images"].iter().filter_map(|list| json[*list].as_array()).flatten();
    let uris = uris.filter_map(|entry| entry["uri"].as_str()).filter(|uri| !uri.starts_with("data:"));
    Ok(uris.map(|uri| uri.replace("%20", " ")).collect())
}

/// What stands after the words of a text file's lines that `is_wanted`: a path, which may have spaces.
fn words_after(path: &Path, is_wanted: impl Fn(&str) -> bool) -> Result<Vec<String>> {
    let io = |error| Error::io("read", path, error);
    let mut lines = BufReader::new(std::fs::File::open(path).map_err(io)?.take(SEARCH_BYTES_MAX));
    let (mut line, mut found) = (Vec::new(), Vec::new());
    loop {
        line.clear();
        if lines.read_until(b'\n', &mut line).map_err(io)? == 0 {
            return Ok(found);
        }
        let text = String::from_utf8_lossy(&line);
        if let Some((_, rest)) =
            text.trim().split_once(char::is_whitespace).filter(|(word, _)| is_wanted(word))
        {
            // Options of textures come first, the file last
            found.push(rest.trim().replace('\\', "/"));
            found.extend(rest.split_whitespace().last().map(|last| last.replace('\\', "/")));
        }
    }
}

/// Files of the given types in `folder` and below, as many as a job may have.
fn below(folder: &Path, types: &[&str]) -> Result<Vec<PathBuf>> {
    let (mut found, mut folders) = (Vec::new(), vec![folder.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        let io = |error| Error::io("read", &folder, error);
        for entry in std::fs::read_dir(&folder).map_err(io)? {
            let entry = entry.map_err(io)?;
            let (path, kind) = (entry.path(), entry.file_type().map_err(io)?);
            let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
            if kind.is_dir() {
                folders.push(path);
            } else if types.contains(&&*extension) {
                found.push(path);
            }
            if found.len() + folders.len() > limits::FILES_MAX {
                return Err(Error::invalid("too many files")
                    .at(&folder)
                    .hint("give the asset a folder of its own"));
            }
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a file that a model names and the farm would miss, and one outside of the scene's folder that is sent.
    #[test]
    fn files_that_files_name_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        write("scene/models/a.obj", "mtllib a b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
        write("scene/models/a b.mtl", "newmtl m\nmap_Kd -s 1 1 1 leaf.png\n");
        write("scene/models/leaf.png", "");
        write(
            "scene/models/c.gltf",
            r#"{"buffers":[{"uri":"c%20d.bin"},{"uri":"data:,x"}],"images":[{"uri":"leaf.png"}]}"#,
        );
        write("scene/models/c d.bin", "");
        write("scene/copies.csv", "");
        write("elsewhere.obj", "");
        let scene = |file: &str| {
            let text = format!(
                r#"<scene version="1" units="m" up="y"><geometries><geometry name="a" occluder="true"><stream file="{file}"/>
                <instances file="copies.csv"/></geometry></geometries></scene>"#
            );
            engine::scene::parse(&folder.path().join("scene/scene.xml"), &text).unwrap()
        };
        let mut files = Files::new();
        collect(&scene("models/a.obj"), &[], &mut files).unwrap();
        collect(&scene("models/c.gltf"), &[], &mut files).unwrap();
        let expected = [
            "copies.csv",
            "models/a b.mtl",
            "models/a.obj",
            "models/c d.bin",
            "models/c.gltf",
            "models/leaf.png",
        ];
        assert_eq!(files.keys().collect::<Vec<_>>(), expected);
        assert!(collect(&scene("../elsewhere.obj"), &[], &mut files).is_err());
    }
}
