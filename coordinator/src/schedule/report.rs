//! What follows from a worker's report: results recorded, leases renewed, lost ones taken back.

use std::collections::BTreeSet;

use planesweep_plan::{JobId, WorkerId};

use super::state::{Job, State};
use super::{Command, Ending, Finished, Held, MAX_FAILURES, Reopening, Snapshot, Timestamp};

/// The worker lives; what it finished is recorded, what it holds renewed, and a lease of which it
/// does not speak is taken back: the reply that granted it was lost on the way.
pub(super) fn reported(
    snapshot: &Snapshot,
    worker: &WorkerId,
    ready: bool,
    held: &[Held],
    finished: &[Finished],
    now: Timestamp,
) -> Vec<Command> {
    let deadline = now.plus(snapshot.lease_ms);
    let mut commands = vec![Command::Admit { worker: worker.clone(), ready, deadline }];
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
    // Lost inputs always count, so that a store that loses everything ends the job at last.
    let failures = job.failures + u32::from(counts || !lost.is_empty());
    if (!retryable && lost.is_empty()) || failures >= MAX_FAILURES {
        commands.push(Command::GiveUp { job: id, attempt, quarantined: false });
        return;
    }
    // A worker that drains hands its jobs on; any other failure may have a cause that passes.
    let until = if ready { now.plus(snapshot.lease_ms / 4) } else { now };
    commands.push(Command::Retry { job: id, attempt, failures, until });
    commands.extend(lost.into_iter().map(|job| Command::Reopen { job, why: Reopening::ResultLost }));
}

/// Those who ended, or are just running, without this result run again. Their own dependents
/// follow when they complete, for they are outdated in turn.
fn reopen_dependents(snapshot: &Snapshot, job: &Job, commands: &mut Vec<Command>) {
    for dependent in &job.dependents {
        let dependent = &snapshot.jobs[*dependent as usize];
        if matches!(dependent.state, State::Done | State::Leased { .. }) {
            commands.push(Command::Reopen { job: dependent.id, why: Reopening::NewInput });
        }
    }
}
