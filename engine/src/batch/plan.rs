//! The batch plan: which points make which batch, on disk, so that an interrupted bake goes on where it stopped.
//!
//! Two files in a folder, laid out in `docs/formats.md`: `points.bin` with the points, batch by batch in the order of
//! the k-d tree's leaves, and `plan.bin` with one record per batch in Hilbert order. `plan.bin` comes last: where it
//! is, the plan is whole.

use std::fs::{self, File};
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use glam::DVec3;
use xxhash_rust::xxh3::{Xxh3Default, xxh3_64};

use super::scratch::sweep;
use super::{BitSet, Point};
use crate::math::Bounds;
use crate::stream::file::AtomicFile;
use crate::{Error, ErrorKind, Result};

const PLAN_FILE: &str = "plan.bin";
const POINTS_FILE: &str = "points.bin";
const PLAN_MAGIC: &[u8; 8] = b"PNTRPLAN";
const POINTS_MAGIC: &[u8; 8] = b"PNTRPNTS";
const VERSION: u32 = 1;
const HEADER_BYTES: u64 = 40;
const RECORD_BYTES: u64 = 64;
const POINTS_HEADER_BYTES: u64 = 16;

/// The batches of a bake set, in the order in which they are best baked.
///
/// Holds 64 bytes per batch in memory; points are read batch by batch.
#[derive(Debug)]
pub struct BatchPlan {
    table: PlanTable,
    points_path: PathBuf,
    points_file: Mutex<File>,
}

/// The batches of a plan without their points: where those of each batch stand, for who reads single batches from afar.
#[derive(Debug)]
pub struct PlanTable {
    header: Header,
    records: Vec<Record>,
    hash: u64,
}

/// What is known of a batch without reading its points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BatchInfo {
    /// Points.
    pub count: u32,
    /// The box of the points, scene units.
    pub bounds: Bounds,
}

/// The figures at the head of `plan.bin`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Header {
    pub points_per_batch_max: u32,
    /// Points of all batches.
    pub points: u64,
    /// Vertices of the stream, with those that the filter dropped.
    pub stream_points: u64,
}

/// A batch as `plan.bin` has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Record {
    /// Its number in the order of the points file: all leaves but the last are full, so this is its place as well.
    pub leaf: u32,
    pub count: u32,
    /// xxh3 of the points' bytes.
    pub hash: u64,
    pub bounds: Bounds,
}

impl BatchPlan {
    /// Opens the plan in `folder`.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when there is no whole plan; [`ErrorKind::Corrupt`] with the byte when magic, version,
    /// length, checksum or a record is wrong.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self> {
        let plan_path = folder.as_ref().join(PLAN_FILE);
        let points_path = folder.as_ref().join(POINTS_FILE);
        let table = PlanTable::open(&plan_path)?;
        let points_file = open_points(&points_path, table.header.points)?;
        Ok(Self { table, points_path, points_file: Mutex::new(points_file) })
    }

    /// The plan without its points.
    pub fn table(&self) -> &PlanTable {
        &self.table
    }

    /// Batches.
    pub fn len(&self) -> usize {
        self.table.records.len()
    }

    /// Never: a plan has points.
    pub fn is_empty(&self) -> bool {
        self.table.records.is_empty()
    }

    /// Points of all batches.
    pub fn points(&self) -> u64 {
        self.table.header.points
    }

    /// Vertices of the stream; more than [`points`](Self::points) where a filter dropped some.
    pub fn stream_points(&self) -> u64 {
        self.table.header.stream_points
    }

    /// Points of a batch at most; all batches but one have as many.
    pub fn points_per_batch_max(&self) -> u32 {
        self.table.header.points_per_batch_max
    }

    /// A hash of the whole plan: equal for equal points in equal batches.
    pub fn hash(&self) -> u64 {
        self.table.hash
    }

    /// What is known of batch `i` without reading it.
    ///
    /// # Panics
    /// When `i` is not below [`len`](Self::len).
    pub fn batch(&self, i: usize) -> BatchInfo {
        let record = &self.table.records[i];
        BatchInfo { count: record.count, bounds: record.bounds }
    }

    /// Reads the points of batch `i` into `points`, in the order of the Hilbert curve through the batch.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the points are not those that were written.
    ///
    /// # Panics
    /// When `i` is not below [`len`](Self::len).
    pub fn read(&self, i: usize, points: &mut Vec<Point>) -> Result<()> {
        let range = self.table.points_range(i);
        let mut bytes = vec![0; (range.end - range.start) as usize];
        {
            // The lock guards nothing but the file's position, which every reader sets anew.
            let mut file = self.points_file.lock().unwrap_or_else(PoisonError::into_inner);
            let read = file.seek(SeekFrom::Start(range.start)).and_then(|_| file.read_exact(&mut bytes));
            read.map_err(|error| Error::io("read points", &self.points_path, error))?;
        }
        self.table.decode(i, &bytes, &self.points_path, points)
    }
}

impl PlanTable {
    /// Opens a plan's table, the file `plan.bin`.
    ///
    /// # Errors
    /// As [`BatchPlan::open`].
    pub fn open(path: &Path) -> Result<Self> {
        let (header, records, hash) = read_table(path)?;
        check_table(path, &header, &records)?;
        Ok(Self { header, records, hash })
    }

    /// Batches.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Never: a plan has points.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// Points of a batch at most.
    pub fn points_per_batch_max(&self) -> u32 {
        self.header.points_per_batch_max
    }

    /// Where in the points file, `points.bin`, the points of batch `i` stand.
    ///
    /// # Panics
    /// When `i` is not below [`len`](Self::len).
    pub fn points_range(&self, i: usize) -> std::ops::Range<u64> {
        let record = &self.records[i];
        let first = u64::from(record.leaf) * u64::from(self.header.points_per_batch_max);
        let start = POINTS_HEADER_BYTES + first * Point::BYTES as u64;
        start..start + u64::from(record.count) * Point::BYTES as u64
    }

    /// The points of batch `i`, which stand in `bytes`; `path` says where those came from.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] when the points are not those that were written.
    ///
    /// # Panics
    /// When `i` is not below [`len`](Self::len).
    pub fn decode(&self, i: usize, bytes: &[u8], path: &Path, points: &mut Vec<Point>) -> Result<()> {
        let offset = self.points_range(i).start;
        if bytes.len() != self.records[i].count as usize * Point::BYTES
            || xxh3_64(bytes) != self.records[i].hash
        {
            let message = format!("the points of batch `{i}` do not match their checksum");
            return Err(damaged(path, offset, message));
        }
        points.clear();
        points.extend(bytes.as_chunks().0.iter().map(Point::from_bytes));
        let sound = |point: &Point| {
            point.index < self.header.stream_points && point.position.is_finite() && point.normal.is_finite()
        };
        match points.iter().position(|point| !sound(point)) {
            Some(at) => {
                let message =
                    format!("point {at} of batch `{i}` is not finite or has an index past the stream's end");
                Err(damaged(path, offset + (at * Point::BYTES) as u64, message))
            }
            None => Ok(()),
        }
    }

    /// Whole batches, evenly spaced along the plan's order, of about `points_max` points and not more, but at least one.
    pub fn evenly_spaced(&self, points_max: u64) -> Vec<u32> {
        let batches = self.records.len() as u64;
        if points_max >= self.header.points {
            return (0..batches as u32).collect();
        }
        let chosen = (points_max / u64::from(self.header.points_per_batch_max)).clamp(1, batches);
        // The middles of as many equal stretches
        (0..chosen).map(|i| ((2 * i + 1) * batches / (2 * chosen)) as u32).collect()
    }
}

fn damaged(path: &Path, offset: u64, message: String) -> Error {
    Error::corrupt(path, offset, message).hint("remove the folder to plan the batches again")
}

/// Writes the points file and then the table: the writing half of a plan.
pub(super) struct PlanWriter {
    folder: PathBuf,
    points: AtomicFile,
}

impl PlanWriter {
    /// Removes the plan in `folder`, if one is there, and starts a new one.
    ///
    /// # Errors
    /// When the operating system refuses.
    pub fn create(folder: &Path) -> Result<Self> {
        for name in [PLAN_FILE, POINTS_FILE] {
            sweep(folder, &format!(".{name}."), ".partial")?;
            let path = folder.join(name);
            match fs::remove_file(&path) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(Error::io("remove the old plan", &path, error));
                }
                _ => {}
            }
        }
        let points = AtomicFile::create(&folder.join(POINTS_FILE))?;
        let mut writer = Self { folder: folder.into(), points };
        let mut header = POINTS_MAGIC.to_vec();
        header.extend_from_slice(&VERSION.to_le_bytes());
        header.extend_from_slice(&(Point::BYTES as u32).to_le_bytes());
        writer.append(&header)?;
        Ok(writer)
    }

    /// Appends the points of the next leaf.
    ///
    /// # Errors
    /// When the disk is full or refuses.
    pub fn append(&mut self, bytes: &[u8]) -> Result<()> {
        let written = self.points.write_all(bytes);
        written.map_err(|error| Error::io("write points", self.points.target(), error))
    }

    /// Brings points and table to disk and gives both their names.
    ///
    /// # Errors
    /// When the operating system refuses.
    pub fn finish(self, header: Header, table: &[Record]) -> Result<BatchPlan> {
        self.points.commit()?;
        let path = self.folder.join(PLAN_FILE);
        let mut file = AtomicFile::create(&path)?;
        write_table(&mut file, &header, table).map_err(|error| Error::io("write the plan", &path, error))?;
        file.commit()?;
        BatchPlan::open(&self.folder)
    }
}

fn write_table(file: &mut AtomicFile, header: &Header, table: &[Record]) -> std::io::Result<()> {
    let mut out = HashingWriter { out: BufWriter::new(file), hash: Xxh3Default::new() };
    out.put(PLAN_MAGIC)?;
    out.put(&VERSION.to_le_bytes())?;
    out.put(&header.points_per_batch_max.to_le_bytes())?;
    out.put(&header.points.to_le_bytes())?;
    out.put(&header.stream_points.to_le_bytes())?;
    out.put(&(table.len() as u32).to_le_bytes())?;
    out.put(&[0; 4])?;
    for record in table {
        out.put(&record.to_bytes())?;
    }
    let hash = out.hash.digest();
    out.out.write_all(&hash.to_le_bytes())?;
    out.out.flush()
}

/// A writer that hashes what passes.
struct HashingWriter<W> {
    out: W,
    hash: Xxh3Default,
}

impl<W: Write> HashingWriter<W> {
    fn put(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.hash.update(bytes);
        self.out.write_all(bytes)
    }
}

impl Record {
    fn to_bytes(self) -> [u8; RECORD_BYTES as usize] {
        let mut bytes = [0; RECORD_BYTES as usize];
        bytes[..4].copy_from_slice(&self.leaf.to_le_bytes());
        bytes[4..8].copy_from_slice(&self.count.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.hash.to_le_bytes());
        let numbers = self.bounds.min.to_array().into_iter().chain(self.bounds.max.to_array());
        for (bytes, x) in bytes[16..].chunks_exact_mut(8).zip(numbers) {
            bytes.copy_from_slice(&x.to_le_bytes());
        }
        bytes
    }

    fn from_bytes(bytes: &[u8; RECORD_BYTES as usize]) -> Self {
        let vector = |at: usize| {
            DVec3::from_array(std::array::from_fn(|axis| f64::from_bits(u64_at(bytes, at + 8 * axis))))
        };
        Self {
            leaf: u32_at(bytes, 0),
            count: u32_at(bytes, 4),
            hash: u64_at(bytes, 8),
            bounds: Bounds { min: vector(16), max: vector(40) },
        }
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"))
}

/// Reads `plan.bin`: header, records and checksum. What the records say is not checked here.
fn read_table(path: &Path) -> Result<(Header, Vec<Record>, u64)> {
    let refused = |error| Error::io("read the plan", path, error);
    let file = File::open(path).map_err(refused)?;
    let bytes_total = file.metadata().map_err(refused)?.len();
    let mut input = BufReader::with_capacity(1 << 16, file);

    let mut head = [0; HEADER_BYTES as usize];
    input.read_exact(&mut head).map_err(|error| short(path, 0, error))?;
    check_magic(path, &head, PLAN_MAGIC, "batch plan")?;
    let header = Header {
        points_per_batch_max: u32_at(&head, 12),
        points: u64_at(&head, 16),
        stream_points: u64_at(&head, 24),
    };
    let batches = u64::from(u32_at(&head, 32));
    if bytes_total != HEADER_BYTES + batches * RECORD_BYTES + 8 {
        return Err(Error::corrupt(path, 32, format!("{batches} batches do not make {bytes_total} bytes")));
    }

    let mut hash = Xxh3Default::new();
    hash.update(&head);
    let mut table = Vec::with_capacity(batches as usize);
    let mut record = [0; RECORD_BYTES as usize];
    for i in 0..batches {
        input.read_exact(&mut record).map_err(|error| short(path, HEADER_BYTES + i * RECORD_BYTES, error))?;
        hash.update(&record);
        table.push(Record::from_bytes(&record));
    }
    let mut stored = [0; 8];
    input.read_exact(&mut stored).map_err(|error| short(path, bytes_total - 8, error))?;
    let hash = hash.digest();
    if hash != u64::from_le_bytes(stored) {
        return Err(Error::corrupt(path, bytes_total - 8, "the plan does not match its checksum"));
    }
    Ok((header, table, hash))
}

/// Checks everything that readers of the plan rely on.
fn check_table(path: &Path, header: &Header, table: &[Record]) -> Result<()> {
    let per_batch = u64::from(header.points_per_batch_max);
    if per_batch == 0 || header.points == 0 || header.points > header.stream_points {
        return Err(Error::corrupt(path, 12, "the plan's counts contradict each other"));
    }
    if header.points.div_ceil(per_batch) != table.len() as u64 {
        return Err(Error::corrupt(
            path,
            32,
            format!("{} batches for {} points", table.len(), header.points),
        ));
    }
    let mut seen = BitSet::new(table.len() as u64);
    for (i, record) in table.iter().enumerate() {
        let leaf = u64::from(record.leaf);
        let full = leaf + 1 < table.len() as u64;
        let expected = if full { per_batch } else { header.points - (table.len() as u64 - 1) * per_batch };
        let bounds = &record.bounds;
        let boxed = bounds.min.is_finite() && bounds.max.is_finite() && !bounds.is_empty();
        if leaf >= seen.len() || !seen.insert(leaf) || u64::from(record.count) != expected || !boxed {
            let offset = HEADER_BYTES + i as u64 * RECORD_BYTES;
            return Err(Error::corrupt(path, offset, format!("the record of batch `{i}` makes no sense")));
        }
    }
    Ok(())
}

/// Opens the points file and checks its head and length.
fn open_points(path: &Path, points: u64) -> Result<File> {
    let refused = |error| Error::io("read points", path, error);
    let mut file = File::open(path).map_err(refused)?;
    let bytes_total = file.metadata().map_err(refused)?.len();
    let mut head = [0; POINTS_HEADER_BYTES as usize];
    file.read_exact(&mut head).map_err(|error| short(path, 0, error))?;
    check_magic(path, &head, POINTS_MAGIC, "points file of a batch plan")?;
    let expected =
        points.checked_mul(Point::BYTES as u64).and_then(|bytes| bytes.checked_add(POINTS_HEADER_BYTES));
    if u32_at(&head, 12) != Point::BYTES as u32 || expected != Some(bytes_total) {
        return Err(Error::corrupt(path, 12, format!("{points} points do not make {bytes_total} bytes")));
    }
    Ok(file)
}

fn check_magic(path: &Path, head: &[u8], magic: &[u8; 8], what: &str) -> Result<()> {
    if head[..8] != magic[..] {
        return Err(Error::corrupt(path, 0, format!("this is not a {what}")));
    }
    match u32_at(head, 8) {
        VERSION => Ok(()),
        version => Err(Error::unsupported(format!("version {version} of a {what}, {VERSION} wanted"))
            .at_byte(path, 8)
            .hint("remove the folder to plan the batches again")),
    }
}

/// The error of a read that ended early, which is damage, or that the operating system refused.
fn short(path: &Path, offset: u64, error: std::io::Error) -> Error {
    match error.kind() {
        std::io::ErrorKind::UnexpectedEof => {
            Error::new(ErrorKind::Corrupt, "the file ends too early").at_byte(path, offset)
        }
        _ => Error::io("read", path, error),
    }
}
