//! A batch's result: an immutable, checksummed object with the values of its points and a mask of those computed.
//!
//! ```text
//! 40 bytes of identity and lengths │ row layout │ point indices │ coverage │ rows │ xxh3
//! ```
//!
//! Points stand in the order of their indices, whatever the order in which they were baked: indices become small steps
//! and the merge writes in one direction. `docs/formats.md` describes every byte.

use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use crate::batch::{BitSet, RAYS_PER_BATCH_MAX};
use crate::stream::schema::ATTRIBUTES_MAX;
use crate::stream::{Attribute, Rate, Schema, ValueType};
use crate::{Error, ErrorKind, Result};

const MAGIC: &[u8; 8] = b"PNTRPART";
const VERSION: u32 = 1;
const HEADER_BYTES: usize = 40;

/// What all parts of one bake of one bake set have in common.
#[derive(Clone, Debug, PartialEq)]
pub struct PartFormat {
    bake: u64,
    attributes: Vec<Attribute>,
    points_max: u32,
    row_bytes: usize,
    /// The attributes as parts and logs have them.
    layout: Vec<u8>,
}

impl PartFormat {
    /// The format of parts of up to `points_max` points, whose rows hold the values of `attributes` one after the
    /// other. `bake` is a hash of everything that the results depend on: parts of another bake are refused.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when there is no attribute, one is not per vertex or not possible in a stream, or
    /// `points_max` is not from 1 to 2^20.
    pub fn new(bake: u64, attributes: &[Attribute], points_max: u32) -> Result<Self> {
        if attributes.is_empty() {
            return Err(Error::invalid("nothing to bake: no attributes"));
        }
        Schema { attributes: attributes.to_vec(), ..Schema::default() }.validate()?;
        if let Some(attribute) = attributes.iter().find(|attribute| attribute.rate != Rate::Vertex) {
            return Err(Error::invalid(format!("attribute `{}` is not per vertex", attribute.name)));
        }
        if !(1..=RAYS_PER_BATCH_MAX).contains(&points_max) {
            let message = format!("`{points_max}` points per part, 1 to {RAYS_PER_BATCH_MAX} are possible");
            return Err(Error::invalid(message));
        }
        let row_bytes = attributes.iter().map(Attribute::value_bytes).sum();
        let layout = encode_layout(attributes);
        Ok(Self { bake, attributes: attributes.to_vec(), points_max, row_bytes, layout })
    }

    /// The hash of everything that the results depend on.
    pub fn bake(&self) -> u64 {
        self.bake
    }

    /// What a row holds, in order.
    pub fn attributes(&self) -> &[Attribute] {
        &self.attributes
    }

    /// Points of a part at most.
    pub fn points_max(&self) -> u32 {
        self.points_max
    }

    /// Bytes of the values of one point.
    pub fn row_bytes(&self) -> usize {
        self.row_bytes
    }

    /// The attributes as parts and logs have them.
    pub(super) fn layout(&self) -> &[u8] {
        &self.layout
    }

    /// Bytes of an encoded part at most.
    pub fn part_bytes_max(&self) -> usize {
        let points = self.points_max as usize;
        HEADER_BYTES + self.layout.len() + points * (10 + self.row_bytes) + points.div_ceil(8) + 8
    }
}

/// The result of one batch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Part {
    /// Number of the batch in the plan.
    pub batch: u32,
    /// The points' indices in the stream, without repetition.
    pub indices: Vec<u64>,
    /// The rows that were computed.
    pub covered: BitSet,
    /// One row per point, as the format lays it out; zeros where nothing was computed.
    pub values: Vec<u8>,
}

impl Part {
    /// Becomes the part of `batch` with these points, nothing computed yet; keeps its memory.
    pub fn start(&mut self, batch: u32, indices: impl IntoIterator<Item = u64>, format: &PartFormat) {
        self.batch = batch;
        self.indices.clear();
        self.indices.extend(indices);
        self.covered.reset(self.indices.len() as u64);
        self.values.clear();
        self.values.resize(self.indices.len() * format.row_bytes, 0);
    }

    /// Sets the values of the point at `row`: the components of all attributes, one after the other, converted to the
    /// types in which they are stored (integers are rounded and clamped).
    ///
    /// # Panics
    /// When `row` or the number of values does not fit.
    pub fn set_row(&mut self, format: &PartFormat, row: usize, values: &[f32]) {
        let mut out = &mut self.values[row * format.row_bytes..][..format.row_bytes];
        let mut rest = values;
        for attribute in &format.attributes {
            let (now, later) = rest.split_at(usize::from(attribute.components));
            let (bytes, others) = out.split_at_mut(attribute.value_bytes());
            (rest, out) = (later, others);
            for (bytes, &value) in bytes.chunks_exact_mut(attribute.value_type.bytes()).zip(now) {
                match attribute.value_type {
                    ValueType::F32 => bytes.copy_from_slice(&value.to_le_bytes()),
                    ValueType::F16 => bytes.copy_from_slice(&half::f16::from_f32(value).to_le_bytes()),
                    ValueType::U8 => bytes[0] = value.round() as u8,
                    ValueType::U32 => bytes.copy_from_slice(&(value.round() as u32).to_le_bytes()),
                }
            }
        }
        assert!(rest.is_empty(), "{} values too many", rest.len());
        self.covered.insert(row as u64);
    }

    /// The bytes of the point at `row`.
    pub fn row(&self, format: &PartFormat, row: usize) -> &[u8] {
        &self.values[row * format.row_bytes..][..format.row_bytes]
    }

    /// Checks that lengths agree with the format and that every computed value is a finite number.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] with batch, point and attribute.
    pub fn check(&self, format: &PartFormat) -> Result<()> {
        let points = self.indices.len();
        let batch = self.batch;
        if points == 0 || points > format.points_max as usize {
            let most = format.points_max;
            let message =
                format!("the part of batch `{batch}` has {points} points, 1 to {most} are possible");
            return Err(Error::invalid(message));
        }
        if self.values.len() != points * format.row_bytes || self.covered.len() != points as u64 {
            return Err(Error::invalid(format!(
                "the part of batch `{batch}` has columns of different lengths"
            )));
        }
        for (row, bytes) in self.values.chunks_exact(format.row_bytes).enumerate() {
            let mut rest = bytes;
            for attribute in &format.attributes {
                let (value, later) = rest.split_at(attribute.value_bytes());
                rest = later;
                if !all_finite(attribute.value_type, value) && self.covered.contains(row as u64) {
                    let (name, index) = (&attribute.name, self.indices[row]);
                    let message =
                        format!("`{name}` of point `{index}` in batch `{batch}` is not a finite number");
                    return Err(Error::invalid(message));
                }
            }
        }
        Ok(())
    }

    /// Appends the part as an object to `out`, points sorted by index.
    ///
    /// # Errors
    /// What [`check`](Self::check) finds; [`ErrorKind::Invalid`] when a point is there twice.
    pub fn encode(&self, format: &PartFormat, out: &mut Vec<u8>) -> Result<()> {
        self.check(format)?;
        let mut order: Vec<u32> = (0..self.indices.len() as u32).collect();
        order.sort_unstable_by_key(|&row| self.indices[row as usize]);
        let start = out.len();
        out.reserve(format.part_bytes_max());

        // Identity and lengths
        out.extend_from_slice(MAGIC);
        out.extend_from_slice(&VERSION.to_le_bytes());
        out.extend_from_slice(&self.batch.to_le_bytes());
        out.extend_from_slice(&format.bake.to_le_bytes());
        out.extend_from_slice(&(self.indices.len() as u32).to_le_bytes());
        out.extend_from_slice(&(format.row_bytes as u32).to_le_bytes());
        out.extend_from_slice(&(format.layout.len() as u32).to_le_bytes());
        out.extend_from_slice(&[0; 4]); // bytes of the indices, below
        out.extend_from_slice(&format.layout);

        // Indices as steps
        let indices_start = out.len();
        let mut previous = None;
        for &row in &order {
            let index = self.indices[row as usize];
            let step = match previous {
                None => index,
                Some(previous) if previous == index => {
                    let message = format!("point `{index}` is twice in the part of batch `{}`", self.batch);
                    return Err(Error::invalid(message));
                }
                Some(previous) => index - previous - 1,
            };
            put_varint(step, out);
            previous = Some(index);
        }
        let index_bytes = (out.len() - indices_start) as u32;
        out[start + 36..start + 40].copy_from_slice(&index_bytes.to_le_bytes());

        // Coverage and rows, zero where nothing was computed
        let mut covered = BitSet::new(order.len() as u64);
        let mask_start = out.len();
        out.resize(mask_start + order.len().div_ceil(8), 0);
        for (place, &row) in order.iter().enumerate() {
            if self.covered.contains(u64::from(row)) {
                covered.insert(place as u64);
                out.extend_from_slice(self.row(format, row as usize));
            } else {
                out.resize(out.len() + format.row_bytes, 0);
            }
        }
        let mut mask = Vec::with_capacity(order.len().div_ceil(8));
        covered.write_bytes(&mut mask);
        out[mask_start..mask_start + mask.len()].copy_from_slice(&mask);
        out.extend_from_slice(&xxh3_64(&out[start..]).to_le_bytes());
        Ok(())
    }

    /// Becomes the part that `bytes` hold; keeps its memory. `path` and `offset` say where they came from.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] with the byte for damage, [`ErrorKind::Unsupported`] for another version,
    /// [`ErrorKind::Invalid`] for a part of another bake. The part is empty then.
    pub fn decode(&mut self, bytes: &[u8], format: &PartFormat, path: &Path, offset: u64) -> Result<()> {
        *self = Self {
            indices: std::mem::take(&mut self.indices),
            values: std::mem::take(&mut self.values),
            ..Self::default()
        };
        self.indices.clear();
        self.values.clear();
        let header = PartHeader::decode(bytes, path, offset)?;
        if header.bake != format.bake || bytes[HEADER_BYTES..][..header.layout_bytes] != format.layout {
            let message = format!("the part of batch `{}` is one of another bake", header.batch);
            return Err(Error::invalid(message).at_byte(path, offset));
        }
        if header.points > format.points_max {
            let message =
                format!("{} points in a part, at most {} are possible", header.points, format.points_max);
            return Err(Error::corrupt(path, offset + 24, message));
        }

        // The header has checked that the lengths add up
        let points = header.points as usize;
        let indices_start = HEADER_BYTES + header.layout_bytes;
        let mask_start = indices_start + header.index_bytes;
        let rows_start = mask_start + points.div_ceil(8);
        let corrupt = |at: usize, what: &str| {
            let message = format!("{what} in the part of batch `{}`", header.batch);
            Error::corrupt(path, offset + at as u64, message)
        };
        let steps = &bytes[indices_start..mask_start];
        if let Err(at) = decode_steps(steps, points, &mut self.indices) {
            self.indices.clear();
            return Err(corrupt(indices_start + at, "an impossible point index"));
        }
        if !self.covered.read_bytes(&bytes[mask_start..rows_start], points as u64) {
            self.indices.clear();
            return Err(corrupt(rows_start - 1, "coverage of more points than there are"));
        }
        self.values.extend_from_slice(&bytes[rows_start..bytes.len() - 8]);
        self.batch = header.batch;
        Ok(())
    }
}

/// What an encoded part says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct PartHeader {
    /// Number of the batch in the plan.
    pub batch: u32,
    /// The hash of everything that the results depend on.
    pub bake: u64,
    /// Points.
    pub points: u32,
    /// What a row holds, in order.
    pub attributes: Vec<Attribute>,
    layout_bytes: usize,
    index_bytes: usize,
}

impl PartHeader {
    /// Reads the header of an encoded part and checks magic, version, checksum and lengths.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] with the byte for damage, [`ErrorKind::Unsupported`] for another version.
    pub fn decode(bytes: &[u8], path: &Path, offset: u64) -> Result<Self> {
        let corrupt = |at: usize, message: &str| Error::corrupt(path, offset + at as u64, message);
        if bytes.len() < HEADER_BYTES + 8 {
            return Err(corrupt(bytes.len(), "a part ends within its header"));
        }
        if bytes[..8] != MAGIC[..] {
            return Err(corrupt(0, "this is not a batch part"));
        }
        let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
        let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"));
        if u32_at(8) != VERSION {
            let message = format!("version {} of a batch part, {VERSION} wanted", u32_at(8));
            return Err(Error::new(ErrorKind::Unsupported, message).at_byte(path, offset + 8));
        }
        let checksum_at = bytes.len() - 8;
        if xxh3_64(&bytes[..checksum_at]) != u64_at(checksum_at) {
            return Err(corrupt(checksum_at, "a part does not match its checksum"));
        }
        let (points, row_bytes) = (u32_at(24), u32_at(28));
        let (layout_bytes, index_bytes) = (u32_at(32), u32_at(36));
        let [n, row, layout, index] = [points, row_bytes, layout_bytes, index_bytes].map(u128::from);
        let expected = HEADER_BYTES as u128 + layout + index + n.div_ceil(8) + n * row + 8;
        if points == 0 || expected != bytes.len() as u128 {
            return Err(corrupt(24, "the lengths of a part do not add up"));
        }
        let layout = &bytes[HEADER_BYTES..][..layout_bytes as usize];
        let attributes = decode_layout(layout)
            .filter(|attributes| attributes.iter().map(Attribute::value_bytes).sum::<usize>() as u128 == row)
            .ok_or_else(|| corrupt(HEADER_BYTES, "an impossible row layout in a part"))?;
        Ok(Self {
            batch: u32_at(12),
            bake: u64_at(16),
            points,
            attributes,
            layout_bytes: layout_bytes as usize,
            index_bytes: index_bytes as usize,
        })
    }
}

/// Attributes as parts and logs have them: count, then name, type and components of each.
fn encode_layout(attributes: &[Attribute]) -> Vec<u8> {
    let mut out = (attributes.len() as u16).to_le_bytes().to_vec();
    for attribute in attributes {
        out.push(attribute.name.len() as u8);
        out.extend_from_slice(attribute.name.as_bytes());
        out.push(match attribute.value_type {
            ValueType::F32 => 0,
            ValueType::F16 => 1,
            ValueType::U8 => 2,
            ValueType::U32 => 3,
        });
        out.extend_from_slice(&attribute.components.to_le_bytes());
    }
    out
}

/// The attributes that `bytes` hold, if they are possible.
fn decode_layout(bytes: &[u8]) -> Option<Vec<Attribute>> {
    let (count, mut rest) = bytes.split_first_chunk()?;
    let count = usize::from(u16::from_le_bytes(*count));
    if !(1..=ATTRIBUTES_MAX).contains(&count) {
        return None;
    }
    let mut attributes = Vec::with_capacity(count);
    for _ in 0..count {
        let (&length, tail) = rest.split_first()?;
        let (name, tail) = tail.split_at_checked(usize::from(length))?;
        let (&[code, low, high], tail) = tail.split_first_chunk()?;
        rest = tail;
        let value_type = match code {
            0 => ValueType::F32,
            1 => ValueType::F16,
            2 => ValueType::U8,
            3 => ValueType::U32,
            _ => return None,
        };
        attributes.push(Attribute::vertex(
            str::from_utf8(name).ok()?,
            value_type,
            u16::from_le_bytes([low, high]),
        ));
    }
    let schema = Schema { attributes, ..Schema::default() };
    (rest.is_empty() && schema.validate().is_ok()).then_some(schema.attributes)
}

/// Appends a number, seven bits a byte, low bits first, the top bit set on all bytes but the last (LEB128).
fn put_varint(mut x: u64, out: &mut Vec<u8>) {
    while x >= 0x80 {
        out.push(x as u8 | 0x80);
        x >>= 7;
    }
    out.push(x as u8);
}

/// Reads `count` steps into rising indices. The error is the place of the byte where it went wrong.
fn decode_steps(bytes: &[u8], count: usize, indices: &mut Vec<u64>) -> Result<(), usize> {
    // Every step takes a byte at least: no room is made for more than there is.
    if bytes.len() < count {
        return Err(bytes.len());
    }
    indices.reserve(count);
    let mut at = 0;
    for i in 0..count {
        let (mut step, mut shift) = (0u64, 0);
        loop {
            let &byte = bytes.get(at).ok_or(at)?;
            let bits = u64::from(byte & 0x7f);
            if shift > 63 || bits << shift >> shift != bits {
                return Err(at);
            }
            step |= bits << shift;
            shift += 7;
            at += 1;
            if byte < 0x80 {
                break;
            }
        }
        let index = match i {
            0 => step,
            _ => indices[i - 1].checked_add(1).and_then(|next| next.checked_add(step)).ok_or(at)?,
        };
        indices.push(index);
    }
    if at == bytes.len() { Ok(()) } else { Err(at) }
}

/// Whether every component of a value is a finite number.
fn all_finite(value_type: ValueType, bytes: &[u8]) -> bool {
    match value_type {
        ValueType::F32 => bytes.as_chunks().0.iter().all(|&bytes| f32::from_le_bytes(bytes).is_finite()),
        ValueType::F16 => {
            bytes.as_chunks().0.iter().all(|&bytes| half::f16::from_le_bytes(bytes).is_finite())
        }
        ValueType::U8 | ValueType::U32 => true,
    }
}

#[cfg(test)]
#[path = "part_tests.rs"]
pub(super) mod tests;
