//! What a USD file may make the library read: files by count, size, nesting and classes, looked at before the library sees them.

use std::cell::{Cell, RefCell};
use std::io::{self, Cursor, Read, Seek};
use std::panic::resume_unwind;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::atomic::Ordering;

use openusd::ar::{Asset, DefaultResolver, ResolvedPath, Resolver, split_package_relative_path_outer};

use super::arcs::ClassArcs;
use super::fence::Stop;
use super::{binary, package};
use crate::{Error, ErrorKind};

/// Files that one import may open.
const FILES_MAX: u32 = 65_536;

/// Times that paths may be looked up: each arc of composition looks up its target, so this bounds composition.
const LOOKUPS_MAX: u64 = 20_000_000;

/// Brackets that may be open at once in a text layer: the library's parser calls itself for each.
const NESTING_MAX: u32 = 1024;

/// A resolver that counts, and refuses what is beyond its limits.
pub(super) struct Guard {
    inner: DefaultResolver,
    path: PathBuf,
    bytes_left: Rc<Cell<u64>>,
    files: Cell<u32>,
    lookups: Cell<u64>,
    stop: Stop,
    classes: RefCell<ClassArcs>,
    memory_bytes: u64,
}

impl Guard {
    /// A guard for the import of `path`, which may read `bytes_max` bytes of layers.
    pub fn new(path: PathBuf, bytes_max: u64, stop: Stop) -> Self {
        let inner = DefaultResolver::new();
        Self {
            inner,
            path,
            bytes_left: Rc::new(Cell::new(bytes_max)),
            files: Cell::new(0),
            lookups: Cell::new(0),
            stop,
            classes: RefCell::default(),
            memory_bytes: bytes_max,
        }
    }

    /// The bytes of layers that may still be read, at any time.
    pub fn bytes_left(&self) -> Rc<Cell<u64>> {
        self.bytes_left.clone()
    }

    fn count_lookup(&self) {
        self.lookups.set(self.lookups.get() + 1);
        if self.stop.load(Ordering::Relaxed) {
            throw(Error::new(ErrorKind::Cancelled, "the import has ended"));
        }
        if self.lookups.get() > LOOKUPS_MAX {
            let message = format!("more than {LOOKUPS_MAX} references to follow");
            throw(Error::new(ErrorKind::Limit, message).at(&self.path));
        }
    }

    /// Takes a file of `bytes` from what may be read.
    fn take(&self, path: &ResolvedPath, bytes: u64) {
        self.files.set(self.files.get() + 1);
        if self.files.get() > FILES_MAX {
            throw(Error::new(ErrorKind::Limit, format!("more than {FILES_MAX} layers")).at(&self.path));
        }
        match self.bytes_left.get().checked_sub(bytes) {
            Some(left) => self.bytes_left.set(left),
            None => throw(
                Error::new(
                    ErrorKind::Limit,
                    format!(
                        "a layer of {} MiB is more than the memory allowed has left",
                        bytes.div_ceil(1 << 20)
                    ),
                )
                .at(path)
                .hint("allow more memory (`--memory`), or cut the file into parts"),
            ),
        }
    }
}

/// Unwinds to the fence with an error. The library would turn an error it knows of into a layer that is not there.
fn throw(error: Error) -> ! {
    resume_unwind(Box::new(error))
}

impl Resolver for Guard {
    fn create_identifier(&self, asset_path: &str, anchor: Option<&ResolvedPath>) -> String {
        self.count_lookup();
        self.inner.create_identifier(asset_path, anchor)
    }

    fn resolve(&self, asset_path: &str) -> Option<ResolvedPath> {
        self.count_lookup();
        self.inner.resolve(asset_path)
    }

    fn resolve_for_new_asset(&self, asset_path: &str) -> Option<ResolvedPath> {
        self.inner.resolve_for_new_asset(asset_path)
    }

    fn open_asset(&self, resolved_path: &ResolvedPath) -> io::Result<Box<dyn Asset>> {
        if let Some((package, _)) = split_package_relative_path_outer(&resolved_path.to_string())
            && let Err(reason) = package::check(Path::new(&package))
        {
            throw(Error::new(ErrorKind::Unsupported, reason).at(&package));
        }
        let mut asset = self.inner.open_asset(resolved_path)?;
        self.take(resolved_path, asset.size()?);
        let mut bytes = Vec::new();
        asset.rewind()?;
        asset.read_to_end(&mut bytes)?;
        let checked = match bytes.starts_with(b"PXR-USDC") {
            true => binary::check(&bytes, self.memory_bytes),
            false => check_text(&bytes),
        };
        let in_order = || self.classes.borrow_mut().add_layer(&bytes);
        if let Some(reason) = checked.is_ok().then(in_order).and_then(Result::err) {
            throw(Error::new(ErrorKind::Limit, reason).at(resolved_path));
        }
        match checked {
            Ok(()) => Ok(Box::new(Cursor::new(bytes))),
            Err(reason) => Err(io::Error::new(io::ErrorKind::InvalidData, reason)),
        }
    }

    fn identity(&self) -> String {
        self.inner.identity()
    }
}

/// Refuses text that nests deeper than the library's parser has stack for.
fn check_text(bytes: &[u8]) -> Result<(), String> {
    let (mut depth, mut deepest, mut quote) = (0_u32, 0, None);
    let mut rest = bytes.iter().copied();
    while let Some(byte) = rest.next() {
        match (byte, quote) {
            (b'\\', Some(_)) => _ = rest.next(),
            (byte, Some(open)) if byte == open || byte == b'\n' => quote = None,
            (_, Some(_)) => {}
            (b'"' | b'\'', None) => quote = Some(byte),
            (b'{' | b'[' | b'(', None) => (depth, deepest) = (depth + 1, deepest.max(depth + 1)),
            (b'}' | b']' | b')', None) => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    if deepest > NESTING_MAX {
        return Err(format!("brackets nested {deepest} deep, at most {NESTING_MAX} are read"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches nesting that would overflow the stack, and brackets in strings that count.
    #[test]
    fn deep_text_is_refused() {
        assert!(check_text("[".repeat(2000).as_bytes()).is_err());
        assert!(check_text("[]".repeat(2000).as_bytes()).is_ok());
        assert!(check_text(format!("\"{}\"", "[".repeat(2000)).as_bytes()).is_ok());
        assert!(check_text(format!("\"\\\"{}\"", "[".repeat(2000)).as_bytes()).is_ok());
    }
}
