//! A blob on its way into a store, piece by piece.

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStoreExt, PutPayloadMut, WriteMultipart};
use planesweep_plan::{BlobHasher, BlobKey};

use crate::{Objects, StoreError};

/// Larger blobs are written in parts of this size, some at a time.
const PART_BYTES: usize = 8 << 20;
const PARTS_AT_A_TIME: usize = 4;
/// Smaller pieces are copied one after the other into larger ones: each that is kept as it came takes memory beside its
/// bytes, and may keep alive what it was cut from.
const KEPT_BYTES: usize = 64 << 10;

/// A blob whose bytes come in pieces, a few parts of it in memory. Nothing of it is to be seen before
/// [`Upload::finish`]; dropped before that, nothing of it stays.
#[derive(Debug)]
pub struct Upload {
    store: Objects,
    path: Path,
    key: BlobKey,
    length: u64,
    written: u64,
    hasher: BlobHasher,
    /// What has come, as long as it is less than a part.
    first: PutPayloadMut,
    parts: Option<WriteMultipart>,
}

impl Upload {
    pub(crate) fn new(store: Objects, path: Path, key: BlobKey, length: u64) -> Self {
        let (hasher, first) = (BlobHasher::default(), PutPayloadMut::new());
        Self { store, path, key, length, written: 0, hasher, first, parts: None }
    }

    /// Adds the next piece; refused are more bytes than the blob has.
    pub async fn write(&mut self, mut piece: Bytes) -> Result<(), StoreError> {
        self.written += piece.len() as u64;
        if self.written > self.length {
            return Err(StoreError::Refused { key: self.key });
        }
        self.hasher.update(&piece);
        if self.length < PART_BYTES as u64 {
            if piece.len() < KEPT_BYTES {
                self.first.extend_from_slice(&piece);
            } else {
                self.first.push(piece);
            }
            return Ok(());
        }
        while !piece.is_empty() {
            let part = piece.split_to(piece.len().min(PART_BYTES));
            self.send(part).await.map_err(|source| self.unwritten(source))?;
        }
        Ok(())
    }

    async fn send(&mut self, part: Bytes) -> object_store::Result<()> {
        if self.parts.is_none() {
            let upload = self.store.objects.put_multipart(&self.path).await?;
            self.parts = Some(WriteMultipart::new_with_chunk_size(upload, PART_BYTES));
        }
        if let Some(parts) = &mut self.parts {
            parts.wait_for_capacity(PARTS_AT_A_TIME).await?;
            if part.len() < KEPT_BYTES {
                parts.write(&part);
            } else {
                parts.put(part);
            }
        }
        Ok(())
    }

    /// Publishes the blob if its bytes are those of its key.
    pub async fn finish(mut self) -> Result<(), StoreError> {
        if self.written != self.length || self.hasher.key() != self.key {
            return Err(StoreError::Refused { key: self.key });
        }
        let written = match self.parts.take() {
            Some(parts) => parts.finish().await,
            None => self.store.objects.put(&self.path, std::mem::take(&mut self.first).freeze()).await,
        };
        written.map(|_| ()).map_err(|source| self.unwritten(source))
    }

    fn unwritten(&self, source: object_store::Error) -> StoreError {
        StoreError::Write { key: self.key, url: self.store.url.clone(), source }
    }
}

impl Drop for Upload {
    fn drop(&mut self) {
        // What was sent stays hidden, but costs room until it is told to go.
        if let (Some(parts), Ok(runtime)) = (self.parts.take(), tokio::runtime::Handle::try_current()) {
            runtime.spawn(parts.abort());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn tiny_pieces_are_gathered() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Objects::open(&format!("file://{}", folder.path().display())).expect("a store");
        let bytes = vec![7; 100_000];
        let key = BlobKey::of(&bytes);
        let mut upload = store.upload(key, bytes.len() as u64);
        for byte in bytes.chunks(1) {
            upload.write(Bytes::copy_from_slice(byte)).await.expect("within the length");
        }
        let kept = std::mem::take(&mut upload.first).freeze();
        assert!(kept.iter().count() < 20, "{}", kept.iter().count());
        assert_eq!(kept.iter().map(Bytes::len).sum::<usize>(), bytes.len());

        // Between large ones they keep their places.
        let pieces = [vec![1; KEPT_BYTES], vec![2], vec![3], vec![4; KEPT_BYTES], vec![5]];
        let bytes = pieces.concat();
        let key = BlobKey::of(&bytes);
        let mut upload = store.upload(key, bytes.len() as u64);
        for piece in pieces {
            upload.write(piece.into()).await.expect("within the length");
        }
        upload.finish().await.expect("written");
        assert!(store.get(key, bytes.len() as u64).await.expect("read") == bytes);
    }
}
