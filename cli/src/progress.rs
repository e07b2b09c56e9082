//! Progress on standard error: a bar on a terminal, a line now and then elsewhere, nothing with `--quiet`.

use std::io::{IsTerminal, Write};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use engine::bake::Progress;
use indicatif::{ProgressBar, ProgressStyle};

use crate::figures;

/// Lines of one stage are at least this far apart where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Steps of a bar.
const STEPS: u64 = 1000;

/// Shows how far work is.
#[derive(Debug)]
pub struct Display {
    mode: Mode,
    stage: Mutex<Option<Stage>>,
}

#[derive(Clone, Debug)]
enum Mode {
    Quiet,
    Lines,
    Bar(ProgressBar),
}

impl Display {
    /// A display that suits standard error, or none.
    pub fn new(quiet: bool) -> Self {
        let mode = match (quiet, std::io::stderr().is_terminal()) {
            (true, _) => Mode::Quiet,
            (false, false) => Mode::Lines,
            (false, true) => Mode::Bar(ProgressBar::hidden()),
        };
        if let Mode::Bar(bar) = &mode {
            let template = "{prefix:12} [{bar:30}] {percent:>3} %  {msg}";
            let style = ProgressStyle::with_template(template).expect("the template is well formed");
            bar.set_style(style.progress_chars("=> "));
            bar.set_length(STEPS);
        }
        Self { mode, stage: Mutex::new(None) }
    }

    /// Ends the current stage; one that failed is not called done.
    pub fn end(&self, done: bool) {
        let mut stage = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        if let Mode::Bar(bar) = &self.mode {
            bar.finish_and_clear();
        }
        if let Some(stage) = stage.take().filter(|_| done) {
            self.say(&stage.end(Instant::now()));
        }
    }

    /// Where log lines go so that they do not tear the bar.
    pub fn log_writer(&self) -> LogWriter {
        LogWriter(self.mode.clone())
    }

    fn say(&self, line: &str) {
        match &self.mode {
            Mode::Quiet => {}
            Mode::Lines => drop(writeln!(std::io::stderr(), "{line}")),
            Mode::Bar(bar) => bar.suspend(|| drop(writeln!(std::io::stderr(), "{line}"))),
        }
    }
}

impl Progress for Display {
    fn update(&self, name: &str, done: f64, detail: &str) {
        if matches!(self.mode, Mode::Quiet) {
            return;
        }
        let now = Instant::now();
        let mut current = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        if current.as_ref().is_none_or(|stage| stage.name != name) {
            if let Some(ended) = current.replace(Stage::begin(name, now)) {
                self.say(&ended.end(now));
            }
            if let Mode::Bar(bar) = &self.mode {
                bar.set_draw_target(indicatif::ProgressDrawTarget::stderr());
                bar.set_prefix(name.to_string());
            }
        }
        let Some(stage) = current.as_mut() else { return };
        stage.done = if done.is_finite() { done.clamp(0.0, 1.0) } else { stage.done };
        match &self.mode {
            Mode::Bar(bar) => {
                bar.set_message(stage.rest(now, detail));
                bar.set_position((stage.done * STEPS as f64) as u64);
            }
            _ => {
                if let Some(line) = stage.line(now, detail) {
                    self.say(&line);
                }
            }
        }
    }
}

/// A stage on its way.
#[derive(Debug)]
struct Stage {
    name: String,
    began: Instant,
    said: Instant,
    done: f64,
    detail: String,
}

impl Stage {
    fn begin(name: &str, now: Instant) -> Self {
        Self { name: name.into(), began: now, said: now, done: 0.0, detail: String::new() }
    }

    /// The detail, and the time left once there is enough to tell it from.
    fn rest(&mut self, now: Instant, detail: &str) -> String {
        self.detail.clear();
        self.detail.push_str(detail);
        let elapsed = (now - self.began).as_secs_f64();
        let left = (self.done > 0.01 && elapsed > 1.0 && self.done < 1.0)
            .then(|| format!("{} left", figures::seconds(elapsed * (1.0 - self.done) / self.done)));
        [Some(detail).filter(|detail| !detail.is_empty()), left.as_deref()]
            .into_iter()
            .flatten()
            .collect::<Vec<_>>()
            .join(", ")
    }

    /// A line, if it is time for one.
    fn line(&mut self, now: Instant, detail: &str) -> Option<String> {
        let rest = self.rest(now, detail);
        if now - self.said < LINE_INTERVAL {
            return None;
        }
        self.said = now;
        let comma = if rest.is_empty() { "" } else { ", " };
        Some(format!("{} {:.0} %{comma}{rest}", self.name, 100.0 * self.done))
    }

    /// The last line.
    fn end(&self, now: Instant) -> String {
        let seconds = figures::seconds((now - self.began).as_secs_f64());
        match self.detail.as_str() {
            "" => format!("{} done in {seconds}", self.name),
            detail => format!("{} done in {seconds}, {detail}", self.name),
        }
    }
}

/// Writes log lines above the bar.
#[derive(Clone, Debug)]
pub struct LogWriter(Mode);

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        match &self.0 {
            Mode::Bar(bar) => bar.suspend(|| std::io::stderr().write(bytes)),
            Mode::Quiet | Mode::Lines => std::io::stderr().write(bytes),
        }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a log file flooded with lines, a missing rate, and a wrong estimate of the time left.
    #[test]
    fn lines_come_now_and_then_with_rate_and_time_left() {
        let start = Instant::now();
        let after = |seconds: f64| start + Duration::from_secs_f64(seconds);
        let mut stage = Stage::begin("trace", start);
        let mut lines = Vec::new();
        for step in 0..100 {
            stage.done = f64::from(step) / 100.0;
            lines.extend(stage.line(after(0.2 * f64::from(step)), "4.0 M rays/s"));
        }
        assert_eq!(
            lines,
            [
                "trace 25 %, 4.0 M rays/s, 15.0 s left",
                "trace 50 %, 4.0 M rays/s, 10.0 s left",
                "trace 75 %, 4.0 M rays/s, 5.0 s left",
            ]
        );
        assert_eq!(stage.end(after(20.0)), "trace done in 20.0 s, 4.0 M rays/s");
    }
}
