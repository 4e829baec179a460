//! The store through the coordinator, from the caller's side.

use std::fmt;
use std::time::Duration;

use bytes::Bytes;
use planesweep_plan::BlobKey;
use tokio::sync::watch;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};

use crate::chunks::{answer_to_chunks, blob_chunks, in_time, receive};
use crate::client::WithToken;
use crate::failover::Failover;
use crate::limits::{CHUNK_TIME, MAX_EXCHANGE_MESSAGE_BYTES};
use crate::wire::blobs_client::BlobsClient;
use crate::{ServiceError, wire};

/// What may be under way before it is read: enough for a fast network, and bounded.
const WINDOW_BYTES: u32 = 4 << 20;
/// How long an answer may take, or the first chunk of one, and the next chunk that is sent: the coordinator may have to
/// read all of a large blob first, and others may come before. A host that vanishes is noticed much sooner.
const ANSWER_TIME: Duration = Duration::from_mins(10);

type Stub = BlobsClient<InterceptedService<Channel, WithToken>>;

/// A client of the store of a coordinator, or of several; cheap to clone, clones share the connections.
#[derive(Clone)]
pub struct BlobClient {
    coordinators: Failover<Stub>,
}

impl BlobClient {
    /// Must be called within a tokio runtime.
    pub(crate) fn new(endpoints: &[Endpoint], token: &WithToken) -> Self {
        let stub = |endpoint: &Endpoint| {
            let endpoint = endpoint
                .clone()
                .initial_stream_window_size(WINDOW_BYTES)
                .initial_connection_window_size(WINDOW_BYTES);
            BlobsClient::with_interceptor(endpoint.connect_lazy(), token.clone())
                .max_decoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
                .max_encoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
        };
        Self { coordinators: Failover::new(endpoints.iter().map(stub).collect()) }
    }

    /// Whether the store has the blob, whole and undamaged.
    pub async fn find(&mut self, key: &BlobKey) -> Result<bool, ServiceError> {
        let request = wire::BlobRequest::from(key);
        let find = |mut stub: Stub| async move { in_time(ANSWER_TIME, stub.find(request)).await? };
        Ok(self.coordinators.call(find).await?.into_inner().found)
    }

    /// The bytes that the store has under this key; refused when they are more than `at_most`. Their hash is the
    /// caller's to check.
    pub async fn read(&mut self, key: &BlobKey, at_most: u64) -> Result<Bytes, ServiceError> {
        let request = wire::BlobRequest::from(key);
        let read = |mut stub: Stub| async move { in_time(ANSWER_TIME, stub.read(request)).await? };
        let chunks = self.coordinators.call(read).await?.into_inner();
        receive(chunks, key, at_most, CHUNK_TIME).await
    }

    /// Stores a blob under the hash of its bytes.
    pub async fn write(&mut self, key: &BlobKey, bytes: Bytes) -> Result<(), ServiceError> {
        let (taking, taken) = watch::channel(());
        let chunks = blob_chunks(*key, bytes).inspect(move |_| taking.send_replace(()));
        let chunks = tokio_stream::iter(chunks);
        let write =
            |mut stub: Stub| async move { answer_to_chunks(stub.write(chunks), taken, ANSWER_TIME).await? };
        self.coordinators.call(write).await?;
        Ok(())
    }
}

impl fmt::Debug for BlobClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BlobClient").finish_non_exhaustive()
    }
}
