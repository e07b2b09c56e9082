//! The document against the code, and against the pages that people read.

use super::{document, roles};

const OPENAPI: &str = include_str!("../../../docs/openapi.json");
const API: &str = include_str!("../../../docs/api.md");

/// Catches a document that does not say what the code does. `PANTARAY_WRITE=1` writes it anew.
#[test]
fn the_document_is_up_to_date() {
    let text = format!("{:#}\n", document());
    if std::env::var_os("PANTARAY_WRITE").is_some() {
        std::fs::write(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/openapi.json"), &text).unwrap();
    } else {
        assert!(text == OPENAPI, "docs/openapi.json is not what the code says: PANTARAY_WRITE=1 writes it");
    }
}

/// Catches an operation that says nothing about who may do it, and one that is missing in the table, or there with
/// another role.
#[test]
fn every_operation_has_its_role_and_its_line() {
    let document = document();
    let roles = roles(&document);
    assert!(roles.len() > 30);
    for ((method, path), role) in roles {
        let security = &document["paths"][&path][method.to_lowercase()]["security"];
        assert!(security.as_array().is_some_and(|s| s.len() == 1), "{method} {path} declares no role");
        let role = role.map_or("none", |role| role.word());
        let line = format!("| {method} | `{path}` | {role} |");
        assert!(API.contains(&line), "docs/api.md has no line `{line}`");
    }
}
