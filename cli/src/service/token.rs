//! `pantaray token`: who may do what.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use engine::{Error, Result};
use protocol::Role;
use protocol::admin::{Secret, TokenRequest};
use serde_json::json;
use server::clock::Clock;
use server::db::Store;

use super::{Place, block_on, write_secret};
use crate::console::Answer;
use crate::farm::Connection;

/// What to do with tokens
#[derive(Debug, Subcommand)]
pub enum Command {
    Create(CreateArguments),
    /// List all tokens, without their secrets
    List(Connection),
    Revoke(RevokeArguments),
}

/// Make a token; its secret is shown this once, or written to a file
#[derive(Debug, Args)]
pub struct CreateArguments {
    #[command(flatten)]
    connection: Connection,
    #[command(flatten)]
    place: Place,
    /// Write it to the database itself: for a coordinator that does not run, or whose tokens are lost
    #[arg(long)]
    offline: bool,
    /// What it may do: `viewer`, `submitter`, `worker` or `admin`
    #[arg(long, value_parser = str::parse::<Role>)]
    role: Role,
    /// Whose it is, for the audit
    #[arg(long)]
    label: String,
    /// The only project that it may see and change
    #[arg(long)]
    project: Option<String>,
    /// Days until it expires [default: never]
    #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(i64).range(1..=3650))]
    days: Option<i64>,
    /// Write the secret to this file, which only its owner can read
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Revoke a token
#[derive(Debug, Args)]
pub struct RevokeArguments {
    /// Its id
    id: String,
    #[command(flatten)]
    connection: Connection,
}

/// Makes, lists or revokes.
pub fn run(command: Command) -> Result<Answer> {
    match command {
        Command::Create(arguments) => create(arguments),
        Command::List(connection) => list(&connection),
        Command::Revoke(arguments) => {
            arguments.connection.client()?.revoke_token(&arguments.id)?;
            Answer::new(&json!({ "revoked": arguments.id }), format!("{} is revoked", arguments.id))
        }
    }
}

fn create(arguments: CreateArguments) -> Result<Answer> {
    let CreateArguments { connection, place, offline, role, label, project, days, output } = arguments;
    let request = TokenRequest { role, project, label, expires_s: days.map(|days| days * 86_400) };
    let made = if offline {
        create_offline(&place, &request)?
    } else {
        connection.client()?.create_token(&request)?
    };
    let Some(path) = output else { return Answer::new(&made, made.secret.clone()) };
    write_secret(&path, &made.secret).map_err(|error| Error::io("write", &path, error))?;
    Answer::new(&json!({ "id": made.id }), format!("token {} is in {}", made.id, path.display()))
}

fn create_offline(place: &Place, request: &TokenRequest) -> Result<Secret> {
    place.make()?;
    let database = place.database();
    block_on(async move {
        let store = Store::open(&database, 2).await?;
        store.migrate().await?;
        let clock = Clock::default();
        if let Some(now) = store.driver().now_ms().await? {
            clock.set_ms(now);
        }
        let made = server::http::make_token(&store, request, clock.now_ms()).await?;
        store.driver().close().await;
        Ok(made)
    })
}

fn list(connection: &Connection) -> Result<Answer> {
    let tokens = connection.client()?.tokens()?;
    let line = |token: &protocol::admin::TokenDetail| {
        let project = token.project.as_deref().unwrap_or("all projects");
        let revoked = if token.revoked_at.is_some() { ", revoked" } else { "" };
        format!("{}  {}  {project}  {}{revoked}", token.id, token.role, token.label.escape_debug())
    };
    let text = tokens.iter().map(line).collect::<Vec<_>>().join("\n");
    Answer::new(&tokens, text)
}
