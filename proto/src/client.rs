//! The client's side of the contract, in domain types.

use std::time::Duration;

use planesweep_plan::{Job, NUMERICS_VERSION, RunId};
use prost::Message;
use tokio_stream::StreamExt;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};

use crate::failover::Failover;
use crate::limits::{MAX_MESSAGE_BYTES, SUBMIT_CHUNK_BYTES};
use crate::wire::coordinator_client::CoordinatorClient;
use crate::{
    BlobClient, CODE_VERSION, Code, Credentials, JobResult, PROTOCOL_VERSION, Report, ReportReply, RunStatus,
    RunSummary, ServiceError, StorePlace, SubmitHeader, Submitted, check_jobs, wire,
};

/// The metadata key that carries the token.
pub const TOKEN_HEADER: &str = "authorization";

/// How long a connection may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// How often an idle connection is probed, and how long the answer may take: a host that vanished
/// without a word is noticed after both.
pub(crate) const KEEP_ALIVE: (Duration, Duration) = (Duration::from_secs(10), Duration::from_secs(5));
/// How long a report may take beyond the time that the reply may be held back.
const REPORT_TIMEOUT: Duration = Duration::from_secs(10);

/// What is sent as [`TOKEN_HEADER`] for a token; an error when it has characters that no header
/// can carry.
pub fn bearer(token: &str) -> Result<MetadataValue<Ascii>, ServiceError> {
    format!("Bearer {token}")
        .parse()
        .map_err(|_| ServiceError::new(Code::Invalid, "the token has characters other than printable ASCII"))
}

/// Adds the token to every call.
#[derive(Clone)]
pub struct WithToken(Option<MetadataValue<Ascii>>);

impl WithToken {
    pub(crate) fn new(token: Option<MetadataValue<Ascii>>) -> Self {
        Self(token)
    }
}

impl tonic::service::Interceptor for WithToken {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.0 {
            request.metadata_mut().insert(TOKEN_HEADER, token.clone());
        }
        Ok(request)
    }
}

type Stub = CoordinatorClient<InterceptedService<Channel, WithToken>>;

/// A client of one coordinator, or of several that share a ledger: one of them is called until it cannot be
/// reached, then the next. Cheap to clone; clones share the connections and the choice.
#[derive(Clone)]
pub struct Client {
    coordinators: Failover<Stub>,
    blobs: BlobClient,
}

impl Client {
    /// A client of the coordinator at `url`, such as `http://127.0.0.1:7070`, or of several, with commas
    /// between. A connection is made by the first call and again by the next call after it broke.
    ///
    /// Must be called within a tokio runtime.
    pub fn connect(url: &str, token: Option<&str>) -> Result<Self, ServiceError> {
        Self::connect_with(url, &Credentials::of_token(token))
    }

    /// The same with a token or certificates that vouch for `https://` coordinators.
    pub fn connect_with(url: &str, credentials: &Credentials) -> Result<Self, ServiceError> {
        let token = WithToken(credentials.token.as_deref().map(bearer).transpose()?);
        let endpoint = |url: &str| -> Result<Endpoint, ServiceError> {
            Ok(credentials
                .endpoint(url.trim())?
                .connect_timeout(CONNECT_TIMEOUT)
                .tcp_nodelay(true)
                .http2_keep_alive_interval(KEEP_ALIVE.0)
                .keep_alive_timeout(KEEP_ALIVE.1)
                .keep_alive_while_idle(true))
        };
        let endpoints = url.split(',').map(endpoint).collect::<Result<Vec<_>, _>>()?;
        let blobs = BlobClient::new(&endpoints, &token);
        let stub = |endpoint: &Endpoint| {
            CoordinatorClient::with_interceptor(endpoint.connect_lazy(), token.clone())
                .max_decoding_message_size(MAX_MESSAGE_BYTES)
                .max_encoding_message_size(MAX_MESSAGE_BYTES)
        };
        Ok(Self { coordinators: Failover::new(endpoints.iter().map(stub).collect()), blobs })
    }

    /// How many coordinators there are.
    pub fn coordinators(&self) -> usize {
        self.coordinators.len()
    }

    /// The one that is called now, by its place in the list.
    pub fn coordinator(&self) -> usize {
        self.coordinators.current()
    }

    /// Calls the next one from now on, unless another is called already.
    pub fn leave(&self, coordinator: usize) {
        self.coordinators.leave(coordinator);
    }

    /// Reports, and learns what to do next. Dropping the future before it ends is safe: what it
    /// would have granted is granted anew after the next report.
    pub async fn report(&mut self, report: &Report) -> Result<ReportReply, ServiceError> {
        let mut request = Request::new(wire::ReportRequest::from(report));
        request.set_timeout(report.max_wait + REPORT_TIMEOUT);
        let call = |mut stub: Stub| async move { stub.report(request).await };
        Ok(self.coordinators.call(call).await?.into_inner().try_into()?)
    }

    /// Submits a plan; each job follows those that it needs. A job that repeats an earlier one, but
    /// for paths, names and ids of views, is left out. The first job that is refused is named by its
    /// kind and view.
    pub async fn submit(&mut self, header: &SubmitHeader, jobs: Vec<Job>) -> Result<Submitted, ServiceError> {
        check_jobs(&jobs)?;
        let header = wire::SubmitChunk { header: Some(header.into()), jobs: Vec::new() };
        let chunks = std::iter::once(header).chain(Chunks { jobs: jobs.into_iter() });
        let call = |mut stub: Stub| async move { stub.submit(tokio_stream::iter(chunks)).await };
        Ok(self.coordinators.call(call).await?.into_inner().try_into()?)
    }

    /// The store, through the coordinator, over a connection of its own: a large blob does not hold up
    /// reports.
    pub fn blobs(&self) -> BlobClient {
        self.blobs.clone()
    }

    /// Where the coordinator's results lie; an error when it is of another version.
    pub async fn store(&mut self) -> Result<StorePlace, ServiceError> {
        let describe = |mut stub: Stub| async move {
            let request = wire::DescribeRequest {
                protocol_version: PROTOCOL_VERSION,
                code_version: CODE_VERSION.to_owned(),
                numerics_version: NUMERICS_VERSION,
            };
            stub.describe(request).await
        };
        Ok(self.coordinators.call_any(describe).await?.into_inner().try_into()?)
    }

    /// The latest runs, newest first.
    pub async fn runs(&mut self) -> Result<Vec<RunSummary>, ServiceError> {
        let ask = |mut stub: Stub| async move { stub.runs(wire::RunsRequest {}).await };
        let runs = self.coordinators.call_any(ask).await?.into_inner().runs;
        Ok(runs.into_iter().map(TryInto::try_into).collect::<Result<_, _>>()?)
    }

    /// How far a run is, with the jobs that ended after `after`: 0 at first, then
    /// [`JobResult::ended`] of the last one seen.
    pub async fn status(&mut self, run: &RunId, after: u64) -> Result<RunStatus, ServiceError> {
        let ask = |mut stub: Stub| {
            let request = wire::StatusRequest { run: run.0.clone(), after };
            async move { stub.status(request).await }
        };
        Ok(self.coordinators.call_any(ask).await?.into_inner().try_into()?)
    }

    /// Every job of a run, in the order of the plan.
    pub async fn results(&mut self, run: &RunId) -> Result<Vec<JobResult>, ServiceError> {
        let ask = |mut stub: Stub| {
            let request = wire::ResultsRequest { run: run.0.clone() };
            async move { stub.results(request).await }
        };
        let mut chunks = self.coordinators.call_any(ask).await?.into_inner();
        let mut results = Vec::new();
        while let Some(chunk) = chunks.next().await {
            for result in chunk?.results {
                results.push(result.try_into()?);
            }
        }
        Ok(results)
    }

    /// Stops a run; what is done stays.
    pub async fn cancel(&mut self, run: &RunId) -> Result<(), ServiceError> {
        let cancel = |mut stub: Stub| {
            let request = wire::CancelRequest { run: run.0.clone() };
            async move { stub.cancel(request).await }
        };
        self.coordinators.call_any(cancel).await?;
        Ok(())
    }
}

/// Jobs in chunks of about [`SUBMIT_CHUNK_BYTES`], encoded one chunk at a time.
struct Chunks {
    jobs: std::vec::IntoIter<Job>,
}

impl Iterator for Chunks {
    type Item = wire::SubmitChunk;

    fn next(&mut self) -> Option<wire::SubmitChunk> {
        let mut chunk = wire::SubmitChunk::default();
        let mut bytes = 0;
        while bytes < SUBMIT_CHUNK_BYTES {
            let Some(job) = self.jobs.next() else { break };
            let job = wire::Job::from(&job);
            bytes += job.encoded_len();
            chunk.jobs.push(job);
        }
        (!chunk.jobs.is_empty()).then_some(chunk)
    }
}

#[cfg(test)]
mod tests {
    use planesweep_plan::{EmitSpec, JobId, JobSpec};
    use planesweep_scene::ViewId;

    use super::*;

    #[test]
    fn chunks_hold_every_job_once_and_stay_small() {
        let job = |k: u32| {
            let mut id = [0; 32];
            id[..4].copy_from_slice(&k.to_be_bytes());
            let spec = JobSpec::Emit(EmitSpec {
                view: ViewId(k),
                neighbours: vec![ViewId(1); 500],
                max_relative_depth: 0.01,
                double: false,
            });
            Job { id: JobId(id), spec, needs: vec![JobId([1; 32]); 500] }
        };
        let jobs: Vec<Job> = (0..200).map(job).collect();
        let chunks: Vec<_> = Chunks { jobs: jobs.clone().into_iter() }.collect();
        assert!(chunks.len() > 1);
        assert!(chunks.iter().all(|chunk| chunk.encoded_len() < 2 * SUBMIT_CHUNK_BYTES));
        let back: Result<Vec<Job>, _> = chunks.into_iter().flat_map(|c| c.jobs).map(Job::try_from).collect();
        assert_eq!(back, Ok(jobs));
    }

    #[test]
    fn tokens_that_no_header_carries_are_refused() {
        assert!(bearer("s3cret").is_ok());
        assert_eq!(bearer("a\nb").map_err(|e| e.code), Err(Code::Invalid));
    }
}
