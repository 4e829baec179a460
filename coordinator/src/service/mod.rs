//! The gRPC handlers: decode, hand to the driver or the ledger, encode. No decisions.

mod blobs;
mod report;
mod runs;

use std::pin::Pin;
use std::sync::Arc;

use planesweep_plan::NUMERICS_VERSION;
use planesweep_proto::limits::MAX_MESSAGE_BYTES;
use planesweep_proto::wire::coordinator_server::{Coordinator, CoordinatorServer};
use planesweep_proto::{CODE_VERSION, Code, PROTOCOL_VERSION, Refusals, ServiceError, StorePlace, wire};
use tokio_stream::Stream;
use tonic::{Request, Response, Status, Streaming};

pub(crate) use blobs::BlobService;

use crate::driver::DriverHandle;
use crate::ledger::Ledger;

/// What the handlers need.
#[derive(Clone)]
pub(crate) struct Service {
    pub driver: DriverHandle,
    pub ledger: Arc<Ledger>,
    pub store: StorePlace,
    pub refusals: Refusals,
}

impl Service {
    pub(crate) fn into_server(self) -> CoordinatorServer<Self> {
        CoordinatorServer::new(self)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES)
    }
}

#[tonic::async_trait]
impl Coordinator for Service {
    type ResultsStream = Pin<Box<dyn Stream<Item = Result<wire::ResultsChunk, Status>> + Send>>;

    async fn report(
        &self,
        request: Request<wire::ReportRequest>,
    ) -> Result<Response<wire::ReportReply>, Status> {
        Ok(Response::new(self.answer_report(request.into_inner()).await?))
    }

    async fn submit(
        &self,
        request: Request<Streaming<wire::SubmitChunk>>,
    ) -> Result<Response<wire::SubmitReply>, Status> {
        Ok(Response::new(self.answer_submit(request.into_inner()).await?))
    }

    async fn status(
        &self,
        request: Request<wire::StatusRequest>,
    ) -> Result<Response<wire::StatusReply>, Status> {
        Ok(Response::new(self.answer_status(request.into_inner()).await?))
    }

    async fn results(
        &self,
        request: Request<wire::ResultsRequest>,
    ) -> Result<Response<Self::ResultsStream>, Status> {
        Ok(Response::new(self.answer_results(request.into_inner()).await?))
    }

    async fn cancel(
        &self,
        request: Request<wire::CancelRequest>,
    ) -> Result<Response<wire::CancelReply>, Status> {
        Ok(Response::new(self.answer_cancel(request.into_inner()).await?))
    }

    async fn describe(
        &self,
        request: Request<wire::DescribeRequest>,
    ) -> Result<Response<wire::DescribeReply>, Status> {
        Ok(Response::new(self.answer_describe(&request.into_inner())?))
    }

    async fn runs(&self, _: Request<wire::RunsRequest>) -> Result<Response<wire::RunsReply>, Status> {
        Ok(Response::new(self.answer_runs().await?))
    }
}

fn check_protocol(version: u32) -> Result<(), ServiceError> {
    if version == PROTOCOL_VERSION {
        return Ok(());
    }
    let text = format!("the caller speaks protocol {version}, the coordinator {PROTOCOL_VERSION}");
    Err(ServiceError::new(Code::VersionMismatch, text))
}

/// Results of another version must not mix with ours.
fn check_versions(caller: &str, code: &str, numerics: u32) -> Result<(), ServiceError> {
    if code == CODE_VERSION && numerics == NUMERICS_VERSION {
        return Ok(());
    }
    let text = format!(
        "{caller} is version {code} (numerics {numerics}), the coordinator {CODE_VERSION} (numerics {NUMERICS_VERSION})"
    );
    Err(ServiceError::new(Code::VersionMismatch, text))
}
