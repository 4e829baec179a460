//! Which jobs a worker is given: free slots times ready jobs.

use std::collections::BTreeSet;

use planesweep_plan::{Attempt, WorkerId};

use super::state::{Ordinal, State, Worker};
use super::{Class, Command, FreeSlots, Snapshot, Timestamp};

/// How far after a worker's last job the next one may lie to be of the same stretch. Neighbours in plan
/// order share source images; far ones share nothing.
const NEAR: Ordinal = 8;
/// Ready jobs that are compared for where their inputs lie, from the first on, and from the worker's last
/// one on.
const COMPARED: usize = 32;

/// Fills free slots with ready jobs.
///
/// - Inference goes on along the plan, where the worker has the images and their features. One that
///   cannot, takes the second half of the longest stretch that another works on: so each works on
///   neighbours, and nobody waits while there is work.
/// - Other jobs go where their inputs are in memory: to the worker that made most of them, or to one on
///   its host. What suits one of the `waiting` better is left to it.
/// - A suspect is given only to a worker that holds nothing, ahead of all else, and that worker is
///   given nothing beside it. So the next death says whose fault it is.
pub(super) fn wants_work(
    snapshot: &Snapshot,
    id: &WorkerId,
    free: FreeSlots,
    waiting: &[WorkerId],
    now: Timestamp,
) -> Vec<Command> {
    let Some(worker) = snapshot.workers.get(id) else { return Vec::new() };
    let holds_suspect = worker.holds.iter().any(|held| snapshot.jobs[*held as usize].suspect);
    if !worker.ready || holds_suspect {
        return Vec::new();
    }
    let grant = |ordinal: Ordinal| {
        let job = &snapshot.jobs[ordinal as usize];
        Command::Grant {
            job: job.id,
            attempt: Attempt(job.attempt.0 + 1),
            worker: id.clone(),
            deadline: worker.deadline,
        }
    };
    if worker.holds.is_empty() {
        let has_slot = |ordinal: &Ordinal| match snapshot.jobs[*ordinal as usize].class {
            Class::Infer => free.infer > 0,
            Class::Fuse => free.fuse > 0,
        };
        if let Some(suspect) = snapshot.suspects.iter().find(|s| snapshot.is_due(**s, now) && has_slot(s)) {
            return vec![grant(*suspect)];
        }
    }
    let waiting: Vec<(&WorkerId, &Worker)> = waiting
        .iter()
        .filter(|other| *other != id)
        .filter_map(|id| snapshot.workers.get_key_value(id))
        .collect();
    let mut jobs = inferences(snapshot, id, worker, free.infer, now);
    jobs.extend(other_jobs(snapshot, (id, worker), free.fuse, &waiting, now));
    jobs.into_iter().map(grant).collect()
}

/// The next inferences of the worker's stretch, or of a new one.
fn inferences(
    snapshot: &Snapshot,
    id: &WorkerId,
    worker: &Worker,
    free: u32,
    now: Timestamp,
) -> Vec<Ordinal> {
    let Some(ready) = snapshot.ready.get(&Class::Infer).filter(|_| free > 0) else { return Vec::new() };
    let others = snapshot.workers.iter().filter(|(other, _)| *other != id);
    let others = Others(others.filter_map(|(_, worker)| worker.last.get(&Class::Infer).copied()).collect());
    let mut last = worker.last.get(&Class::Infer).copied();
    let mut jobs = Vec::new();
    for _ in 0..free {
        let may_be_taken = |job: &&Ordinal| snapshot.is_due(**job, now) && !jobs.contains(*job);
        // The reach moves on with each job taken, as if each were the last one.
        let near = last.and_then(|last| {
            let near = ready.range(last + 1..=last.saturating_add(NEAR)).find(may_be_taken);
            near.filter(|job| !others.is_between(last, **job))
        });
        let next = near.copied().or_else(|| {
            let left: Vec<Ordinal> = ready.iter().filter(may_be_taken).copied().collect();
            others.start_of_a_stretch(&left)
        });
        let Some(next) = next else { break };
        jobs.push(next);
        last = Some(next);
    }
    jobs
}

/// How far other workers have come with their inferences.
struct Others(BTreeSet<Ordinal>);

impl Others {
    fn is_between(&self, job: Ordinal, next: Ordinal) -> bool {
        self.0.range(job + 1..next).next().is_some()
    }

    /// Where a worker begins that has nothing near its last job: at the longest stretch, and in its middle
    /// if another worker is coming along it.
    fn start_of_a_stretch(&self, left: &[Ordinal]) -> Option<Ordinal> {
        let stretches = left.chunk_by(|job, next| next - job <= NEAR && !self.is_between(*job, *next));
        let longest =
            stretches.reduce(|longest, other| if other.len() > longest.len() { other } else { longest })?;
        let first = longest[0];
        let is_taken_up = self.0.range(first.saturating_sub(NEAR)..first).next().is_some();
        Some(if is_taken_up { longest[longest.len() / 2] } else { first })
    }
}

/// The ready jobs whose inputs are nearest to the worker, the first in the plan if there are several.
fn other_jobs(
    snapshot: &Snapshot,
    worker: (&WorkerId, &Worker),
    free: u32,
    waiting: &[(&WorkerId, &Worker)],
    now: Timestamp,
) -> Vec<Ordinal> {
    let Some(ready) = snapshot.ready.get(&Class::Fuse).filter(|_| free > 0) else { return Vec::new() };
    let from = worker.1.last.get(&Class::Fuse).map_or(0, |last| last + 1);
    let due = |job: &&Ordinal| snapshot.is_due(**job, now);
    let first = ready.iter().filter(due).take(COMPARED);
    let mut compared: Vec<(u32, Ordinal)> = first
        .chain(ready.range(from..).filter(due).take(COMPARED))
        .map(|job| (nearness(snapshot, *job, worker), *job))
        .filter(|(own, job)| waiting.iter().all(|other| nearness(snapshot, *job, *other) <= *own))
        .collect();
    compared.sort_by_key(|(nearness, job)| (std::cmp::Reverse(*nearness), *job));
    compared.dedup();
    compared.into_iter().take(free as usize).map(|(_, job)| job).collect()
}

/// How many of a job's inputs the worker has in memory, or has near: what it made itself weighs more than
/// what reaches it through the memory of its host.
fn nearness(snapshot: &Snapshot, job: Ordinal, (id, worker): (&WorkerId, &Worker)) -> u32 {
    let makers = snapshot.jobs[job as usize].needs.iter().filter_map(|need| snapshot.maker(*need));
    makers
        .map(|maker| match maker {
            maker if maker.worker == *id => 2,
            maker if maker.host == worker.host => 1,
            _ => 0,
        })
        .sum()
}

impl Snapshot {
    /// Whether an open job may be granted as far as its delay is concerned.
    fn is_due(&self, job: Ordinal, now: Timestamp) -> bool {
        matches!(self.jobs[job as usize].state, State::Open { not_before, .. } if not_before <= now)
    }
}

#[cfg(test)]
mod tests {
    use planesweep_plan::JobId;
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::super::{Ending, Event, Finished, JobShape, decide};
    use super::*;

    fn id(job: usize) -> JobId {
        let mut id = [0; 32];
        id[..8].copy_from_slice(&(job as u64).to_be_bytes());
        JobId(id)
    }

    fn worker(k: usize) -> WorkerId {
        WorkerId(format!("w{k}"))
    }

    fn happen(snapshot: &mut Snapshot, event: Event) -> Vec<usize> {
        let commands = decide(snapshot, event, Timestamp(0));
        let mut granted = Vec::new();
        for command in &commands {
            assert!(snapshot.apply(command, Timestamp(0)), "{command:?}");
            if let Command::Grant { job, .. } = command {
                granted.push(u64::from_be_bytes(*job.0.first_chunk().expect("32 bytes")) as usize);
            }
        }
        granted
    }

    fn report(snapshot: &mut Snapshot, k: usize, host: &str, done: &[usize]) {
        let finished = done
            .iter()
            .map(|job| Finished { job: id(*job), attempt: Attempt(1), ending: Ending::Success })
            .collect();
        let (worker, host) = (worker(k), host.to_owned());
        happen(snapshot, Event::Reported { worker, host, ready: true, held: vec![], finished });
    }

    fn wants(snapshot: &mut Snapshot, k: usize, free: FreeSlots, waiting: &[usize]) -> Vec<usize> {
        let waiting = waiting.iter().map(|k| worker(*k)).collect();
        happen(snapshot, Event::WantsWork { worker: worker(k), free, waiting })
    }

    const INFER: FreeSlots = FreeSlots { infer: 1, fuse: 0 };

    #[test]
    fn each_worker_goes_along_a_stretch_of_its_own() {
        let (views, workers) = (1000, 5);
        let mut snapshot = Snapshot::new(7000, [], Timestamp(0));
        let shape = |job| JobShape { id: id(job), class: Class::Infer, needs: vec![] };
        happen(&mut snapshot, Event::Submitted { jobs: (0..views).map(shape).collect() });
        let mut done = vec![Vec::new(); workers];
        for round in 0.. {
            let k = round % workers;
            let finished: Vec<usize> = done[k].last().copied().into_iter().collect();
            report(&mut snapshot, k, "host", &finished);
            let granted = wants(&mut snapshot, k, INFER, &[]);
            if granted.is_empty() {
                break;
            }
            done[k].extend(granted);
        }
        let all: BTreeSet<usize> = done.iter().flatten().copied().collect();
        assert_eq!(all.len(), views, "all are done, each once");
        for jobs in &done {
            let leaps = jobs.windows(2).filter(|pair| pair[1] != pair[0] + 1).count();
            assert!(jobs.len() > views / workers / 2 && leaps < 20, "{} jobs, {leaps} leaps", jobs.len());
        }
    }

    proptest! {
        #[test]
        fn no_slot_stays_free_while_there_is_work_and_no_job_is_given_twice(
            views in 1..60_usize,
            wishes in vec((0..4_usize, 0..4_u32), 1..80),
        ) {
            let mut snapshot = Snapshot::new(7000, [], Timestamp(0));
            let shape = |job| JobShape { id: id(job), class: Class::Infer, needs: vec![] };
            happen(&mut snapshot, Event::Submitted { jobs: (0..views).map(shape).collect() });
            let mut given: BTreeSet<usize> = BTreeSet::new();
            for k in 0..4 {
                report(&mut snapshot, k, "host", &[]);
            }
            for (k, free) in wishes {
                let granted = wants(&mut snapshot, k, FreeSlots { infer: free, fuse: 0 }, &[]);
                prop_assert_eq!(granted.len(), (free as usize).min(views - given.len()));
                prop_assert!(granted.iter().all(|job| given.insert(*job)));
            }
        }

        /// Workers 0 and 1 are on host a, 2 on host b, 3 on host c and made nothing.
        #[test]
        fn jobs_go_where_their_inputs_lie(
            makers in vec(0..3_usize, 1..12),
            needs in vec(vec(any::<prop::sample::Index>(), 0..5), 1..12),
            free in 1..4_u32,
            waiting in prop::sample::subsequence(vec![0, 1, 2, 3], 0..4),
        ) {
            const HOSTS: [&str; 4] = ["a", "a", "b", "c"];
            let maps = makers.len();
            let needs: Vec<BTreeSet<usize>> =
                needs.iter().map(|needs| needs.iter().map(|need| need.index(maps)).collect()).collect();
            let mut snapshot = Snapshot::new(7000, [], Timestamp(0));
            let infer = (0..maps).map(|job| JobShape { id: id(job), class: Class::Infer, needs: vec![] });
            let fuse = needs.iter().enumerate().map(|(k, needs)| JobShape {
                id: id(maps + k),
                class: Class::Fuse,
                needs: needs.iter().map(|need| id(*need)).collect(),
            });
            happen(&mut snapshot, Event::Submitted { jobs: infer.chain(fuse).collect() });
            for (k, host) in HOSTS.iter().enumerate() {
                report(&mut snapshot, k, host, &[]);
            }
            for (map, maker) in makers.iter().enumerate() {
                let command = Command::Grant {
                    job: id(map),
                    attempt: Attempt(1),
                    worker: worker(*maker),
                    deadline: Timestamp(7000),
                };
                prop_assert!(snapshot.apply(&command, Timestamp(0)));
                report(&mut snapshot, *maker, HOSTS[*maker], &[map]);
            }
            let nearness = |job: usize, k: usize| -> usize {
                let weigh = |need: &usize| match makers[*need] {
                    maker if maker == k => 2,
                    maker => usize::from(HOSTS[maker] == HOSTS[k]),
                };
                needs[job - maps].iter().map(weigh).sum()
            };
            let granted = wants(&mut snapshot, 0, FreeSlots { infer: 0, fuse: free }, &waiting);
            let suits: Vec<usize> = (maps..maps + needs.len())
                .filter(|job| waiting.iter().all(|k| nearness(*job, *k) <= nearness(*job, 0)))
                .collect();
            prop_assert_eq!(granted.len(), suits.len().min(free as usize));
            let least = granted.iter().map(|job| nearness(*job, 0)).min();
            for job in &suits {
                prop_assert!(granted.contains(job) || Some(nearness(*job, 0)) <= least);
            }
            prop_assert!(granted.iter().all(|job| suits.contains(job)));
        }
    }
}
