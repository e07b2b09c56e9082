//! How work flows: into an idle farm, along the curve, past slow workers, all at once.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use engine::Result;

use super::Size;
use crate::fake::Temper;
use crate::ledger::Near;
use crate::load::{Gate, Load};
use crate::report::{Figure, at_least, at_most, percentile, told};
use crate::stage::Stage;

/// Time for a farm to do something.
const PATIENCE: Duration = Duration::from_secs(90);

/// All workers wait; then there is work for all.
pub fn fill(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    stage.hire(&size.crew())?;
    stage.until_known(PATIENCE)?;
    std::thread::sleep(Duration::from_secs(1));
    let gate = Arc::new(Gate::default());
    let load = Load { gate: Some(gate), ..Load::new(size.batches(8), 0.0, 60_000) };
    let start = stage.shared.ledger.now();
    stage.submit(load, |_| {})?;
    stage.until("all workers are busy", PATIENCE, || {
        Ok(stage.shared.busy.load(Ordering::Relaxed) >= size.workers)
    })?;
    let filled = stage.shared.ledger.now();
    let first = stage.shared.ledger.seen().claims.iter().map(|claim| claim.at).fold(filled, f64::min);
    Ok(vec![
        told("workers", size.workers as f64),
        at_most("seconds from the submission to the last worker's claim", filled - start, 10.0),
        told("seconds from the first bake's claim to the last", filled - first),
    ])
}

/// One job along its curve, by workers that remember eight segments.
pub fn locality(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let job = stage.submit(Load::new(size.batches(160), 10.0, 20_000), |_| {})?;
    stage.prepare(&[&job])?;
    stage.hire(&size.crew())?;
    stage.finish(&job, PATIENCE)?;
    let seen = stage.shared.ledger.seen();
    let count = |near| seen.claims.iter().filter(|claim| claim.near == near).count() as f64;
    let (warm, adjacent, cold) = (count(Near::Warm), count(Near::Adjacent), count(Near::Cold));
    let all = (warm + adjacent + cold).max(1.0);
    Ok(vec![
        at_most("part of claims from a cold cache", cold / all, 0.2),
        at_least("part of claims from what is in memory", warm / all, 0.5),
        told("part of claims next to what is in memory", adjacent / all),
        told("claims", all),
    ])
}

/// Every eighth worker is eight times as slow.
pub fn stragglers(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    const SLOWNESS: f64 = 8.0;
    let (batches, batch_ms) = (size.batches(60), 50.0);
    let job = stage.submit(Load { group: 1, ..Load::new(batches, batch_ms, 10_000) }, |_| {})?;
    stage.prepare(&[&job])?;
    let slow = |number: usize| number.is_multiple_of(8);
    let temper = |number| Temper { slowness: if slow(number) { SLOWNESS } else { 1.0 }, ..Temper::default() };
    let start = Instant::now();
    stage.hire(&(0..size.workers).map(temper).collect::<Vec<_>>())?;
    stage.finish(&job, PATIENCE)?;
    let took = start.elapsed().as_secs_f64();
    let speed: f64 = (0..size.workers).map(|number| if slow(number) { 1.0 / SLOWNESS } else { 1.0 }).sum();
    let ideal = batches as f64 * batch_ms / 1e3 / speed;
    Ok(vec![
        at_most("time that the job took, over the least that is possible", took / ideal, 2.0),
        told("seconds that it took", took),
    ])
}

/// All workers finish a claim, and report it when a gate opens.
pub fn storm(stage: &mut Stage, size: &Size) -> Result<Vec<Figure>> {
    let gate = Arc::new(Gate::default());
    let batches = size.batches(4);
    let load = Load { gate: Some(gate.clone()), group: 64, ..Load::new(batches, 0.0, 15_000) };
    let job = stage.submit(load, |_| {})?;
    stage.prepare(&[&job])?;
    stage.hire(&size.crew())?;
    stage.until("all workers wait at the gate", PATIENCE, || {
        Ok(stage.shared.busy.load(Ordering::Relaxed) >= size.workers)
    })?;
    let opened = stage.shared.ledger.now();
    stage.shared.ledger.seen().complete_s.clear();
    gate.open();
    stage.finish(&job, PATIENCE)?;
    let seen = stage.shared.ledger.seen();
    let served: BTreeSet<usize> = seen.claims.iter().map(|claim| claim.worker).collect();
    let firsts = &seen.complete_s[..served.len().min(seen.complete_s.len())];
    let last = seen.accepted.iter().map(|accepted| accepted.at).fold(opened, f64::max);
    let beats: Vec<f64> = seen.beats.iter().filter(|b| b.at > opened).map(|b| b.seconds).collect();
    let done: usize = seen.accepted.iter().map(|accepted| accepted.batches).sum();
    Ok(vec![
        at_least("batches accepted, of all", done as f64 / batches as f64, 1.0),
        at_most("seconds that 99 of 100 reports took at most", percentile(firsts, 0.99), 5.0),
        at_most("seconds until the last was accepted", last - opened, 10.0),
        told("seconds that 99 of 100 heartbeats took meanwhile", percentile(&beats, 0.99)),
    ])
}
