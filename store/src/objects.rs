//! A store that this process reaches itself: a folder or a bucket.

use std::sync::Arc;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode};
use planesweep_plan::{BlobHasher, BlobKey};
use planesweep_proto::with_causes;
use tokio_stream::{Stream, StreamExt};

use crate::StoreError;
use crate::address::{self, IfAbsent};
use crate::upload::Upload;

/// Under this name a store says who it is.
const IDENTITY: &str = "identity";

/// The blobs in a local folder or an object store; clones share them.
#[derive(Clone, Debug)]
pub struct Objects {
    pub(crate) objects: Arc<dyn ObjectStore>,
    pub(crate) url: String,
}

impl Objects {
    /// Opens a local folder, `file:///...`, which is made if it is not there, or an object store,
    /// `s3://bucket/prefix` (also `gs://`, `az://`), whose endpoint and keys are in the environment as the
    /// provider's own tools have them (`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`, ...).
    pub fn open(url: &str) -> Result<Self, StoreError> {
        Self::open_with(url, std::env::vars())
    }

    /// The same with other variables than those of the environment.
    pub fn open_with(
        url: &str,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, StoreError> {
        Ok(Self { objects: address::open(url, variables, IfAbsent::Make)?, url: url.to_owned() })
    }

    /// The store at this address, if it says that it is this one and may be written to. A folder is not made:
    /// another host has another one under the same path.
    pub(crate) async fn find(url: &str, identity: &str) -> Result<Self, StoreError> {
        let objects = address::open(url, std::env::vars(), IfAbsent::Refuse)?;
        let found = Self { objects, url: url.to_owned() };
        match found.said_identity().await? {
            Some(said) if said == identity => {
                found.say_identity(identity).await?;
                Ok(found)
            }
            said => {
                let problem = if said.is_some() { "another store is there" } else { "no store is there" };
                Err(StoreError::Open { url: url.to_owned(), problem: problem.to_owned() })
            }
        }
    }

    /// The store's address.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// What tells this store from all others; `new`, which must be unique, if it has nothing yet.
    pub async fn identity(&self, new: &str) -> Result<String, StoreError> {
        if let Some(said) = self.said_identity().await? {
            return Ok(said);
        }
        let (place, create) = (Path::from(IDENTITY), PutMode::Create.into());
        match self.objects.put_opts(&place, new.to_owned().into(), create).await {
            Ok(_) => Ok(new.to_owned()),
            // Another coordinator was faster: its word holds, if there is one.
            Err(object_store::Error::AlreadyExists { .. }) => {
                if let Some(said) = self.said_identity().await? {
                    return Ok(said);
                }
                self.say_identity(new).await?;
                Ok(new.to_owned())
            }
            Err(error) => Err(self.cannot_open(&error)),
        }
    }

    async fn say_identity(&self, identity: &str) -> Result<(), StoreError> {
        let written = self.objects.put(&Path::from(IDENTITY), identity.to_owned().into()).await;
        written.map(|_| ()).map_err(|error| self.cannot_open(&error))
    }

    /// What tells this store from all others, if it has that yet.
    pub async fn said_identity(&self) -> Result<Option<String>, StoreError> {
        let read = async { self.objects.get(&Path::from(IDENTITY)).await?.bytes().await };
        match read.await {
            // People write it with an editor or a shell, which end it with a line.
            Ok(bytes) => {
                let said = String::from_utf8_lossy(&bytes).trim().to_owned();
                // An empty object, as of a shell that found no disk space, says nothing.
                Ok(Some(said).filter(|said| !said.is_empty()))
            }
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.cannot_open(&error)),
        }
    }

    fn cannot_open(&self, error: &object_store::Error) -> StoreError {
        StoreError::Open { url: self.url.clone(), problem: with_causes(error) }
    }

    /// Begins to write a blob of this key and length whose bytes come in pieces.
    pub fn upload(&self, key: BlobKey, length: u64) -> Upload {
        Upload::new(self.clone(), path_of(&key), key, length)
    }

    /// Reads a blob piece by piece, and says how long it is; nobody checks its hash.
    pub async fn read(
        &self,
        key: BlobKey,
    ) -> Result<(u64, impl Stream<Item = Result<Bytes, StoreError>> + Send + 'static), StoreError> {
        let found = self.objects.get(&path_of(&key)).await;
        let found = found.map_err(|source| self.unreadable(key, source))?;
        let (length, store) = (found.meta.size, self.clone());
        let pieces =
            found.into_stream().map(move |piece| piece.map_err(|source| store.unreadable(key, source)));
        Ok((length, pieces))
    }

    /// Whether a blob is there with all its bytes, which are read for that.
    pub async fn holds(&self, key: BlobKey) -> Result<bool, StoreError> {
        let read = async {
            let (_, mut pieces) = self.read(key).await?;
            let mut hasher = BlobHasher::default();
            while let Some(piece) = pieces.next().await {
                hasher.update(&piece?);
            }
            Ok::<_, StoreError>(hasher.key() == key)
        };
        match read.await {
            Err(error) if error.is_lost() => Ok(false),
            done => done,
        }
    }

    pub(crate) async fn get(&self, key: BlobKey, at_most: u64) -> Result<Bytes, StoreError> {
        let unreadable = |source| self.unreadable(key, source);
        let found = self.objects.get(&path_of(&key)).await.map_err(unreadable)?;
        if found.meta.size > at_most {
            return Err(StoreError::TooLarge { key, at_most });
        }
        let bytes = found.bytes().await.map_err(unreadable)?;
        if BlobKey::of(&bytes) == key { Ok(bytes) } else { Err(StoreError::Damaged { key }) }
    }

    pub(crate) async fn put(&self, key: BlobKey, bytes: Bytes) -> Result<(), StoreError> {
        let length = bytes.len() as u64;
        // Of the right length, but perhaps damaged: only then it is written again.
        let is_there = self.objects.head(&path_of(&key)).await.is_ok_and(|found| found.size == length);
        if is_there && self.holds(key).await.unwrap_or(false) {
            return Ok(());
        }
        self.write(key, bytes).await
    }

    pub(crate) async fn write(&self, key: BlobKey, bytes: Bytes) -> Result<(), StoreError> {
        let mut upload = self.upload(key, bytes.len() as u64);
        upload.write(bytes).await?;
        upload.finish().await
    }

    fn unreadable(&self, key: BlobKey, source: object_store::Error) -> StoreError {
        match source {
            object_store::Error::NotFound { .. } => StoreError::Missing { key },
            source => StoreError::Read { key, url: self.url.clone(), source },
        }
    }
}

/// Blobs are spread over 256 folders, so that no folder grows without bound.
fn path_of(key: &BlobKey) -> Path {
    let name = key.to_string();
    Path::from(format!("blobs/{}/{}", &name[..2], &name[2..]))
}
