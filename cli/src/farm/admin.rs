//! `pantaray project`, `limits`, `audit`, `ticket` and `enrol`: what administrators look at and change, and how workers come to
//! a token of their own.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use engine::{Error, Result};
use protocol::admin::{AuditEntry, EnrolRequest, Project, Secret, TicketRequest};
use protocol::overview::ProjectUse;
use serde_json::json;

use super::jobs::{printable, table};
use super::{Connection, read_token};
use crate::console::Answer;
use crate::service::write_secret;
use crate::{figures, values};

/// What to do with projects
#[derive(Debug, Subcommand)]
pub enum ProjectCommand {
    /// List the projects that the token may see
    List(Connection),
    Set(ProjectArguments),
}

/// Make a project, or change one; what is not named stays as it is
#[derive(Debug, Args)]
pub struct ProjectArguments {
    /// Its name
    name: String,
    #[command(flatten)]
    connection: Connection,
    /// Its share of the farm, against those of others [default: 100]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..=1_000_000))]
    share: Option<i64>,
    /// Batches that run at once at most, over all of its jobs; `none` for no limit
    #[arg(long, value_name = "N|none", value_parser = values::number_or_none)]
    running_max: Option<values::OrNone>,
    /// Days after a job's end that its batches, parts and scene are kept [default: 14]
    #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(i64).range(0..=36_500))]
    retention_days: Option<i64>,
    /// Days after a job's end that what it published is kept [default: for ever]
    #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(i64).range(0..=36_500))]
    outputs_days: Option<i64>,
}

/// Show what projects use of the farm, and what they may
#[derive(Debug, Args)]
pub struct LimitsArguments {
    #[command(flatten)]
    connection: Connection,
}

/// Show what was changed and by whom, latest first
#[derive(Debug, Args)]
pub struct AuditArguments {
    #[command(flatten)]
    connection: Connection,
    /// Entries at most
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..=1000))]
    limit: u16,
    /// Entries before this number
    #[arg(long, value_name = "ID")]
    before: Option<i64>,
}

/// Make a ticket, by which workers enrol; its secret is shown this once, or written to a file
#[derive(Debug, Args)]
pub struct TicketArguments {
    #[command(flatten)]
    connection: Connection,
    /// Workers that may enrol with it
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(i64).range(1..=100_000))]
    uses: i64,
    /// Minutes until it expires
    #[arg(long, value_name = "MINUTES", default_value_t = 60, value_parser = clap::value_parser!(i64).range(1..=525_600))]
    minutes: i64,
    /// A label that every such worker gets
    #[arg(long, value_name = "LABEL")]
    label: Vec<String>,
    /// Write the secret to this file, which only its owner can read
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Trade a ticket for a worker's own token
#[derive(Debug, Args)]
pub struct EnrolArguments {
    #[command(flatten)]
    connection: Connection,
    /// The file that holds the ticket
    #[arg(long, value_name = "FILE")]
    ticket_file: PathBuf,
    /// The worker's name: the token works for this name only [default: the host's name]
    #[arg(long)]
    name: Option<String>,
    /// Write the token to this file, which only its owner can read
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

/// Lists projects, or makes or changes one.
pub fn run_project(command: ProjectCommand) -> Result<Answer> {
    match command {
        ProjectCommand::List(connection) => {
            let projects = connection.client()?.projects()?;
            let mut rows =
                vec![["PROJECT", "SHARE", "AT MOST", "WORK KEPT", "STREAMS KEPT"].map(String::from)];
            rows.extend(projects.iter().map(project_row));
            Answer::new(&projects, table(&rows))
        }
        ProjectCommand::Set(arguments) => set(arguments),
    }
}

fn set(arguments: ProjectArguments) -> Result<Answer> {
    let ProjectArguments { name, connection, share, running_max, retention_days, outputs_days } = arguments;
    let client = connection.client()?;
    let known = client.projects()?.into_iter().find(|project| project.name == name);
    let (share_now, running_now) = known.map_or((100, None), |known| (known.share, known.running_max));
    let project = Project {
        name,
        share: share.unwrap_or(share_now),
        running_max: running_max.map_or(running_now, |max| max.0),
        retention_days,
        outputs_days,
    };
    client.put_project(&project)?;
    Answer::new(&project, format!("the project {} is as you wish", project.name))
}

fn project_row(project: &Project) -> [String; 5] {
    let days = |days: Option<i64>| days.map_or("for ever".into(), |days| format!("{days} days"));
    [
        printable(&project.name),
        project.share.to_string(),
        most(project.running_max),
        days(project.retention_days),
        days(project.outputs_days),
    ]
}

fn most(max: Option<i64>) -> String {
    max.map_or("no limit".into(), |max| max.to_string())
}

/// Shows what projects use, and may.
pub fn run_limits(arguments: LimitsArguments) -> Result<Answer> {
    let projects = arguments.connection.client()?.farm()?.projects;
    let shares = projects.iter().filter(|project| project.jobs > 0).map(|project| project.share).sum();
    let mut rows =
        vec![["PROJECT", "SHARE", "OF THE FARM", "RUNNING", "AT MOST", "READY", "JOBS"].map(String::from)];
    rows.extend(projects.iter().map(|project| limits_row(project, shares)));
    Answer::new(&projects, table(&rows))
}

/// A project among those with work, whose shares are `shares` together.
fn limits_row(project: &ProjectUse, shares: i64) -> [String; 7] {
    let of_the_farm = match project.jobs {
        0 => "idle".into(),
        _ => figures::percent(project.share as f64 / shares.max(1) as f64),
    };
    [
        printable(&project.name),
        project.share.to_string(),
        of_the_farm,
        project.running.to_string(),
        most(project.running_max),
        project.ready.to_string(),
        project.jobs.to_string(),
    ]
}

/// Shows what was changed, and by whom.
pub fn run_audit(arguments: AuditArguments) -> Result<Answer> {
    let before = arguments.before.map_or(String::new(), |id| format!("&after={id}"));
    let page = arguments.connection.client()?.audit(&format!("?limit={}{before}", arguments.limit))?;
    let mut rows = vec![["ID", "TIME", "WHO", "FROM", "STATUS", "WHAT"].map(String::from)];
    rows.extend(page.entries.iter().map(audit_row));
    Answer::new(&page, table(&rows))
}

fn audit_row(entry: &AuditEntry) -> [String; 6] {
    [
        entry.id.to_string(),
        figures::time(entry.at),
        printable(&entry.actor),
        printable(&entry.address),
        entry.status.to_string(),
        printable(&entry.action),
    ]
}

/// Makes a ticket.
pub fn run_ticket(arguments: TicketArguments) -> Result<Answer> {
    let TicketArguments { connection, uses, minutes, label: labels, output } = arguments;
    let request = TicketRequest { uses, expires_s: 60 * minutes, labels };
    let made = connection.client()?.create_ticket(&request)?;
    match output {
        None => Answer::new(&made, made.secret.clone()),
        Some(path) => keep(&made, "ticket", path),
    }
}

/// Trades a ticket for a token.
pub fn run_enrol(arguments: EnrolArguments) -> Result<Answer> {
    let EnrolArguments { connection, ticket_file, name, output } = arguments;
    let request = EnrolRequest {
        ticket: read_token(&ticket_file)?,
        name: name.unwrap_or_else(super::worker::host_name),
    };
    keep(&connection.client()?.enrol(&request)?, "token", output)
}

/// Writes a secret to a file.
fn keep(made: &Secret, what: &str, path: PathBuf) -> Result<Answer> {
    write_secret(&path, &made.secret).map_err(|error| Error::io("write", &path, error))?;
    Answer::new(&json!({ "id": made.id }), format!("{what} {} is in {}", made.id, path.display()))
}
