//! The layout of a preview: a header, a directory of nodes level by level, then their points in the same order. So the
//! beginning of the file is a coarse picture of all of it.

use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use glam::DVec3;

use super::NODE_BYTES_MAX;
use super::sample::Points;
use super::tree::Spread;
use crate::scene::{Domain, UpAxis, Weight};
use crate::shade::sh::{BANDS_MAX, bands_of, coefficient_count};
use crate::stream::Schema;
use crate::stream::file::AtomicFile;
use crate::stream::schema::names;
use crate::{Error, ErrorKind, Result};

/// The first bytes.
const MAGIC: [u8; 8] = *b"PNTRPRVW";
/// The layout's version; version 1 is the same without errors.
const VERSION: u32 = 2;
/// Bytes of the header before the directory.
const FIXED_BYTES: usize = 152;
/// Bytes of the attribute's name, filled up with zeros.
const NAME_BYTES: usize = 64;
/// Bytes of a node in the directory.
const NODE_BYTES: usize = 24;
/// Nodes at most.
const NODES_MAX: u32 = 1 << 20;
/// Bytes of a record before its coefficients: position, normal, albedo and one that is 0.
pub const RECORD_HEAD_BYTES: usize = 14;

/// What a preview says about itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// The lower corner of the cube that holds all points, scene units.
    pub corner: DVec3,
    /// The cube's edge.
    pub edge: f64,
    /// Points in it.
    pub points: u64,
    /// Vertices of the stream that have a result.
    pub baked: u64,
    /// Metres per scene unit.
    pub meters_per_unit: f64,
    /// Which way is up.
    pub up: UpAxis,
    /// Bands of the coefficients.
    pub bands: usize,
    /// How directions weighed.
    pub weight: Weight,
    /// Where rays went.
    pub domain: Domain,
    /// Whether the stream has normals, and albedo.
    pub has: [bool; 2],
    /// Whether points have the error of their coefficients.
    pub has_error: bool,
    /// The attribute of the coefficients.
    pub attribute: String,
    /// Its column in the stream, and that of the error; not written.
    pub(super) columns: (usize, Option<usize>),
}

impl Header {
    /// A header for a stream's coefficients; what the points say comes later.
    pub(super) fn new(
        schema: &Schema,
        columns: (usize, Option<usize>),
        weight: Weight,
        domain: Option<Domain>,
    ) -> Self {
        let (column, error) = columns;
        let attribute = &schema.attributes[column];
        let normals = schema.find(names::NORMAL).is_some();
        Self {
            corner: DVec3::ZERO,
            edge: 0.0,
            points: 0,
            baked: 0,
            meters_per_unit: schema.meters_per_unit,
            up: schema.up,
            bands: bands_of(usize::from(attribute.components)).unwrap_or(1),
            weight,
            domain: domain.unwrap_or(if normals { Domain::Hemisphere } else { Domain::Sphere }),
            has: [normals, schema.find(names::ALBEDO).is_some()],
            has_error: error.is_some(),
            attribute: attribute.name.clone(),
            columns,
        }
    }

    /// Coefficients of a point.
    pub fn coefficients(&self) -> usize {
        coefficient_count(self.bands)
    }

    /// Bytes of a point.
    pub fn record_bytes(&self) -> usize {
        (RECORD_HEAD_BYTES + 2 * (self.coefficients() + usize::from(self.has_error))).next_multiple_of(4)
    }

    fn encode(&self, nodes: usize) -> Vec<u8> {
        let mut out = Vec::with_capacity(FIXED_BYTES + NODE_BYTES * nodes + 4);
        out.extend_from_slice(&MAGIC);
        out.extend_from_slice(&VERSION.to_le_bytes());
        out.extend_from_slice(&((FIXED_BYTES + NODE_BYTES * nodes + 4) as u32).to_le_bytes());
        for value in [self.corner.x, self.corner.y, self.corner.z, self.edge] {
            out.extend_from_slice(&value.to_le_bytes());
        }
        out.extend_from_slice(&self.points.to_le_bytes());
        out.extend_from_slice(&self.baked.to_le_bytes());
        out.extend_from_slice(&self.meters_per_unit.to_le_bytes());
        out.push(u8::from(self.up == UpAxis::Z));
        out.push(self.bands as u8);
        out.push(u8::from(self.weight == Weight::Cosine));
        out.push(u8::from(self.domain == Domain::Sphere));
        out.extend_from_slice(&(self.record_bytes() as u32).to_le_bytes());
        out.extend_from_slice(&(nodes as u32).to_le_bytes());
        let flags = [self.has[0], self.has[1], self.has_error];
        let flags = flags.into_iter().enumerate().map(|(bit, is)| u8::from(is) << bit).sum();
        out.extend([flags, 0, 0, 0]);
        let mut name = [0; NAME_BYTES];
        let bytes = self.attribute.len().min(NAME_BYTES);
        name[..bytes].copy_from_slice(&self.attribute.as_bytes()[..bytes]);
        out.extend_from_slice(&name);
        out
    }
}

/// A node in the directory.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Node {
    /// Where its points begin in the file.
    pub offset: u64,
    /// Its points.
    pub points: u32,
    /// How far apart points lie in its cube when it and all above it are shown, scene units.
    pub spacing: f32,
    /// CRC-32 of its points' bytes: what a browser can check quickly.
    pub crc32: u32,
    /// A bit for each child that is there; bit 0, 1, 2 of a child's number is its half along x, y, z.
    pub children: u8,
    /// Its level; the root's is 0.
    pub level: u8,
}

/// Header, directory and checksum, and how long all of the preview is.
fn encode_start(header: &Header, nodes: &[Spread], points: &Points) -> (Vec<u8>, u64) {
    let record = header.record_bytes();
    let mut start = header.encode(nodes.len());
    let mut offset = (FIXED_BYTES + NODE_BYTES * nodes.len() + 4) as u64;
    let mut bytes = Vec::with_capacity(NODE_BYTES_MAX);
    for spread in nodes {
        encode_points(spread, header, points, &mut bytes);
        let node = Node { offset, crc32: crc32fast::hash(&bytes), ..spread.node };
        start.extend_from_slice(&node.offset.to_le_bytes());
        start.extend_from_slice(&node.points.to_le_bytes());
        start.extend_from_slice(&node.spacing.to_le_bytes());
        start.extend_from_slice(&node.crc32.to_le_bytes());
        start.extend([node.children, node.level, 0, 0]);
        offset += u64::from(node.points) * record as u64;
    }
    start.extend_from_slice(&crc32fast::hash(&start).to_le_bytes());
    (start, offset)
}

/// A small preview, in memory.
pub(super) fn encode(header: &Header, nodes: &[Spread], points: &Points) -> Vec<u8> {
    let (mut all, length) = encode_start(header, nodes, points);
    all.reserve_exact((length as usize).saturating_sub(all.len()));
    let mut bytes = Vec::with_capacity(NODE_BYTES_MAX);
    for spread in nodes {
        encode_points(spread, header, points, &mut bytes);
        all.extend_from_slice(&bytes);
    }
    all
}

/// Writes a preview; its bytes.
pub(super) fn write(target: &Path, header: &Header, nodes: &[Spread], points: &Points) -> Result<u64> {
    let (start, length) = encode_start(header, nodes, points);
    let mut bytes = Vec::with_capacity(NODE_BYTES_MAX);
    let io = |error| Error::io("write", target, error);
    let mut file = BufWriter::new(AtomicFile::create(target)?);
    file.write_all(&start).map_err(io)?;
    for spread in nodes {
        encode_points(spread, header, points, &mut bytes);
        file.write_all(&bytes).map_err(io)?;
    }
    file.into_inner().map_err(|error| io(error.into_error()))?.commit()?;
    Ok(length)
}

/// The records of a node's points, their positions as 16 bits of its cube.
fn encode_points(spread: &Spread, header: &Header, points: &Points, bytes: &mut Vec<u8>) {
    bytes.clear();
    for &point in &spread.points {
        let at = (points.positions[point as usize] - spread.corner) / spread.edge;
        for value in at.to_array() {
            let quantised = (value.clamp(0.0, 1.0) * 65_535.0).round() as u16;
            bytes.extend_from_slice(&quantised.to_le_bytes());
        }
        bytes.extend_from_slice(points.record(header, point));
    }
}

/// A preview that is read.
#[derive(Debug)]
pub struct Preview {
    path: PathBuf,
    file: File,
    /// What it says about itself.
    pub header: Header,
    /// Its nodes, level by level, the root first.
    pub nodes: Vec<Node>,
}

impl Preview {
    /// Opens a preview and checks its header and directory.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] for another version, [`ErrorKind::Corrupt`] with the byte.
    pub fn open(path: &Path) -> Result<Self> {
        let io = |error| Error::io("read", path, error);
        let mut file = File::open(path).map_err(|error| Error::io("open", path, error))?;
        let length = file.metadata().map_err(io)?.len();
        let mut fixed = [0; FIXED_BYTES];
        if length < FIXED_BYTES as u64 {
            return Err(Error::corrupt(path, length, "the file ends in its header"));
        }
        file.read_exact(&mut fixed).map_err(io)?;
        if fixed[..8] != MAGIC {
            return Err(Error::new(ErrorKind::Corrupt, "not a preview").at(path));
        }
        let version = u32_at(&fixed, 8);
        if !(1..=VERSION).contains(&version) {
            let message = format!("a preview of version {version}, 1 to {VERSION} wanted");
            return Err(Error::unsupported(message).at(path));
        }
        let (start, count) = (u64::from(u32_at(&fixed, 12)), u32_at(&fixed, 80));
        let expected = FIXED_BYTES as u64 + NODE_BYTES as u64 * u64::from(count) + 4;
        if count == 0 || count > NODES_MAX || start != expected || start > length {
            return Err(Error::corrupt(path, 80, format!("{count} nodes in {length} bytes")));
        }
        let mut all = fixed.to_vec();
        all.resize(start as usize, 0);
        file.read_exact(&mut all[FIXED_BYTES..]).map_err(io)?;
        let sum = all.len() - 4;
        if crc32fast::hash(&all[..sum]) != u32_at(&all, sum) {
            return Err(Error::corrupt(path, sum as u64, "the checksum of the directory is wrong"));
        }
        let header = decode_header(path, &fixed)?;
        let nodes: Vec<Node> = all[FIXED_BYTES..sum].chunks_exact(NODE_BYTES).map(decode_node).collect();
        check(path, &header, &nodes, start, length)?;
        Ok(Self { path: path.into(), file, header, nodes })
    }

    /// Reads the records of a node's points.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when they are damaged.
    pub fn read(&mut self, node: usize, bytes: &mut Vec<u8>) -> Result<()> {
        let found = self.nodes[node];
        bytes.resize(found.points as usize * self.header.record_bytes(), 0);
        let read = self.file.seek(SeekFrom::Start(found.offset)).and_then(|_| self.file.read_exact(bytes));
        read.map_err(|error| Error::io("read", &self.path, error))?;
        if crc32fast::hash(bytes) != found.crc32 {
            return Err(Error::corrupt(&self.path, found.offset, format!("node {node} is damaged")));
        }
        Ok(())
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"))
}

fn f64_at(bytes: &[u8], at: usize) -> f64 {
    f64::from_bits(u64_at(bytes, at))
}

fn decode_header(path: &Path, fixed: &[u8; FIXED_BYTES]) -> Result<Header> {
    let bands = usize::from(fixed[73]);
    if fixed[72] > 1 || !(1..=BANDS_MAX).contains(&bands) || fixed[74] > 1 || fixed[75] > 1 {
        return Err(Error::corrupt(path, 72, "no such axis, number of bands, weight or domain"));
    }
    let name = &fixed[FIXED_BYTES - NAME_BYTES..];
    let name = &name[..name.iter().position(|&byte| byte == 0).unwrap_or(NAME_BYTES)];
    let header = Header {
        corner: DVec3::from_array([16, 24, 32].map(|at| f64_at(fixed, at))),
        edge: f64_at(fixed, 40),
        points: u64_at(fixed, 48),
        baked: u64_at(fixed, 56),
        meters_per_unit: f64_at(fixed, 64),
        up: if fixed[72] == 1 { UpAxis::Z } else { UpAxis::Y },
        bands,
        weight: if fixed[74] == 1 { Weight::Cosine } else { Weight::Uniform },
        domain: if fixed[75] == 1 { Domain::Sphere } else { Domain::Hemisphere },
        has: [fixed[84] & 1 != 0, fixed[84] & 2 != 0],
        has_error: fixed[84] & 4 != 0,
        attribute: String::from_utf8_lossy(name).into_owned(),
        columns: (0, None),
    };
    if u32_at(fixed, 76) as usize != header.record_bytes()
        || !header.corner.is_finite()
        || header.edge.is_nan()
        || header.edge <= 0.0
    {
        return Err(Error::corrupt(path, 76, "the record's length or the cube is impossible"));
    }
    Ok(header)
}

fn decode_node(bytes: &[u8]) -> Node {
    Node {
        offset: u64_at(bytes, 0),
        points: u32_at(bytes, 8),
        spacing: f32::from_bits(u32_at(bytes, 12)),
        crc32: u32_at(bytes, 16),
        children: bytes[20],
        level: bytes[21],
    }
}

/// Checks that the nodes follow one another, fill the file, and are one tree.
fn check(path: &Path, header: &Header, nodes: &[Node], start: u64, length: u64) -> Result<()> {
    let record = header.record_bytes() as u64;
    let (mut offset, mut points) = (start, 0);
    for node in nodes {
        let bytes = u64::from(node.points) * record;
        if node.offset != offset || bytes > NODE_BYTES_MAX as u64 {
            return Err(Error::corrupt(path, offset, "a node is not where it should be, or too large"));
        }
        offset += bytes;
        points += u64::from(node.points);
    }
    let children: u32 = nodes.iter().map(|node| node.children.count_ones()).sum();
    if offset != length || points != header.points || children as usize + 1 != nodes.len() {
        return Err(Error::corrupt(path, offset, "the nodes do not add up"));
    }
    Ok(())
}
