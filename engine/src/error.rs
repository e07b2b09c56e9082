//! One error for the whole engine: what went wrong, where, why, and what to do about it.
//!
//! Libraries never print. The command line prints an error once, with its hint; a service maps the kind to a status.

use std::fmt;
use std::path::{Path, PathBuf};

/// The engine's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What sort of failure this is. Callers decide by kind, never by text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// The input says something that is wrong: a bad scene, a broken mesh, an impossible option.
    Invalid,
    /// Something that was named is not there.
    NotFound,
    /// The input is understood but this version cannot do what it asks.
    Unsupported,
    /// Bytes do not match their checksum, length or magic.
    Corrupt,
    /// A stated limit was reached (memory, counts, depth).
    Limit,
    /// The operating system refused a read or a write.
    Io,
    /// Another process holds what this one needs.
    Busy,
    /// A GPU or its driver failed; the same work may succeed elsewhere.
    Device,
    /// The caller asked the work to stop.
    Cancelled,
}

/// Where an error lies.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A file or folder as a whole.
    Path(PathBuf),
    /// A place in a text file; line and column count from 1.
    Text {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: u64,
        /// Column in characters, from 1.
        column: u64,
    },
    /// A place in a binary file.
    Byte {
        /// The file.
        path: PathBuf,
        /// Offset in bytes from the start of the file.
        offset: u64,
    },
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::Path(path) => write!(f, "{}", path.display()),
            Place::Text { path, line, column } => write!(f, "{}:{line}:{column}", path.display()),
            Place::Byte { path, offset } => write!(f, "{}: byte {offset}", path.display()),
        }
    }
}

/// An error: kind, message, and where known the place, a hint and the cause.
#[derive(Debug)]
pub struct Error(Box<Inner>);

#[derive(Debug)]
struct Inner {
    kind: ErrorKind,
    message: String,
    place: Option<Place>,
    hint: Option<String>,
    source: Option<Box<dyn std::error::Error + Send + Sync>>,
}

impl Error {
    /// An error of `kind`. The message is lower case, has no full stop and puts values in backticks.
    pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self(Box::new(Inner { kind, message: message.into(), place: None, hint: None, source: None }))
    }

    /// Shorthand for [`ErrorKind::Invalid`].
    pub fn invalid(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Invalid, message)
    }

    /// Shorthand for [`ErrorKind::Unsupported`].
    pub fn unsupported(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Unsupported, message)
    }

    /// Shorthand for [`ErrorKind::Corrupt`] at a byte of a file.
    pub fn corrupt(path: impl AsRef<Path>, offset: u64, message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Corrupt, message).at_byte(path, offset)
    }

    /// An operating system error while doing `what` to `path`.
    pub fn io(what: &str, path: impl AsRef<Path>, source: std::io::Error) -> Self {
        let kind = match source.kind() {
            std::io::ErrorKind::NotFound => ErrorKind::NotFound,
            _ => ErrorKind::Io,
        };
        let mut error = Self::new(kind, format!("cannot {what}: {source}")).at(path);
        error.0.source = Some(Box::new(source));
        error
    }

    /// Says which file the error is about, unless a place is known already.
    pub fn at(mut self, path: impl AsRef<Path>) -> Self {
        self.0.place.get_or_insert_with(|| Place::Path(path.as_ref().to_path_buf()));
        self
    }

    /// Says which line and column (from 1) of a text file the error is about.
    pub fn at_text(mut self, path: impl AsRef<Path>, line: u64, column: u64) -> Self {
        self.0.place = Some(Place::Text { path: path.as_ref().to_path_buf(), line, column });
        self
    }

    /// Says which byte of a file the error is about.
    pub fn at_byte(mut self, path: impl AsRef<Path>, offset: u64) -> Self {
        self.0.place = Some(Place::Byte { path: path.as_ref().to_path_buf(), offset });
        self
    }

    /// Adds what the user can do about it.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.0.hint = Some(hint.into());
        self
    }

    /// Adds the cause.
    pub fn caused_by(mut self, source: impl std::error::Error + Send + Sync + 'static) -> Self {
        self.0.source = Some(Box::new(source));
        self
    }

    /// What sort of failure this is.
    pub fn kind(&self) -> ErrorKind {
        self.0.kind
    }

    /// Where it lies, where known.
    pub fn place(&self) -> Option<&Place> {
        self.0.place.as_ref()
    }

    /// What the user can do about it, where known.
    pub fn hint_text(&self) -> Option<&str> {
        self.0.hint.as_deref()
    }

    /// The message without place and hint.
    pub fn message(&self) -> &str {
        &self.0.message
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(place) = &self.0.place {
            write!(f, "{place}: ")?;
        }
        f.write_str(&self.0.message)
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.0.source.as_ref().map(|source| source.as_ref() as _)
    }
}

/// The name among `candidates` that is nearest to `name`, if one is near enough to be a slip of the hand.
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    candidates
        .into_iter()
        .map(|candidate| (edit_distance(name, candidate), candidate))
        .filter(|&(distance, candidate)| distance <= 1 + name.len().max(candidate.len()) / 3)
        .min_by_key(|&(distance, _)| distance)
        .map(|(_, candidate)| candidate)
}

/// Levenshtein distance, bounded work: names longer than 64 bytes are cut.
fn edit_distance(a: &str, b: &str) -> usize {
    let a: Vec<char> = a.chars().take(64).collect();
    let b: Vec<char> = b.chars().take(64).collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let substitute = diagonal + usize::from(!ca.eq_ignore_ascii_case(cb));
            diagonal = row[j + 1];
            row[j + 1] = substitute.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a suggestion that is far off, or none for a plain typing error.
    #[test]
    fn nearest_name_forgives_a_slip_and_nothing_more() {
        let names = ["camera", "shaders", "geometries"];
        assert_eq!(nearest("geometrys", names), Some("geometries"));
        assert_eq!(nearest("Camera", names), Some("camera"));
        assert_eq!(nearest("zzz", names), None);
    }

    /// Catches a place that is overwritten by a caller who knows less.
    #[test]
    fn the_first_place_stays() {
        let error = Error::invalid("bad").at_text("a.xml", 3, 4).at("b.xml");
        assert_eq!(error.to_string(), "a.xml:3:4: bad");
    }
}
