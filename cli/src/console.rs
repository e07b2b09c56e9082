//! What a person or a script sees: answers on standard output, everything else on standard error.

use std::io::{IsTerminal, Write};
use std::process::ExitCode;

use clap::ValueEnum;
use engine::bake::Control;
use engine::{Error, ErrorKind, Result};
use serde::Serialize;
use tracing_subscriber::EnvFilter;

use crate::progress::Display;
use crate::signals;

/// What a subcommand found out: an object for scripts and a text for people.
#[derive(Debug)]
pub struct Answer {
    json: String,
    text: String,
}

impl Answer {
    /// An answer that says the same twice.
    pub fn new(json: &impl Serialize, text: impl Into<String>) -> Result<Self> {
        let json = serde_json::to_string_pretty(json)
            .map_err(|error| Error::invalid("the answer cannot be written as JSON").caused_by(error))?;
        Ok(Self { json, text: text.into() })
    }

    /// The answer of a command that has said everything already.
    pub fn said() -> Self {
        Self { json: String::new(), text: String::new() }
    }
}

/// How log lines are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line, with the ids of request, job, pass, batch and fence as fields of their own.
    Json,
}

impl LogFormat {
    /// Says on standard error what is no answer and no complaint.
    pub fn tell(self, text: &str) {
        match self {
            Self::Text => drop(writeln!(std::io::stderr(), "{text}")),
            Self::Json => tracing::info!("{text}"),
        }
    }

    /// What is logged where `RUST_LOG` says nothing: what is told goes through the log where that is JSON.
    fn level(self) -> &'static str {
        match self {
            Self::Text => "warn",
            Self::Json => "info",
        }
    }
}

/// Where a subcommand's progress and answer go.
#[derive(Debug)]
pub struct Console {
    json: bool,
    progress: Display,
}

impl Console {
    /// Sets logging up as `RUST_LOG` and `format` say, and a display that suits where standard error goes.
    pub fn new(json: bool, quiet: bool, format: LogFormat) -> Self {
        let progress = Display::new(quiet);
        let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(format.level()));
        let log = progress.log_writer();
        let lines = tracing_subscriber::fmt().with_env_filter(filter).with_writer(move || log.clone());
        match format {
            LogFormat::Text => lines.with_ansi(colours()).init(),
            LogFormat::Json => {
                lines.json().flatten_event(true).with_current_span(false).with_ansi(false).init();
            }
        }
        Self { json, progress }
    }

    /// What long work reports to, and what ends it.
    pub fn control(&self) -> Control<'_> {
        Control { progress: &self.progress, cancel: signals::cancel_flag() }
    }

    /// Prints a part of an answer that comes bit by bit.
    pub fn print_more(&self, text: &str) -> Result<()> {
        if text.is_empty() { Ok(()) } else { print(text) }
    }

    /// Prints an answer.
    pub fn show(&self, answer: &Answer) -> Result<()> {
        self.print_more(if self.json { &answer.json } else { &answer.text })
    }

    /// Prints the answer or the error and says how the process ends.
    pub fn finish(&self, result: Result<Answer>) -> ExitCode {
        self.progress.end(result.is_ok());
        let printed = result.and_then(|answer| self.show(&answer));
        match printed {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                // If standard error is gone, too, there is nobody left to tell
                let _ = std::io::stderr().write_all(describe(&error, colours()).as_bytes());
                ExitCode::FAILURE
            }
        }
    }
}

fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    let line_end = if text.ends_with('\n') { "" } else { "\n" };
    match write!(out, "{text}{line_end}").and_then(|()| out.flush()) {
        // Whoever reads has seen enough, as `head` does
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        Err(error) => Err(Error::new(ErrorKind::Io, "cannot write to standard output").caused_by(error)),
        Ok(()) => Ok(()),
    }
}

/// Whether standard error shows colours: on a terminal, unless <https://no-color.org> is obeyed.
fn colours() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// The error as people read it: what and where, then why, then what to do about it.
fn describe(error: &Error, colours: bool) -> String {
    let paint = |code: &str, text: &str| match colours {
        true => format!("\x1b[1;{code}m{text}\x1b[0m"),
        false => text.to_string(),
    };
    let mut text = format!("{} {error}\n", paint("31", "error:"));
    let mut said = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(source) = cause {
        let reason = source.to_string();
        if !said.contains(&reason) {
            text.push_str(&format!("  caused by: {reason}\n"));
            said = reason;
        }
        cause = source.source();
    }
    if let Some(hint) = error.hint_text() {
        text.push_str(&format!("\n{} {hint}\n", paint("36", "hint:")));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a cause that is said twice, a lost hint, and escape codes where none belong.
    #[test]
    fn errors_say_what_where_why_and_what_to_do() {
        let cause = std::io::Error::other("disk on fire");
        let error = Error::invalid("bad brick").at_text("a.xml", 3, 4).caused_by(cause).hint("buy a disk");
        let expected = "error: a.xml:3:4: bad brick\n  caused by: disk on fire\n\nhint: buy a disk\n";
        assert_eq!(describe(&error, false), expected);
        assert!(describe(&error, true).starts_with("\x1b[1;31merror:\x1b[0m a.xml"));
        let error = Error::io("open", "b.mgs", std::io::Error::other("denied"));
        assert_eq!(describe(&error, false), "error: b.mgs: cannot open: denied\n");
    }
}
