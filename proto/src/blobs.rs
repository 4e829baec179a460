//! The store through the coordinator, from the caller's side.

use std::fmt;

use bytes::{Bytes, BytesMut};
use planesweep_plan::BlobKey;
use tokio_stream::StreamExt;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};

use crate::client::WithToken;
use crate::failover::Failover;
use crate::limits::{FETCH_CHUNK_BYTES, MAX_BLOB_BYTES, MAX_EXCHANGE_MESSAGE_BYTES};
use crate::wire::blobs_client::BlobsClient;
use crate::{Code, ServiceError, wire};

/// What may be under way before it is read: enough for a fast network, and bounded.
const WINDOW_BYTES: u32 = 4 << 20;

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
        let request = wire::FindRequest { blob: key.0.to_vec() };
        let find = |mut stub: Stub| async move { stub.find(request).await };
        Ok(self.coordinators.call(find).await?.into_inner().found)
    }

    /// The bytes that the store has under this key. Their hash is the caller's to check.
    pub async fn read(&mut self, key: &BlobKey) -> Result<Bytes, ServiceError> {
        let request = wire::ReadRequest { blob: key.0.to_vec() };
        let read = |mut stub: Stub| async move { stub.read(request).await };
        let mut chunks = self.coordinators.call(read).await?.into_inner();
        let mut bytes = BytesMut::new();
        while let Some(chunk) = chunks.next().await {
            bytes.extend_from_slice(&chunk?.data);
            if bytes.len() as u64 > MAX_BLOB_BYTES {
                return Err(ServiceError::new(Code::TooLarge, format!("blob {key} has no end")));
            }
        }
        Ok(bytes.freeze())
    }

    /// Stores a blob under the hash of its bytes.
    pub async fn write(&mut self, key: &BlobKey, bytes: Bytes) -> Result<(), ServiceError> {
        let blob = wire::Blob { key: key.0.to_vec(), length: bytes.len() as u64 };
        let header = wire::WriteChunk { blob: Some(blob), data: Bytes::new() };
        let chunks = (0..bytes.len()).step_by(FETCH_CHUNK_BYTES).map(move |start| {
            let data = bytes.slice(start..bytes.len().min(start + FETCH_CHUNK_BYTES));
            wire::WriteChunk { blob: None, data }
        });
        let chunks = tokio_stream::iter(std::iter::once(header).chain(chunks));
        let write = |mut stub: Stub| async move { stub.write(chunks).await };
        self.coordinators.call(write).await?;
        Ok(())
    }
}

impl fmt::Debug for BlobClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BlobClient").finish_non_exhaustive()
    }
}
