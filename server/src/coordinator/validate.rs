//! Whether a request for a job can be carried out, and what it would ask of the farm: before anything is stored.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use engine::bake::set::require_sets;
use engine::brickmap::FarField;
use engine::cut::Lod;
use engine::scene::{Roots, Scene, StreamSource, load_confined};
use protocol::job::{BakeSettings, Estimate, JobRequest, SetEstimate};
use protocol::{keys, limits};

use super::{Coordinator, estimate};
use crate::error::Kind;
use crate::{Error, Result};

impl Coordinator {
    /// Checks a request in full; its frames, or none where it is one job without a frame of its own.
    pub(super) async fn check(&self, request: &JobRequest) -> Result<Vec<Option<i64>>> {
        check_words(request)?;
        let frames = frames(request)?;
        let hashes: BTreeSet<&String> = request.files.values().collect();
        let hashes: Vec<String> = hashes.into_iter().cloned().collect();
        let missing = self.store.missing_assets(&request.project, &hashes).await?;
        if let Some(first) = missing.first() {
            let message = format!("{} files are not uploaded, the first is `{first}`", missing.len());
            return Err(Error::new(Kind::Conflict, message)
                .hint("ask `POST /v1/assets/missing`, then `PUT /v1/assets/{sha256}`"));
        }
        let read: Vec<Option<i64>> = frames.iter().map(|frame| frame.or(request.settings.frame)).collect();
        self.read_scene(request, read).await?;
        Ok(frames)
    }

    /// What a request would ask of the farm; nothing is stored.
    ///
    /// # Errors
    /// As a submission.
    pub async fn estimate(&self, request: &JobRequest) -> Result<Estimate> {
        let frames = self.check(request).await?;
        let frame = frames.first().copied().flatten().or(request.settings.frame);
        let (sets, root_bytes) = self.read_scene(request, vec![frame]).await?;
        let hashes: BTreeSet<&String> = request.files.values().collect();
        let hashes: Vec<String> = hashes.into_iter().cloned().collect();
        let asset_bytes = self.store.asset_bytes(&request.project, &hashes).await?;
        let input_bytes = root_bytes + asset_bytes.unsigned_abs();
        Ok(estimate::total(sets, input_bytes, self.store.recent_batch_ms().await?))
    }

    /// Reads the scene once for each frame; what the last one's bake sets ask for, and the bytes of its files below asset
    /// roots.
    async fn read_scene(
        &self,
        request: &JobRequest,
        frames: Vec<Option<i64>>,
    ) -> Result<(Vec<SetEstimate>, u64)> {
        let (request, roots) = (request.clone(), self.settings.roots.clone());
        let read = tokio::task::spawn_blocking(move || read_frames(&request, &frames, &roots));
        read.await.map_err(|error| {
            tracing::error!(%error, "a scene could not be read");
            Error::new(Kind::Internal, "the scene could not be read")
        })?
    }
}

fn check_words(request: &JobRequest) -> Result<()> {
    let says = |what: &str, text: &str| {
        let short = text.len() <= 1_000 && !text.chars().any(char::is_control);
        if short {
            Ok(())
        } else {
            Err(Error::invalid(format!("the {what} is too long, or has control characters")))
        }
    };
    if request.name.trim().is_empty() || request.name.len() > limits::NAME_BYTES_MAX {
        let message = format!(
            "the name has `{}` bytes, 1 to {} are possible",
            request.name.len(),
            limits::NAME_BYTES_MAX
        );
        return Err(Error::invalid(message));
    }
    says("name", &request.name)?;
    says("comment", &request.comment)?;
    [&request.show, &request.sequence, &request.shot].into_iter().try_for_each(|name| says("shot", name))?;
    if !(0..=100).contains(&request.priority) {
        return Err(Error::invalid(format!("priority `{}`, from 0 to 100 is possible", request.priority)));
    }
    if request.running_max.is_some_and(|max| max < 1) || request.failed_max < 0 {
        return Err(Error::invalid("`running_max` is 1 or more, `failed_max` is not negative"));
    }
    if request.requires.len() > limits::LABELS_MAX || !request.requires.iter().all(|l| limits::is_name(l)) {
        return Err(Error::invalid("a label of `requires` is not possible"));
    }
    if request.depends_on.len() > limits::PAGE_MAX as usize {
        return Err(Error::invalid(format!("`depends_on` names more than {} jobs", limits::PAGE_MAX)));
    }
    if request.files.len() > limits::FILES_MAX {
        return Err(Error::invalid(format!("the scene has more than {} files", limits::FILES_MAX)));
    }
    for (path, sha256) in &request.files {
        if !keys::is_relative(path) || path == "scene.xml" || !keys::is_sha256(sha256) {
            return Err(Error::invalid(format!("the file `{path}` or its hash `{sha256}` is not possible")));
        }
    }
    check_settings(&request.settings)
}

fn check_settings(settings: &BakeSettings) -> Result<()> {
    let refuse = |error: engine::Error| Error::invalid(error.to_string());
    settings.lod.as_deref().map(Lod::parse).transpose().map_err(refuse)?;
    settings.far_field.as_deref().map(str::parse::<FarField>).transpose().map_err(Error::invalid)?;
    match settings.samples {
        Some(samples) if !(16..=65_536).contains(&samples) => {
            Err(Error::invalid(format!("samples `{samples}`, from 16 to 65536 are possible")))
        }
        _ => Ok(()),
    }
}

fn frames(request: &JobRequest) -> Result<Vec<Option<i64>>> {
    let Some((first, last)) = request.frames else { return Ok(vec![None]) };
    match last.checked_sub(first) {
        Some(span) if (0..limits::FRAMES_MAX).contains(&span) => Ok((first..=last).map(Some).collect()),
        _ => Err(Error::invalid(format!(
            "frames `{first}` to `{last}`: 1 to {} are possible",
            limits::FRAMES_MAX
        ))),
    }
}

/// The scene in an empty folder with the names of its files: what they hold is for workers to read.
fn lay_out(request: &JobRequest) -> Result<(tempfile::TempDir, PathBuf)> {
    let folder = tempfile::tempdir()?;
    for path in request.files.keys() {
        let path = folder.path().join(path);
        let place = |()| std::fs::File::create_new(&path).map(drop);
        // Two files of which one would lie below the other
        std::fs::create_dir_all(path.parent().unwrap_or(folder.path())).and_then(place).map_err(|error| {
            tracing::debug!(%error, "files of a scene");
            Error::invalid("the files of the scene cannot lie in one folder")
        })?;
    }
    let path = folder.path().join("scene.xml");
    std::fs::write(&path, &request.scene)?;
    Ok((folder, path))
}

/// A scene without what its files hold.
///
/// # Errors
/// When it cannot be read, which it could when it was submitted.
pub(super) fn scene_of(request: &JobRequest, frame: Option<i64>, roots: &Roots) -> Result<Scene> {
    let (folder, path) = lay_out(request)?;
    load_confined(&path, frame, roots).map_err(|error| refused(&error, folder.path()))
}

/// Reads a scene once for each frame.
fn read_frames(
    request: &JobRequest,
    frames: &[Option<i64>],
    roots: &Roots,
) -> Result<(Vec<SetEstimate>, u64)> {
    let (folder, path) = lay_out(request)?;
    let mut found = (Vec::new(), 0);
    for &frame in frames {
        let read = load_confined(&path, frame, roots).and_then(|scene| require_sets(&scene).map(|()| scene));
        let scene = read.map_err(|error| refused(&error, folder.path()))?;
        let sets = estimate::sets(&scene, &request.settings, folder.path());
        found = (sets, root_bytes(&scene, folder.path()));
    }
    Ok(found)
}

/// The engine's error as the submitter's: without the folder in which the scene was read.
fn refused(error: &engine::Error, folder: &Path) -> Error {
    let folder = format!("{}/", folder.display());
    let refused = Error::invalid(error.to_string().replace(&folder, ""));
    match error.hint_text() {
        Some(hint) => refused.hint(hint.replace(&folder, "")),
        None => refused,
    }
}

fn root_bytes(scene: &Scene, folder: &Path) -> u64 {
    let streams = scene.geometries.iter().flat_map(|geometry| &geometry.streams);
    let paths: BTreeSet<&PathBuf> = streams
        .filter_map(|stream| match stream {
            StreamSource::File(path, _) if !path.starts_with(folder) => Some(path),
            _ => None,
        })
        .collect();
    paths.into_iter().filter_map(|path| path.metadata().ok()).map(|metadata| metadata.len()).sum()
}
