//! A scratch file of records of one size: written one after the other, read in runs, or by number.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};

use crate::{Error, Result};

/// Bytes of a write buffer, and of a run that is read, about.
const RUN_BYTES: usize = 1 << 18;

/// Bytes read at once where single records are asked for.
const WINDOW_BYTES: usize = 1 << 13;

/// Records of type `T` on disk. The file has no name: it is gone with its owner, however that ends.
pub(super) struct Records<T> {
    file: File,
    folder: PathBuf,
    buffer: Vec<T>,
    /// Records in the file; the buffer's come after them.
    written: u64,
}

impl<T: Pod> Records<T> {
    /// An empty file in `folder`.
    pub fn new(folder: &Path) -> Result<Self> {
        let file = tempfile::tempfile_in(folder)
            .map_err(|error| Error::io("create a temporary file in", folder, error))?;
        Ok(Self { file, folder: folder.to_path_buf(), buffer: Vec::new(), written: 0 })
    }

    /// A file in `folder` for `count` records that are written in any order.
    pub fn with_room(folder: &Path, count: u64) -> Result<Self> {
        Ok(Self { written: count, ..Self::new(folder)? })
    }

    /// Records so far.
    pub fn len(&self) -> u64 {
        self.written + self.buffer.len() as u64
    }

    /// Appends a record.
    pub fn push(&mut self, record: T) -> Result<()> {
        self.buffer.push(record);
        if self.buffer.len() * size_of::<T>() >= RUN_BYTES { self.flush() } else { Ok(()) }
    }

    /// Brings everything to the file. Reading sees what was flushed.
    pub fn flush(&mut self) -> Result<()> {
        let buffer = std::mem::take(&mut self.buffer);
        self.write_at(self.written, &buffer)?;
        self.written += buffer.len() as u64;
        self.buffer = buffer;
        self.buffer.clear();
        Ok(())
    }

    /// Writes records from number `first` on.
    pub fn write_at(&self, first: u64, records: &[T]) -> Result<()> {
        let (bytes, offset) = (bytemuck::cast_slice(records), first * size_of::<T>() as u64);
        let written = self.file.write_all_at(bytes, offset);
        written.map_err(|error| Error::io("write a temporary file in", &self.folder, error))
    }

    /// Reads `count` records from number `first` on.
    pub fn read(&self, first: u64, count: usize, into: &mut Vec<T>) -> Result<()> {
        into.resize(count, T::zeroed());
        let offset = first * size_of::<T>() as u64;
        let read = self.file.read_exact_at(bytemuck::cast_slice_mut(into), offset);
        read.map_err(|error| Error::io("read a temporary file in", &self.folder, error))
    }

    /// Reads all records in runs; `take` gets the number of the first one of each.
    pub fn for_each_run(&self, mut take: impl FnMut(u64, &[T]) -> Result<()>) -> Result<()> {
        let run = (RUN_BYTES / size_of::<T>()).max(1);
        let (mut first, mut records) = (0, Vec::new());
        while first < self.written {
            self.read(first, run.min((self.written - first) as usize), &mut records)?;
            take(first, &records)?;
            first += records.len() as u64;
        }
        Ok(())
    }

    /// The records of the given numbers, which ascend.
    pub fn gather(&self, numbers: &[u32]) -> Result<Vec<T>> {
        let window = (WINDOW_BYTES / size_of::<T>()).max(1);
        let (mut first, mut records) = (0, Vec::new());
        let mut found = Vec::with_capacity(numbers.len());
        for &number in numbers {
            let number = u64::from(number);
            if number - first >= records.len() as u64 {
                first = number;
                self.read(first, window.min((self.written - first) as usize), &mut records)?;
            }
            found.push(records[(number - first) as usize]);
        }
        Ok(found)
    }
}

/// Distributes records to places in a file that are known beforehand, through a buffer for each.
pub(super) struct Scatter<'a, T> {
    records: &'a Records<T>,
    /// Per place the number of its next record, and what waits for it.
    places: Vec<(u64, Vec<T>)>,
    buffer_max: usize,
}

/// Bytes of all buffers of a [`Scatter`] together, about.
const SCATTER_BYTES: usize = 16 << 20;

impl<'a, T: Pod> Scatter<'a, T> {
    /// Places that begin at the given records.
    pub fn new(records: &'a Records<T>, starts: impl Iterator<Item = u64>) -> Self {
        let places: Vec<_> = starts.map(|start| (start, Vec::new())).collect();
        let buffer_max = (SCATTER_BYTES / size_of::<T>() / places.len().max(1)).clamp(32, 4096);
        Self { records, places, buffer_max }
    }

    /// Appends a record to a place.
    pub fn push(&mut self, place: usize, record: T) -> Result<()> {
        self.places[place].1.push(record);
        if self.places[place].1.len() >= self.buffer_max { self.flush(place) } else { Ok(()) }
    }

    /// Brings everything to the file.
    pub fn finish(mut self) -> Result<()> {
        (0..self.places.len()).try_for_each(|place| self.flush(place))
    }

    fn flush(&mut self, place: usize) -> Result<()> {
        let (next, waiting) = &mut self.places[place];
        self.records.write_at(*next, waiting)?;
        *next += waiting.len() as u64;
        waiting.clear();
        Ok(())
    }
}

/// A vertex as its file has it.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Vertex {
    pub position: [f64; 3],
    pub radius: f32,
    pub color: [u8; 3],
    pub opacity: u8,
}

/// A face of at most four corners that can be used.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Face {
    /// Its normal, as long as its area.
    pub normal: [f64; 3],
    pub center: [f32; 3],
    /// Positions, [`NONE`] where there is no corner.
    pub corners: [u32; 4],
    /// Normals, [`NONE`] where none was given.
    pub normals: [u32; 4],
    pub material: u32,
    pub object: u32,
    pub opacity: u32,
}

/// Nothing.
pub(super) const NONE: u32 = u32::MAX;

impl Face {
    /// Its corners, 1 to 4.
    pub fn arity(&self) -> usize {
        self.corners.iter().take_while(|&&corner| corner != NONE).count()
    }
}
