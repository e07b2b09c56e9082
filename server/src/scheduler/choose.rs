//! Which segments a worker may claim from, best first: fair between projects, by lot and priority between jobs, and
//! near what the worker has in memory.
//!
//! Shares are of workers, not of batches: a project of short batches has no more of the farm than one of long ones. A worker
//! stays on the segment that it walks while its project and its job are within their shares. Otherwise the project with the
//! least of its share comes first, and its jobs draw lots weighted by priority (Efraimidis and Spirakis, 2006), so that no
//! job starves. Within a job: what is warm, then its neighbours, then the middle of the widest stretch that nobody
//! walks, at last the tail of a segment that another worker walks from its head.

use std::collections::{BTreeMap, BTreeSet};

use super::farm::{Farm, Job, Pass, Segment, Worker};

/// Segments that are offered at most.
pub const CANDIDATES_MAX: usize = 8;
/// Jobs that are looked at for one claim at most.
const JOBS_MAX: usize = 16;
/// A project or a job may go this far over its share, and by one worker, while a worker stays where it is.
const STAY: f64 = 1.25;
/// Milliseconds that one claim should take.
const TARGET_MS: i64 = 60_000;
/// Batches of a claim while nobody knows how long one takes.
const SAMPLE: i64 = 4;

/// How near a claim is to what the worker has in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Locality {
    /// The segment that it walks.
    Own,
    /// A segment that it has in memory.
    Warm,
    /// Next to such a one.
    Adjacent,
    /// The tail of another worker's segment.
    Steal,
    /// Anything else.
    Cold,
}

impl Locality {
    /// A word for metrics.
    pub fn word(self) -> &'static str {
        match self {
            Self::Own => "own",
            Self::Warm => "warm",
            Self::Adjacent => "adjacent",
            Self::Steal => "steal",
            Self::Cold => "cold",
        }
    }
}

/// A segment to claim from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Candidate {
    /// The pass.
    pub pass: i64,
    /// The segment.
    pub segment: i64,
    /// How near it is.
    pub locality: Locality,
    /// Batches to take at most.
    pub count: i64,
}

/// Who asks.
#[derive(Clone, Copy, Debug)]
pub struct Asker<'a> {
    /// The worker's name.
    pub name: &'a str,
    /// What it is.
    pub worker: &'a Worker,
    /// Pass and segment of what it has in memory, latest first.
    pub warm: &'a [(i64, i64)],
    /// Batches that it takes at most.
    pub max: i64,
}

/// Segments for a worker to claim from, best first. `lot` is a random number.
pub fn choose(farm: &Farm, asker: &Asker<'_>, now: i64, lot: u64) -> Vec<Candidate> {
    let mut candidates: Vec<Candidate> = stay(farm, asker, now).into_iter().collect();
    for (_, job) in lottery(farm, asker, now, lot) {
        for pass in &job.passes {
            let Some(segments) = farm.passes.get(pass).map(|pass| &pass.segments) else { continue };
            for (segment, locality) in places(segments, *pass, asker, now) {
                if !candidates.iter().any(|c| (c.pass, c.segment) == (*pass, segment)) {
                    let count = count(farm, asker, &segments[&segment], job, now);
                    candidates.push(Candidate { pass: *pass, segment, locality, count });
                }
                if candidates.len() == CANDIDATES_MAX {
                    return candidates;
                }
            }
        }
    }
    candidates
}

/// The segment that the worker walks, while it may stay.
fn stay(farm: &Farm, asker: &Asker<'_>, now: i64) -> Option<Candidate> {
    asker.warm.iter().take(2).find_map(|&(pass, segment)| {
        let Pass { job, segments } = farm.passes.get(&pass)?;
        let found = segments.get(&segment)?;
        let mine = found.owner.as_deref() == Some(asker.name) && found.is_claimable(now);
        let job = farm.jobs.get(job).filter(|job| mine && is_open(farm, job, asker))?;
        let count = count(farm, asker, found, job, now);
        may_stay(farm, job).then_some(Candidate { pass, segment, locality: Locality::Own, count })
    })
}

/// Whether a worker may stay at a job: while its project among projects, and the job among those of its project, has no more
/// workers than it should.
fn may_stay(farm: &Farm, job: &Job) -> bool {
    let (mut wanting, mut weights) = (BTreeSet::new(), 0);
    for other in farm.jobs.values().filter(|other| !other.paused) {
        wanting.insert(&other.project);
        if other.project == job.project {
            weights += other.priority + 1;
        }
    }
    let projects = wanting.into_iter().filter_map(|name| farm.projects.get(name));
    let (leases, shares) = projects.fold((0, 0), |sum, p| (sum.0 + p.leases, sum.1 + p.share));
    let Some(project) = farm.projects.get(&job.project) else { return true };
    let within = |has: i64, all: i64, part: i64, parts: i64| {
        has as f64 <= STAY * all as f64 * part as f64 / parts.max(1) as f64 + 1.0
    };
    within(project.leases, leases, project.share, shares)
        && within(job.leases, project.leases, job.priority + 1, weights)
}

/// Jobs that the worker may work for, in the order in which they are tried.
fn lottery<'a>(farm: &'a Farm, asker: &Asker<'_>, now: i64, lot: u64) -> Vec<(&'a String, &'a Job)> {
    let claimable = |pass: &i64| farm.passes.get(pass).is_some_and(|p| has_work(p, now));
    let blocks = farm.blocks.get(asker.name);
    let jobs = farm.jobs.iter().filter(|(id, job)| {
        is_open(farm, job, asker)
            && !blocks.is_some_and(|jobs| jobs.contains(*id))
            && job.passes.iter().any(claimable)
    });
    let mut drawn: Vec<(f64, f64, &String, &Job)> = jobs
        .map(|(id, job)| {
            let project = farm.projects.get(&job.project);
            let load = project.map_or(0.0, |p| p.leases as f64 / p.share.max(1) as f64);
            // The greatest of u^(1/w) wins with a chance in proportion to w
            let draw = unit(lot, id).ln() / (job.priority + 1) as f64;
            (load, draw, id, job)
        })
        .collect();
    drawn.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1)));
    drawn.into_iter().take(JOBS_MAX).map(|(_, _, id, job)| (id, job)).collect()
}

fn has_work(pass: &Pass, now: i64) -> bool {
    pass.segments.values().any(|segment| segment.is_claimable(now))
}

fn is_open(farm: &Farm, job: &Job, asker: &Asker<'_>) -> bool {
    let below = |running: i64, max: Option<i64>| max.is_none_or(|max| running < max);
    let project = farm.projects.get(&job.project);
    !job.paused
        && below(job.running, job.running_max)
        && project.is_none_or(|project| below(project.running, project.running_max))
        && asker.worker.has(&job.requires)
}

/// Segments of a pass, nearest first.
fn places(segments: &BTreeMap<i64, Segment>, pass: i64, asker: &Asker<'_>, now: i64) -> Vec<(i64, Locality)> {
    let claimable = |number: &i64| segments.get(number).is_some_and(|segment| segment.is_claimable(now));
    let free = |number: &i64| claimable(number) && !segments[number].is_foreign(asker.name, now);
    let warm = || asker.warm.iter().take(8).filter(|&&(p, _)| p == pass).map(|&(_, segment)| segment);
    let mut found: Vec<(i64, Locality)> = Vec::new();
    found.extend(warm().filter(free).map(|segment| (segment, Locality::Warm)));
    found.extend(
        warm().flat_map(|s| [s + 1, s - 1]).filter(free).map(|segment| (segment, Locality::Adjacent)),
    );
    found.extend(widest_stretch(segments, &free, now).map(|segment| (segment, Locality::Cold)));
    let fullest = segments.iter().filter(|(n, s)| claimable(n) && s.is_foreign(asker.name, now));
    found.extend(fullest.max_by_key(|(_, s)| s.ready).map(|(&segment, _)| (segment, Locality::Steal)));
    found
}

/// The first segment of the later half of the widest stretch that nobody walks: its neighbours stay free for whoever
/// walks up to it. The very first segment of a pass that nobody walks is its beginning.
fn widest_stretch(segments: &BTreeMap<i64, Segment>, free: &dyn Fn(&i64) -> bool, now: i64) -> Option<i64> {
    let owned = |segment: &Segment| segment.owner.is_some() && segment.owner_until > now;
    if !segments.values().any(owned) {
        return segments.keys().find(|number| free(number)).copied();
    }
    let (mut best, mut stretch): (Vec<i64>, Vec<i64>) = Default::default();
    for number in segments.keys() {
        if free(number) {
            stretch.push(*number);
        } else {
            stretch.clear();
        }
        if stretch.len() > best.len() {
            best.clone_from(&stretch);
        }
    }
    best.get(best.len() / 2).copied()
}

/// Batches to take: about a minute's worth, few while that is not known, single ones when little is left.
fn count(farm: &Farm, asker: &Asker<'_>, segment: &Segment, job: &Job, now: i64) -> i64 {
    let (mut left, mut known, mut sum_ms) = (0, 0, 0);
    let passes = job.passes.iter().filter_map(|pass| farm.passes.get(pass));
    for other in passes.flat_map(|pass| pass.segments.values()).take(4096) {
        left += other.ready;
        known += i64::from(other.batch_ms > 0);
        sum_ms += other.batch_ms;
    }
    let worth = match (segment.batch_ms, known) {
        (0, 0) => SAMPLE,
        (0, known) => TARGET_MS / (sum_ms / known).max(1),
        (batch_ms, _) => TARGET_MS / batch_ms,
    };
    let fair = (left / farm.alive(now).max(1)).max(1);
    let room = job.running_max.map_or(i64::MAX, |max| (max - job.running).max(1));
    asker.max.min(worth.max(1)).min(fair).min(room).clamp(1, protocol::limits::CLAIM_MAX)
}

/// A number in (0, 1] that depends on both (the finaliser of splitmix64).
fn unit(lot: u64, id: &str) -> f64 {
    let mut x = id.bytes().fold(lot, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3));
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ (x >> 31)) >> 11).wrapping_add(1) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::super::farm::Project;
    use super::*;

    fn farm(jobs: &[(&str, &str, i64)], segments: i64, ready: i64) -> Farm {
        let mut farm = Farm::default();
        for (number, &(id, project, priority)) in jobs.iter().enumerate() {
            let pass = number as i64;
            let segment = Segment { ready, ..Segment::default() };
            let segments = (0..segments).map(|s| (s, segment.clone())).collect();
            farm.passes.insert(pass, Pass { job: id.into(), segments });
            farm.projects.entry(project.into()).or_insert(Project {
                share: 100,
                running_max: None,
                running: 0,
                leases: 0,
            });
            let project = project.to_string();
            let (paused, running_max, running, leases, requires) = (false, None, 0, 0, Vec::new());
            let passes = vec![pass];
            let job = Job { project, priority, paused, running_max, running, leases, requires, passes };
            farm.jobs.insert(id.into(), job);
        }
        for i in 0..4 {
            farm.workers.insert(format!("w{i}"), Worker::default());
        }
        farm
    }

    fn first(farm: &Farm, name: &str, warm: &[(i64, i64)], lot: u64) -> Option<Candidate> {
        let asker = Asker { name, worker: &farm.workers[name], warm, max: 16 };
        choose(farm, &asker, 1_000, lot).first().copied()
    }

    /// Catches a lottery that ignores priorities, or starves a job.
    #[test]
    fn jobs_win_in_proportion_to_their_priority() {
        let farm = farm(&[("a", "p", 9), ("b", "p", 29), ("c", "p", 0)], 1, 100);
        let mut wins = [0; 3];
        for lot in 0..4100_u64 {
            let lot = lot.wrapping_mul(0x9e37_79b9_7f4a_7c15);
            wins[first(&farm, "w0", &[], lot).unwrap().pass as usize] += 1;
        }
        let near = |wins: i32, share: i32| (wins - share).abs() < 150;
        assert!(near(wins[0], 1000) && near(wins[1], 3000) && near(wins[2], 100), "{wins:?}");
    }

    /// Catches a project that takes more than its share while another waits.
    #[test]
    fn projects_get_their_shares() {
        let mut farm = farm(&[("a", "p", 50), ("b", "q", 50)], 64, 1000);
        farm.projects.get_mut("p").unwrap().share = 300;
        for lot in 0..400 {
            let won = first(&farm, "w0", &[], lot * 77).unwrap();
            farm.claimed(won.pass, won.segment, None, 1 + lot as i64 % 7);
        }
        assert_eq!((farm.projects["p"].leases, farm.projects["q"].leases), (300, 100));
    }

    /// Catches workers that crowd into one segment, or leave their own while it has work.
    #[test]
    fn workers_stay_and_keep_apart() {
        let mut farm = farm(&[("a", "p", 50)], 9, 100);
        let mut warm = Vec::new();
        for (worker, expected) in [("w0", 0), ("w1", 5), ("w2", 3)] {
            let won = first(&farm, worker, &[], 5).unwrap();
            assert_eq!((won.segment, won.locality), (expected, Locality::Cold), "{worker}");
            farm.claimed(won.pass, won.segment, Some((worker, 9_999)), 16);
            warm.push((won.pass, won.segment));
        }
        let again = first(&farm, "w1", &warm[1..2], 6).unwrap();
        assert_eq!((again.segment, again.locality), (5, Locality::Own));
        farm.passes.get_mut(&0).unwrap().segments.get_mut(&5).unwrap().ready = 0;
        assert_eq!(first(&farm, "w1", &warm[1..2], 6).unwrap().locality, Locality::Adjacent);
    }

    /// Catches workers that stay at a job while another of its project, as urgent or more so, gets nobody; and ones that leave
    /// although all have what is theirs.
    #[test]
    fn workers_leave_a_job_that_has_more_than_its_part() {
        let mut farm = farm(&[("a", "p", 49), ("b", "p", 49)], 4, 100);
        for worker in ["w0", "w1", "w2", "w3"] {
            farm.claimed(0, 0, Some((worker, 9_999)), 8);
        }
        let stays = |farm: &Farm| first(farm, "w3", &[(0, 0)], 1).unwrap().locality == Locality::Own;
        assert!(!stays(&farm), "four of four workers");
        farm.returned(0, 0, 8, 0, true);
        farm.claimed(1, 0, Some(("w0", 9_999)), 8);
        assert!(stays(&farm), "three of four, one over its part");
    }

    /// Catches claims of an hour by workers that cannot know it, and estimates of one segment that others do not use.
    #[test]
    fn claims_are_short_until_the_pace_is_known() {
        let mut farm = farm(&[("a", "p", 50)], 2, 1_000);
        let count = |farm: &Farm| first(farm, "w0", &[], 1).unwrap().count;
        assert_eq!(count(&farm), SAMPLE);
        farm.passes.get_mut(&0).unwrap().segments.get_mut(&1).unwrap().batch_ms = TARGET_MS / 10;
        assert_eq!(count(&farm), 10);
    }

    /// Catches a paused, full or foreign job that is worked for all the same.
    #[test]
    fn closed_jobs_get_nobody() {
        let open = farm(&[("a", "p", 50)], 1, 100);
        assert!(first(&open, "w0", &[], 1).is_some());
        let closed = |change: &dyn Fn(&mut Farm)| {
            let mut farm = open.clone();
            change(&mut farm);
            first(&farm, "w0", &[], 1).is_none()
        };
        assert!(closed(&|farm| farm.jobs.get_mut("a").unwrap().paused = true));
        assert!(closed(&|farm| farm.jobs.get_mut("a").unwrap().running_max = Some(0)));
        assert!(closed(&|farm| farm.projects.get_mut("p").unwrap().running_max = Some(0)));
        assert!(closed(&|farm| farm.jobs.get_mut("a").unwrap().requires = vec!["gpu".into()]));
        assert!(closed(&|farm| drop(farm.blocks.insert("w0".into(), ["a".into()].into()))));
    }

    /// Catches a tail of a pass that one worker keeps to itself while others idle.
    #[test]
    fn tails_are_shared_and_taken_singly() {
        let mut farm = farm(&[("a", "p", 50)], 1, 3);
        farm.workers.values_mut().for_each(|worker| worker.last_seen = 1_000);
        farm.claimed(0, 0, Some(("w0", 9_999)), 1);
        let won = first(&farm, "w1", &[], 1).unwrap();
        assert_eq!((won.locality, won.count), (Locality::Steal, 1));
    }
}
