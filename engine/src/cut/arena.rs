//! The arena: one allocation that holds the loaded bricks; least recently used ones go out, holes close step by step.
//!
//! Bricks lie in address order with holes between them. A brick that does not fit into the space behind the last one
//! takes the first hole that is large enough from a rover on; when there is none, bricks are moved down, a few at a time,
//! until one is (paper, section 4.4: incremental coalescing). Moving is safe because nothing points into the arena but
//! its own table.

use std::sync::Arc;

use memmap2::MmapMut;

use crate::brick::leaf::READ_PAST_BYTES;
use crate::brick::walk::{Bricks, Location};
use crate::brick::{ALIGNMENT, BYTES_MAX, Brick};
use crate::brickmap::BrickMap;
use crate::{Error, ErrorKind, Result};

const NONE: u32 = u32::MAX;

/// A place: in the cut, but not loaded.
pub const MISSING: u32 = u32::MAX;
/// A place: not in the cut.
pub const NOT_IN_CUT: u32 = u32::MAX - 1;

/// Bytes that one read from storage asks for at most, when bricks are neighbours on disk.
const READ_BYTES_MAX: usize = 1 << 20;

/// What the arena counted, over its whole life.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ArenaCounts {
    /// Bricks asked for.
    pub requests: u64,
    /// Bricks that had to be loaded.
    pub misses: u64,
    /// Bytes read from storage.
    pub read_bytes: u64,
    /// Bricks that went out.
    pub evicted: u64,
    /// Bytes moved to close holes.
    pub moved_bytes: u64,
}

/// A brick's place. Slots form two lists: by address, and by last use.
#[derive(Clone, Copy, Debug)]
struct Slot {
    brick: u32,
    /// Offset and length in units of [`ALIGNMENT`].
    at: u32,
    length: u32,
    /// The batch that last used it.
    used: u32,
    below: u32,
    above: u32,
    older: u32,
    newer: u32,
}

/// The memory that holds loaded bricks.
#[derive(Debug)]
pub struct Arena {
    map: Arc<BrickMap>,
    /// Anonymous memory, aligned to pages.
    memory: MmapMut,
    capacity: u32,
    slot_of: Vec<u32>,
    slots: Vec<Slot>,
    free_slots: Vec<u32>,
    lowest: u32,
    highest: u32,
    oldest: u32,
    newest: u32,
    free: u32,
    rover: u32,
    /// The current batch; slots with this mark must stay.
    batch: u32,
    /// Whether every brick is in every cut.
    everything: bool,
    /// The bricks of the current cut, unless everything is.
    cut: Vec<u32>,
    /// Per brick, what a walk asks for: its address, [`MISSING`] or [`NOT_IN_CUT`]. One look-up a brick.
    places: Vec<u32>,
    staging: Vec<u8>,
    /// What was written, if somebody keeps a copy.
    changes: Option<Changes>,
    /// What was counted.
    pub counts: ArenaCounts,
}

/// What has changed in an arena since a copy of it was last brought up to date.
#[derive(Clone, Debug, Default)]
pub struct Changes {
    /// Ranges of memory in units of [`ALIGNMENT`], in any order, some of them more than once.
    pub lines: Vec<std::ops::Range<u32>>,
    /// Bricks whose place is another one, likewise.
    pub places: Vec<u32>,
}

impl Arena {
    /// An arena of `bytes` for the bricks of `map`; never more than the map needs. With `everything`, all bricks belong
    /// to every cut.
    ///
    /// # Errors
    /// [`ErrorKind::Limit`] when `bytes` is less than a handful of bricks.
    pub fn new(map: Arc<BrickMap>, bytes: u64, everything: bool) -> Result<Self> {
        let wanted = bytes.min(map.bytes() + ALIGNMENT as u64);
        let smallest = (16 * BYTES_MAX as u64).min(map.bytes());
        if wanted < smallest {
            return Err(Error::new(ErrorKind::Limit, format!("an arena of {bytes} bytes is too small"))
                .hint(format!("at least {smallest} bytes are needed: raise `--memory`")));
        }
        let capacity = (wanted / ALIGNMENT as u64) as u32;
        // Zeroed by the operating system, page by page as bricks come in
        let memory = MmapMut::map_anon(capacity as usize * ALIGNMENT + READ_PAST_BYTES).map_err(|error| {
            Error::new(ErrorKind::Limit, format!("cannot get an arena of {wanted} bytes: {error}"))
                .hint("lower `--memory`")
        })?;
        // Walks jump about in all of it: large pages save a miss of the address cache at nearly every visit
        #[cfg(target_os = "linux")]
        if let Err(error) = memory.advise(memmap2::Advice::HugePage) {
            tracing::debug!("no huge pages for the arena: {error}");
        }
        let bricks = map.brick_count() as usize;
        Ok(Self {
            memory,
            capacity,
            slot_of: vec![NONE; bricks],
            slots: Vec::new(),
            free_slots: Vec::new(),
            lowest: NONE,
            highest: NONE,
            oldest: NONE,
            newest: NONE,
            free: capacity,
            rover: NONE,
            batch: 0,
            everything,
            cut: Vec::new(),
            places: vec![if everything { MISSING } else { NOT_IN_CUT }; bricks],
            staging: Vec::new(),
            changes: None,
            map,
            counts: ArenaCounts::default(),
        })
    }

    /// The map whose bricks it holds.
    pub fn map(&self) -> &Arc<BrickMap> {
        &self.map
    }

    /// From now on [`take_changes`](Self::take_changes) tells what has changed, first of all everything that is there.
    pub fn track_changes(&mut self) {
        let lines = if self.highest == NONE { Vec::new() } else { vec![0..self.end_of(self.highest)] };
        self.changes = Some(Changes { lines, places: (0..self.map.brick_count()).collect() });
    }

    /// Nobody keeps a copy any more.
    pub fn forget_changes(&mut self) {
        self.changes = None;
    }

    /// What has changed since the last call; nothing unless changes are tracked.
    pub fn take_changes(&mut self) -> Changes {
        self.changes.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Per brick, where it is in units of [`ALIGNMENT`]; [`MISSING`] or [`NOT_IN_CUT`].
    pub fn places(&self) -> &[u32] {
        &self.places
    }

    /// Bytes that it has for bricks.
    pub fn bytes(&self) -> u64 {
        u64::from(self.capacity) * ALIGNMENT as u64
    }

    /// Starts a new batch with an empty cut: bricks loaded or touched from now on stay until the next one starts.
    pub fn begin_batch(&mut self) {
        self.batch += 1;
        for brick in std::mem::take(&mut self.cut) {
            self.set_place(brick, NOT_IN_CUT);
        }
    }

    fn set_place(&mut self, brick: u32, place: u32) {
        if self.places[brick as usize] != place {
            self.places[brick as usize] = place;
            if let Some(changes) = &mut self.changes {
                changes.places.push(brick);
            }
        }
    }

    /// Notes that a brick's lines were written.
    fn note_written(&mut self, at: u32, lines: u32) {
        if let Some(changes) = &mut self.changes {
            changes.lines.push(at..at + lines);
        }
    }

    /// Lets bricks of the current batch go, but keeps its cut.
    pub fn release(&mut self) {
        self.batch += 1;
    }

    /// Adds bricks to the current batch's cut.
    pub fn add_to_cut(&mut self, bricks: &[u32]) {
        if self.everything {
            return;
        }
        self.cut.extend_from_slice(bricks);
        for &brick in bricks {
            let slot = self.slot_of[brick as usize];
            self.set_place(brick, if slot == NONE { MISSING } else { self.slots[slot as usize].at });
        }
    }

    /// Notes where a brick is now, if it is in the cut.
    fn note_place(&mut self, brick: u32, place: u32) {
        if self.places[brick as usize] != NOT_IN_CUT {
            self.set_place(brick, place);
        }
    }

    /// The brick, if it is loaded.
    pub fn brick(&self, brick: u32) -> Option<Brick<'_>> {
        let slot = self.slot_of[brick as usize];
        (slot != NONE)
            .then(|| Brick::trusted(&self.memory()[self.slots[slot as usize].at as usize * ALIGNMENT..]))
    }

    /// Loads those of `bricks` that are not loaded, as long as they fit beside what the current batch holds already.
    /// `bricks` is sorted. Returns how many of them, from the front, are loaded now.
    ///
    /// # Errors
    /// When storage cannot be read or a brick is corrupt.
    pub fn load(&mut self, bricks: &[u32]) -> Result<usize> {
        // What is there already must not go out to make room for the rest
        for &brick in bricks {
            let slot = self.slot_of[brick as usize];
            if slot != NONE {
                self.touch(slot);
            }
        }
        let mut done = 0;
        while done < bricks.len() {
            self.counts.requests += 1;
            if self.slot_of[bricks[done] as usize] != NONE {
                done += 1;
                continue;
            }
            // Read neighbours on disk in one go
            let (mut run, mut bytes) = (0, 0);
            for (&brick, number) in bricks[done..].iter().zip(bricks[done]..) {
                let length = self.map.brick_bytes(brick) as usize;
                if brick != number
                    || self.slot_of[brick as usize] != NONE
                    || run > 0 && bytes + length > READ_BYTES_MAX
                {
                    break;
                }
                (run, bytes) = (run + 1, bytes + length);
            }
            let mut staging = std::mem::take(&mut self.staging);
            staging.clear();
            staging.resize(bytes + READ_PAST_BYTES, 0);
            let placed = self.read_run(bricks[done], run as u32, &mut staging);
            self.staging = staging;
            let placed = placed?;
            done += placed as usize;
            self.counts.requests += u64::from(placed.saturating_sub(1));
            if placed < run as u32 {
                return Ok(done);
            }
        }
        Ok(done)
    }

    /// Loads the whole map, if it fits. Costs nothing when it is loaded already.
    ///
    /// # Errors
    /// See [`load`](Self::load).
    pub fn load_everything(&mut self) -> Result<bool> {
        let bricks = self.map.brick_count();
        if u64::from(self.capacity) * (ALIGNMENT as u64) < self.map.bytes() {
            return Ok(false);
        }
        if (self.slots.len() - self.free_slots.len()) < bricks as usize {
            let all: Vec<u32> = (0..bricks).collect();
            return Ok(self.load(&all)? == all.len());
        }
        self.counts.requests += u64::from(bricks);
        Ok(true)
    }

    /// Reads `count` bricks from `first` on and places them, until one does not fit. How many were placed.
    fn read_run(&mut self, first: u32, count: u32, staging: &mut [u8]) -> Result<u32> {
        let bytes = staging.len() - READ_PAST_BYTES;
        // Do not read what cannot be placed
        if !self.make_room(self.map.brick_bytes(first) / ALIGNMENT as u32) {
            return Ok(0);
        }
        self.map.read(first, count, &mut staging[..bytes])?;
        self.counts.read_bytes += bytes as u64;
        let mut at = 0;
        for brick in first..first + count {
            let length = self.map.brick_bytes(brick) as usize;
            Brick::check(&staging[at..], length, brick).map_err(|error| error.at(self.map.path()))?;
            let lines = (length / ALIGNMENT) as u32;
            if !self.make_room(lines) {
                return Ok(brick - first);
            }
            let place = self.place(lines);
            let start = place as usize * ALIGNMENT;
            self.memory[start..start + length].copy_from_slice(&staging[at..at + length]);
            self.note_written(place, lines);
            self.insert(brick, place, lines);
            self.counts.misses += 1;
            at += length;
        }
        Ok(count)
    }

    /// Evicts bricks that the current batch does not hold, oldest first, until `lines` are free in all.
    fn make_room(&mut self, lines: u32) -> bool {
        while self.free < lines {
            let slot = self.oldest;
            if slot == NONE || self.slots[slot as usize].used == self.batch {
                return false;
            }
            self.remove(slot);
            self.counts.evicted += 1;
        }
        true
    }

    /// The address of a hole of `lines`, made by moving bricks down if there is none. Enough lines are free in all.
    fn place(&mut self, lines: u32) -> u32 {
        // Behind the last brick
        let end = self.end_of(self.highest);
        if self.capacity - end >= lines {
            return end;
        }
        // In a hole, from the rover on
        let mut slot = if self.rover == NONE { self.lowest } else { self.rover };
        for _ in 0..64 {
            let below = self.slots[slot as usize].below;
            let hole = self.end_of(below);
            if self.slots[slot as usize].at - hole >= lines {
                self.rover = slot;
                return hole;
            }
            slot = self.slots[slot as usize].above;
            if slot == NONE {
                slot = self.lowest;
            }
        }
        // Move bricks down over their holes until one large hole has gathered, from the rover up
        self.rover = slot;
        loop {
            let hole = self.end_of(self.slots[slot as usize].below);
            let Slot { at, length, above, .. } = self.slots[slot as usize];
            if at - hole >= lines {
                self.rover = slot;
                return hole;
            }
            if at > hole {
                let (from, to, bytes) =
                    (at as usize * ALIGNMENT, hole as usize * ALIGNMENT, length as usize * ALIGNMENT);
                self.memory.copy_within(from..from + bytes, to);
                self.slots[slot as usize].at = hole;
                self.note_written(hole, length);
                self.note_place(self.slots[slot as usize].brick, hole);
                self.counts.moved_bytes += bytes as u64;
            }
            if above == NONE {
                let end = self.end_of(slot);
                if self.capacity - end >= lines {
                    self.rover = self.lowest;
                    return end;
                }
                // The gathered hole is at the top; what is missing lies below the rover
                slot = self.lowest;
                continue;
            }
            slot = above;
        }
    }

    /// One past the last line of a slot; 0 for none.
    fn end_of(&self, slot: u32) -> u32 {
        if slot == NONE { 0 } else { self.slots[slot as usize].at + self.slots[slot as usize].length }
    }

    /// Links a new slot into both lists.
    fn insert(&mut self, brick: u32, at: u32, length: u32) {
        let slot = self.free_slots.pop().unwrap_or_else(|| {
            self.slots.push(Slot {
                brick,
                at,
                length,
                used: 0,
                below: NONE,
                above: NONE,
                older: NONE,
                newer: NONE,
            });
            self.slots.len() as u32 - 1
        });
        // The neighbour above is the rover's slot if the hole was found there
        let above = if self.highest == NONE || at >= self.end_of(self.highest) { NONE } else { self.rover };
        let below = if above == NONE { self.highest } else { self.slots[above as usize].below };
        self.slots[slot as usize] =
            Slot { brick, at, length, used: self.batch, below, above, older: self.newest, newer: NONE };
        *(if below == NONE { &mut self.lowest } else { &mut self.slots[below as usize].above }) = slot;
        *(if above == NONE { &mut self.highest } else { &mut self.slots[above as usize].below }) = slot;
        *(if self.newest == NONE { &mut self.oldest } else { &mut self.slots[self.newest as usize].newer }) =
            slot;
        self.newest = slot;
        self.slot_of[brick as usize] = slot;
        self.note_place(brick, at);
        self.free -= length;
    }

    /// Unlinks a slot from both lists.
    fn remove(&mut self, slot: u32) {
        let Slot { brick, length, below, above, .. } = self.slots[slot as usize];
        *(if below == NONE { &mut self.lowest } else { &mut self.slots[below as usize].above }) = above;
        *(if above == NONE { &mut self.highest } else { &mut self.slots[above as usize].below }) = below;
        self.unlink_use(slot);
        if self.rover == slot {
            self.rover = above;
        }
        self.slot_of[brick as usize] = NONE;
        self.note_place(brick, MISSING);
        self.free_slots.push(slot);
        self.free += length;
    }

    /// Marks a slot as used by the current batch.
    fn touch(&mut self, slot: u32) {
        if self.slots[slot as usize].used == self.batch {
            return;
        }
        self.unlink_use(slot);
        let newest = self.newest;
        let entry = &mut self.slots[slot as usize];
        (entry.used, entry.older, entry.newer) = (self.batch, newest, NONE);
        *(if newest == NONE { &mut self.oldest } else { &mut self.slots[newest as usize].newer }) = slot;
        self.newest = slot;
    }

    fn unlink_use(&mut self, slot: u32) {
        let Slot { older, newer, .. } = self.slots[slot as usize];
        *(if older == NONE { &mut self.oldest } else { &mut self.slots[older as usize].newer }) = newer;
        *(if newer == NONE { &mut self.newest } else { &mut self.slots[newer as usize].older }) = older;
    }
}

impl Bricks for Arena {
    fn memory(&self) -> &[u8] {
        &self.memory
    }

    #[inline(always)]
    fn locate(&self, brick: u32) -> Location {
        match self.places[brick as usize] {
            NOT_IN_CUT => Location::FarField,
            MISSING => Location::Missing,
            place => Location::Resident(place),
        }
    }
}
