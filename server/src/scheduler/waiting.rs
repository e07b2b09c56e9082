//! Why a job's batches wait: exactly one reason at a time, the first that holds of a fixed order.

use protocol::{JobState, WaitReason};

use super::farm::{Farm, Worker};

/// A job as this question sees it.
#[derive(Clone, Copy, Debug)]
pub struct Question<'a> {
    /// Its id.
    pub job: &'a str,
    /// How far it is.
    pub state: JobState,
    /// Batches that are ready but must wait after a failure.
    pub backing_off: i64,
}

/// The reason.
pub fn reason(farm: &Farm, question: &Question<'_>, now: i64) -> WaitReason {
    if question.state == JobState::Blocked {
        return WaitReason::Dependency;
    }
    let Some(job) = farm.jobs.get(question.job) else {
        // No pass of it is open: it is between two passes, or its end
        return if question.state.is_final() { WaitReason::Flowing } else { WaitReason::Dependency };
    };
    if job.paused {
        return WaitReason::Paused;
    }
    let alive: Vec<(&String, &Worker)> = farm.workers.iter().filter(|(_, w)| w.is_alive(now)).collect();
    let matching: Vec<&String> =
        alive.iter().filter(|(_, w)| w.has(&job.requires)).map(|(name, _)| *name).collect();
    let blocked = |name: &&&String| farm.blocks.get(**name).is_some_and(|jobs| jobs.contains(question.job));
    let reached = |running: i64, max: Option<i64>| max.is_some_and(|max| running >= max);
    let segments = || job.passes.iter().filter_map(|p| farm.passes.get(p)).flat_map(|p| p.segments.values());
    let ready: i64 = segments().map(|segment| segment.ready).sum();
    match () {
        () if ready == 0 => WaitReason::Flowing,
        () if alive.is_empty() => WaitReason::NoWorker,
        () if matching.is_empty() => WaitReason::NoMatch,
        () if matching.iter().filter(blocked).count() == matching.len() => WaitReason::AllWorkersBlocked,
        () if reached(job.running, job.running_max) => WaitReason::Limit,
        () if farm.projects.get(&job.project).is_some_and(|p| reached(p.running, p.running_max)) => {
            WaitReason::Quota
        }
        () if question.backing_off >= ready => WaitReason::Backoff,
        () if job.running > 0 => WaitReason::Flowing,
        () => WaitReason::Capacity,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::super::farm::{Job, Pass, Project, Segment};
    use super::*;

    /// Catches a reason that hides the one that a person can do something about.
    #[test]
    fn the_first_reason_that_holds_is_told() {
        let mut farm = Farm::default();
        let question = Question { job: "a", state: JobState::Ready, backing_off: 0 };
        assert_eq!(reason(&farm, &question, 0), WaitReason::Dependency);
        let segments = BTreeMap::from([(0, Segment { ready: 5, ..Segment::default() })]);
        farm.passes.insert(0, Pass { job: "a".into(), segments });
        let job = Job {
            project: "p".into(),
            priority: 50,
            paused: false,
            running_max: Some(1),
            running: 0,
            leases: 0,
            requires: vec!["gpu".into()],
            passes: vec![0],
        };
        farm.jobs.insert("a".into(), job);
        farm.projects.insert("p".into(), Project { share: 1, running_max: Some(1), running: 1, leases: 1 });
        let mut told = vec![reason(&farm, &question, 0)];
        let mut then = |change: &mut dyn FnMut(&mut Farm)| {
            change(&mut farm);
            told.push(reason(&farm, &question, 0));
        };
        then(&mut |farm| drop(farm.workers.insert("w".into(), Worker::default())));
        then(&mut |farm| farm.workers.get_mut("w").unwrap().labels = vec!["gpu".into()]);
        then(&mut |farm| farm.projects.get_mut("p").unwrap().running = 0);
        then(&mut |farm| farm.jobs.get_mut("a").unwrap().running = 1);
        then(&mut |farm| farm.jobs.get_mut("a").unwrap().running_max = None);
        then(&mut |farm| drop(farm.blocks.insert("w".into(), ["a".into()].into())));
        then(&mut |farm| farm.jobs.get_mut("a").unwrap().paused = true);
        use WaitReason::{AllWorkersBlocked, Capacity, Flowing, Limit, NoMatch, NoWorker, Paused, Quota};
        assert_eq!(told, [NoWorker, NoMatch, Quota, Capacity, Limit, Flowing, AllWorkersBlocked, Paused]);
    }
}
