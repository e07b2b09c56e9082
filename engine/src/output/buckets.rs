//! Rows of all parts by range of point indices: scattered to disk in one pass, read back range by range.
//!
//! One temporary file holds all ranges. Each range has a block in memory that goes to the end of the file when it is
//! full; the list of a range's blocks stays in memory.

use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;

use crate::batch::{BitSet, ScratchFile, sweep};
use crate::{Error, ErrorKind, Result};

/// Smaller blocks would make a disk seek for little.
const BLOCK_BYTES_MIN: u64 = 4 << 10;

/// Larger blocks would make it no faster.
const BLOCK_BYTES_MAX: u64 = 1 << 20;

/// How a merge divides the points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Division {
    /// Points of the stream.
    pub points: u64,
    /// Bytes of a row.
    pub row_bytes: usize,
    /// Points of a range; the last may have fewer.
    pub range_points: u64,
    /// Bytes of a block.
    pub block_bytes: usize,
}

impl Division {
    /// Divides so that a range takes half of the memory at most, and all blocks together a quarter.
    ///
    /// # Errors
    /// [`ErrorKind::Limit`] when the memory is too small for so many points.
    pub fn new(points: u64, row_bytes: usize, memory_bytes: u64) -> Result<Self> {
        // A bit per point for the coverage, and no more than fits into the 32 bits of a place in a range
        let range_points = u128::from(memory_bytes) * 4 / (8 * row_bytes as u128 + 1);
        let range_points = range_points.min(1 << 31) as u64;
        let range_points = range_points.clamp(1, points.max(1));
        let ranges = points.div_ceil(range_points).max(1);
        let block_bytes = (memory_bytes / 4 / ranges).min(BLOCK_BYTES_MAX);
        if ranges > 1 && block_bytes < BLOCK_BYTES_MIN.max(4 + row_bytes as u64) {
            let message =
                format!("merging {points} points of {row_bytes} bytes needs more than {memory_bytes} bytes");
            return Err(Error::new(ErrorKind::Limit, message).hint("give more memory"));
        }
        Ok(Self { points, row_bytes, range_points, block_bytes: block_bytes as usize })
    }

    /// Ranges.
    pub fn ranges(&self) -> usize {
        self.points.div_ceil(self.range_points).max(1) as usize
    }
}

/// The rows of a range of points, dense, and which of them were written.
#[derive(Debug)]
pub struct Range {
    first: u64,
    row_bytes: usize,
    rows: Vec<u8>,
    covered: BitSet,
}

impl Range {
    fn new(row_bytes: usize) -> Self {
        Self { first: 0, row_bytes, rows: Vec::new(), covered: BitSet::default() }
    }

    /// Becomes the range of `points` points from `first` on, none written.
    fn start(&mut self, first: u64, points: u64) {
        self.first = first;
        self.covered.reset(points);
        self.rows.clear();
        self.rows.resize(points as usize * self.row_bytes, 0);
    }

    /// Writes a row.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when it is written already, with other bytes.
    fn write(&mut self, place: u64, row: &[u8]) -> Result<()> {
        let old = &mut self.rows[place as usize * self.row_bytes..][..self.row_bytes];
        if self.covered.insert(place) {
            old.copy_from_slice(row);
        } else if old != row {
            let message = format!("point `{}` was baked twice with different results", self.first + place);
            return Err(Error::invalid(message));
        }
        Ok(())
    }

    /// Whether the point was written, and its row: zeros where it was not.
    pub fn row(&self, index: u64) -> (bool, &[u8]) {
        let place = index - self.first;
        (self.covered.contains(place), &self.rows[place as usize * self.row_bytes..][..self.row_bytes])
    }
}

/// All rows. With one range they never leave the memory.
pub struct Buckets {
    division: Division,
    scratch: Option<Scratch>,
    range: Range,
    /// The range that is in memory.
    loaded: Option<usize>,
}

/// The blocks of several ranges.
struct Scratch {
    file: ScratchFile,
    file_bytes: u64,
    /// Per range the block that is being filled, and what is in the file: offset and bytes.
    filling: Vec<Vec<u8>>,
    written: Vec<Vec<(u64, u32)>>,
}

impl Buckets {
    /// Empty buckets, with a file in `folder` if one is needed.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn new(division: Division, folder: &Path) -> Result<Self> {
        sweep(folder, "merge-", ".tmp")?;
        let mut range = Range::new(division.row_bytes);
        let ranges = division.ranges();
        if ranges == 1 {
            range.start(0, division.points);
            return Ok(Self { division, scratch: None, range, loaded: Some(0) });
        }
        let scratch = Scratch {
            file: ScratchFile::create(folder.join("merge-rows.tmp"))?,
            file_bytes: 0,
            filling: vec![Vec::new(); ranges],
            written: vec![Vec::new(); ranges],
        };
        Ok(Self { division, scratch: Some(scratch), range, loaded: None })
    }

    /// Puts the row of a point; its index is below the division's points.
    ///
    /// # Errors
    /// When the disk is full or refuses; [`ErrorKind::Invalid`] when the point is there already with other bytes, as
    /// far as that can be seen now.
    pub fn put(&mut self, index: u64, row: &[u8]) -> Result<()> {
        let Some(scratch) = &mut self.scratch else { return self.range.write(index, row) };
        let (number, place) = (index / self.division.range_points, index % self.division.range_points);
        let block = &mut scratch.filling[number as usize];
        if block.len() + 4 + row.len() > self.division.block_bytes {
            scratch.flush(number as usize)?;
        }
        let block = &mut scratch.filling[number as usize];
        if block.capacity() == 0 {
            block.reserve_exact(self.division.block_bytes);
        }
        block.extend_from_slice(&(place as u32).to_le_bytes());
        block.extend_from_slice(row);
        Ok(())
    }

    /// Writes out what waits in memory, and frees it.
    ///
    /// # Errors
    /// When the disk is full or refuses.
    pub fn finish(&mut self) -> Result<()> {
        let Some(scratch) = &mut self.scratch else { return Ok(()) };
        for number in 0..scratch.filling.len() {
            scratch.flush(number)?;
            scratch.filling[number] = Vec::new();
        }
        Ok(())
    }

    /// The range that holds `index`. Calls with rising indices read every range once.
    ///
    /// # Errors
    /// When the disk refuses; [`ErrorKind::Invalid`] when a point was written twice with different bytes.
    pub fn range(&mut self, index: u64) -> Result<&Range> {
        let number = (index / self.division.range_points) as usize;
        if self.loaded != Some(number) {
            self.load(number)?;
        }
        Ok(&self.range)
    }

    /// Bytes in the temporary file.
    pub fn scratch_bytes(&self) -> u64 {
        self.scratch.as_ref().map_or(0, |scratch| scratch.file_bytes)
    }

    fn load(&mut self, number: usize) -> Result<()> {
        let Some(scratch) = &mut self.scratch else { return Ok(()) };
        self.loaded = None;
        let first = number as u64 * self.division.range_points;
        self.range.start(first, self.division.range_points.min(self.division.points - first));
        let mut block = Vec::with_capacity(self.division.block_bytes);
        for &(offset, bytes) in &scratch.written[number] {
            block.resize(bytes as usize, 0);
            let file = &mut scratch.file.file;
            let read = file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(&mut block));
            read.map_err(|error| Error::io("read rows", scratch.file.path(), error))?;
            for record in block.chunks_exact(4 + self.division.row_bytes) {
                let (place, row) = record.split_first_chunk().expect("more than four bytes");
                let place = u64::from(u32::from_le_bytes(*place));
                if place >= self.range.covered.len() {
                    return Err(Error::corrupt(
                        scratch.file.path(),
                        offset,
                        "the temporary file was changed",
                    ));
                }
                self.range.write(place, row)?;
            }
        }
        self.loaded = Some(number);
        Ok(())
    }
}

impl Scratch {
    /// Appends the block of a range to the file.
    fn flush(&mut self, number: usize) -> Result<()> {
        let block = &mut self.filling[number];
        if block.is_empty() {
            return Ok(());
        }
        let file = &mut self.file.file;
        let written = file.seek(SeekFrom::Start(self.file_bytes)).and_then(|_| file.write_all(block));
        written.map_err(|error| Error::io("write rows", self.file.path(), error))?;
        self.written[number].push((self.file_bytes, block.len() as u32));
        self.file_bytes += block.len() as u64;
        block.clear();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches rows that land at another point, or stay behind in a block, with one range and with many.
    #[test]
    fn rows_come_back_at_their_points() {
        let folder = tempfile::tempdir().expect("a folder");
        for range_points in [1000, 333, 7] {
            let division = Division { points: 1000, row_bytes: 6, range_points, block_bytes: 64 };
            let mut buckets = Buckets::new(division, folder.path()).expect("buckets");
            let row = |index: u64| [index as u8, (index >> 8) as u8, 1, 2, 3, 4];
            // 617 and 1000 have no common factor: every point but the multiples of five comes once, out of order
            for index in (0..1000).map(|i| i * 617 % 1000).filter(|index| index % 5 != 0) {
                buckets.put(index, &row(index)).expect("put");
            }
            buckets.put(1, &row(1)).expect("the same again");
            buckets.finish().expect("finished");
            assert_eq!(buckets.scratch_bytes(), if range_points == 1000 { 0 } else { 801 * 10 });
            for index in 0..1000 {
                let expected = if index % 5 == 0 { (false, [0; 6]) } else { (true, row(index)) };
                let (covered, bytes) = buckets.range(index).expect("a range").row(index);
                assert_eq!((covered, bytes), (expected.0, &expected.1[..]), "point {index}");
            }
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    /// Catches two results for one point of which the later wins.
    #[test]
    fn a_point_has_one_row() {
        let folder = tempfile::tempdir().expect("a folder");
        for range_points in [10, 4] {
            let division = Division { points: 10, row_bytes: 2, range_points, block_bytes: 64 };
            let mut buckets = Buckets::new(division, folder.path()).expect("buckets");
            buckets.put(7, &[1, 2]).expect("put");
            let again = buckets.put(7, &[1, 3]).and_then(|()| buckets.finish());
            let error = again.and_then(|()| buckets.range(7).map(drop)).expect_err("two rows");
            assert_eq!(error.message(), "point `7` was baked twice with different results");
        }
    }

    /// Catches a division that takes more memory than given, or one block too small to be read back fast.
    #[test]
    fn divisions_keep_to_the_memory() {
        for (points, row_bytes, memory_bytes) in [
            (1, 36, 16 << 20),
            (1_000_000, 36, 1 << 30),
            (1_000_000_000, 36, 64 << 20),
            (300_000_000, 600, 1 << 30),
            (1 << 40, 1, u64::MAX),
        ] {
            let division = Division::new(points, row_bytes, memory_bytes).expect("a division");
            let ranges = division.ranges() as u64;
            let range_bytes = division.range_points * row_bytes as u64 + division.range_points / 8;
            assert!(range_bytes <= memory_bytes / 2);
            assert!(ranges == 1 || ranges * division.block_bytes as u64 <= memory_bytes / 4);
            assert!(ranges * division.range_points >= points);
        }
        let error = Division::new(1 << 40, 36, 16 << 20).expect_err("too little memory");
        assert_eq!(error.kind(), ErrorKind::Limit);
    }
}
