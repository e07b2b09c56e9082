//! `pantaray devices`: what can trace on this machine.

use clap::Args;
use engine::Result;
use engine::brick::lanes::InstructionSet;
use serde::Serialize;

use crate::console::Answer;

/// List what can trace on this machine
#[derive(Debug, Args)]
pub struct Arguments {}

#[derive(Debug, Serialize)]
struct Devices {
    devices: Vec<Device>,
}

/// A device as `bake --device` names it.
#[derive(Debug, Serialize)]
struct Device {
    name: &'static str,
    model: String,
    architecture: &'static str,
    /// Threads that run at once.
    threads: usize,
    /// The inner loops that it can run, the best last.
    instruction_sets: Vec<&'static str>,
    /// The one that `bake` uses.
    instructions: &'static str,
}

/// Lists the devices; there is nothing but the CPU yet.
pub fn run(Arguments {}: Arguments) -> Result<Answer> {
    let mut sets = InstructionSet::available();
    sets.sort();
    let cpu = Device {
        name: "cpu",
        model: cpu_model().unwrap_or_else(|| "unknown".into()),
        architecture: std::env::consts::ARCH,
        threads: std::thread::available_parallelism().map_or(1, usize::from),
        instruction_sets: sets.into_iter().map(InstructionSet::name).collect(),
        instructions: InstructionSet::detect().name(),
    };
    let text = format!(
        "cpu  {} ({}), {} threads, inner loops: {}; `bake` uses {}",
        cpu.model,
        cpu.architecture,
        cpu.threads,
        cpu.instruction_sets.join(" "),
        cpu.instructions
    );
    Answer::new(&Devices { devices: vec![cpu] }, text)
}

/// The processor's name, where Linux says it.
fn cpu_model() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim().to_string())
}
