//! The log on local disk that grids are spilled to: appended to, and found again by partition.
//!
//! A partition is a list of blocks in the log. The log has no name once it is open, so nothing is left behind whatever
//! happens. A thread of its own writes. Buffers share one bound: when it is reached, the fullest partition's is written,
//! so blocks are as large as memory and the order of the input allow, and 1 MiB at most.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use super::spill::Quantised;
use crate::brick::LatticeBox;
use crate::{Error, Result};

/// Buffers grow by this much.
const CHUNK_BYTES: usize = 16 << 10;
/// Bytes of a block at which it is written.
const BLOCK_BYTES: usize = 1 << 20;
/// Blocks on their way to the disk at most.
const BLOCKS_IN_FLIGHT: usize = 8;

/// Grids on their way to their partitions, encoded.
#[derive(Debug, Default)]
pub struct Batch {
    bytes: Vec<u8>,
    /// Partition, bytes and micropolygons of each grid.
    grids: Vec<(u32, u32, u32)>,
    /// Boxes of the grids, by partition.
    bounds: Vec<(u32, LatticeBox)>,
}

impl Batch {
    /// Adds a grid.
    pub fn push(&mut self, partition: usize, grid: &Quantised) {
        let start = self.bytes.len();
        grid.encode(&mut self.bytes);
        let bytes = (self.bytes.len() - start) as u32;
        self.grids.push((partition as u32, bytes, grid.arities.len() as u32));
        self.note(partition, grid);
    }

    /// Adds a grid's box alone: the grid is not needed any more.
    pub fn note(&mut self, partition: usize, grid: &Quantised) {
        let bounds = grid.bounds();
        match self.bounds.last_mut() {
            Some((last, all)) if *last == partition as u32 => *all = all.union(bounds),
            _ => self.bounds.push((partition as u32, bounds)),
        }
    }
}

/// Where a block lies in the log.
#[derive(Clone, Copy, Debug)]
pub struct Block {
    offset: u64,
    bytes: u32,
    micropolygons: u32,
}

/// The grids of a partition: blocks of a log, or a range of micropolygons in them.
#[derive(Clone, Debug)]
pub struct Spilled {
    log: Arc<Log>,
    blocks: Vec<Block>,
    /// Micropolygons of the blocks that come before the range, counted in whole grids.
    skipped: u64,
    /// Micropolygons of the range, to the end of the grid in which it ends.
    pub micropolygons: u64,
    /// The box of all its vertices, without radii; for a range that of all it is a range of.
    pub bounds: LatticeBox,
}

/// The file behind a log.
#[derive(Debug)]
struct Log {
    file: File,
    folder: PathBuf,
}

/// A log that is being written.
#[derive(Debug)]
pub struct Spill {
    log: Arc<Log>,
    partitions: Vec<Buffer>,
    buffered_bytes: usize,
    buffered_bytes_max: usize,
    written: u64,
    writer: Option<(SyncSender<Write>, JoinHandle<Result<()>>)>,
}

/// What a partition has in memory and on disk.
#[derive(Debug)]
struct Buffer {
    chunks: Vec<Vec<u8>>,
    bytes: usize,
    micropolygons: u32,
    blocks: Vec<Block>,
    bounds: LatticeBox,
}

/// A block for the writing thread.
struct Write {
    offset: u64,
    chunks: Vec<Vec<u8>>,
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
        let log = Arc::new(Log { file, folder: folder.to_path_buf() });
        let (sender, receiver) = sync_channel::<Write>(BLOCKS_IN_FLIGHT);
        let writing = log.clone();
        let write = move || receiver.iter().try_for_each(|write| writing.write(&write));
        let thread = std::thread::Builder::new().name("spill".into()).spawn(write).map_err(io)?;
        let in_flight = BLOCKS_IN_FLIGHT * BLOCK_BYTES;
        Ok(Self {
            log,
            partitions: (0..partitions).map(|_| Buffer::new()).collect(),
            buffered_bytes: 0,
            buffered_bytes_max: (memory_bytes as usize).saturating_sub(in_flight).max(BLOCK_BYTES),
            written: 0,
            writer: Some((sender, thread)),
        })
    }

    /// Adds grids to their partitions.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn add(&mut self, batch: &Batch) -> Result<()> {
        for &(partition, bounds) in &batch.bounds {
            let all = &mut self.partitions[partition as usize].bounds;
            *all = all.union(bounds);
        }
        let mut rest = &batch.bytes[..];
        for &(partition, bytes, micropolygons) in &batch.grids {
            let (record, after) = rest.split_at(bytes as usize);
            rest = after;
            let buffer = &mut self.partitions[partition as usize];
            self.buffered_bytes += buffer.push(record, micropolygons);
            if buffer.bytes >= BLOCK_BYTES {
                self.flush(partition as usize)?;
            }
            while self.buffered_bytes > self.buffered_bytes_max {
                let sizes = self.partitions.iter().enumerate().map(|(number, buffer)| (buffer.bytes, number));
                let (_, fullest) = sizes.max().expect("something is buffered");
                self.flush(fullest)?;
            }
        }
        Ok(())
    }

    /// Writes what is buffered. Returns the partitions and the bytes of the log.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn finish(mut self) -> Result<(Vec<Spilled>, u64)> {
        (0..self.partitions.len()).try_for_each(|partition| self.flush(partition))?;
        self.join()?;
        let spilled = |buffer: Buffer| {
            let micropolygons = buffer.blocks.iter().map(|block| u64::from(block.micropolygons)).sum();
            Spilled {
                log: self.log.clone(),
                blocks: buffer.blocks,
                skipped: 0,
                micropolygons,
                bounds: buffer.bounds,
            }
        };
        Ok((std::mem::take(&mut self.partitions).into_iter().map(spilled).collect(), self.written))
    }

    fn flush(&mut self, partition: usize) -> Result<()> {
        let buffer = &mut self.partitions[partition];
        if buffer.bytes == 0 {
            return Ok(());
        }
        let bytes = std::mem::take(&mut buffer.bytes);
        let micropolygons = std::mem::take(&mut buffer.micropolygons);
        buffer.blocks.push(Block { offset: self.written, bytes: bytes as u32, micropolygons });
        let chunks = std::mem::take(&mut buffer.chunks);
        self.buffered_bytes -= chunks.len() * CHUNK_BYTES;
        let write = Write { offset: self.written, chunks };
        self.written += bytes as u64;
        let sent = self.writer.as_ref().is_some_and(|(sender, _)| sender.send(write).is_ok());
        // A writer that has gone has an error to tell
        if sent { Ok(()) } else { self.join() }
    }

    fn join(&mut self) -> Result<()> {
        let Some((sender, thread)) = self.writer.take() else { return Ok(()) };
        drop(sender);
        thread.join().expect("the writing thread does not panic")
    }
}

impl Drop for Spill {
    fn drop(&mut self) {
        // The error that ended the work has been told
        _ = self.join();
    }
}

impl Buffer {
    fn new() -> Self {
        Self { chunks: Vec::new(), bytes: 0, micropolygons: 0, blocks: Vec::new(), bounds: LatticeBox::EMPTY }
    }

    /// Appends a record. Returns the bytes by which the buffer grew.
    fn push(&mut self, mut record: &[u8], micropolygons: u32) -> usize {
        let before = self.chunks.len();
        self.bytes += record.len();
        self.micropolygons += micropolygons;
        while !record.is_empty() {
            if self.chunks.last().is_none_or(|chunk| chunk.len() == CHUNK_BYTES) {
                self.chunks.push(Vec::with_capacity(CHUNK_BYTES));
            }
            let chunk = self.chunks.last_mut().expect("just made");
            let (now, later) = record.split_at(record.len().min(CHUNK_BYTES - chunk.len()));
            chunk.extend_from_slice(now);
            record = later;
        }
        (self.chunks.len() - before) * CHUNK_BYTES
    }
}

impl Log {
    fn write(&self, write: &Write) -> Result<()> {
        let mut offset = write.offset;
        for chunk in &write.chunks {
            self.file.write_all_at(chunk, offset).map_err(|error| {
                Error::io("write temporary data", &self.folder, error)
                    .hint("the folder needs about 20 bytes for every micropolygon of the occluders")
            })?;
            offset += chunk.len() as u64;
        }
        Ok(())
    }
}

impl Spilled {
    /// Gives the disk back what its blocks take, where the system can: nobody reads them any more. So the log shrinks as the map
    /// grows.
    pub fn release(&self) {
        #[cfg(target_os = "linux")]
        for block in &self.blocks {
            use rustix::fs::{FallocateFlags, fallocate};
            let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
            // File systems without holes keep the bytes until the log is closed
            _ = fallocate(&self.log.file, hole, block.offset, u64::from(block.bytes));
        }
    }

    /// The blocks one by one, in order, for threads to share.
    pub fn blocks(&self) -> impl Iterator<Item = Self> {
        debug_assert_eq!(self.skipped, 0);
        self.blocks.iter().map(|&block| Self {
            log: self.log.clone(),
            blocks: vec![block],
            skipped: 0,
            micropolygons: u64::from(block.micropolygons),
            bounds: self.bounds,
        })
    }

    /// Ranges of `micropolygons` each, in order; a grid belongs to the range in which it begins.
    pub fn ranges(&self, micropolygons: u64) -> Vec<Self> {
        debug_assert_eq!(self.skipped, 0);
        let range = |number: u64| {
            let from = number * micropolygons;
            let to = (from + micropolygons).min(self.micropolygons);
            let (mut before, mut skipped, mut blocks) = (0, 0, Vec::new());
            for &block in &self.blocks {
                let after = before + u64::from(block.micropolygons);
                if after > from && before < to {
                    if blocks.is_empty() {
                        skipped = from.saturating_sub(before);
                    }
                    blocks.push(block);
                }
                before = after;
            }
            Self { log: self.log.clone(), blocks, skipped, micropolygons: to - from, bounds: self.bounds }
        };
        (0..self.micropolygons.div_ceil(micropolygons)).map(range).collect()
    }

    /// Calls `each` with every grid of a partition, in the order they came.
    ///
    /// # Errors
    /// When the log cannot be read, and what `each` returns.
    pub fn read(&self, mut each: impl FnMut(&Quantised) -> Result<()>) -> Result<()> {
        let (mut grid, mut buffer) = (Quantised::default(), Vec::new());
        let (mut seen, end) = (0, self.skipped + self.micropolygons);
        for block in &self.blocks {
            buffer.resize(block.bytes as usize, 0);
            self.log
                .file
                .read_exact_at(&mut buffer, block.offset)
                .map_err(|error| Error::io("read temporary data", &self.log.folder, error))?;
            let mut rest = &buffer[..];
            while !rest.is_empty() {
                rest = grid.decode(rest);
                if seen >= self.skipped && seen < end {
                    each(&grid)?;
                }
                seen += grid.arities.len() as u64;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::spill::tests::sample;
    use super::*;

    /// Catches a grid that gets into another partition, out of order, or lost between two blocks; ranges that share or drop
    /// one; and a partition that takes others with it when it is released, or keeps the disk.
    #[test]
    fn partitions_come_back_in_order() {
        let folder = tempfile::tempdir().unwrap();
        // So little memory that blocks are small
        let mut spill = Spill::create(folder.path(), 3, 1 << 16).unwrap();
        let grids = [sample(true, false), sample(false, true), sample(false, false), sample(true, true)];
        for batch in 0..400 {
            let mut grids_of_batch = Batch::default();
            (50 * batch..50 * (batch + 1)).for_each(|i| grids_of_batch.push(i % 3, &grids[i % 4]));
            spill.add(&grids_of_batch).unwrap();
        }
        let (partitions, bytes) = spill.finish().unwrap();
        assert!(bytes > 2 << 20 && partitions[0].blocks.len() > 2);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the log has a name");
        for (partition, spilled) in partitions.iter().enumerate() {
            let mut i = partition;
            let mut check = |grid: &Quantised| {
                assert_eq!(*grid, grids[i % 4]);
                i += 3;
                Ok(())
            };
            spilled.read(&mut check).unwrap();
            assert!(i >= 20_000);
            let mut i = partition;
            for range in spilled.ranges(1000) {
                let mut micropolygons = 0;
                let mut check = |grid: &Quantised| {
                    assert_eq!(*grid, grids[i % 4]);
                    i += 3;
                    micropolygons += grid.arities.len();
                    Ok(())
                };
                range.read(&mut check).unwrap();
                assert!(micropolygons < 1024, "{micropolygons}");
            }
            assert!(i >= 20_000, "ranges lose grids");
            spilled.release();
        }
        #[cfg(target_os = "linux")]
        {
            use std::os::unix::fs::MetadataExt;
            let kept = 512 * partitions[0].log.file.metadata().unwrap().blocks();
            assert!(kept < bytes / 4, "{kept} of {bytes} bytes are still on the disk");
        }
    }
}
