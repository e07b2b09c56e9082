//! The files of a glTF asset: text or binary container, and the buffers inside, beside, or in data URIs.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::document::Document;
use crate::import::budget::Budget;
use crate::import::confine;
use crate::{Error, ErrorKind, Result};

/// Extensions that may be required: they are read, or change nothing about shape, colour and opacity.
const READABLE: [&str; 5] = [
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
    "KHR_texture_transform",
    "KHR_node_visibility",
    "KHR_lights_punctual",
];

/// Where a chunk lies in a GLB: offset and length in bytes.
type Chunk = (u64, u64);

/// An asset: its document and its buffers, each loaded when first asked for.
pub(super) struct Container {
    pub path: PathBuf,
    pub document: Document,
    pub budget: Budget,
    /// The binary chunk of a GLB.
    chunk: Option<Chunk>,
    buffers: Vec<Option<Vec<u8>>>,
}

impl Container {
    /// Reads the document of a `.gltf` or `.glb` file; the content says which it is.
    pub fn open(path: &Path, memory_bytes: u64) -> Result<Self> {
        let io = |e| Error::io("read the file", path, e);
        let mut budget = Budget::new(memory_bytes, path);
        let mut file = File::open(path).map_err(|e| Error::io("open the file", path, e))?;
        let length = file.metadata().map_err(io)?.len();
        let mut magic = [0; 4];
        let is_binary = length >= 12 && file.read_exact(&mut magic).is_ok() && &magic == b"glTF";
        file.seek(SeekFrom::Start(0)).map_err(io)?;
        let (json, chunk) = if is_binary {
            read_binary(&mut file, path, length, &mut budget)?
        } else {
            (read_part(&mut file, length, &mut budget, "the document").map_err(|e| e.at(path))?, None)
        };
        let document = parse(&json, path, is_binary, &mut budget)?;
        budget.give(json.len() as u64);
        check_version(&document)?;
        check_extensions(&document.extensions_required)?;
        super::check::check(&document)?;
        let buffers = document.buffers.iter().map(|_| None).collect();
        Ok(Self { path: path.to_path_buf(), document, budget, chunk, buffers })
    }

    /// The bytes of a buffer view, and the stride it asks for.
    pub fn view(&mut self, view: usize) -> Result<(&[u8], Option<u64>)> {
        let views = &self.document.buffer_views;
        let found = views.get(view).ok_or_else(|| missing("buffer view", view, views.len()))?;
        let has_bytes = found.buffer == 0 && self.chunk.is_some()
            || self.document.buffers.get(found.buffer).is_some_and(|buffer| buffer.uri.is_some());
        if let Some(name) = found.extensions.keys().find(|name| name.contains("meshopt") && !has_bytes) {
            return Err(unsupported(name));
        }
        let (buffer, stride) = (found.buffer, found.byte_stride);
        let range = (found.byte_offset, found.byte_length);
        self.load(buffer)?;
        let bytes = self.buffers[buffer].as_deref().unwrap_or_default();
        let end = range.0.checked_add(range.1).filter(|&end| end <= bytes.len() as u64).ok_or_else(|| {
            Error::invalid(format!(
                "buffer view {view} is bytes {} to {} of buffer {buffer}, which has {}",
                range.0,
                u128::from(range.0) + u128::from(range.1),
                bytes.len()
            ))
        })?;
        Ok((&bytes[range.0 as usize..end as usize], stride))
    }

    /// Loads a buffer, once.
    fn load(&mut self, index: usize) -> Result<()> {
        let count = self.buffers.len();
        let slot = self.buffers.get(index).ok_or_else(|| missing("buffer", index, count))?;
        if slot.is_some() {
            return Ok(());
        }
        let length = self.document.buffers[index].byte_length;
        let what = format!("buffer {index}");
        let bytes = match self.document.buffers[index].uri.as_deref() {
            Some(uri) => read_uri(&self.path, uri, Some(length), &mut self.budget, &what)?,
            None => match self.chunk {
                Some((offset, size)) if index == 0 => {
                    if size < length {
                        return Err(Error::corrupt(
                            &self.path,
                            offset,
                            format!("buffer 0 has {length} bytes, the binary chunk {size}"),
                        ));
                    }
                    let io = |e| Error::io("read the file", &self.path, e);
                    let mut file = File::open(&self.path).map_err(io)?;
                    file.seek(SeekFrom::Start(offset)).map_err(io)?;
                    read_part(&mut file, length, &mut self.budget, &what)?
                }
                _ => return Err(Error::invalid(format!("buffer {index} has no data"))),
            },
        };
        self.buffers[index] = Some(bytes);
        Ok(())
    }

    /// The bytes of an image that a document names by URI.
    pub fn image_uri(&mut self, uri: &str, image: usize) -> Result<Vec<u8>> {
        read_uri(&self.path, uri, None, &mut self.budget, &format!("image {image}"))
    }
}

/// An index that refers to nothing.
pub(super) fn missing(what: &str, index: usize, count: usize) -> Error {
    Error::invalid(format!("{what} {index} of {count}, which count from 0"))
}

/// The error for an extension that cannot be read.
pub(super) fn unsupported(name: &str) -> Error {
    let name: String = name.chars().take(80).collect();
    Error::unsupported(format!("the glTF extension `{}` is not supported", name.escape_debug()))
        .hint("export again without this extension, or convert the file with another program")
}

/// Reads the chunks of a GLB: the document, and where the binary chunk lies.
fn read_binary(
    file: &mut File,
    path: &Path,
    length: u64,
    budget: &mut Budget,
) -> Result<(Vec<u8>, Option<Chunk>)> {
    let io = |e| Error::io("read the file", path, e);
    let word = |file: &mut File| -> Result<u64> {
        let mut bytes = [0; 4];
        file.read_exact(&mut bytes).map_err(io)?;
        Ok(u64::from(u32::from_le_bytes(bytes)))
    };
    let [_, version, stated] = [word(file)?, word(file)?, word(file)?];
    if version != 2 {
        return Err(
            Error::unsupported(format!("GLB version {version}, version 2 can be read")).at_byte(path, 4)
        );
    }
    if stated > length {
        let message = format!("the header says {stated} bytes, the file has {length}");
        return Err(Error::corrupt(path, 8, message).hint("the file may be cut off"));
    }
    // What stands behind the stated end is not part of the asset
    let length = stated;
    let mut offset = 12;
    let mut chunks = Vec::new();
    // The document, the binary chunk, and whatever extensions put behind them, which is not needed
    while offset < length && chunks.len() < 2 {
        if length.saturating_sub(offset) < 8 {
            return Err(Error::corrupt(path, offset, "the file ends inside a chunk's header"));
        }
        file.seek(SeekFrom::Start(offset)).map_err(io)?;
        let (size, kind) = (word(file)?, word(file)?);
        if size > length - offset - 8 {
            let message = format!("a chunk of {size} bytes, {} are left", length - offset - 8);
            return Err(Error::corrupt(path, offset, message));
        }
        chunks.push((kind, offset + 8, size));
        offset += 8 + size;
    }
    let (json, rest) = match chunks.as_slice() {
        [(0x4e4f_534a, offset, size), rest @ ..] => ((*offset, *size), rest),
        _ => return Err(Error::corrupt(path, 12, "the first chunk is not the JSON document")),
    };
    let binary = rest.iter().find(|chunk| chunk.0 == 0x004e_4942).map(|chunk| (chunk.1, chunk.2));
    file.seek(SeekFrom::Start(json.0)).map_err(io)?;
    Ok((read_part(file, json.1, budget, "the document")?, binary))
}

/// Reads `length` bytes, of which the file is known or found to have as many.
fn read_part(file: &mut File, length: u64, budget: &mut Budget, what: &str) -> Result<Vec<u8>> {
    budget.take(length, what)?;
    let mut bytes = Vec::new();
    file.take(length)
        .read_to_end(&mut bytes)
        .map_err(|e| Error::new(ErrorKind::Io, format!("cannot read {what}: {e}")))?;
    if bytes.len() as u64 != length {
        let message = format!("{what} has {} bytes, {length} expected", bytes.len());
        return Err(Error::new(ErrorKind::Corrupt, message).hint("a file may be cut off"));
    }
    Ok(bytes)
}

fn parse(json: &[u8], path: &Path, is_binary: bool, budget: &mut Budget) -> Result<Document> {
    // What a document takes when parsed, at most: an object up to 512 bytes, a value 64
    let objects = json.iter().filter(|&&b| b == b'{').count() as u64;
    let values = json.iter().filter(|&&b| b == b',').count() as u64;
    let bytes = objects * 512 + values * 64 + json.len() as u64;
    budget.take(bytes, "the parsed document")?;
    let mut parsed = serde_json::from_slice(json);
    if matches!(&parsed, Err(e) if e.is_data()) && json.windows(2).any(|pair| pair == b".0") {
        // Integers may be written with a fraction of zero (specification, section 2.7.1.1)
        budget.take(bytes, "the parsed document")?;
        let value = serde_json::from_slice(json).map(whole_numbers);
        parsed = value.and_then(serde_json::from_value).or(parsed);
        budget.give(bytes);
    }
    parsed.map_err(|e| {
        let error = Error::invalid(format!("the document cannot be read: {e}"));
        match is_binary {
            true => error.at(path),
            false => error.at_text(path, e.line().max(1) as u64, e.column().max(1) as u64),
        }
    })
}

/// Makes integers of numbers whose fraction is zero.
fn whole_numbers(value: serde_json::Value) -> serde_json::Value {
    use serde_json::Value;
    match value {
        Value::Number(number) => match number.as_f64() {
            Some(x) if number.is_f64() && x.fract() == 0.0 && (0.0..9e15).contains(&x) => {
                Value::from(x as u64)
            }
            _ => Value::Number(number),
        },
        Value::Array(values) => values.into_iter().map(whole_numbers).collect(),
        Value::Object(map) => map.into_iter().map(|(key, value)| (key, whole_numbers(value))).collect(),
        other => other,
    }
}

fn check_version(document: &Document) -> Result<()> {
    let asset = document.asset.as_ref().ok_or_else(|| Error::invalid("the document has no `asset`"))?;
    let major_minor = |text: &str| -> Option<(u32, u32)> {
        let (major, minor) = text.split_once('.')?;
        Some((major.parse().ok()?, minor.parse().ok()?))
    };
    let version = major_minor(&asset.version);
    let needed = asset.min_version.as_deref().map_or(Some((2, 0)), major_minor);
    match (version, needed) {
        (None, _) | (_, None) => Err(Error::invalid("`asset.version` is not a version number")),
        (Some((2, _)), Some((2, 0))) => Ok(()),
        (Some((major, minor)), Some(needed)) => {
            let (major, minor) = if needed > (2, 0) { needed } else { (major, minor) };
            Err(Error::unsupported(format!("glTF version {major}.{minor}, 2.0 can be read")))
        }
    }
}

fn check_extensions(required: &[String]) -> Result<()> {
    let is_readable = |name: &str| {
        // Material extensions add to what is read of a material, or take its place with the same base colour
        READABLE.contains(&name) || name.starts_with("KHR_materials_") || name.starts_with("KHR_animation")
    };
    match required.iter().find(|name| !is_readable(name)) {
        Some(name) => Err(unsupported(name)),
        None => Ok(()),
    }
}

/// Reads a data URI, or a file beside `path`. With `length`, that many bytes.
fn read_uri(path: &Path, uri: &str, length: Option<u64>, budget: &mut Budget, what: &str) -> Result<Vec<u8>> {
    if let Some(data) = uri.strip_prefix("data:") {
        let (_, text) = data
            .split_once(";base64,")
            .ok_or_else(|| Error::invalid(format!("{what} has a data URI that is not base64")))?;
        budget.take(text.len() as u64 / 4 * 3, what)?;
        let mut bytes = base64(text)
            .ok_or_else(|| Error::invalid(format!("{what} has broken base64 in its data URI")))?;
        if let Some(length) = length {
            if (bytes.len() as u64) < length {
                let message = format!("{what} has {} bytes in its data URI, {length} expected", bytes.len());
                return Err(Error::invalid(message));
            }
            bytes.truncate(length as usize);
        }
        return Ok(bytes);
    }
    let name = percent_decode(uri).ok_or_else(|| Error::invalid(format!("{what} has a broken URI")))?;
    let target = confine::beside(path, &name)?;
    let io = |e| Error::io("read the file", &target, e);
    let mut file = File::open(&target).map_err(io)?;
    let size = file.metadata().map_err(io)?.len();
    if let Some(length) = length.filter(|&length| length > size) {
        let message = format!("{what} has {length} bytes, this file {size}");
        return Err(Error::corrupt(&target, size, message).hint("the file may be cut off"));
    }
    read_part(&mut file, length.unwrap_or(size), budget, what).map_err(|e| e.at(&target))
}

/// Decodes base64 (RFC 4648) with or without padding.
fn base64(text: &str) -> Option<Vec<u8>> {
    let text = text.trim_end_matches('=');
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3 + 3);
    let (mut bits, mut count) = (0_u32, 0);
    for c in text.bytes() {
        let value = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        bits = bits << 6 | u32::from(value);
        count += 6;
        if count >= 8 {
            count -= 8;
            bytes.push((bits >> count) as u8);
            bits &= (1 << count) - 1;
        }
    }
    (text.len() % 4 != 1).then_some(bytes)
}

/// Decodes percent escapes (RFC 3986).
fn percent_decode(uri: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.bytes();
    while let Some(byte) = rest.next() {
        if byte != b'%' {
            bytes.push(byte);
            continue;
        }
        let digits = [rest.next()?, rest.next()?];
        bytes.push(u8::from_str_radix(std::str::from_utf8(&digits).ok()?, 16).ok()?);
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a decoder that is off at the padding, or takes what is not base64.
    #[test]
    fn base64_follows_the_standard() {
        for (text, bytes) in [("", ""), ("Zg==", "f"), ("Zm8=", "fo"), ("Zm9v", "foo"), ("Zm9vYg", "foob")] {
            assert_eq!(base64(text).as_deref(), Some(bytes.as_bytes()), "{text}");
        }
        assert_eq!([base64("Z"), base64("Zm 9"), base64("Zm9v\u{e9}")], [None, None, None]);
    }

    /// Catches escapes that hide a way out of the folder, or that are cut off.
    #[test]
    fn percent_escapes_are_decoded_before_names_are_checked() {
        assert_eq!(percent_decode("a%20b%2f..").as_deref(), Some("a b/.."));
        assert_eq!([percent_decode("a%2"), percent_decode("%zz"), percent_decode("%ff")], [None, None, None]);
    }
}
