//! A running coordinator: ledger, driver and gRPC server, started and stopped together.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use planesweep_plan::{Job, JobId, RunId};
use planesweep_proto::wire::coordinator_server::CoordinatorServer;
use planesweep_proto::{
    CheckToken, JobResult, Order, Refusals, RunStatus, ServerTls, ServiceError, StorePlace, SubmitHeader,
    Submitted, TlsError, check_jobs, probing_server, serve,
};
use planesweep_store::StoreError;
use thiserror::Error;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::service::interceptor::InterceptedService;

use crate::config::{Config, ConfigError, ServedStore};
use crate::driver::{Driver, DriverHandle, Message, Settings};
use crate::ledger::{Ledger, LedgerError};
use crate::service::{BlobService, Service};

/// How long calls may take to end when the server stops.
const CLOSING: Duration = Duration::from_secs(2);

/// Why a coordinator did not start.
#[derive(Debug, Error)]
pub enum StartError {
    /// The configuration is refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The ledger is.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The store does not say who it is.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The certificate cannot be served with.
    #[error("cannot speak TLS")]
    Tls(#[from] TlsError),
    /// The address is taken, or not of this host.
    #[error("could not listen on {listen}")]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// Why.
        #[source]
        source: io::Error,
    },
}

/// Starts coordinators.
#[derive(Debug)]
pub struct Coordinator;

impl Coordinator {
    /// Opens the ledger, goes on with what it holds, and serves. The address is bound when this
    /// returns.
    pub async fn start(config: Config) -> Result<Handle, StartError> {
        let expected = config.check()?;
        let tls = config.tls.as_ref().map(ServerTls::acceptor).transpose()?;
        let scheme = if tls.is_some() { "https" } else { "http" };
        if tls.is_none() && !config.listen.ip().is_loopback() {
            tracing::warn!("the token, and everything else, travels in plain text: there is no certificate");
        }
        let listener = TcpListener::bind(config.listen).await;
        let listener = listener.map_err(|source| StartError::Listen { listen: config.listen, source })?;
        let local_addr =
            listener.local_addr().map_err(|source| StartError::Listen { listen: config.listen, source })?;
        let ledger = Arc::new(Ledger::open(&config.ledger).await?);
        let identity = match &config.served {
            Some(served) => Some(tie(&ledger, served).await?),
            None => None,
        };
        let closed = CancellationToken::new();
        let store = StorePlace { url: config.store_url.clone(), identity };
        let settings =
            Settings { lease: config.lease, report_interval: config.report_interval(), store: store.clone() };
        let (driver, driver_task) = Driver::start(ledger.clone(), settings, closed.clone()).await?;
        let refusals = Refusals::default();
        let service = Service { driver, ledger, store, refusals: refusals.clone() };
        let check = CheckToken { expected, refusals: refusals.clone() };
        let guarded = InterceptedService::new(service.clone().into_server(), check.clone());
        let blobs = config.served.as_ref().map(|served| BlobService::server(served.store.clone()));
        let blobs = blobs.map(|blobs| InterceptedService::new(blobs, check));
        let (health, health_service) = tonic_health::server::health_reporter();
        health.set_serving::<CoordinatorServer<Service>>().await;
        let stop = CancellationToken::new();
        let stopped = stop.clone().cancelled_owned();
        let router =
            probing_server().add_service(health_service).add_service(guarded).add_optional_service(blobs);
        let server_task = serve(router, listener, tls, refusals, stopped);
        Ok(Handle {
            local_addr,
            scheme,
            report_interval: config.report_interval(),
            service,
            stop: stop.drop_guard(),
            closed: closed.drop_guard(),
            driver_task,
            server_task,
        })
    }
}

/// Ties the ledger to the store that is served; what that says of itself.
async fn tie(ledger: &Ledger, served: &ServedStore) -> Result<String, StartError> {
    let store = &served.store;
    let identity = match ledger.store().await? {
        // One that says nothing, which no store has for an identity, is another one. Nothing is written into it: it may
        // be here by mistake.
        Some(_) => store.said_identity().await?.unwrap_or_default(),
        None => store.identity(&served.new_identity).await?,
    };
    ledger.tie_to_store(&identity, store.url()).await?;
    Ok(identity)
}

/// A running coordinator. Dropped without [`Handle::shutdown`], it stops as if it were killed.
pub struct Handle {
    local_addr: SocketAddr,
    scheme: &'static str,
    report_interval: Duration,
    service: Service,
    stop: DropGuard,
    closed: DropGuard,
    driver_task: JoinHandle<()>,
    server_task: JoinHandle<Result<(), tonic::transport::Error>>,
}

impl Handle {
    /// Where it listens.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// The address for [`planesweep_proto::Client::connect`].
    pub fn url(&self) -> String {
        format!("{}://{}", self.scheme, self.local_addr)
    }

    /// Submits a plan, as over the wire and with the same checks of each job; each job follows those
    /// that it needs. The first job that is refused is named by its kind and view.
    ///
    /// A job that repeats an earlier one (the same id, and the same content but for paths, names and
    /// ids of views) is left out: the run lists it once, under the view that came first. A job that
    /// is known from an earlier run gets the paths and the view id of this one.
    pub async fn submit(&self, header: SubmitHeader, jobs: Vec<Job>) -> Result<Submitted, ServiceError> {
        check_jobs(&jobs)?;
        self.driver().ask(|reply| Message::Submit(header, jobs, reply)).await?
    }

    /// How far a run is, with the jobs that ended after `after` (0, then the last `ended` seen).
    pub async fn status(&self, run: &RunId, after: u64) -> Result<RunStatus, ServiceError> {
        self.service.status_of(run, after).await
    }

    /// Every job of a run, in the order of the plan.
    pub async fn results(&self, run: &RunId) -> Result<Vec<JobResult>, ServiceError> {
        let ledger = &self.service.ledger;
        ledger.results(run, 0, usize::MAX >> 1).await.map_err(|e| ledger.refusal(&e))
    }

    /// Stops a run; what is done stays.
    pub async fn cancel(&self, run: &RunId) -> Result<(), ServiceError> {
        self.driver().ask(|reply| Message::Cancel(run.clone(), reply)).await?
    }

    /// Makes done jobs run again whose results are no longer in the store; says how many there were.
    pub async fn forget_results(&self, jobs: Vec<JobId>) -> Result<usize, ServiceError> {
        self.driver().ask(|reply| Message::ForgetResults(jobs, reply)).await?
    }

    /// Waits until every job of a run ended, or the run was cancelled. Waits for ever when no worker
    /// comes; [`Handle::status`] tells.
    pub async fn wait_finished(&self, run: &RunId) -> Result<RunStatus, ServiceError> {
        let ledger = &self.service.ledger;
        let mut changes = self.driver().changes();
        loop {
            changes.borrow_and_update();
            if ledger.is_finished(run).await.map_err(|e| ledger.refusal(&e))? {
                return self.status(run, 0).await;
            }
            if changes.changed().await.is_err() {
                return Err(ServiceError::new(
                    planesweep_proto::Code::Unavailable,
                    "the coordinator is stopping",
                ));
            }
        }
    }

    /// Tells all workers to end what they hold and go; nothing new is granted.
    pub async fn drain(&self) -> Result<(), ServiceError> {
        self.driver().tell(Message::SetOrder(Order::Drain)).await
    }

    /// Waits until no worker is left that has something in hand: all have gone, or their leases ended.
    pub async fn drained(&self) -> Result<(), ServiceError> {
        while !self.driver().ask(Message::AllStopped).await? {
            tokio::time::sleep(self.report_interval / 50).await;
        }
        Ok(())
    }

    /// Tells the workers to stop, waits a report interval at most until all know it, and closes.
    pub async fn shutdown(self) {
        let driver = self.driver();
        let told = async {
            driver.tell(Message::SetOrder(Order::Stop)).await?;
            self.drained().await
        };
        // Who does not hear it in time finds nobody to report to, and ends by its own lease.
        let _ = tokio::time::timeout(self.report_interval, told).await;
        drop(self.stop);
        let mut server_task = self.server_task;
        if tokio::time::timeout(CLOSING, &mut server_task).await.is_err() {
            server_task.abort();
            let _ = server_task.await;
        }
        drop(self.closed);
        let _ = self.driver_task.await;
        if let Some(ledger) = Arc::into_inner(self.service.ledger) {
            ledger.close().await;
        }
    }

    fn driver(&self) -> &DriverHandle {
        &self.service.driver
    }
}
