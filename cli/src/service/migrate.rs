//! `pantaray migrate`: the schema is brought up to date before a coordinator of a new version starts.

use std::path::Path;

use clap::Args;
use engine::Result;
use serde_json::json;
use server::db::Store;

use super::{Place, block_on};
use crate::console::Answer;

/// Make the database's schema, or bring it up to date; `serve` does this by itself, too
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    place: Place,
    /// Say which version it has and which is wanted, and change nothing
    #[arg(long)]
    dry_run: bool,
}

/// Takes the steps that are missing.
pub fn run(arguments: Arguments) -> Result<Answer> {
    let Arguments { place, dry_run } = arguments;
    let database = place.database();
    match database.strip_prefix("sqlite:") {
        // To open a file that is not there would make it
        Some(path) if dry_run && !Path::new(path).exists() => return told(None, dry_run),
        _ if dry_run => {}
        _ => place.make()?,
    }
    let found = block_on(async move {
        let store = Store::open(&database, 2).await?;
        let found = store.schema_version().await?;
        if !dry_run {
            store.migrate().await?;
        }
        store.driver().close().await;
        Ok(found)
    })?;
    told(found, dry_run)
}

fn told(found: Option<i64>, dry_run: bool) -> Result<Answer> {
    let wanted = Store::SCHEMA_VERSION;
    let text = match (found.unwrap_or(0), dry_run) {
        (found, _) if found == wanted => format!("the schema has version {wanted} already"),
        (0, true) => format!("there is no schema yet, version {wanted} would be made"),
        (found, true) => format!("the schema has version {found}, {wanted} is wanted"),
        (0, false) => format!("the schema was made, version {wanted}"),
        (found, false) => format!("the schema had version {found} and has version {wanted} now"),
    };
    let changed = !dry_run && found != Some(wanted);
    Answer::new(&json!({ "found": found, "wanted": wanted, "changed": changed }), text)
}
