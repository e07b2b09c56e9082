//! Damaged scenes and rubble: an error with its place, never a panic.

use proptest::prelude::*;

use super::{SCENE, read};
use crate::error::Place;
use crate::scene::load;

/// A random edit of a text: at a fraction of its length, so many bytes out, something in.
fn edit() -> impl Strategy<Value = (f64, usize, Vec<u8>)> {
    let tokens = [
        "<",
        ">",
        "/>",
        "</",
        "\"",
        "'",
        "&",
        "&#",
        ";",
        "=",
        " ",
        "<!--",
        "<?xml",
        "<![CDATA[",
        "<!DOCTYPE [",
        "]]>",
        "-->",
        "?>",
        "\u{feff}",
        "é",
        "nan",
        "1e999",
        "<scene>",
        "stream",
        "####",
    ];
    let token = prop::sample::select(tokens.to_vec()).prop_map(|token| token.as_bytes().to_vec());
    (
        0.0..1.0,
        prop_oneof![Just(0), 0..4usize, 0..200usize],
        prop_oneof![token, prop::collection::vec(any::<u8>(), 0..4)],
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Catches a panic on a scene that was damaged in a few places, and an error without its place.
    #[test]
    fn damaged_scenes_never_panic(edits in prop::collection::vec(edit(), 1..6)) {
        let mut bytes = SCENE.as_bytes().to_vec();
        for (at, out, new) in edits {
            let start = (at * bytes.len() as f64) as usize;
            let end = (start + out).min(bytes.len());
            bytes.splice(start..end, new);
        }
        if let Err(error) = read(&String::from_utf8_lossy(&bytes)) {
            prop_assert!(matches!(error.place(), Some(Place::Text { .. })), "{error}");
        }
    }

    /// Catches a panic on text made of nothing but the pieces of XML, in any order.
    #[test]
    fn rubble_never_panics(edits in prop::collection::vec(edit(), 0..40)) {
        let bytes: Vec<u8> = edits.into_iter().flat_map(|(_, _, new)| new).collect();
        let error = read(&String::from_utf8_lossy(&bytes)).unwrap_err();
        prop_assert!(matches!(error.place(), Some(Place::Text { .. })), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Catches a panic on a file of arbitrary bytes.
    #[test]
    fn arbitrary_files_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        prop_assert!(load(file.path()).is_err());
    }
}
