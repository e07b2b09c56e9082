//! The arena's copy on the device: pages of bricks, and the table that says where each brick is (paper, section 4.4).
//!
//! Before a batch is traced, what the arena has changed since the last one is sent. Runs of changed bytes with small gaps
//! between them travel as one, as long as the gaps add less than a fifth to what is sent.

use std::ops::Range;

use wgpu::{Buffer, BufferUsages};

use super::device::Gpu;
use super::shader::Pages;
use crate::Result;
use crate::brick::ALIGNMENT;
use crate::brick::walk::Bricks;
use crate::cut::Arena;
use crate::cut::arena::Changes;

/// The arena's copy on a device.
#[derive(Debug)]
pub struct Mirror {
    /// How the pages are cut.
    pub pages: Pages,
    /// Their memory.
    pub(super) buffers: Vec<Buffer>,
    /// Per brick, where it is.
    pub(super) places: Buffer,
    /// Bytes sent so far.
    pub sent_bytes: u64,
}

impl Mirror {
    /// A copy of `arena`, empty until the first [`update`](Self::update). Pages have at most `page_bytes_max` bytes, a power
    /// of two of at least 64 KiB.
    ///
    /// # Errors
    /// [`ErrorKind::Device`](crate::ErrorKind::Device) when the device has too little memory, or too few bindings.
    pub fn new(gpu: &Gpu, arena: &Arena, page_bytes_max: u64) -> Result<Self> {
        let bytes = arena.memory().len() as u64;
        let page_bytes =
            page_bytes_max.min(gpu.adapter.page_bytes()).min(bytes.next_power_of_two()).max(1 << 16);
        let count = bytes.div_ceil(page_bytes) as u32;
        if count > gpu.adapter.pages_max() {
            let limit = u64::from(gpu.adapter.pages_max()) * page_bytes;
            return Err(super::device::fault(
                &gpu.adapter.name,
                &format!("can hold an arena of `{limit}` bytes, not of `{bytes}`"),
            )
            .hint("lower `--memory`"));
        }
        let page = |number: u32| {
            let rest = bytes - u64::from(number) * page_bytes;
            gpu.buffer("arena", rest.min(page_bytes), BufferUsages::STORAGE)
        };
        let buffers = (0..count).map(page).collect::<Result<Vec<_>>>()?;
        let places = gpu.buffer("places", 4 * arena.places().len() as u64, BufferUsages::STORAGE)?;
        let pages = Pages { count, bytes: page_bytes };
        Ok(Self { pages, buffers, places, sent_bytes: 0 })
    }

    /// Largest arena that a device can mirror, in bytes.
    pub fn capacity_bytes(gpu: &Gpu) -> u64 {
        u64::from(gpu.adapter.pages_max()) * gpu.adapter.page_bytes()
    }

    /// Sends what has changed. Earlier submissions see the old state, later ones the new.
    pub fn update(&mut self, gpu: &Gpu, arena: &Arena, changes: &Changes) {
        let (line, whole) = (ALIGNMENT as u64, arena.memory());
        for run in merged(changes.lines.clone()) {
            let end = (u64::from(run.end) * line).min(whole.len() as u64);
            let mut at = u64::from(run.start) * line;
            self.sent_bytes += end - at;
            while at < end {
                let (page, offset) = (at / self.pages.bytes, at % self.pages.bytes);
                let length = (end - at).min(self.pages.bytes - offset);
                let bytes = &whole[at as usize..(at + length) as usize];
                gpu.queue.write_buffer(&self.buffers[page as usize], offset, bytes);
                at += length;
            }
        }
        let table = arena.places();
        for run in merged(changes.places.iter().map(|&brick| brick..brick + 1).collect()) {
            let bytes = bytemuck::cast_slice(&table[run.start as usize..run.end as usize]);
            gpu.queue.write_buffer(&self.places, 4 * u64::from(run.start), bytes);
            self.sent_bytes += bytes.len() as u64;
        }
    }
}

/// The runs in order, those that touch joined, and then across the smallest gaps, as long as all gaps together are at most
/// a fifth of the runs.
fn merged(mut runs: Vec<Range<u32>>) -> Vec<Range<u32>> {
    runs.sort_unstable_by_key(|run| run.start);
    let mut joined: Vec<Range<u32>> = Vec::new();
    for run in runs {
        match joined.last_mut() {
            Some(last) if run.start <= last.end => last.end = last.end.max(run.end),
            _ => joined.push(run),
        }
    }

    // Fill the smallest gaps first, while there is allowance
    let gap = |run: usize| joined[run].start - joined[run - 1].end;
    let dirty: u64 = joined.iter().map(|run| u64::from(run.end - run.start)).sum();
    let (mut allowance, mut is_filled) = (dirty / 5, vec![false; joined.len()]);
    let mut by_gap: Vec<usize> = (1..joined.len()).collect();
    by_gap.sort_unstable_by_key(|&run| gap(run));
    for run in by_gap {
        if u64::from(gap(run)) > allowance {
            break;
        }
        allowance -= u64::from(gap(run));
        is_filled[run] = true;
    }
    let mut merged: Vec<Range<u32>> = Vec::with_capacity(joined.len());
    for (run, is_filled) in joined.into_iter().zip(is_filled) {
        match merged.last_mut() {
            Some(last) if is_filled => last.end = run.end,
            _ => merged.push(run),
        }
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::hash::hash32;

    /// Catches changed bytes that are not sent, bytes that are sent twice, and more than a fifth of waste.
    #[test]
    fn merged_runs_cover_what_changed_and_little_else() {
        let mut seed = 3;
        let mut next = |range: u32| {
            seed = hash32(seed);
            seed % range
        };
        for case in 0..500 {
            let spread = [20, 300, 100_000][case % 3];
            let runs: Vec<Range<u32>> = (0..1 + next(200))
                .map(|_| [next(spread), next(9)])
                .map(|[start, more]| start..start + 1 + more)
                .collect();
            let mut dirty = vec![false; spread as usize + 10];
            runs.iter().for_each(|run| dirty[run.start as usize..run.end as usize].fill(true));
            let joined = merged(runs);
            let mut sent = vec![false; dirty.len()];
            for pair in joined.windows(2) {
                assert!(pair[0].end < pair[1].start, "case {case}: {pair:?}");
            }
            joined.iter().for_each(|run| sent[run.start as usize..run.end as usize].fill(true));
            assert!(dirty.iter().zip(&sent).all(|(dirty, sent)| !dirty || *sent), "case {case}");
            let count = |flags: &[bool]| flags.iter().filter(|flag| **flag).count();
            assert!(5 * (count(&sent) - count(&dirty)) <= count(&dirty), "case {case}");
        }
        let none: Vec<Range<u32>> = merged(Vec::new());
        assert!(none.is_empty());
    }

    /// Catches gaps that are not filled although they may be.
    #[test]
    fn small_gaps_are_filled_first() {
        assert_eq!(merged(vec![20..30, 0..10, 11..15]), vec![0..15, 20..30]);
        assert_eq!(merged(vec![0..10, 100..110]), vec![0..10, 100..110]);
        assert_eq!(merged(vec![0..100, 105..200, 240..241]), vec![0..200, 240..241]);
    }
}
