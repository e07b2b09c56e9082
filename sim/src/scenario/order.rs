//! Who is served: by priority between jobs, by share between projects.

use std::time::Duration;

use engine::{Error, ErrorKind, Result};
use protocol::admin::Project;

use super::{Size, accepted, spent};
use crate::load::Load;
use crate::report::{Figure, at_least, at_most, rank_correlation, told};
use crate::stage::{Job, Stage};

/// Milliseconds that a batch is said to take: claims are of a few batches then.
const TOLD_MS: i64 = 15_000;

/// Ten jobs of ten priorities, and an eleventh of the highest when all workers are taken.
pub fn priority(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    // Segments are short, so that workers often choose
    let load = || Load::new(size.batches(80), 25.0, TOLD_MS);
    let mut jobs: Vec<(i64, Job)> = Vec::new();
    for priority in (5..100).step_by(10) {
        jobs.push((priority, stage.submit(load(), |request| request.priority = priority)?));
    }
    stage.prepare(&jobs.iter().map(|(_, job)| job).collect::<Vec<_>>())?;
    stage.hire(&size.crew())?;
    let from = stage.shared.ledger.now() + 0.5;
    sleep_s(size.window_s);
    let late = stage.submit(load(), |request| request.priority = 100)?;
    let submitted = stage.shared.ledger.now();
    sleep_s(size.window_s);
    let to = stage.shared.ledger.now();

    let early = spent(stage, from, submitted);
    let pairs: Vec<(f64, f64)> = jobs
        .iter()
        .map(|(priority, job)| (*priority as f64, early.get(&job.load).copied().unwrap_or(0.0)))
        .collect();
    let all: f64 = early.values().sum();
    let lowest = pairs[0].1 / all.max(1e-9);
    let after = spent(stage, submitted + size.window_s / 2.0, to);
    let weights: f64 = jobs.iter().map(|(priority, _)| (priority + 1) as f64).sum::<f64>() + 101.0;
    let part = after.get(&late.load).copied().unwrap_or(0.0) / after.values().sum::<f64>().max(1e-9);
    Ok(vec![
        at_least("rank correlation of priority and workers' time", rank_correlation(&pairs), 0.85),
        at_least("part of the lowest priority", lowest, 0.001),
        at_least("a late job's part, over that of its priority", part / (101.0 / weights), 0.5),
        told("batches a second", accepted(stage, from, to).values().sum::<f64>() / (to - from)),
    ])
}

/// Two projects with shares of 3 to 1; the greater one's batches are four times as long.
pub fn fairness(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    for (name, share) in [("features", 300), ("shorts", 100)] {
        let project =
            Project { name: name.into(), share, running_max: None, retention_days: None, outputs_days: None };
        stage.client().put_project(&project)?;
    }
    let of = |name: &str| {
        let name = name.to_owned();
        move |request: &mut protocol::job::JobRequest| request.project = name
    };
    let long = stage.submit(Load::new(size.batches(200), 80.0, 4 * TOLD_MS), of("features"))?;
    let short = stage.submit(Load::new(size.batches(800), 20.0, TOLD_MS), of("shorts"))?;
    stage.prepare(&[&long, &short])?;
    stage.hire(&size.crew())?;
    let from = stage.shared.ledger.now() + 1.5;
    sleep_s(2.0 * size.window_s);
    let to = stage.shared.ledger.now();
    let time = spent(stage, from, to);
    let of = |job: &Job| time.get(&job.load).copied().unwrap_or(0.0);
    let (long, short) = (of(&long), of(&short));
    if long + short == 0.0 {
        return Err(Error::new(ErrorKind::Io, "nobody worked"));
    }
    let part = long / (long + short);
    let used = (long + short) / ((to - from) * size.workers as f64);
    Ok(vec![
        told("part of the project with 3 of 4 shares", part),
        at_most("how far that is from its share", (part - 0.75).abs(), 0.1),
        at_least("workers' time that was used", used, 0.6),
    ])
}

fn sleep_s(seconds: f64) {
    std::thread::sleep(Duration::from_secs_f64(seconds));
}
