//! Reads a `.mgs` file forward, block by block, and trusts none of it.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use glam::{DVec3, Vec3};
use xxhash_rust::xxh3::xxh3_64;

use super::block::{self, BlockHeader, ValueBytes};
use super::footer::{self, Footer};
use super::header::{self, Header};
use super::{StreamCounts, read_le};
use crate::stream::microgrid::FACES_MAX;
use crate::stream::{Microgrid, MicrogridStream, Rate, Schema};
use crate::{Error, ErrorKind, Result};

/// The exponent bits of an f32; all set in infinities and NaNs.
const EXPONENT: u32 = 0x7f80_0000;

/// Reads a `.mgs` file. Memory is bounded by the format's maxima whatever the file claims: about 30 MiB at the very
/// worst, 4 MiB for what [`MgsWriter`](super::MgsWriter) writes.
pub struct MgsReader {
    path: PathBuf,
    file: File,
    file_bytes: u64,
    header: Header,
    value_bytes: ValueBytes,
    seed: u64,
    blocks_offset: u64,
    footer: Footer,
    /// Where the next block, or the footer, begins.
    offset: u64,
    counted: Footer,
    state: State,
    block: Block,
    stored: Vec<u8>,
}

/// What a counting pass needs to know of a grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridSummary {
    /// What positions are relative to, in scene units.
    pub anchor: DVec3,
    /// The offset of vertex `vertices / 2` from the anchor.
    pub middle: Vec3,
    /// Vertices, 1 to 256.
    pub vertices: u32,
    /// Faces, at most 1,024.
    pub faces: u32,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    Reading,
    Ended,
    Broken,
}

/// The block that is being read: its decoded columns and how far they are used.
#[derive(Default)]
struct Block {
    offset: u64,
    grids: usize,
    vertices: usize,
    faces: usize,
    corners: usize,
    payload_frame: [u32; 2],
    payload_checksum: u64,
    payload_offset: u64,
    has_payload: bool,
    summary: Vec<u8>,
    payload: Vec<u8>,
    /// Where each attribute's column begins in the payload.
    columns: Vec<usize>,
    grid: usize,
    vertex: usize,
    face: usize,
    corner: usize,
}

impl MgsReader {
    /// Opens a file and checks its header and footer, so that a truncated file is refused at once.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::Unsupported`] for another version, [`ErrorKind::Corrupt`] with the byte.
    pub fn open(path: &Path) -> Result<Self> {
        let io = |error| Error::io("read", path, error);
        let mut file = File::open(path).map_err(|error| Error::io("open", path, error))?;
        let metadata = file.metadata().map_err(io)?;
        if !metadata.is_file() {
            return Err(Error::invalid("not a regular file").at(path));
        }
        let file_bytes = metadata.len();
        let mut fixed = [0; header::FIXED_BYTES];
        if file_bytes < (header::FIXED_BYTES + 8 + footer::BYTES) as u64 {
            let message = format!("the file ends at byte {file_bytes}, too short for a .mgs file");
            return Err(Error::corrupt(path, file_bytes, message));
        }
        file.read_exact(&mut fixed).map_err(io)?;
        let header_bytes = Header::length(&fixed, file_bytes, path)?;
        let mut bytes = vec![0; header_bytes];
        bytes[..header::FIXED_BYTES].copy_from_slice(&fixed);
        file.read_exact(&mut bytes[header::FIXED_BYTES..]).map_err(io)?;
        let header = Header::decode(&bytes, path)?;
        let value_bytes = ValueBytes::of(&header.schema).map_err(|error| error.at_byte(path, 26))?;
        let seed = read_le!(u64, bytes, header_bytes - 8);

        let footer_offset = file_bytes - footer::BYTES as u64;
        let mut bytes = [0; footer::BYTES];
        file.seek(SeekFrom::Start(footer_offset)).map_err(io)?;
        file.read_exact(&mut bytes).map_err(io)?;
        let footer = Footer::decode(&bytes, footer_offset, seed, path)?;
        let mut reader = Self {
            path: path.to_path_buf(),
            file,
            file_bytes,
            header,
            value_bytes,
            seed,
            blocks_offset: header_bytes as u64,
            footer,
            offset: 0,
            counted: Footer::default(),
            state: State::Reading,
            block: Block::default(),
            stored: Vec::new(),
        };
        reader.rewind()?;
        Ok(reader)
    }

    /// The file's metadata in its own order: keys and values.
    pub fn metadata(&self) -> &[(String, String)] {
        &self.header.metadata
    }

    /// Counts and bounds of the whole file, as its writer noted them.
    ///
    /// # Errors
    /// None today: the footer is read and checked by [`open`](Self::open).
    pub fn footer(&self) -> Result<Footer> {
        Ok(self.footer)
    }

    /// Bytes of the file.
    pub fn file_bytes(&self) -> u64 {
        self.file_bytes
    }

    /// Steps over the next grid and returns what a counting pass needs. A pass that calls only this reads a small part
    /// of the file and decodes less; calls may alternate with [`next`](MicrogridStream::next).
    ///
    /// # Errors
    /// Like [`next`](MicrogridStream::next).
    pub fn next_summary(&mut self) -> Result<Option<GridSummary>> {
        let result = self.advance().and_then(|more| more.then(|| self.step_summary()).transpose());
        self.note_failure(result)
    }

    /// Makes sure that the block has a grid left. False at the end.
    fn advance(&mut self) -> Result<bool> {
        match self.state {
            State::Reading => {}
            State::Ended => return Ok(false),
            State::Broken => {
                return Err(Error::new(ErrorKind::Corrupt, "reading on after an error")
                    .at_byte(&self.path, self.offset));
            }
        }
        if self.block.grid < self.block.grids {
            return Ok(true);
        }
        self.block.check_used_up(&self.path)?;
        if self.offset + footer::BYTES as u64 == self.file_bytes {
            return self.end();
        }
        self.load_block()?;
        Ok(true)
    }

    fn note_failure<T>(&mut self, result: Result<T>) -> Result<T> {
        if result.is_err() {
            self.state = State::Broken;
        }
        result
    }

    /// Compares what was read with what the footer says.
    fn end(&mut self) -> Result<bool> {
        let counts = |footer: &Footer| {
            let StreamCounts { grids, micropolygons, vertices, .. } = footer.counts;
            [grids, micropolygons, vertices, footer.blocks]
        };
        if counts(&self.counted) != counts(&self.footer) {
            return Err(Error::corrupt(
                &self.path,
                self.offset + 8,
                "the footer's counts are not those of the blocks",
            ));
        }
        self.state = State::Ended;
        Ok(false)
    }

    /// Reads the next block's header and summary.
    fn load_block(&mut self) -> Result<()> {
        let offset = self.offset;
        let left = self.file_bytes - footer::BYTES as u64 - offset;
        if left < block::HEADER_BYTES as u64 {
            return Err(Error::corrupt(
                &self.path,
                offset,
                format!("{left} bytes where a block is expected"),
            ));
        }
        let mut bytes = [0; block::HEADER_BYTES];
        self.read_at(offset, &mut bytes)?;
        let frames_offset = offset + block::HEADER_BYTES as u64;
        let left = left - block::HEADER_BYTES as u64;
        let header = BlockHeader::decode(&bytes, offset, self.seed, self.value_bytes, left, &self.path)?;
        let mut summary = std::mem::take(&mut self.block.summary);
        self.read_frame(frames_offset, header.summary_bytes, header.summary_checksum, &mut summary)?;
        self.block.begin(offset, &header, summary);
        self.block.check_summary(&self.path)?;
        self.offset = frames_offset + header.stored_bytes();
        self.counted.blocks += 1;
        self.counted.counts.grids += u64::from(header.grids);
        self.counted.counts.micropolygons += u64::from(header.faces);
        self.counted.counts.vertices += u64::from(header.vertices);
        Ok(())
    }

    /// Reads the payload of the block whose summary is there.
    fn load_payload(&mut self) -> Result<()> {
        let mut payload = std::mem::take(&mut self.block.payload);
        let block = &self.block;
        self.read_frame(block.payload_offset, block.payload_frame, block.payload_checksum, &mut payload)?;
        self.block.payload = payload;
        self.block.open_payload(&self.header.schema, &self.path)
    }

    fn read_at(&mut self, offset: u64, bytes: &mut [u8]) -> Result<()> {
        let read = self.file.seek(SeekFrom::Start(offset)).and_then(|_| self.file.read_exact(bytes));
        read.map_err(|error| Error::io("read", &self.path, error).at_byte(&self.path, offset))
    }

    /// Reads, checks and unpacks a frame. `sizes` are its plain and stored bytes, checked against the maxima.
    fn read_frame(&mut self, offset: u64, sizes: [u32; 2], checksum: u64, plain: &mut Vec<u8>) -> Result<()> {
        let [plain_bytes, stored_bytes] = sizes.map(|bytes| bytes as usize);
        let mut stored = std::mem::take(&mut self.stored);
        stored.resize(stored_bytes, 0);
        self.read_at(offset, &mut stored)?;
        if xxh3_64(&stored) != checksum {
            return Err(Error::corrupt(&self.path, offset, "a block's checksum does not match"));
        }
        if stored_bytes == plain_bytes {
            std::mem::swap(plain, &mut stored);
        } else {
            plain.resize(plain_bytes, 0);
            let unpacked = lz4_flex::block::decompress_into(&stored, plain);
            if unpacked.ok() != Some(plain_bytes) {
                return Err(Error::corrupt(&self.path, offset, "a block does not unpack to its length"));
            }
        }
        self.stored = stored;
        Ok(())
    }

    fn step_summary(&mut self) -> Result<GridSummary> {
        let block = &mut self.block;
        let summary = block.summary_of(block.grid);
        block.grid += 1;
        block.vertex += summary.vertices as usize;
        let faces = block.face..block.face + summary.faces as usize;
        block.face = faces.end;
        if block.has_payload {
            block.corner += corners_of(&block.payload[faces]);
        }
        Ok(summary)
    }

    fn step(&mut self, grid: &mut Microgrid) -> Result<()> {
        if !self.block.has_payload {
            self.load_payload()?;
        }
        self.block.read_grid(&self.header.schema, grid, &self.path)
    }
}

impl MicrogridStream for MgsReader {
    fn schema(&self) -> &Schema {
        &self.header.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.offset = self.blocks_offset;
        self.counted = Footer::default();
        self.state = State::Reading;
        self.block.forget();
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        let result = self.advance().and_then(|more| {
            if more {
                self.step(grid)?;
            }
            Ok(more)
        });
        self.note_failure(result)
    }

    fn progress(&self) -> f64 {
        let block_share = self.block.grid as f64 / self.block.grids.max(1) as f64;
        let read = self.block.offset as f64
            + block_share * (self.offset.max(self.block.offset) - self.block.offset) as f64;
        (read / self.file_bytes as f64).min(1.0)
    }
}

impl Block {
    fn forget(&mut self) {
        (self.grids, self.vertices, self.faces, self.corners) = (0, 0, 0, 0);
        (self.grid, self.vertex, self.face, self.corner) = (0, 0, 0, 0);
        (self.offset, self.has_payload) = (0, false);
    }

    fn begin(&mut self, offset: u64, header: &BlockHeader, summary: Vec<u8>) {
        self.forget();
        self.offset = offset;
        self.grids = header.grids as usize;
        self.vertices = header.vertices as usize;
        self.faces = header.faces as usize;
        self.corners = header.corners as usize;
        self.payload_frame = header.payload_bytes;
        self.payload_checksum = header.payload_checksum;
        self.payload_offset = offset + block::HEADER_BYTES as u64 + u64::from(header.summary_bytes[1]);
        self.summary = summary;
    }

    fn summary_of(&self, grid: usize) -> GridSummary {
        let [middles, vertex_counts, face_counts] = block::summary_columns(self.grids);
        let anchor = std::array::from_fn(|i| read_le!(f64, self.summary, 24 * grid + 8 * i));
        let middle = middles + 12 * grid;
        GridSummary {
            anchor: DVec3::from_array(anchor),
            middle: vec3(self.summary[middle..middle + 12].as_array().expect("12 bytes")),
            vertices: u32::from(self.summary[vertex_counts + grid]) + 1,
            faces: u32::from(read_le!(u16, self.summary, face_counts + 2 * grid)),
        }
    }

    /// Checks what later slicing relies on: the grids' counts add up to the block's.
    fn check_summary(&self, path: &Path) -> Result<()> {
        let (mut vertices, mut faces) = (0, 0);
        for grid in 0..self.grids {
            let summary = self.summary_of(grid);
            vertices += summary.vertices as usize;
            faces += summary.faces as usize;
            if summary.faces as usize > FACES_MAX {
                return Err(self.broken(
                    path,
                    grid,
                    &format!("has {} faces, at most {FACES_MAX} are possible", summary.faces),
                ));
            }
            if !summary.anchor.is_finite() || !summary.middle.is_finite() {
                return Err(self.broken(path, grid, "has a position that is not a finite number"));
            }
        }
        if vertices != self.vertices || faces != self.faces {
            return Err(Error::corrupt(path, self.offset, "the counts of a block's grids do not add up"));
        }
        Ok(())
    }

    /// Finds the columns and checks arities and positions of the whole block at once, which vectorises.
    fn open_payload(&mut self, schema: &Schema, path: &Path) -> Result<()> {
        let arities = &self.payload[..self.faces];
        let legal = arities.iter().fold(true, |legal, arity| legal & (1..=4).contains(arity));
        if !legal || corners_of(arities) != self.corners {
            return Err(Error::corrupt(path, self.payload_offset, "a block's faces do not add up"));
        }
        let positions = &self.payload[self.positions_at(0)..self.positions_at(self.vertices)];
        let exponents = positions.as_chunks::<4>().0.iter().map(|&x| u32::from_le_bytes(x) & EXPONENT);
        if !exponents.fold(true, |finite, exponent| finite & (exponent != EXPONENT)) {
            return Err(Error::corrupt(path, self.payload_offset, "a position is not a finite number"));
        }
        let mut at = self.positions_at(self.vertices);
        self.columns.clear();
        for attribute in &schema.attributes {
            self.columns.push(at);
            at += attribute.value_bytes()
                * if attribute.rate == Rate::Vertex { self.vertices } else { self.grids };
        }
        self.corner = corners_of(&self.payload[..self.face]);
        self.has_payload = true;
        Ok(())
    }

    /// Where the position of a vertex of the block begins in the payload.
    fn positions_at(&self, vertex: usize) -> usize {
        self.faces + self.corners + 12 * vertex
    }

    /// Copies the next grid out of the columns and checks its indices.
    fn read_grid(&mut self, schema: &Schema, grid: &mut Microgrid, path: &Path) -> Result<()> {
        let summary = self.summary_of(self.grid);
        let (vertices, faces) = (summary.vertices as usize, summary.faces as usize);
        let arities = &self.payload[self.face..self.face + faces];
        let corners = corners_of(arities);
        let indices = &self.payload[self.faces + self.corner..][..corners];
        let positions =
            &self.payload[self.positions_at(self.vertex)..self.positions_at(self.vertex + vertices)];
        let highest = indices.iter().fold(0, |highest, &index| index.max(highest));
        if usize::from(highest) >= vertices {
            let what = format!("has {vertices} vertices and a face index {highest}");
            return Err(self.broken(path, self.grid, &what));
        }
        grid.clear(schema.attributes.len());
        grid.anchor = summary.anchor;
        grid.positions.extend(positions.as_chunks::<12>().0.iter().map(vec3));
        if grid.positions[vertices / 2] != summary.middle {
            return Err(self.broken(
                path,
                self.grid,
                "has a middle vertex that is not the one of its summary",
            ));
        }
        grid.arities.extend_from_slice(arities);
        grid.indices.extend_from_slice(indices);
        for ((attribute, &at), column) in schema.attributes.iter().zip(&self.columns).zip(&mut grid.columns) {
            let (first, count) = match attribute.rate {
                Rate::Vertex => (self.vertex, vertices),
                Rate::Grid => (self.grid, 1),
            };
            let bytes = attribute.value_bytes();
            column.extend_from_slice(&self.payload[at + first * bytes..][..count * bytes]);
        }
        self.grid += 1;
        self.vertex += vertices;
        self.face += faces;
        self.corner += corners;
        Ok(())
    }

    /// After its last grid a block must be used up, or its counts lied.
    fn check_used_up(&self, path: &Path) -> Result<()> {
        let used = self.vertex == self.vertices && self.face == self.faces;
        if !used || (self.has_payload && self.corner != self.corners) {
            return Err(Error::corrupt(path, self.offset, "the counts of a block's grids do not add up"));
        }
        Ok(())
    }

    fn broken(&self, path: &Path, grid: usize, what: &str) -> Error {
        Error::corrupt(path, self.payload_offset, format!("grid {grid} of a block {what}"))
    }
}

/// The corners of faces of these arities. At most 4,096 in a grid and 8 Mi in a block.
fn corners_of(arities: &[u8]) -> usize {
    arities.iter().map(|&arity| u32::from(arity)).sum::<u32>() as usize
}

fn vec3(bytes: &[u8; 12]) -> Vec3 {
    Vec3::from_array(std::array::from_fn(|i| read_le!(f32, bytes, 4 * i)))
}
