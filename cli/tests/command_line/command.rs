//! Runs `pantaray` as a user would and looks at what comes out.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

/// What a run left: exit code, standard output, standard error.
#[derive(Debug)]
pub struct Run {
    /// Exit code; -1 when a signal ended it.
    pub code: i32,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

/// The command, ready for arguments.
pub fn pantaray() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_pantaray"));
    command.env_remove("RUST_LOG");
    command
}

/// Runs it.
pub fn run<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Run {
    pantaray().args(arguments).output().expect("pantaray runs").into()
}

/// Runs it with `--json --quiet`; it must succeed, print exactly one object, and say nothing on standard error.
pub fn json<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Value {
    let output = pantaray().args(arguments).args(["--json", "--quiet"]).output().expect("pantaray runs");
    let run = Run::from(output);
    assert_eq!((run.code, run.err.as_str()), (0, ""), "{run:?}");
    let value: Value = serde_json::from_str(&run.out).unwrap_or_else(|error| panic!("{error}: {run:?}"));
    assert!(value.is_object(), "{value}");
    value
}

/// Runs it; it must fail with code 1, one error that says `message`, a hint if there is one to expect, and nothing on
/// standard output.
pub fn fails<S: AsRef<std::ffi::OsStr>>(
    arguments: impl IntoIterator<Item = S>,
    message: &str,
    hint: Option<&str>,
) {
    let run = run(arguments);
    assert_eq!((run.code, run.out.as_str()), (1, ""), "{run:?}");
    assert_eq!(run.err.matches("error: ").count(), 1, "{run:?}");
    assert!(run.err.contains(message), "{message} expected: {run:?}");
    assert!(!run.err.contains('\x1b') && !run.err.contains("panicked"), "{run:?}");
    if let Some(hint) = hint {
        let said = run.err.split("\n\nhint: ").nth(1).unwrap_or_else(|| panic!("a hint expected: {run:?}"));
        assert!(said.contains(hint), "{hint} expected: {run:?}");
    }
}

impl From<Output> for Run {
    fn from(output: Output) -> Self {
        let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
        Self { code: output.status.code().unwrap_or(-1), out: text(output.stdout), err: text(output.stderr) }
    }
}

/// A folder of the repository.
pub fn repository(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name)
}

/// Names in a folder, in order.
pub fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("a folder");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}
