//! `pantaray fetch`: what a job published comes down, verified.

use std::path::PathBuf;

use clap::Args;
use engine::{Error, ErrorKind, Result};
use protocol::job::Output;
use protocol::keys;

use super::Connection;
use crate::console::{Answer, Console};
use crate::figures;

/// Bring down the streams that a job published, and verify them
#[derive(Debug, Args)]
pub struct Arguments {
    /// The job
    job: String,
    #[command(flatten)]
    connection: Connection,
    /// The folder that they come into; made if it is not there
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

/// Brings everything down that is not there already.
pub fn run(arguments: Arguments, console: &Console) -> Result<Answer> {
    let client = arguments.connection.client()?;
    let manifest = client.manifest(&arguments.job)?;
    let folder = &arguments.output;
    std::fs::create_dir_all(folder).map_err(|error| Error::io("create the folder", folder, error))?;
    let total: u64 = manifest.outputs.iter().map(|output| output.bytes).sum();
    let (mut done, mut lines) = (0, Vec::new());
    for output in &manifest.outputs {
        console.control().progress.update("fetch", done as f64 / total.max(1) as f64, &output.name);
        bring(&client, &arguments, output)?;
        done += output.bytes;
        let holes = output.points - output.baked.min(output.points);
        let note = if holes > 0 {
            format!(", {} points lack a result", figures::count(holes))
        } else {
            String::new()
        };
        lines.push(format!(
            "{} ({}{note})",
            folder.join(&output.name).display(),
            figures::bytes(output.bytes)
        ));
    }
    Answer::new(&manifest, lines.join("\n"))
}

/// Brings one stream down under a temporary name, and gives it its own when its hash is right.
fn bring(client: &worker::client::Client, arguments: &Arguments, output: &Output) -> Result<()> {
    if !keys::is_relative(&output.name) || output.name.contains('/') {
        return Err(Error::invalid(format!("`{}` cannot be the name of a file", output.name.escape_debug())));
    }
    let target = arguments.output.join(&output.name);
    let is_right = |content: &protocol::storage::FolderFile| {
        content.sha256 == output.sha256 && content.bytes == output.bytes
    };
    if target.is_file() && is_right(&worker::digest::of_file(&target)?) {
        return Ok(());
    }
    let temporary = arguments.output.join(format!("{}.part", output.name));
    let url = client.own(&format!("/v1/jobs/{}/outputs/{}", arguments.job, output.name));
    let fetched = client.download(&url, &temporary, output.bytes).map_err(Error::from).and_then(|content| {
        if !is_right(&content) {
            let message = format!("`{}` is not what the job published", output.name);
            return Err(Error::new(ErrorKind::Corrupt, message).hint("fetch it again"));
        }
        let file = std::fs::File::open(&temporary).and_then(|file| file.sync_all());
        file.map_err(|error| Error::io("write", &temporary, error))?;
        std::fs::rename(&temporary, &target).map_err(|error| Error::io("rename to", &target, error))
    });
    if fetched.is_err() {
        let _ = std::fs::remove_file(&temporary);
    }
    fetched
}
