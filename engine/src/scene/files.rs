//! The files a scene names: frame patterns, known types, and whether they are there.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use super::element::Value;
use super::xml::cut;
use crate::error::nearest;
use crate::{ErrorKind, Result};

/// Types of files that a stream can come from.
pub(super) const STREAM_TYPES: [&str; 9] =
    ["mgs", "ply", "obj", "gltf", "glb", "usd", "usda", "usdc", "usdz"];
/// Digits of a frame number at most, in a pattern.
const FRAME_DIGITS_MAX: usize = 9;
/// Entries of a folder to look at, at most, for a name like the one that is missing.
const FOLDER_ENTRIES_MAX: usize = 4096;

/// Folders by name that a scene from elsewhere may read, as `root:NAME/path`, besides its own folder.
pub type Roots = BTreeMap<String, PathBuf>;

/// How paths in a scene become files.
pub(super) struct Files<'a> {
    /// The folder of the scene file.
    pub base: &'a Path,
    /// The frame that patterns stand for.
    pub frame: Option<i64>,
    /// Set for a scene that is not trusted: nothing but the scene's folder and these may be read.
    pub roots: Option<&'a Roots>,
}

impl Files<'_> {
    /// The file that a stream comes from: of a known type, and there.
    pub fn stream(&self, value: &Value<'_>) -> Result<PathBuf> {
        let path = self.resolve(value)?;
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        if !STREAM_TYPES.contains(&&*extension) {
            let known = STREAM_TYPES.map(|known| format!("`.{known}`")).join(", ");
            let message = match extension.as_str() {
                "" => format!("file without a type, expected one of {known}"),
                other => format!("unknown file type `.{}`, expected one of {known}", cut(other)),
            };
            let error = value.error(ErrorKind::Invalid, message);
            return Err(match nearest(&extension, STREAM_TYPES) {
                Some(near) => error.hint(format!("did you mean `.{near}`?")),
                None => error,
            });
        }
        there(value, path)
    }

    /// The file that instances come from.
    pub fn instances(&self, value: &Value<'_>) -> Result<PathBuf> {
        there(value, self.resolve(value)?)
    }

    /// The path with its frame, relative to the scene file's folder.
    fn resolve(&self, value: &Value<'_>) -> Result<PathBuf> {
        if value.text().trim().is_empty() {
            return Err(value.error(ErrorKind::Invalid, "path is empty, expected a file"));
        }
        if value.text().chars().any(char::is_control) {
            return Err(value.error(ErrorKind::Invalid, "path holds a control character"));
        }
        let Some(path) = with_frame(value.text(), self.frame) else {
            let message = format!("path `{}` has a frame pattern, but no frame was given", cut(value.text()));
            return Err(value.error(ErrorKind::Invalid, message).hint("choose one: `--frame N`"));
        };
        match self.roots {
            None => Ok(self.base.join(path)),
            Some(roots) => confined(value, self.base, roots, &path),
        }
    }
}

/// The file that `path` means below `base` or one of the `roots`; links may not lead out.
fn confined(value: &Value<'_>, base: &Path, roots: &Roots, path: &str) -> Result<PathBuf> {
    let (root, rest) = match path.strip_prefix("root:") {
        None => (base, path),
        Some(path) => {
            let (name, rest) = path.split_once('/').unwrap_or((path, ""));
            let Some(root) = roots.get(name) else {
                let error =
                    value.error(ErrorKind::NotFound, format!("no asset root is called `{}`", cut(name)));
                return Err(match nearest(name, roots.keys().map(String::as_str)) {
                    Some(near) => error.hint(format!("did you mean `root:{near}/`?")),
                    None => error.hint("asset roots are set up by whoever runs the service"),
                });
            };
            (root.as_path(), rest)
        }
    };
    let inside = |component| matches!(component, Component::Normal(_) | Component::CurDir);
    let target = root.join(rest);
    let leads_out = || match (target.canonicalize(), root.canonicalize()) {
        (Ok(target), Ok(root)) => !target.starts_with(root),
        // What is not there leads nowhere, and is refused by name later
        _ => false,
    };
    if !Path::new(rest).components().all(inside) || leads_out() {
        let message = format!("path `{}` leads out of the folder it is in", cut(path));
        return Err(value
            .error(ErrorKind::Invalid, message)
            .hint("name files below the scene's folder, or as `root:NAME/path` below an asset root"));
    }
    Ok(target)
}

/// Puts a frame number where a path has two or more `#`, `%d` or `%04d` (any width up to 9). None if there is such a
/// pattern but no frame.
fn with_frame(path: &str, frame: Option<i64>) -> Option<String> {
    let mut result = String::with_capacity(path.len());
    let mut rest = path;
    while let Some(at) = rest.find(['#', '%']) {
        result.push_str(&rest[..at]);
        rest = &rest[at..];
        let (bytes, width) = pattern(rest);
        match width {
            Some(width) => result.push_str(&format!("{:0width$}", frame?)),
            None => result.push_str(&rest[..bytes]),
        }
        rest = &rest[bytes..];
    }
    result.push_str(rest);
    Some(result)
}

/// Length and width of the pattern that `text`, which starts with `#` or `%`, starts with; no width if it is none.
fn pattern(text: &str) -> (usize, Option<usize>) {
    let hashes = text.len() - text.trim_start_matches('#').len();
    if hashes > 0 {
        return (hashes, (2..=FRAME_DIGITS_MAX).contains(&hashes).then_some(hashes));
    }
    let digits = text[1..].len() - text[1..].trim_start_matches(|c: char| c.is_ascii_digit()).len();
    let (number, after) = text[1..].split_at(digits);
    let width = match number {
        "" => Some(0),
        _ => number.strip_prefix('0').and_then(|width| width.parse().ok()).filter(|&w| w <= FRAME_DIGITS_MAX),
    };
    match width {
        Some(width) if after.starts_with('d') => (digits + 2, Some(width)),
        _ => (1, None),
    }
}

/// The path, if a file is there.
fn there(value: &Value<'_>, path: PathBuf) -> Result<PathBuf> {
    let shown = cut(&path.to_string_lossy());
    match path.metadata() {
        Ok(metadata) if metadata.is_dir() => {
            Err(value.error(ErrorKind::Invalid, format!("`{shown}` is a folder, expected a file")))
        }
        Ok(_) => Ok(path),
        Err(source) if source.kind() == std::io::ErrorKind::NotFound => {
            let error =
                value.error(ErrorKind::NotFound, format!("file `{shown}` is not there")).caused_by(source);
            Err(match neighbour(&path) {
                Some(near) => error.hint(format!("did you mean `{near}`, in the same folder?")),
                None => error.hint("paths are relative to the scene file"),
            })
        }
        Err(source) => Err(value
            .error(ErrorKind::Io, format!("cannot look at file `{shown}`: {source}"))
            .caused_by(source)),
    }
}

/// The name in the path's folder that is nearest to the path's own.
fn neighbour(path: &Path) -> Option<String> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let entries = std::fs::read_dir(folder).ok()?;
    let mut names: Vec<String> = entries
        .take(FOLDER_ENTRIES_MAX)
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .collect();
    // Folders list in any order; among equally near names always the first
    names.sort_unstable();
    nearest(path.file_name()?.to_str()?, names.iter().map(String::as_str)).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a pattern that is missed, misread or padded wrongly, and a plain name that is taken for one.
    #[test]
    fn frames_fill_patterns_and_nothing_else() {
        for (path, frame, expected) in [
            ("a.####.ply", Some(7), Some("a.0007.ply")),
            ("a.%04d.ply", Some(7), Some("a.0007.ply")),
            ("a.%d.ply", Some(7), Some("a.7.ply")),
            ("##/%03d/é.ply", Some(12345), Some("12345/12345/é.ply")),
            ("a.####.ply", Some(-5), Some("a.-005.ply")),
            ("a.####.ply", None, None),
            ("a.%04d.ply", None, None),
            ("tree#1.ply", None, Some("tree#1.ply")),
            ("100%.ply", None, Some("100%.ply")),
            ("%", None, Some("%")),
            ("%04", None, Some("%04")),
            ("%4d", None, Some("%4d")),
            ("%099d##########", None, Some("%099d##########")),
            ("plain.ply", Some(3), Some("plain.ply")),
        ] {
            assert_eq!(with_frame(path, frame).as_deref(), expected, "{path}");
        }
    }
}
