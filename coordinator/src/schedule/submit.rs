//! What follows from what clients ask for: new runs, cancelled runs, results that are gone.

use std::collections::BTreeSet;

use planesweep_plan::JobId;
use thiserror::Error;

use super::state::State;
use super::{Command, JobShape, Reopening, Snapshot};

/// Why a list of jobs is no plan.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum OrderError {
    /// Two different jobs have one id.
    #[error("job {job} is listed twice, with different contents")]
    Twice {
        /// The job.
        job: JobId,
    },
    /// A job needs one that does not come before it; so there are no cycles.
    #[error("job {job} needs job {need}, which is not listed before it")]
    NotBefore {
        /// The job.
        job: JobId,
        /// What it needs.
        need: JobId,
    },
    /// There is nothing to do.
    #[error("a run without jobs cannot be submitted")]
    Empty,
}

/// Checks that each job follows all those that it needs.
pub fn check_order(jobs: &[JobShape]) -> Result<(), OrderError> {
    if jobs.is_empty() {
        return Err(OrderError::Empty);
    }
    let mut listed = BTreeSet::new();
    for JobShape { id, needs, .. } in jobs {
        if let Some(need) = needs.iter().find(|need| !listed.contains(*need)) {
            return Err(OrderError::NotBefore { job: *id, need: *need });
        }
        if !listed.insert(*id) {
            return Err(OrderError::Twice { job: *id });
        }
    }
    Ok(())
}

/// New jobs are added; what failed or was cancelled before gets a new chance; what is done or under
/// way is shared with the runs that had it done.
pub(super) fn submitted(snapshot: &Snapshot, jobs: Vec<JobShape>) -> Vec<Command> {
    let mut inserted = BTreeSet::new();
    let mut commands = Vec::new();
    for shape in jobs {
        match snapshot.get(&shape.id).map(|job| &job.state) {
            None if inserted.insert(shape.id) => commands.push(Command::Insert { shape }),
            Some(State::Failed | State::Cancelled) => {
                commands.push(Command::Reopen { job: shape.id, why: Reopening::Resubmitted });
            }
            _ => {}
        }
    }
    commands
}

pub(super) fn cancelled(snapshot: &Snapshot, jobs: &[JobId]) -> Vec<Command> {
    jobs.iter()
        .filter(|job| {
            snapshot
                .get(job)
                .is_some_and(|job| matches!(job.state, State::Open { .. } | State::Leased { .. }))
        })
        .map(|job| Command::Cancel { job: *job })
        .collect()
}

pub(super) fn results_lost(snapshot: &Snapshot, jobs: &[JobId]) -> Vec<Command> {
    jobs.iter()
        .filter(|job| snapshot.is_done(job))
        .map(|job| Command::Reopen { job: *job, why: Reopening::ResultLost })
        .collect()
}
