//! Streams on the command line: opened with a helpful error, watched while they are read, copied to files.

use std::path::Path;
use std::sync::atomic::Ordering;

use engine::bake::Control;
use engine::import::is_importable;
pub use engine::stream::file::StreamCounts;
use engine::stream::file::{MgsReader, MgsWriter};
use engine::stream::{Microgrid, MicrogridStream, Schema};
use engine::{Error, ErrorKind, Result};

/// Grids between two looks at the cancel flag and the progress.
const GRIDS_PER_LOOK: u32 = 256;

/// Opens a `.mgs` file.
pub fn open(path: &Path) -> Result<MgsReader> {
    MgsReader::open(path).map_err(|error| {
        if is_importable(path) && error.kind() != ErrorKind::NotFound {
            error.hint("this is no microgrid stream; `pantaray import` makes one of it")
        } else {
            error
        }
    })
}

/// Ends work with an error once the user asked to stop.
pub fn check(control: Control<'_>) -> Result<()> {
    match control.cancel.load(Ordering::Relaxed) {
        true => Err(Error::new(ErrorKind::Cancelled, "cancelled")),
        false => Ok(()),
    }
}

/// A stream that reports how far it was read, and ends with an error once the user asked to stop.
pub struct Watched<'a, S> {
    inner: S,
    stage: &'a str,
    control: Control<'a>,
    /// Grids read since the last look.
    grids: u32,
    /// Passes begun, and whether the current one has read anything.
    passes: u32,
    reading: bool,
    label: String,
}

impl<'a, S: MicrogridStream> Watched<'a, S> {
    /// Watches a stream; `stage` says what it is read for.
    pub fn new(inner: S, stage: &'a str, control: Control<'a>) -> Self {
        Self { inner, stage, control, grids: 0, passes: 1, reading: false, label: stage.into() }
    }
}

impl<S: MicrogridStream> MicrogridStream for Watched<'_, S> {
    fn schema(&self) -> &Schema {
        self.inner.schema()
    }

    fn rewind(&mut self) -> Result<()> {
        if std::mem::take(&mut self.reading) {
            self.passes += 1;
            self.label = format!("{}, pass {}", self.stage, self.passes);
        }
        self.inner.rewind()
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        if self.grids == 0 {
            check(self.control)?;
            self.control.progress.update(&self.label, self.inner.progress(), "");
        }
        self.reading = true;
        self.grids = (self.grids + 1) % GRIDS_PER_LOOK;
        self.inner.next(grid)
    }

    fn progress(&self) -> f64 {
        self.inner.progress()
    }
}

/// Writes a stream to a `.mgs` file, which appears when it is complete.
pub fn copy(
    stream: &mut dyn MicrogridStream,
    path: &Path,
    metadata: &[(String, String)],
) -> Result<StreamCounts> {
    let mut writer = MgsWriter::create(path, stream.schema(), metadata)?;
    let mut grid = Microgrid::default();
    while stream.next(&mut grid)? {
        writer.write(&grid)?;
    }
    writer.finish()
}

/// Bytes of a file that was just written.
pub fn file_bytes(path: &Path) -> Result<u64> {
    Ok(std::fs::metadata(path).map_err(|error| Error::io("read", path, error))?.len())
}
