//! The merge pass: committed parts, verified as they come, become the decorated stream.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use engine::batch::BatchPlan;
use engine::output::{Part, PartFormat, PartSource};
use protocol::storage::FolderFile;
use protocol::work::{ClaimedBatch, PartEntry, PassResult};
use protocol::{keys, limits};

use super::inputs::Reads;
use super::preview::ForTheEye;
use super::{Executor, Finished, Work, need, preview};
use crate::depot::{Depot, Wanted};
use crate::{Error, Result, digest};

/// Damaged parts that one merge reports at most; the next merge finds the others.
const BAD_PARTS_MAX: usize = 1_024;

impl Executor {
    /// Merges the parts of a bake pass into the decorated stream, and puts it.
    pub(super) fn merge(&mut self, work: Work<'_>, folder: &str) -> Result<Finished> {
        let task = &work.claim.task;
        let prepared = self.prepare(work, Reads::Carrier)?;
        let plan_folder = self.fetch_folder(&**work.depot, need(&task.plan, "plan")?)?;
        let plan = BatchPlan::open(plan_folder.path())?;
        let set = prepared.set(task)?;
        let pass = task.parts.ok_or_else(|| engine::Error::invalid("the task names no parts"))?;
        let scratch = self.cache.scratch()?;
        let mut parts = CommittedParts {
            depot: &**work.depot,
            job: &task.job,
            pass,
            format: set.format(&plan)?,
            batches: set.batches(&plan),
            scratch: scratch.path(),
            after: None,
            is_last: false,
            ready: VecDeque::new(),
            bad: Vec::new(),
            failure: None,
        };
        let name = format!("{}.mgs", set.bake_set.name);
        let target = scratch.path().join(&name);
        let merged = set.merge(&plan, &mut parts, task.partial, scratch.path(), &target, work.control);
        if !parts.bad.is_empty() {
            return Err(Error::BadParts(parts.bad));
        }
        if let Some(failure) = parts.failure {
            return Err(failure);
        }
        let report = merged?;
        let content = digest::of_file(&target)?;
        let key = format!("{folder}/{name}");
        work.depot.write(&key, &target, &content)?;
        let (points, baked, bytes) = (report.points, report.baked, content.bytes);
        let ForTheEye { preview, picture } =
            preview::make(work, prepared.options.memory_bytes / 4, &target, &key)?;
        Ok(Finished { content, result: PassResult::Merge { points, baked, bytes, preview, picture } })
    }
}

/// The committed parts of a pass, fetched a page at a time.
struct CommittedParts<'a> {
    depot: &'a dyn Depot,
    job: &'a str,
    pass: i64,
    format: PartFormat,
    /// The plan's batches by number of the pass's batch.
    batches: Vec<u32>,
    scratch: &'a Path,
    after: Option<i64>,
    is_last: bool,
    /// Parts that have come, and what they should be.
    ready: VecDeque<(PartEntry, PathBuf, Result<FolderFile>)>,
    bad: Vec<ClaimedBatch>,
    /// Why parts could not be had, which is no fault of theirs.
    failure: Option<Error>,
}

impl CommittedParts<'_> {
    /// Fetches the next page; none where there is no more.
    fn fetch(&mut self) -> Result<bool> {
        if self.is_last {
            return Ok(false);
        }
        let page = self.depot.parts(self.after)?;
        self.after = page.next;
        self.is_last = page.next.is_none();
        for parts in page.parts.chunks(limits::URLS_MAX) {
            let wanted = |part: &PartEntry| Wanted {
                key: keys::part(self.job, self.pass, part.batch, part.fence, &part.sha256),
                path: self.scratch.join(format!("{}.part", part.batch)),
                bytes_max: self.format.part_bytes_max() as u64,
            };
            // A batch without points has no object
            let parts: Vec<&PartEntry> = parts.iter().filter(|part| part.bytes > 0).collect();
            let wanted: Vec<Wanted> = parts.iter().map(|part| wanted(part)).collect();
            let came = self.depot.read(&wanted).into_iter().zip(wanted);
            self.ready
                .extend(parts.iter().zip(came).map(|(part, (came, w))| ((*part).clone(), w.path, came)));
        }
        Ok(true)
    }

    /// Whether `part` becomes the one that was committed.
    fn accept(
        &self,
        entry: &PartEntry,
        path: &Path,
        came: &FolderFile,
        part: &mut Part,
    ) -> engine::Result<bool> {
        let bytes = std::fs::read(path).map_err(|error| engine::Error::io("read", path, error))?;
        std::fs::remove_file(path).map_err(|error| engine::Error::io("remove", path, error))?;
        let planned = usize::try_from(entry.batch).ok().and_then(|number| self.batches.get(number));
        let is_right = came.sha256 == entry.sha256 && came.bytes == entry.bytes as u64;
        Ok(is_right
            && part.decode(&bytes, &self.format, path, 0).is_ok()
            && planned == Some(&part.batch)
            && part.check(&self.format).is_ok())
    }
}

impl PartSource for CommittedParts<'_> {
    fn format(&self) -> &PartFormat {
        &self.format
    }

    fn rewind(&mut self) -> engine::Result<()> {
        (self.after, self.is_last) = (None, false);
        self.ready.clear();
        Ok(())
    }

    fn next(&mut self, part: &mut Part) -> engine::Result<bool> {
        loop {
            let Some((entry, path, came)) = self.ready.pop_front() else {
                match self.fetch() {
                    Ok(true) => continue,
                    Ok(false) => return Ok(false),
                    Err(error) => {
                        let message = error.to_string();
                        self.failure = Some(error);
                        return Err(engine::Error::new(engine::ErrorKind::Io, message));
                    }
                }
            };
            let is_good = match came {
                Ok(came) => self.accept(&entry, &path, &came, part)?,
                // An object that is not there cannot be waited for: its batch is baked again
                Err(error) if error.status() == Some(404) => false,
                Err(error) => {
                    let message = error.to_string();
                    self.failure = Some(error);
                    return Err(engine::Error::new(engine::ErrorKind::Io, message));
                }
            };
            if is_good {
                return Ok(true);
            }
            self.bad.push(ClaimedBatch { batch: entry.batch, fence: entry.fence });
            if self.bad.len() == BAD_PARTS_MAX {
                return Err(engine::Error::new(engine::ErrorKind::Corrupt, "too many parts are damaged"));
            }
        }
    }
}
