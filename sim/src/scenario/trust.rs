//! What is believed: poison and broken workers, results that come twice or too late, a wire that mixes messages up.

use std::collections::BTreeSet;
use std::time::Duration;

use engine::Result;
use protocol::job::{BatchPage, JobDetail};
use protocol::work::Verdict;
use protocol::{JobState, PassKind};

use super::Size;
use crate::fake::Temper;
use crate::load::Load;
use crate::random::Random;
use crate::report::{Figure, at_least, at_most, told};
use crate::stage::{Job, Stage};
use crate::wire::Wire;

/// Time for a job.
const PATIENCE: Duration = Duration::from_secs(120);
/// Batches that are poison.
const POISON: usize = 5;

/// Some batches crash every worker; the first worker spoils every batch by its own fault.
pub fn poison(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let batches = size.batches(40);
    let mut random = Random::new(stage.seed(), 77);
    let mut poison = BTreeSet::new();
    while poison.len() < POISON {
        poison.insert(random.below(batches as u64) as i64);
    }
    let load = Load { poison: poison.clone(), group: 1, ..Load::new(batches, 10.0, 10_000) };
    let job = stage.submit(load, |_| {})?;
    stage.prepare(&[&job])?;
    let mut crew = size.crew();
    crew[0].is_broken = true;
    let broken = stage.hire(&crew)?;
    let detail = stage.finish(&job, PATIENCE)?;

    let failed = failed(stage, &job, &detail)?;
    let pass = bake(&detail);
    let seen = stage.shared.ledger.seen();
    let tried = |batch: &i64| seen.failures.get(&(pass, *batch)).cloned().unwrap_or_default();
    let distinct = |workers: &[usize]| workers.iter().collect::<BTreeSet<_>>().len();
    let most = poison.iter().map(|batch| tried(batch).len()).max().unwrap_or(0);
    let least = poison.iter().map(|batch| distinct(&tried(batch))).min().unwrap_or(0);
    let spoiled = seen.failures.values().filter(|workers| workers.contains(&broken)).count();
    let wrong = failed.symmetric_difference(&poison).count();
    Ok(vec![
        at_most("batches given up that are no poison, or the other way", wrong as f64, 0.0),
        at_least("workers that tried each poisoned batch", least as f64, 3.0),
        at_most("tries of a poisoned batch", most as f64, 5.0),
        at_most("batches that the broken worker spoiled", spoiled as f64, 8.0),
        at_least("the job has failed", f64::from(u8::from(detail.summary.state == JobState::Failed)), 1.0),
    ])
}

/// Every report arrives twice, and two workers sleep through their leases and report all the same.
pub fn double(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let job = stage.submit(Load::new(size.batches(60), 40.0, 10_000), |_| {})?;
    stage.prepare(&[&job])?;
    let wire = Wire { doubled: 1.0, ..Wire::default() };
    let mut crew = vec![Temper { wire, ..Temper::default() }; size.workers];
    crew.iter_mut().take(2).for_each(|temper| temper.freezes = Some(Duration::from_secs(8)));
    stage.hire(&crew)?;
    let detail = stage.finish(&job, PATIENCE)?;
    stage.until(
        "the sleepers have reported",
        PATIENCE,
        || Ok(verdicts(stage, Verdict::Superseded) >= 2.0),
    )?;
    Ok(vec![
        succeeded(&detail),
        at_least(
            "results that had come before",
            verdicts(stage, Verdict::AlreadyDone),
            size.batches(30) as f64,
        ),
        at_least("results that came too late", verdicts(stage, Verdict::Superseded), 2.0),
        told("results accepted", verdicts(stage, Verdict::Accepted)),
    ])
}

/// One message in ten is lost, unanswered, doubled or late, and a coordinator is killed in the midst of it.
pub fn wire(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let load = || Load { group: 2, ..Load::new(size.batches(100), 15.0, 10_000) };
    let jobs = [stage.submit(load(), |_| {})?, stage.submit(load(), |_| {})?];
    let wire = Wire { lost: 0.1, unanswered: 0.1, doubled: 0.1, late: 0.1 };
    stage.hire(&vec![Temper { wire, ..Temper::default() }; size.workers])?;
    std::thread::sleep(Duration::from_secs(2));
    stage.kill(0);
    std::thread::sleep(Duration::from_millis(500));
    stage.restart(0, &[])?;
    let mut figures = Vec::new();
    for job in &jobs {
        figures.push(succeeded(&stage.finish(job, PATIENCE)?));
    }
    figures.push(told("results accepted", verdicts(stage, Verdict::Accepted)));
    figures.push(at_least("results that had come before", verdicts(stage, Verdict::AlreadyDone), 1.0));
    Ok(figures)
}

fn verdicts(stage: &Stage, verdict: Verdict) -> f64 {
    stage.shared.ledger.seen().verdicts.get(&verdict).copied().unwrap_or(0) as f64
}

fn succeeded(detail: &JobDetail) -> Figure {
    let state = detail.summary.state;
    at_least("the job has succeeded", f64::from(u8::from(state == JobState::Succeeded)), 1.0)
}

fn bake(detail: &JobDetail) -> i64 {
    detail.passes.iter().find(|pass| pass.kind == PassKind::Bake).map_or(0, |pass| pass.id)
}

/// The batches of a job that were given up.
fn failed(stage: &Stage, job: &Job, detail: &JobDetail) -> Result<BTreeSet<i64>> {
    let path = format!("/v1/jobs/{}/passes/{}/batches?state=failed&limit=1000", job.id, bake(detail));
    let page: BatchPage = stage.client().get(&path)?;
    Ok(page.batches.iter().map(|batch| batch.batch).collect())
}
