//! Where partitions go as they are done: into the map in order, and into the journal, from which a build that was
//! interrupted continues.

use serde::{Deserialize, Serialize};

use super::bvh;
use super::chunk::Skipped;
use super::farfield;
use super::leaves::Leaves;
use super::pack::{self, ByteSplit, Far, Packed, Primitive, Top};
use super::shared::Placed;
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
    /// Whether it is the tree over a prototype's partitions, not a partition.
    ends_prototype: bool,
}

/// The tree of a prototype.
#[derive(Clone, Copy, Debug)]
pub struct PrototypeRoot {
    /// Its root brick; none if everything in it was left out.
    pub root: Option<Primitive>,
    /// What a directional far field needs of it.
    far: Option<farfield::Root>,
}

/// The map so far.
#[derive(Debug)]
pub struct Output {
    /// The files.
    pub writer: MapWriter,
    /// The prototypes that are done.
    pub prototypes: Vec<PrototypeRoot>,
    /// Root bricks of the partitions, of the tree that is being written.
    pub roots: Vec<Primitive>,
    /// What a directional far field needs of them.
    far_roots: Vec<farfield::Root>,
    /// Where the bytes go.
    pub split: ByteSplit,
    /// What was left out.
    pub skipped: Skipped,
    /// Leaves.
    pub leaves: u64,
    /// Partitions that are written, those of prototypes and one more for the tree over each included.
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
            prototypes: Vec::new(),
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
            ends_prototype: false,
        };
        self.note(note, &built.packed)
    }

    fn note(&mut self, note: Note, packed: &Packed) -> Result<()> {
        let json = serde_json::to_vec(&note).map_err(|e| Error::invalid(e.to_string()))?;
        self.writer.write(&packed.bytes, &packed.lengths, Some(&json))?;
        self.count(note);
        Ok(())
    }

    /// Writes the tree over the partitions of a prototype, as if it were partition `partition`.
    ///
    /// # Errors
    /// When the disk is full or fails.
    pub fn write_prototype(&mut self, partition: usize) -> Result<()> {
        let mut packed = Packed::default();
        let root = self.pack_top(&[], &[], &mut packed);
        let far_root = (!self.far_roots.is_empty()).then(|| farfield::Root::of(&self.far_roots));
        let note = Note {
            partition,
            is_last: true,
            root,
            far_root,
            split: packed.split,
            skipped: Skipped::default(),
            leaves: 0,
            ends_prototype: true,
        };
        self.note(note, &packed)
    }

    /// Packs the tree over the partitions and copies of prototypes; none if there is nothing.
    fn pack_top(&self, copies: &[Primitive], placed: &[Placed], packed: &mut Packed) -> Option<Primitive> {
        if copies.is_empty() && self.roots.len() < 2 {
            return self.roots.first().copied();
        }
        let primitives: Vec<Primitive> = self.roots.iter().chain(copies).copied().collect();
        let boxes: Vec<LatticeBox> = primitives.iter().map(|primitive| primitive.bounds).collect();
        let tree = bvh::build(&boxes);
        drop(boxes);
        let prototypes: Vec<farfield::Root> =
            self.prototypes.iter().map(|p| p.far).collect::<Option<_>>().unwrap_or_default();
        // A directional far field says something of every root, the paper's of none
        let is_paper = self.far_roots.is_empty() && prototypes.is_empty();
        let top = Top { is_paper, roots: &self.far_roots, prototypes: &prototypes, placed };
        Some(pack::pack(
            &tree,
            &primitives,
            &Leaves::default(),
            self.writer.bricks(),
            Far::Over(&top),
            packed,
        ))
    }

    fn count(&mut self, note: Note) {
        self.split += note.split;
        self.leaves += note.leaves;
        self.skipped.degenerate += note.skipped.degenerate;
        self.skipped.no_radius += note.skipped.no_radius;
        self.skipped.transparent += note.skipped.transparent;
        if note.ends_prototype {
            self.roots.clear();
            self.far_roots.clear();
            self.prototypes.push(PrototypeRoot { root: note.root, far: note.far_root });
        } else {
            self.roots.extend(note.root);
            self.far_roots.extend(note.far_root);
        }
        if note.is_last {
            self.partitions = note.partition + 1;
        }
    }

    /// Writes the tree over the partitions and copies of prototypes; its root brick is the map's last.
    ///
    /// # Errors
    /// When the disk is full or fails, or nothing was left to build.
    pub fn write_top(&mut self, copies: &[Primitive], placed: &[Placed]) -> Result<Primitive> {
        let mut packed = Packed::default();
        let root = self.pack_top(copies, placed, &mut packed).ok_or_else(|| {
            Error::invalid("the occluders hold no face with an area, no point or line with a radius")
        })?;
        if !packed.lengths.is_empty() {
            self.writer.write(&packed.bytes, &packed.lengths, None)?;
            self.split += packed.split;
        }
        Ok(root)
    }
}
