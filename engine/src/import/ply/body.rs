//! The body of a PLY file: rows of values, as text or in either byte order.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::header::{Element, Encoding, Header, Scalar};
use crate::import::lines::{self, LineReader};
use crate::{Error, ErrorKind, Result};

/// Reads values one after the other.
pub(super) enum Body {
    Ascii { reader: LineReader, at: usize, last: usize, bytes: u64 },
    Binary { reader: BufReader<File>, big_endian: bool, offset: u64, bytes: u64, path: PathBuf },
}

impl Body {
    /// Goes to the body of a file.
    pub fn open(mut file: File, header: &Header, path: &Path) -> Result<Self> {
        let io = |e| Error::io("read the file", path, e);
        let length = file.seek(SeekFrom::End(0)).map_err(io)?;
        file.seek(SeekFrom::Start(header.body_offset)).map_err(io)?;
        let reader = BufReader::with_capacity(1 << 18, file);
        Ok(match header.encoding {
            Encoding::Ascii => {
                let mut reader = LineReader::new(reader, path);
                reader.number = header.lines;
                Self::Ascii { reader, at: 0, last: 0, bytes: length - header.body_offset }
            }
            encoding => Self::Binary {
                reader,
                big_endian: encoding == Encoding::BigEndian,
                offset: header.body_offset,
                bytes: length,
                path: path.to_path_buf(),
            },
        })
    }

    /// Refuses elements that claim more rows than the rest of the file can hold.
    pub fn check(&self, elements: &[Element], encoding: Encoding) -> Result<()> {
        let left = match self {
            // The last line may have no end
            Self::Ascii { bytes, .. } => bytes + 1,
            Self::Binary { offset, bytes, .. } => bytes - offset,
        };
        let mut claimed = 0_u64;
        for element in elements {
            claimed = claimed.saturating_add(element.count.saturating_mul(element.row_bytes_min(encoding)));
            if claimed > left {
                let message = format!(
                    "element `{}` claims {} rows, the {left} bytes behind the header cannot hold them",
                    element.name.escape_default(),
                    element.count
                );
                return Err(self.error(ErrorKind::Corrupt, message).hint("the file may be cut off"));
            }
        }
        Ok(())
    }

    /// Goes to the next row.
    pub fn begin_row(&mut self) -> Result<()> {
        if let Self::Ascii { reader, at, last, .. } = self {
            (*at, *last) = (0, 0);
            loop {
                if !reader.advance(false)? {
                    let error = reader.error(ErrorKind::Corrupt, &[], "the file ends before its last row");
                    return Err(error.hint("the file may be cut off"));
                }
                if reader.line().iter().any(|b| !b.is_ascii_whitespace()) {
                    break;
                }
            }
        }
        Ok(())
    }

    /// The next value of the row.
    pub fn value(&mut self, scalar: Scalar) -> Result<f64> {
        match self {
            Self::Ascii { reader, at, last, .. } => {
                let rest = &reader.line()[*at..];
                let Some(token) = lines::tokens(rest).next() else {
                    return Err(reader.error(ErrorKind::Corrupt, rest, "the row has too few values"));
                };
                *last = token.as_ptr() as usize - reader.line().as_ptr() as usize;
                *at = *last + token.len();
                lines::number(token).ok_or_else(|| {
                    let text = String::from_utf8_lossy(&token[..token.len().min(40)]).into_owned();
                    reader.error(
                        ErrorKind::Invalid,
                        token,
                        format!("`{}` is not a number", text.escape_default()),
                    )
                })
            }
            Self::Binary { reader, big_endian, offset, path, .. } => {
                let mut bytes = [0; 8];
                let size = scalar.bytes();
                reader.read_exact(&mut bytes[..size]).map_err(|e| read_error(e, path, *offset))?;
                *offset += size as u64;
                if *big_endian {
                    bytes[..size].reverse();
                }
                Ok(decode(scalar, bytes))
            }
        }
    }

    /// The length of a list.
    pub fn length(&mut self, scalar: Scalar) -> Result<u64> {
        let length = self.value(scalar)?;
        if !(length >= 0.0 && length.fract() == 0.0) {
            return Err(self.error(ErrorKind::Invalid, format!("`{length}` is not the length of a list")));
        }
        Ok(length as u64)
    }

    /// Leaves out an element. A binary one of fixed rows costs one seek.
    pub fn skip(&mut self, element: &Element) -> Result<()> {
        if let Self::Binary { reader, offset, bytes, path, .. } = self
            && element.is_fixed()
        {
            let size = element.count.saturating_mul(element.row_bytes_min(Encoding::LittleEndian));
            let target = offset.saturating_add(size).min(*bytes);
            let step = i64::try_from(target - *offset).unwrap_or(i64::MAX);
            reader.seek_relative(step).map_err(|e| Error::io("read the file", &*path, e))?;
            *offset = target;
            return Ok(());
        }
        if element.properties.is_empty() {
            return Ok(());
        }
        for _ in 0..element.count {
            self.begin_row()?;
            for property in &element.properties {
                let length = property.length.map_or(Ok(1), |length| self.length(length))?;
                for _ in 0..length {
                    self.value(property.scalar)?;
                }
            }
        }
        Ok(())
    }

    /// An error at the value read last.
    pub fn error(&self, kind: ErrorKind, message: impl Into<String>) -> Error {
        match self {
            Self::Ascii { reader, last, .. } => reader.error(kind, &reader.line()[*last..], message),
            Self::Binary { offset, path, .. } => Error::new(kind, message).at_byte(path, *offset),
        }
    }
}

fn read_error(error: std::io::Error, path: &Path, offset: u64) -> Error {
    if error.kind() == std::io::ErrorKind::UnexpectedEof {
        Error::corrupt(path, offset, "the file ends before its last row").hint("the file may be cut off")
    } else {
        Error::io("read the file", path, error)
    }
}

/// A value from little endian bytes.
fn decode(scalar: Scalar, b: [u8; 8]) -> f64 {
    match scalar {
        Scalar::I8 => f64::from(b[0] as i8),
        Scalar::U8 => f64::from(b[0]),
        Scalar::I16 => f64::from(i16::from_le_bytes([b[0], b[1]])),
        Scalar::U16 => f64::from(u16::from_le_bytes([b[0], b[1]])),
        Scalar::I32 => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        Scalar::U32 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        Scalar::F32 => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        Scalar::F64 => f64::from_le_bytes(b),
    }
}
