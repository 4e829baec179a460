//! What a worker reports and what it is answered, checked.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use planesweep_plan::{Attempt, BlobKey, JobId, JobSpec, WorkerId};

/// Heartbeat, lease renewal, results and pull for work.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Must be [`crate::PROTOCOL_VERSION`].
    pub protocol_version: u32,
    /// Must be [`crate::CODE_VERSION`].
    pub code_version: String,
    /// Must be [`planesweep_plan::NUMERICS_VERSION`].
    pub numerics_version: u32,
    /// One life of the worker's process.
    pub worker: WorkerId,
    /// Rises with every report of this worker.
    pub sequence: u64,
    /// Name of the worker's host.
    pub host: String,
    /// What tells hosts of one name apart.
    pub boot_id: String,
    /// Which jobs it takes.
    pub role: Role,
    /// The device it infers on, for people.
    pub device: String,
    /// Whether it takes new jobs.
    pub state: WorkerState,
    /// How many more jobs of each class it takes now.
    pub free: Slots,
    /// The worker's monotonic clock when it sent this, in ms.
    pub offset_ms: u64,
    /// Every job it holds and has not finished.
    pub held: Vec<HeldJob>,
    /// Every ended job that was not acknowledged yet.
    pub finished: Vec<FinishedJob>,
    /// How long the reply may be held back while there is nothing to say.
    pub max_wait: Duration,
    /// Where other workers reach it.
    pub endpoint: Endpoint,
}

/// Where a worker is reached by other workers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Endpoint {
    /// Serves what the worker has in memory, such as `http://10.0.0.2:7071`.
    pub address: Option<String>,
    /// Takes maps through shared memory: the name of a service on the worker's host.
    pub inbox: Option<String>,
}

/// Which jobs a worker takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Inference only.
    Infer,
    /// Everything but inference.
    Fuse,
    /// Every job.
    Both,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Infer => "infer",
            Self::Fuse => "fuse",
            Self::Both => "both",
        })
    }
}

/// Where a worker stands in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WorkerState {
    /// Takes jobs.
    Ready,
    /// Ends what it holds.
    Draining,
    /// Holds nothing and goes.
    Drained,
}

impl fmt::Display for WorkerState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ready => "ready",
            Self::Draining => "draining",
            Self::Drained => "drained",
        })
    }
}

/// Numbers of jobs by class.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Slots {
    /// `Infer` jobs.
    pub infer: u32,
    /// All other jobs.
    pub fuse: u32,
}

/// One try of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct JobAttempt {
    /// The job.
    pub job: JobId,
    /// Which try.
    pub attempt: Attempt,
}

/// A job in a worker's hands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeldJob {
    /// The job.
    pub job: JobId,
    /// Which try.
    pub attempt: Attempt,
    /// Whether it is being computed, not only queued.
    pub started: bool,
}

/// A try that ended.
#[derive(Clone, Debug, PartialEq)]
pub struct FinishedJob {
    /// The job.
    pub job: JobId,
    /// Which try.
    pub attempt: Attempt,
    /// How it ended.
    pub outcome: Outcome,
}

/// How a try ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The result is in the store.
    Success(Success),
    /// There is none.
    Failure(Failure),
}

/// A result.
#[derive(Clone, Debug, PartialEq)]
pub struct Success {
    /// The blob with the result.
    pub blob: BlobKey,
    /// Its length in bytes.
    pub length: u64,
    /// What was measured on the way (pixels left by each filter, for example); numbers that are
    /// not finite are left out on the wire.
    pub measurements: BTreeMap<String, f64>,
    /// How long the job took.
    pub seconds: f64,
}

/// Why there is no result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// A short word for programs, such as "decode" or "out-of-memory".
    pub code: String,
    /// What was attempted, on which thing, for people.
    pub message: String,
    /// Whether another try may succeed.
    pub retryable: bool,
    /// Whether the try uses up one of the job's; a drain or a full disk does not.
    pub counts_against_job: bool,
    /// Needed jobs whose blob is gone or damaged; they run again before this one does.
    pub lost_inputs: Vec<JobId>,
}

/// The answer to a report.
#[derive(Clone, Debug, PartialEq)]
pub struct ReportReply {
    /// The report's `offset_ms`: the worker's lease ends at this plus `lease`, on its own clock.
    pub offset_ms: u64,
    /// How long a lease lasts.
    pub lease: Duration,
    /// How long to wait before the next report when no job ends.
    pub report_interval: Duration,
    /// New jobs, in the order in which they are to be run.
    pub grants: Vec<Grant>,
    /// Held jobs that are no longer the worker's.
    pub revoked: Vec<JobAttempt>,
    /// Ended jobs that it may forget.
    pub acknowledged: Vec<JobAttempt>,
    /// Where blobs lie.
    pub store: StorePlace,
    /// Whether to go on.
    pub order: Order,
    /// The workers that made what the grants need, and those of the same host with an inbox.
    pub peers: Vec<Peer>,
}

/// Where blobs lie, as the coordinator sees it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StorePlace {
    /// The store's address.
    pub url: String,
    /// What the store says of itself: who finds something else at the address does not see the store.
    /// `None` when all do.
    pub identity: Option<String>,
}

/// Another worker, and the ways on which this one can reach it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Peer {
    /// The worker.
    pub worker: WorkerId,
    /// Its endpoint, without what cannot be reached.
    pub endpoint: Endpoint,
}

/// What a worker is to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// Go on.
    Work,
    /// End what is held, then go.
    Drain,
    /// Go now.
    Stop,
}

/// A job handed out, complete.
#[derive(Clone, Debug, PartialEq)]
pub struct Grant {
    /// The job.
    pub job: JobId,
    /// Which try.
    pub attempt: Attempt,
    /// What is to be done.
    pub spec: JobSpec,
    /// The results of the needed jobs, in the job's order.
    pub inputs: Vec<Input>,
}

/// The result of a needed job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Input {
    /// The needed job.
    pub job: JobId,
    /// Its result; `None` when it failed for good.
    pub produced: Option<Produced>,
}

/// A blob and who made it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Produced {
    /// The blob.
    pub blob: BlobKey,
    /// Its length in bytes.
    pub length: u64,
    /// Who made it and may still have it in memory.
    pub worker: WorkerId,
}
