//! Which grids of a stream a camera sees: a z-buffer of grid numbers.

use super::draw::draw;
use super::raster::Sample;
use super::view::View;
use crate::scene::Camera;
use crate::stream::MicrogridStream;
use crate::{Error, ErrorKind, Result};

/// The grids that a camera sees, a bit for each grid of the stream.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VisibleGrids {
    bits: Vec<u64>,
    grids: u64,
}

impl VisibleGrids {
    /// Whether the grid of this number, counted from 0 in the stream's order, is seen. False past the end.
    pub fn contains(&self, grid: u64) -> bool {
        self.bits.get((grid / 64) as usize).is_some_and(|word| word >> (grid % 64) & 1 == 1)
    }

    /// Grids of the stream.
    pub fn grid_count(&self) -> u64 {
        self.grids
    }

    /// Grids that are seen.
    pub fn visible_count(&self) -> u64 {
        self.bits.iter().map(|word| u64::from(word.count_ones())).sum()
    }
}

/// Finds the grids of which at least one sample of `camera`'s picture shows a face: in view, and not hidden.
///
/// One pass over the stream, which is rewound before and after; memory is 8 bytes per sample
/// (pixels × `supersampling`²) and a bit per grid. Faces cover a share of the samples equal to their opacity, so what
/// stands behind a sparse leaf is seen too. The same grids are found by any number of threads.
///
/// # Errors
/// When the camera is impossible, the stream unreadable, or has 2^32 - 1 grids and more.
pub fn visible_grids(
    stream: &mut dyn MicrogridStream,
    camera: &Camera,
    supersampling: u32,
    progress: &mut dyn FnMut(f64),
) -> Result<VisibleGrids> {
    let view = View::new(camera, supersampling, stream.schema().meters_per_unit)?;
    let mut samples = vec![Sample::<u32>::EMPTY; view.width * view.height];
    stream.rewind()?;
    let drawn = draw(stream, &view, None, &mut samples, progress)?;
    stream.rewind()?;
    if drawn.grids >= u64::from(u32::MAX) {
        return Err(Error::new(
            ErrorKind::Limit,
            format!("{} grids, at most 2^32 - 2 are possible", drawn.grids),
        ));
    }
    let mut bits = vec![0_u64; drawn.grids.div_ceil(64) as usize];
    for sample in samples.iter().filter(|sample| sample.inverse_depth > 0.0) {
        bits[(sample.paint / 64) as usize] |= 1 << (sample.paint % 64);
    }
    Ok(VisibleGrids { bits, grids: drawn.grids })
}
