//! Lines of text from a file of any size, with place and bound.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use crate::{Error, ErrorKind, Result};

/// Bytes of a line at most, continuations included.
pub(super) const LINE_MAX: usize = 1 << 20;

/// Reads lines that end with LF, CR LF or CR.
pub(super) struct LineReader<R = BufReader<File>> {
    source: R,
    path: PathBuf,
    /// The number of the line read last, from 1.
    pub number: u64,
    after_return: bool,
    line: Vec<u8>,
}

impl LineReader {
    /// Opens a file.
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|e| Error::io("open the file", path, e))?;
        Ok(Self::new(BufReader::with_capacity(1 << 18, file), path))
    }
}

impl<R: BufRead> LineReader<R> {
    /// Reads on from `source`, counting lines from 1.
    pub fn new(source: R, path: &Path) -> Self {
        Self { source, path: path.to_path_buf(), number: 0, after_return: false, line: Vec::new() }
    }

    /// Goes to the next line; false after the last. With `joined`, a backslash at the end of a line continues it on the
    /// next.
    pub fn advance(&mut self, joined: bool) -> Result<bool> {
        self.line.clear();
        let mut any = false;
        while self.append_line()? {
            any = true;
            match self.line.last() {
                Some(b'\\') if joined => *self.line.last_mut().expect("not empty") = b' ',
                _ => break,
            }
        }
        Ok(any)
    }

    /// The line read last, without its end.
    pub fn line(&self) -> &[u8] {
        &self.line
    }

    /// An error of `kind` at a token of the line read last.
    pub fn error(&self, kind: ErrorKind, token: &[u8], message: impl Into<String>) -> Error {
        // The token is a part of the line: its distance from the start is the column
        let column = (token.as_ptr() as usize).wrapping_sub(self.line.as_ptr() as usize);
        let column = if column <= self.line.len() { column as u64 + 1 } else { 1 };
        Error::new(kind, message).at_text(&self.path, self.number.max(1), column)
    }

    /// Appends up to the next line end. False when there is nothing left.
    fn append_line(&mut self) -> Result<bool> {
        let mut any = false;
        loop {
            let path = &self.path;
            let buffer = self.source.fill_buf().map_err(|e| Error::io("read the file", path, e))?;
            if buffer.is_empty() {
                break;
            }
            let skip = usize::from(self.after_return && buffer[0] == b'\n');
            self.after_return = false;
            if skip == buffer.len() {
                self.source.consume(skip);
                continue;
            }
            any = true;
            let rest = &buffer[skip..];
            let end = rest.iter().position(|&b| b == b'\n' || b == b'\r');
            let taken = end.unwrap_or(rest.len());
            if self.line.len() + taken > LINE_MAX {
                let error = Error::new(ErrorKind::Limit, format!("a line of more than {LINE_MAX} bytes"));
                return Err(error.at_text(path, self.number + 1, 1));
            }
            self.line.extend_from_slice(&rest[..taken]);
            self.after_return = end.is_some_and(|end| rest[end] == b'\r');
            let consumed = skip + taken + usize::from(end.is_some());
            self.source.consume(consumed);
            if end.is_some() {
                break;
            }
        }
        self.number += u64::from(any);
        Ok(any)
    }
}

/// The tokens of a line, parted by spaces and tabs.
pub(super) fn tokens(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(|b| matches!(b, b' ' | b'\t' | 0x0b | 0x0c)).filter(|token| !token.is_empty())
}

/// A number as text. The ways in which C prints what is not a number are understood: `nan`, `-nan(ind)`, `1.#QNAN`.
pub(super) fn number(token: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(token).ok()?;
    if let Ok(value) = text.parse::<f64>() {
        return Some(value);
    }
    let lower = text.to_ascii_lowercase();
    let bare = lower.trim_start_matches(['+', '-']);
    (bare.starts_with("nan") || bare.contains(".#")).then_some(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(text: &str, joined: bool) -> Vec<(String, u64)> {
        // A buffer of three bytes puts every line end on a border once
        let source = BufReader::with_capacity(3, text.as_bytes());
        let mut reader = LineReader::new(source, Path::new("a.obj"));
        let mut lines = Vec::new();
        while reader.advance(joined).unwrap() {
            let line = String::from_utf8_lossy(reader.line()).into_owned();
            lines.push((line, reader.number));
        }
        lines
    }

    /// Catches a line end that is missed, doubled, or lost on a buffer's border.
    #[test]
    fn lines_end_in_three_ways() {
        let lines = all("a\nbc\r\n\r\nd\re", false);
        let expected = [("a", 1), ("bc", 2), ("", 3), ("d", 4), ("e", 5)];
        assert_eq!(lines, expected.map(|(line, number)| (line.to_string(), number)));
    }

    /// Catches a continuation that is not joined, or one that swallows the end of the file.
    #[test]
    fn backslashes_join_lines() {
        assert_eq!(all("f 1 \\\n2 3\\", true), [("f 1  2 3 ".to_string(), 2)]);
    }

    /// Catches an endless line that fills the memory.
    #[test]
    fn endless_lines_are_refused() {
        let text = vec![b'1'; LINE_MAX + 1];
        let mut reader = LineReader::new(text.as_slice(), Path::new("a.obj"));
        assert_eq!(reader.advance(false).unwrap_err().kind(), ErrorKind::Limit);
    }

    /// Catches the spellings of numbers that real exporters write.
    #[test]
    fn numbers_are_read_as_exporters_write_them() {
        assert_eq!(number(b"-.5e-007"), Some(-0.5e-7));
        assert_eq!(number(b"+1."), Some(1.0));
        assert!(number(b"-nan(ind)").unwrap().is_nan() && number(b"1.#QNAN0").unwrap().is_nan());
        assert_eq!([number(b"1,5"), number(b""), number(b"\xff")], [None; 3]);
    }
}
