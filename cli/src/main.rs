//! The `pantaray` command: reads the arguments, runs one subcommand, prints its answer or its error.

mod bake;
mod build;
mod compare;
mod console;
mod demo;
mod devices;
mod export;
mod figures;
mod generate;
mod import;
mod inspect;
mod progress;
mod relight;
mod signals;
mod streams;
mod values;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use engine::Result;

use console::{Answer, Console};

/// Directional occlusion for film lighting, baked in spherical harmonics from scenes many times larger than memory.
#[derive(Debug, Parser)]
#[command(name = "pantaray", version, propagate_version = true, after_help = AFTER_HELP)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
    /// Print one JSON object on standard output, and nothing else there
    #[arg(long, global = true)]
    json: bool,
    /// Show no progress
    #[arg(long, short, global = true)]
    quiet: bool,
}

const AFTER_HELP: &str = "\
Exit codes: 0 done, 1 the work failed, 2 wrong usage.
Environment: RUST_LOG sets what is logged (default `warn`), NO_COLOR turns colours off.";

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Arguments),
    Import(import::Arguments),
    Generate(generate::Arguments),
    Build(build::Arguments),
    Bake(bake::Arguments),
    Inspect(inspect::Arguments),
    Compare(compare::Arguments),
    Relight(relight::Arguments),
    Export(export::Arguments),
    Devices(devices::Arguments),
}

fn main() -> ExitCode {
    let Arguments { command, json, quiet } = Arguments::parse();
    let console = Console::new(json, quiet);
    let result = signals::install().and_then(|()| run(command, &console));
    console.finish(result)
}

fn run(command: Command, console: &Console) -> Result<Answer> {
    match command {
        Command::Demo(arguments) => demo::run(arguments, console),
        Command::Import(arguments) => import::run(arguments, console),
        Command::Generate(arguments) => generate::run(arguments, console),
        Command::Build(arguments) => build::run(arguments, console),
        Command::Bake(arguments) => bake::run(arguments, console),
        Command::Inspect(arguments) => inspect::run(arguments, console),
        Command::Compare(arguments) => compare::run(arguments, console),
        Command::Relight(arguments) => relight::run(arguments, console),
        Command::Export(arguments) => export::run(arguments, console),
        Command::Devices(arguments) => devices::run(arguments),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    /// Catches arguments that contradict each other, which clap reports only when it runs.
    #[test]
    fn the_grammar_is_sound() {
        super::Arguments::command().debug_assert();
    }
}
