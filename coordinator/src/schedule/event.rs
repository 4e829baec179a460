//! Event in, command out.

use std::fmt;

use planesweep_plan::{Attempt, JobId, WorkerId};

/// Milliseconds since the driver's epoch, on its monotonic clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Timestamp(pub u64);

impl Timestamp {
    /// This much later.
    #[must_use]
    pub fn plus(self, ms: u64) -> Self {
        Self(self.0.saturating_add(ms))
    }
}

/// Which slots a job takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// Inference: needs the device.
    Infer,
    /// Everything else: needs processors and memory.
    Fuse,
}

impl Class {
    /// The class of jobs of this kind, as [`planesweep_plan::JobSpec::kind`] names it.
    pub fn of(kind: &str) -> Self {
        if kind == "infer" { Self::Infer } else { Self::Fuse }
    }
}

/// What scheduling knows of a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobShape {
    /// The job.
    pub id: JobId,
    /// Which slots it takes.
    pub class: Class,
    /// Jobs that must have ended before.
    pub needs: Vec<JobId>,
}

/// A job in a worker's hands, as the worker says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Held {
    /// The job.
    pub job: JobId,
    /// Which try.
    pub attempt: Attempt,
    /// Whether it is being computed.
    pub started: bool,
}

/// How a try ended, as far as it matters for what comes next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ending {
    /// There is a result.
    Success,
    /// There is none.
    Failure {
        /// Whether another try may succeed.
        retryable: bool,
        /// Whether it uses up one of the job's tries.
        counts: bool,
        /// Needed jobs whose result is gone; they run again.
        lost: Vec<JobId>,
    },
}

/// A try that ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finished {
    /// The job.
    pub job: JobId,
    /// Which try.
    pub attempt: Attempt,
    /// How.
    pub ending: Ending,
}

/// Free slots by class.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FreeSlots {
    /// For inference.
    pub infer: u32,
    /// For all else.
    pub fuse: u32,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// A run was submitted; each job follows those that it needs.
    Submitted {
        /// Its jobs, in plan order.
        jobs: Vec<JobShape>,
    },
    /// A worker reported.
    Reported {
        /// Who.
        worker: WorkerId,
        /// Where it is: workers of one host reach each other's memory.
        host: String,
        /// Whether it is going to take more jobs.
        ready: bool,
        /// What it holds.
        held: Vec<Held>,
        /// What ended.
        finished: Vec<Finished>,
    },
    /// A worker that has just reported waits for jobs.
    WantsWork {
        /// Who.
        worker: WorkerId,
        /// For how many.
        free: FreeSlots,
        /// Who else waits for jobs other than inference.
        waiting: Vec<WorkerId>,
    },
    /// Time passed.
    Tick,
    /// No run wants these jobs any more.
    Cancelled {
        /// The jobs.
        jobs: Vec<JobId>,
    },
    /// What was just granted cannot be read from the ledger.
    Unreadable {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
    },
    /// The results of these jobs are gone from the store.
    ResultsLost {
        /// The jobs.
        jobs: Vec<JobId>,
    },
}

/// Why a job goes back to the open ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reopening {
    /// It failed or was cancelled before and is submitted again.
    Resubmitted,
    /// Its result is gone from the store.
    ResultLost,
    /// It ended without, or with an older, result of a job that has one now. In any state, its own
    /// next result counts as new to those that need it, for it may have lost an older one that they saw.
    NewInput,
}

/// What is to be done. Each command on a job names the attempt that it is about, so a command that
/// comes too late changes nothing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Add a job nobody knew.
    Insert {
        /// It.
        shape: JobShape,
    },
    /// Make a job run again.
    Reopen {
        /// The job.
        job: JobId,
        /// Why.
        why: Reopening,
    },
    /// Note that a worker is alive until the deadline.
    Admit {
        /// The worker.
        worker: WorkerId,
        /// Where it is.
        host: String,
        /// Whether it takes jobs.
        ready: bool,
        /// When its leases end unless it reports.
        deadline: Timestamp,
    },
    /// Prolong a lease.
    Renew {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
        /// Whose.
        worker: WorkerId,
        /// Whether it is being computed.
        started: bool,
        /// New end of the lease.
        deadline: Timestamp,
    },
    /// Give a job to a worker.
    Grant {
        /// The job.
        job: JobId,
        /// Which try this is.
        attempt: Attempt,
        /// To whom.
        worker: WorkerId,
        /// End of the lease.
        deadline: Timestamp,
    },
    /// Publish a result.
    Complete {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
        /// Whose.
        worker: WorkerId,
    },
    /// Try a job again later.
    Retry {
        /// The job.
        job: JobId,
        /// Which try failed.
        attempt: Attempt,
        /// Failures that count against the job, with this one.
        failures: u32,
        /// Tries that found an input lost and do not count, with this one.
        losses: u32,
        /// Not before.
        until: Timestamp,
    },
    /// Let a job fail for good.
    GiveUp {
        /// The job.
        job: JobId,
        /// Which try failed.
        attempt: Attempt,
        /// Whether it was its worker's death rather than its own failure.
        quarantined: bool,
    },
    /// Take a lease back without blame.
    Release {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
    },
    /// Take a lease back, and blame the death of the worker on the job.
    Suspect {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
        /// Deaths of workers that ran nothing else, with this one.
        deaths_alone: u32,
    },
    /// Cancel a job.
    Cancel {
        /// The job.
        job: JobId,
    },
    /// Forget a worker.
    Dismiss {
        /// The worker.
        worker: WorkerId,
    },
    /// Tell a worker to drop a job.
    Revoke {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
    },
    /// Tell a worker that the end of a try is recorded.
    Acknowledge {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
    },
    /// Count the result of a try that is no longer the job's.
    CountLate {
        /// The job.
        job: JobId,
        /// Which try.
        attempt: Attempt,
    },
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ms", self.0)
    }
}
