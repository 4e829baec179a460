//! What scheduling knows.

use std::collections::{BTreeMap, BTreeSet};

use planesweep_plan::{Attempt, JobId, WorkerId};

use super::{Class, JobShape, Timestamp};

/// A job's place in the order of all jobs; jobs refer to each other by it, because a hash for every
/// edge of a graph of 100 000 views would fill hundreds of megabytes.
pub(super) type Ordinal = u32;

/// Where a job stands in the ledger.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LedgerState {
    /// To be done.
    Open,
    /// In the hands of a worker.
    Leased(WorkerId),
    /// Done.
    Done,
    /// Failed for good.
    Failed,
    /// No longer wanted.
    Cancelled,
}

/// A job as the ledger keeps it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobRecord {
    /// Id, class and needs.
    pub shape: JobShape,
    /// Where it stands.
    pub state: LedgerState,
    /// The latest try; 0 when there was none.
    pub attempt: Attempt,
    /// Failures that count against it.
    pub failures: u32,
    /// Tries that found an input lost and do not count.
    pub losses: u32,
    /// Whether a worker died while it was running.
    pub suspect: bool,
    /// Deaths of workers that ran nothing else.
    pub deaths_alone: u32,
    /// Whether jobs that need it may have ended without its (newest) result.
    pub outdated: bool,
}

/// A job within the snapshot.
#[derive(Clone, Debug)]
pub(super) struct Job {
    pub id: JobId,
    pub class: Class,
    pub needs: Box<[Ordinal]>,
    pub dependents: Vec<Ordinal>,
    pub state: State,
    pub attempt: Attempt,
    pub failures: u32,
    pub losses: u32,
    pub suspect: bool,
    pub deaths_alone: u32,
    pub outdated: bool,
    /// Who made its result, as an index into [`Snapshot::makers`], if that is known.
    pub maker: Option<u32>,
}

/// A worker that made a result, and may still have it in memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Maker {
    pub worker: WorkerId,
    pub host: String,
}

/// Where a job stands; fields exist only in the states that have them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// Ready when `unmet`, the number of needed jobs that have not ended, is 0 and the time has come.
    Open {
        unmet: u32,
        not_before: Timestamp,
    },
    Leased {
        worker: WorkerId,
        started: bool,
    },
    Done,
    Failed,
    Cancelled,
}

impl State {
    /// Whether jobs that need this one may run.
    pub(super) fn has_ended(&self) -> bool {
        matches!(self, Self::Done | Self::Failed)
    }
}

/// A worker whose lease runs.
#[derive(Clone, Debug)]
pub(super) struct Worker {
    /// When its leases end unless it reports.
    pub deadline: Timestamp,
    /// Whether it takes jobs.
    pub ready: bool,
    /// Whether it reported since the coordinator started. One that did not is known by its leases
    /// only; that it is gone says nothing about its jobs, for the whole host may have gone.
    pub reported: bool,
    /// Where it is.
    pub host: String,
    /// What it holds, in the order of the grants.
    pub holds: Vec<Ordinal>,
    /// The job granted last, by class: its neighbours share images with it.
    pub last: BTreeMap<Class, Ordinal>,
}

/// The jobs of the ledger and the workers that live, for [`super::decide`].
#[derive(Clone, Debug)]
pub struct Snapshot {
    pub(super) lease_ms: u64,
    pub(super) jobs: Vec<Job>,
    pub(super) ordinals: BTreeMap<JobId, Ordinal>,
    pub(super) workers: BTreeMap<WorkerId, Worker>,
    /// Open jobs without unmet needs, by class, in plan order; suspects are in `suspects` instead.
    pub(super) ready: BTreeMap<Class, BTreeSet<Ordinal>>,
    pub(super) suspects: BTreeSet<Ordinal>,
    /// Every worker that completed a job since the coordinator started.
    pub(super) makers: Vec<Maker>,
}

impl Snapshot {
    /// What the ledger holds, in the order of the ledger, at the start of a coordinator: workers
    /// with leases get one whole lease to report.
    ///
    /// Records whose needs do not come before them are left out, with all that need them; the
    /// ledger never takes such jobs.
    pub fn new(lease_ms: u64, records: impl IntoIterator<Item = JobRecord>, now: Timestamp) -> Self {
        let mut snapshot = Self {
            lease_ms,
            jobs: Vec::new(),
            ordinals: BTreeMap::new(),
            workers: BTreeMap::new(),
            ready: BTreeMap::new(),
            suspects: BTreeSet::new(),
            makers: Vec::new(),
        };
        for record in records {
            snapshot.add(record, now);
        }
        // What is unmet is known only now that every state is in place.
        for ordinal in 0..snapshot.jobs.len() as Ordinal {
            if matches!(snapshot.jobs[ordinal as usize].state, State::Open { .. }) {
                snapshot.enter_open(ordinal, Timestamp::default());
            }
        }
        snapshot
    }

    /// How many jobs there are.
    pub fn len(&self) -> usize {
        self.jobs.len()
    }

    /// Whether there are no jobs.
    pub fn is_empty(&self) -> bool {
        self.jobs.is_empty()
    }

    /// Whether the job is known.
    pub fn knows(&self, job: &JobId) -> bool {
        self.ordinals.contains_key(job)
    }

    /// The needs of a job, in its order; empty when it is not known.
    pub fn needs(&self, job: &JobId) -> Vec<JobId> {
        let Some(job) = self.get(job) else { return Vec::new() };
        job.needs.iter().map(|need| self.jobs[*need as usize].id).collect()
    }

    /// Whether the job is done.
    pub fn is_done(&self, job: &JobId) -> bool {
        self.get(job).is_some_and(|job| job.state == State::Done)
    }

    /// Whether some job could be granted now or after a delay.
    pub fn has_ready(&self) -> bool {
        !self.suspects.is_empty() || self.ready.values().any(|jobs| !jobs.is_empty())
    }

    /// Whether some job has not ended.
    pub fn has_unfinished(&self) -> bool {
        self.jobs.iter().any(|job| matches!(job.state, State::Open { .. } | State::Leased { .. }))
    }

    /// Whether the worker's lease runs and it reported since the coordinator started.
    pub fn is_alive(&self, worker: &WorkerId) -> bool {
        self.workers.get(worker).is_some_and(|worker| worker.reported)
    }

    /// How many workers are alive.
    pub fn alive(&self) -> usize {
        self.workers.values().filter(|worker| worker.reported).count()
    }

    /// Whether the lease of some worker runs, here or at another coordinator.
    pub fn has_holder(&self) -> bool {
        self.workers.values().any(|worker| worker.reported || !worker.holds.is_empty())
    }

    /// How many jobs a worker holds.
    pub fn held_by(&self, worker: &WorkerId) -> usize {
        self.workers.get(worker).map_or(0, |worker| worker.holds.len())
    }

    /// Who made the result that a done job has now, if this coordinator saw it.
    pub(super) fn maker(&self, job: Ordinal) -> Option<&Maker> {
        let job = &self.jobs[job as usize];
        let maker = job.maker.filter(|_| job.state == State::Done)?;
        self.makers.get(maker as usize)
    }

    pub(super) fn get(&self, job: &JobId) -> Option<&Job> {
        self.ordinals.get(job).map(|ordinal| &self.jobs[*ordinal as usize])
    }

    /// Whether the worker holds this try of the job.
    pub(super) fn holds(&self, worker: &WorkerId, job: &JobId, attempt: Attempt) -> bool {
        self.get(job).is_some_and(|job| {
            job.attempt == attempt && matches!(&job.state, State::Leased { worker: of, .. } if of == worker)
        })
    }
}

impl JobRecord {
    /// A job that nobody has tried yet.
    pub fn new(shape: JobShape) -> Self {
        Self {
            shape,
            state: LedgerState::Open,
            attempt: Attempt(0),
            failures: 0,
            losses: 0,
            suspect: false,
            deaths_alone: 0,
            outdated: false,
        }
    }
}

impl Worker {
    pub(super) fn new(deadline: Timestamp) -> Self {
        let (holds, last) = (Vec::new(), BTreeMap::new());
        Self { deadline, ready: false, reported: false, host: String::new(), holds, last }
    }
}
