//! The wire: the gRPC contract and its checked conversion to and from domain types.
//!
//! `proto/planesweep/v1/coordinator.proto` is the contract with the coordinator, `blobs.proto` what it
//! passes on of the store, `exchange.proto` that of workers among themselves. [`wire`] is what the compiler makes of
//! it; only `convert` and the server's handlers touch it. Everybody else speaks in the types of
//! this page and in those of `plan`, which cannot hold what was not checked: finite numbers, true
//! rotations, hashes of the right length, counts and names within [`limits`].
//!
//! ```no_run
//! # async fn example(report: planesweep_proto::Report) -> Result<(), planesweep_proto::ServiceError> {
//! let mut client = planesweep_proto::Client::connect("http://127.0.0.1:7070", None)?;
//! let reply = client.report(&report).await?;
//! for grant in reply.grants {
//!     println!("{} for {:?}", grant.spec.kind(), grant.spec.view());
//! }
//! # Ok(())
//! # }
//! ```

#![warn(missing_docs)]

mod blobs;
mod chunks;
mod client;
mod convert;
mod credentials;
mod error;
mod failover;
pub mod limits;
mod peer;
mod report;
mod run;
mod tls;
mod token;
mod way;

pub use blobs::BlobClient;
pub use chunks::{ChunkSender, blob_chunks, first_chunk};
pub use client::{Client, TOKEN_HEADER, bearer};
pub use convert::{WireError, check_job, check_jobs, decode_job, encode_job};
pub use credentials::Credentials;
pub use error::{Code, ServiceError, with_causes};
pub use peer::PeerClient;
pub use report::{
    Endpoint, Failure, FinishedJob, Grant, HeldJob, Input, JobAttempt, Order, Outcome, Peer, Produced,
    Report, ReportReply, Role, Slots, StorePlace, Success, WorkerState,
};
pub use run::{JobResult, JobState, RunStatus, RunSummary, SubmitHeader, Submitted, WorkerStatus};
pub use tls::{ServerTls, TlsError, probing_server, serve};
pub use token::{CheckToken, Refusals};
pub use way::{IMAGES_FETCHED, Way, images_fetched, maps_by_way};

/// Raised when a message changes its meaning; two sides with different numbers refuse each other.
pub const PROTOCOL_VERSION: u32 = 1;

/// The version of this build; a coordinator and its workers must be of one version.
pub const CODE_VERSION: &str = env!("CARGO_PKG_VERSION");

/// The generated messages, client and server.
#[allow(missing_docs, clippy::all, clippy::pedantic, unused_qualifications)]
pub mod wire {
    tonic::include_proto!("planesweep.v1");
}
