//! The graph of a job: import → brick maps and plans → bake → merge → published. Says what comes next.

use protocol::work::{PassResult, Task};
use protocol::{PassKind, PassState};

/// A pass as the graph sees it.
#[derive(Clone, Debug)]
pub struct Pass {
    /// Its id.
    pub id: i64,
    /// What it does.
    pub kind: PassKind,
    /// The bake set or brick map that it is about.
    pub name: String,
    /// How far it is.
    pub state: PassState,
    /// What it was asked.
    pub task: Task,
    /// What it found out.
    pub result: Option<PassResult>,
    /// Where its result is, for passes of one batch.
    pub result_key: Option<String>,
    /// Batches that are to run or are running.
    pub open: i64,
    /// Batches that failed too often.
    pub failed: i64,
    /// Batches that were skipped.
    pub skipped: i64,
}

/// A job as the graph sees it.
#[derive(Clone, Debug)]
pub struct Job {
    /// What every pass is asked in common.
    pub task: Task,
    /// Whether a result with holes is wanted.
    pub partial: bool,
    /// Batches that may fail before the job is given up.
    pub failed_max: i64,
    /// Its passes so far.
    pub passes: Vec<Pass>,
}

/// What to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// Make a pass of so many batches.
    Create {
        /// What it does.
        kind: PassKind,
        /// What it is about.
        name: String,
        /// What it is asked.
        task: Box<Task>,
        /// Batches.
        batches: i64,
        /// Whether it can begin at once.
        open: bool,
    },
    /// What the pass waited for is there.
    Open(i64),
    /// The pass has ended.
    End(i64, PassState),
    /// Publish: all of it is there.
    Succeed {
        /// Whether points lack a result.
        incomplete: bool,
    },
    /// The job has failed.
    Fail(String),
}

/// The next steps of a job; none where it waits for its batches. To be asked again after the steps are taken.
pub fn next_steps(job: &Job) -> Vec<Step> {
    let ended: Vec<Step> = job.passes.iter().filter_map(|pass| ends(job, pass)).collect();
    if !ended.is_empty() {
        return ended;
    }
    if let Some(failed) = job.passes.iter().find(|pass| pass.state == PassState::Failed) {
        let reason =
            format!("{} batches of {} `{}` failed too often", failed.failed, failed.kind, failed.name);
        return vec![Step::Fail(reason)];
    }
    let Some(import) = find(job, PassKind::Import, "") else {
        return vec![create(PassKind::Import, "", job.task.clone(), 1, true)];
    };
    let (PassState::Done, Some(PassResult::Import { sets })) = (import.state, &import.result) else {
        return Vec::new();
    };
    let with_inputs = Task { inputs: import.result_key.clone(), ..job.task.clone() };
    let mut steps = Vec::new();
    for set in sets {
        let task = |kind| Task {
            kind,
            set: Some(set.set.clone()),
            map: Some(set.map.clone()),
            partial: job.partial,
            ..with_inputs.clone()
        };
        set_steps(job, &set.set, &set.map, &task, &mut steps);
    }
    let merges = |state| job.passes.iter().filter(|p| p.kind == PassKind::Merge && p.state == state).count();
    if steps.is_empty() && merges(PassState::Done) == sets.len() {
        let holes = |pass: &Pass| pass.kind == PassKind::Bake && pass.failed + pass.skipped > 0;
        steps.push(Step::Succeed { incomplete: job.passes.iter().any(holes) });
    }
    steps
}

/// The next steps of one bake set.
fn set_steps(job: &Job, set: &str, map: &str, task: &dyn Fn(PassKind) -> Task, steps: &mut Vec<Step>) {
    let build = find(job, PassKind::Build, map);
    let known = |step: &Step| matches!(step, Step::Create { kind: PassKind::Build, name, .. } if name == map);
    if build.is_none() && !steps.iter().any(known) {
        let task = Task { set: None, ..task(PassKind::Build) };
        steps.push(create(PassKind::Build, map, task, 1, true));
    }
    let Some(plan) = find(job, PassKind::Plan, set) else {
        steps.push(create(PassKind::Plan, set, task(PassKind::Plan), 1, true));
        return;
    };
    let (PassState::Done, Some(PassResult::Plan { batches, .. })) = (plan.state, &plan.result) else {
        return;
    };
    let planned = |kind| Task { plan: plan.result_key.clone(), ..task(kind) };
    let built = build.is_some_and(|build| build.state == PassState::Done);
    let Some(bake) = find(job, PassKind::Bake, set) else {
        steps.push(create(PassKind::Bake, set, planned(PassKind::Bake), *batches, false));
        return;
    };
    if bake.state == PassState::Waiting && built {
        steps.push(Step::Open(bake.id));
    }
    match find(job, PassKind::Merge, set) {
        None if bake.state == PassState::Done => {
            let partial = bake.failed + bake.skipped > 0;
            let task = Task { parts: Some(bake.id), partial, ..planned(PassKind::Merge) };
            steps.push(create(PassKind::Merge, set, task, 1, true));
        }
        // A damaged part took the bake back: the merge waited for it
        Some(merge) if merge.state == PassState::Waiting && bake.state == PassState::Done => {
            steps.push(Step::Open(merge.id));
        }
        _ => {}
    }
}

/// Whether a pass that is open has come to its end.
fn ends(job: &Job, pass: &Pass) -> Option<Step> {
    if pass.state != PassState::Open {
        return None;
    }
    let may_fail = if job.partial { i64::MAX } else { job.failed_max };
    if pass.kind == PassKind::Bake && pass.failed > may_fail && job.failed_max > 0 {
        return Some(Step::End(pass.id, PassState::Failed));
    }
    if pass.open > 0 {
        return None;
    }
    let holes_allowed = job.partial && pass.kind == PassKind::Bake;
    let whole = pass.failed == 0 && (pass.skipped == 0 || holes_allowed);
    let state = if whole || holes_allowed { PassState::Done } else { PassState::Failed };
    Some(Step::End(pass.id, state))
}

fn find<'a>(job: &'a Job, kind: PassKind, name: &str) -> Option<&'a Pass> {
    job.passes.iter().find(|pass| pass.kind == kind && (pass.name == name || kind == PassKind::Import))
}

fn create(kind: PassKind, name: &str, task: Task, batches: i64, open: bool) -> Step {
    Step::Create { kind, name: name.into(), task: Box::new(Task { kind, ..task }), batches, open }
}

#[cfg(test)]
mod tests {
    use protocol::work::SetMap;

    use super::*;

    fn task() -> Task {
        Task {
            kind: PassKind::Import,
            job: "j".into(),
            settings: Default::default(),
            set: None,
            map: None,
            inputs: None,
            plan: None,
            parts: None,
            partial: false,
        }
    }

    /// Takes steps until none is left, every pass ending with the given count of failed batches for a bake.
    fn play(job: &mut Job, bake_failed: i64) -> Vec<String> {
        let mut log = Vec::new();
        for _ in 0..100 {
            let steps = next_steps(job);
            if steps.is_empty() {
                // The farm does what is open
                let Some(pass) = job.passes.iter_mut().find(|p| p.state == PassState::Open && p.open > 0)
                else {
                    return log;
                };
                pass.open = 0;
                pass.failed = if pass.kind == PassKind::Bake { bake_failed } else { 0 };
                let set = |set: &str| SetMap { set: set.into(), map: "m".into() };
                pass.result = match pass.kind {
                    PassKind::Import => Some(PassResult::Import { sets: vec![set("a"), set("b")] }),
                    PassKind::Plan => Some(PassResult::Plan { batches: 7, points: 70 }),
                    _ => None,
                };
                pass.result_key = Some(format!("{}/{}", pass.kind, pass.name));
            }
            for step in steps {
                match step {
                    Step::Create { kind, name, task, batches, open } => {
                        log.push(format!("{kind} {name}"));
                        let state = if open { PassState::Open } else { PassState::Waiting };
                        let id = job.passes.len() as i64;
                        let (result, result_key) = (None, None);
                        job.passes.push(Pass {
                            id,
                            kind,
                            name,
                            state,
                            task: *task,
                            result,
                            result_key,
                            open: batches,
                            failed: 0,
                            skipped: 0,
                        });
                    }
                    Step::Open(id) => job.passes[id as usize].state = PassState::Open,
                    Step::End(id, state) => job.passes[id as usize].state = state,
                    Step::Succeed { incomplete } => {
                        log.push(format!("succeed {incomplete}"));
                        return log;
                    }
                    Step::Fail(reason) => {
                        log.push(reason);
                        return log;
                    }
                }
            }
        }
        panic!("the job has no end: {log:?}");
    }

    /// Catches a brick map that is built twice for two sets, a bake before its map, and an end before the last merge.
    #[test]
    fn passes_come_in_order() {
        let mut job = Job { task: task(), partial: false, failed_max: 0, passes: Vec::new() };
        let expected = [
            "import ",
            "build m",
            "plan a",
            "plan b",
            "bake a",
            "bake b",
            "merge a",
            "merge b",
            "succeed false",
        ];
        assert_eq!(play(&mut job, 0), expected);
        let bake = find(&job, PassKind::Bake, "a").unwrap();
        assert_eq!(bake.task.plan.as_deref(), Some("plan/a"));
        assert_eq!(bake.task.inputs.as_deref(), Some("import/"));
    }

    /// Catches a job that publishes with holes nobody asked for, and one that does not when it was asked to.
    #[test]
    fn holes_are_published_only_on_request() {
        let mut job = Job { task: task(), partial: false, failed_max: 0, passes: Vec::new() };
        assert_eq!(play(&mut job, 2).last().unwrap(), "2 batches of bake `a` failed too often");
        let mut job = Job { task: task(), partial: true, failed_max: 0, passes: Vec::new() };
        assert_eq!(play(&mut job, 2).last().unwrap(), "succeed true");
        assert!(find(&job, PassKind::Merge, "a").unwrap().task.partial);
    }
}
