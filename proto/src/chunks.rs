//! A blob on its way, in chunks. The first says which it is and how long; no chunk keeps the other side waiting for
//! ever.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use planesweep_plan::BlobKey;
use tokio::sync::mpsc::error::SendTimeoutError;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::Status;
use tonic::codegen::BoxStream;

use crate::limits::FETCH_CHUNK_BYTES;
use crate::{Code, ServiceError, wire};

/// Chunks that wait for a slow reader; what they are made of is read no faster.
const CHUNKS_AHEAD: usize = 2;
/// Bytes set aside before any came; a length in a message is only somebody's word.
const FIRST_BYTES: u64 = 64 << 20;

/// The chunk that says which blob follows, and how long it is.
pub fn first_chunk(key: BlobKey, length: u64) -> wire::BlobChunk {
    wire::BlobChunk { blob: Some((key, length).into()), data: Bytes::new() }
}

/// All chunks of a blob, in order.
pub fn blob_chunks(key: BlobKey, bytes: Bytes) -> impl Iterator<Item = wire::BlobChunk> + Send + 'static {
    let first = first_chunk(key, bytes.len() as u64);
    let rest = (0..bytes.len()).step_by(FETCH_CHUNK_BYTES).map(move |start| {
        let data = bytes.slice(start..bytes.len().min(start + FETCH_CHUNK_BYTES));
        wire::BlobChunk { blob: None, data }
    });
    std::iter::once(first).chain(rest)
}

/// Where a server puts the chunks of an answer. A reader who does not take the next one in time is told so, and gets
/// no more; what he has not taken yet is all that is kept for him.
#[derive(Debug)]
pub struct ChunkSender {
    chunks: mpsc::Sender<Result<wire::BlobChunk, Status>>,
    /// For why there are no more; with room of its own, for a slow reader leaves none among the chunks.
    end: mpsc::Sender<Result<wire::BlobChunk, Status>>,
    patience: Duration,
}

impl ChunkSender {
    /// A sender, and what the reader gets.
    pub fn new(patience: Duration) -> (Self, BoxStream<wire::BlobChunk>) {
        let (chunks, taken) = mpsc::channel(CHUNKS_AHEAD);
        let (end, ended) = mpsc::channel(1);
        let answer = ReceiverStream::new(taken).chain(ReceiverStream::new(ended));
        (Self { chunks, end, patience }, Box::pin(answer))
    }

    /// Sends the next chunk as soon as the reader has room for it; false when nothing more is to be sent, for he has
    /// gone or was too slow.
    pub async fn send(&self, chunk: wire::BlobChunk) -> bool {
        match self.chunks.send_timeout(Ok(chunk), self.patience).await {
            Ok(()) => true,
            Err(SendTimeoutError::Closed(_)) => false,
            Err(SendTimeoutError::Timeout(_)) => {
                let text = format!("the next chunk of the blob was not taken within {:?}", self.patience);
                tracing::warn!("{text}; the reader gets no more");
                self.fail(ServiceError::new(Code::Unavailable, text));
                false
            }
        }
    }

    /// Ends the answer with an error, the first one.
    pub fn fail(&self, error: ServiceError) {
        // A reader that has gone does not want to know.
        let _ = self.end.try_send(Err(error.into()));
    }
}

/// The bytes of a blob that comes in chunks. Refused are another one, more bytes than `at_most`, and more or fewer than
/// the first chunk announces; their hash is the caller's to check.
pub(crate) async fn receive(
    mut chunks: impl Stream<Item = Result<wire::BlobChunk, Status>> + Unpin,
    key: &BlobKey,
    at_most: u64,
    patience: Duration,
) -> Result<Bytes, ServiceError> {
    let refused = |code, text: String| Err(ServiceError::new(code, text));
    let Some(wire::BlobChunk { blob: Some(blob), data }) = next(&mut chunks, patience).await? else {
        return refused(Code::Invalid, format!("the first chunk does not say how long blob {key} is"));
    };
    let (named, announced) = blob.try_into()?;
    if named != *key {
        return refused(Code::Invalid, format!("blob {named} comes instead of blob {key}"));
    }
    if announced > at_most {
        let text = format!("blob {key} of {announced} bytes is over the limit of {at_most}");
        return refused(Code::TooLarge, text);
    }
    let mut bytes = BytesMut::with_capacity(announced.min(FIRST_BYTES) as usize);
    let mut chunk = Some(wire::BlobChunk { blob: None, data });
    while let Some(wire::BlobChunk { data, .. }) = chunk {
        bytes.extend_from_slice(&data);
        if bytes.len() as u64 > announced {
            return refused(Code::TooLarge, format!("blob {key} comes with more than its {announced} bytes"));
        }
        chunk = next(&mut chunks, patience).await?;
        if chunk.as_ref().is_some_and(|chunk| chunk.data.is_empty() || chunk.blob.is_some()) {
            return refused(
                Code::Invalid,
                format!("blob {key} comes with a chunk that is empty or names it again"),
            );
        }
    }
    if (bytes.len() as u64) < announced {
        let text = format!("blob {key} ends after {} of its {announced} bytes", bytes.len());
        return refused(Code::Invalid, text);
    }
    Ok(bytes.freeze())
}

async fn next(
    chunks: &mut (impl Stream<Item = Result<wire::BlobChunk, Status>> + Unpin),
    patience: Duration,
) -> Result<Option<wire::BlobChunk>, ServiceError> {
    Ok(in_time(patience, chunks.next()).await?.transpose()?)
}

/// The answer to chunks that are sent, of which `taken` hears; none when for so long no chunk is taken.
pub(crate) async fn answer_to_chunks<T>(
    answer: impl Future<Output = T>,
    mut taken: watch::Receiver<()>,
    patience: Duration,
) -> Result<T, ServiceError> {
    let mut answer = std::pin::pin!(answer);
    loop {
        tokio::select! {
            biased;
            answer = &mut answer => return Ok(answer),
            next = in_time(patience, taken.changed()) => if next?.is_err() {
                // The last one is taken.
                return in_time(patience, answer).await;
            },
        }
    }
}

pub(crate) async fn in_time<T>(
    patience: Duration,
    answer: impl Future<Output = T>,
) -> Result<T, ServiceError> {
    let late = |_| ServiceError::new(Code::Unavailable, format!("nothing came within {patience:?}"));
    tokio::time::timeout(patience, answer).await.map_err(late)
}

#[cfg(test)]
mod tests {
    use std::future::pending;

    use super::*;

    /// Over at once for who waits in vain.
    const SHORT: Duration = Duration::from_millis(20);
    /// Never over.
    const LONG: Duration = Duration::from_mins(5);

    fn chunk(data: &'static [u8]) -> wire::BlobChunk {
        wire::BlobChunk { blob: None, data: Bytes::from_static(data) }
    }

    async fn received(chunks: Vec<wire::BlobChunk>, at_most: u64) -> Result<Bytes, Code> {
        let chunks = tokio_stream::iter(chunks.into_iter().map(Ok));
        receive(chunks, &BlobKey([1; 32]), at_most, LONG).await.map_err(|error| error.code)
    }

    #[tokio::test]
    async fn a_blob_comes_out_of_its_chunks() {
        for length in [0, 1, FETCH_CHUNK_BYTES, 2 * FETCH_CHUNK_BYTES + 1] {
            let bytes: Bytes = (0..length).map(|k| k as u8).collect();
            let chunks: Vec<_> = blob_chunks(BlobKey([1; 32]), bytes.clone()).collect();
            assert_eq!(chunks.len(), 1 + length.div_ceil(FETCH_CHUNK_BYTES));
            assert_eq!(received(chunks, length as u64).await, Ok(bytes));
        }
    }

    #[tokio::test]
    async fn no_more_comes_than_was_announced_and_is_allowed() {
        let first = |length| first_chunk(BlobKey([1; 32]), length);
        assert_eq!(received(vec![first(2), chunk(b"ab")], 2).await, Ok(Bytes::from_static(b"ab")));
        assert_eq!(received(vec![first(3), chunk(b"abc")], 2).await, Err(Code::TooLarge));
        assert_eq!(received(vec![first(u64::MAX)], u64::MAX - 1).await, Err(Code::TooLarge));
        assert_eq!(received(vec![first(2), chunk(b"ab"), chunk(b"c")], 9).await, Err(Code::TooLarge));
        assert_eq!(received(vec![first(2), chunk(b"a")], 9).await, Err(Code::Invalid));
        assert_eq!(received(vec![chunk(b"ab")], 9).await, Err(Code::Invalid));
        assert_eq!(received(vec![first_chunk(BlobKey([2; 32]), 0)], 9).await, Err(Code::Invalid));
        assert_eq!(received(Vec::new(), 9).await, Err(Code::Invalid));
    }

    #[tokio::test]
    async fn who_sends_nothing_more_is_not_waited_for() {
        let begun = tokio_stream::iter([Ok(first_chunk(BlobKey([1; 32]), 9))]);
        let silent = Box::pin(begun.chain(tokio_stream::pending()));
        let error = receive(silent, &BlobKey([1; 32]), 9, SHORT).await.expect_err("nothing more comes");
        assert_eq!(error.code, Code::Unavailable, "{error}");

        // Neither is one that takes nothing more, or does not answer.
        let (taking, taken) = watch::channel(());
        taking.send_replace(());
        let error = answer_to_chunks(pending::<()>(), taken.clone(), SHORT).await.expect_err("nothing moves");
        assert_eq!(error.code, Code::Unavailable, "{error}");
        drop(taking);
        assert!(answer_to_chunks(pending::<()>(), taken.clone(), SHORT).await.is_err());
        assert_eq!(answer_to_chunks(async { 7 }, taken, LONG).await, Ok(7));
    }

    #[tokio::test]
    async fn who_takes_nothing_is_told_so_and_gets_no_more() {
        let (sender, mut answer) = ChunkSender::new(SHORT);
        let mut sent = 0;
        while sender.send(chunk(b"x")).await {
            sent += 1;
        }
        assert_eq!(sent, CHUNKS_AHEAD);
        drop(sender);
        for _ in 0..sent {
            assert!(answer.next().await.is_some_and(|chunk| chunk.is_ok()));
        }
        let told = answer.next().await.expect("an end").expect_err("that says why");
        assert!(told.code() == tonic::Code::Unavailable && told.message().contains("not taken"), "{told}");
        assert!(answer.next().await.is_none());
    }
}
