//! What a client submits and learns of a run, checked.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use planesweep_plan::{Attempt, BlobKey, JobId, RunId, WorkerId};
use planesweep_scene::ViewId;

use crate::{Role, WorkerState};

/// What goes ahead of the jobs of a submission.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SubmitHeader {
    /// The run's name, for people; its id is made of it.
    pub name: String,
    /// Cancels every other run, so that nothing of an abandoned one is computed first.
    pub exclusive: bool,
    /// Jobs whose results, if there are any, are no longer in the store; they run again.
    pub missing_results: Vec<JobId>,
}

/// What became of a submission.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Submitted {
    /// The run.
    pub run: RunId,
    /// Its jobs, each counted once.
    pub jobs: u32,
    /// Those of them that an earlier run had done already.
    pub reused: u32,
}

/// A run in the list of all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunSummary {
    /// The run.
    pub run: RunId,
    /// Its name.
    pub name: String,
    /// Whether it was cancelled.
    pub cancelled: bool,
    /// Its jobs.
    pub jobs: u64,
    /// Those of them that are done.
    pub done: u64,
    /// Those that failed for good.
    pub failed: u64,
}

impl RunSummary {
    /// Whether every job ended, well or not, or the run was cancelled.
    pub fn is_finished(&self) -> bool {
        self.cancelled || self.done + self.failed == self.jobs
    }
}

/// Where a job stands in the ledger.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum JobState {
    /// Waits for others, or for a worker.
    Open,
    /// In the hands of a worker.
    Leased,
    /// Its result is published.
    Done,
    /// Failed for good.
    Failed,
    /// No run wants it any more.
    Cancelled,
}

impl JobState {
    /// All states, in the order of a job's life.
    pub const ALL: [Self; 5] = [Self::Open, Self::Leased, Self::Done, Self::Failed, Self::Cancelled];

    /// The state's name: "open", "leased", "done", "failed" or "cancelled".
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Leased => "leased",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.as_str() == name)
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// How far a run is.
#[derive(Clone, Debug, PartialEq)]
pub struct RunStatus {
    /// The run's name.
    pub name: String,
    /// Whether every job ended, well or not.
    pub finished: bool,
    /// Whether it was cancelled.
    pub cancelled: bool,
    /// Jobs by kind and state; what is not listed is zero.
    pub counts: BTreeMap<(String, JobState), u64>,
    /// The first failures for good, in the order of the plan.
    pub failures: Vec<JobResult>,
    /// Jobs that ended since the query's `after`, oldest first, as many as fit.
    pub recent: Vec<JobResult>,
    /// Every worker seen since the coordinator started.
    pub workers: Vec<WorkerStatus>,
    /// How many of them live.
    pub workers_alive: u32,
    /// How long jobs have been waiting without a living worker; `None` while one lives.
    pub waiting: Option<Duration>,
    /// Results refused because their attempt was no longer the job's, since the coordinator started.
    pub late_results: u64,
    /// Those of them that differed from the published result.
    pub divergent_results: u64,
    /// Callers without the token, with a wrong one, or without a TLS handshake that ended well, since the coordinator started.
    pub refused_callers: u64,
}

impl RunStatus {
    /// Jobs in this state, of all kinds.
    pub fn count(&self, state: JobState) -> u64 {
        self.counts.iter().filter(|((_, of), _)| *of == state).map(|(_, jobs)| jobs).sum()
    }
}

/// A job as the ledger knows it.
#[derive(Clone, Debug, PartialEq)]
pub struct JobResult {
    /// The job.
    pub job: JobId,
    /// Its kind, as [`planesweep_plan::JobSpec::kind`] names it.
    pub kind: String,
    /// The view it is about.
    pub view: Option<ViewId>,
    /// Where it stands.
    pub state: JobState,
    /// The latest try; 0 when there was none.
    pub attempt: Attempt,
    /// Rises with every job that ends; 0 for one that has not.
    pub ended: u64,
    /// Blob and length, of a job that is done.
    pub blob: Option<(BlobKey, u64)>,
    /// What was measured on the way.
    pub measurements: BTreeMap<String, f64>,
    /// How long it took.
    pub seconds: f64,
    /// Who did it, or holds it.
    pub worker: Option<WorkerId>,
    /// Code and message of the latest try that failed.
    pub failure: Option<(String, String)>,
}

/// A worker as the coordinator knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerStatus {
    /// The life of its process.
    pub worker: WorkerId,
    /// Its host.
    pub host: String,
    /// Which jobs it takes.
    pub role: Role,
    /// The device it infers on.
    pub device: String,
    /// Whether it takes new jobs.
    pub state: WorkerState,
    /// Whether its lease runs.
    pub alive: bool,
    /// Since its last report.
    pub last_report_ago: Duration,
    /// Jobs in its hands.
    pub held: u32,
}
