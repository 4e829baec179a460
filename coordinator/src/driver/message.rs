//! What the loop is asked, and the handle that asks.

use std::time::Duration;

use planesweep_plan::{Job, JobId, RunId};
use planesweep_proto::{
    Code, Order, Report, ReportReply, ServiceError, SubmitHeader, Submitted, WorkerStatus,
};
use tokio::sync::{mpsc, oneshot, watch};

/// Where an answer goes.
pub(crate) type Reply<T> = oneshot::Sender<T>;

pub(crate) enum Message {
    Report(Report, Reply<Result<ReportReply, ServiceError>>),
    Submit(SubmitHeader, Vec<Job>, Reply<Result<Submitted, ServiceError>>),
    Cancel(RunId, Reply<Result<(), ServiceError>>),
    ForgetResults(Vec<JobId>, Reply<Result<usize, ServiceError>>),
    Fleet(Reply<Fleet>),
    SetOrder(Order),
    AllStopped(Reply<bool>),
}

/// The workers, and what went wrong with them.
#[derive(Debug)]
pub(crate) struct Fleet {
    pub workers: Vec<WorkerStatus>,
    pub alive: u32,
    pub without_worker: Option<Duration>,
    pub late_results: u64,
    pub divergent_results: u64,
}

#[derive(Clone)]
pub(crate) struct DriverHandle {
    pub(super) messages: mpsc::Sender<Message>,
    pub(super) changed: watch::Receiver<u64>,
}

impl DriverHandle {
    /// Sends a message without an answer.
    pub(crate) async fn tell(&self, message: Message) -> Result<(), ServiceError> {
        self.messages.send(message).await.map_err(|_| stopping())
    }

    /// Sends a message and waits for its answer.
    pub(crate) async fn ask<T>(&self, message: impl FnOnce(Reply<T>) -> Message) -> Result<T, ServiceError> {
        let (reply, answer) = oneshot::channel();
        self.tell(message(reply)).await?;
        answer.await.map_err(|_| stopping())
    }

    /// Tells when jobs have changed.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changed.clone()
    }
}

fn stopping() -> ServiceError {
    ServiceError::new(Code::Unavailable, "the coordinator is stopping")
}
