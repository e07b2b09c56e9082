//! `pantaray sim`: the coordinator before a farm of fake workers.

use std::sync::atomic::Ordering;

use clap::Args;
use engine::{Error, ErrorKind, Result};
use serde_json::json;
use sim::process::Launch;
use sim::scenario::{self, ALL, LARGE, Scenario, Size};

use crate::console::{Answer, Console};
use crate::signals;

/// Try the coordinator on a farm of fake workers, and say what came of it
#[derive(Debug, Args)]
pub struct Arguments {
    /// Exit with 1 if a figure is not as wanted, or anything contradicts itself
    #[arg(long)]
    verify: bool,
    /// Only this scenario; may be repeated [default: all but those of a large farm's size]
    #[arg(long, value_name = "NAME", value_parser = named)]
    scenario: Vec<&'static Scenario>,
    /// Repeats the workers' choices
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Workers
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(2..=10_000))]
    workers: u32,
    /// Seconds that are looked at where a scenario goes on and on
    #[arg(long, value_name = "SECONDS", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=600))]
    window: u32,
    /// A database on a PostgreSQL server, on which each scenario makes one of its own [default: SQLite files]
    #[arg(long, value_name = "URL")]
    database: Option<String>,
}

fn named(name: &str) -> Result<&'static Scenario, String> {
    let names = || ALL.iter().chain(LARGE).map(|scenario| scenario.name).collect::<Vec<_>>().join(", ");
    scenario::named(name).ok_or_else(|| format!("expected one of {}", names()))
}

/// Runs scenarios, one after the other.
pub fn run(arguments: &Arguments, console: &Console) -> Result<Answer> {
    let chosen: Vec<&Scenario> =
        if arguments.scenario.is_empty() { ALL.iter().collect() } else { arguments.scenario.clone() };
    let program = std::env::current_exe().map_err(|error| {
        Error::new(ErrorKind::Io, "this program cannot be started again").caused_by(error)
    })?;
    let launch = Launch { program, arguments: vec!["serve".into()] };
    let size = Size { workers: arguments.workers as usize, window_s: f64::from(arguments.window) };
    let mut outcomes = Vec::new();
    for (number, chosen_one) in chosen.iter().enumerate() {
        if signals::cancel_flag().load(Ordering::Relaxed) {
            return Err(Error::new(ErrorKind::Cancelled, "stopped"));
        }
        let control = console.control();
        control.progress.update("simulate", number as f64 / chosen.len() as f64, chosen_one.name);
        let outcome =
            scenario::run(chosen_one, &launch, arguments.database.as_deref(), arguments.seed, &size)?;
        eprintln!("{}", outcome.text());
        outcomes.push(outcome);
    }
    let failed: Vec<&str> = outcomes.iter().filter(|o| !o.passed).map(|o| o.scenario).collect();
    let text = format!("{} of {} scenarios pass", outcomes.len() - failed.len(), outcomes.len());
    let seed = arguments.seed;
    let answer = Answer::new(&json!({ "seed": seed, "workers": size.workers, "scenarios": outcomes }), text)?;
    if arguments.verify && !failed.is_empty() {
        console.show(&answer)?;
        return Err(Error::invalid(format!("not as wanted: {}", failed.join(", "))));
    }
    Ok(answer)
}
