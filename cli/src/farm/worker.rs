//! `pantaray worker`: this machine bakes for the farm.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use engine::Result;
use engine::bake::BakeOptions;
use engine::trace::Device;
use worker::run::{Options, run as work};

use super::{Connection, pair};
use crate::bake::Resources;
use crate::console::{Answer, Console};
use crate::{figures, signals, values};

/// Bake for the farm until stopped: the first signal gives the batch at hand some time and the others back
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    connection: Connection,
    /// The worker's name, unique on the farm [default: the host's name]
    #[arg(long)]
    name: Option<String>,
    /// What the worker is and has, for jobs that ask for it
    #[arg(long, value_name = "LABEL")]
    label: Vec<String>,
    /// The folder of the local cache, finished parts and work in progress; one for each worker
    #[arg(long, value_name = "DIR", default_value = "pantaray-worker")]
    cache: PathBuf,
    /// Bytes that the cache keeps of scenes, streams, plans and brick maps
    #[arg(long, value_name = "SIZE", default_value = "20GiB", value_parser = values::size)]
    cache_size: u64,
    /// Bytes of finished parts that may wait for the coordinator
    #[arg(long, value_name = "SIZE", default_value = "1GiB", value_parser = values::size)]
    spool_size: u64,
    /// An asset root: scenes name files below DIR as `root:NAME/path`
    #[arg(long, value_name = "NAME=DIR", value_parser = pair)]
    root: Vec<(String, PathBuf)>,
    /// Seconds that the batch at hand gets when the worker is stopped
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    grace: u64,
    /// What traces, as for `bake`
    #[arg(long, default_value = "auto", value_parser = str::parse::<Device>)]
    device: Device,
    #[command(flatten)]
    resources: Resources,
}

/// Works until it is stopped.
pub fn run(arguments: Arguments, _console: &Console) -> Result<Answer> {
    let options = Options {
        client: arguments.connection.client()?,
        name: arguments.name.unwrap_or_else(host_name),
        labels: with_device(arguments.label, arguments.device)?,
        cache: arguments.cache,
        cache_bytes: arguments.cache_size,
        spool_bytes: arguments.spool_size,
        roots: arguments.root.into_iter().collect(),
        machine: BakeOptions { device: arguments.device, ..arguments.resources.options() },
        grace: Duration::from_secs(arguments.grace),
    };
    let summary = work(&options, signals::cancel_flag())?;
    let text = format!(
        "{} batches finished in {} claims, {} failed, {} given back",
        figures::count(summary.batches),
        figures::count(summary.claims),
        figures::count(summary.failed),
        figures::count(summary.given_back)
    );
    Answer::new(&summary, text)
}

/// The labels, and one that names what traces here: results of the same are compared to the byte.
fn with_device(mut labels: Vec<String>, device: Device) -> Result<Vec<String>> {
    if !labels.iter().any(|label| label.starts_with("device=")) {
        labels.push(format!("device={}", device_name(device)?));
    }
    Ok(labels)
}

#[cfg(feature = "gpu")]
fn device_name(device: Device) -> Result<String> {
    let adapters = engine::trace::gpu::choose(device)?.adapters;
    let names: Vec<&str> = adapters.iter().map(|adapter| adapter.name.as_str()).collect();
    let plain = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c } else { '_' };
    Ok(match names.join("+") {
        names if names.is_empty() => "cpu".into(),
        names => names.chars().map(plain).take(80).collect(),
    })
}

#[cfg(not(feature = "gpu"))]
fn device_name(_device: Device) -> Result<String> {
    Ok("cpu".into())
}

/// The host's name, or one that says that it has none.
pub(super) fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    match name.trim() {
        "" => "unnamed".into(),
        name => name.into(),
    }
}
