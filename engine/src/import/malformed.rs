//! Tests on broken files of others: nothing panics, and every refusal says which file and where.

use std::path::{Path, PathBuf};

use super::assets::{collect, folder};
use super::is_importable;
use crate::error::Place;

/// Every importable file below a folder, in order.
fn importable_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if is_importable(&path) {
                files.push(path);
            }
        }
    }
    files.sort();
    files
}

/// Catches a panic on files that a validator refuses, an error that does not say in which file, and broken structure that is
/// read all the same.
#[test]
fn files_that_a_validator_refuses_never_panic() {
    let Some(folder) = folder() else { return };
    let files = importable_below(&folder.join("malformed"));
    // Read or refused, without and with errors by the validator
    let mut tally = [[0; 2]; 2];
    let mut panics = Vec::new();
    for path in &files {
        let Ok(outcome) = std::panic::catch_unwind(|| collect(path).map(|(_, report)| report)) else {
            panics.push(path.clone());
            continue;
        };
        if let Err(error) = &outcome {
            let named = match error.place() {
                Some(
                    Place::Path(named) | Place::Text { path: named, .. } | Place::Byte { path: named, .. },
                ) => named,
                None => panic!("{}: `{error}` names no file", path.display()),
            };
            // Its own name, or that of a file beside it that it refers to
            assert!(named.starts_with(path.parent().unwrap()), "{}: {error}", path.display());
        }
        let oracle = std::fs::read_to_string(format!("{}.report.json", path.display())).ok();
        let errors = oracle.and_then(|text| serde_json::from_str::<serde_json::Value>(&text).ok());
        if let Some(errors) = errors.and_then(|report| report["issues"]["numErrors"].as_u64()) {
            tally[usize::from(errors > 0)][usize::from(outcome.is_err())] += 1;
        }
    }
    let [[good_read, good_refused], [bad_read, bad_refused]] = tally;
    eprintln!(
        "{} malformed files; the validator finds no error: {good_read} read, {good_refused} refused; \
         errors: {bad_read} read (most in animations, skins and cameras), {bad_refused} refused",
        files.len(),
    );
    assert!(files.len() > 300 && panics.is_empty(), "{panics:?}");
    assert!(good_refused <= 5 && bad_refused >= 60, "{tally:?}");
}

/// Catches a panic in what reads vertices and indices: most malformed documents show no mesh, so all are shown here.
#[test]
fn malformed_meshes_never_panic() {
    let Some(folder) = folder() else { return };
    let (mut shown, mut refused, mut faces) = (0, 0, 0);
    for path in importable_below(&folder.join("malformed/gltf")) {
        let text = std::fs::read(&path).unwrap();
        let Ok(mut document) = serde_json::from_slice::<serde_json::Value>(&text) else { continue };
        let Some(meshes) = document["meshes"].as_array().map(Vec::len).filter(|&meshes| meshes > 0) else {
            continue;
        };
        document["nodes"] = (0..meshes).map(|mesh| serde_json::json!({ "mesh": mesh })).collect();
        document["scenes"] = serde_json::json!([{ "nodes": (0..meshes).collect::<Vec<_>>() }]);
        document["scene"] = 0.into();
        // Buffers lie beside the document
        let copy = tempfile::tempdir().unwrap();
        for entry in std::fs::read_dir(path.parent().unwrap()).unwrap() {
            let entry = entry.unwrap();
            if entry.file_type().unwrap().is_file() && entry.path().extension().is_some_and(|e| e == "bin") {
                std::fs::copy(entry.path(), copy.path().join(entry.file_name())).unwrap();
            }
        }
        let patched = copy.path().join("patched.gltf");
        std::fs::write(&patched, document.to_string()).unwrap();
        let outcome = std::panic::catch_unwind(|| collect(&patched).map(|(_, report)| report));
        shown += 1;
        match outcome {
            Ok(Ok(report)) => faces += report.micropolygons,
            Ok(Err(_)) => refused += 1,
            Err(_) => panic!("{} panics when its meshes are shown", path.display()),
        }
    }
    eprintln!("{shown} documents with all meshes shown: {refused} refused, {faces} faces from the rest");
    assert!(shown > 30);
}
