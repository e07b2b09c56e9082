//! Splits by the surface area heuristic, in bins, over boxes with weights.
//!
//! Binned SAH (Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies", 2007). A side costs its area times the
//! containers of a given capacity that its weight fills, so that splits leave containers full.

use glam::{IVec3, Vec4};

use crate::brick::LatticeBox;

const BINS: usize = 16;

/// References that are looked at to find where to split a part.
const SAMPLES: usize = 1024;

/// A box on its way into a tree: 32 bytes, two vectors.
#[derive(Clone, Copy, Debug)]
pub struct Reference {
    /// Lower corner, and the weight.
    low: Vec4,
    /// Upper corner, and the bits of the index.
    high: Vec4,
}

impl Reference {
    /// A box that weighs `weight`, relative to `base` for the sake of precision.
    pub fn new(bounds: &LatticeBox, base: IVec3, weight: u32, index: u32) -> Self {
        let corner = |corner: IVec3| (corner.wrapping_sub(base)).as_vec3();
        Self {
            low: corner(bounds.min).extend(weight as f32),
            high: corner(bounds.max).extend(f32::from_bits(index)),
        }
    }

    /// What it stands for.
    pub fn index(&self) -> u32 {
        self.high.w.to_bits()
    }

    /// Half the area of its box.
    pub fn half_area(&self) -> f32 {
        half_area(self.low, self.high)
    }

    /// Twice its center.
    fn center(&self) -> Vec4 {
        self.low + self.high
    }
}

/// Half the area of the box around `part`.
pub fn extent_half_area(part: &[Reference]) -> f32 {
    let (low, high) = part
        .iter()
        .fold((Vec4::INFINITY, Vec4::NEG_INFINITY), |(low, high), r| (low.min(r.low), high.max(r.high)));
    half_area(low, high)
}

fn half_area(low: Vec4, high: Vec4) -> f32 {
    let size = high - low;
    size.x * size.y + size.y * size.z + size.z * size.x
}

#[derive(Clone, Copy)]
struct Bin {
    low: Vec4,
    high: Vec4,
    weight: f32,
}

impl Bin {
    const EMPTY: Self = Self { low: Vec4::INFINITY, high: Vec4::NEG_INFINITY, weight: 0.0 };

    #[inline(always)]
    fn add(&mut self, low: Vec4, high: Vec4, weight: f32) {
        self.low = self.low.min(low);
        self.high = self.high.max(high);
        self.weight += weight;
    }

    /// What it costs in containers of `capacity`.
    #[inline(always)]
    fn cost(&self, capacity: u32) -> f32 {
        half_area(self.low, self.high) * (self.weight as u32).div_ceil(capacity) as f32
    }
}

/// Where references fall along the axes: bin `round((center - low) * scale)`, the outermost ones half as wide.
#[derive(Clone, Copy)]
struct Grid {
    low: Vec4,
    size: Vec4,
    scale: Vec4,
    last: Vec4,
}

impl Grid {
    fn over(part: &[Reference], stride: usize, bins: usize) -> Self {
        let (low, high) =
            part.iter().step_by(stride).fold((Vec4::INFINITY, Vec4::NEG_INFINITY), |(low, high), r| {
                let center = r.center();
                (low.min(center), high.max(center))
            });
        let (size, last) = (high - low, Vec4::splat((bins - 1) as f32));
        Self { low, size, scale: last / size.max(Vec4::splat(f32::MIN_POSITIVE)), last }
    }

    /// The bins along all axes. Adding 2^23 rounds to the last bit, which spares conversions.
    #[inline(always)]
    fn bins(&self, r: &Reference) -> [usize; 4] {
        let at = ((r.center() - self.low) * self.scale).clamp(Vec4::ZERO, self.last);
        (at + 8_388_608.0).to_array().map(|at| at.to_bits() as usize & (BINS - 1))
    }
}

/// Puts the left half of at least two references in front and returns its length, at least one and less than all.
pub fn split(part: &mut [Reference], capacity: u32) -> usize {
    if part.len() == 2 {
        return 1;
    }
    // Small parts have few places to cut, and of large ones a sample shows where
    let bins = if part.len() < BINS { BINS / 2 } else { BINS };
    let stride = (part.len() / SAMPLES).max(1);
    let grid = Grid::over(part, stride, bins);
    let mut table = [[Bin::EMPTY; BINS]; 3];
    for r in part.iter().step_by(stride) {
        let at = grid.bins(r);
        for axis in 0..3 {
            table[axis][at[axis]].add(r.low, r.high, r.low.w);
        }
    }
    let mut best = (f32::INFINITY, 0, 0);
    for axis in 0..3 {
        if grid.size[axis] > 0.0 {
            let (cost, bin) = best_bin(&table[axis][..bins], capacity);
            if cost < best.0 {
                best = (cost, axis, bin);
            }
        }
    }
    let (cost, axis, bin) = best;
    if cost.is_finite() {
        // Half a bin further; it does not matter on which side those at the very border are
        let border = grid.low[axis] + (bin as f32 + 0.5) / grid.scale[axis];
        let middle = partition(part, |r| r.low[axis] + r.high[axis] <= border);
        if 0 < middle && middle < part.len() {
            return middle;
        }
    }
    // All in one place: halves keep the tree's depth logarithmic
    part.len() / 2
}

/// The bin after which to split along an axis, and what that costs.
fn best_bin(bins: &[Bin], capacity: u32) -> (f32, usize) {
    let mut right = [f32::INFINITY; BINS];
    let mut all = Bin::EMPTY;
    for bin in (1..bins.len()).rev() {
        all.add(bins[bin].low, bins[bin].high, bins[bin].weight);
        right[bin] = if all.weight > 0.0 { all.cost(capacity) } else { f32::INFINITY };
    }
    let mut best = (f32::INFINITY, 0);
    all = Bin::EMPTY;
    for bin in 0..bins.len() - 1 {
        // Nothing new on the left: nothing cheaper
        if bins[bin].weight == 0.0 {
            continue;
        }
        all.add(bins[bin].low, bins[bin].high, bins[bin].weight);
        let cost = all.cost(capacity) + right[bin + 1];
        if cost < best.0 {
            best = (cost, bin);
        }
    }
    best
}

/// Puts those for which `left` holds in front, keeps no order, and returns how many they are. Without branches, since none
/// could be predicted.
fn partition(part: &mut [Reference], left: impl Fn(&Reference) -> bool) -> usize {
    let mut front = 0;
    for i in 0..part.len() {
        let goes_left = left(&part[i]);
        part.swap(i, front);
        front += usize::from(goes_left);
    }
    front
}
