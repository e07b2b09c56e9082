//! The spill: quantised microgrids on local disk, appended to one log and found again by partition.
//!
//! A partition is a list of blocks in the log. Records are packed, not compressed: coordinates do not compress, and the
//! disk is faster than the compressor. The log has no name once it is open, so nothing is left behind whatever happens.
//!
//! ```text
//! record  vertices - 1  u8      faces  u16      shift  u8
//!         flags         u8      1: coordinates are u16, not u32; 2: regular grid; 4: extinctions; 8: radii
//!         columns       u8      quads across, regular grids only
//!         arity         u8      of all faces; 0: each has its own
//!         low           3 x i32 lattice coordinates of the lower corner
//!         coordinates   3 x u16 or u32 per vertex, relative to `low`
//!         arities, indices      as in a microgrid; none of a regular grid
//!         extinctions   u16 per face, if flagged
//!         radii         f32 per vertex in lattice steps, if flagged
//! ```

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use glam::IVec3;

use crate::{Error, Result};

const SHORT: u8 = 1;
const REGULAR: u8 = 2;
const EXTINCTIONS: u8 = 4;
const RADII: u8 = 8;

/// A microgrid on the lattice.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Quantised {
    /// Coordinates.
    pub vertices: Vec<IVec3>,
    /// As in a microgrid.
    pub arities: Vec<u8>,
    /// As in a microgrid.
    pub indices: Vec<u8>,
    /// One per face, or none when all faces are opaque.
    pub extinctions: Vec<u16>,
    /// One per vertex in lattice steps, or none when there are neither points nor lines.
    pub radii: Vec<f32>,
    /// Lattice shift of the geometry.
    pub shift: u8,
    /// Quads across when the faces are a regular grid in rows, otherwise 0.
    pub columns: u8,
}

impl Quantised {
    /// Empties it, keeping memory.
    pub fn clear(&mut self) {
        self.vertices.clear();
        self.arities.clear();
        self.indices.clear();
        self.extinctions.clear();
        self.radii.clear();
        (self.shift, self.columns) = (0, 0);
    }

    /// Sees whether the faces are a regular grid of quads in rows, and notes how many are in a row.
    pub fn find_columns(&mut self) {
        self.columns = 0;
        let faces = self.arities.len();
        if faces < 4 || self.arities.iter().any(|&arity| arity != 4) {
            return;
        }
        // The first face is 0, 1, w+1, w for rows of w vertices
        let wide = usize::from(self.indices[3]);
        let columns = wide.wrapping_sub(1);
        if !(1..=254).contains(&columns)
            || !faces.is_multiple_of(columns)
            || self.vertices.len() != (faces / columns + 1) * wide
        {
            return;
        }
        let regular = self.indices.chunks_exact(4).enumerate().all(|(face, corners)| {
            let a = (face / columns) * wide + face % columns;
            [a, a + 1, a + wide + 1, a + wide] == [0, 1, 2, 3].map(|i| usize::from(corners[i]))
        });
        if regular {
            self.columns = columns as u8;
        }
    }

    fn encode(&self, out: &mut Vec<u8>) {
        let low = self.vertices.iter().fold(IVec3::MAX, |low, &v| low.min(v));
        let high = self.vertices.iter().fold(IVec3::MIN, |high, &v| high.max(v));
        let short = (high - low).max_element() < 1 << 16;
        let flag = |on: bool, flag: u8| if on { flag } else { 0 };
        let flags = flag(short, SHORT)
            | flag(self.columns > 0, REGULAR)
            | flag(!self.extinctions.is_empty(), EXTINCTIONS)
            | flag(!self.radii.is_empty(), RADII);
        out.push((self.vertices.len() - 1) as u8);
        out.extend_from_slice(&(self.arities.len() as u16).to_le_bytes());
        let arity = if self.arities.windows(2).all(|pair| pair[0] == pair[1]) { self.arities[0] } else { 0 };
        out.extend_from_slice(&[self.shift, flags, self.columns, arity]);
        low.to_array().iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
        for &vertex in &self.vertices {
            let relative = (vertex - low).to_array();
            if short {
                relative.iter().for_each(|&c| out.extend_from_slice(&(c as u16).to_le_bytes()));
            } else {
                relative.iter().for_each(|&c| out.extend_from_slice(&(c as u32).to_le_bytes()));
            }
        }
        if self.columns == 0 {
            if arity == 0 {
                out.extend_from_slice(&self.arities);
            }
            out.extend_from_slice(&self.indices);
        }
        self.extinctions.iter().for_each(|e| out.extend_from_slice(&e.to_le_bytes()));
        self.radii.iter().for_each(|r| out.extend_from_slice(&r.to_le_bytes()));
    }

    /// Reads a record that [`encode`](Self::encode) wrote, and returns what follows it. The log is private and
    /// without a name, so only this process can have written it.
    pub fn decode<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        self.clear();
        let vertices = usize::from(bytes[0]) + 1;
        let faces = usize::from(u16::from_le_bytes([bytes[1], bytes[2]]));
        let flags = bytes[4];
        (self.shift, self.columns) = (bytes[3], bytes[5]);
        let (low, mut rest) = bytes[7..].split_at(12);
        let low = IVec3::from_array(
            [0, 4, 8].map(|i| i32::from_le_bytes(low[i..i + 4].try_into().expect("4 bytes"))),
        );
        let mut take = |count: usize| {
            let (taken, left) = rest.split_at(count);
            rest = left;
            taken
        };
        if flags & SHORT != 0 {
            self.vertices.extend(take(6 * vertices).chunks_exact(6).map(|c| {
                low + IVec3::new(
                    i32::from(u16::from_le_bytes([c[0], c[1]])),
                    i32::from(u16::from_le_bytes([c[2], c[3]])),
                    i32::from(u16::from_le_bytes([c[4], c[5]])),
                )
            }));
        } else {
            self.vertices.extend(take(12 * vertices).chunks_exact(12).map(|c| {
                low + IVec3::from_array(
                    [0, 4, 8].map(|i| i32::from_le_bytes(c[i..i + 4].try_into().expect("4 bytes"))),
                )
            }));
        }
        if flags & REGULAR != 0 {
            let (columns, wide) = (usize::from(self.columns), usize::from(self.columns) + 1);
            self.arities.resize(faces, 4);
            for face in 0..faces {
                let a = (face / columns) * wide + face % columns;
                self.indices.extend([a, a + 1, a + wide + 1, a + wide].map(|index| index as u8));
            }
        } else {
            match bytes[6] {
                0 => self.arities.extend_from_slice(take(faces)),
                arity => self.arities.resize(faces, arity),
            }
            let corners = self.arities.iter().map(|&arity| usize::from(arity)).sum();
            self.indices.extend_from_slice(take(corners));
        }
        if flags & EXTINCTIONS != 0 {
            self.extinctions
                .extend(take(2 * faces).chunks_exact(2).map(|c| u16::from_le_bytes([c[0], c[1]])));
        }
        if flags & RADII != 0 {
            let word = |c: &[u8]| f32::from_le_bytes(c.try_into().expect("4 bytes"));
            self.radii.extend(take(4 * vertices).chunks_exact(4).map(word));
        }
        rest
    }
}

/// Bytes of a record at most: 256 vertices of 12 bytes and a radius, 1024 faces of 5 bytes and an extinction.
const RECORD_BYTES_MAX: usize = 19 + 256 * 16 + 1024 * 7;

/// Bytes of a block: no less than holds a record, no more than a disk needs to be quick.
const BLOCK_BYTES: std::ops::RangeInclusive<usize> = 16 << 10..=1 << 20;
const _: () = assert!(RECORD_BYTES_MAX < 16 << 10);

/// Where a block of a partition lies in the log.
#[derive(Clone, Copy, Debug)]
struct Block {
    offset: u64,
    bytes: u32,
}

/// A list of microgrids in the log.
#[derive(Clone, Debug, Default)]
pub struct Partition {
    blocks: Vec<Block>,
    /// Micropolygons in it.
    pub micropolygons: u64,
}

impl Partition {
    /// Blocks in the log.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }
}

/// The log.
#[derive(Debug)]
pub struct Log {
    file: File,
    written: u64,
    folder: PathBuf,
}

impl Log {
    /// An empty log in `folder`.
    ///
    /// # Errors
    /// When it cannot be made.
    pub fn create(folder: &Path) -> Result<Self> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let path = folder.join(format!("spill.{}.{number}", std::process::id()));
        let io = |error| Error::io("create", &path, error);
        std::fs::create_dir_all(folder).map_err(io)?;
        let file = File::options().read(true).write(true).create_new(true).open(&path).map_err(io)?;
        std::fs::remove_file(&path).map_err(io)?;
        Ok(Self { file, written: 0, folder: folder.to_path_buf() })
    }

    /// Bytes in the log.
    pub fn bytes(&self) -> u64 {
        self.written
    }

    fn append(&mut self, bytes: &[u8]) -> Result<Block> {
        self.file.write_all_at(bytes, self.written).map_err(|error| {
            Error::io("write temporary data", &self.folder, error)
                .hint("the folder needs about 20 bytes for every micropolygon of the occluders")
        })?;
        let block = Block { offset: self.written, bytes: bytes.len() as u32 };
        self.written += bytes.len() as u64;
        Ok(block)
    }

    /// The bytes of a block of a partition: records for [`Quantised::decode`].
    ///
    /// # Errors
    /// When the log cannot be read.
    pub fn read_block(&self, partition: &Partition, block: usize, bytes: &mut Vec<u8>) -> Result<()> {
        let block = partition.blocks[block];
        bytes.resize(block.bytes as usize, 0);
        self.file
            .read_exact_at(bytes, block.offset)
            .map_err(|error| Error::io("read temporary data", &self.folder, error))
    }

    /// Calls `each` with every grid of a partition, in the order they came.
    ///
    /// # Errors
    /// When the log cannot be read.
    pub fn read(&self, partition: &Partition, mut each: impl FnMut(&Quantised)) -> Result<()> {
        let (mut grid, mut bytes) = (Quantised::default(), Vec::new());
        for block in 0..partition.block_count() {
            self.read_block(partition, block, &mut bytes)?;
            let mut rest = &bytes[..];
            while !rest.is_empty() {
                rest = grid.decode(rest);
                each(&grid);
            }
        }
        Ok(())
    }
}

/// Partitions that are being filled.
#[derive(Debug)]
pub struct Scatter {
    block_bytes: usize,
    buffers: Vec<Vec<u8>>,
    partitions: Vec<Partition>,
}

impl Scatter {
    /// `partitions` empty ones, with buffers of `memory_bytes` together, but no less than 16 KiB each.
    pub fn new(partitions: usize, memory_bytes: u64) -> Self {
        let block_bytes = memory_bytes as usize / partitions.max(1);
        Self {
            block_bytes: block_bytes.clamp(*BLOCK_BYTES.start(), *BLOCK_BYTES.end()),
            buffers: vec![Vec::new(); partitions],
            partitions: vec![Partition::default(); partitions],
        }
    }

    /// Adds a grid to a partition.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn push(&mut self, log: &mut Log, partition: usize, grid: &Quantised) -> Result<()> {
        if self.buffers[partition].len() + RECORD_BYTES_MAX > self.block_bytes {
            self.flush(log, partition)?;
        }
        let buffer = &mut self.buffers[partition];
        if buffer.capacity() == 0 {
            buffer.reserve_exact(self.block_bytes);
        }
        grid.encode(buffer);
        self.partitions[partition].micropolygons += grid.arities.len() as u64;
        Ok(())
    }

    /// Writes what is buffered and returns the partitions.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn finish(mut self, log: &mut Log) -> Result<Vec<Partition>> {
        (0..self.buffers.len()).try_for_each(|partition| self.flush(log, partition))?;
        Ok(self.partitions)
    }

    fn flush(&mut self, log: &mut Log, partition: usize) -> Result<()> {
        let buffer = &mut self.buffers[partition];
        if !buffer.is_empty() {
            self.partitions[partition].blocks.push(log.append(buffer)?);
            buffer.clear();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(regular: bool, far: bool) -> Quantised {
        let mut grid = Quantised { shift: 2, ..Quantised::default() };
        let scale = if far { 100_000 } else { 40 };
        grid.vertices = (0..12).map(|i| IVec3::new(i % 4, i / 4, i * i % 5) * scale - 70_000).collect();
        for face in 0..6_u8 {
            let a = face / 3 * 4 + face % 3;
            grid.arities.push(4);
            grid.indices.extend([a, a + 1, a + 5, a + 4]);
        }
        if !regular {
            grid.arities.extend([1, 2, 3]);
            grid.indices.extend([0, 1, 2, 3, 4, 5]);
            grid.extinctions = (0..9).collect();
            grid.radii = (0..12).map(|i| i as f32).collect();
        }
        grid.find_columns();
        grid
    }

    /// Catches a grid that changes on its way through the disk, or lands in another partition.
    #[test]
    fn grids_come_back_as_they_went() {
        let folder = tempfile::tempdir().unwrap();
        let mut log = Log::create(folder.path()).unwrap();
        let mut scatter = Scatter::new(3, 0);
        let grids = [sample(true, false), sample(false, false), sample(true, true), sample(false, true)];
        assert_eq!(grids.each_ref().map(|grid| grid.columns), [3, 0, 3, 0]);
        for i in 0..2000 {
            scatter.push(&mut log, i % 3, &grids[i % 4]).unwrap();
        }
        let partitions = scatter.finish(&mut log).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the log should have no name");
        for (number, partition) in partitions.iter().enumerate() {
            assert!(partition.blocks.len() > 1);
            let (mut i, mut micropolygons) = (number, 0);
            log.read(partition, |grid| {
                assert_eq!(*grid, grids[i % 4]);
                micropolygons += grid.arities.len() as u64;
                i += 3;
            })
            .unwrap();
            assert!(i >= 2000);
            assert_eq!(micropolygons, partition.micropolygons);
        }
    }
}
