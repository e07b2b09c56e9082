//! Instance files: CSV of 16 columns, one transform a line, streamed so that a million of them cost no memory.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use glam::DMat4;

use super::{Instances, matrix};
use crate::{Error, ErrorKind, Result};

/// Bytes of a line of an instance file at most; 16 doubles at full length take under 400.
pub const LINE_BYTES_MAX: usize = 4096;

/// Reads an instance file line by line: 16 numbers, separated by commas or white space, the translation in the last
/// four; world from object.
///
/// Blank lines and lines that begin with `#` are skipped, and so is a heading: a first line of which no field is a
/// number. Memory is constant; a warm reader allocates nothing.
#[derive(Debug)]
pub struct InstanceReader {
    path: PathBuf,
    file: BufReader<File>,
    bytes: Vec<u8>,
    line: u64,
    before_data: bool,
}

impl InstanceReader {
    /// Opens a file at its first line.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] or [`ErrorKind::Io`] with the file's path.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref().to_path_buf();
        let file = File::open(&path).map_err(|source| Error::io("open instance file", &path, source))?;
        let file = BufReader::with_capacity(1 << 16, file);
        Ok(Self { path, file, bytes: Vec::new(), line: 0, before_data: true })
    }

    /// The next transform, or none at the end of the file.
    ///
    /// # Errors
    /// With file, line and column: a wrong count of numbers, a number that is none or not finite, a matrix that is
    /// not affine or not invertible, a line that is too long, text that is not UTF-8.
    #[expect(clippy::should_implement_trait, reason = "fallible, as `MicrogridStream::next`")]
    pub fn next(&mut self) -> Result<Option<DMat4>> {
        while self.read_line()? {
            let start = if self.line == 1 && self.bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
            let text =
                std::str::from_utf8(&self.bytes[start..]).map_err(|error| self.not_utf8(start, error))?;
            if text.trim_start().is_empty() || text.trim_start().starts_with('#') {
                continue;
            }
            if std::mem::take(&mut self.before_data) && is_heading(text) {
                continue;
            }
            return matrix::parse(text).map(Some).map_err(|fault| {
                let column = text[..fault.offset].chars().count() as u64 + 1;
                fault.into_error().at_text(&self.path, self.line, column)
            });
        }
        Ok(None)
    }

    /// The line, from 1, that [`next`](Self::next) read last.
    pub fn line(&self) -> u64 {
        self.line
    }

    /// Reads a line, without its end, into the buffer. False at the end of the file.
    fn read_line(&mut self) -> Result<bool> {
        self.bytes.clear();
        self.line += 1;
        let mut bounded = (&mut self.file).take(LINE_BYTES_MAX as u64 + 2);
        let read = bounded
            .read_until(b'\n', &mut self.bytes)
            .map_err(|source| Error::io("read instance file", &self.path, source))?;
        let ended = self.bytes.pop_if(|byte| *byte == b'\n').is_some();
        self.bytes.pop_if(|byte| *byte == b'\r');
        if self.bytes.len() > LINE_BYTES_MAX || (!ended && read == LINE_BYTES_MAX + 2) {
            let message = format!("line is longer than {LINE_BYTES_MAX} bytes");
            return Err(Error::new(ErrorKind::Limit, message)
                .at_text(&self.path, self.line, 1)
                .hint("an instance file has one matrix of 16 numbers on each line"));
        }
        Ok(read > 0)
    }

    fn not_utf8(&self, start: usize, error: std::str::Utf8Error) -> Error {
        let before = String::from_utf8_lossy(&self.bytes[start..start + error.valid_up_to()]);
        Error::invalid("text is not UTF-8").at_text(&self.path, self.line, before.chars().count() as u64 + 1)
    }
}

/// Whether a line can be a heading: no field is a number, `nan` and `inf` among them.
fn is_heading(text: &str) -> bool {
    matrix::fields(text).all(|(_, field)| !field.is_empty() && field.parse::<f64>().is_err())
}

/// Calls `visit` for every copy of a geometry, with its number and its transform, world from object, in the order of
/// declaration; once with the identity where nothing is declared. Returns the count.
///
/// Files are streamed, so this is constant memory whatever their size, and two calls over unchanged files visit the
/// same.
///
/// # Errors
/// Those of [`InstanceReader`], those of `visit`, [`ErrorKind::Invalid`] for a file without any matrix, and
/// [`ErrorKind::Limit`] beyond 2³² - 1 copies.
pub fn for_each_instance(
    instances: &[Instances],
    mut visit: impl FnMut(u32, &DMat4) -> Result<()>,
) -> Result<u32> {
    if instances.is_empty() {
        visit(0, &DMat4::IDENTITY)?;
        return Ok(1);
    }
    let mut count = 0;
    let mut visit_next = |matrix: &DMat4| {
        let next = u32::checked_add(count, 1);
        let next =
            next.ok_or_else(|| Error::new(ErrorKind::Limit, format!("more than {} instances", u32::MAX)))?;
        visit(std::mem::replace(&mut count, next), matrix)
    };
    for instance in instances {
        match instance {
            Instances::Matrix(matrix) => visit_next(matrix)?,
            Instances::File(path) => {
                let mut reader = InstanceReader::open(path)?;
                let mut is_empty = true;
                while let Some(matrix) = reader.next()? {
                    is_empty = false;
                    visit_next(&matrix).map_err(|error| error.at(path))?;
                }
                if is_empty {
                    return Err(Error::invalid("instance file holds no matrix")
                        .at(path)
                        .hint("give one matrix of 16 numbers on each line"));
                }
            }
        }
    }
    Ok(count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use proptest::prelude::*;

    const ONE: &str = "1,0,0,0,0,1,0,0,0,0,1,0,7,8,9,1";

    fn file(bytes: impl AsRef<[u8]>) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scatter.csv");
        std::fs::write(&path, bytes).unwrap();
        (folder, path)
    }

    fn read(bytes: impl AsRef<[u8]>) -> Result<Vec<DMat4>> {
        let (_folder, path) = file(bytes);
        let mut reader = InstanceReader::open(path)?;
        std::iter::from_fn(|| reader.next().transpose()).collect()
    }

    /// Catches a dialect of CSV that is misread: heading, comment, blank line, CRLF, byte order mark, no last newline.
    #[test]
    fn the_usual_dialects_are_read() {
        let text = format!(
            "\u{feff}a,b,c,d,e,f,g,h,i,j,k,l,m,n,o,p\r\n# comment\r\n{ONE}\r\n\r\n 1 0 0 0  0 1 0 0  0 0 1 0  1 2 3 1"
        );
        let matrices = read(text).unwrap();
        let translations: Vec<_> = matrices.iter().map(|m| m.w_axis.truncate()).collect();
        assert_eq!(translations, [DVec3::new(7.0, 8.0, 9.0), DVec3::new(1.0, 2.0, 3.0)]);
        assert_eq!(read("").unwrap(), []);
    }

    /// Catches a broken line that passes, or one whose line or column is wrong.
    #[test]
    fn broken_lines_are_refused_at_their_place() {
        let flat = ONE.replacen('1', "0", 1);
        for (text, line, column, kind, message) in [
            (format!("{ONE}\n{ONE},1\n"), 2, 1, ErrorKind::Invalid, "matrix of 17 numbers"),
            (format!("{ONE}\n\n{flat}\n"), 3, 1, ErrorKind::Invalid, "matrix is not invertible"),
            (format!("{ONE}\n# é\n1,é,0"), 3, 3, ErrorKind::Invalid, "`é` is not a number"),
            ("nan,nan".into(), 1, 1, ErrorKind::Invalid, "`nan` is not a finite number"),
            (format!("a,b\nc,d\n{ONE}"), 2, 1, ErrorKind::Invalid, "`c` is not a number"),
            ("1 ".repeat(LINE_BYTES_MAX), 1, 1, ErrorKind::Limit, "line is longer"),
            (format!("{ONE}\n{}", "#".repeat(LINE_BYTES_MAX + 1)), 2, 1, ErrorKind::Limit, "line is longer"),
        ] {
            let error = read(&text).unwrap_err();
            assert_eq!(error.kind(), kind, "{error}");
            assert!(error.message().starts_with(message), "{error}");
            let place = error.place().unwrap().to_string();
            assert!(place.ends_with(&format!("scatter.csv:{line}:{column}")), "{error}");
        }
        let error = read(b"# \xc3\xa9 \xff\n").unwrap_err();
        assert!(error.to_string().ends_with("scatter.csv:1:5: text is not UTF-8"), "{error}");
        assert!(read("#".repeat(LINE_BYTES_MAX) + "\r\n" + ONE).is_ok());
    }

    /// Catches copies that are lost, doubled or out of order over inline matrices and files.
    #[test]
    fn every_copy_is_visited_once_in_order() {
        let (_folder, path) = file(format!("{ONE}\n{ONE}\n"));
        let at = |x| Instances::Matrix(DMat4::from_translation(DVec3::new(x, 0.0, 0.0)));
        let mut visited = Vec::new();
        let mut visit = |number: u32, matrix: &DMat4| {
            visited.push((number, matrix.w_axis.x));
            Ok(())
        };
        assert_eq!(for_each_instance(&[at(1.0), Instances::File(path), at(2.0)], &mut visit).unwrap(), 4);
        assert_eq!(for_each_instance(&[], &mut visit).unwrap(), 1);
        assert_eq!(visited, [(0, 1.0), (1, 7.0), (2, 7.0), (3, 2.0), (0, 0.0)]);
        let (_folder, empty) = file("# nothing\n");
        let error = for_each_instance(&[Instances::File(empty)], |_, _| Ok(())).unwrap_err();
        assert_eq!(error.message(), "instance file holds no matrix");
        let missing = Instances::File("no/such.csv".into());
        assert_eq!(for_each_instance(&[missing], |_, _| Ok(())).unwrap_err().kind(), ErrorKind::NotFound);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// Catches a panic or an endless read on whatever bytes a file may hold.
        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(prop_oneof![
            4 => prop::sample::select(b"0123456789.,e+- \n\r#infa\xc3\xa9".to_vec()), 1 => any::<u8>(),
        ], 0..2000)) {
            let _ = read(bytes);
        }
    }
}
