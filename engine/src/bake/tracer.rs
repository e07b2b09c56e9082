//! The batches of one plan, traced one after the other by all shaders of their bake set.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use super::run::{Program, Runs};
use super::work::BakeWork;
use crate::Result;
use crate::batch::{BatchPlan, Point};
use crate::cut::arena::ArenaCounts;
use crate::output::{Part, PartFormat};
use crate::trace::{Backend, Shading};

/// Traces batches of one plan, one after the other; keeps what it has loaded.
pub struct BatchTracer {
    plan: Arc<BatchPlan>,
    runs: Runs,
    format: PartFormat,
    backend: Backend,
    points: Vec<Point>,
    /// The batch whose points are the next ones.
    next: Option<u32>,
    next_points: Vec<Point>,
    /// What each run computed at the batch's points.
    values: Vec<Vec<f32>>,
    row: Vec<f32>,
}

impl BatchTracer {
    /// A tracer of `plan`, whose parts are of `format`.
    pub(super) fn new(format: PartFormat, plan: Arc<BatchPlan>, runs: Runs, backend: Backend) -> Self {
        let values = vec![Vec::new(); runs.runs.len()];
        let (points, next_points, row) = Default::default();
        Self { plan, runs, format, backend, points, next: None, next_points, values, row }
    }

    /// What the parts have in common.
    pub fn format(&self) -> &PartFormat {
        &self.format
    }

    /// Says which batch is traced after the coming one, so that its bricks can be loaded meanwhile.
    ///
    /// # Errors
    /// When the plan is damaged.
    pub fn expect(&mut self, next: Option<u32>) -> Result<()> {
        self.next = next;
        match next {
            Some(batch) => self.plan.read(batch as usize, &mut self.next_points),
            None => Ok(()),
        }
    }

    /// Traces `batch`, becomes its part, and adds to `work`. The part depends on the batch alone.
    ///
    /// # Errors
    /// When the plan or the brick map is damaged, or `cancel` is set.
    pub fn trace(
        &mut self,
        batch: u32,
        part: &mut Part,
        work: &mut BakeWork,
        cancel: &AtomicBool,
    ) -> Result<()> {
        let start = Instant::now();
        self.plan.read(batch as usize, &mut self.points)?;
        let Self { runs, values, backend, points, next, next_points, .. } = self;
        let spherical: Vec<&Shading> = runs
            .runs
            .iter()
            .map(|run| match &run.program {
                Program::Spherical(shading) => shading,
            })
            .collect();
        for (number, (shading, values)) in spherical.iter().zip(values).enumerate() {
            values.resize(points.len() * shading.values(), 0.0);
            let next = match spherical.get(number + 1) {
                Some(shading) => Some((&points[..], *shading)),
                None => next.map(|_| (&next_points[..], spherical[0])),
            };
            work.add(&backend.trace(points, shading, next, cancel, values)?);
        }
        self.write(batch, part);
        work.batches += 1;
        work.seconds += start.elapsed().as_secs_f64();
        Ok(())
    }

    /// Writes what was computed as the part of `batch`.
    fn write(&mut self, batch: u32, part: &mut Part) {
        part.start(batch, self.points.iter().map(|point| point.index), &self.format);
        for (number, point) in self.points.iter().enumerate() {
            self.row.clear();
            for column in &self.runs.columns {
                let program = &self.runs.runs[column.run].program;
                let count = program.values();
                let values = &self.values[column.run][number * count..][..count];
                program.push_output(&column.output, point, values, &mut self.row);
            }
            part.set_row(&self.format, number, &self.row);
        }
    }

    /// What the arena has done since the tracer was made.
    pub fn arena_counts(&self) -> ArenaCounts {
        self.backend.arena_counts()
    }

    /// The name of what traces: `cpu`, or those of adapters.
    pub fn device(&self) -> &str {
        &self.backend.name
    }

    /// Adds to `work` what the arena has done since the tracer was made.
    pub fn finish(&self, work: &mut BakeWork) {
        work.add_backend(&self.backend);
    }
}
