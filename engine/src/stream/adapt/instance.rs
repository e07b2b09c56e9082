//! Many copies of a stream, one after the other, in world space.

use std::mem::size_of;
use std::ops::Range;
use std::sync::Arc;

use glam::DMat4;

use super::place::{InstanceNumber, PlacedColumns, PlacedPiece, Placement};
use crate::stream::piece::PIECE_VERTICES;
use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Piece, Schema, ValueType};
use crate::{Error, ErrorKind, Result};

/// A prototype that needs at most this much memory is decoded once; a larger one is read again for every copy.
pub const PROTOTYPE_BYTES_MAX: usize = 32 << 20;

/// A rewindable source of matrices, world from object: a list in memory, or a file of millions read as it goes.
pub trait MatrixSource: Send {
    /// Starts again from the first matrix.
    ///
    /// # Errors
    /// When the source cannot be opened again.
    fn rewind(&mut self) -> Result<()>;

    /// The next matrix; none at the end.
    ///
    /// # Errors
    /// When the source is unreadable or broken; the error names file and place.
    fn next(&mut self) -> Result<Option<DMat4>>;

    /// About how much lies behind, from 0 to 1, for progress bars.
    fn progress(&self) -> f64 {
        0.0
    }
}

impl<M: MatrixSource + ?Sized> MatrixSource for &mut M {
    fn rewind(&mut self) -> Result<()> {
        (**self).rewind()
    }

    fn next(&mut self) -> Result<Option<DMat4>> {
        (**self).next()
    }

    fn progress(&self) -> f64 {
        (**self).progress()
    }
}

/// Matrices in memory.
#[derive(Clone, Debug)]
pub struct MatrixList {
    matrices: Vec<DMat4>,
    next: usize,
}

impl MatrixList {
    /// A source of these matrices.
    pub fn new(matrices: Vec<DMat4>) -> Self {
        Self { matrices, next: 0 }
    }
}

impl MatrixSource for MatrixList {
    fn rewind(&mut self) -> Result<()> {
        self.next = 0;
        Ok(())
    }

    fn next(&mut self) -> Result<Option<DMat4>> {
        let matrix = self.matrices.get(self.next).copied();
        self.next += usize::from(matrix.is_some());
        Ok(matrix)
    }

    fn progress(&self) -> f64 {
        self.next as f64 / self.matrices.len().max(1) as f64
    }
}

/// A stream times many matrices: all grids of the first copy, then all of the second.
///
/// Every grid gets the attribute `instance`, u32, the copy's number from 0; one that the stream had is replaced.
/// Normals turn by the inverse transpose and stay unit vectors, radii grow with the cube root of the determinant,
/// mirrored copies have their faces' winding flipped.
pub struct Instance<S, M> {
    inner: S,
    matrices: M,
    schema: Schema,
    columns: PlacedColumns,
    instance_column: usize,
    prototype: Prototype,
    /// The copy that is being made.
    placement: Option<Placement>,
    /// Its number plus one; 0 before the first.
    copies: u64,
    scratch: Microgrid,
}

/// What is known of the prototype's grids.
struct Prototype {
    grids: Arc<Vec<Microgrid>>,
    bytes: usize,
    state: PrototypeState,
    next: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum PrototypeState {
    /// The first copy is under way and its grids are kept.
    Filling,
    /// All grids are in memory.
    Kept,
    /// There are too many; every copy reads the stream again.
    TooLarge,
}

impl<S: MicrogridStream, M: MatrixSource> Instance<S, M> {
    /// Copies of `inner`, one for every matrix. Both are rewound first.
    ///
    /// # Errors
    /// When a source cannot be rewound, or normals or radii are stored in integers.
    pub fn new(inner: S, matrices: M) -> Result<Self> {
        let mut schema = inner.schema().clone();
        let attribute = Attribute::grid(names::INSTANCE, ValueType::U32, 1);
        let instance_column = match schema.find(names::INSTANCE) {
            Some(column) => {
                schema.attributes[column] = attribute;
                column
            }
            None => {
                schema.attributes.push(attribute);
                schema.attributes.len() - 1
            }
        };
        schema.validate()?;
        let columns = PlacedColumns::of(&schema)?;
        let mut instance = Self {
            inner,
            matrices,
            schema,
            columns,
            instance_column,
            prototype: Prototype::new(),
            placement: None,
            copies: 0,
            scratch: Microgrid::default(),
        };
        instance.rewind()?;
        Ok(instance)
    }

    /// Goes to the next copy. False when there is none.
    fn begin_copy(&mut self) -> Result<bool> {
        let Some(matrix) = self.matrices.next()? else { return Ok(false) };
        if self.copies > u64::from(u32::MAX) {
            return Err(Error::new(ErrorKind::Limit, "more than 2^32 instances"));
        }
        let number = self.copies;
        let placement = Placement::new(matrix);
        self.placement = Some(
            placement.map_err(|error| Error::invalid(format!("instance {number}: {}", error.message())))?,
        );
        self.copies += 1;
        self.prototype.next = 0;
        if number > 0 && self.prototype.state == PrototypeState::TooLarge {
            self.inner.rewind()?;
        }
        Ok(true)
    }
}

impl<S: MicrogridStream, M: MatrixSource> MicrogridStream for Instance<S, M> {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.matrices.rewind()?;
        self.inner.rewind()?;
        self.prototype.rewind();
        self.placement = None;
        self.copies = 0;
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        // Ends with the matrices: every turn either returns a grid or uses one up.
        loop {
            if self.placement.is_none() && !self.begin_copy()? {
                return Ok(false);
            }
            let Some(placement) = &self.placement else { unreachable!("a copy has begun") };
            if let Some(source) = self.prototype.next(&mut self.inner, &mut self.scratch)? {
                placement.apply(source, &self.columns, grid)?;
                self.number().write(grid);
                return Ok(true);
            }
            self.placement = None;
        }
    }

    fn next_piece(&mut self) -> Result<Option<Box<dyn Piece>>> {
        if self.prototype.state == PrototypeState::Filling {
            while self.prototype.next(&mut self.inner, &mut self.scratch)?.is_some()
                && self.prototype.state == PrototypeState::Filling
            {}
            self.inner.rewind()?;
        }
        match self.prototype.state {
            PrototypeState::TooLarge => self.next_piece_of_inner(),
            _ => self.next_copies(),
        }
    }

    fn progress(&self) -> f64 {
        self.matrices.progress()
    }
}

impl<S: MicrogridStream, M: MatrixSource> Instance<S, M> {
    /// The next piece of a prototype that is read again for every copy.
    fn next_piece_of_inner(&mut self) -> Result<Option<Box<dyn Piece>>> {
        // Ends with the matrices, as `next` does
        loop {
            if self.placement.is_none() && !self.begin_copy()? {
                return Ok(None);
            }
            if let (Some(placement), Some(inner)) = (self.placement, self.inner.next_piece()?) {
                let instance = Some(self.number());
                return Ok(Some(Box::new(PlacedPiece { inner, placement, columns: self.columns, instance })));
            }
            self.placement = None;
        }
    }

    /// The next piece of a prototype in memory: several copies, or a part of one.
    fn next_copies(&mut self) -> Result<Option<Box<dyn Piece>>> {
        let count = self.prototype.grids.len();
        let mut copies =
            Copies { grids: self.prototype.grids.clone(), columns: self.columns, copies: Vec::new() };
        let mut vertices = 0;
        while vertices < PIECE_VERTICES {
            if self.placement.is_none() && (count == 0 || !self.begin_copy()?) {
                break;
            }
            let Some(placement) = self.placement else { unreachable!("a copy has begun") };
            // The rest of the copy, or what fills the piece
            let from = self.prototype.next;
            while self.prototype.next < count && vertices < PIECE_VERTICES {
                vertices += self.prototype.grids[self.prototype.next].vertex_count();
                self.prototype.next += 1;
            }
            copies.copies.push((placement, self.number(), from..self.prototype.next));
            if self.prototype.next == count {
                self.placement = None;
            }
        }
        Ok((!copies.copies.is_empty()).then(|| Box::new(copies) as Box<dyn Piece>))
    }

    /// The number of the copy that is being made.
    fn number(&self) -> InstanceNumber {
        InstanceNumber { column: self.instance_column, number: (self.copies - 1) as u32 }
    }
}

/// Copies of a prototype in memory, or parts of copies.
struct Copies {
    grids: Arc<Vec<Microgrid>>,
    columns: PlacedColumns,
    copies: Vec<(Placement, InstanceNumber, Range<usize>)>,
}

impl Piece for Copies {
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        for (placement, number, range) in &self.copies {
            for source in &self.grids[range.clone()] {
                placement.apply(source, &self.columns, grid)?;
                number.write(grid);
                each(grid)?;
            }
        }
        Ok(())
    }
}

impl Prototype {
    fn new() -> Self {
        Self { grids: Arc::default(), bytes: 0, state: PrototypeState::Filling, next: 0 }
    }

    /// Forgets a prototype that is not complete; the first copy will fill it again.
    fn rewind(&mut self) {
        self.next = 0;
        if self.state == PrototypeState::Filling {
            self.grids = Arc::default();
            self.bytes = 0;
        }
    }

    /// The next grid of the copy; none at its end.
    fn next<'a, S: MicrogridStream>(
        &'a mut self,
        inner: &mut S,
        scratch: &'a mut Microgrid,
    ) -> Result<Option<&'a Microgrid>> {
        if self.state == PrototypeState::Kept {
            self.next += 1;
            return Ok(self.grids.get(self.next - 1));
        }
        if !inner.next(scratch)? {
            if self.state == PrototypeState::Filling {
                self.state = PrototypeState::Kept;
            }
            return Ok(None);
        }
        if self.state == PrototypeState::Filling {
            self.keep(scratch);
        }
        Ok(Some(scratch))
    }

    fn keep(&mut self, grid: &Microgrid) {
        self.bytes += memory_bytes(grid);
        if self.bytes > PROTOTYPE_BYTES_MAX {
            self.grids = Arc::default();
            self.state = PrototypeState::TooLarge;
        } else {
            Arc::make_mut(&mut self.grids).push(grid.clone());
        }
    }
}

/// What a clone of a grid takes in memory: its values, its vectors and about 16 bytes of the allocator's for each.
fn memory_bytes(grid: &Microgrid) -> usize {
    let columns: usize = grid.columns.iter().map(|column| column.len() + size_of::<Vec<u8>>() + 16).sum();
    // The list of grids grows by doubling: count its slot twice.
    2 * size_of::<Microgrid>()
        + 4 * 16
        + 12 * grid.positions.len()
        + grid.arities.len()
        + grid.indices.len()
        + columns
}
