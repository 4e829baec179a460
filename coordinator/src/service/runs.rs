//! `Describe`, `Submit`, `Runs`, `Status`, `Results` and `Cancel`.

use planesweep_plan::{Job, RunId};
use planesweep_proto::limits::{MAX_JOBS, RESULTS_CHUNK};
use planesweep_proto::{JobState, RunStatus, ServiceError, SubmitHeader, WireError, wire};
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::BoxStream;
use tonic::{Status, Streaming};

use super::{Service, check_protocol, check_versions};
use crate::driver::Message;

/// Chunks of results that wait for a slow reader; the ledger is read no faster.
const CHUNKS_AHEAD: usize = 2;

impl Service {
    pub(super) fn answer_describe(
        &self,
        request: &wire::DescribeRequest,
    ) -> Result<wire::DescribeReply, ServiceError> {
        check_protocol(request.protocol_version)?;
        check_versions("the caller", &request.code_version, request.numerics_version)?;
        Ok((&self.store).into())
    }

    pub(super) async fn answer_runs(&self) -> Result<wire::RunsReply, ServiceError> {
        let runs = self.ledger.runs().await.map_err(|e| self.ledger.refusal(&e))?;
        Ok(wire::RunsReply { runs: runs.iter().map(Into::into).collect() })
    }

    pub(super) async fn answer_submit(
        &self,
        mut chunks: Streaming<wire::SubmitChunk>,
    ) -> Result<wire::SubmitReply, ServiceError> {
        let mut header = None;
        let mut jobs = Vec::new();
        while let Some(chunk) = chunks.next().await {
            let chunk = chunk?;
            if let Some(received) = chunk.header {
                check_protocol(received.protocol_version)?;
                header = Some(SubmitHeader::try_from(received)?);
            }
            if header.is_none() {
                break;
            }
            for job in chunk.jobs {
                jobs.push(Job::try_from(job)?);
            }
            if jobs.len() > MAX_JOBS {
                return Err(WireError::TooMany { field: "jobs", got: jobs.len(), limit: MAX_JOBS }.into());
            }
        }
        let header = header.ok_or(WireError::Missing { field: "header of the first chunk" })?;
        let submitted = self.driver.ask(|reply| Message::Submit(header, jobs, reply)).await??;
        Ok((&submitted).into())
    }

    pub(super) async fn answer_status(
        &self,
        request: wire::StatusRequest,
    ) -> Result<wire::StatusReply, ServiceError> {
        let status = self.status_of(&RunId(request.run), request.after).await?;
        Ok((&status).into())
    }

    /// What the ledger says of the run, and the driver of the workers.
    pub(crate) async fn status_of(&self, run: &RunId, after: u64) -> Result<RunStatus, ServiceError> {
        let row = self.ledger.run(run, after).await.map_err(|e| self.ledger.refusal(&e))?;
        let fleet = self.driver.ask(Message::Fleet).await?;
        let unfinished: u64 = row
            .counts
            .iter()
            .filter(|((_, state), _)| matches!(state, JobState::Open | JobState::Leased))
            .map(|(_, jobs)| jobs)
            .sum();
        let finished = row.cancelled || unfinished == 0;
        Ok(RunStatus {
            name: row.name,
            finished,
            cancelled: row.cancelled,
            counts: row.counts,
            failures: row.failures,
            recent: row.recent,
            workers: fleet.workers,
            workers_alive: fleet.alive,
            waiting: fleet.without_worker.filter(|_| !finished),
            late_results: fleet.late_results,
            divergent_results: fleet.divergent_results,
            refused_callers: self.refusals.total(),
        })
    }

    pub(super) async fn answer_results(
        &self,
        request: wire::ResultsRequest,
    ) -> Result<BoxStream<wire::ResultsChunk>, ServiceError> {
        let run = RunId(request.run);
        let ledger = self.ledger.clone();
        let mut page = ledger.results(&run, 0, RESULTS_CHUNK).await.map_err(|e| ledger.refusal(&e))?;
        let (sender, receiver) = mpsc::channel(CHUNKS_AHEAD);
        tokio::spawn(async move {
            let mut from = 0;
            while !page.is_empty() {
                from += page.len();
                let chunk = wire::ResultsChunk { results: page.iter().map(Into::into).collect() };
                if sender.send(Ok(chunk)).await.is_err() {
                    return;
                }
                page = match ledger.results(&run, from, RESULTS_CHUNK).await {
                    Ok(page) => page,
                    Err(error) => {
                        let _ = sender.send(Err(Status::from(ledger.refusal(&error)))).await;
                        return;
                    }
                };
            }
        });
        Ok(Box::pin(ReceiverStream::new(receiver)))
    }

    pub(super) async fn answer_cancel(
        &self,
        request: wire::CancelRequest,
    ) -> Result<wire::CancelReply, ServiceError> {
        self.driver.ask(|reply| Message::Cancel(RunId(request.run), reply)).await??;
        Ok(wire::CancelReply {})
    }
}
