//! A claim, executed: the steps of a bake, taken one by one with the functions that `pantaray bake` calls in a row.

mod bricks;
mod inputs;
mod merge;
mod preview;
#[cfg(test)]
mod tests;
mod trace;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

use engine::bake::map::{build_if_missing, map_key};
use engine::bake::{BakeOptions, Control};
use engine::brickmap::BrickMap;
use engine::scene::Roots;
use engine::{ErrorKind, bake::set::SetBake};
use protocol::storage::{FolderFile, FolderIndex};
use protocol::traced::Traced;
use protocol::work::{Claim, ClaimedBatch, PassResult, SetMap, Task};
use protocol::{PassKind, keys};

use self::inputs::{Prepared, Reads};
use self::trace::Bench;
use crate::cache::{Cache, Entry, Folder};
use crate::depot::{Depot, read_index, write_folder};
use crate::{Error, Result, digest};

/// Folders of one claim that may be found damaged one after the other: record, streams, plan, brick map.
const HEALINGS_MAX: usize = 4;

/// Takes the step that a claim asks for; keeps what the next claim of the same pass will need.
pub struct Executor {
    cache: Arc<Cache>,
    /// Bytes of a brick map that is kept whole at most.
    whole_map_bytes_max: u64,
    machine: BakeOptions,
    roots: Roots,
    /// What traces batches, while claims are of the same pass.
    bench: Option<Bench>,
    /// The folders that this claim has read from.
    used: Vec<(String, Vec<Entry>)>,
    /// What the names of the blocks that it has read from begin with.
    blocks: Option<String>,
}

/// A claim and what it is executed with.
#[derive(Clone, Copy)]
pub struct Work<'a> {
    /// The claim.
    pub claim: &'a Claim,
    /// Its bytes.
    pub depot: &'a Arc<dyn Depot>,
    /// Progress, and the flag that ends it.
    pub control: Control<'a>,
}

/// What a pass of one batch came to.
#[derive(Clone, Debug)]
pub struct Finished {
    /// The hash and length that its result is known by.
    pub content: FolderFile,
    /// What it found out.
    pub result: PassResult,
}

/// A batch's part, and what it took.
#[derive(Clone, Copy, Debug)]
pub struct Baked<'a> {
    /// The encoded part, empty for a batch without points.
    pub bytes: &'a [u8],
    /// How long it took.
    pub elapsed: Duration,
    /// What there is to say about it.
    pub log: &'a str,
    /// What traced: `cpu`, or the names of adapters.
    pub device: &'a str,
    /// What tracing took.
    pub traced: Traced,
}

/// Where parts go.
pub trait PartSink {
    /// Takes the part of a batch. Whether the next one is wanted.
    ///
    /// # Errors
    /// When it cannot be kept.
    fn part(&mut self, batch: ClaimedBatch, baked: Baked<'_>) -> Result<bool>;

    /// A batch begins; with it, `left` are left of the claim.
    fn begins(&mut self, _left: usize) {}

    /// The first batch of the next claim where that is known to be of `pass` too: its bricks are loaded while the last
    /// batch of this claim is traced.
    fn upcoming(&mut self, _pass: i64) -> Option<ClaimedBatch> {
        None
    }
}

impl Executor {
    /// An executor that works with what `machine` says of this machine and reads below `roots`.
    pub fn new(cache: Arc<Cache>, machine: BakeOptions, roots: Roots) -> Self {
        let whole_map_bytes_max = cache.bytes_max() / bricks::WHOLE_SHARE;
        Self { cache, whole_map_bytes_max, machine, roots, bench: None, used: Vec::new(), blocks: None }
    }

    /// Executes a claim: parts go to `sink`, the result of a pass of one batch comes back.
    ///
    /// # Errors
    /// Why it has no result. Damaged files of the local disk are thrown away and fetched again.
    pub fn execute(&mut self, work: Work<'_>, sink: &mut dyn PartSink) -> Result<Option<Finished>> {
        for _ in 0..HEALINGS_MAX {
            self.used.clear();
            self.blocks = None;
            match self.guarded(work, sink) {
                Err(Error::Engine(error)) if error.kind() != ErrorKind::Cancelled && self.heal()? => {
                    tracing::warn!("files of the local disk were damaged and are fetched again: {error}");
                }
                result => return result,
            }
        }
        self.guarded(work, sink)
    }

    /// Throws away what of the local disk is damaged; whether anything was.
    fn heal(&mut self) -> Result<bool> {
        self.bench = None;
        let mut damaged = match self.blocks.take() {
            Some(prefix) => self.cache.forget_blocks(&prefix)?,
            None => false,
        };
        for (name, entries) in &self.used {
            damaged |= self.cache.check(name, entries)?;
        }
        Ok(damaged)
    }

    /// A panic of the engine is this claim's failure and not the worker's end.
    fn guarded(&mut self, work: Work<'_>, sink: &mut dyn PartSink) -> Result<Option<Finished>> {
        match catch_unwind(AssertUnwindSafe(|| self.dispatch(work, sink))) {
            Ok(result) => result,
            Err(panic) => {
                self.bench = None;
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message");
                Err(Error::Crashed(text.to_owned()))
            }
        }
    }

    fn dispatch(&mut self, work: Work<'_>, sink: &mut dyn PartSink) -> Result<Option<Finished>> {
        let kind = work.claim.task.kind;
        if kind == PassKind::Bake {
            return self.bake(work, sink).map(|()| None);
        }
        self.bench = None;
        let &[batch] = &work.claim.batches[..] else {
            return Err(engine::Error::invalid(format!("a pass of kind `{kind}` has one batch")).into());
        };
        let _span = tracing::error_span!("batch", batch = batch.batch, fence = batch.fence).entered();
        let folder = keys::result_folder(&work.claim.task.job, work.claim.pass, batch.fence);
        let finished = match kind {
            PassKind::Import => self.import(work, &folder)?,
            PassKind::Build => self.build(work)?,
            PassKind::Plan => self.plan(work, &folder)?,
            _ => self.merge(work, &folder)?,
        };
        Ok(Some(finished))
    }

    /// Builds a brick map and puts it under its content key.
    fn build(&mut self, work: Work<'_>) -> Result<Finished> {
        let key = need(&work.claim.task.map, "brick map")?;
        let prepared = self.prepare(work, Reads::Occluders)?;
        let seen = prepared.occluders(key)?;
        let Prepared { scene, inputs, options, .. } = &prepared;
        let scratch = self.cache.scratch()?;
        let (target, build) = (scratch.path().join(key), scratch.path().join("build"));
        build_if_missing(scene, inputs, &seen, options, &build, &target, work.control)?;
        let map = BrickMap::open(&target)?;
        let manifest = map.manifest();
        let result = PassResult::Build {
            bricks: u64::from(manifest.bricks),
            bytes: manifest.bytes,
            micropolygons: manifest.micropolygons,
        };
        let paths = crate::depot::files_below(&target)?;
        let folder = keys::brick_map(key);
        let (index, content) = write_folder(&**work.depot, &folder, &target, &paths, scratch.path())?;
        self.keep(&target, index.files)?;
        Ok(Finished { content, result })
    }

    /// Splits the points of a bake set into batches.
    fn plan(&mut self, work: Work<'_>, folder: &str) -> Result<Finished> {
        let prepared = self.prepare(work, Reads::Carrier)?;
        let set = prepared.set(&work.claim.task)?;
        let (scratch, target) = (self.cache.scratch()?, self.cache.scratch()?);
        let plan = set.plan(target.path(), work.control)?;
        let batches = set.batches(&plan);
        let points = batches.iter().map(|&batch| u64::from(plan.batch(batch as usize).count)).sum();
        let result = PassResult::Plan { batches: batches.len() as i64, points };
        let paths = crate::depot::files_below(target.path())?;
        let (index, content) = write_folder(&**work.depot, folder, target.path(), &paths, scratch.path())?;
        self.keep(target.path(), index.files)?;
        Ok(Finished { content, result })
    }

    /// Keeps what was put: the next pass of the job may well come to this worker.
    fn keep(
        &self,
        root: &std::path::Path,
        files: impl IntoIterator<Item = (String, FolderFile)>,
    ) -> Result<()> {
        for (path, content) in files {
            // A cache that is full has use for something else
            if let Err(error) = self.cache.adopt(&root.join(&path), &content) {
                tracing::debug!("{path} is not kept: {error}");
            }
        }
        Ok(())
    }

    /// A folder of storage on the local disk.
    fn fetch_folder(&mut self, depot: &dyn Depot, key: &str) -> Result<Arc<Folder>> {
        let scratch = self.cache.scratch()?;
        let index = read_index(depot, key, scratch.path())?;
        self.folder(key, entries(key, &index), depot)
    }

    /// A folder of the cache, remembered as used.
    fn folder(&mut self, key: &str, entries: Vec<Entry>, depot: &dyn Depot) -> Result<Arc<Folder>> {
        let name = key.replace('/', "+");
        let folder = self.cache.folder(&name, &entries, depot)?;
        self.used.push((name, entries));
        Ok(folder)
    }
}

/// The files of the folder `key` in storage as objects.
fn entries(key: &str, index: &FolderIndex) -> Vec<Entry> {
    let entry = |(path, file): (&String, &FolderFile)| Entry {
        path: path.clone(),
        key: format!("{key}/{path}"),
        sha256: file.sha256.clone(),
        bytes: Some(file.bytes),
    };
    index.files.iter().map(entry).collect()
}

/// What a task must name.
fn need<'a>(what: &'a Option<String>, name: &str) -> Result<&'a String> {
    Ok(what.as_ref().ok_or_else(|| engine::Error::invalid(format!("the task names no {name}")))?)
}

/// The bake sets of a scene and the brick maps that they need.
fn set_maps(sets: &[SetBake<'_>], prepared: &Prepared) -> Vec<SetMap> {
    let map = |set: &SetBake<'_>| SetMap {
        set: set.bake_set.name.clone(),
        map: map_key(&prepared.inputs, &set.occluders, &prepared.options),
    };
    sets.iter().map(map).collect()
}

impl Prepared {
    /// The bake set that the task is about.
    fn set(&self, task: &Task) -> Result<SetBake<'_>> {
        let name = need(&task.set, "bake set")?;
        let sets = SetBake::all(&self.scene, &self.inputs, &self.options)?;
        let found = sets.into_iter().find(|set| set.bake_set.name == *name);
        Ok(found.ok_or_else(|| engine::Error::invalid(format!("the scene has no bake set `{name}`")))?)
    }
}

/// The content of a batch without points.
pub fn no_part() -> FolderFile {
    digest::of_bytes(&[])
}
