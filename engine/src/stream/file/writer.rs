//! Writes a `.mgs` file, one grid after the other, in constant memory.

use std::io::Write;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use super::block::{self, BlockHeader, ValueBytes};
use super::footer::Footer;
use super::header::Header;
use super::{AtomicFile, StreamCounts};
use crate::stream::{Microgrid, Schema};
use crate::{Error, ErrorKind, Result};

/// Writes a `.mgs` file. The file appears under its name with [`finish`](Self::finish); dropped before, nothing stays.
pub struct MgsWriter {
    file: AtomicFile,
    schema: Schema,
    seed: u64,
    offset: u64,
    columns: BlockColumns,
    scratch: Scratch,
    footer: Footer,
    failed: bool,
}

/// The columns of the block that is being filled.
#[derive(Default)]
struct BlockColumns {
    grids: usize,
    vertices: usize,
    anchors: Vec<u8>,
    middles: Vec<u8>,
    vertex_counts: Vec<u8>,
    face_counts: Vec<u8>,
    arities: Vec<u8>,
    indices: Vec<u8>,
    positions: Vec<u8>,
    attributes: Vec<Vec<u8>>,
}

/// Memory that every block uses again.
#[derive(Default)]
struct Scratch {
    plain: Vec<u8>,
    block: Vec<u8>,
}

impl MgsWriter {
    /// Begins a file for grids of `schema`. `metadata` is free text by key: at most 1,024 entries, keys unique, the
    /// whole header within 1 MiB.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] for a broken schema or metadata, [`ErrorKind::Limit`] for one beyond the format's
    /// maxima, otherwise what the operating system says.
    pub fn create(path: &Path, schema: &Schema, metadata: &[(String, String)]) -> Result<Self> {
        ValueBytes::of(schema)?;
        let header = Header { schema: schema.clone(), metadata: metadata.to_vec() }.encode()?;
        let seed = u64::from_le_bytes(header[header.len() - 8..].try_into().expect("8 bytes"));
        let mut file = AtomicFile::create(path)?;
        file.write_all(&header).map_err(|error| Error::io("write", path, error))?;
        let attributes = vec![Vec::new(); schema.attributes.len()];
        Ok(Self {
            file,
            schema: schema.clone(),
            seed,
            offset: header.len() as u64,
            columns: BlockColumns { attributes, ..BlockColumns::default() },
            scratch: Scratch::default(),
            footer: Footer::default(),
            failed: false,
        })
    }

    /// Appends a grid.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] for a grid that does not fit the schema or is broken; what the operating system says.
    pub fn write(&mut self, grid: &Microgrid) -> Result<()> {
        self.refuse_after_failure()?;
        grid.validate(&self.schema).map_err(|error| error.at(self.file.target()))?;
        self.columns.push(grid);
        self.footer.counts.add(grid);
        for &arity in &grid.arities {
            self.footer.faces_by_arity[usize::from(arity - 1)] += 1;
        }
        if self.columns.payload_bytes() >= block::PAYLOAD_BYTES_TARGET
            || self.columns.grids == block::GRIDS_MAX
        {
            self.flush_block()?;
        }
        Ok(())
    }

    /// Writes what is left and the footer, brings the file to the disk and gives it its name.
    ///
    /// # Errors
    /// What the operating system says; nothing stays behind then.
    pub fn finish(mut self) -> Result<StreamCounts> {
        self.refuse_after_failure()?;
        if self.columns.grids > 0 {
            self.flush_block()?;
        }
        let footer = self.footer.encode(self.offset, self.seed);
        self.file.write_all(&footer).map_err(|error| Error::io("write", self.file.target(), error))?;
        self.file.commit()?;
        Ok(self.footer.counts)
    }

    fn refuse_after_failure(&self) -> Result<()> {
        if self.failed {
            return Err(Error::new(ErrorKind::Io, "an earlier write failed").at(self.file.target()));
        }
        Ok(())
    }

    fn flush_block(&mut self) -> Result<()> {
        let bytes = self.columns.encode(self.offset, self.seed, &mut self.scratch);
        if let Err(error) = self.file.write_all(bytes) {
            self.failed = true;
            return Err(Error::io("write", self.file.target(), error));
        }
        self.offset += bytes.len() as u64;
        self.footer.blocks += 1;
        self.columns.clear();
        Ok(())
    }
}

impl BlockColumns {
    fn push(&mut self, grid: &Microgrid) {
        self.grids += 1;
        self.vertices += grid.vertex_count();
        self.anchors.extend(grid.anchor.to_array().iter().flat_map(|x| x.to_le_bytes()));
        let middle = grid.positions[grid.vertex_count() / 2];
        self.middles.extend(middle.to_array().iter().flat_map(|x| x.to_le_bytes()));
        self.vertex_counts.push((grid.vertex_count() - 1) as u8);
        self.face_counts.extend((grid.face_count() as u16).to_le_bytes());
        self.arities.extend_from_slice(&grid.arities);
        self.indices.extend_from_slice(&grid.indices);
        for position in &grid.positions {
            self.positions.extend(position.to_array().map(f32::to_le_bytes).as_flattened());
        }
        for (column, values) in self.attributes.iter_mut().zip(&grid.columns) {
            column.extend_from_slice(values);
        }
    }

    fn payload_bytes(&self) -> usize {
        let attributes: usize = self.attributes.iter().map(Vec::len).sum();
        self.arities.len() + self.indices.len() + self.positions.len() + attributes
    }

    fn clear(&mut self) {
        let Self { anchors, middles, vertex_counts, face_counts, arities, indices, positions, .. } = self;
        for column in [anchors, middles, vertex_counts, face_counts, arities, indices, positions] {
            column.clear();
        }
        self.attributes.iter_mut().for_each(Vec::clear);
        self.grids = 0;
        self.vertices = 0;
    }

    /// The whole block as it stands in the file at `offset`.
    fn encode<'a>(&self, offset: u64, seed: u64, scratch: &'a mut Scratch) -> &'a [u8] {
        let Scratch { plain, block } = scratch;
        block.clear();
        block.resize(block::HEADER_BYTES, 0);

        plain.clear();
        for column in [&self.anchors, &self.middles, &self.vertex_counts, &self.face_counts] {
            plain.extend_from_slice(column);
        }
        let (summary_bytes, summary_checksum) = append_frame(plain, block);

        plain.clear();
        plain.extend_from_slice(&self.arities);
        plain.extend_from_slice(&self.indices);
        plain.extend_from_slice(&self.positions);
        self.attributes.iter().for_each(|column| plain.extend_from_slice(column));
        let (payload_bytes, payload_checksum) = append_frame(plain, block);

        let header = BlockHeader {
            grids: self.grids as u32,
            vertices: self.vertices as u32,
            faces: self.arities.len() as u32,
            corners: self.indices.len() as u32,
            summary_bytes,
            payload_bytes,
            summary_checksum,
            payload_checksum,
        };
        block[..block::HEADER_BYTES].copy_from_slice(&header.encode(offset, seed));
        block
    }
}

/// Appends a frame, compressed where that makes it smaller. Returns its plain and stored bytes and the checksum.
fn append_frame(plain: &[u8], out: &mut Vec<u8>) -> ([u32; 2], u64) {
    let start = out.len();
    out.resize(start + lz4_flex::block::get_maximum_output_size(plain.len()), 0);
    let compressed =
        lz4_flex::block::compress_into(plain, &mut out[start..]).expect("room for the worst case");
    let stored = compressed.min(plain.len());
    out.truncate(start + stored);
    if compressed >= plain.len() {
        out[start..].copy_from_slice(plain);
    }
    ([plain.len() as u32, stored as u32], xxh3_64(&out[start..]))
}
