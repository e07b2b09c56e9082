//! `pantaray export`: a stream for other programs.

use std::path::PathBuf;

use clap::Args;
use engine::Result;
use engine::output::export::{ExportReport, export};
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::figures;
use crate::streams::{self, Watched};

/// Export a stream to other programs: binary PLY
///
/// Vertices carry `x y z nx ny nz` and a float `NAME_i` for every component of every attribute.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The stream, .mgs
    #[arg(value_name = "IN.mgs")]
    input: PathBuf,
    /// The file to write, .ply
    #[arg(short, long, value_name = "OUT.ply")]
    output: PathBuf,
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
    let Arguments { input, output } = arguments;
    let mut stream = Watched::new(streams::open(&input)?, "export", console.control());
    let report = export(&mut stream, &output)?;
    let ExportReport { vertices, faces, lines, points, bytes, .. } = report;
    let kinds = [(vertices, "vertices"), (faces, "faces"), (lines, "lines"), (points, "points")];
    let kinds = kinds
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, kind)| format!("{} {kind}", figures::count(*count)));
    let text =
        format!("{}: {}, {}", output.display(), kinds.collect::<Vec<_>>().join(", "), figures::bytes(bytes));
    Answer::new(&Exported { output, report }, text)
}
