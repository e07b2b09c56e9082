//! `pantaray import`: meshes, points and streams become one microgrid stream.

use std::path::{Path, PathBuf};

use clap::Args;
use engine::bake::Control;
use engine::dice::Rate;
use engine::import::{
    EXTENSIONS, Expected, ImportOptions, ImportReport, Part, Parts, Step, import_parts, is_importable,
};
use engine::scene::{Camera, Dice, Edge};
use engine::stream::MicrogridStream;
use engine::stream::adapt::{Concat, Convert};
use engine::stream::file::MgsReader;
use engine::{Error, Result};
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched, check};
use crate::{figures, values};

/// Import files as one microgrid stream
///
/// USD, glTF and .mgs files are converted to the units and the up axis asked for; PLY and OBJ files say neither and
/// are taken as they are.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The files: .usd .usda .usdc .usdz .ply .obj .gltf .glb .mgs
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
    /// The time code at which USD is read [default: its default values]
    #[arg(long, value_name = "N", value_parser = values::finite, allow_negative_numbers = true)]
    frame: Option<f64>,
    /// Dice faces, and subdivision surfaces on their limit, to edges of SIZE units, or of PIXELS (1) pixels of a camera;
    /// leaves along their texture to edges of N (2) texels
    #[arg(long, value_name = "world:SIZE|camera:NAME[:PIXELS][,texels:N]")]
    dice: Option<String>,
    /// Micropolygons that the leaves of a file may become
    #[arg(long, value_name = "N", default_value_t = 1 << 28, value_parser = clap::value_parser!(u64).range(1..))]
    leaves_max: u64,
    /// The scene file whose camera `--dice` names
    #[arg(long, value_name = "SCENE", requires = "dice")]
    scene: Option<PathBuf>,
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
    let Arguments { inputs, output, space, memory, frame, dice, leaves_max, scene } = arguments;
    let dice = dice.map(|dice| Dice::parse(&dice)).transpose()?.unwrap_or_default();
    let options = ImportOptions {
        meters_per_unit: space.units,
        up: space.up.into(),
        memory_bytes: memory,
        frame,
        dice: Rate::of(&dice, &cameras(&dice, scene.as_deref())?)?,
        texels: dice.texels,
        leaves_max,
        ..ImportOptions::default()
    };
    let inputs = import_all(&inputs, &output, &options, console.control())?;
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

/// The cameras of the scene, if one is needed to dice.
fn cameras(dice: &Dice, scene: Option<&Path>) -> Result<Vec<Camera>> {
    match (&dice.edge, scene) {
        (Some(Edge::Camera { .. }), Some(scene)) => Ok(engine::scene::load(scene)?.cameras),
        (Some(Edge::Camera { .. }), None) => {
            Err(Error::invalid("no scene says where the camera stands").hint("name one: `--scene SCENE`"))
        }
        _ => Ok(Vec::new()),
    }
}

/// Imports each file beside the output, then joins what there is.
fn import_all(
    inputs: &[PathBuf],
    output: &Path,
    options: &ImportOptions,
    control: Control<'_>,
) -> Result<Vec<Input>> {
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = tempfile::Builder::new().prefix(".import-").tempdir_in(parent);
    let scratch = scratch.map_err(|error| Error::io("create a folder in", parent, error))?;
    let (mut found, mut all) = (Vec::with_capacity(inputs.len()), Vec::with_capacity(inputs.len()));
    for (number, path) in inputs.iter().enumerate() {
        if !is_importable(path) {
            found.push(Input::of_stream(path)?);
            let metadata = MgsReader::open(path)?.metadata().to_vec();
            all.push(Parts { parts: vec![Part { file: path.clone(), copies: None }], metadata });
            continue;
        }
        control.progress.update("import", 0.0, &path.to_string_lossy());
        let target = scratch.path().join(format!("{number}.mgs"));
        let mut watch = |step| {
            if let Step::Begin(expected) = step {
                control.progress.update("import", 0.0, &describe(path, &expected));
            }
            check(control)
        };
        let (parts, report) = import_parts(path, &target, options, &mut watch)?;
        let ImportReport { grids, micropolygons, vertices, skipped, warnings, .. } = report;
        found.push(Input { path: path.into(), grids, micropolygons, vertices, skipped, warnings });
        all.push(parts);
    }

    // A file that became one stream is the output; any other is copied
    match &all[..] {
        [Parts { parts, .. }] if matches!(&parts[..], [Part { file, copies: None }] if file.starts_with(scratch.path())) =>
        {
            let from = &parts[0].file;
            std::fs::rename(from, output).map_err(|error| Error::io("rename to", output, error))?;
        }
        _ => join(&all, output, options, control)?,
    }
    Ok(found)
}

/// What is about to be read.
fn describe(path: &Path, expected: &Expected) -> String {
    let mut text = format!("{}: needs {} of memory", path.display(), figures::bytes(expected.memory_bytes));
    if expected.leaves > 0 {
        text += &format!(", leaves become {} micropolygons", figures::count(expected.leaves));
    }
    text
}

/// Writes all streams one after the other.
fn join(all: &[Parts], output: &Path, options: &ImportOptions, control: Control<'_>) -> Result<()> {
    let open = |parts: &Parts| -> Result<Box<dyn MicrogridStream>> {
        Ok(Box::new(Convert::to_units(parts.open()?, options.meters_per_unit, options.up)?))
    };
    let joined = Concat::new(all.iter().map(open).collect::<Result<_>>()?)?;
    // What files say about themselves may not hold for several together
    let metadata = if let [only] = all { &only.metadata[..] } else { &[] };
    streams::copy(&mut Watched::new(joined, "write", control), output, metadata)?;
    Ok(())
}

impl Input {
    /// A file that is a stream already.
    fn of_stream(path: &Path) -> Result<Self> {
        if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mgs")) {
            return Err(Error::unsupported("this is not a format that can be imported").at(path).hint(
                format!(
                    "files of these names are read: {} .mgs",
                    EXTENSIONS.map(|e| format!(".{e}")).join(" ")
                ),
            ));
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
