//! An imported file on disk: what stands once in one microgrid file, each prototype in one of its own.
//!
//! A forest stays as small as its prototypes, and streams as large as it is.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::assembly::{Assembly, SavedScopes};
use super::{Copies, Expected, GridSink, ImportOptions, ImportReport, import};
use crate::stream::adapt::{Concat, Instance};
use crate::stream::file::{MgsReader, MgsWriter};
use crate::stream::{Microgrid, MicrogridStream, Schema};
use crate::{Error, ErrorKind, Result};

/// One file of an import.
#[derive(Clone, Debug)]
pub struct Part {
    /// The microgrids.
    pub file: PathBuf,
    /// Where they stand; none where they stand once, as they are.
    pub copies: Option<Copies>,
}

/// The files of an import, in order.
#[derive(Clone, Debug, Default)]
pub struct Parts {
    /// What stands once first, then the prototypes.
    pub parts: Vec<Part>,
    /// What the imported file says about itself.
    pub metadata: Vec<(String, String)>,
}

/// [`Parts`] as they are kept beside the files.
#[derive(Debug, Serialize, Deserialize)]
pub struct SavedParts {
    /// Relative to a folder where they lie below it. Prototypes have their scope and the number of their copies.
    files: Vec<(PathBuf, Option<(u32, u64)>)>,
    scopes: SavedScopes,
    metadata: Vec<(String, String)>,
}

impl Parts {
    /// What [`load`](Self::load) needs, with files below `folder` named from there.
    pub fn save(&self, folder: &Path) -> SavedParts {
        let relative = |file: &PathBuf| file.strip_prefix(folder).unwrap_or(file).to_path_buf();
        let copies = |part: &Part| part.copies.as_ref().map(Copies::key);
        let files = self.parts.iter().map(|part| (relative(&part.file), copies(part))).collect();
        let assembly = self.parts.iter().find_map(|part| part.copies.as_ref()).map(Copies::assembly);
        let scopes = assembly.map(Assembly::save).unwrap_or_default();
        SavedParts { files, scopes, metadata: self.metadata.clone() }
    }

    /// The parts that were saved; none if they are damaged.
    pub fn load(saved: SavedParts, folder: &Path) -> Option<Self> {
        let assembly = Arc::new(Assembly::load(saved.scopes)?);
        let part = |(file, key): (PathBuf, Option<(u32, u64)>)| {
            let copies = match key {
                Some((scope, count)) => Some(Copies::checked(&assembly, scope, count)?),
                None => None,
            };
            Some(Part { file: folder.join(file), copies })
        };
        let parts = saved.files.into_iter().map(part).collect::<Option<_>>()?;
        Some(Self { parts, metadata: saved.metadata })
    }

    /// All grids as one stream. Those of prototypes carry `instance`, the number of their copy.
    ///
    /// # Errors
    /// When a file is gone or broken.
    pub fn open(&self) -> Result<Box<dyn MicrogridStream>> {
        let open = |part: &Part| -> Result<Box<dyn MicrogridStream>> {
            let reader = MgsReader::open(&part.file)?;
            Ok(match &part.copies {
                Some(copies) => Box::new(Instance::new(reader, copies.clone())?),
                None => Box::new(reader),
            })
        };
        match &self.parts[..] {
            [only] => open(only),
            parts => Ok(Box::new(Concat::new(parts.iter().map(open).collect::<Result<_>>()?)?)),
        }
    }
}

/// What an import is about to do.
#[derive(Clone, Copy, Debug)]
pub enum Step {
    /// To read a file.
    Begin(Expected),
    /// To write a grid.
    Grid,
}

/// Imports `path` into files beside `target`: `target` itself, and for prototypes the same name with a number before
/// its extension. Calls `watch` before every step; an error that it returns ends the import.
///
/// # Errors
/// As [`import`], and for a file without any geometry; no file stays then.
pub fn import_parts(
    path: &Path,
    target: &Path,
    options: &ImportOptions,
    watch: &mut dyn FnMut(Step) -> Result<()>,
) -> Result<(Parts, ImportReport)> {
    let mut sink =
        PartsSink { target, watch, begun: None, writer: None, next: None, parts: Parts::default() };
    let beside = target.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = options.scratch.clone().or_else(|| Some(beside.to_path_buf()));
    let options = ImportOptions { scratch, ..options.clone() };
    let outcome = import(path, &options, &mut sink).and_then(|report| {
        sink.finish_part()?;
        if !sink.parts.parts.is_empty() {
            return Ok(report);
        }
        let reason = report.skipped.first().map(|(reason, count)| format!("left out {count}: {reason}"));
        let error = Error::invalid("the file holds no geometry").at(path);
        Err(reason.into_iter().fold(error, Error::hint))
    });
    match outcome {
        Ok(report) => Ok((sink.parts, report)),
        Err(error) => {
            // Files of a stream that is not whole would be taken for results
            sink.parts.parts.iter().for_each(|part| _ = std::fs::remove_file(&part.file));
            Err(error)
        }
    }
}

struct PartsSink<'a> {
    target: &'a Path,
    watch: &'a mut dyn FnMut(Step) -> Result<()>,
    begun: Option<(Schema, Vec<(String, String)>)>,
    /// The part that is being written; it begins with its first grid.
    writer: Option<(MgsWriter, PathBuf)>,
    /// How the grids of that part are placed.
    next: Option<Copies>,
    parts: Parts,
}

impl PartsSink<'_> {
    fn finish_part(&mut self) -> Result<()> {
        if let Some((writer, file)) = self.writer.take() {
            writer.finish()?;
            self.parts.parts.push(Part { file, copies: self.next.take() });
        }
        Ok(())
    }
}

impl GridSink for PartsSink<'_> {
    fn expect(&mut self, expected: &Expected) -> Result<()> {
        (self.watch)(Step::Begin(*expected))
    }

    fn begin(&mut self, schema: &Schema, metadata: &[(String, String)]) -> Result<()> {
        self.begun = Some((schema.clone(), metadata.to_vec()));
        self.parts.metadata = metadata.to_vec();
        Ok(())
    }

    fn copies(&mut self, copies: &Copies) -> Result<()> {
        self.finish_part()?;
        self.next = Some(copies.clone());
        Ok(())
    }

    fn grid(&mut self, grid: &Microgrid) -> Result<()> {
        (self.watch)(Step::Grid)?;
        if self.writer.is_none() {
            let (schema, metadata) = self
                .begun
                .as_ref()
                .ok_or_else(|| Error::new(ErrorKind::Invalid, "a grid before the schema"))?;
            let file = match self.parts.parts.len() {
                0 => self.target.to_path_buf(),
                number => self.target.with_extension(format!("{number}.mgs")),
            };
            self.writer = Some((MgsWriter::create(&file, schema, metadata)?, file));
        }
        let (writer, _) = self.writer.as_mut().expect("it was opened right above");
        writer.write(grid)
    }
}
