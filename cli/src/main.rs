//! The `pantaray` command: reads the arguments, runs one subcommand, prints its answer or its error.

mod bake;
mod build;
mod compare;
mod console;
mod demo;
mod devices;
mod export;
mod farm;
mod figures;
mod generate;
mod import;
mod inspect;
mod progress;
mod relight;
mod service;
mod signals;
mod streams;
mod values;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use engine::Result;

use console::{Answer, Console, LogFormat};

/// Directional occlusion for film lighting, baked in spherical harmonics from scenes many times larger than memory.
#[derive(Debug, Parser)]
#[command(name = "pantaray", version, propagate_version = true, after_help = AFTER_HELP)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
    /// Print one JSON object on standard output, and nothing else there
    #[arg(long, global = true, help_heading = EVERYWHERE)]
    json: bool,
    /// Show no progress
    #[arg(long, short, global = true, help_heading = EVERYWHERE)]
    quiet: bool,
    /// How log lines are written
    #[arg(long, global = true, value_enum, value_name = "FORMAT", default_value_t, env = "PANTARAY_LOG_FORMAT", help_heading = EVERYWHERE)]
    log_format: LogFormat,
}

/// Heads the options that every subcommand has.
const EVERYWHERE: &str = "With every command";

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
    Worker(farm::worker::Arguments),
    Submit(farm::submit::Arguments),
    Jobs(farm::jobs::Arguments),
    Watch(farm::watch::Arguments),
    /// Cancel a job
    Cancel(farm::control::JobArguments),
    /// Pause a job: nothing more of it is begun
    Pause(farm::control::JobArguments),
    /// Let a paused job go on
    Resume(farm::control::JobArguments),
    Retry(farm::control::RetryArguments),
    Reprioritise(farm::control::ReprioritiseArguments),
    Resubmit(farm::control::ResubmitArguments),
    Workers(farm::jobs::WorkersArguments),
    Logs(farm::logs::Arguments),
    Fetch(farm::fetch::Arguments),
    Delete(farm::gc::DeleteArguments),
    Gc(farm::gc::Arguments),
    /// List, make and change projects
    #[command(subcommand)]
    Project(farm::admin::ProjectCommand),
    Limits(farm::admin::LimitsArguments),
    Audit(farm::admin::AuditArguments),
    Ticket(farm::admin::TicketArguments),
    Enrol(farm::admin::EnrolArguments),
    Serve(service::serve::Arguments),
    Migrate(service::migrate::Arguments),
    Sim(service::sim::Arguments),
    /// Make, list and revoke tokens
    #[command(subcommand)]
    Token(service::token::Command),
}

fn main() -> ExitCode {
    let Arguments { command, json, quiet, log_format } = Arguments::parse();
    let console = Console::new(json, quiet, log_format);
    let result = signals::install(log_format).and_then(|()| run(command, &console, log_format));
    console.finish(result)
}

fn run(command: Command, console: &Console, log_format: LogFormat) -> Result<Answer> {
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
        Command::Devices(arguments) => devices::run(arguments, console),
        Command::Worker(arguments) => farm::worker::run(arguments, console),
        Command::Submit(arguments) => farm::submit::run(arguments, console),
        Command::Jobs(arguments) => farm::jobs::run(arguments, console),
        Command::Watch(arguments) => farm::watch::run(arguments, console),
        Command::Cancel(arguments) => farm::control::run(arguments, "cancel", console),
        Command::Pause(arguments) => farm::control::run(arguments, "pause", console),
        Command::Resume(arguments) => farm::control::run(arguments, "resume", console),
        Command::Retry(arguments) => farm::control::run_retry(arguments, console),
        Command::Reprioritise(arguments) => farm::control::run_reprioritise(arguments),
        Command::Resubmit(arguments) => farm::control::run_resubmit(arguments),
        Command::Workers(arguments) => farm::jobs::run_workers(arguments, console),
        Command::Logs(arguments) => farm::logs::run(arguments, console),
        Command::Fetch(arguments) => farm::fetch::run(arguments, console),
        Command::Delete(arguments) => farm::gc::run_delete(arguments, console),
        Command::Gc(arguments) => farm::gc::run(arguments, console),
        Command::Project(command) => farm::admin::run_project(command),
        Command::Limits(arguments) => farm::admin::run_limits(arguments),
        Command::Audit(arguments) => farm::admin::run_audit(arguments),
        Command::Ticket(arguments) => farm::admin::run_ticket(arguments),
        Command::Enrol(arguments) => farm::admin::run_enrol(arguments),
        Command::Serve(arguments) => service::serve::run(arguments, log_format),
        Command::Migrate(arguments) => service::migrate::run(arguments),
        Command::Sim(arguments) => service::sim::run(&arguments, console),
        Command::Token(command) => service::token::run(command),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    const DOCUMENTATION: &str = include_str!("../../docs/command-line.md");
    const REPORT: &str = include_str!("../../docs/report.md");

    /// Catches arguments that contradict each other, which clap reports only when it runs.
    #[test]
    fn the_grammar_is_sound() {
        super::Arguments::command().debug_assert();
    }

    /// Catches a command or an option that the documentation does not know.
    #[test]
    fn every_option_is_documented() {
        let grammar = super::Arguments::command();
        for command in grammar.get_subcommands() {
            let heading = format!("\n## {}\n", command.get_name());
            let section =
                DOCUMENTATION.split(&heading).nth(1).unwrap_or_else(|| panic!("no section{heading}"));
            let section = section.split("\n## ").next().expect("text");
            for option in command.get_opts().filter(|option| !option.is_hide_set()) {
                let name = format!("--{}", option.get_long().expect("a long name"));
                assert!(section.contains(&name), "{name} of {}", command.get_name());
            }
        }
    }

    /// Catches a figure of the report that the documentation does not know.
    #[test]
    fn every_figure_is_documented() {
        let report = engine::stats::Report { bake_sets: vec![Default::default()], ..Default::default() };
        let value = serde_json::to_value(report).expect("a report");
        let parts = [&value, &value["brickmap"], &value["bake"], &value["bake_sets"][0]];
        for part in parts {
            for figure in part.as_object().expect("an object").keys() {
                assert!(REPORT.contains(&format!("`{figure}`")), "{figure}");
            }
        }
    }
}
