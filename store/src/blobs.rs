//! Writing, reading and checking blobs.

use std::sync::Arc;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, WriteMultipart};
use planesweep_plan::BlobKey;
use tokio_util::sync::CancellationToken;

use crate::patience::patiently;
use crate::{StoreError, address};

/// Larger blobs go to object stores in parts of this size, some at a time.
const PART_BYTES: usize = 8 << 20;
const PARTS_AT_A_TIME: usize = 4;

/// A store of blobs; clones share it.
#[derive(Clone, Debug)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    url: String,
    /// Ends the waiting for a store in trouble.
    impatience: CancellationToken,
}

impl Store {
    /// Opens the store in a local folder, `file:///...`, which is made if it is not there, or in an object
    /// store, `s3://bucket/prefix` (also `gs://`, `az://`), whose endpoint and keys are in the environment
    /// as the provider's own tools have them (`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`, ...).
    pub fn open(url: &str) -> Result<Self, StoreError> {
        Self::open_with(url, std::env::vars())
    }

    /// The same with other variables than those of the environment.
    pub fn open_with(
        url: &str,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, StoreError> {
        let impatience = CancellationToken::new();
        impatience.cancel();
        Ok(Self { objects: address::open(url, variables)?, url: url.to_owned(), impatience })
    }

    /// The same store, which waits while it cannot be reached or has no room, until `impatience` is
    /// cancelled: what was computed is kept until it can be stored, and no try of a job is lost.
    #[must_use]
    pub fn patient(self, impatience: CancellationToken) -> Self {
        Self { impatience, ..self }
    }

    /// The store's address.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Writes a blob, unless it is there already, and returns its key.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobKey, StoreError> {
        let key = BlobKey::of(&bytes);
        patiently(&self.impatience, || self.try_put(key, bytes.clone())).await?;
        Ok(key)
    }

    async fn try_put(&self, key: BlobKey, bytes: Bytes) -> Result<(), StoreError> {
        let path = path_of(&key);
        if self.objects.head(&path).await.is_ok_and(|found| found.size == bytes.len() as u64) {
            // Of the right length, but perhaps damaged: only then it is written again.
            if self.try_get(key).await.is_ok() {
                return Ok(());
            }
        }
        let written = self.write(&path, bytes).await;
        written.map_err(|source| StoreError::Write { key, url: self.url.clone(), source })
    }

    async fn write(&self, path: &Path, bytes: Bytes) -> object_store::Result<()> {
        // A file is written at once, whatever its size.
        if bytes.len() <= 2 * PART_BYTES || self.url.starts_with("file://") {
            self.objects.put(path, bytes.into()).await?;
            return Ok(());
        }
        let upload = self.objects.put_multipart(path).await?;
        let mut parts = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
        for start in (0..bytes.len()).step_by(PART_BYTES) {
            if let Err(error) = parts.wait_for_capacity(PARTS_AT_A_TIME).await {
                // What was sent stays hidden, but costs room until it is told to go.
                let _ = parts.abort().await;
                return Err(error);
            }
            parts.put(bytes.slice(start..bytes.len().min(start + PART_BYTES)));
        }
        parts.finish().await?;
        Ok(())
    }

    /// Reads a blob and checks its hash.
    pub async fn get(&self, key: &BlobKey) -> Result<Bytes, StoreError> {
        patiently(&self.impatience, || self.try_get(*key)).await
    }

    async fn try_get(&self, key: BlobKey) -> Result<Bytes, StoreError> {
        let read = async { self.objects.get(&path_of(&key)).await?.bytes().await };
        let bytes = read.await.map_err(|source| match source {
            object_store::Error::NotFound { .. } => StoreError::Missing { key },
            source => StoreError::Read { key, url: self.url.clone(), source },
        })?;
        if BlobKey::of(&bytes) == key { Ok(bytes) } else { Err(StoreError::Damaged { key }) }
    }

    /// Whether a blob of this length is there; its hash is not checked.
    pub async fn has(&self, key: &BlobKey, length: u64) -> Result<bool, StoreError> {
        patiently(&self.impatience, || self.ask(*key, length)).await
    }

    async fn ask(&self, key: BlobKey, length: u64) -> Result<bool, StoreError> {
        match self.objects.head(&path_of(&key)).await {
            Ok(found) => Ok(found.size == length),
            Err(object_store::Error::NotFound { .. }) => Ok(false),
            Err(source) => Err(StoreError::Read { key, url: self.url.clone(), source }),
        }
    }
}

/// Blobs are spread over 256 folders, so that no folder grows without bound.
fn path_of(key: &BlobKey) -> Path {
    let name = key.to_string();
    Path::from(format!("blobs/{}/{}", &name[..2], &name[2..]))
}
