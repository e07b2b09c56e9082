//! Many copies of a stream, one after the other, in world space.

use std::mem::size_of;

use glam::DMat4;

use super::place::{PlacedColumns, Placement};
use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Schema, ValueType};
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
    grids: Vec<Microgrid>,
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
                grid.columns.resize_with(self.schema.attributes.len(), Vec::new);
                let column = &mut grid.columns[self.instance_column];
                column.clear();
                column.extend_from_slice(&((self.copies - 1) as u32).to_le_bytes());
                return Ok(true);
            }
            self.placement = None;
        }
    }

    fn progress(&self) -> f64 {
        self.matrices.progress()
    }
}

impl Prototype {
    fn new() -> Self {
        Self { grids: Vec::new(), bytes: 0, state: PrototypeState::Filling, next: 0 }
    }

    /// Forgets a prototype that is not complete; the first copy will fill it again.
    fn rewind(&mut self) {
        self.next = 0;
        if self.state == PrototypeState::Filling {
            self.grids.clear();
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
            self.grids = Vec::new();
            self.state = PrototypeState::TooLarge;
        } else {
            self.grids.push(grid.clone());
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
