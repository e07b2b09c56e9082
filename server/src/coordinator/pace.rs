//! How fast jobs go: the batches done, noted every few seconds while something is baked. It is kept in memory, and lost
//! with the process; what is needed for work is in the database.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use protocol::job::Counts;
use protocol::overview::{JobNow, JobProgress, PaceSample};
use protocol::{JobState, WaitReason};

use super::{Coordinator, lock};
use crate::scheduler::farm::Farm;
use crate::scheduler::waiting::{Question, reason};

/// Between two samples that are kept.
const EVERY: Duration = Duration::from_secs(3);
/// Between two looks while somebody listens: they hear of each job twice a second at most.
const TOLD_EVERY: Duration = Duration::from_millis(500);
/// Samples of one job; when there are as many, every other one is dropped.
const SAMPLES_MAX: usize = 240;
/// Jobs that are remembered; later ones have greater ids, so the first are the oldest.
const JOBS_MAX: usize = 2_048;
/// Jobs that are told of at once; of others pages ask by themselves.
const FRAMES_MAX: usize = 500;
/// Milliseconds over which the present pace is taken.
const PRESENT_MS: i64 = 60_000;

/// The pace of jobs.
#[derive(Debug, Default)]
pub struct Pace(Mutex<BTreeMap<String, VecDeque<PaceSample>>>);

impl Pace {
    /// Notes a sample, unless it says nothing new.
    pub fn note(&self, job: &str, sample: PaceSample) {
        let mut jobs = lock(&self.0);
        let samples = jobs.entry(job.into()).or_default();
        match samples.back_mut() {
            Some(last) if last.at >= sample.at || last.done > sample.done => return,
            _ => samples.push_back(sample),
        }
        if samples.len() >= SAMPLES_MAX {
            let last = samples.back().copied();
            *samples = samples.iter().copied().step_by(2).collect();
            samples.extend(last.filter(|last| samples.back() != Some(last)));
        }
        if jobs.len() > JOBS_MAX {
            jobs.pop_first();
        }
    }

    /// The samples of a job, oldest first.
    pub fn of(&self, job: &str) -> Vec<PaceSample> {
        lock(&self.0).get(job).map(|samples| samples.iter().copied().collect()).unwrap_or_default()
    }

    /// Batches per minute at present; none before two samples are there.
    pub fn per_minute(&self, job: &str) -> Option<f64> {
        let jobs = lock(&self.0);
        let samples = jobs.get(job)?;
        let last = samples.back()?;
        let first = samples.iter().rev().take_while(|sample| last.at - sample.at <= PRESENT_MS).last()?;
        let elapsed = last.at - first.at;
        (elapsed > 0).then(|| (last.done - first.done) as f64 * 60_000.0 / elapsed as f64)
    }
}

impl Coordinator {
    /// Notes the pace of jobs while something runs, and tells listeners how far they are, until the coordinator stops.
    pub async fn note_pace(self: Arc<Self>) {
        let (mut told, mut noted) = (BTreeMap::new(), Instant::now());
        while !self.is_stopping() {
            let is_heard = self.progress.receiver_count() > 0;
            let pause = if is_heard { TOLD_EVERY } else { EVERY };
            let stopped = self.stopped.notified();
            tokio::select! { () = stopped => return, () = tokio::time::sleep(pause) => {} }
            if self.read_farm(|farm| farm.passes.is_empty()) {
                continue;
            }
            match self.store.counts_of_live_jobs().await {
                Ok(jobs) => {
                    if !is_heard || noted.elapsed() >= EVERY {
                        noted = Instant::now();
                        let at = self.now();
                        jobs.iter().for_each(|(job, counts)| {
                            self.pace.note(job, PaceSample { at, done: counts.done })
                        });
                    }
                    self.tell(jobs, &mut told);
                }
                Err(error) => tracing::warn!(%error, "the pace of jobs cannot be read"),
            }
        }
    }

    /// Tells listeners of those jobs whose batches are not as they were `told` the last time.
    fn tell(&self, jobs: Vec<(String, Counts)>, told: &mut BTreeMap<String, Counts>) {
        let now = self.now();
        let frame = |farm: &Farm, job: &String, batches: Counts| {
            let question = Question { job, state: JobState::Running, backing_off: 0 };
            let project = farm.jobs.get(job)?.project.clone();
            let doing = doing(&self.pace, job, &batches, reason(farm, &question, now));
            Some(JobProgress { job: job.clone(), project, batches, now: doing })
        };
        let frames: Vec<JobProgress> = self.read_farm(|farm| {
            let changed = jobs.iter().filter(|(job, batches)| told.get(job) != Some(batches));
            changed.filter_map(|(job, batches)| frame(farm, job, *batches)).take(FRAMES_MAX).collect()
        });
        *told = jobs.into_iter().collect();
        for frame in frames {
            // Nobody listening any more is no failure
            let _ = self.progress.send(frame);
        }
    }
}

/// What a job does at this moment, by its pace.
pub fn doing(pace: &Pace, job: &str, batches: &Counts, waiting: WaitReason) -> JobNow {
    let per_minute = pace.per_minute(job);
    let left = |rate: f64| (batches.open() as f64 / rate * 60_000.0) as i64;
    JobNow { waiting, per_minute, left_ms: per_minute.filter(|rate| *rate > 0.0).map(left) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a memory that grows with a job's length, a thinning that loses the ends, and a pace that is not the last
    /// minute's.
    #[test]
    fn samples_are_bounded_and_the_pace_is_the_present_one() {
        let pace = Pace::default();
        assert_eq!(pace.per_minute("a"), None);
        for step in 0..10_000 {
            // Ten batches a step of 3 s, and none in the last two minutes
            let done = 10 * step.min(9_960);
            pace.note("a", PaceSample { at: 3_000 * step, done });
        }
        let samples = pace.of("a");
        assert!(samples.len() < SAMPLES_MAX && samples.is_sorted_by_key(|sample| sample.at));
        assert_eq!((samples[0].at, samples.last().unwrap().at), (0, 29_997_000));
        assert!(pace.per_minute("a").is_none_or(|rate| rate < 200.0));
        for job in 0..3_000 {
            pace.note(&format!("b{job:05}"), PaceSample { at: 0, done: 0 });
        }
        assert!(lock(&pace.0).len() <= JOBS_MAX);
    }

    /// Catches a pace that is off by its unit.
    #[test]
    fn the_pace_is_per_minute() {
        let pace = Pace::default();
        for step in 0..100 {
            pace.note("a", PaceSample { at: 3_000 * step, done: 10 * step });
        }
        assert_eq!(pace.per_minute("a"), Some(200.0));
    }
}
