//! Where partitions go as they are done: into the map in order, and into the journal, from which a build that was
//! interrupted continues.

use serde::{Deserialize, Serialize};

use super::bvh;
use super::chunk::Skipped;
use super::farfield;
use super::pack::{self, ByteSplit, Far, Packed, Primitive};
use super::writer::MapWriter;
use crate::brick::{LatticeBox, renumber};
use crate::{Error, Result};

/// A partition that is done, or a part of a large one; its bricks are numbered from 0.
#[derive(Debug)]
pub struct Built {
    /// Which partition.
    pub partition: usize,
    /// Whether the partition ends with this part.
    pub is_last: bool,
    /// Its bricks.
    pub packed: Packed,
    /// Its root brick; none if everything in it was left out.
    pub root: Option<Primitive>,
    /// What was left out.
    pub skipped: Skipped,
    /// Leaves.
    pub leaves: u64,
}

/// What the journal says of a [`Built`] besides its bricks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Note {
    partition: usize,
    is_last: bool,
    /// With its number in the map.
    root: Option<Primitive>,
    far_root: Option<farfield::Root>,
    split: ByteSplit,
    skipped: Skipped,
    leaves: u64,
}

/// The map so far.
#[derive(Debug)]
pub struct Output {
    /// The files.
    pub writer: MapWriter,
    /// Root bricks of the partitions.
    pub roots: Vec<Primitive>,
    /// What a directional far field needs of them.
    far_roots: Vec<farfield::Root>,
    /// Where the bytes go.
    pub split: ByteSplit,
    /// What was left out.
    pub skipped: Skipped,
    /// Leaves.
    pub leaves: u64,
    /// Partitions that are written.
    pub partitions: usize,
}

impl Output {
    /// Opens the map that will be `target`; what an interrupted build of the same content has left is kept.
    ///
    /// # Errors
    /// When the disk fails, or another build is writing it.
    pub fn open(target: &std::path::Path, content: u128) -> Result<Self> {
        let (writer, notes) = MapWriter::open(target, content, |note| {
            serde_json::from_slice::<Note>(note).ok().map(|note| (note.is_last, note))
        })?;
        let mut output = Self {
            writer,
            roots: Vec::new(),
            far_roots: Vec::new(),
            split: ByteSplit::default(),
            skipped: Skipped::default(),
            leaves: 0,
            partitions: 0,
        };
        notes.into_iter().for_each(|note| output.count(note));
        Ok(output)
    }

    /// Writes a partition after those before it.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn write(&mut self, mut built: Built) -> Result<()> {
        let base = self.writer.bricks();
        let mut at = 0;
        for &length in &built.packed.lengths {
            renumber(&mut built.packed.bytes[at..at + length as usize], base);
            at += length as usize;
        }
        if let Some(Primitive { content: pack::Content::Brick(number), .. }) = &mut built.root {
            *number += base;
        }
        let note = Note {
            partition: built.partition,
            is_last: built.is_last,
            root: built.root,
            far_root: built.packed.root,
            split: built.packed.split,
            skipped: built.skipped,
            leaves: built.leaves,
        };
        let json = serde_json::to_vec(&note).map_err(|e| Error::invalid(e.to_string()))?;
        self.writer.write(&built.packed.bytes, &built.packed.lengths, Some(&json))?;
        self.count(note);
        Ok(())
    }

    fn count(&mut self, note: Note) {
        self.split += note.split;
        self.leaves += note.leaves;
        self.skipped.degenerate += note.skipped.degenerate;
        self.skipped.no_radius += note.skipped.no_radius;
        self.skipped.transparent += note.skipped.transparent;
        self.roots.extend(note.root);
        self.far_roots.extend(note.far_root);
        if note.is_last {
            self.partitions = note.partition + 1;
        }
    }

    /// Writes the tree over the partitions; its root brick is the map's last.
    ///
    /// # Errors
    /// When the disk is full or fails, or nothing was left to build.
    pub fn write_top(&mut self) -> Result<Primitive> {
        match self.roots.as_slice() {
            [] => {
                Err(Error::invalid("the occluders hold no face with an area, no point or line with a radius"))
            }
            [root] => Ok(*root),
            roots => {
                let boxes: Vec<LatticeBox> = roots.iter().map(|root| root.bounds).collect();
                let mut packed = Packed::default();
                // A directional far field says something of every root, the paper's of none
                let far = if self.far_roots.is_empty() { Far::Paper } else { Far::Over(&self.far_roots) };
                let root =
                    pack::pack(&bvh::build(&boxes), roots, &[], self.writer.bricks(), far, &mut packed);
                self.writer.write(&packed.bytes, &packed.lengths, None)?;
                self.split += packed.split;
                Ok(root)
            }
        }
    }
}
