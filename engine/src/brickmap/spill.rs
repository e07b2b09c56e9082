//! The spill: quantised microgrids on local disk, appended to one log and found again by partition.
//!
//! A partition is a list of blocks in the log. Records are packed, not compressed: coordinates do not compress, and the
//! disk is faster than the compressor. The log has no name once it is open, so nothing is left behind whatever happens.
//!
//! ```text
//! record  vertices - 1  u8      faces  u16      shift  u8
//!         flags         u8      1: coordinates are u16, not u32; 2: regular grid; 4: extinctions; 8: radii
//!         columns       u8      quads across, regular grids only
//!         low           3 x i32 lattice coordinates of the lower corner
//!         coordinates   3 x u16 or u32 per vertex, relative to `low`
//!         arities, indices      as in a microgrid, unless regular
//!         extinctions   u16 per face, if flagged
//!         radii         f32 per vertex in lattice steps, if flagged
//! ```

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use glam::IVec3;

use crate::{Error, ErrorKind, Result};

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
        // The first face is 0, 1, w+2, w+1 or 0, w+1, w+2, 1 for rows of w quads
        let wide = usize::from(self.indices[1].max(self.indices[3]));
        let columns = wide.wrapping_sub(1);
        if !(1..=254).contains(&columns)
            || !faces.is_multiple_of(columns)
            || self.vertices.len() != (faces / columns + 1) * wide
        {
            return;
        }
        let across_first = self.indices[1] == 1;
        let regular = self.indices.chunks_exact(4).enumerate().all(|(face, corners)| {
            let a = (face / columns) * wide + face % columns;
            let [b, d] = if across_first { [a + 1, a + wide] } else { [a + wide, a + 1] };
            [a, b, a + wide + 1, d] == [0, 1, 2, 3].map(|i| usize::from(corners[i]))
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
        out.extend_from_slice(&[self.shift, flags, self.columns]);
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
            out.extend_from_slice(&self.arities);
            out.extend_from_slice(&self.indices);
        }
        self.extinctions.iter().for_each(|e| out.extend_from_slice(&e.to_le_bytes()));
        self.radii.iter().for_each(|r| out.extend_from_slice(&r.to_le_bytes()));
    }

    /// Reads a record that [`encode`](Self::encode) wrote, and returns what follows it. The log is private and
    /// without a name, so only this process can have written it.
    fn decode<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        self.clear();
        let vertices = usize::from(bytes[0]) + 1;
        let faces = usize::from(u16::from_le_bytes([bytes[1], bytes[2]]));
        let flags = bytes[4];
        (self.shift, self.columns) = (bytes[3], bytes[5]);
        let (low, mut rest) = bytes[6..].split_at(12);
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
            self.arities.extend_from_slice(take(faces));
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

/// Where a block of a partition lies in the log.
#[derive(Clone, Copy, Debug)]
struct Block {
    offset: u64,
    bytes: u32,
}

/// The log and its partitions.
#[derive(Debug)]
pub struct Spill {
    file: File,
    written: u64,
    block_bytes: usize,
    buffers: Vec<Vec<u8>>,
    blocks: Vec<Vec<Block>>,
    folder: std::path::PathBuf,
}

impl Spill {
    /// An empty log in `folder` for `partitions`, with buffers of `memory_bytes` together.
    ///
    /// # Errors
    /// When the log cannot be made.
    pub fn create(folder: &Path, partitions: usize, memory_bytes: u64) -> Result<Self> {
        static NEXT: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(0);
        let number = NEXT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let path = folder.join(format!("spill.{}.{number}", std::process::id()));
        let io = |error| Error::io("create", &path, error);
        std::fs::create_dir_all(folder).map_err(io)?;
        let file = File::options().read(true).write(true).create_new(true).open(&path).map_err(io)?;
        std::fs::remove_file(&path).map_err(io)?;
        let block_bytes = (memory_bytes as usize / partitions.max(1)).clamp(16 << 10, 1 << 20);
        Ok(Self {
            file,
            written: 0,
            block_bytes,
            buffers: vec![Vec::new(); partitions],
            blocks: vec![Vec::new(); partitions],
            folder: folder.to_path_buf(),
        })
    }

    /// Bytes in the log.
    pub fn bytes(&self) -> u64 {
        self.written
    }

    /// Adds a grid to a partition.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn push(&mut self, partition: usize, grid: &Quantised) -> Result<()> {
        grid.encode(&mut self.buffers[partition]);
        if self.buffers[partition].len() >= self.block_bytes {
            self.flush(partition)?;
        }
        Ok(())
    }

    /// Writes what is buffered and gives the buffers back.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn finish(&mut self) -> Result<()> {
        (0..self.buffers.len()).try_for_each(|partition| self.flush(partition))?;
        self.buffers = Vec::new();
        Ok(())
    }

    fn flush(&mut self, partition: usize) -> Result<()> {
        let buffer = &mut self.buffers[partition];
        if buffer.is_empty() {
            return Ok(());
        }
        self.file.write_all_at(buffer, self.written).map_err(|error| {
            Error::io("write temporary data", &self.folder, error)
                .hint("the folder needs about 20 bytes for every micropolygon of the occluders")
        })?;
        self.blocks[partition].push(Block { offset: self.written, bytes: buffer.len() as u32 });
        self.written += buffer.len() as u64;
        buffer.clear();
        Ok(())
    }

    /// Calls `each` with every grid of a partition, in the order they came.
    ///
    /// # Errors
    /// When the log cannot be read, and what `each` returns.
    pub fn read(&self, partition: usize, mut each: impl FnMut(&Quantised) -> Result<()>) -> Result<()> {
        let (mut grid, mut buffer) = (Quantised::default(), Vec::new());
        for block in &self.blocks[partition] {
            buffer.resize(block.bytes as usize, 0);
            self.file
                .read_exact_at(&mut buffer, block.offset)
                .map_err(|error| Error::io("read temporary data", &self.folder, error))?;
            let mut rest = &buffer[..];
            while !rest.is_empty() {
                rest = grid.decode(rest);
                each(&grid)?;
            }
        }
        Ok(())
    }
}

/// The error of a build that was told to stop.
pub fn cancelled() -> Error {
    Error::new(ErrorKind::Cancelled, "the build was cancelled")
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
        let mut spill = Spill::create(folder.path(), 3, 0).unwrap();
        let grids = [sample(true, false), sample(false, false), sample(true, true), sample(false, true)];
        assert_eq!(grids.each_ref().map(|grid| grid.columns), [3, 0, 3, 0]);
        for i in 0..2000 {
            spill.push(i % 3, &grids[i % 4]).unwrap();
        }
        spill.finish().unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the log should have no name");
        for partition in 0..3 {
            let mut i = partition;
            spill
                .read(partition, |grid| {
                    assert_eq!(*grid, grids[i % 4]);
                    i += 3;
                    Ok(())
                })
                .unwrap();
            assert!(i >= 2000);
        }
    }
}
