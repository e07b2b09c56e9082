//! What of a merged stream is for the eye: its preview and a picture of it, beside the stream. A bake without them is a
//! bake all the same, so that neither can make a merge fail.

use std::path::Path;

use engine::preview::write_preview;
use engine::relight::{
    Environment, RelightOptions, Sky, Viewpoint, find_attribute, noted, noted_attribute, relight,
};
use engine::stream::MicrogridStream;
use engine::stream::file::MgsReader;

use super::Work;
use crate::{Error, Result, digest};

/// Width and height of the picture.
const PICTURE: [u32; 2] = [640, 360];

/// What was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct ForTheEye {
    pub preview: bool,
    pub picture: bool,
}

/// Makes and puts preview and picture of the stream `target`, which lies in storage under `key`.
///
/// # Errors
/// When they cannot be put, or the work is cancelled.
pub(super) fn make(work: Work<'_>, memory_bytes: u64, target: &Path, key: &str) -> Result<ForTheEye> {
    let (preview, picture) = (target.with_extension("preview"), target.with_extension("png"));
    let made = ForTheEye {
        preview: is_made("preview", work, make_preview(work, memory_bytes, target, &preview))?,
        picture: is_made("picture", work, make_picture(work, target, &picture))?,
    };
    let put = |path: &Path, ending: &str| {
        let key = format!("{}.{ending}", key.strip_suffix(".mgs").unwrap_or(key));
        work.depot.write(&key, path, &digest::of_file(path)?)
    };
    if made.preview {
        put(&preview, "preview")?;
    }
    if made.picture {
        put(&picture, "png")?;
    }
    Ok(made)
}

/// Whether something was made; only a cancelled work is an error.
fn is_made(what: &str, work: Work<'_>, made: engine::Result<()>) -> Result<bool> {
    if work.control.cancel.load(std::sync::atomic::Ordering::Relaxed) {
        return Err(Error::Engine(engine::Error::new(
            engine::ErrorKind::Cancelled,
            "the merge was cancelled",
        )));
    }
    if let Err(error) = &made {
        tracing::warn!("the job has no {what}: {error}");
    }
    Ok(made.is_ok())
}

fn make_preview(work: Work<'_>, memory_bytes: u64, target: &Path, path: &Path) -> engine::Result<()> {
    let mut stream = MgsReader::open(target)?;
    let mut progress = |done: f64| work.control.progress.update("preview", done, "");
    write_preview(&mut stream, path, memory_bytes, &mut progress).map(|_| ())
}

/// The stream under a clear sky, from where all of it is in view.
fn make_picture(work: Work<'_>, target: &Path, path: &Path) -> engine::Result<()> {
    let mut stream = MgsReader::open(target)?;
    let mut options = RelightOptions::new(Environment::sky(Sky::Clear, None)?);
    options.viewpoint = Viewpoint::Automatic(PICTURE);
    let column = find_attribute(stream.schema(), noted_attribute(stream.metadata()))?;
    let name = stream.schema().attributes[column].name.clone();
    (options.weight, options.domain) = noted(stream.metadata(), &name);
    options.attribute = Some(name);
    let mut progress = |done: f64| work.control.progress.update("picture", done, "");
    relight(&mut stream, &options, &mut progress)?.save(path)
}
