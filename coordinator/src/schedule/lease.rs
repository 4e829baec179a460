//! What follows from time alone: leases end, and deaths are laid at somebody's door.

use std::collections::{BTreeMap, BTreeSet};

use super::state::{Ordinal, State, Worker};
use super::{Class, Command, MAX_DEATHS_ALONE, Snapshot, Timestamp};

/// Takes the jobs of workers whose lease ended back, and blames the death on those that ran.
pub(super) fn tick(snapshot: &Snapshot, now: Timestamp) -> Vec<Command> {
    let mut commands = Vec::new();
    for (id, worker) in snapshot.workers.iter().filter(|(_, worker)| worker.deadline <= now) {
        let blamed = blamed(snapshot, worker);
        for ordinal in &worker.holds {
            let job = &snapshot.jobs[*ordinal as usize];
            let (id, attempt) = (job.id, job.attempt);
            if !blamed.contains(ordinal) {
                commands.push(Command::Release { job: id, attempt });
                continue;
            }
            let was_alone = job.suspect && worker.holds.len() == 1;
            let deaths_alone = job.deaths_alone + u32::from(was_alone);
            if deaths_alone >= MAX_DEATHS_ALONE {
                commands.push(Command::GiveUp { job: id, attempt, quarantined: true });
            } else {
                commands.push(Command::Suspect { job: id, attempt, deaths_alone });
            }
        }
        commands.push(Command::Dismiss { worker: id.clone() });
    }
    commands
}

/// The jobs that were running: those that the worker named, else the first of each class, because
/// a worker takes them in the order of the grants and may die before it can name one. Nobody is
/// blamed for a worker that was going anyway, or that this coordinator never met.
fn blamed(snapshot: &Snapshot, worker: &Worker) -> BTreeSet<Ordinal> {
    if !worker.ready || !worker.reported {
        return BTreeSet::new();
    }
    let started: BTreeSet<Ordinal> = worker
        .holds
        .iter()
        .copied()
        .filter(|held| matches!(snapshot.jobs[*held as usize].state, State::Leased { started: true, .. }))
        .collect();
    if !started.is_empty() {
        return started;
    }
    let mut first: BTreeMap<Class, Ordinal> = BTreeMap::new();
    for held in &worker.holds {
        first.entry(snapshot.jobs[*held as usize].class).or_insert(*held);
    }
    first.into_values().collect()
}
