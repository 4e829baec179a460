//! How commands, and what other coordinators did, change what scheduling knows.

use planesweep_plan::{Attempt, JobId, WorkerId};

use super::state::{Job, JobRecord, LedgerState, Maker, Ordinal, Snapshot, State, Worker};
use super::{Command, Reopening, Timestamp};

impl Snapshot {
    /// Takes over what another coordinator did with a job, as the ledger has it now; `deadline` is the end of
    /// its lease, if it has one. Says whether the snapshot can hold it.
    ///
    /// What this coordinator knows better stays: when a job may be tried again, whether it was begun.
    pub fn observe(&mut self, record: JobRecord, deadline: Option<Timestamp>, now: Timestamp) -> bool {
        let holder = match &record.state {
            LedgerState::Leased(worker) => Some(worker.clone()),
            _ => None,
        };
        let is_known = match self.ordinals.get(&record.shape.id) {
            None => self.add(record, now),
            Some(&ordinal) => {
                self.overwrite(ordinal, record, now);
                true
            }
        };
        // Whoever renews the lease knows that the worker lives.
        let ends = deadline.unwrap_or_else(|| now.plus(self.lease_ms));
        if let Some(worker) = holder.and_then(|holder| self.workers.get_mut(&holder)) {
            worker.deadline = if worker.reported { worker.deadline.max(ends) } else { ends };
        }
        is_known
    }

    fn overwrite(&mut self, ordinal: Ordinal, record: JobRecord, now: Timestamp) {
        let JobRecord { state, attempt, failures, losses, suspect, deaths_alone, outdated, .. } = record;
        self.drop_from_holder(ordinal);
        self.leave_ready(ordinal);
        let job = &mut self.jobs[ordinal as usize];
        let is_same = job.attempt == attempt;
        let old = std::mem::replace(&mut job.state, State::Cancelled);
        (job.attempt, job.failures, job.losses) = (attempt, failures, losses);
        (job.suspect, job.deaths_alone, job.outdated) = (suspect, deaths_alone, outdated);
        let mut not_before = Timestamp::default();
        match state {
            LedgerState::Open => {
                if let (State::Open { not_before: known, .. }, true) = (&old, is_same) {
                    not_before = *known;
                }
                job.state = State::Open { unmet: 0, not_before };
            }
            LedgerState::Leased(worker) => {
                let was_started =
                    matches!(&old, State::Leased { started: true, worker: of } if of == &worker);
                let started = is_same && was_started;
                let deadline = now.plus(self.lease_ms);
                let holder = self.workers.entry(worker.clone()).or_insert_with(|| Worker::new(deadline));
                holder.holds.push(ordinal);
                job.state = State::Leased { worker, started };
            }
            LedgerState::Done => job.state = State::Done,
            LedgerState::Failed => job.state = State::Failed,
            LedgerState::Cancelled => {}
        }
        let (had_ended, has_ended) = (old.has_ended(), job.state.has_ended());
        let is_open = matches!(job.state, State::Open { .. });
        match (had_ended, has_ended) {
            (true, false) => self.tell_dependents(ordinal, |unmet| unmet + 1),
            (false, true) => self.tell_dependents(ordinal, |unmet| unmet.saturating_sub(1)),
            _ => {}
        }
        if is_open {
            self.enter_open(ordinal, not_before);
        }
    }

    /// Puts the end of every lease off: for this long nobody could have reported.
    pub fn prolong(&mut self, ms: u64) {
        for worker in self.workers.values_mut() {
            worker.deadline = worker.deadline.plus(ms);
        }
    }

    /// Changes the snapshot as the command says; `false` when the command comes too late, so that
    /// nothing changed. The same conditions stand in the ledger's statements.
    pub fn apply(&mut self, command: &Command, now: Timestamp) -> bool {
        match command {
            Command::Insert { shape } => {
                !self.knows(&shape.id) && self.add(JobRecord::new(shape.clone()), now)
            }
            Command::Reopen { job, why } => self.reopen(job, *why),
            Command::Admit { worker, host, ready, deadline } => {
                let worker = self.workers.entry(worker.clone()).or_insert_with(|| Worker::new(*deadline));
                (worker.ready, worker.deadline, worker.reported) = (*ready, *deadline, true);
                worker.host.clone_from(host);
                true
            }
            Command::Renew { job, attempt, worker, started, .. } => {
                self.change_lease(job, *attempt, Some(worker), |job, _| {
                    if let State::Leased { started: is, .. } = &mut job.state {
                        *is = *started;
                    }
                })
            }
            Command::Grant { job, attempt, worker, .. } => self.grant(job, *attempt, worker),
            Command::Complete { job, attempt, worker } => {
                self.end(job, *attempt, Some(worker), State::Done) && {
                    let maker = self.note_maker(worker);
                    let ordinal = self.ordinals[job];
                    self.jobs[ordinal as usize].maker = Some(maker);
                    true
                }
            }
            Command::GiveUp { job, attempt, .. } => self.end(job, *attempt, None, State::Failed),
            Command::Retry { job, attempt, failures, losses, until } => {
                self.take_back(job, *attempt, *until, |job| {
                    (job.failures, job.losses) = (*failures, *losses);
                })
            }
            Command::Release { job, attempt } => self.take_back(job, *attempt, now, |_| ()),
            Command::Suspect { job, attempt, deaths_alone } => self.take_back(job, *attempt, now, |job| {
                job.suspect = true;
                job.deaths_alone = *deaths_alone;
            }),
            Command::Cancel { job } => self.cancel(job),
            Command::Dismiss { worker } => self.workers.remove(worker).is_some(),
            Command::Revoke { .. } | Command::Acknowledge { .. } | Command::CountLate { .. } => true,
        }
    }

    pub(super) fn add(&mut self, record: JobRecord, now: Timestamp) -> bool {
        let JobRecord { shape, state, attempt, failures, losses, suspect, deaths_alone, outdated } = record;
        let needs: Option<Box<[Ordinal]>> =
            shape.needs.iter().map(|need| self.ordinals.get(need).copied()).collect();
        let Some(needs) = needs else { return false };
        let ordinal = self.jobs.len() as Ordinal;
        for need in &needs {
            self.jobs[*need as usize].dependents.push(ordinal);
        }
        let state = match state {
            LedgerState::Open => State::Open { unmet: 0, not_before: now },
            LedgerState::Leased(worker) => {
                let deadline = now.plus(self.lease_ms);
                let of = self.workers.entry(worker.clone()).or_insert_with(|| Worker::new(deadline));
                of.holds.push(ordinal);
                State::Leased { worker, started: false }
            }
            LedgerState::Done => State::Done,
            LedgerState::Failed => State::Failed,
            LedgerState::Cancelled => State::Cancelled,
        };
        let is_open = matches!(state, State::Open { .. });
        self.ordinals.insert(shape.id, ordinal);
        self.jobs.push(Job {
            id: shape.id,
            class: shape.class,
            needs,
            dependents: Vec::new(),
            state,
            attempt,
            failures,
            losses,
            suspect,
            deaths_alone,
            outdated,
            maker: None,
        });
        if is_open {
            self.enter_open(ordinal, now);
        }
        true
    }

    fn grant(&mut self, job: &JobId, attempt: Attempt, worker: &WorkerId) -> bool {
        let Some(&ordinal) = self.ordinals.get(job) else { return false };
        let job = &mut self.jobs[ordinal as usize];
        let is_ready = matches!(job.state, State::Open { unmet: 0, .. });
        let (Some(holder), true) = (self.workers.get_mut(worker), is_ready && attempt > job.attempt) else {
            return false;
        };
        holder.holds.push(ordinal);
        holder.last.insert(job.class, ordinal);
        job.attempt = attempt;
        job.state = State::Leased { worker: worker.clone(), started: false };
        self.leave_ready(ordinal);
        true
    }

    /// A number for the worker; the latest are looked at first, for they are the ones that live.
    fn note_maker(&mut self, worker: &WorkerId) -> u32 {
        let known = self.makers.iter().rposition(|maker| maker.worker == *worker);
        let at = known.unwrap_or_else(|| {
            let host = self.workers.get(worker).map(|worker| worker.host.clone()).unwrap_or_default();
            self.makers.push(Maker { worker: worker.clone(), host });
            self.makers.len() - 1
        });
        at as u32
    }

    /// Ends a lease with a result or for good, and with it the wait of those who need the job.
    fn end(&mut self, job: &JobId, attempt: Attempt, worker: Option<&WorkerId>, state: State) -> bool {
        self.change_lease(job, attempt, worker, |job, _| {
            // What failed may leave others without it; what is done is waited for by all others.
            job.outdated = state == State::Failed;
            job.state = state;
            (job.failures, job.losses, job.suspect, job.deaths_alone) = (0, 0, false, 0);
        }) && {
            let ordinal = self.ordinals[job];
            self.drop_from_holder(ordinal);
            self.tell_dependents(ordinal, |unmet| unmet.saturating_sub(1));
            true
        }
    }

    /// Ends a lease without a result.
    fn take_back(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        not_before: Timestamp,
        change: impl FnOnce(&mut Job),
    ) -> bool {
        self.change_lease(job, attempt, None, |job, _| change(job)) && {
            let ordinal = self.ordinals[job];
            self.drop_from_holder(ordinal);
            self.enter_open(ordinal, not_before);
            true
        }
    }

    /// Changes a job whose lease is at this attempt (and with this worker); `false` if it is not.
    fn change_lease(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        worker: Option<&WorkerId>,
        change: impl FnOnce(&mut Job, Ordinal),
    ) -> bool {
        let Some(&ordinal) = self.ordinals.get(job) else { return false };
        let job = &mut self.jobs[ordinal as usize];
        match &job.state {
            State::Leased { worker: holder, .. }
                if job.attempt == attempt && worker.is_none_or(|worker| worker == holder) =>
            {
                change(job, ordinal);
                true
            }
            _ => false,
        }
    }

    fn reopen(&mut self, job: &JobId, why: Reopening) -> bool {
        let Some(&ordinal) = self.ordinals.get(job) else { return false };
        let job = &mut self.jobs[ordinal as usize];
        let had_ended = job.state.has_ended();
        let allowed = match why {
            Reopening::Resubmitted => matches!(job.state, State::Failed | State::Cancelled),
            Reopening::ResultLost => job.state == State::Done,
            Reopening::NewInput => matches!(job.state, State::Done | State::Leased { .. }),
        };
        // A lost result comes back as it was; with a new input it may differ.
        job.outdated |= why == Reopening::NewInput;
        if !allowed {
            return why == Reopening::NewInput;
        }
        (job.failures, job.losses, job.suspect, job.deaths_alone) = (0, 0, false, 0);
        self.drop_from_holder(ordinal);
        if had_ended {
            self.tell_dependents(ordinal, |unmet| unmet + 1);
        }
        self.enter_open(ordinal, Timestamp::default());
        true
    }

    fn cancel(&mut self, job: &JobId) -> bool {
        let Some(&ordinal) = self.ordinals.get(job) else { return false };
        if !matches!(self.jobs[ordinal as usize].state, State::Open { .. } | State::Leased { .. }) {
            return false;
        }
        self.drop_from_holder(ordinal);
        self.leave_ready(ordinal);
        self.jobs[ordinal as usize].state = State::Cancelled;
        true
    }

    fn drop_from_holder(&mut self, ordinal: Ordinal) {
        // A job is in the hands of one worker at most, and workers hold few jobs.
        for worker in self.workers.values_mut() {
            worker.holds.retain(|held| *held != ordinal);
        }
    }

    /// Makes a job open, and ready when all it needs has ended.
    pub(super) fn enter_open(&mut self, ordinal: Ordinal, not_before: Timestamp) {
        let needs = self.jobs[ordinal as usize].needs.iter();
        let unmet = needs.filter(|need| !self.jobs[**need as usize].state.has_ended()).count() as u32;
        self.jobs[ordinal as usize].state = State::Open { unmet, not_before };
        self.place(ordinal);
    }

    /// Adjusts what the open jobs that need this one wait for.
    fn tell_dependents(&mut self, ordinal: Ordinal, change: impl Fn(u32) -> u32) {
        let dependents = std::mem::take(&mut self.jobs[ordinal as usize].dependents);
        for dependent in &dependents {
            if let State::Open { unmet, .. } = &mut self.jobs[*dependent as usize].state {
                *unmet = change(*unmet);
                self.place(*dependent);
            }
        }
        self.jobs[ordinal as usize].dependents = dependents;
    }

    /// Puts an open job into the set where it belongs.
    fn place(&mut self, ordinal: Ordinal) {
        self.leave_ready(ordinal);
        let job = &self.jobs[ordinal as usize];
        if matches!(job.state, State::Open { unmet: 0, .. }) {
            if job.suspect {
                self.suspects.insert(ordinal);
            } else {
                self.ready.entry(job.class).or_default().insert(ordinal);
            }
        }
    }

    fn leave_ready(&mut self, ordinal: Ordinal) {
        self.suspects.remove(&ordinal);
        if let Some(ready) = self.ready.get_mut(&self.jobs[ordinal as usize].class) {
            ready.remove(&ordinal);
        }
    }
}
