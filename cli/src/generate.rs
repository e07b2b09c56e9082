//! `pantaray generate`: a procedural scene as a stream.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use engine::Result;
use engine::scene::{Procedural, ProceduralKind};
use engine::stream::procedural::ProceduralStream;
use serde::Serialize;

use crate::console::{Answer, Console};
use crate::streams::{self, Watched};
use crate::{figures, values};

/// Generate a procedural scene as a microgrid stream
#[derive(Debug, Args)]
pub struct Arguments {
    /// What to make
    kind: Kind,
    /// The file to write, .mgs
    #[arg(short, long, value_name = "OUT.mgs", value_parser = values::stream_path)]
    output: PathBuf,
    /// About how many micropolygons
    #[arg(long, value_name = "N", default_value = "1M", value_parser = values::count)]
    micropolygons: u64,
    /// The same seed gives the same bytes
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    space: values::Space,
}

/// A generator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Plants of several species scattered on terrain, around a clearing
    Jungle,
    /// A meadow
    Grass,
    /// Bare ground
    Terrain,
}

impl From<Kind> for ProceduralKind {
    fn from(kind: Kind) -> Self {
        match kind {
            Kind::Jungle => Self::Jungle,
            Kind::Grass => Self::Grass,
            Kind::Terrain => Self::Terrain,
        }
    }
}

/// What was written.
#[derive(Debug, Serialize)]
struct Generated {
    output: PathBuf,
    grids: u64,
    micropolygons: u64,
    vertices: u64,
    bytes: u64,
}

/// Generates and says how much.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let Arguments { kind, output, micropolygons, seed, space } = arguments;
    let parameters = Procedural { kind: kind.into(), seed, micropolygons };
    let stream = ProceduralStream::new(&parameters, space.units, space.up.into())?;
    let counts = streams::copy(&mut Watched::new(stream, "generate", console.control()), &output, &[])?;
    let bytes = streams::file_bytes(&output)?;
    let text = format!(
        "{}: {} micropolygons in {} grids, {}",
        output.display(),
        figures::count(counts.micropolygons),
        figures::count(counts.grids),
        figures::bytes(bytes)
    );
    let streams::StreamCounts { grids, micropolygons, vertices, .. } = counts;
    Answer::new(&Generated { output, grids, micropolygons, vertices, bytes }, text)
}
