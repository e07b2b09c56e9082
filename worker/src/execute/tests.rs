//! Every pass of a job by hand-made claims, with a folder for the farm's storage.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

use engine::bake::{BakeOptions, Control, Quiet};
use engine::scene::Roots;
use protocol::job::BakeSettings;
use protocol::storage::{FolderFile, SceneFiles};
use protocol::work::{Claim, ClaimedBatch, PartEntry, PartPage, PassResult, Task};
use protocol::{FailureClass, PassKind, keys};

use super::{Baked, Executor, PartSink, Work};
use crate::cache::Cache;
use crate::depot::{Depot, Wanted};
use crate::{Error, Result, digest};

const SCENE: &str = r#"<scene version="1" units="m" up="y">
  <shaders>
    <shader name="occlusion" type="sh_occlusion">
      <param name="samples" value="64"/>
    </shader>
  </shaders>
  <geometries>
    <geometry name="hill" occluder="true">
      <stream procedural="terrain" seed="7" micropolygons="60000"/>
      <bakeset name="hill"> <attribute name="sh" shader="occlusion"/> </bakeset>
    </geometry>
    <geometry name="tent" occluder="true">
      <stream file="models/tent.obj"/>
      <bakeset name="tent" occluders="tent"> <attribute name="sh" shader="occlusion"/> </bakeset>
    </geometry>
  </geometries>
</scene>"#;
const TENT: &str = "v -1 0 -1\nv 1 0 -1\nv 0 2 0\nv -1 0 1\nv 1 0 1\nf 1 2 3\nf 4 3 5\nf 1 3 4\n";

/// The farm's storage as a folder.
#[derive(Debug)]
struct FolderDepot {
    root: PathBuf,
    /// Committed parts, pages of two.
    parts: Mutex<Vec<PartEntry>>,
    /// Ranges that were read.
    ranges: Mutex<u64>,
}

impl Depot for FolderDepot {
    fn scene(&self) -> Result<SceneFiles> {
        let sha256 = digest::of_bytes(TENT.as_bytes()).sha256;
        Ok(SceneFiles { scene: SCENE.into(), files: [("models/tent.obj".into(), sha256)].into() })
    }

    fn read(&self, wanted: &[Wanted]) -> Vec<Result<FolderFile>> {
        let copy = |wanted: &Wanted| {
            let from = self.root.join(&wanted.key);
            let io = |error| engine::Error::io("read", &from, error);
            let bytes = std::fs::read(&from).map_err(io)?;
            assert!(bytes.len() as u64 <= wanted.bytes_max);
            std::fs::write(&wanted.path, &bytes).map_err(io)?;
            Ok(digest::of_bytes(&bytes))
        };
        wanted.iter().map(copy).collect()
    }

    fn read_range(&self, key: &str, offset: u64, out: &mut [u8]) -> Result<()> {
        let bytes = std::fs::read(self.root.join(key)).unwrap();
        out.copy_from_slice(&bytes[offset as usize..][..out.len()]);
        *self.ranges.lock().unwrap() += 1;
        Ok(())
    }

    fn write(&self, key: &str, path: &Path, content: &FolderFile) -> Result<()> {
        let to = self.root.join(key);
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        assert_eq!(digest::of_file(path)?, *content, "{key}");
        std::fs::copy(path, to).unwrap();
        Ok(())
    }

    fn parts(&self, after: Option<i64>) -> Result<PartPage> {
        let parts = self.parts.lock().unwrap();
        let mut rest = parts.iter().filter(|part| after.is_none_or(|after| part.batch > after)).cloned();
        let page: Vec<_> = rest.by_ref().take(2).collect();
        let next = rest.next().map(|_| page[1].batch);
        Ok(PartPage { parts: page, next })
    }
}

/// Commits parts as the coordinator would.
struct Committer<'a> {
    depot: &'a FolderDepot,
    job: String,
    pass: i64,
}

impl PartSink for Committer<'_> {
    fn part(
        &mut self,
        batch: ClaimedBatch,
        Baked { bytes, log, device, traced, .. }: Baked<'_>,
    ) -> Result<bool> {
        assert!(log.starts_with("traced "));
        // 16 rays or more for each point, and what it asked of the arena
        assert_eq!((device, traced.batches), ("cpu", 1));
        assert!(traced.rays >= 16 * traced.points && traced.trace_us > 0, "{traced:?}");
        assert!(traced.brick_requests >= traced.brick_misses, "{traced:?}");
        assert_eq!(traced.brick_misses == 0, traced.read_bytes == 0, "{traced:?}");
        let content = digest::of_bytes(bytes);
        let key = keys::part(&self.job, self.pass, batch.batch, batch.fence, &content.sha256);
        let path = self.depot.root.join(key);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
        let ClaimedBatch { batch, fence } = batch;
        let mut parts = self.depot.parts.lock().unwrap();
        parts.retain(|part| part.batch != batch);
        parts.push(PartEntry { batch, fence, sha256: content.sha256, bytes: content.bytes as i64 });
        parts.sort_by_key(|part| part.batch);
        Ok(true)
    }
}

/// A farm of one executor at a time.
struct Farm {
    depot: Arc<FolderDepot>,
    executor: Executor,
    folder: tempfile::TempDir,
    pass: i64,
    /// Whether the cache of the executor that bakes is too small for the brick map.
    is_small: bool,
}

fn machine() -> BakeOptions {
    BakeOptions { memory_bytes: 256 << 20, threads: 2, ..BakeOptions::default() }
}

fn task(kind: PassKind) -> Task {
    let (job, settings) = ("job".into(), BakeSettings::default());
    Task { kind, job, settings, set: None, map: None, inputs: None, plan: None, parts: None, partial: false }
}

impl Farm {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let depot = FolderDepot {
            root: folder.path().join("storage"),
            parts: Mutex::default(),
            ranges: Mutex::default(),
        };
        let depot = Arc::new(depot);
        let asset = depot.root.join(keys::asset(&digest::of_bytes(TENT.as_bytes()).sha256));
        std::fs::create_dir_all(asset.parent().unwrap()).unwrap();
        std::fs::write(asset, TENT).unwrap();
        let executor = executor(&folder.path().join("first"));
        Self { depot, executor, folder, pass: 0, is_small: false }
    }

    /// Executes a pass as one claim of `batches`; where its result is, and what it found out.
    fn pass(&mut self, task: Task, batches: &[i64]) -> Result<(i64, String, Option<PassResult>)> {
        self.pass += 1;
        let claim = Claim {
            lease: "lease".into(),
            ttl_ms: 60_000,
            pass: self.pass,
            segment: 0,
            batches: batches.iter().map(|&batch| ClaimedBatch { batch, fence: 1 }).collect(),
            task,
        };
        let cancel = AtomicBool::new(false);
        let control = Control { progress: &Quiet, cancel: &cancel };
        let depot: Arc<dyn Depot> = self.depot.clone();
        let work = Work { claim: &claim, depot: &depot, control };
        let mut sink = Committer { depot: &self.depot, job: claim.task.job.clone(), pass: self.pass };
        let finished = self.executor.execute(work, &mut sink)?;
        let folder = keys::result_folder(&claim.task.job, self.pass, 1);
        Ok((self.pass, folder, finished.map(|finished| finished.result)))
    }

    /// Takes a job up to the bake of `set`, by two executors that share nothing but storage; the task of its merge.
    fn bake(&mut self, set: &str) -> Task {
        let (_, inputs, result) = self.pass(task(PassKind::Import), &[0]).unwrap();
        let Some(PassResult::Import { sets }) = result else { panic!("{result:?}") };
        let map = sets.iter().find(|found| found.set == set).unwrap().map.clone();
        let with = |kind| Task { inputs: Some(inputs.clone()), ..task(kind) };
        let with = |kind| Task { set: Some(set.into()), map: Some(map.clone()), ..with(kind) };
        self.pass(with(PassKind::Build), &[0]).unwrap();
        self.executor = executor(&self.folder.path().join("second"));
        let (_, plan, result) = self.pass(with(PassKind::Plan), &[0]).unwrap();
        let Some(PassResult::Plan { batches, .. }) = result else { panic!("{result:?}") };
        let with = |kind| Task { plan: Some(plan.clone()), ..with(kind) };
        self.executor = executor(&self.folder.path().join("third"));
        if self.is_small {
            self.executor.whole_map_bytes_max = 0;
        }
        let order: Vec<i64> = (0..batches).rev().collect();
        self.depot.parts.lock().unwrap().clear();
        let (bake, _, _) = self.pass(with(PassKind::Bake), &order).unwrap();
        Task { parts: Some(bake), ..with(PassKind::Merge) }
    }

    fn merged(&mut self, merge: Task) -> Result<Vec<u8>> {
        let name = format!("{}.mgs", merge.set.clone().unwrap());
        let (_, folder, _) = self.pass(merge, &[0])?;
        Ok(std::fs::read(self.depot.root.join(folder).join(name)).unwrap())
    }
}

fn executor(cache: &Path) -> Executor {
    Executor::new(Arc::new(Cache::open(cache, 1 << 30).unwrap()), machine(), Roots::new())
}

/// The stream that one process bakes.
fn baked(set: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("models")).unwrap();
    std::fs::write(folder.path().join("models/tent.obj"), TENT).unwrap();
    std::fs::write(folder.path().join("scene.xml"), SCENE).unwrap();
    let scene = engine::scene::load(&folder.path().join("scene.xml")).unwrap();
    let (cancel, out) = (AtomicBool::new(false), folder.path().join("out"));
    let control = Control { progress: &Quiet, cancel: &cancel };
    engine::bake::bake(&scene, &machine(), &out, control).unwrap();
    std::fs::read(out.join(format!("{set}.mgs"))).unwrap()
}

/// Catches a pass that does something else than its step of `pantaray bake`, and one that leans on another worker's disk.
#[test]
fn passes_give_the_bytes_of_one_process() {
    let mut farm = Farm::new();
    for set in ["hill", "tent"] {
        let merge = farm.bake(set);
        assert!(farm.merged(merge).unwrap() == baked(set), "{set}");
    }
    assert!(farm.depot.parts.lock().unwrap().len() == 1);
}

/// Catches a merge that believes a part whose bytes are not those that were committed, and one that blames the wrong part.
#[test]
fn merges_find_damaged_parts() {
    let mut farm = Farm::new();
    let merge = farm.bake("hill");
    let parts = farm.depot.parts.lock().unwrap().clone();
    assert!(parts.len() > 2, "{} parts", parts.len());
    let entry = &parts[1];
    let key = keys::part("job", merge.parts.unwrap(), entry.batch, entry.fence, &entry.sha256);
    let path = farm.depot.root.join(key);
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let error = farm.merged(merge).unwrap_err();
    assert_eq!(error.class(), FailureClass::Verify);
    assert!(
        matches!(&error, Error::BadParts(bad) if *bad == [ClaimedBatch { batch: 1, fence: 1 }]),
        "{error:?}"
    );
}

/// Catches a worker that fails for ever on a file that went bad on its own disk.
#[test]
fn damaged_files_of_the_local_disk_are_fetched_again() {
    let mut farm = Farm::new();
    let merge = farm.bake("hill");
    let objects = farm.folder.path().join("third/objects");
    let mut damaged = 0;
    for path in crate::depot::files_below(&objects).unwrap() {
        let path = objects.join(path);
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x55;
        std::fs::write(&path, bytes).unwrap();
        damaged += 1;
    }
    assert!(damaged > 3);
    assert!(farm.merged(merge).unwrap() == baked("hill"));
}

/// Catches a bake that needs the whole brick map on the local disk, and a block that stands for another.
#[test]
fn maps_larger_than_the_cache_come_block_by_block() {
    let mut farm = Farm::new();
    farm.is_small = true;
    let merge = farm.bake("hill");
    assert!(*farm.depot.ranges.lock().unwrap() > 0);
    assert!(farm.merged(merge).unwrap() == baked("hill"));
}
