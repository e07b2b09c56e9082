//! A scene's inputs as streams: files are imported once into the bake folder, instances expanded as they stream.

use std::path::{Path, PathBuf};

use glam::DMat4;
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::Xxh3;

use super::folder::write_atomically;
use crate::import::{GridSink, ImportOptions, ImportReport, import, is_importable};
use crate::scene::instances::InstanceReader;
use crate::scene::{Geometry, Instances, Scene, StreamSource};
use crate::stream::adapt::{Concat, Convert, Instance, MatrixSource};
use crate::stream::file::{MgsReader, MgsWriter};
use crate::stream::procedural::ProceduralStream;
use crate::stream::{Microgrid, MicrogridStream, Schema};
use crate::{Error, Result};

/// A scene whose files are all microgrid streams.
#[derive(Debug)]
pub struct Inputs {
    /// Per geometry and stream: the .mgs file to read, none for procedural streams.
    files: Vec<Vec<Option<PathBuf>>>,
    /// Per geometry, a hash of everything its stream's bytes depend on.
    pub identities: Vec<u128>,
    /// What the imports reported.
    pub reports: Vec<(PathBuf, ImportReport)>,
}

/// [`Inputs`] as they are kept beside what was imported.
#[derive(Serialize, Deserialize)]
struct Saved {
    version: u32,
    /// Relative to the folder where they were imported into it.
    files: Vec<Vec<Option<PathBuf>>>,
    /// In hexadecimal.
    identities: Vec<String>,
}

const SAVED_FILE: &str = "inputs.json";
const SAVED_VERSION: u32 = 1;

impl Inputs {
    /// Imports the files of `scene` that are no microgrid streams into `folder`, and hashes everything.
    ///
    /// # Errors
    /// When a file is broken or cannot be read.
    pub fn prepare(
        scene: &Scene,
        folder: &Path,
        memory_bytes: u64,
        progress: &mut dyn FnMut(f64) -> Result<()>,
    ) -> Result<Self> {
        let options = ImportOptions { meters_per_unit: scene.meters_per_unit, up: scene.up, memory_bytes };
        let total: usize = scene.geometries.iter().map(|geometry| geometry.streams.len()).sum();
        let mut inputs = Self { files: Vec::new(), identities: Vec::new(), reports: Vec::new() };
        let mut imported: Vec<(PathBuf, PathBuf)> = Vec::new();
        let mut done = 0;
        for geometry in &scene.geometries {
            let mut hash = Xxh3::new();
            hash.update(&scene.meters_per_unit.to_le_bytes());
            hash.update(&[scene.up as u8]);
            let mut files = Vec::new();
            for source in &geometry.streams {
                progress(done as f64 / total as f64)?;
                done += 1;
                let file = match source {
                    StreamSource::Procedural(parameters) => {
                        hash.update(format!("{parameters:?}").as_bytes());
                        hash.update(env!("CARGO_PKG_VERSION").as_bytes());
                        files.push(None);
                        continue;
                    }
                    StreamSource::File(path) if !is_importable(path) => path.clone(),
                    StreamSource::File(path) => match imported.iter().find(|(from, _)| from == path) {
                        Some((_, to)) => to.clone(),
                        None => {
                            let to = folder.join(format!("{}.mgs", imported.len()));
                            inputs.reports.push((path.clone(), import_file(path, &to, &options)?));
                            imported.push((path.clone(), to.clone()));
                            to
                        }
                    },
                };
                hash_file(&file, &mut hash)?;
                files.push(Some(file));
            }
            for instances in &geometry.instances {
                match instances {
                    Instances::Matrix(matrix) => hash.update(bytemuck::cast_slice(&matrix.to_cols_array())),
                    Instances::File(path) => hash_file(path, &mut hash)?,
                }
            }
            inputs.files.push(files);
            inputs.identities.push(hash.digest128());
        }
        Ok(inputs)
    }

    /// Leaves a record in `folder`, into which the files were imported, for [`load`](Self::load).
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let relative = |file: &PathBuf| file.strip_prefix(folder).unwrap_or(file).to_path_buf();
        let files = self.files.iter().map(|files| files.iter().map(|f| f.as_ref().map(relative)).collect());
        let identities = self.identities.iter().map(|identity| format!("{identity:032x}"));
        let saved =
            Saved { version: SAVED_VERSION, files: files.collect(), identities: identities.collect() };
        let json = serde_json::to_vec(&saved).map_err(|e| Error::invalid(e.to_string()))?;
        write_atomically(&folder.join(SAVED_FILE), &json)
    }

    /// The inputs of `scene` as [`save`](Self::save) left them in `folder`, without importing again.
    ///
    /// # Errors
    /// When there is no record, or it is not one of this scene.
    pub fn load(scene: &Scene, folder: &Path) -> Result<Self> {
        let path = folder.join(SAVED_FILE);
        let bytes = std::fs::read(&path).map_err(|error| Error::io("read", &path, error))?;
        let damaged = || Error::corrupt(&path, 0, "this is not a record of the scene's imported inputs");
        let saved: Saved = serde_json::from_slice(&bytes).map_err(|error| damaged().caused_by(error))?;
        let identities = saved.identities.iter().map(|text| u128::from_str_radix(text, 16));
        let identities = identities.collect::<Result<Vec<_>, _>>().map_err(|_| damaged())?;
        let counts = scene.geometries.iter().map(|geometry| geometry.streams.len());
        if saved.version != SAVED_VERSION
            || identities.len() != saved.files.len()
            || !counts.eq(saved.files.iter().map(Vec::len))
        {
            return Err(damaged());
        }
        let absolute = |file: PathBuf| folder.join(file);
        let files = saved.files.into_iter().map(|files| files.into_iter().map(|f| f.map(absolute)).collect());
        Ok(Self { files: files.collect(), identities, reports: Vec::new() })
    }

    /// The stream of a geometry in the scene's units and axes, instances expanded.
    ///
    /// # Errors
    /// When a file cannot be opened.
    pub fn open(&self, scene: &Scene, geometry: usize) -> Result<Box<dyn MicrogridStream>> {
        let Geometry { streams, instances, .. } = &scene.geometries[geometry];
        let mut opened: Vec<Box<dyn MicrogridStream>> = Vec::with_capacity(streams.len());
        for (source, file) in streams.iter().zip(&self.files[geometry]) {
            opened.push(match (source, file) {
                (StreamSource::Procedural(parameters), _) => {
                    Box::new(ProceduralStream::new(parameters, scene.meters_per_unit, scene.up)?)
                }
                (_, Some(file)) => {
                    Box::new(Convert::to_units(MgsReader::open(file)?, scene.meters_per_unit, scene.up)?)
                }
                (StreamSource::File(path), None) => {
                    return Err(Error::invalid("the file was not imported").at(path));
                }
            });
        }
        let stream = match opened.len() {
            1 => opened.remove(0),
            _ => Box::new(Concat::new(opened)?),
        };
        if instances.is_empty() {
            return Ok(stream);
        }
        Ok(Box::new(Instance::new(stream, Matrices::new(instances))?))
    }
}

/// Imports one file into a microgrid stream beside nothing else: the target appears when it is complete.
///
/// # Errors
/// See [`import`].
pub fn import_file(path: &Path, target: &Path, options: &ImportOptions) -> Result<ImportReport> {
    let mut sink = FileSink { target, writer: None };
    let report = import(path, options, &mut sink)?;
    match sink.writer {
        Some(writer) if report.grids > 0 => writer.finish()?,
        _ => return Err(Error::invalid("the file holds no geometry").at(path)),
    };
    Ok(report)
}

/// Writes imported grids to a microgrid stream.
struct FileSink<'a> {
    target: &'a Path,
    writer: Option<MgsWriter>,
}

impl GridSink for FileSink<'_> {
    fn begin(&mut self, schema: &Schema) -> Result<()> {
        self.writer = Some(MgsWriter::create(self.target, schema, &[])?);
        Ok(())
    }

    fn grid(&mut self, grid: &Microgrid) -> Result<()> {
        self.writer.as_mut().ok_or_else(|| Error::invalid("a grid before the schema"))?.write(grid)
    }
}

/// A geometry's copies as the instance adapter reads them: inline matrices and files, one after the other.
struct Matrices {
    instances: Vec<Instances>,
    next: usize,
    reader: Option<InstanceReader>,
}

impl Matrices {
    fn new(instances: &[Instances]) -> Self {
        Self { instances: instances.to_vec(), next: 0, reader: None }
    }
}

impl MatrixSource for Matrices {
    fn rewind(&mut self) -> Result<()> {
        (self.next, self.reader) = (0, None);
        Ok(())
    }

    fn next(&mut self) -> Result<Option<DMat4>> {
        loop {
            if let Some(reader) = &mut self.reader {
                if let Some(matrix) = reader.next()? {
                    return Ok(Some(matrix));
                }
                self.reader = None;
            }
            let Some(instances) = self.instances.get(self.next) else { return Ok(None) };
            self.next += 1;
            match instances {
                Instances::Matrix(matrix) => return Ok(Some(*matrix)),
                Instances::File(path) => self.reader = Some(InstanceReader::open(path)?),
            }
        }
    }
}

/// Adds a file's content to a hash.
fn hash_file(path: &Path, hash: &mut Xxh3) -> Result<()> {
    use std::io::Read;
    let io = |error| Error::io("read", path, error);
    let mut file = std::fs::File::open(path).map_err(io)?;
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(io)? {
            0 => return Ok(()),
            count => hash.update(&buffer[..count]),
        }
    }
}
