//! Coordinators that die: what goes on meanwhile, and what is left when they are back.

use std::collections::HashSet;
use std::sync::atomic::Ordering;
use std::time::Duration;

use engine::Result;
use protocol::JobState;

use super::Size;
use crate::load::Load;
use crate::report::{Figure, at_least, at_most, told};
use crate::stage::Stage;

/// Time for a farm to do something.
const PATIENCE: Duration = Duration::from_secs(90);
/// Longer than a lease.
const AWAY: Duration = Duration::from_secs(6);

/// Kills a coordinator in the midst of a job. Where there is one, it is started again at once.
pub fn failover(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let job = stage.submit(Load::new(size.batches(100), 40.0, 10_000), |_| {})?;
    stage.prepare(&[&job])?;
    stage.hire(&size.crew())?;
    std::thread::sleep(Duration::from_secs(2));
    let killed = stage.shared.ledger.now();
    stage.kill(0);
    if stage.processes.len() == 1 {
        stage.restart(0, &[])?;
    }
    let mut submitted = 0.0;
    for _ in 0..3 {
        let job = stage.submit(Load::new(4, 1.0, 10), |_| {})?;
        submitted += f64::from(u8::from(!job.id.is_empty()));
    }
    let detail = stage.finish(&job, PATIENCE)?;
    let seen = stage.shared.ledger.seen();
    let mut times: Vec<f64> =
        seen.accepted.iter().map(|accepted| accepted.at).filter(|at| *at > killed).collect();
    times.push(killed);
    times.sort_by(f64::total_cmp);
    let gap = times.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
    Ok(vec![
        told("coordinators", stage.processes.len() as f64),
        at_most("longest time without a result, seconds", gap, 5.0),
        at_least("submissions accepted after the kill", submitted, 3.0),
        at_least("results accepted after the kill", times.len() as f64 - 1.0, 10.0),
        at_least(
            "the job has succeeded",
            f64::from(u8::from(detail.summary.state == JobState::Succeeded)),
            1.0,
        ),
    ])
}

/// The coordinator is away for longer than a lease lasts while every worker is at a batch.
pub fn reconnect(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let batches = size.batches(1);
    let job = stage.submit(Load { group: 1, ..Load::new(batches, 10_000.0, 60_000) }, |_| {})?;
    stage.prepare(&[&job])?;
    stage.client().act(&job.id, "pause")?;
    stage.hire(&size.crew())?;
    stage.until_known(PATIENCE)?;
    // The coordinator looks at the farm once a second: each worker is to get its one batch
    std::thread::sleep(Duration::from_secs(2));
    stage.client().act(&job.id, "resume")?;
    stage.until("all workers are busy", PATIENCE, || {
        Ok(stage.shared.busy.load(Ordering::Relaxed) >= size.workers)
    })?;
    stage.kill(0);
    std::thread::sleep(AWAY);
    stage.restart(0, &[])?;
    let back = stage.shared.ledger.now();
    stage.until("all workers were heard of", PATIENCE, || {
        let seen = stage.shared.ledger.seen();
        let heard: HashSet<usize> = seen.beats.iter().filter(|b| b.at > back).map(|b| b.worker).collect();
        Ok(heard.len() >= size.workers)
    })?;
    let heard = stage.shared.ledger.now() - back;
    stage.finish(&job, PATIENCE)?;
    let seen = stage.shared.ledger.seen();
    let claimed: usize = seen.claims.iter().map(|claim| claim.batches).sum();
    Ok(vec![
        told("workers", size.workers as f64),
        at_most("seconds until all were heard of", heard, 10.0),
        at_most("sessions lost", seen.sessions_lost as f64, 0.0),
        at_most("leases lost", seen.leases_lost as f64, 0.0),
        at_most("claims of a batch", claimed as f64 / batches as f64, 1.0),
    ])
}
