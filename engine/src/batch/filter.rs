//! Which points of a bake set are baked: filters on a microgrid stream (paper, section 4.2).

use super::BitSet;
use crate::stream::Microgrid;

/// Decides which vertices become points of the bake. It sees the grids in stream order, each vertex once.
pub trait PointFilter {
    /// Whether `vertex` of `grid`, the `grid_number`-th grid of the stream from 0, is baked.
    fn keep(&mut self, grid_number: u64, grid: &Microgrid, vertex: usize) -> bool;
}

/// Bakes every vertex.
#[derive(Clone, Copy, Debug, Default)]
pub struct KeepAll;

impl PointFilter for KeepAll {
    fn keep(&mut self, _: u64, _: &Microgrid, _: usize) -> bool {
        true
    }
}

/// Bakes all vertices of chosen grids, those that a camera sees for instance. One bit per grid of the stream.
#[derive(Clone, Debug, Default)]
pub struct GridMask(BitSet);

impl GridMask {
    /// A mask that keeps nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Keeps the `grid_number`-th grid of the stream, from 0.
    pub fn insert(&mut self, grid_number: u64) {
        // Doubling keeps insertion in stream order linear.
        if grid_number >= self.0.len() {
            self.0.grow((grid_number + 1).max(2 * self.0.len()));
        }
        self.0.insert(grid_number);
    }

    /// Whether the `grid_number`-th grid is kept.
    pub fn contains(&self, grid_number: u64) -> bool {
        self.0.contains(grid_number)
    }

    /// Grids kept.
    pub fn count(&self) -> u64 {
        self.0.count()
    }
}

impl PointFilter for GridMask {
    fn keep(&mut self, grid_number: u64, _: &Microgrid, _: usize) -> bool {
        self.contains(grid_number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a mask that keeps a neighbour, or that stops keeping what it kept when it grows.
    #[test]
    fn a_mask_keeps_what_was_put_in() {
        let mut mask = GridMask::new();
        let chosen = [0, 5, 63, 64, 65, 4096, 100_000];
        chosen.iter().for_each(|&grid| mask.insert(grid));
        assert_eq!(mask.count(), chosen.len() as u64);
        for grid in 0..100_100 {
            assert_eq!(mask.keep(grid, &Microgrid::default(), 0), chosen.contains(&grid), "grid {grid}");
        }
    }
}
