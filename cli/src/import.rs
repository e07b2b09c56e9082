//! `pantaray import`: meshes, points and streams become one microgrid stream.

use std::path::{Path, PathBuf};

use clap::Args;
use engine::bake::Control;
use engine::import::{GridSink, ImportOptions, ImportReport, import, is_importable};
use engine::stream::adapt::{Concat, Convert};
use engine::stream::file::{MgsReader, MgsWriter};
use engine::stream::schema::{Schema, UpAxis};
use engine::stream::{Microgrid, MicrogridStream};
use engine::{Error, Result};
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched, check};
use crate::{figures, values};

/// Import files as one microgrid stream
///
/// glTF and .mgs files are converted to the units and the up axis asked for; PLY and OBJ files say neither and are
/// taken as they are.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The files: .ply .obj .gltf .glb .mgs
    #[arg(required = true, value_name = "IN")]
    inputs: Vec<PathBuf>,
    /// The file to write, .mgs
    #[arg(short, long, value_name = "OUT.mgs", value_parser = values::stream_path)]
    output: PathBuf,
    #[command(flatten)]
    space: values::Space,
    /// Memory that a file's mesh may take
    #[arg(long, value_name = "SIZE", default_value = "1GiB", value_parser = values::size)]
    memory: u64,
    /// Known to the design, not to this version.
    #[arg(long, hide = true)]
    dice: Option<String>,
}

/// What was read and written.
#[derive(Debug, Serialize)]
struct Imported {
    output: PathBuf,
    grids: u64,
    micropolygons: u64,
    vertices: u64,
    bytes: u64,
    inputs: Vec<Input>,
}

/// What an input held.
#[derive(Debug, Serialize)]
struct Input {
    path: PathBuf,
    grids: u64,
    micropolygons: u64,
    vertices: u64,
    skipped: Vec<(String, u64)>,
    warnings: Vec<String>,
}

/// Imports and says what was read, left out and written.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let Arguments { inputs, output, space, memory, dice } = arguments;
    if dice.is_some() {
        return Err(Error::unsupported("`--dice` is not supported yet")
            .hint("leave it out: polygons become micropolygons as they are"));
    }
    let options = ImportOptions { meters_per_unit: space.units, up: space.up.into(), memory_bytes: memory };
    let control = console.control();
    let inputs = match &inputs[..] {
        [only] if is_importable(only) => vec![import_one(only, &output, &options, control)?],
        _ => import_all(&inputs, &output, &options, control)?,
    };
    let footer = MgsReader::open(&output)?.footer()?.counts;
    let imported = Imported {
        grids: footer.grids,
        micropolygons: footer.micropolygons,
        vertices: footer.vertices,
        bytes: streams::file_bytes(&output)?,
        inputs,
        output,
    };
    Answer::new(&imported, imported.describe())
}

/// Imports one file to a stream of its own.
fn import_one(path: &Path, target: &Path, options: &ImportOptions, control: Control<'_>) -> Result<Input> {
    control.progress.update("import", 0.0, &path.to_string_lossy());
    let mut sink = FileSink { target, control, writer: None };
    let report = import(path, options, &mut sink)?;
    match sink.writer {
        Some(writer) if report.grids > 0 => writer.finish()?,
        _ => {
            let reason = report.skipped.first().map(|(reason, count)| format!("left out {count}: {reason}"));
            let error = Error::invalid("the file holds no geometry").at(path);
            return Err(reason.into_iter().fold(error, Error::hint));
        }
    };
    let ImportReport { grids, micropolygons, vertices, skipped, warnings, .. } = report;
    Ok(Input { path: path.into(), grids, micropolygons, vertices, skipped, warnings })
}

/// Imports each file beside the output, then joins them.
fn import_all(
    inputs: &[PathBuf],
    output: &Path,
    options: &ImportOptions,
    control: Control<'_>,
) -> Result<Vec<Input>> {
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = tempfile::Builder::new().prefix(".import-").tempdir_in(parent);
    let scratch = scratch.map_err(|error| Error::io("create a folder in", parent, error))?;
    let mut parts: Vec<Box<dyn MicrogridStream>> = Vec::with_capacity(inputs.len());
    let mut found = Vec::with_capacity(inputs.len());
    for (number, path) in inputs.iter().enumerate() {
        check(control)?;
        let part = scratch.path().join(format!("{number}.mgs"));
        let stream = if is_importable(path) {
            found.push(import_one(path, &part, options, control)?);
            &part
        } else {
            found.push(Input::of_stream(path)?);
            path
        };
        parts.push(converted(stream, options.meters_per_unit, options.up)?);
    }
    let joined = Concat::new(parts)?;
    streams::copy(&mut Watched::new(joined, "write", control), output, &[])?;
    Ok(found)
}

fn converted(path: &Path, meters_per_unit: f64, up: UpAxis) -> Result<Box<dyn MicrogridStream>> {
    Ok(Box::new(Convert::to_units(MgsReader::open(path)?, meters_per_unit, up)?))
}

impl Input {
    /// A file that is a stream already.
    fn of_stream(path: &Path) -> Result<Self> {
        if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mgs")) {
            return Err(Error::unsupported("this is not a format that can be imported")
                .at(path)
                .hint("files of these names are read: .ply .obj .gltf .glb .mgs"));
        }
        let counts = MgsReader::open(path)?.footer()?.counts;
        Ok(Self {
            path: path.into(),
            grids: counts.grids,
            micropolygons: counts.micropolygons,
            vertices: counts.vertices,
            skipped: Vec::new(),
            warnings: Vec::new(),
        })
    }
}

impl Imported {
    fn describe(&self) -> String {
        let mut lines = vec![format!(
            "{}: {} micropolygons, {} vertices in {} grids, {}",
            self.output.display(),
            figures::count(self.micropolygons),
            figures::count(self.vertices),
            figures::count(self.grids),
            figures::bytes(self.bytes)
        )];
        for input in &self.inputs {
            let path = input.path.display();
            lines.extend(
                input.skipped.iter().map(|(reason, count)| format!("{path}: left out {count}: {reason}")),
            );
            lines.extend(input.warnings.iter().map(|warning| format!("{path}: {warning}")));
        }
        lines.join("\n")
    }
}

/// Writes imported grids to a stream, which appears when it is complete.
struct FileSink<'a> {
    target: &'a Path,
    control: Control<'a>,
    writer: Option<MgsWriter>,
}

impl GridSink for FileSink<'_> {
    fn begin(&mut self, schema: &Schema) -> Result<()> {
        self.writer = Some(MgsWriter::create(self.target, schema, &[])?);
        Ok(())
    }

    fn grid(&mut self, grid: &Microgrid) -> Result<()> {
        check(self.control)?;
        self.writer.as_mut().ok_or_else(|| Error::invalid("a grid before the schema"))?.write(grid)
    }
}
