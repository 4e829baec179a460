//! What a worker holds: pure bookkeeping, no I/O, no clock.

use std::collections::{BTreeMap, BTreeSet};

use planesweep_plan::JobSpec;
use planesweep_proto::{FinishedJob, Grant, HeldJob, JobAttempt, Outcome, Role, Slots};

/// The jobs in a worker's hands, and the ended ones that the coordinator has not acknowledged.
#[derive(Debug)]
pub(crate) struct Held {
    capacity: Slots,
    running: BTreeMap<JobAttempt, Running>,
    finished: BTreeMap<JobAttempt, Outcome>,
}

#[derive(Debug)]
struct Running {
    is_inference: bool,
    started: bool,
}

impl Held {
    /// A worker that takes the jobs of `role`, at most `slots` at once.
    pub fn new(role: Role, slots: Slots) -> Self {
        let capacity = match role {
            Role::Infer => Slots { fuse: 0, ..slots },
            Role::Fuse => Slots { infer: 0, ..slots },
            Role::Both => slots,
        };
        Self { capacity, running: BTreeMap::new(), finished: BTreeMap::new() }
    }

    /// How many more jobs of each class fit.
    pub fn free(&self) -> Slots {
        let infer = self.running.values().filter(|job| job.is_inference).count() as u32;
        let fuse = self.running.len() as u32 - infer;
        Slots {
            infer: self.capacity.infer.saturating_sub(infer),
            fuse: self.capacity.fuse.saturating_sub(fuse),
        }
    }

    /// Whether nothing runs and nothing is left to report.
    pub fn is_empty(&self) -> bool {
        self.running.is_empty() && self.finished.is_empty()
    }

    /// Takes a granted job; `false` when it is held or ended already, for a reply may arrive twice.
    pub fn take(&mut self, grant: &Grant) -> bool {
        let attempt = JobAttempt { job: grant.job, attempt: grant.attempt };
        if self.running.contains_key(&attempt) || self.finished.contains_key(&attempt) {
            return false;
        }
        let is_inference = matches!(grant.spec, JobSpec::Infer(_));
        self.running.insert(attempt, Running { is_inference, started: false });
        true
    }

    /// Notes that computing began.
    pub fn start(&mut self, attempt: JobAttempt) {
        if let Some(job) = self.running.get_mut(&attempt) {
            job.started = true;
        }
    }

    /// Notes that a job ended; one that was let go in the meantime is forgotten.
    pub fn finish(&mut self, attempt: JobAttempt, outcome: Outcome) {
        if self.running.remove(&attempt).is_some() {
            self.finished.insert(attempt, outcome);
        }
    }

    /// Forgets what the coordinator took back or acknowledged.
    pub fn forget<'a>(&mut self, attempts: impl IntoIterator<Item = &'a JobAttempt>) {
        for attempt in attempts {
            self.running.remove(attempt);
            self.finished.remove(attempt);
        }
    }

    /// The jobs that were not begun; when the lease is over or the worker drains, they go first.
    pub fn not_started(&self) -> BTreeSet<JobAttempt> {
        self.running.iter().filter(|(_, job)| !job.started).map(|(attempt, _)| *attempt).collect()
    }

    /// What a report says of running jobs.
    pub fn held(&self) -> Vec<HeldJob> {
        let held = self.running.iter();
        held.map(|(id, job)| HeldJob { job: id.job, attempt: id.attempt, started: job.started }).collect()
    }

    /// What a report says of ended jobs.
    pub fn finished(&self) -> Vec<FinishedJob> {
        let ended = self.finished.iter();
        ended
            .map(|(id, outcome)| FinishedJob { job: id.job, attempt: id.attempt, outcome: outcome.clone() })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use planesweep_plan::{Attempt, EmitSpec, JobId};
    use planesweep_proto::Failure;
    use planesweep_scene::ViewId;

    use super::*;

    fn grant(job: u8) -> Grant {
        Grant {
            job: JobId([job; 32]),
            attempt: Attempt(1),
            spec: JobSpec::Emit(EmitSpec {
                view: ViewId(0),
                neighbours: vec![],
                max_relative_depth: 0.01,
                double: false,
            }),
            inputs: vec![],
        }
    }

    fn attempt(job: u8) -> JobAttempt {
        JobAttempt { job: JobId([job; 32]), attempt: Attempt(1) }
    }

    fn failure() -> Outcome {
        Outcome::Failure(Failure {
            code: "x".into(),
            message: String::new(),
            retryable: true,
            counts_against_job: true,
            lost_inputs: vec![],
        })
    }

    #[test]
    fn a_job_is_held_until_its_end_is_acknowledged() {
        let mut held = Held::new(Role::Both, Slots { infer: 1, fuse: 2 });
        assert!(held.take(&grant(1)) && !held.take(&grant(1)));
        assert_eq!(held.free(), Slots { infer: 1, fuse: 1 });
        assert_eq!(held.not_started(), BTreeSet::from([attempt(1)]));
        held.start(attempt(1));
        assert!(held.not_started().is_empty() && held.held()[0].started);
        held.finish(attempt(1), failure());
        assert_eq!(held.free(), Slots { infer: 1, fuse: 2 });
        assert_eq!(held.finished().len(), 1);
        assert!(!held.take(&grant(1)), "a grant that arrives again is not run again");
        held.forget(&[attempt(1)]);
        assert!(held.is_empty());
    }

    #[test]
    fn a_revoked_job_ends_unheard() {
        let mut held = Held::new(Role::Fuse, Slots { infer: 1, fuse: 1 });
        assert_eq!(held.free(), Slots { infer: 0, fuse: 1 });
        held.take(&grant(1));
        held.forget(&[attempt(1)]);
        held.finish(attempt(1), failure());
        assert!(held.is_empty());
    }
}
