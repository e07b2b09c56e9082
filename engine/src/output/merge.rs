//! The merge: a bake set's stream cloned in its own order, with the baked attributes appended.
//!
//! Parts come in the order of batches, the stream wants the order of points. Parts are scattered into ranges of points,
//! then the stream passes once while one range after the other is in memory. No pass needs more memory than given.

use std::path::Path;

use super::buckets::{Buckets, Division};
use super::{Part, PartFormat, PartSource};
use crate::batch::{BatchPlan, BitSet, Progress};
use crate::stream::file::MgsWriter;
use crate::stream::schema::names;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Schema, ValueType};
use crate::{Error, ErrorKind, Result};

/// The part of the work that scattering is taken for, in what progress reports.
const SCATTER_SHARE: f64 = 0.4;

/// Less memory than this is refused.
const MEMORY_BYTES_MIN: u64 = 16 << 20;

/// How to merge.
#[derive(Clone, Copy, Debug)]
pub struct MergeOptions<'a> {
    /// An existing folder for a temporary file, at most as large as all rows with 4 bytes more each.
    pub scratch: &'a Path,
    /// Memory for rows, at least 16 MiB. The output is the same for any.
    pub memory_bytes: u64,
    /// Whether points may lack a result: they get zeros, and an attribute `baked` (u8) is 1 where there is one. Where
    /// the plan's filter dropped points, this is so without saying, for the dropped points only.
    pub partial: bool,
    /// What the output says of itself, by key: for spherical harmonics their convention and frame.
    pub metadata: &'a [(String, String)],
}

/// What a merge did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MergeReport {
    /// Grids of the output.
    pub grids: u64,
    /// Points of the output.
    pub points: u64,
    /// Points with a result.
    pub baked: u64,
    /// Parts read.
    pub parts: u64,
    /// Bytes that went through the temporary file.
    pub scratch_bytes: u64,
}

/// Clones `input` to the `.mgs` file `target`, with the attributes that `parts` hold appended to every grid.
///
/// `plan` is the plan of the bake of `input`. The file appears under its name when it is complete, and not at all
/// otherwise.
///
/// # Errors
/// [`ErrorKind::Invalid`] when the input has an attribute of that name, a point that should have a result has none, has
/// two different ones or one that is not finite, or the parts or the input do not belong to the plan; errors name
/// point and batch. [`ErrorKind::Limit`] when the memory is too small. What stream, parts, disk and `progress` report.
pub fn merge(
    input: &mut dyn MicrogridStream,
    plan: &BatchPlan,
    parts: &mut dyn PartSource,
    options: &MergeOptions,
    target: &Path,
    progress: Progress,
) -> Result<MergeReport> {
    if options.memory_bytes < MEMORY_BYTES_MIN {
        let given = options.memory_bytes;
        let message = format!("merging needs {MEMORY_BYTES_MIN} bytes of memory, {given} given");
        return Err(Error::new(ErrorKind::Limit, message));
    }
    let division = Division::new(plan.stream_points(), parts.format().row_bytes(), options.memory_bytes)?;
    merge_with(input, plan, parts, options, division, target, progress)
}

/// [`merge`] with the division of the points given.
fn merge_with(
    input: &mut dyn MicrogridStream,
    plan: &BatchPlan,
    parts: &mut dyn PartSource,
    options: &MergeOptions,
    division: Division,
    target: &Path,
    progress: Progress,
) -> Result<MergeReport> {
    let format = parts.format().clone();
    let marked = options.partial || plan.points() < plan.stream_points();
    let schema = decorated(input.schema(), &format, marked)?;
    let mut buckets = Buckets::new(division, options.scratch)?;
    let mut report = MergeReport::default();
    scatter(plan, parts, options.partial, &mut buckets, &mut report, progress)?;
    buckets.finish()?;
    report.scratch_bytes = buckets.scratch_bytes();
    let mut writer = MgsWriter::create(target, &schema, options.metadata)?;
    let mut decorator = Decorator { format: &format, marked, buckets, next: 0, report };
    decorator.pass(input, plan.stream_points(), &mut writer, progress)?;
    progress(1.0)?;
    writer.finish()?;
    Ok(decorator.report)
}

/// The schema of the output.
fn decorated(input: &Schema, format: &PartFormat, marked: bool) -> Result<Schema> {
    let mut schema = input.clone();
    schema.attributes.extend_from_slice(format.attributes());
    if marked {
        schema.attributes.push(Attribute::vertex(names::BAKED, ValueType::U8, 1));
    }
    for attribute in &schema.attributes[input.attributes.len()..] {
        if input.find(&attribute.name).is_some() {
            let message = format!("the bake set's stream already has an attribute `{}`", attribute.name);
            return Err(Error::invalid(message).hint("give the baked attribute another name"));
        }
    }
    schema.validate()?;
    Ok(schema)
}

/// Reads all parts, checks them against the plan and puts their rows into buckets.
fn scatter(
    plan: &BatchPlan,
    parts: &mut dyn PartSource,
    partial: bool,
    buckets: &mut Buckets,
    report: &mut MergeReport,
    progress: Progress,
) -> Result<()> {
    let format = parts.format().clone();
    let mut part = Part::default();
    let mut seen = BitSet::new(plan.len() as u64);
    parts.rewind()?;
    while parts.next(&mut part)? {
        check_part(plan, &format, &part, partial)?;
        for (row, &index) in part.indices.iter().enumerate() {
            if part.covered.contains(row as u64) {
                let put = buckets.put(index, part.row(&format, row));
                put.map_err(|error| {
                    error.hint(format!("one of the results is that of batch `{}`", part.batch))
                })?;
            }
        }
        seen.insert(u64::from(part.batch));
        report.parts += 1;
        if report.parts.is_multiple_of(64) {
            progress(SCATTER_SHARE * (report.parts as f64 / plan.len() as f64).min(1.0))?;
        }
    }
    match seen.first_missing() {
        Some(batch) if !partial => Err(missing_batch(plan, batch as usize)),
        _ => Ok(()),
    }
}

/// Checks that a part is one of the plan, finite, and complete unless `partial`.
fn check_part(plan: &BatchPlan, format: &PartFormat, part: &Part, partial: bool) -> Result<()> {
    part.check(format)?;
    let batch = part.batch;
    let expected = if (batch as usize) < plan.len() { plan.batch(batch as usize).count } else { 0 };
    let points = part.indices.len();
    if points != expected as usize {
        let message = format!("the part of batch `{batch}` has {points} points, {expected} in the plan");
        return Err(Error::invalid(message));
    }
    if let Some(index) = part.indices.iter().find(|&&index| index >= plan.stream_points()) {
        let message =
            format!("point `{index}` in batch `{batch}`, in a stream of {} points", plan.stream_points());
        return Err(Error::invalid(message));
    }
    match part.covered.first_missing() {
        Some(row) if !partial => Err(missing_point(part.indices[row as usize], batch)),
        _ => Ok(()),
    }
}

fn missing_point(index: u64, batch: u32) -> Error {
    Error::invalid(format!("point `{index}` in batch `{batch}` has no result"))
        .hint("continue the bake in the same folder")
}

/// The error of a batch without part: it names the batch and its first point.
fn missing_batch(plan: &BatchPlan, batch: usize) -> Error {
    let mut points = Vec::new();
    match plan.read(batch, &mut points) {
        Ok(()) => {
            let first = points.iter().map(|point| point.index).min().unwrap_or_default();
            missing_point(first, batch as u32)
        }
        Err(error) => error,
    }
}

/// The pass over the stream.
struct Decorator<'a> {
    format: &'a PartFormat,
    /// Whether the output says which points have a result.
    marked: bool,
    buckets: Buckets,
    /// Index of the next grid's first point.
    next: u64,
    report: MergeReport,
}

impl Decorator<'_> {
    /// Clones every grid, decorates it and writes it.
    fn pass(
        &mut self,
        input: &mut dyn MicrogridStream,
        stream_points: u64,
        writer: &mut MgsWriter,
        progress: Progress,
    ) -> Result<()> {
        let other = |found: &str| {
            let message = format!("the stream has {found} than the {stream_points} points of its plan");
            Error::invalid(message).hint("its source has changed since; begin anew with --restart")
        };
        let mut grid = Microgrid::default();
        // Columns are taken off and put back for each grid, so that their memory stays.
        let mut columns = vec![Vec::new(); self.format.attributes().len() + usize::from(self.marked)];
        input.rewind()?;
        while input.next(&mut grid)? {
            if grid.vertex_count() as u64 > stream_points - self.next {
                return Err(other("more"));
            }
            self.decorate(grid.vertex_count(), &mut columns)?;
            grid.columns.append(&mut columns);
            writer.write(&grid)?;
            columns.extend(grid.columns.drain(input.schema().attributes.len()..));
            self.report.grids += 1;
            if self.report.grids.is_multiple_of(256) {
                progress(SCATTER_SHARE + (1.0 - SCATTER_SHARE) * self.next as f64 / stream_points as f64)?;
            }
        }
        if self.next < stream_points { Err(other("fewer")) } else { Ok(()) }
    }

    /// Fills the new columns of a grid from the rows of its points.
    fn decorate(&mut self, vertices: usize, columns: &mut [Vec<u8>]) -> Result<()> {
        columns.iter_mut().for_each(Vec::clear);
        let (attributes, marks) = columns.split_at_mut(self.format.attributes().len());
        for index in self.next..self.next + vertices as u64 {
            let (baked, row) = self.buckets.range(index)?.row(index);
            if !baked && !self.marked {
                // Complete parts of every batch leave no gap, unless they hold points of another plan.
                let message = format!("point `{index}` is in no part: the parts are not those of the plan");
                return Err(Error::invalid(message));
            }
            let mut rest = row;
            for (column, attribute) in attributes.iter_mut().zip(self.format.attributes()) {
                let (value, later) = rest.split_at(attribute.value_bytes());
                column.extend_from_slice(value);
                rest = later;
            }
            marks.iter_mut().for_each(|column| column.push(u8::from(baked)));
            self.report.baked += u64::from(baked);
        }
        self.next += vertices as u64;
        self.report.points += vertices as u64;
        Ok(())
    }
}

#[cfg(test)]
#[path = "merge_tests.rs"]
mod tests;
