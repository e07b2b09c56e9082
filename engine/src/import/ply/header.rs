//! The header of a PLY file: its elements, their properties, and where the body begins.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::error::nearest;
use crate::{Error, Result};

/// Bytes of a header at most; real ones have a few hundred, those full of comments some thousands.
const HEADER_MAX: u64 = 1 << 20;

/// Elements, and properties of one, at most.
const ENTRIES_MAX: usize = 1024;

/// How the body is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// The type of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// Both sets of names in use, the original's and the sized ones.
const SCALARS: [(&str, Scalar); 16] = [
    ("char", Scalar::I8),
    ("int8", Scalar::I8),
    ("uchar", Scalar::U8),
    ("uint8", Scalar::U8),
    ("short", Scalar::I16),
    ("int16", Scalar::I16),
    ("ushort", Scalar::U16),
    ("uint16", Scalar::U16),
    ("int", Scalar::I32),
    ("int32", Scalar::I32),
    ("uint", Scalar::U32),
    ("uint32", Scalar::U32),
    ("float", Scalar::F32),
    ("float32", Scalar::F32),
    ("double", Scalar::F64),
    ("float64", Scalar::F64),
];

impl Scalar {
    fn named(name: &str) -> Result<Self> {
        match SCALARS.iter().find(|(known, _)| *known == name) {
            Some((_, scalar)) => Ok(*scalar),
            None => {
                let error = Error::invalid(format!("unknown property type `{}`", name.escape_default()));
                Err(match nearest(name, SCALARS.iter().map(|(known, _)| *known)) {
                    Some(near) => error.hint(format!("did you mean `{near}`?")),
                    None => error,
                })
            }
        }
    }

    /// Bytes of a value in a binary body.
    pub fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The largest value of an integer type, or none.
    pub fn integer_max(self) -> Option<f64> {
        match self {
            Self::I8 => Some(127.0),
            Self::U8 => Some(255.0),
            Self::I16 => Some(32_767.0),
            Self::U16 => Some(65_535.0),
            Self::I32 => Some(2_147_483_647.0),
            Self::U32 => Some(4_294_967_295.0),
            Self::F32 | Self::F64 => None,
        }
    }
}

/// A property: a value, or a list of values with its length before it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Property {
    pub name: String,
    pub scalar: Scalar,
    /// The type of a list's length.
    pub length: Option<Scalar>,
}

/// An element: rows of properties.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
}

impl Element {
    /// Bytes that a row takes at least.
    pub fn row_bytes_min(&self, encoding: Encoding) -> u64 {
        let bytes = |property: &Property| match encoding {
            // A digit and what parts it from the next
            Encoding::Ascii => 2,
            _ => property.length.unwrap_or(property.scalar).bytes() as u64,
        };
        self.properties.iter().map(bytes).sum()
    }

    /// Whether every row has the same bytes in a binary body.
    pub fn is_fixed(&self) -> bool {
        self.properties.iter().all(|property| property.length.is_none())
    }
}

/// A header.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Header {
    pub encoding: Encoding,
    pub elements: Vec<Element>,
    /// Where the body begins, in bytes from the start of the file.
    pub body_offset: u64,
    /// Lines before the body.
    pub lines: u64,
}

/// Reads the header of a file.
pub(super) fn read(file: &mut File, path: &Path) -> Result<Header> {
    let mut bytes = Vec::new();
    file.take(HEADER_MAX).read_to_end(&mut bytes).map_err(|e| Error::io("read the header", path, e))?;
    parse(&bytes, path)
}

/// Parts a line off: what stands before its end, and what comes behind. In a file whose first line ends with a lone
/// CR, all do.
fn cut_line(bytes: &[u8], lone_return: bool) -> Option<(&[u8], &[u8])> {
    let end = bytes.iter().position(|&b| b == b'\n' || b == b'\r')?;
    let pair = !lone_return && bytes[end..].starts_with(b"\r\n");
    Some((&bytes[..end], &bytes[end + 1 + usize::from(pair)..]))
}

fn parse(bytes: &[u8], path: &Path) -> Result<Header> {
    let blank = bytes.iter().take_while(|b| b.is_ascii_whitespace()).count();
    let mut lines = bytes[..blank].iter().filter(|&&b| b == b'\n').count() as u64;
    let mut rest = &bytes[blank..];
    if !rest.starts_with(b"ply") {
        return Err(Error::corrupt(
            path,
            blank as u64,
            "this is not a PLY file: it does not begin with `ply`",
        ));
    }
    let lone_return = rest[3..].starts_with(b"\r") && !rest[3..].starts_with(b"\r\n");
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    while let Some((line, behind)) = cut_line(rest, lone_return) {
        rest = behind;
        lines += 1;
        let text = String::from_utf8_lossy(line);
        let words: Vec<&str> = text.split_ascii_whitespace().take(8).collect();
        match words.as_slice() {
            ["end_header", ..] => {
                let encoding = encoding.ok_or_else(|| {
                    Error::invalid("the header does not say its format").at_text(path, lines, 1)
                })?;
                let body_offset = (bytes.len() - rest.len()) as u64;
                return Ok(Header { encoding, elements, body_offset, lines });
            }
            words => {
                statement(words, &mut encoding, &mut elements).map_err(|e| e.at_text(path, lines, 1))?;
            }
        }
    }
    let message = format!("the header does not end within {} bytes", bytes.len());
    Err(Error::corrupt(path, bytes.len() as u64, message).hint("the file may be cut off"))
}

fn statement(words: &[&str], encoding: &mut Option<Encoding>, elements: &mut Vec<Element>) -> Result<()> {
    match words {
        [] | ["ply" | "comment" | "obj_info", ..] => {}
        ["format", name, version, ..] => {
            if *version != "1.0" {
                let message = format!("PLY version `{}`, 1.0 can be read", version.escape_default());
                return Err(Error::unsupported(message));
            }
            *encoding = Some(match *name {
                "ascii" => Encoding::Ascii,
                "binary_little_endian" => Encoding::LittleEndian,
                "binary_big_endian" => Encoding::BigEndian,
                _ => {
                    return Err(Error::invalid(format!("unknown format `{}`", name.escape_default()))
                        .hint("formats are `ascii`, `binary_little_endian` and `binary_big_endian`"));
                }
            });
        }
        ["element", name, count, ..] => {
            let count = count.parse().map_err(|_| {
                Error::invalid(format!("`{}` is not a number of rows", count.escape_default()))
            })?;
            if elements.len() >= ENTRIES_MAX || elements.iter().any(|element| element.name == *name) {
                return Err(Error::invalid(format!("element `{}` is there twice", name.escape_default())));
            }
            elements.push(Element { name: name.to_string(), count, properties: Vec::new() });
        }
        ["property", rest @ ..] => {
            let element =
                elements.last_mut().ok_or_else(|| Error::invalid("a property before any element"))?;
            let property = property(rest)?;
            if element.properties.len() >= ENTRIES_MAX {
                return Err(Error::invalid(format!("more than {ENTRIES_MAX} properties")));
            }
            element.properties.push(property);
        }
        [word, ..] => {
            let known = ["format", "element", "property", "comment", "obj_info", "end_header"];
            let error = Error::invalid(format!("unknown header line `{}`", word.escape_default()));
            return Err(match nearest(word, known) {
                Some(near) => error.hint(format!("did you mean `{near}`?")),
                None => error,
            });
        }
    }
    Ok(())
}

fn property(words: &[&str]) -> Result<Property> {
    match words {
        ["list", length, scalar, name, ..] => {
            let length = Scalar::named(length)?;
            if length.integer_max().is_none() {
                return Err(Error::invalid(format!(
                    "list `{}` has a length that is not an integer",
                    name.escape_default()
                )));
            }
            Ok(Property { name: name.to_string(), scalar: Scalar::named(scalar)?, length: Some(length) })
        }
        [scalar, name, ..] => {
            Ok(Property { name: name.to_string(), scalar: Scalar::named(scalar)?, length: None })
        }
        _ => Err(Error::invalid("a property without type or name")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement vertex 3\n\
                          property float x\nelement face 1\nproperty list uint8 int32 vertex_index\nend_header\n";

    fn read(text: &str) -> Result<Header> {
        parse(text.as_bytes(), Path::new("a.ply"))
    }

    /// Catches a body that is looked for one byte off, for each way of ending lines.
    #[test]
    fn the_body_begins_behind_the_last_line_end() {
        let plain = read(&format!("{HEADER}\nX")).unwrap();
        assert_eq!(plain.body_offset, HEADER.len() as u64);
        for end in ["\r\n", "\r"] {
            let text = HEADER.replace('\n', end);
            let header = read(&format!("{text}\nX")).unwrap();
            assert_eq!((header.body_offset, header.elements), (text.len() as u64, plain.elements.clone()));
        }
        assert_eq!(read(&format!("\n\n{HEADER}")).unwrap().body_offset, HEADER.len() as u64 + 2);
    }

    /// Catches headers that are wrong and taken nevertheless, or refused without the line.
    #[test]
    fn wrong_headers_name_their_line() {
        let cases = [
            ("format binary_big_endian", "format bnary", "2:1"),
            (" 1.0", " 1.1", "2:1"),
            ("vertex 3", "vertex -3", "4:1"),
            ("vertex 3", "vertex 99999999999999999999", "4:1"),
            ("float x", "flaot x", "5:1"),
            ("element face", "element vertex", "6:1"),
            ("uint8", "float", "7:1"),
            ("format binary_big_endian 1.0", "comment", "8:1"),
            ("end_header", "end", "8:1"),
        ];
        for (from, to, place) in cases {
            let error = read(&HEADER.replace(from, to)).unwrap_err();
            assert!(error.to_string().contains(place), "{error}");
        }
        assert!(read(&HEADER[..60]).is_err() && read("plz").is_err());
    }
}
