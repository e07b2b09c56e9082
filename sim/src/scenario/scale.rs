//! Sizes of a large farm: a million batches, thousands of jobs, hundreds of workers with nothing to do.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use engine::{Error, ErrorKind, Result};
use protocol::{PassKind, PassState};
use worker::client::Client;

use super::Size;
use crate::fake::Temper;
use crate::load::{Gate, Load};
use crate::report::{Figure, at_least, at_most, percentile, told};
use crate::stage::{Job, Stage};

/// Time for large things.
const PATIENCE: Duration = Duration::from_secs(120);
/// Batches of a large job.
const MILLION: i64 = 1_000_000;
/// Jobs of a long list, and frames of one submission.
const JOBS: (i64, i64) = (10_000, 2_500);
/// Requests of which the slowest hundredth is told.
const LOOKS: usize = 200;
/// Seconds for which idle workers are watched.
const IDLE_S: u64 = 60;

/// A million batches: made, looked at, waited before by all workers, and found again by a coordinator that was killed.
pub fn million(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let gate = Arc::new(Gate::default());
    let load = Load { gate: Some(gate), ..Load::new(MILLION, 0.0, 60_000) };
    let job = stage.submit(load, |_| {})?;
    let mut figures = create(stage, &job)?;
    stage.client().act(&job.id, "pause")?;
    figures.push(at_most("job page, 99 of 100, milliseconds", slowest_ms(|| get(stage, &job, ""))?, 100.0));
    let pass = bake(stage, &job)?;
    let segments = format!("/passes/{pass}/segments?limit=1000");
    figures.push(at_most(
        "page of segments, milliseconds",
        slowest_ms(|| get(stage, &job, &segments))?,
        100.0,
    ));
    let batches = format!("/passes/{pass}/batches?after={}&limit=1000", MILLION / 2);
    figures.push(at_most("page of batches, milliseconds", slowest_ms(|| get(stage, &job, &batches))?, 100.0));

    // All workers wait for work
    stage.hire(&size.crew())?;
    stage.until_known(PATIENCE)?;
    std::thread::sleep(Duration::from_secs(5));
    let resident = |stage: &Stage| {
        let bytes = stage.processes[0].as_ref().and_then(crate::process::Process::resident_bytes);
        bytes.map_or(f64::NAN, |bytes| bytes as f64 / f64::from(1 << 20))
    };
    figures.push(told("workers that wait for work", size.workers as f64));
    figures.push(at_most("resident memory, MiB", resident(stage), 200.0));

    // All have a lease; then the coordinator is killed and started again
    stage.client().act(&job.id, "resume")?;
    stage.until("all workers are busy", PATIENCE, || {
        Ok(stage.shared.busy.load(Ordering::Relaxed) >= size.workers)
    })?;
    stage.kill(0);
    let start = Instant::now();
    stage.restart(0, &[])?;
    stage.client().text("/readyz")?;
    figures.push(at_most("seconds from the start to ready", start.elapsed().as_secs_f64(), 2.0));
    std::thread::sleep(Duration::from_secs(8));
    let seen = stage.shared.ledger.seen();
    figures.push(at_most("leases lost", (seen.leases_lost + seen.sessions_lost) as f64, 0.0));
    drop(seen);
    figures.push(at_most("resident memory after that, MiB", resident(stage), 200.0));
    Ok(figures)
}

/// Brings the job up to its bake, while somebody asks for this and that.
fn create(stage: &mut Stage, job: &Job) -> Result<Vec<Figure>> {
    let stop = Arc::new(AtomicBool::new(false));
    let asking = std::thread::spawn({
        let (client, stop) = (stage.client().clone(), stop.clone());
        move || ask_until(&client, &stop)
    });
    let shy = Temper { is_shy: true, wait: Duration::from_millis(200), ..Temper::default() };
    stage.hire(&[shy])?;
    let (mut planned, mut ready) = (None, None);
    let waited = stage.until("the bake is open", PATIENCE, || {
        let detail = stage.client().job(&job.id)?;
        let is = |kind, state| detail.passes.iter().any(|pass| pass.kind == kind && pass.state == state);
        if planned.is_none() && is(PassKind::Plan, PassState::Done) {
            planned = Some(Instant::now());
        }
        if is(PassKind::Bake, PassState::Open) {
            ready = Some(Instant::now());
        }
        Ok(ready.is_some())
    });
    stop.store(true, Ordering::Relaxed);
    let asked = asking.join().map_err(|_| Error::new(ErrorKind::Io, "whoever asked has panicked"))??;
    waited?;
    let took = ready.zip(planned).map_or(f64::NAN, |(ready, planned)| (ready - planned).as_secs_f64());
    let all = asked.iter().map(|(_, ms)| *ms).collect::<Vec<_>>();
    let writes: Vec<f64> = asked.iter().filter(|(writes, _)| *writes).map(|(_, ms)| *ms).collect();
    Ok(vec![
        at_most("seconds until a million batches were made", took, 10.0),
        at_least("requests meanwhile", all.len() as f64, 20.0),
        at_most("99 of 100 of them took, milliseconds", percentile(&all, 0.99), 100.0),
        told("the longest of those that write took, milliseconds", percentile(&writes, 1.0)),
    ])
}

/// Lists jobs and asks whether the database takes writes, until it is to stop; whether each wrote, and its milliseconds.
fn ask_until(client: &Client, stop: &AtomicBool) -> Result<Vec<(bool, f64)>> {
    let mut asked = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        for (path, writes) in [("/v1/jobs?limit=50", false), ("/readyz", true)] {
            let start = Instant::now();
            client.text(path)?;
            asked.push((writes, start.elapsed().as_secs_f64() * 1e3));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(asked)
}

/// Many jobs, and a look at their list.
pub fn list(stage: &mut Stage, _: &Size) -> Result<Vec<Figure>> {
    let start = Instant::now();
    for first in (0..JOBS.0).step_by(JOBS.1 as usize) {
        stage.submit(Load::new(1, 1.0, 10), |request| request.frames = Some((first, first + JOBS.1 - 1)))?;
    }
    let took = start.elapsed().as_secs_f64();
    let page = |query: &str| {
        slowest_ms(|| stage.client().text(&format!("/v1/jobs{query}")).map(drop).map_err(Into::into))
    };
    Ok(vec![
        told("jobs", JOBS.0 as f64),
        told("seconds to submit them", took),
        at_most("list of 100, 99 of 100, milliseconds", page("?limit=100")?, 100.0),
        at_most("list of 1,000, 99 of 100, milliseconds", page("?limit=1000")?, 100.0),
        at_most("list of 100 that are running", page("?limit=100&state=running")?, 100.0),
    ])
}

/// Workers with nothing to do, watched from when they have settled.
pub fn idle(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let temper = Temper { wait: Duration::from_secs(25), ..Temper::default() };
    stage.hire(&vec![temper; size.workers])?;
    stage.until_known(PATIENCE)?;
    std::thread::sleep(Duration::from_secs(10));
    let operations = || {
        let all = stage.metrics();
        all.iter()
            .filter(|(name, _)| name.starts_with("pantaray_db_operations_total"))
            .map(|(_, n)| n)
            .sum::<f64>()
    };
    let before = operations();
    std::thread::sleep(Duration::from_secs(IDLE_S));
    let rate = (operations() - before) / IDLE_S as f64;
    Ok(vec![told("workers", size.workers as f64), at_most("queries and transactions a second", rate, 1.0)])
}

fn get(stage: &Stage, job: &Job, rest: &str) -> Result<()> {
    Ok(stage.client().text(&format!("/v1/jobs/{}{rest}", job.id)).map(drop)?)
}

fn bake(stage: &Stage, job: &Job) -> Result<i64> {
    let detail = stage.client().job(&job.id)?;
    let pass = detail.passes.iter().find(|pass| pass.kind == PassKind::Bake);
    pass.map(|pass| pass.id).ok_or_else(|| Error::new(ErrorKind::NotFound, "there is no bake"))
}

/// Milliseconds that 99 of 100 requests take at most.
fn slowest_ms(request: impl Fn() -> Result<()>) -> Result<f64> {
    let mut times = Vec::with_capacity(LOOKS);
    for _ in 0..LOOKS {
        let start = Instant::now();
        request()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok(percentile(&times, 0.99))
}
