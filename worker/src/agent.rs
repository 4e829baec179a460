//! The report loop: results out, jobs in.
//!
//! One loop owns all state. It reports as soon as a job ends, and otherwise at the interval that the
//! coordinator names; the reply may be held back while there is nothing to say, so an idle worker
//! learns of a job at once. Jobs run as tasks and tell the loop when they begin and end.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use planesweep_plan::{NUMERICS_VERSION, WorkerId};
use planesweep_proto::{
    Client, Code, Credentials, Failure, Grant, JobAttempt, Order, Outcome, PROTOCOL_VERSION, Report,
    ReportReply, Role, ServiceError, Slots, StorePlace, WorkerState,
};
use thiserror::Error;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::device::{BackendFactory, Device};
use crate::disk_cache::DiskCache;
use crate::exchange::{Exchange, ExchangeConfig, ExchangeError, Trust};
use crate::failure::JobError;
use crate::fault_point::{FaultPoint, code_version, pass};
use crate::held::Held;
use crate::jobs::Jobs;
use crate::maps::Maps;
use crate::orders::{Orders, Verdict};
use crate::store::{Store, StoreError};

/// The first report asks for an answer at once, for it brings the store's address.
const FIRST_WAIT: Duration = Duration::ZERO;
/// Between reports that brought nothing although the coordinator answered at once.
const SHORTEST_PAUSE: Duration = Duration::from_millis(20);
/// Pauses between attempts to reach the coordinator: doubled up to the longest.
const RECONNECT: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(2));

/// Is told where the maps of a worker are served.
pub type ConnectedHook = Box<dyn FnOnce(&str) + Send>;

/// What a worker is told when it starts.
pub struct WorkerConfig {
    /// The coordinator, such as `http://127.0.0.1:7070`; with commas between, several that share a ledger: the
    /// worker goes on to the next when one cannot be reached or goes.
    pub coordinator: String,
    /// What is shown to the coordinator and to other workers, and who vouches for them.
    pub credentials: Credentials,
    /// One life of this process.
    pub id: WorkerId,
    /// Name of this host.
    pub host: String,
    /// What tells hosts of one name apart.
    pub boot_id: String,
    /// Which jobs it takes.
    pub role: Role,
    /// The device it infers on, for people.
    pub device: String,
    /// Jobs it holds at once, by class.
    pub slots: Slots,
    /// Budget of images in memory, of depth maps, of filtered ones, and of maps in shared memory, each.
    pub cache_bytes: u64,
    /// Where photographs and masks are kept that come from the store, and how many bytes of them.
    pub disk_cache: (PathBuf, u64),
    /// How it exchanges maps with other workers.
    pub exchange: ExchangeConfig,
    /// Makes the network.
    pub backend: BackendFactory,
    /// Called once, when a coordinator has taken the worker, with where its maps are served.
    pub connected: ConnectedHook,
}

/// Why a worker ended before its time.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// The coordinator refuses this worker, or the worker does not trust it.
    #[error("cannot work for coordinator {url}")]
    Refused {
        /// The coordinator.
        url: String,
        /// Why.
        #[source]
        source: ServiceError,
    },
    /// The store cannot be opened.
    #[error("cannot reach the results")]
    Store(#[from] StoreError),
    /// The device cannot run the network, or its thread has ended.
    #[error("the device is out of order: {message}")]
    BrokenDevice {
        /// Why.
        message: String,
    },
    /// The thread of the device cannot be started.
    #[error("cannot start the thread of the device")]
    Device(#[source] std::io::Error),
    /// Its maps cannot be served to others.
    #[error("cannot exchange maps with other workers")]
    Exchange(#[from] ExchangeError),
}

/// Works until the coordinator says stop or `stop` is cancelled; a running job is ended first, what
/// was only queued is given back.
pub async fn run_worker(config: WorkerConfig, stop: CancellationToken) -> Result<(), WorkerError> {
    let client = Client::connect_with(&config.coordinator, &config.credentials)
        .map_err(|source| WorkerError::Refused { url: config.coordinator.clone(), source })?;
    config.exchange.check(&config.coordinator)?;
    let device = Device::start(config.backend).map_err(WorkerError::Device)?;
    let maps = Arc::new(Maps::new(config.cache_bytes));
    let disk_cache = DiskCache::new(config.disk_cache.0, config.disk_cache.1);
    let exchange = Exchange::start(
        &config.exchange,
        &config.id,
        &config.host,
        config.role,
        Trust::of(&config.coordinator, config.credentials),
        Arc::clone(&maps),
        config.cache_bytes,
    )
    .await?;
    let (events, inbox) = mpsc::channel(64);
    let agent = Agent {
        identity: Identity {
            coordinator: config.coordinator,
            worker: config.id,
            host: config.host,
            boot_id: config.boot_id,
            role: config.role,
            device: config.device,
        },
        orders: Orders::new(client.coordinators()),
        client,
        epoch: Instant::now(),
        sequence: 0,
        state: WorkerState::Ready,
        held: Held::new(config.role, config.slots),
        tasks: BTreeMap::new(),
        events,
        exchange: Arc::new(exchange),
        jobs: None,
        has_begun_to_open: false,
        connected: Some(config.connected),
        unopened: Some(Unopened { device, maps, cache_bytes: config.cache_bytes, disk_cache }),
        max_wait: FIRST_WAIT,
        lease_ends: None,
        broken: None,
        impatience: CancellationToken::new(),
    };
    agent.run(inbox, stop).await
}

struct Identity {
    coordinator: String,
    worker: WorkerId,
    host: String,
    boot_id: String,
    role: Role,
    device: String,
}

/// What the jobs are going to be made of.
struct Unopened {
    device: Device,
    maps: Arc<Maps>,
    cache_bytes: u64,
    disk_cache: DiskCache,
}

enum Event {
    /// The store was found, or cannot be.
    Opened(Result<Store, StoreError>),
    Started(JobAttempt),
    Finished(JobAttempt, Outcome),
    /// The job ended for the device is out of order.
    Broken(JobAttempt, Failure),
}

struct Agent {
    identity: Identity,
    client: Client,
    orders: Orders,
    epoch: Instant,
    sequence: u64,
    state: WorkerState,
    held: Held,
    /// A way to give up each running job.
    tasks: BTreeMap<JobAttempt, CancellationToken>,
    events: mpsc::Sender<Event>,
    exchange: Arc<Exchange>,
    /// Made when the store is found, of which the first reply tells.
    jobs: Option<Arc<Jobs>>,
    has_begun_to_open: bool,
    connected: Option<ConnectedHook>,
    unopened: Option<Unopened>,
    max_wait: Duration,
    lease_ends: Option<Instant>,
    /// Why the device can do no further job.
    broken: Option<String>,
    /// Ends the waiting for a store in trouble: a worker that goes gives its jobs back instead.
    impatience: CancellationToken,
}

impl Agent {
    async fn run(
        mut self,
        mut inbox: mpsc::Receiver<Event>,
        stop: CancellationToken,
    ) -> Result<(), WorkerError> {
        let mut reconnect = RECONNECT.0;
        loop {
            if stop.is_cancelled() {
                self.drain();
            }
            let report = self.report();
            let sent = Instant::now();
            let mut client = self.client.clone();
            let coordinator = client.coordinator();
            let answer = tokio::select! {
                biased;
                // A job that ends is reported at once; the report under way is dropped for it.
                Some(event) = inbox.recv() => {
                    self.note(event)?;
                    while let Ok(event) = inbox.try_recv() {
                        self.note(event)?;
                    }
                    continue;
                }
                () = stop.cancelled(), if self.state == WorkerState::Ready => continue,
                answer = client.report(&report) => answer,
            };
            match answer {
                Ok(reply) => {
                    reconnect = RECONNECT.0;
                    self.lease_ends = Some(sent + reply.lease);
                    let (order, lease) = (reply.order, reply.lease);
                    let brought_something = self.apply(reply);
                    let verdict = self.orders.hear(coordinator, order, lease, Instant::now());
                    if verdict == Verdict::Leave && self.state == WorkerState::Ready {
                        self.take_leave(coordinator).await;
                        continue;
                    }
                    if order == Order::Stop || self.state == WorkerState::Drained {
                        return Ok(());
                    }
                    if order == Order::Drain {
                        self.drain();
                    }
                    if let Some(message) = self.broken.take() {
                        // Its end was reported; whoever started this worker may start another.
                        return Err(WorkerError::BrokenDevice { message });
                    }
                    if self.state != WorkerState::Ready {
                        // The coordinator holds no reply back for a worker that takes no jobs.
                        pause(self.max_wait.max(SHORTEST_PAUSE), &mut inbox, &mut self).await?;
                    } else if !brought_something && sent.elapsed() < SHORTEST_PAUSE {
                        pause(SHORTEST_PAUSE, &mut inbox, &mut self).await?;
                    }
                }
                Err(error) if error.is_retryable() => {
                    if error.code != Code::Unavailable {
                        self.orders.hear_of_one();
                    } else if self.orders.is_forsaken(Instant::now()) {
                        tracing::warn!("one coordinator goes and no other can be reached, going too");
                        return Ok(());
                    }
                    tracing::warn!(%error, "cannot report to the coordinator, trying again");
                    self.end_lease_if_over();
                    if self.state != WorkerState::Ready {
                        // Nobody takes what it still computes; the lease gives the job to another.
                        return Ok(());
                    }
                    pause(reconnect, &mut inbox, &mut self).await?;
                    reconnect = (2 * reconnect).min(RECONNECT.1);
                }
                Err(source) => {
                    return Err(WorkerError::Refused { url: self.identity.coordinator.clone(), source });
                }
            }
        }
    }

    /// Goes on to the next coordinator. The one that goes is told not to wait for what is held here.
    async fn take_leave(&mut self, coordinator: usize) {
        tracing::info!("the coordinator goes, going on with the next");
        let farewell = Report {
            state: WorkerState::Drained,
            free: Slots::default(),
            max_wait: FIRST_WAIT,
            ..self.report()
        };
        match self.client.clone().report(&farewell).await {
            Ok(reply) => drop(self.apply(reply)),
            Err(error) => tracing::debug!(%error, "the coordinator has gone already"),
        }
        self.client.leave(coordinator);
    }

    fn report(&mut self) -> Report {
        self.sequence += 1;
        if self.state == WorkerState::Draining && self.held.is_empty() {
            self.state = WorkerState::Drained;
        }
        let is_ready = self.state == WorkerState::Ready;
        Report {
            protocol_version: PROTOCOL_VERSION,
            code_version: code_version(),
            numerics_version: NUMERICS_VERSION,
            worker: self.identity.worker.clone(),
            sequence: self.sequence,
            host: self.identity.host.clone(),
            boot_id: self.identity.boot_id.clone(),
            role: self.identity.role,
            device: self.identity.device.clone(),
            state: self.state,
            free: if is_ready && self.jobs.is_some() { self.held.free() } else { Slots::default() },
            offset_ms: self.epoch.elapsed().as_millis() as u64,
            held: self.held.held(),
            finished: self.held.finished(),
            max_wait: if self.state == WorkerState::Drained { Duration::ZERO } else { self.max_wait },
            endpoint: self.exchange.endpoint(),
        }
    }

    /// Opens the store, which may take longer than a lease lasts when it does not answer.
    fn open(&self, place: StorePlace) {
        let (client, events) = (self.client.clone(), self.events.clone());
        tokio::spawn(async move {
            let opened = Store::of(&client, &place).await;
            let _ = events.send(Event::Opened(opened)).await;
        });
    }

    /// Does what a reply says; whether it said anything.
    fn apply(&mut self, reply: ReportReply) -> bool {
        if !self.has_begun_to_open {
            self.has_begun_to_open = true;
            if let (Some(connected), Some(maps)) = (self.connected.take(), self.exchange.endpoint().address) {
                connected(&maps);
            }
            self.open(reply.store);
        }
        self.exchange.learn(&reply.peers);
        self.max_wait = reply.report_interval;
        for attempt in &reply.revoked {
            self.give_up(*attempt);
        }
        self.held.forget(reply.acknowledged.iter().chain(&reply.revoked));
        let brought_something = !reply.grants.is_empty() || !reply.acknowledged.is_empty();
        for grant in reply.grants {
            if self.held.take(&grant) {
                self.begin(grant);
            }
        }
        brought_something
    }

    fn begin(&mut self, grant: Grant) {
        let Some(jobs) = self.jobs.clone() else { return };
        let attempt = JobAttempt { job: grant.job, attempt: grant.attempt };
        let cancelled = CancellationToken::new();
        self.tasks.insert(attempt, cancelled.clone());
        let events = self.events.clone();
        tokio::spawn(async move {
            let job = grant.job.to_string()[..12].to_owned();
            let (kind, view) = (grant.spec.kind(), grant.spec.view().map(|v| v.0));
            // The receiver lives as long as the loop; without it nobody needs to know.
            let begun = events.clone();
            let granted = Arc::new(grant);
            let grant = Arc::clone(&granted);
            let started = move || {
                drop(begun.try_send(Event::Started(attempt)));
                pass(FaultPoint::Started, &granted.spec);
            };
            // On a task of its own, so that a panic ends the job and not the news of it.
            let run = tokio::spawn(async move {
                let made = jobs.run(&grant, &cancelled, started).await?;
                pass(FaultPoint::Stored, &grant.spec);
                Ok(made)
            });
            let result =
                run.await.unwrap_or_else(|panic| Err(JobError::Panicked { message: panic.to_string() }));
            let event = match result {
                Ok(success) => {
                    tracing::debug!(job, kind, view, seconds = success.seconds, "done");
                    Event::Finished(attempt, Outcome::Success(success))
                }
                Err(error) => {
                    let failure = error.to_failure();
                    if !matches!(error, JobError::GivenUp) {
                        tracing::warn!(job, kind, view, code = failure.code, "{}", failure.message);
                    }
                    if error.is_fatal() {
                        Event::Broken(attempt, failure)
                    } else {
                        Event::Finished(attempt, Outcome::Failure(failure))
                    }
                }
            };
            let _ = events.send(event).await;
        });
    }

    fn note(&mut self, event: Event) -> Result<(), WorkerError> {
        match event {
            Event::Opened(store) => {
                let store = store?.patient(self.impatience.clone());
                if let Some(Unopened { device, maps, cache_bytes, disk_cache }) = self.unopened.take() {
                    let exchange = Arc::clone(&self.exchange);
                    let jobs = Jobs::new(store, device, cache_bytes, disk_cache, maps, exchange);
                    self.jobs = Some(Arc::new(jobs));
                }
            }
            Event::Started(attempt) => self.held.start(attempt),
            Event::Finished(attempt, outcome) => {
                self.tasks.remove(&attempt);
                self.held.finish(attempt, outcome);
            }
            Event::Broken(attempt, failure) => {
                self.tasks.remove(&attempt);
                self.broken = Some(failure.message.clone());
                self.held.finish(attempt, Outcome::Failure(failure));
            }
        }
        Ok(())
    }

    fn give_up(&mut self, attempt: JobAttempt) {
        if let Some(cancelled) = self.tasks.remove(&attempt) {
            cancelled.cancel();
        }
    }

    /// Takes no more jobs and gives back those that were not begun.
    fn drain(&mut self) {
        if self.state == WorkerState::Ready {
            self.state = WorkerState::Draining;
            self.impatience.cancel();
            for attempt in self.held.not_started() {
                self.give_up(attempt);
            }
        }
    }

    /// When the lease is over, queued jobs belong to somebody else. A running one goes on: if nobody
    /// else has taken it when the coordinator is back, its result is still welcome.
    fn end_lease_if_over(&mut self) {
        if self.lease_ends.is_some_and(|ends| Instant::now() > ends) {
            let lost = self.held.not_started();
            for attempt in &lost {
                self.give_up(*attempt);
            }
            self.held.forget(&lost);
            self.lease_ends = None;
        }
    }
}

/// Waits, but not longer than until something happens.
async fn pause(
    duration: Duration,
    inbox: &mut mpsc::Receiver<Event>,
    agent: &mut Agent,
) -> Result<(), WorkerError> {
    match tokio::time::timeout(duration, inbox.recv()).await {
        Ok(Some(event)) => agent.note(event),
        _ => Ok(()),
    }
}
