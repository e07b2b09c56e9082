//! `pantaray export`: a stream for other programs.

use std::path::PathBuf;

use clap::Args;
use engine::Result;
use engine::output::export::{ExportOptions, ExportReport, export};
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched};
use crate::{figures, values};

/// Export a stream to other programs: binary PLY, USD, or EXR for meshes with texture coordinates
///
/// PLY: vertices carry `x y z nx ny nz` and a float `NAME_i` for every component of every attribute. USD: points with
/// primvars, or with `--over` primvars on the prims that the stream was imported from. EXR: a layer `NAME_i` for every
/// component of what was baked, drawn over the texture coordinates.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The stream, .mgs
    #[arg(value_name = "IN.mgs")]
    input: PathBuf,
    /// The file to write: .ply .usd .usda .exr
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// USD: overs on the prims of the asset, to be sublayered above it
    #[arg(long)]
    over: bool,
    /// EXR: the attribute of texture coordinates
    #[arg(long, value_name = "NAME", default_value = "st")]
    uv: String,
    /// EXR: pixels across and down
    #[arg(long, value_name = "WxH", default_value = "1024x1024", value_parser = values::resolution)]
    size: [u32; 2],
    /// Memory that a USD or EXR file may take; PLY streams
    #[arg(long, value_name = "SIZE", default_value = "4GiB", value_parser = values::size)]
    memory: u64,
}

/// What was written.
#[derive(Debug, Serialize)]
struct Exported {
    output: PathBuf,
    #[serde(flatten)]
    report: ExportReport,
}

/// Exports and says how much.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let Arguments { input, output, over, uv, size, memory } = arguments;
    let reader = streams::open(&input)?;
    let metadata = reader.metadata().to_vec();
    let mut stream = Watched::new(reader, "export", console.control());
    let options =
        ExportOptions { over, uv: &uv, resolution: size, memory_bytes: memory, metadata: &metadata };
    let report = export(&mut stream, &output, &options)?;
    let ExportReport { vertices, faces, lines, points, bytes, left_out, points_without, .. } = report;
    let kinds = [(vertices, "vertices"), (faces, "faces"), (lines, "lines"), (points, "points")];
    let kinds = kinds
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, kind)| format!("{} {kind}", figures::count(*count)));
    let text =
        format!("{}: {}, {}", output.display(), kinds.collect::<Vec<_>>().join(", "), figures::bytes(bytes));
    let mut text = text;
    if left_out > 0 {
        text.push_str(&format!(
            "\nleft out {left_out}: vertices of prototypes, or faces outside of the picture"
        ));
    }
    if points_without > 0 {
        text.push_str(&format!("\n{points_without} points that no face uses are zero"));
    }
    Answer::new(&Exported { output, report }, text)
}
