//! How the database means to find what the loops and the workers ask for: never by looking through all that ever was.

use super::{Store, Value};

/// Statements of the loops and of workers.
const SOURCES: [(&str, &str); 8] = [
    ("claim", include_str!("claim.rs")),
    ("complete", include_str!("complete.rs")),
    ("control", include_str!("control.rs")),
    ("farm", include_str!("farm.rs")),
    ("graph", include_str!("graph.rs")),
    ("lease", include_str!("lease.rs")),
    ("opinion", include_str!("opinion.rs")),
    ("traced", include_str!("traced.rs")),
];

/// Tables that grow with what has been done.
const HISTORY: [&str; 6] = ["job", "pass", "segment", "batch", "batch_fault", "event"];

/// Indexes that have what is to be done alone.
const LIVE: [&str; 3] = ["pass_live", "segment_ready", "batch_lease"];

/// Statements in a source, with what is put together when they are used left out.
fn statements(source: &str) -> Vec<String> {
    let mut found = Vec::new();
    for text in source.split('"').skip(1).step_by(2) {
        let starts = ["SELECT ", "UPDATE ", "DELETE ", "INSERT ", "WITH "];
        if !starts.iter().any(|start| text.starts_with(start)) {
            continue;
        }
        let mut statement = String::new();
        let mut depth = 0;
        for c in text.chars() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                c if depth == 0 => statement.push(c),
                _ => {}
            }
        }
        found.push(statement);
    }
    found
}

/// Whether a step of a plan looks through all batches of a pass.
fn looks_through_pass(step: &str) -> bool {
    ["SEARCH batch ", "SEARCH b "].iter().any(|start| step.starts_with(start))
        && step.ends_with("(pass_id=?)")
}

/// Whether a step of a plan looks through one of [`HISTORY`], which `statement` may call by another name.
fn looks_through_history(step: &str, statement: &str) -> bool {
    let Some(rest) = step.strip_prefix("SCAN ") else { return false };
    let name = rest.split(' ').next().unwrap_or_default();
    let words: Vec<&str> = statement.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
    let is_history = |table: &str| HISTORY.contains(&table);
    let is_name_of = |pair: &[&str]| is_history(pair[0]) && pair[1] == name;
    (is_history(name) || words.windows(2).any(is_name_of)) && !LIVE.iter().any(|index| rest.ends_with(index))
}

/// Catches a claim, a completion or a round of the loops that takes the longer the more has been done before it.
#[tokio::test]
async fn nothing_looks_through_history() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(&format!("sqlite:{}", folder.path().join("q.db").display()), 1).await.unwrap();
    store.migrate().await.unwrap();
    let mut explained = 0;
    for (source, text) in SOURCES {
        for statement in statements(text) {
            // Some are parts, which say nothing alone
            if !statement.contains("WHERE") {
                continue;
            }
            let values =
                (1..).take_while(|n| statement.contains(&format!("${n}"))).map(|_| Value::Int(Some(1)));
            let explain = format!("EXPLAIN QUERY PLAN {statement}");
            let Ok(plan) = store.driver().query(explain.into(), values.collect()).await else { continue };
            explained += 1;
            for step in plan {
                let step = step.text(3).unwrap();
                assert!(!looks_through_history(&step, &statement), "{source}: {step}: {statement}");
                let is_of_worker = ["claim", "complete", "lease"].contains(&source);
                assert!(!(is_of_worker && looks_through_pass(&step)), "{source}: {step}: {statement}");
            }
        }
    }
    assert!(explained > 60, "{explained}");
}
