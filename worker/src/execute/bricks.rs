//! Brick maps larger than what the local disk keeps: blocks of their segments come by range reads when they are needed.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use engine::brickmap::{BrickMap, SegmentSource};
use protocol::keys;
use protocol::storage::FolderIndex;

use super::Executor;
use crate::cache::{Cache, Folder};
use crate::depot::{Depot, read_index};
use crate::{Error, Result};

/// Bytes of a block: a few hundred neighbouring bricks come with one request.
const BLOCK_BYTES: u64 = 4 << 20;
/// The part of the cache that a map may take to be kept whole.
pub(super) const WHOLE_SHARE: u64 = 4;

/// The segments of one map.
#[derive(Debug)]
pub(super) struct RemoteBricks {
    cache: Arc<Cache>,
    /// The map's folder in storage.
    folder: String,
    index: FolderIndex,
    prefix: String,
    /// The lease at hand, under which URLs are to be had.
    depot: Mutex<Arc<dyn Depot>>,
}

impl RemoteBricks {
    /// From now on asks as this lease.
    pub fn ask(&self, depot: &Arc<dyn Depot>) {
        *self.depot.lock().unwrap_or_else(PoisonError::into_inner) = depot.clone();
    }

    /// What the names of its blocks begin with.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Fills `out` from one block.
    fn read_block(&self, name: &str, number: u64, offset: u64, out: &mut [u8]) -> Result<()> {
        let block = format!("{}{name}-{number}", self.prefix);
        if self.cache.read_block(&block, offset, out) {
            return Ok(());
        }
        let segment = self.index.files.get(name).map_or(0, |file| file.bytes);
        let start = number * BLOCK_BYTES;
        let bytes = BLOCK_BYTES.min(segment.saturating_sub(start));
        if offset + out.len() as u64 > bytes {
            return Err(Error::Damaged(format!("`{name}` of the brick map ends at byte {segment}")));
        }
        let mut fetched = vec![0; bytes as usize];
        let depot = self.depot.lock().unwrap_or_else(PoisonError::into_inner).clone();
        depot.read_range(&format!("{}/{name}", self.folder), start, &mut fetched)?;
        out.copy_from_slice(&fetched[offset as usize..][..out.len()]);
        Ok(self.cache.keep_block(&block, &fetched)?)
    }
}

impl SegmentSource for RemoteBricks {
    fn read(&self, name: &str, offset: u64, out: &mut [u8]) -> engine::Result<()> {
        let mut done = 0;
        while done < out.len() {
            let at = offset + done as u64;
            let (number, within) = (at / BLOCK_BYTES, at % BLOCK_BYTES);
            let count = (out.len() - done).min((BLOCK_BYTES - within) as usize);
            self.read_block(name, number, within, &mut out[done..done + count])?;
            done += count;
        }
        Ok(())
    }
}

impl Executor {
    /// Opens a brick map: from the local disk where all of it is there or it is small enough, else block by block.
    pub(super) fn map(
        &mut self,
        depot: &Arc<dyn Depot>,
        key: &str,
    ) -> Result<(BrickMap, Arc<Folder>, Option<Arc<RemoteBricks>>)> {
        let folder = keys::brick_map(key);
        let scratch = self.cache.scratch()?;
        let index = read_index(&**depot, &folder, scratch.path())?;
        let bytes: u64 = index.files.values().map(|file| file.bytes).sum();
        if self.cache.has(&index.files) || bytes <= self.whole_map_bytes_max {
            let local = self.fetch_folder(&**depot, &folder)?;
            return Ok((BrickMap::open(local.path())?, local, None));
        }
        let mut head = index.clone();
        head.files.retain(|path, _| Path::new(path).file_stem().is_none_or(|stem| stem != "segment"));
        let local = self.folder(&format!("{folder}+head"), super::entries(&folder, &head), &**depot)?;
        let prefix = format!("{key}-");
        let (cache, depot) = (self.cache.clone(), Mutex::new(depot.clone()));
        let bricks = Arc::new(RemoteBricks { cache, folder, index, prefix, depot });
        Ok((BrickMap::open_with(local.path(), bricks.clone())?, local, Some(bricks)))
    }
}
