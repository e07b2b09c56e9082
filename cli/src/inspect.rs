//! `pantaray inspect`: what a stream, a brick map or a bake's folder holds.

use std::path::{Path, PathBuf};

use clap::Args;
use engine::brickmap::{BrickMap, Manifest};
use engine::output::inspect::{SummaryBounds, inspect_stream};
use engine::stats::Report;
use engine::stream::file::{Footer, MgsReader};
use engine::stream::{Attribute, MicrogridStream};
use engine::{Error, ErrorKind, Result};
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched};
use crate::{bake, figures};

/// Say what a stream (.mgs), a brick map's folder or a bake's folder holds
#[derive(Debug, Args)]
pub struct Arguments {
    /// The file or folder
    path: PathBuf,
    /// Read only a stream's header and footer: counts and bounds, but no ranges and means of attributes
    #[arg(long)]
    fast: bool,
}

/// Inspects whatever is there.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let Arguments { path, fast } = arguments;
    if path.is_dir() {
        return inspect_folder(&path);
    }
    let reader = streams::open(&path)?;
    let about = describe_file(&reader)?;
    if fast {
        let summary = FastSummary::of(&reader)?;
        return Answer::new(&summary, about + &summary.describe());
    }
    let summary = inspect_stream(&mut Watched::new(reader, "inspect", console.control()))?;
    Answer::new(&summary, about + &summary.to_string())
}

/// What the footer and the metadata of a stream say beyond its summary.
fn describe_file(reader: &MgsReader) -> Result<String> {
    let Footer { faces_by_arity: [points, lines, triangles, quads], blocks, .. } = reader.footer()?;
    let kinds = [(points, "points"), (lines, "lines"), (triangles, "triangles"), (quads, "quads")];
    let kinds = kinds.iter().filter(|(count, _)| *count > 0).map(|(count, kind)| format!("{count} {kind}"));
    let mut text = format!("file           {}, {blocks} blocks\n", figures::bytes(reader.file_bytes()));
    text.push_str(&format!("faces          {}\n", kinds.collect::<Vec<_>>().join(", ")));
    for (key, value) in reader.metadata() {
        text.push_str(&format!("{:14} {}\n", key.escape_debug(), value.escape_debug()));
    }
    Ok(text)
}

/// What is known of a stream without reading it.
#[derive(Debug, Serialize)]
struct FastSummary {
    grids: u64,
    micropolygons: u64,
    vertices: u64,
    bounds: SummaryBounds,
    attributes: Vec<FastAttribute>,
}

#[derive(Debug, Serialize)]
struct FastAttribute {
    name: String,
    #[serde(rename = "type")]
    value_type: engine::stream::ValueType,
    components: u16,
}

impl FastSummary {
    fn of(reader: &MgsReader) -> Result<Self> {
        let counts = reader.footer()?.counts;
        let attribute = |Attribute { name, value_type, components, .. }: &Attribute| FastAttribute {
            name: name.clone(),
            value_type: *value_type,
            components: *components,
        };
        Ok(Self {
            grids: counts.grids,
            micropolygons: counts.micropolygons,
            vertices: counts.vertices,
            bounds: counts.bounds.into(),
            attributes: reader.schema().attributes.iter().map(attribute).collect(),
        })
    }

    fn describe(&self) -> String {
        let mut text = format!(
            "grids          {}\nmicropolygons  {}\nvertices       {}\n",
            self.grids, self.micropolygons, self.vertices
        );
        if self.vertices > 0 {
            text.push_str(&format!("bounds         {:?} to {:?}\n", self.bounds.min, self.bounds.max));
        }
        for attribute in &self.attributes {
            let FastAttribute { name, value_type, components } = attribute;
            text.push_str(&format!(
                "attribute      {name}, {} × {components}\n",
                format!("{value_type:?}").to_lowercase()
            ));
        }
        text
    }
}

fn inspect_folder(path: &Path) -> Result<Answer> {
    if path.join("manifest.json").is_file() {
        return inspect_map(path);
    }
    let report = path.join("report.json");
    if report.is_file() {
        return inspect_bake(&report);
    }
    let unfinished = path.join("work").join("bake.json").is_file();
    let message = if unfinished {
        "the bake in this folder is not finished"
    } else {
        "nothing to inspect in this folder"
    };
    let hint = match unfinished {
        true => "run the same `pantaray bake` again to finish it",
        false => "give a stream (.mgs), a brick map's folder or a bake's folder",
    };
    Err(Error::new(ErrorKind::NotFound, message).at(path).hint(hint))
}

/// A brick map in numbers.
#[derive(Debug, Serialize)]
struct MapSummary<'a> {
    #[serde(flatten)]
    manifest: &'a Manifest,
    bytes_per_micropolygon: f64,
    bounds: SummaryBounds,
}

fn inspect_map(path: &Path) -> Result<Answer> {
    let map = BrickMap::open(path)?;
    let manifest = map.manifest();
    let per_micropolygon = |bytes: u64| bytes as f64 / manifest.micropolygons.max(1) as f64;
    let bounds = map.bounds();
    let mut text = format!(
        "micropolygons  {}\ngrids          {}\nbricks         {}\nnodes          {}\nleaves         {}\n",
        manifest.micropolygons, manifest.grids, manifest.bricks, manifest.nodes, manifest.leaves
    );
    text.push_str(&format!(
        "bytes          {} ({:.2} per micropolygon)\nlattice        2^{} units per step\nbounds         {} to {}\n",
        manifest.bytes,
        per_micropolygon(manifest.bytes),
        manifest.lattice_exponent,
        bounds.min,
        bounds.max
    ));
    let summary = MapSummary {
        manifest,
        bytes_per_micropolygon: per_micropolygon(manifest.bytes),
        bounds: bounds.into(),
    };
    Answer::new(&summary, text)
}

fn inspect_bake(path: &Path) -> Result<Answer> {
    let bytes = std::fs::read(path).map_err(|error| Error::io("read", path, error))?;
    let report: Report = serde_json::from_slice(&bytes).map_err(|error| {
        Error::new(ErrorKind::Corrupt, "this is no report of a bake")
            .at_text(path, error.line() as u64, error.column() as u64)
            .caused_by(error)
    })?;
    Answer::new(&report, bake::describe(&report))
}
