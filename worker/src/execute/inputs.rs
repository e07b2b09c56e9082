//! A job's scene and its imported streams on this machine.
//!
//! ```text
//! scene/scene.xml, scene/…   as submitted
//! roots/NAME                 a link to the asset root of that name
//! import/…, inputs.json      what the import left
//! ```
//!
//! Everything lies below one folder, so what the import recorded holds on any worker, wherever its folder is. A step gets
//! the files of those geometries that it reads; tracing reads none.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use engine::bake::BakeOptions;
use engine::bake::inputs::Inputs;
use engine::bake::map::map_key;
use engine::bake::set::{SetBake, require_sets};
use engine::scene::{Roots, Scene, load_confined};
use protocol::storage::SceneFiles;
use protocol::work::{PassResult, Task};
use protocol::{keys, limits};

use super::{Executor, Finished, Work, set_maps};
use crate::cache::{Entry, Folder};
use crate::depot::{files_below, read_index, write_folder};
use crate::{Error, Result, digest, settings};

/// What the import says about its files.
const RECORD: &str = "inputs.json";

/// Whose geometry a step reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reads {
    /// Nobody's.
    Nothing,
    /// That of the carrier of the task's bake set.
    Carrier,
    /// That of the occluders in the task's brick map.
    Occluders,
}

/// A scene that is imported, and how it is baked.
pub(super) struct Prepared {
    pub scene: Scene,
    pub inputs: Inputs,
    pub options: BakeOptions,
    /// Holds the files.
    _folder: Option<Arc<Folder>>,
}

impl Executor {
    /// Imports a job's scene, and says which brick maps its bake sets need.
    pub(super) fn import(&mut self, work: Work<'_>, folder: &str) -> Result<Finished> {
        let (root, scratch) = (self.cache.scratch()?, self.cache.scratch()?);
        let (root, options) = (root.path(), settings::options(&work.claim.task.settings, &self.machine)?);
        let files = work.depot.scene()?;
        let entries = scene_entries(&files)?;
        self.cache.fetch(&entries, &**work.depot, scratch.path())?;
        self.cache.link(&entries, root)?;
        let scene = self.load_scene(root, &files, options_frame(work))?;
        require_sets(&scene)?;
        let imported = root.join("import");
        make(&imported)?;
        let mut watch = |done: f64| {
            work.control.progress.update("import", done, "");
            match work.control.cancel.load(std::sync::atomic::Ordering::Relaxed) {
                true => Err(engine::Error::new(engine::ErrorKind::Cancelled, "the import was cancelled")),
                false => Ok(()),
            }
        };
        let inputs = Inputs::prepare(&scene, &imported, options.memory_bytes / 2, &mut watch)?;
        inputs.save(root)?;
        let below = files_below(&imported)?;
        let mut paths: Vec<String> = below.iter().map(|path| format!("import/{path}")).collect();
        paths.push(RECORD.into());
        let prepared = Prepared { scene, inputs, options, _folder: None };
        let sets = SetBake::all(&prepared.scene, &prepared.inputs, &prepared.options)?;
        let result = PassResult::Import { sets: set_maps(&sets, &prepared) };
        let (index, content) = write_folder(&**work.depot, folder, root, &paths, scratch.path())?;
        self.keep(root, index.files)?;
        Ok(Finished { content, result })
    }

    /// The scene and inputs of a job that is imported, with the files that the step reads.
    pub(super) fn prepare(&mut self, work: Work<'_>, reads: Reads) -> Result<Prepared> {
        let key = super::need(&work.claim.task.inputs, "inputs")?;
        let files = work.depot.scene()?;
        let mut entries = scene_entries(&files)?;
        let scratch = self.cache.scratch()?;
        let imported = super::entries(key, &read_index(&**work.depot, key, scratch.path())?);
        let is_record = |entry: &Entry| entry.path == RECORD;

        // The record says which geometry has which files
        let record = imported.iter().filter(|entry| is_record(entry)).cloned().collect();
        let (prepared, root) = self.opened(work, &files, &format!("{key}+record"), record)?;
        let geometries = prepared.geometries(&work.claim.task, reads)?;
        if geometries.is_empty() {
            return Ok(prepared);
        }
        let read = geometries.iter().flat_map(|&geometry| prepared.inputs.files(&prepared.scene, geometry));
        let read: BTreeSet<PathBuf> =
            read.filter_map(|path| path.strip_prefix(&root).ok().map(Path::to_path_buf)).collect();
        entries.extend(imported);
        entries.retain(|entry| is_record(entry) || read.contains(Path::new(&entry.path)));
        let name = digest::of_bytes(format!("{geometries:?}").as_bytes()).sha256;
        Ok(self.opened(work, &files, &format!("{key}+{}", &name[..16]), entries)?.0)
    }

    /// The scene and inputs in a folder of these entries, and where that is.
    fn opened(
        &mut self,
        work: Work<'_>,
        files: &SceneFiles,
        name: &str,
        entries: Vec<Entry>,
    ) -> Result<(Prepared, PathBuf)> {
        let options = settings::options(&work.claim.task.settings, &self.machine)?;
        let folder = self.folder(name, entries, &**work.depot)?;
        let root = folder.path().to_path_buf();
        let scene = self.load_scene(&root, files, options_frame(work))?;
        let inputs = Inputs::load(&scene, &root)?;
        Ok((Prepared { scene, inputs, options, _folder: Some(folder) }, root))
    }

    /// Puts the scene's text and the roots beside the scene's files below `root`, and reads the scene. Files that the step
    /// does not read are there by name only.
    fn load_scene(&self, root: &Path, files: &SceneFiles, frame: Option<i64>) -> Result<Scene> {
        let (path, links) = (root.join("scene").join("scene.xml"), root.join("roots"));
        make(&root.join("scene"))?;
        make(&links)?;
        std::fs::write(&path, &files.scene).map_err(|error| engine::Error::io("write", &path, error))?;
        for name in files.files.keys().map(|name| root.join("scene").join(name)).filter(|name| !name.exists())
        {
            make(name.parent().unwrap_or(root))?;
            std::fs::File::create_new(&name).map_err(|error| engine::Error::io("create", &name, error))?;
        }
        let mut roots = Roots::new();
        for (name, target) in &self.roots {
            let link = links.join(name);
            if !link.exists() {
                std::os::unix::fs::symlink(target, &link).map_err(|e| engine::Error::io("link", &link, e))?;
            }
            roots.insert(name.clone(), link);
        }
        Ok(load_confined(&path, frame, &roots)?)
    }
}

impl Prepared {
    /// The geometries that a step reads, by number.
    fn geometries(&self, task: &Task, reads: Reads) -> Result<Vec<usize>> {
        Ok(match reads {
            Reads::Nothing => Vec::new(),
            Reads::Carrier => vec![self.set(task)?.geometry],
            Reads::Occluders => self.occluders(super::need(&task.map, "brick map")?)?,
        })
    }

    /// The geometries in the brick map of this key.
    pub(super) fn occluders(&self, key: &str) -> Result<Vec<usize>> {
        let sets = SetBake::all(&self.scene, &self.inputs, &self.options)?;
        let mut seen = sets.into_iter().map(|set| set.occluders);
        let seen = seen.find(|seen| map_key(&self.inputs, seen, &self.options) == key);
        Ok(seen.ok_or_else(|| {
            engine::Error::invalid(format!("no bake set of the scene needs the brick map `{key}`"))
                .hint("coordinator and worker must be of the same version")
        })?)
    }
}

fn options_frame(work: Work<'_>) -> Option<i64> {
    work.claim.task.settings.frame
}

/// The files beside a scene as objects.
fn scene_entries(files: &SceneFiles) -> Result<Vec<Entry>> {
    if files.files.len() > limits::FILES_MAX {
        return Err(Error::Damaged(format!("the scene has {} files", files.files.len())));
    }
    let mut entries = Vec::with_capacity(files.files.len());
    for (path, sha256) in &files.files {
        if !keys::is_relative(path) || path == "scene.xml" || !keys::is_sha256(sha256) {
            return Err(Error::Damaged(format!("`{path}` cannot be a file beside a scene")));
        }
        let (path, key) = (format!("scene/{path}"), keys::asset(sha256));
        entries.push(Entry { path, key, sha256: sha256.clone(), bytes: None });
    }
    Ok(entries)
}

fn make(path: &Path) -> engine::Result<()> {
    std::fs::create_dir_all(path).map_err(|error| engine::Error::io("create the folder", path, error))
}
