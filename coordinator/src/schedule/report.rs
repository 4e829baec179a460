//! What follows from a worker's report: results recorded, leases renewed, lost ones taken back.

use std::collections::BTreeSet;

use planesweep_plan::{JobId, WorkerId};

use super::state::{Job, State};
use super::{Command, Ending, Finished, Held, MAX_FAILURES, MAX_LOSSES, Reopening, Snapshot, Timestamp};

/// The worker lives; what it finished is recorded, what it holds renewed, and a lease of which it
/// does not speak is taken back: the reply that granted it was lost on the way.
pub(super) fn reported(
    snapshot: &Snapshot,
    (worker, host): (&WorkerId, String),
    ready: bool,
    held: &[Held],
    finished: &[Finished],
    now: Timestamp,
) -> Vec<Command> {
    let deadline = now.plus(snapshot.lease_ms);
    let mut commands = vec![Command::Admit { worker: worker.clone(), host, ready, deadline }];
    for Finished { job, attempt, ending } in finished {
        commands.push(Command::Acknowledge { job: *job, attempt: *attempt });
        let known = snapshot.get(job);
        match known {
            Some(known) if snapshot.holds(worker, job, *attempt) => {
                settle(snapshot, known, worker, ready, ending, now, &mut commands);
            }
            // The same result again, because the reply to the first was lost.
            Some(known) if known.state == State::Done && known.attempt == *attempt => {}
            _ if *ending == Ending::Success => {
                commands.push(Command::CountLate { job: *job, attempt: *attempt });
            }
            // A failure of an old attempt concerns nobody.
            _ => {}
        }
    }
    for &Held { job, attempt, started } in held {
        if snapshot.holds(worker, &job, attempt) {
            commands.push(Command::Renew { job, attempt, worker: worker.clone(), started, deadline });
        } else {
            commands.push(Command::Revoke { job, attempt });
        }
    }
    let spoken_of: BTreeSet<JobId> =
        held.iter().map(|h| h.job).chain(finished.iter().map(|f| f.job)).collect();
    for ordinal in snapshot.workers.get(worker).iter().flat_map(|worker| &worker.holds) {
        let job = &snapshot.jobs[*ordinal as usize];
        if !spoken_of.contains(&job.id) {
            commands.push(Command::Release { job: job.id, attempt: job.attempt });
        }
    }
    commands
}

/// Records how the try that holds the lease ended.
fn settle(
    snapshot: &Snapshot,
    job: &Job,
    worker: &WorkerId,
    ready: bool,
    ending: &Ending,
    now: Timestamp,
    commands: &mut Vec<Command>,
) {
    let (id, attempt) = (job.id, job.attempt);
    let (retryable, counts, lost) = match ending {
        Ending::Success => {
            commands.push(Command::Complete { job: id, attempt, worker: worker.clone() });
            if job.outdated {
                reopen_dependents(snapshot, job, commands);
            }
            return;
        }
        Ending::Failure { retryable, counts, lost } => (*retryable, *counts, lost),
    };
    let lost: Vec<JobId> = job
        .needs
        .iter()
        .map(|need| &snapshot.jobs[*need as usize])
        .filter(|need| need.state == State::Done && lost.contains(&need.id))
        .map(|need| need.id)
        .collect();
    let failures = job.failures + u32::from(counts);
    let losses = job.losses + u32::from(!counts && !lost.is_empty());
    let is_last = failures >= MAX_FAILURES || losses >= MAX_LOSSES;
    if is_last || (!retryable && lost.is_empty()) {
        commands.push(Command::GiveUp { job: id, attempt, quarantined: false });
        return;
    }
    // A worker that drains hands its jobs on; any other failure may have a cause that passes.
    let until = if ready { now.plus(snapshot.lease_ms / 4) } else { now };
    commands.push(Command::Retry { job: id, attempt, failures, losses, until });
    commands.extend(lost.into_iter().map(|job| Command::Reopen { job, why: Reopening::ResultLost }));
}

/// Those who ended, or are just running, without this result run again. Their own dependents
/// follow when they complete, for they are outdated in turn; so are those who wait to run again.
fn reopen_dependents(snapshot: &Snapshot, job: &Job, commands: &mut Vec<Command>) {
    for dependent in &job.dependents {
        let dependent = &snapshot.jobs[*dependent as usize];
        commands.push(Command::Reopen { job: dependent.id, why: Reopening::NewInput });
    }
}

#[cfg(test)]
mod tests {
    use planesweep_plan::Attempt;

    use super::*;
    use crate::schedule::{Class, Event, FreeSlots, JobShape, decide};

    #[test]
    fn a_store_that_loses_everything_ends_the_job_at_last() {
        let (map, filter) = (JobId([0; 32]), JobId([1; 32]));
        let worker = WorkerId("w".to_owned());
        let reports = |finished| Event::Reported {
            worker: worker.clone(),
            host: "host".to_owned(),
            ready: true,
            held: vec![],
            finished,
        };
        let mut now = Timestamp(0);
        let mut snapshot = Snapshot::new(7000, [], now);
        let mut happen = |event: Event, now| {
            let commands = decide(&snapshot, event, now);
            for command in &commands {
                assert!(snapshot.apply(command, now), "{command:?}");
            }
            commands
        };
        let shape = |id, needs| JobShape { id, class: Class::Fuse, needs };
        happen(Event::Submitted { jobs: vec![shape(map, vec![]), shape(filter, vec![map])] }, now);
        let mut finished = Vec::new();
        for losses in 1.. {
            for job in [map, filter] {
                happen(reports(finished), now);
                now = now.plus(2000);
                let free = FreeSlots { infer: 0, fuse: 1 };
                happen(Event::WantsWork { worker: worker.clone(), free, waiting: vec![] }, now);
                let ending = if job == map {
                    Ending::Success
                } else {
                    Ending::Failure { retryable: true, counts: false, lost: vec![map] }
                };
                finished = vec![Finished { job, attempt: Attempt(losses), ending }];
            }
            let commands = happen(reports(finished), now);
            finished = Vec::new();
            let given_up = commands.iter().any(|command| matches!(command, Command::GiveUp { .. }));
            assert_eq!(given_up, losses == MAX_LOSSES, "after {losses} losses: {commands:?}");
            if given_up {
                return;
            }
        }
    }
}
