//! A scene's inputs as streams: files are imported once into the bake folder, instances expanded as they stream.

use std::path::{Path, PathBuf};

use glam::DMat4;
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::Xxh3;

use super::folder::write_atomically;
use crate::dice::Rate;
use crate::import::{ImportOptions, ImportReport, Part, Parts, SavedParts, import_parts, is_importable};
use crate::scene::instances::InstanceReader;
use crate::scene::{Dice, Geometry, Instances, Scene, StreamSource};
use crate::stream::MicrogridStream;
use crate::stream::adapt::{Concat, Convert, Instance, MatrixSource};
use crate::stream::file::MgsReader;
use crate::stream::procedural::ProceduralStream;
use crate::{Error, Result};

/// A scene whose files are all microgrid streams.
#[derive(Debug)]
pub struct Inputs {
    /// Per geometry and stream: the .mgs files to read, none for procedural streams.
    files: Vec<Vec<Option<Parts>>>,
    /// Per geometry, a hash of everything its stream's bytes depend on.
    pub identities: Vec<u128>,
    /// What the imports reported.
    pub reports: Vec<(PathBuf, ImportReport)>,
}

/// [`Inputs`] as they are kept beside what was imported.
#[derive(Serialize, Deserialize)]
struct Saved {
    version: u32,
    files: Vec<Vec<Option<SavedParts>>>,
    /// In hexadecimal.
    identities: Vec<String>,
}

const SAVED_FILE: &str = "inputs.json";
const SAVED_VERSION: u32 = 2;

/// Options that dice as a stream asks for.
fn diced(options: &ImportOptions, dice: Option<&Dice>, scene: &Scene) -> Result<ImportOptions> {
    let rate = dice.map(|dice| Rate::of(dice, &scene.cameras)).transpose()?.flatten();
    Ok(ImportOptions { dice: rate, texels: dice.and_then(|dice| dice.texels), ..options.clone() })
}

impl Inputs {
    /// Imports the files of `scene` that are no microgrid streams into `folder`, and takes the identity of everything. Of
    /// microgrid streams only the block headers are read: their checksums stand for the rest, and are compared with it in
    /// the first pass over it.
    ///
    /// # Errors
    /// When a file is broken or cannot be read.
    pub fn prepare(
        scene: &Scene,
        folder: &Path,
        memory_bytes: u64,
        progress: &mut dyn FnMut(f64) -> Result<()>,
    ) -> Result<Self> {
        let options = ImportOptions {
            meters_per_unit: scene.meters_per_unit,
            up: scene.up,
            memory_bytes,
            frame: scene.frame.map(|frame| frame as f64),
            ..ImportOptions::default()
        };
        let total: usize = scene.geometries.iter().map(|geometry| geometry.streams.len()).sum();
        let mut inputs = Self { files: Vec::new(), identities: Vec::new(), reports: Vec::new() };
        let mut imported: Vec<(StreamSource, Parts)> = Vec::new();
        let mut done = 0;
        for geometry in &scene.geometries {
            let mut hash = Xxh3::new();
            hash.update(&scene.meters_per_unit.to_le_bytes());
            hash.update(&[scene.up as u8]);
            let mut files = Vec::new();
            for source in &geometry.streams {
                progress(done as f64 / total as f64)?;
                done += 1;
                let parts = match source {
                    StreamSource::Procedural(parameters) => {
                        hash.update(format!("{parameters:?}").as_bytes());
                        hash.update(env!("CARGO_PKG_VERSION").as_bytes());
                        files.push(None);
                        continue;
                    }
                    StreamSource::File(path, _) if !is_importable(path) => Parts {
                        parts: vec![Part { file: path.clone(), copies: None }],
                        metadata: MgsReader::open(path)?.metadata().to_vec(),
                    },
                    StreamSource::File(path, dice) => {
                        match imported.iter().find(|(from, _)| from == source) {
                            Some((_, parts)) => parts.clone(),
                            None => {
                                let target = folder.join(format!("{}.mgs", imported.len()));
                                let mut watch = |_| progress(done as f64 / total as f64);
                                let options = diced(&options, dice.as_ref(), scene)?;
                                let (parts, report) = import_parts(path, &target, &options, &mut watch)?;
                                inputs.reports.push((path.clone(), report));
                                imported.push((source.clone(), parts.clone()));
                                parts
                            }
                        }
                    }
                };
                hash_parts(&parts, &mut hash)?;
                files.push(Some(parts));
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
        let saved = |parts: &Option<Parts>| parts.as_ref().map(|parts| parts.save(folder));
        let files = self.files.iter().map(|files| files.iter().map(saved).collect());
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
        let parts = |saved: Option<SavedParts>| match saved {
            Some(saved) => Parts::load(saved, folder).map(Some).ok_or_else(damaged),
            None => Ok(None),
        };
        let files = saved.files.into_iter().map(|files| files.into_iter().map(parts).collect());
        Ok(Self { files: files.collect::<Result<_>>()?, identities, reports: Vec::new() })
    }

    /// What a geometry's file says about itself: nothing where it has several, or copies of its own.
    pub fn metadata(&self, scene: &Scene, geometry: usize) -> &[(String, String)] {
        match &self.files[geometry][..] {
            [Some(only)] if scene.geometries[geometry].instances.is_empty() => &only.metadata,
            _ => &[],
        }
    }

    /// The files that a geometry's stream is read from.
    pub fn files<'a>(&'a self, scene: &'a Scene, geometry: usize) -> impl Iterator<Item = &'a Path> {
        let parts = self.files[geometry].iter().flatten().flat_map(|parts| &parts.parts);
        let instances = scene.geometries[geometry].instances.iter().filter_map(|instances| match instances {
            Instances::File(path) => Some(&**path),
            Instances::Matrix(_) => None,
        });
        parts.map(|part| &*part.file).chain(instances)
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
                (_, Some(parts)) => {
                    Box::new(Convert::to_units(parts.open()?, scene.meters_per_unit, scene.up)?)
                }
                (StreamSource::File(path, _), None) => {
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

/// Adds files, and where they stand, to a hash.
fn hash_parts(parts: &Parts, hash: &mut Xxh3) -> Result<()> {
    for Part { file, copies } in &parts.parts {
        hash.update(&MgsReader::open(file)?.identity()?.to_le_bytes());
        if let Some(copies) = copies {
            copies.each_use(|matrix| hash.update(bytemuck::cast_slice(&matrix.to_cols_array())));
        }
    }
    Ok(())
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
