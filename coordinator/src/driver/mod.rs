//! The one loop: takes messages, reads the clock, has decisions made and carries them out.
//!
//! Nothing else reads the clock. Each message is one step of the ledger: decided on the snapshot,
//! committed, then answered. What other coordinators did in a ledger that is shared is taken over
//! before each decision (`shared`). When the ledger fails, the snapshot is read anew from it and the
//! caller may ask again.

mod carry_out;
mod message;
mod peers;
mod repeats;
mod report;
mod runs;
mod shared;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use planesweep_plan::{JobId, WorkerId};
use planesweep_proto::{
    Order, Produced, Role, ServiceError, StorePlace, WorkerState, WorkerStatus, with_causes,
};
use tokio::sync::{mpsc, watch};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

pub(crate) use message::{DriverHandle, Fleet, Message};
use peers::Place;
use report::Parked;

use crate::ledger::{Change, Changes, Ledger, LedgerError};
use crate::schedule::{Event, Snapshot, Timestamp, decide};

/// Messages that may wait for the loop; senders beyond wait themselves.
const QUEUE: usize = 1024;
/// Workers remembered after their end, for people.
const MAX_KNOWN_WORKERS: usize = 10_000;

/// The numbers that the loop needs from the configuration.
#[derive(Clone, Debug)]
pub(crate) struct Settings {
    pub lease: Duration,
    pub report_interval: Duration,
    pub store: StorePlace,
}

impl Settings {
    /// How often the loop looks what time alone brought.
    fn tick(&self) -> Duration {
        (self.lease / 16).max(Duration::from_millis(5))
    }
}

/// What is known of a worker beside its jobs.
#[derive(Debug)]
struct WorkerInfo {
    place: Place,
    role: Role,
    device: String,
    state: WorkerState,
    last_report: Timestamp,
    sequence: u64,
}

pub(crate) struct Driver {
    ledger: Arc<Ledger>,
    settings: Settings,
    snapshot: Snapshot,
    results: BTreeMap<JobId, Produced>,
    /// The step of the ledger that the snapshot stands at; `None` while it must be read anew.
    seen: Option<i64>,
    /// The loop's clock starts here.
    epoch: Instant,
    workers: BTreeMap<WorkerId, WorkerInfo>,
    /// Reports whose reply is held back until there is something to say.
    parked: BTreeMap<WorkerId, Parked>,
    order: Order,
    /// Workers that know that they are to stop, or stop by themselves.
    told_to_stop: BTreeSet<WorkerId>,
    without_worker_since: Option<Timestamp>,
    late_results: u64,
    divergent_results: u64,
    /// Rises with every change of a job, for those who wait for a run's end.
    changes: watch::Sender<u64>,
    /// When the loop last had time for a tick.
    ticked: Timestamp,
}

impl Driver {
    /// Reads the ledger and starts the loop; it ends when told so or when every handle is gone.
    pub(crate) async fn start(
        ledger: Arc<Ledger>,
        settings: Settings,
        closed: CancellationToken,
    ) -> Result<(DriverHandle, tokio::task::JoinHandle<()>), LedgerError> {
        let epoch = Instant::now();
        let (snapshot, results, seen) = read(&ledger, settings.lease, Timestamp(0)).await?;
        let (messages, inbox) = mpsc::channel(QUEUE);
        let (changes, changed) = watch::channel(0);
        let driver = Self {
            ledger,
            settings,
            snapshot,
            results,
            seen: Some(seen),
            epoch,
            workers: BTreeMap::new(),
            parked: BTreeMap::new(),
            order: Order::Work,
            told_to_stop: BTreeSet::new(),
            without_worker_since: Some(Timestamp(0)),
            late_results: 0,
            divergent_results: 0,
            changes,
            ticked: Timestamp(0),
        };
        let task = tokio::spawn(driver.run(inbox, closed));
        Ok((DriverHandle { messages, changed }, task))
    }

    async fn run(mut self, mut inbox: mpsc::Receiver<Message>, closed: CancellationToken) {
        let mut ticks = tokio::time::interval(self.settings.tick());
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = closed.cancelled() => return,
                message = inbox.recv() => match message {
                    Some(message) => self.handle(message).await,
                    None => return,
                },
                _ = ticks.tick() => self.tick().await,
            }
            self.serve_parked().await;
        }
    }

    async fn handle(&mut self, message: Message) {
        match message {
            Message::Report(report, reply) => self.report(report, reply).await,
            Message::Submit(header, jobs, reply) => {
                let answer = self.submit(header, jobs).await;
                let _ = reply.send(answer);
            }
            Message::Cancel(run, reply) => {
                let answer = self.cancel(run).await;
                let _ = reply.send(answer);
            }
            Message::ForgetResults(jobs, reply) => {
                let answer = self.forget_results(jobs).await;
                let _ = reply.send(answer);
            }
            Message::Fleet(reply) => {
                let _ = reply.send(self.fleet());
            }
            Message::SetOrder(order) => self.order = order,
            Message::AllStopped(reply) => {
                let all = self
                    .workers
                    .keys()
                    .all(|worker| !self.snapshot.is_alive(worker) || self.told_to_stop.contains(worker));
                let _ = reply.send(all);
            }
        }
    }

    fn now(&self) -> Timestamp {
        Timestamp(self.epoch.elapsed().as_millis() as u64)
    }

    async fn tick(&mut self) {
        let now = self.now();
        // A process that stood still, or was busy with one large step, heard no reports; that nobody
        // reported to it means nothing.
        let stood_still = now.0.saturating_sub(self.ticked.0);
        if stood_still > self.settings.lease.as_millis() as u64 / 4 {
            self.snapshot.prolong(stood_still);
        }
        self.ticked = now;
        if let Err(error) = self.catch_up().await {
            tracing::warn!(error = with_causes(&error), "the ledger does not answer");
            self.seen = None;
            return;
        }
        if decide(&self.snapshot, Event::Tick, now).is_empty()
            || self.carry_out_alone(Event::Tick, now).await.is_ok()
        {
            self.note_workers(now);
        }
    }

    /// Keeps account of since when there is no worker.
    fn note_workers(&mut self, now: Timestamp) {
        if self.snapshot.has_holder() {
            self.without_worker_since = None;
        } else if self.without_worker_since.is_none() {
            self.without_worker_since = Some(now);
            if self.snapshot.has_unfinished() {
                tracing::warn!("no worker is left; the jobs wait for new ones");
            }
        }
        while self.workers.len() > MAX_KNOWN_WORKERS {
            let gone = self.workers.iter().filter(|(id, _)| !self.snapshot.is_alive(id));
            let Some(oldest) = gone.min_by_key(|(_, info)| info.last_report).map(|(id, _)| id.clone()) else {
                return;
            };
            self.workers.remove(&oldest);
        }
    }

    /// The step failed and was rolled back: what the ledger says holds.
    async fn recover(&mut self, error: &LedgerError) -> ServiceError {
        // Nothing is decided until it can be written down: workers keep what they have, and report again.
        let refusal = self.ledger.refusal(error);
        tracing::error!(error = refusal.message, "the ledger failed; it is read anew");
        self.seen = None;
        if let Err(error) = self.catch_up().await {
            tracing::error!(error = with_causes(&error), "the ledger cannot be read");
        }
        refusal
    }

    fn fleet(&self) -> Fleet {
        let now = self.now();
        let since = |then: Timestamp| Duration::from_millis(now.0.saturating_sub(then.0));
        Fleet {
            workers: self
                .workers
                .iter()
                .map(|(id, info)| WorkerStatus {
                    worker: id.clone(),
                    host: info.place.host.clone(),
                    role: info.role,
                    device: info.device.clone(),
                    state: info.state,
                    alive: self.snapshot.is_alive(id),
                    last_report_ago: since(info.last_report),
                    held: self.snapshot.held_by(id) as u32,
                })
                .collect(),
            alive: self.snapshot.alive() as u32,
            without_worker: self.without_worker_since.map(since),
            late_results: self.late_results,
            divergent_results: self.divergent_results,
        }
    }
}

async fn read(
    ledger: &Ledger,
    lease: Duration,
    now: Timestamp,
) -> Result<(Snapshot, BTreeMap<JobId, Produced>, i64), LedgerError> {
    let Changes { step, jobs } = ledger.load(now).await?;
    let mut results = BTreeMap::new();
    let records = jobs.into_iter().map(|Change { record, produced, .. }| {
        results.extend(produced.map(|produced| (record.shape.id, produced)));
        record
    });
    let snapshot = Snapshot::new(lease.as_millis() as u64, records, now);
    Ok((snapshot, results, step))
}
