//! `Find`, `Read` and `Write`: the store, for those who do not reach it.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use planesweep_plan::BlobKey;
use planesweep_proto::limits::{CHUNK_TIME, FETCH_CHUNK_BYTES, MAX_BLOB_BYTES, MAX_EXCHANGE_MESSAGE_BYTES};
use planesweep_proto::wire::blobs_server::{Blobs, BlobsServer};
use planesweep_proto::{ChunkSender, Code, ServiceError, first_chunk, wire, with_causes};
use planesweep_store::{Objects, StoreError, Upload};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_stream::{Stream, StreamExt};
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status, Streaming};

/// Blobs on their way at once, each with some parts in memory; who asks beyond that waits. One whose chunks are not
/// taken, or do not come, in time is given up, so that nobody waits for ever.
const MAX_READS: usize = 8;
const MAX_WRITES: usize = 4;

/// A store and whose turn it is.
pub(crate) struct BlobService {
    store: Objects,
    reads: Arc<Semaphore>,
    writes: Arc<Semaphore>,
    /// How long a caller may take for each chunk.
    patience: Duration,
}

impl BlobService {
    pub(crate) fn server(store: Objects) -> BlobsServer<Self> {
        Self::server_with(store, CHUNK_TIME)
    }

    fn server_with(store: Objects, patience: Duration) -> BlobsServer<Self> {
        let turns = |most| Arc::new(Semaphore::new(most));
        BlobsServer::new(Self { store, reads: turns(MAX_READS), writes: turns(MAX_WRITES), patience })
            .max_decoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
    }

    async fn in_time<T>(&self, chunk: impl Future<Output = T>) -> Result<T, ServiceError> {
        tokio::time::timeout(self.patience, chunk).await.map_err(|_| {
            let text = format!("the next chunk of the blob did not come within {:?}", self.patience);
            tracing::warn!("{text}; it is not stored");
            ServiceError::new(Code::Unavailable, text)
        })
    }
}

#[tonic::async_trait]
impl Blobs for BlobService {
    type ReadStream = BoxStream<wire::BlobChunk>;

    async fn find(&self, request: Request<wire::BlobRequest>) -> Result<Response<wire::FindReply>, Status> {
        let key = key_of(request)?;
        let _turn = turn(&self.reads).await?;
        let found = self.store.holds(key).await.map_err(|e| refusal(&e))?;
        Ok(Response::new(wire::FindReply { found }))
    }

    async fn read(&self, request: Request<wire::BlobRequest>) -> Result<Response<Self::ReadStream>, Status> {
        let key = key_of(request)?;
        let turn = turn(&self.reads).await?;
        let (length, pieces) = self.store.read(key).await.map_err(|e| refusal(&e))?;
        let (caller, answer) = ChunkSender::new(self.patience);
        tokio::spawn(async move {
            let _until_the_last = turn;
            if !caller.send(first_chunk(key, length)).await {
                return;
            }
            if let Err(error) = send_all(pieces, &caller).await {
                caller.fail(refusal(&error));
            }
        });
        Ok(Response::new(answer))
    }

    async fn write(
        &self,
        request: Request<Streaming<wire::BlobChunk>>,
    ) -> Result<Response<wire::WriteReply>, Status> {
        let _turn = turn(&self.writes).await?;
        let mut chunks = request.into_inner();
        let mut upload: Option<Upload> = None;
        while let Some(chunk) = self.in_time(chunks.next()).await? {
            let wire::BlobChunk { blob, data } = chunk?;
            if let Some(blob) = blob {
                if upload.is_some() {
                    return Err(
                        ServiceError::new(Code::Invalid, "only the first chunk names the blob").into()
                    );
                }
                let (key, length) = blob.try_into().map_err(ServiceError::from)?;
                if length > MAX_BLOB_BYTES {
                    let text = format!("blob {key} of {length} bytes is over the limit of {MAX_BLOB_BYTES}");
                    return Err(ServiceError::new(Code::TooLarge, text).into());
                }
                upload = Some(self.store.upload(key, length));
            } else if data.is_empty() {
                // Any number of them would hold the turn.
                return Err(ServiceError::new(Code::Invalid, "a chunk is empty").into());
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
    caller: &ChunkSender,
) -> Result<(), StoreError> {
    let mut pieces = pin!(pieces);
    let mut waiting = BytesMut::new();
    loop {
        let piece = pieces.next().await.transpose()?;
        let is_last = piece.is_none();
        waiting.extend_from_slice(&piece.unwrap_or_default());
        while waiting.len() >= FETCH_CHUNK_BYTES || (is_last && !waiting.is_empty()) {
            let data = waiting.split_to(waiting.len().min(FETCH_CHUNK_BYTES)).freeze();
            if !caller.send(wire::BlobChunk { blob: None, data }).await {
                return Ok(());
            }
        }
        if is_last {
            return Ok(());
        }
    }
}

fn key_of(request: Request<wire::BlobRequest>) -> Result<BlobKey, ServiceError> {
    Ok(request.into_inner().try_into()?)
}

async fn turn(turns: &Arc<Semaphore>) -> Result<OwnedSemaphorePermit, ServiceError> {
    let turn = turns.clone().acquire_owned().await;
    turn.map_err(|_| ServiceError::new(Code::Unavailable, "the coordinator is stopping"))
}

/// A failure of the store as callers learn of it.
fn refusal(error: &StoreError) -> ServiceError {
    if let Some(url) = error.full_disk() {
        return ServiceError::disk_full(url, with_causes(error));
    }
    let code = match error {
        StoreError::Refused { .. } => Code::Invalid,
        error if error.is_lost() => Code::NotFound,
        error if error.is_passing() => Code::Unavailable,
        _ => Code::Internal,
    };
    ServiceError::new(code, with_causes(error))
}

#[cfg(test)]
mod tests {
    use planesweep_proto::wire::blobs_client::BlobsClient;
    use planesweep_proto::{Client, probing_server};
    use tokio::net::TcpListener;
    use tonic::transport::Channel;
    use tonic::transport::server::TcpIncoming;

    use super::*;

    /// Over soon for who waits in vain, and not for who is at work on a busy machine.
    const SHORT: Duration = Duration::from_secs(3);
    /// How long an answer may take to come; far above what it ever takes.
    const DEADLINE: Duration = Duration::from_mins(1);
    /// More than fits into the windows and buffers between a server and a reader.
    const LARGE: usize = 8 << 20;

    /// Serves an empty store with little patience.
    async fn served() -> (tempfile::TempDir, String) {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Objects::open(&format!("file://{}", folder.path().display())).expect("a store");
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback is there");
        let url = format!("http://{}", listener.local_addr().expect("bound"));
        let server = probing_server().add_service(BlobService::server_with(store, SHORT));
        tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));
        (folder, url)
    }

    async fn stub(url: &str) -> BlobsClient<Channel> {
        BlobsClient::connect(url.to_owned()).await.expect("it listens")
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn readers_that_take_nothing_and_writers_that_send_nothing_hold_nobody_up() {
        let (_folder, url) = served().await;
        let client = Client::connect(&url, None).expect("an address");
        let bytes = Bytes::from(vec![7; LARGE]);
        let key = BlobKey::of(&bytes);
        client.blobs().write(&key, bytes.clone()).await.expect("written");

        let mut stalled = Vec::new();
        for _ in 0..MAX_READS {
            let answer = stub(&url).await.read(wire::BlobRequest::from(&key)).await.expect("it begins");
            stalled.push(answer.into_inner());
        }
        let mut silent = Vec::new();
        for _ in 0..MAX_WRITES {
            let (kept, chunks) = tokio::sync::mpsc::channel(1);
            let chunks = tokio_stream::wrappers::ReceiverStream::new(chunks);
            let mut stub = stub(&url).await;
            silent.push((kept, tokio::spawn(async move { stub.write(chunks).await })));
        }
        // The turns of all of these are free again.
        let mut blobs = client.blobs();
        let read = tokio::time::timeout(DEADLINE, blobs.read(&key, LARGE as u64)).await.expect("a turn");
        assert!(read.expect("read") == bytes);
        let other = Bytes::from_static(b"other");
        let other_key = BlobKey::of(&other);
        let write = blobs.write(&other_key, other);
        tokio::time::timeout(DEADLINE, write).await.expect("a turn").expect("written");

        // By then the last of them has waited too long, too.
        tokio::time::sleep(SHORT).await;
        for mut answer in stalled {
            let end = loop {
                match answer.message().await {
                    Ok(Some(_)) => {}
                    end => break end,
                }
            };
            let told = end.expect_err("it was too slow");
            assert!(
                told.code() == tonic::Code::Unavailable && told.message().contains("not taken"),
                "{told}"
            );
        }
        for (_kept, answer) in silent {
            let told = answer.await.expect("no panic").expect_err("it sent nothing");
            let is_said = told.message().contains("did not come");
            assert!(told.code() == tonic::Code::Unavailable && is_said, "{told}");
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn writers_that_wait_for_their_turn_hold_up_none_of_their_connection() {
        let (_folder, url) = served().await;
        // Twice as many writes as turns, on two connections.
        let clients = [(); 2].map(|()| Client::connect(&url, None).expect("an address"));
        let mut writes = tokio::task::JoinSet::new();
        for (number, client) in (0..2 * MAX_WRITES).zip(clients.iter().cycle()) {
            let mut blobs = client.blobs();
            let bytes = Bytes::from(vec![number as u8; LARGE]);
            writes.spawn(async move { blobs.write(&BlobKey::of(&bytes), bytes).await });
        }
        while let Some(write) = tokio::time::timeout(DEADLINE, writes.join_next()).await.expect("a turn") {
            write.expect("no panic").expect("written");
        }
    }
}
