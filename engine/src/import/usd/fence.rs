//! The fence around the USD library: its panics and hangs end a prim or a file, not the process.
//!
//! The library reads in a thread of its own with a stack of its own. A panic there is caught and becomes an error. Every
//! answer is waited for, but not for ever: a thread that stays silent is left alone and told to stop where it next asks for a file.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Once};
use std::time::Duration;

use super::read::{Geometry, Stage};
use super::walk::Catalogue;
use crate::import::ImportOptions;
use crate::{Error, ErrorKind, Result};

/// Stack of the reading thread: the library descends into nested values and composition by calling itself.
const STACK_BYTES: usize = 256 << 20;

/// The name by which the panic hook knows the reading thread.
const THREAD_NAME: &str = "usd";

/// Ends the reading thread when set.
pub(super) type Stop = Arc<AtomicBool>;

/// The library's side of the fence, seen from outside.
pub(super) struct Reader {
    requests: SyncSender<Request>,
    answers: Receiver<Answer>,
    stop: Stop,
    path: PathBuf,
    patience: Duration,
}

/// A prim by its number in the catalogue, and one of its parts.
type Request = (usize, usize);

enum Answer {
    Catalogue(Result<Box<Catalogue>>),
    Geometry(Result<Box<Geometry>>),
}

impl Reader {
    /// Opens a file and lists what is in it.
    pub fn open(path: &Path, options: &ImportOptions) -> Result<(Self, Catalogue)> {
        silence_panics();
        let (requests, wanted) = sync_channel(1);
        let (answers_in, answers) = sync_channel(1);
        let stop = Stop::default();
        let (file, options_inside, stop_inside) = (path.to_path_buf(), options.clone(), stop.clone());
        let work = move || serve(&file, &options_inside, stop_inside, &wanted, &answers_in);
        std::thread::Builder::new()
            .name(THREAD_NAME.into())
            .stack_size(STACK_BYTES)
            .spawn(work)
            .map_err(|error| Error::io("start a thread to read", path, error))?;
        let patience = Duration::from_secs(options.patience_seconds);
        let reader = Self { requests, answers, stop, path: path.to_path_buf(), patience };
        match reader.answer()? {
            Answer::Catalogue(catalogue) => Ok((reader, *catalogue?)),
            Answer::Geometry(_) => Err(reader.gone()),
        }
    }

    /// Reads a part of the prim of this number in the catalogue.
    pub fn geometry(&self, number: usize, part: usize) -> Result<Geometry> {
        self.requests.send((number, part)).map_err(|_| self.gone())?;
        match self.answer()? {
            Answer::Geometry(geometry) => geometry.map(|geometry| *geometry),
            Answer::Catalogue(_) => Err(self.gone()),
        }
    }

    fn answer(&self) -> Result<Answer> {
        self.answers.recv_timeout(self.patience).map_err(|error| match error {
            RecvTimeoutError::Disconnected => self.gone(),
            RecvTimeoutError::Timeout => Error::new(
                ErrorKind::Limit,
                format!("nothing was read for {} seconds", self.patience.as_secs()),
            )
            .at(&self.path)
            .hint("the file may refer to itself without end; flatten it with `usdcat --flatten`"),
        })
    }

    fn gone(&self) -> Error {
        Error::invalid("reading ended without an answer").at(&self.path)
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// The reading thread: the catalogue, then prims as they are asked for.
fn serve(
    path: &Path,
    options: &ImportOptions,
    stop: Stop,
    wanted: &Receiver<Request>,
    answers: &SyncSender<Answer>,
) {
    let opened = fenced(path, || {
        let stage = Stage::open(path, options, stop)?;
        let catalogue = super::walk::catalogue(&stage)?;
        Ok((stage, Box::new(catalogue)))
    });
    let (stage, catalogue) = match opened {
        Ok(opened) => opened,
        Err(error) => {
            // Nobody listens when the import has ended already
            _ = answers.send(Answer::Catalogue(Err(error)));
            return;
        }
    };
    let (prims, attributes) = (catalogue.prims.clone(), catalogue.attributes.clone());
    if answers.send(Answer::Catalogue(Ok(catalogue))).is_err() {
        return;
    }
    while let Ok((number, part)) = wanted.recv() {
        let geometry = match prims.get(number) {
            Some(prim) => fenced(path, || stage.geometry(prim, part, &attributes).map(Box::new)),
            None => Err(Error::invalid("a prim that is not in the catalogue")),
        };
        if answers.send(Answer::Geometry(geometry)).is_err() {
            return;
        }
    }
}

/// Runs `work`; a panic in it becomes an error.
fn fenced<T>(path: &Path, work: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|cause| match cause.downcast::<Error>() {
        // Thrown by the guard of the files, in the middle of the library
        Ok(error) => Err(*error),
        Err(cause) => {
            let text = cause.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("no reason given");
            let text: String = text.chars().take(200).collect();
            Err(Error::invalid(format!("the layer is broken: {text}")).at(path))
        }
    })
}

/// Keeps the panics of reading threads, which become errors, off standard error.
fn silence_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if std::thread::current().name() != Some(THREAD_NAME) {
                before(info);
            }
        }));
    });
}
