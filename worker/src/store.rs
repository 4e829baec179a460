//! The store of blobs: the truth of every result.
//!
//! A blob's key is the hash of its bytes, so writing it twice is harmless, and a blob is complete or
//! absent: it is written under a temporary name, flushed, and renamed. Nothing refers to it until
//! the ledger does.

use std::path::PathBuf;
use std::sync::Arc;

use bytes::Bytes;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use planesweep_plan::BlobKey;
use thiserror::Error;

/// Why a blob could not be written or read.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The address of the store is of no kind that is understood, or its folder cannot be made.
    #[error("cannot open the store at {url}: {problem}")]
    Open {
        /// The address.
        url: String,
        /// What is wrong.
        problem: String,
    },
    /// Writing failed.
    #[error("cannot write blob {key}")]
    Write {
        /// The blob.
        key: BlobKey,
        /// What the store said.
        #[source]
        source: object_store::Error,
    },
    /// Reading failed.
    #[error("cannot read blob {key}")]
    Read {
        /// The blob.
        key: BlobKey,
        /// What the store said.
        #[source]
        source: object_store::Error,
    },
    /// The store has no such blob.
    #[error("blob {key} is not in the store")]
    Missing {
        /// The blob.
        key: BlobKey,
    },
    /// The bytes are not those that were written.
    #[error("blob {key} is damaged: its bytes have another hash or length")]
    Damaged {
        /// The blob.
        key: BlobKey,
    },
}

impl StoreError {
    /// Whether the blob must be made again.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Missing { .. } | Self::Damaged { .. })
    }
}

/// A store of blobs; clones share it.
#[derive(Clone, Debug)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    url: String,
}

impl Store {
    /// Opens the store in a local folder, `file:///...`, which is made if it is not there.
    pub fn open(url: &str) -> Result<Self, StoreError> {
        let error = |problem: String| StoreError::Open { url: url.to_owned(), problem };
        let folder = url
            .strip_prefix("file://")
            .map(PathBuf::from)
            .ok_or_else(|| error("only file:// stores are understood".to_owned()))?;
        std::fs::create_dir_all(&folder).map_err(|e| error(e.to_string()))?;
        let local = LocalFileSystem::new_with_prefix(&folder).map_err(|e| error(e.to_string()))?;
        Ok(Self { objects: Arc::new(local.with_fsync(true)), url: url.to_owned() })
    }

    /// The store's address.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Writes a blob, unless it is there already, and returns its key.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobKey, StoreError> {
        let key = BlobKey::of(&bytes);
        let path = path_of(&key);
        if self.objects.head(&path).await.is_ok_and(|found| found.size == bytes.len() as u64) {
            // Of the right length, but perhaps damaged: only then it is written again.
            if self.get(&key).await.is_ok() {
                return Ok(key);
            }
        }
        self.objects.put(&path, bytes.into()).await.map_err(|source| StoreError::Write { key, source })?;
        Ok(key)
    }

    /// Reads a blob and checks its hash.
    pub async fn get(&self, key: &BlobKey) -> Result<Bytes, StoreError> {
        let key = *key;
        let read = async { self.objects.get(&path_of(&key)).await?.bytes().await };
        let bytes = read.await.map_err(|source| match source {
            object_store::Error::NotFound { .. } => StoreError::Missing { key },
            source => StoreError::Read { key, source },
        })?;
        if BlobKey::of(&bytes) == key { Ok(bytes) } else { Err(StoreError::Damaged { key }) }
    }

    /// Whether a blob of this length is there; its hash is not checked.
    pub async fn has(&self, key: &BlobKey, length: u64) -> Result<bool, StoreError> {
        match self.objects.head(&path_of(key)).await {
            Ok(found) => Ok(found.size == length),
            Err(object_store::Error::NotFound { .. }) => Ok(false),
            Err(source) => Err(StoreError::Read { key: *key, source }),
        }
    }
}

/// Blobs are spread over 256 folders, so that no folder grows without bound.
fn path_of(key: &BlobKey) -> Path {
    let name = key.to_string();
    Path::from(format!("blobs/{}/{}", &name[..2], &name[2..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn store(folder: &tempfile::TempDir) -> Store {
        Store::open(&format!("file://{}", folder.path().display())).expect("a local folder")
    }

    #[tokio::test]
    async fn what_is_put_comes_back_and_putting_it_twice_is_harmless() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = store(&folder);
        let key = store.put(Bytes::from_static(b"depth")).await.expect("written");
        assert_eq!(store.put(Bytes::from_static(b"depth")).await.expect("written"), key);
        assert_eq!(store.get(&key).await.expect("read"), &b"depth"[..]);
        assert!(store.has(&key, 5).await.expect("asked") && !store.has(&key, 4).await.expect("asked"));
    }

    #[tokio::test]
    async fn a_flipped_bit_is_found_on_read_and_mended_by_writing() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = store(&folder);
        let key = store.put(Bytes::from_static(b"depth")).await.expect("written");
        let file = folder.path().join(path_of(&key).as_ref());
        std::fs::write(&file, b"deptH").expect("damaged on purpose");
        let error = store.get(&key).await.expect_err("damaged");
        assert!(matches!(error, StoreError::Damaged { .. }) && error.is_lost());
        store.put(Bytes::from_static(b"depth")).await.expect("written again");
        assert!(store.get(&key).await.is_ok());
    }

    #[tokio::test]
    async fn a_missing_blob_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let key = BlobKey::of(b"never written");
        let error = store(&folder).get(&key).await.expect_err("missing");
        assert_eq!(error.to_string(), format!("blob {key} is not in the store"));
        assert!(Store::open("ftp://host").is_err());
    }
}
