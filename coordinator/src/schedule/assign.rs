//! Which jobs a worker is given: free slots times ready jobs.

use planesweep_plan::{Attempt, WorkerId};

use super::state::{Ordinal, State};
use super::{Class, Command, FreeSlots, Snapshot, Timestamp};

/// How far after a worker's last job the next one may lie to be preferred to the first in the
/// plan. Neighbours in plan order share source images; far ones share nothing.
const NEAR: Ordinal = 8;

/// Fills free slots with ready jobs in plan order, near the worker's last one if there are such.
///
/// A suspect is given only to a worker that holds nothing, ahead of all else, and that worker is
/// given nothing beside it. So the next death says whose fault it is.
pub(super) fn wants_work(
    snapshot: &Snapshot,
    id: &WorkerId,
    free: FreeSlots,
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
    let is_due = |ordinal: &Ordinal| matches!(snapshot.jobs[*ordinal as usize].state, State::Open { not_before, .. } if not_before <= now);
    let slots = [(Class::Infer, free.infer), (Class::Fuse, free.fuse)];
    if worker.holds.is_empty() {
        let has_slot = |ordinal: &Ordinal| {
            let class = snapshot.jobs[*ordinal as usize].class;
            slots.iter().any(|(of, free)| *of == class && *free > 0)
        };
        if let Some(suspect) = snapshot.suspects.iter().find(|s| is_due(s) && has_slot(s)) {
            return vec![grant(*suspect)];
        }
    }
    let mut commands = Vec::new();
    for (class, free) in slots {
        let Some(ready) = snapshot.ready.get(&class) else { continue };
        // The reach moves on with each job taken, as if each were the last one.
        let mut last = worker.last.get(&class).copied();
        let mut taken = Vec::new();
        for _ in 0..free {
            let near = last.and_then(|last| {
                let mut near = ready.range(last + 1..=last.saturating_add(NEAR));
                near.find(|job| is_due(job) && !taken.contains(*job))
            });
            let next = near.or_else(|| ready.iter().find(|job| is_due(job) && !taken.contains(*job)));
            let Some(&next) = next else { break };
            taken.push(next);
            last = Some(next);
        }
        commands.extend(taken.into_iter().map(grant));
    }
    commands
}
