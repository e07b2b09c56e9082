//! The header of a `.mgs` file: magic, version, schema, metadata, checksum.

use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use super::read_le;
use crate::stream::schema::UpAxis;
use crate::stream::{Attribute, Rate, Schema, ValueType};
use crate::{Error, ErrorKind, Result};

/// The first eight bytes. Like PNG's they break when a transfer changes line ends or strips the eighth bit.
pub(super) const MAGIC: [u8; 8] = *b"\x89MGS\r\n\x1a\n";

/// The version that is written and read.
pub const VERSION: u32 = 1;

/// Bytes of a header at most.
pub const HEADER_BYTES_MAX: usize = 1 << 20;

/// Entries of the metadata at most.
pub const METADATA_MAX: usize = 1024;

/// Bytes before the list of attributes.
pub(super) const FIXED_BYTES: usize = 32;

/// What a file says of itself before its first block.
#[derive(Clone, Debug)]
pub(super) struct Header {
    pub schema: Schema,
    pub metadata: Vec<(String, String)>,
}

impl Header {
    /// The header's bytes, checksum included.
    pub fn encode(&self) -> Result<Vec<u8>> {
        self.schema.validate()?;
        check_metadata(&self.metadata)?;
        let mut out = Vec::new();
        out.extend_from_slice(&MAGIC);
        out.extend_from_slice(&VERSION.to_le_bytes());
        out.extend_from_slice(&[0; 4]); // the header's length, below
        out.extend_from_slice(&self.schema.meters_per_unit.to_le_bytes());
        out.push(match self.schema.up {
            UpAxis::Y => 0,
            UpAxis::Z => 1,
        });
        out.push(0);
        out.extend_from_slice(&(self.schema.attributes.len() as u16).to_le_bytes());
        out.extend_from_slice(&(self.metadata.len() as u32).to_le_bytes());
        for attribute in &self.schema.attributes {
            out.push(attribute.name.len() as u8);
            out.extend_from_slice(attribute.name.as_bytes());
            out.push(type_code(attribute.value_type));
            out.push(u8::from(attribute.rate == Rate::Grid));
            out.extend_from_slice(&attribute.components.to_le_bytes());
        }
        for text in self.metadata.iter().flat_map(|(key, value)| [key, value]) {
            out.extend_from_slice(&(text.len() as u32).to_le_bytes());
            out.extend_from_slice(text.as_bytes());
        }
        let bytes = out.len() + 8;
        if bytes > HEADER_BYTES_MAX {
            return Err(Error::new(
                ErrorKind::Limit,
                format!("a header of {bytes} bytes, at most {HEADER_BYTES_MAX} are possible"),
            ));
        }
        out[12..16].copy_from_slice(&(bytes as u32).to_le_bytes());
        let checksum = xxh3_64(&out);
        out.extend_from_slice(&checksum.to_le_bytes());
        Ok(out)
    }

    /// The whole header's length, from its first [`FIXED_BYTES`] bytes. Magic and version are checked first, so that
    /// a foreign or newer file is told apart from a broken one.
    pub fn length(fixed: &[u8; FIXED_BYTES], file_bytes: u64, path: &Path) -> Result<usize> {
        if fixed[..8] != MAGIC {
            let found: String = fixed[..8].escape_ascii().to_string();
            return Err(Error::corrupt(path, 0, format!("not a .mgs file: it begins with `{found}`")));
        }
        let version = read_le!(u32, fixed, 8);
        if version != VERSION {
            return Err(Error::unsupported(format!(
                "found .mgs version {version}, version {VERSION} is wanted"
            ))
            .at_byte(path, 8)
            .hint(
                "write the file again with this version of pantaray, or read it with the one that wrote it",
            ));
        }
        let bytes = read_le!(u32, fixed, 12) as usize;
        if !(FIXED_BYTES + 8..=HEADER_BYTES_MAX).contains(&bytes) || bytes as u64 > file_bytes {
            return Err(Error::corrupt(
                path,
                12,
                format!(
                    "the header claims {bytes} bytes; the file has {file_bytes}, at most {HEADER_BYTES_MAX} are possible"
                ),
            ));
        }
        Ok(bytes)
    }

    /// Reads a whole header whose length [`length`](Self::length) gave.
    pub fn decode(bytes: &[u8], path: &Path) -> Result<Self> {
        let (content, checksum) = bytes.split_at(bytes.len() - 8);
        if xxh3_64(content) != read_le!(u64, checksum, 0) {
            return Err(Error::corrupt(path, content.len() as u64, "the header's checksum does not match"));
        }
        let mut fields = Fields { bytes: content, at: FIXED_BYTES, path };
        let up = match content[24] {
            0 => UpAxis::Y,
            1 => UpAxis::Z,
            other => return Err(Error::corrupt(path, 24, format!("up axis `{other}`, 0 or 1 expected"))),
        };
        if content[25] != 0 {
            return Err(Error::corrupt(path, 25, "a reserved byte is not zero"));
        }
        let attribute_count = read_le!(u16, content, 26);
        let attributes = (0..attribute_count).map(|_| fields.attribute()).collect::<Result<_>>()?;
        let schema = Schema { meters_per_unit: read_le!(f64, content, 16), up, attributes };
        schema.validate().map_err(|error| error.at_byte(path, FIXED_BYTES as u64))?;
        let count = read_le!(u32, content, 28);
        if count as usize > METADATA_MAX {
            let message = format!("{count} metadata entries, at most {METADATA_MAX} are possible");
            return Err(Error::corrupt(path, 28, message));
        }
        let metadata =
            (0..count).map(|_| Ok((fields.text()?, fields.text()?))).collect::<Result<Vec<_>>>()?;
        if fields.at != content.len() {
            return Err(Error::corrupt(path, fields.at as u64, "bytes after the last metadata entry"));
        }
        check_metadata(&metadata).map_err(|error| error.at_byte(path, 28))?;
        Ok(Self { schema, metadata })
    }
}

/// The header's variable part, read in order; every length is checked against what is left.
struct Fields<'a> {
    bytes: &'a [u8],
    at: usize,
    path: &'a Path,
}

impl<'a> Fields<'a> {
    fn take(&mut self, bytes: usize) -> Result<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        if bytes > rest.len() {
            let message = format!("{bytes} bytes expected, the header has {} left", rest.len());
            return Err(Error::corrupt(self.path, self.at as u64, message));
        }
        self.at += bytes;
        Ok(&rest[..bytes])
    }

    fn string(&mut self, bytes: usize) -> Result<String> {
        let at = self.at as u64;
        let text = std::str::from_utf8(self.take(bytes)?);
        text.map(str::to_owned).map_err(|_| Error::corrupt(self.path, at, "a text is not UTF-8"))
    }

    fn text(&mut self) -> Result<String> {
        let bytes = read_le!(u32, self.take(4)?, 0);
        self.string(bytes as usize)
    }

    fn attribute(&mut self) -> Result<Attribute> {
        let name_bytes = self.take(1)?[0];
        let name = self.string(usize::from(name_bytes))?;
        let at = self.at as u64;
        let kind = self.take(4)?;
        let value_type = match kind[0] {
            0 => ValueType::F32,
            1 => ValueType::F16,
            2 => ValueType::U8,
            3 => ValueType::U32,
            other => {
                return Err(Error::corrupt(self.path, at, format!("value type `{other}`, 0 to 3 expected")));
            }
        };
        let rate = match kind[1] {
            0 => Rate::Vertex,
            1 => Rate::Grid,
            other => {
                return Err(Error::corrupt(self.path, at + 1, format!("rate `{other}`, 0 or 1 expected")));
            }
        };
        Ok(Attribute { name, value_type, components: read_le!(u16, kind, 2), rate })
    }
}

fn type_code(value_type: ValueType) -> u8 {
    match value_type {
        ValueType::F32 => 0,
        ValueType::F16 => 1,
        ValueType::U8 => 2,
        ValueType::U32 => 3,
    }
}

fn check_metadata(metadata: &[(String, String)]) -> Result<()> {
    if metadata.len() > METADATA_MAX {
        return Err(Error::new(
            ErrorKind::Limit,
            format!("{} metadata entries, at most {METADATA_MAX} are possible", metadata.len()),
        ));
    }
    let mut keys: Vec<&str> = metadata.iter().map(|(key, _)| key.as_str()).collect();
    keys.sort_unstable();
    if keys.first() == Some(&"") {
        return Err(Error::invalid("a metadata entry has no key"));
    }
    match keys.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(Error::invalid(format!("metadata `{}` is there twice", pair[0].escape_default()))),
        None => Ok(()),
    }
}
