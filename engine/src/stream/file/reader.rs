//! Reads a `.mgs` file forward, block by block, and trusts none of it.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::block::{self, BlockHeader, ValueBytes};
use super::footer::{self, Footer};
use super::header::{self, Header};
use super::open_block::{Block, GridSummary};
use super::{StreamCounts, read_le};
use crate::stream::{Microgrid, MicrogridStream, Piece, Schema};
use crate::{Error, ErrorKind, Result};

/// Reads a `.mgs` file. Memory is bounded by the format's maxima whatever the file claims: under 20 MiB at the very
/// worst, 4 MiB for what [`MgsWriter`](super::MgsWriter) writes.
pub struct MgsReader {
    source: Arc<Source>,
    blocks_offset: u64,
    footer: Footer,
    /// Where the next block, or the footer, begins.
    offset: u64,
    counted: Footer,
    state: State,
    block: Block,
    stored: Vec<u8>,
}

/// An open file and what its blocks are read with; shared with the pieces.
struct Source {
    path: PathBuf,
    file: File,
    file_bytes: u64,
    header: Header,
    value_bytes: ValueBytes,
    /// The header's checksum, which block headers and footer build on.
    seed: u64,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    Reading,
    Ended,
    Broken,
}

impl MgsReader {
    /// Opens a file and checks its header and footer, so that a truncated file is refused at once.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::Unsupported`] for another version, [`ErrorKind::Corrupt`] with the byte.
    pub fn open(path: &Path) -> Result<Self> {
        let io = |error| Error::io("read", path, error);
        let file = File::open(path).map_err(|error| Error::io("open", path, error))?;
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
        file.read_exact_at(&mut fixed, 0).map_err(io)?;
        let header_bytes = Header::length(&fixed, file_bytes, path)?;
        let mut bytes = vec![0; header_bytes];
        file.read_exact_at(&mut bytes, 0).map_err(io)?;
        let header = Header::decode(&bytes, path)?;
        let value_bytes = ValueBytes::of(&header.schema).map_err(|error| error.at_byte(path, 26))?;
        let seed = read_le!(u64, bytes, header_bytes - 8);

        let footer_offset = file_bytes - footer::BYTES as u64;
        let mut bytes = [0; footer::BYTES];
        file.read_exact_at(&mut bytes, footer_offset).map_err(io)?;
        let footer = Footer::decode(&bytes, footer_offset, seed, path)?;
        let source = Source { path: path.to_path_buf(), file, file_bytes, header, value_bytes, seed };
        let mut reader = Self {
            source: Arc::new(source),
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
        &self.source.header.metadata
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
        self.source.file_bytes
    }

    /// A hash of the whole content that reads 64 bytes of every block: its header holds the checksums of the rest, which
    /// are compared with the bytes when a block is read. Starts the file again.
    ///
    /// # Errors
    /// Like [`next`](MicrogridStream::next).
    pub fn identity(&mut self) -> Result<u128> {
        let mut hash = Xxh3::new();
        hash.update(&self.source.seed.to_le_bytes());
        self.rewind()?;
        while self.offset + (footer::BYTES as u64) < self.source.file_bytes {
            let (header, bytes) = self.source.block_header(self.offset)?;
            hash.update(&bytes);
            self.pass_block(&header);
        }
        self.end()?;
        self.rewind()?;
        Ok(hash.digest128())
    }

    /// Steps over the next grid and returns what a counting pass needs. A pass that calls only this reads a small part
    /// of the file and decodes less; calls may alternate with [`next`](MicrogridStream::next).
    ///
    /// # Errors
    /// Like [`next`](MicrogridStream::next).
    pub fn next_summary(&mut self) -> Result<Option<GridSummary>> {
        let result = self.advance().map(|more| more.then(|| self.block.step_summary()));
        self.note_failure(result)
    }

    /// Makes sure that the block has a grid left. False at the end.
    fn advance(&mut self) -> Result<bool> {
        match self.state {
            State::Reading => {}
            State::Ended => return Ok(false),
            State::Broken => {
                return Err(Error::new(ErrorKind::Corrupt, "reading on after an error")
                    .at_byte(&self.source.path, self.offset));
            }
        }
        if !self.block.is_used_up() {
            return Ok(true);
        }
        self.block.check_used_up(&self.source.path)?;
        if self.offset + footer::BYTES as u64 == self.source.file_bytes {
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
                &self.source.path,
                self.offset + 8,
                "the footer's counts are not those of the blocks",
            ));
        }
        self.state = State::Ended;
        Ok(false)
    }

    /// Reads the next block's header and summary.
    fn load_block(&mut self) -> Result<()> {
        let (header, _) = self.source.block_header(self.offset)?;
        self.source.open_block(self.offset, &header, &mut self.block, &mut self.stored)?;
        self.pass_block(&header);
        Ok(())
    }

    /// Counts the block that begins at `offset` and goes to the next.
    fn pass_block(&mut self, header: &BlockHeader) {
        self.offset += block::HEADER_BYTES as u64 + header.stored_bytes();
        self.counted.blocks += 1;
        self.counted.counts.grids += u64::from(header.grids);
        self.counted.counts.micropolygons += u64::from(header.faces);
        self.counted.counts.vertices += u64::from(header.vertices);
    }

    fn step(&mut self, grid: &mut Microgrid) -> Result<()> {
        if !self.block.has_payload {
            self.source.load_payload(&mut self.block, &mut self.stored)?;
        }
        self.block.read_grid(&self.source.header.schema, grid, &self.source.path)
    }

    /// The next block as a piece.
    fn next_block(&mut self) -> Result<Option<Box<dyn Piece>>> {
        if self.state == State::Reading && self.offset + footer::BYTES as u64 == self.source.file_bytes {
            self.end()?;
        }
        if self.state == State::Ended {
            return Ok(None);
        }
        let (header, _) = self.source.block_header(self.offset)?;
        let piece = BlockPiece { source: self.source.clone(), offset: self.offset, header };
        self.pass_block(&header);
        Ok(Some(Box::new(piece)))
    }
}

impl Source {
    /// Reads and checks the header of the block at `offset`.
    fn block_header(&self, offset: u64) -> Result<(BlockHeader, [u8; block::HEADER_BYTES])> {
        let left = self.file_bytes - footer::BYTES as u64 - offset;
        if left < block::HEADER_BYTES as u64 {
            let message = format!("{left} bytes where a block is expected");
            return Err(Error::corrupt(&self.path, offset, message));
        }
        let mut bytes = [0; block::HEADER_BYTES];
        self.read_at(offset, &mut bytes)?;
        let left = left - block::HEADER_BYTES as u64;
        let header = BlockHeader::decode(&bytes, offset, self.seed, self.value_bytes, left, &self.path)?;
        Ok((header, bytes))
    }

    /// Reads the summary of the block at `offset` and makes it the current one.
    fn open_block(
        &self,
        offset: u64,
        header: &BlockHeader,
        block: &mut Block,
        stored: &mut Vec<u8>,
    ) -> Result<()> {
        let mut summary = std::mem::take(&mut block.summary);
        let frame = offset + block::HEADER_BYTES as u64;
        self.read_frame(frame, header.summary_bytes, header.summary_checksum, &mut summary, stored)?;
        block.begin(offset, header, summary);
        block.check_summary(&self.path)
    }

    /// Reads the payload of the block whose summary is there.
    fn load_payload(&self, block: &mut Block, stored: &mut Vec<u8>) -> Result<()> {
        let mut payload = std::mem::take(&mut block.payload);
        let (frame, sizes) = (block.payload_offset, block.payload_frame);
        self.read_frame(frame, sizes, block.payload_checksum, &mut payload, stored)?;
        block.payload = payload;
        block.open_payload(&self.header.schema, &self.path)
    }

    fn read_at(&self, offset: u64, bytes: &mut [u8]) -> Result<()> {
        let read = self.file.read_exact_at(bytes, offset);
        read.map_err(|error| Error::io("read", &self.path, error).at_byte(&self.path, offset))
    }

    /// Reads, checks and unpacks a frame. `sizes` are its plain and stored bytes, checked against the maxima.
    fn read_frame(
        &self,
        offset: u64,
        sizes: [u32; 2],
        checksum: u64,
        plain: &mut Vec<u8>,
        stored: &mut Vec<u8>,
    ) -> Result<()> {
        let [plain_bytes, stored_bytes] = sizes.map(|bytes| bytes as usize);
        stored.resize(stored_bytes, 0);
        self.read_at(offset, stored)?;
        if xxh3_64(stored) != checksum {
            return Err(Error::corrupt(&self.path, offset, "a block's checksum does not match"));
        }
        if stored_bytes == plain_bytes {
            std::mem::swap(plain, stored);
        } else {
            plain.resize(plain_bytes, 0);
            let unpacked = lz4_flex::block::decompress_into(stored, plain);
            if unpacked.ok() != Some(plain_bytes) {
                return Err(Error::corrupt(&self.path, offset, "a block does not unpack to its length"));
            }
        }
        Ok(())
    }
}

/// A block that has not been read yet.
struct BlockPiece {
    source: Arc<Source>,
    offset: u64,
    header: BlockHeader,
}

impl Piece for BlockPiece {
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        let Self { source, offset, header } = *self;
        let (mut block, mut stored) = (Block::default(), Vec::new());
        source.open_block(offset, &header, &mut block, &mut stored)?;
        source.load_payload(&mut block, &mut stored)?;
        while !block.is_used_up() {
            block.read_grid(&source.header.schema, grid, &source.path)?;
            each(grid)?;
        }
        block.check_used_up(&source.path)
    }
}

impl MicrogridStream for MgsReader {
    fn schema(&self) -> &Schema {
        &self.source.header.schema
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

    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        let result = self.next_block();
        self.note_failure(result)
    }

    fn progress(&self) -> f64 {
        if self.block.grids == 0 {
            return self.offset as f64 / self.source.file_bytes as f64;
        }
        let block_share = self.block.grid as f64 / self.block.grids as f64;
        let read = self.block.offset as f64
            + block_share * (self.offset.max(self.block.offset) - self.block.offset) as f64;
        (read / self.source.file_bytes as f64).min(1.0)
    }
}
