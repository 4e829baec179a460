//! `Find`, `Read` and `Write`: the store, for those who do not reach it.

use std::pin::pin;
use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use planesweep_plan::BlobKey;
use planesweep_proto::limits::{FETCH_CHUNK_BYTES, MAX_BLOB_BYTES, MAX_EXCHANGE_MESSAGE_BYTES};
use planesweep_proto::wire::blobs_server::{Blobs, BlobsServer};
use planesweep_proto::{Code, ServiceError, wire};
use planesweep_store::{Objects, StoreError, Upload};
use tokio::sync::mpsc::{self, Sender};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};

use crate::driver::describe;

/// Blobs on their way at once, each with some parts in memory; who asks beyond that waits.
const MAX_READS: usize = 8;
const MAX_WRITES: usize = 4;
/// Chunks that wait for a slow reader; the store is read no faster.
const CHUNKS_AHEAD: usize = 2;

/// A store and whose turn it is.
pub(crate) struct BlobService {
    store: Objects,
    reads: Arc<Semaphore>,
    writes: Arc<Semaphore>,
}

impl BlobService {
    pub(crate) fn server(store: Objects) -> BlobsServer<Self> {
        let turns = |most| Arc::new(Semaphore::new(most));
        BlobsServer::new(Self { store, reads: turns(MAX_READS), writes: turns(MAX_WRITES) })
            .max_decoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
    }
}

#[tonic::async_trait]
impl Blobs for BlobService {
    type ReadStream = BoxStream<wire::ReadChunk>;

    async fn find(&self, request: Request<wire::FindRequest>) -> Result<Response<wire::FindReply>, Status> {
        let key = blob_key(&request.into_inner().blob)?;
        let _turn = turn(&self.reads).await?;
        let found = self.store.holds(key).await.map_err(|e| refusal(&e))?;
        Ok(Response::new(wire::FindReply { found }))
    }

    async fn read(&self, request: Request<wire::ReadRequest>) -> Result<Response<Self::ReadStream>, Status> {
        let key = blob_key(&request.into_inner().blob)?;
        let turn = turn(&self.reads).await?;
        let pieces = self.store.read(key).await.map_err(|e| refusal(&e))?;
        let (sender, receiver) = mpsc::channel(CHUNKS_AHEAD);
        tokio::spawn(async move {
            let _until_the_last = turn;
            if let Err(error) = send_all(pieces, &sender).await {
                // A caller that has gone does not want to know.
                let _ = sender.send(Err(refusal(&error).into())).await;
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }

    async fn write(
        &self,
        request: Request<Streaming<wire::WriteChunk>>,
    ) -> Result<Response<wire::WriteReply>, Status> {
        let _turn = turn(&self.writes).await?;
        let mut chunks = request.into_inner();
        let mut upload: Option<Upload> = None;
        while let Some(chunk) = chunks.next().await {
            let wire::WriteChunk { blob, data } = chunk?;
            if let Some(wire::Blob { key, length }) = blob {
                if upload.is_some() {
                    return Err(
                        ServiceError::new(Code::Invalid, "only the first chunk names the blob").into()
                    );
                }
                let key = blob_key(&key)?;
                if length > MAX_BLOB_BYTES {
                    let text = format!("blob {key} of {length} bytes is over the limit of {MAX_BLOB_BYTES}");
                    return Err(ServiceError::new(Code::TooLarge, text).into());
                }
                upload = Some(self.store.upload(key, length));
            }
            let Some(upload) = &mut upload else { break };
            upload.write(data).await.map_err(|e| refusal(&e))?;
        }
        let nameless = || ServiceError::new(Code::Invalid, "the first chunk of a blob names it");
        upload.ok_or_else(nameless)?.finish().await.map_err(|e| refusal(&e))?;
        Ok(Response::new(wire::WriteReply {}))
    }
}

/// Sends what is read from the store in chunks, as the caller takes them.
async fn send_all(
    pieces: impl Stream<Item = Result<Bytes, StoreError>>,
    caller: &Sender<Result<wire::ReadChunk, Status>>,
) -> Result<(), StoreError> {
    let mut pieces = pin!(pieces);
    let mut waiting = BytesMut::new();
    loop {
        let piece = pieces.next().await.transpose()?;
        let is_last = piece.is_none();
        waiting.extend_from_slice(&piece.unwrap_or_default());
        while waiting.len() >= FETCH_CHUNK_BYTES || (is_last && !waiting.is_empty()) {
            let data = waiting.split_to(waiting.len().min(FETCH_CHUNK_BYTES)).freeze();
            if caller.send(Ok(wire::ReadChunk { data })).await.is_err() {
                return Ok(());
            }
        }
        if is_last {
            return Ok(());
        }
    }
}

fn blob_key(key: &[u8]) -> Result<BlobKey, ServiceError> {
    let key = key.try_into().map_err(|_| ServiceError::new(Code::Invalid, "a blob's key has 32 bytes"))?;
    Ok(BlobKey(key))
}

async fn turn(turns: &Arc<Semaphore>) -> Result<OwnedSemaphorePermit, ServiceError> {
    let turn = turns.clone().acquire_owned().await;
    turn.map_err(|_| ServiceError::new(Code::Unavailable, "the coordinator is stopping"))
}

/// A failure of the store as callers learn of it.
fn refusal(error: &StoreError) -> ServiceError {
    let code = match error {
        StoreError::Refused { .. } => Code::Invalid,
        error if error.is_lost() => Code::NotFound,
        error if error.is_passing() => Code::Unavailable,
        _ => Code::Internal,
    };
    ServiceError::new(code, describe(error))
}
