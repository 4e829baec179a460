//! Files of the scene, wherever this worker can get them: under their path, on its own disk, from the store.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use planesweep_plan::BlobKey;
use thiserror::Error;

use crate::disk_cache::DiskCache;
use crate::jobs::compute;
use crate::store::{Store, StoreError};

/// Why the bytes of a file cannot be had.
#[derive(Debug, Error)]
pub enum FileError {
    /// The file cannot be read, and nobody has put it into the store.
    #[error("cannot read image {}, and the store has no copy of it", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The file is not the one that was planned with.
    #[error("image {} has changed since the run was planned", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
    },
    /// The store is in trouble.
    #[error("cannot get image {} from the store", path.display())]
    Store {
        /// The file.
        path: PathBuf,
        /// What the store said.
        #[source]
        source: StoreError,
    },
}

/// The files of all scenes.
pub(crate) struct Files {
    store: Store,
    cache: Arc<DiskCache>,
    /// Whether it was said that the cache does not work.
    has_complained: AtomicBool,
}

impl Files {
    /// What comes from the store is kept in `cache`.
    pub fn new(store: Store, cache: DiskCache) -> Self {
        Self { store, cache: Arc::new(cache), has_complained: AtomicBool::new(false) }
    }

    /// The bytes of this hash, which were at `path` where the run was planned; counts those that come from the
    /// store.
    pub async fn get(&self, path: &Path, hash: BlobKey, fetched: &mut u32) -> Result<Bytes, FileError> {
        let (path, cache) = (path.to_owned(), Arc::clone(&self.cache));
        let near = compute(move || read(&path, hash).or_else(|error| cache.get(&hash).ok_or((path, error))));
        let (path, not_here) = match near.await {
            Ok(bytes) => return Ok(bytes),
            Err(not_here) => not_here,
        };
        tracing::debug!(path = %path.display(), "fetching from the store");
        let bytes = match self.store.get_file(&hash).await {
            Ok(bytes) => bytes,
            Err(error) if error.is_lost() => return Err(not_here),
            Err(source) => return Err(FileError::Store { path, source }),
        };
        tracing::debug!(path = %path.display(), "fetched");
        *fetched += 1;
        let (cache, kept) = (Arc::clone(&self.cache), bytes.clone());
        if let Err(error) = compute(move || cache.put(&hash, &kept)).await
            && !self.has_complained.swap(true, Ordering::Relaxed)
        {
            let folder = self.cache.folder().display();
            tracing::warn!(%error, "photographs from the store are not kept in {folder}");
        }
        Ok(bytes)
    }
}

/// The bytes of a file, which must be those that the run was planned with.
fn read(path: &Path, hash: BlobKey) -> Result<Bytes, FileError> {
    let bytes = std::fs::read(path).map_err(|source| FileError::Read { path: path.to_owned(), source })?;
    if BlobKey::of(&bytes) == hash {
        Ok(bytes.into())
    } else {
        Err(FileError::Changed { path: path.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[tokio::test]
    async fn a_file_comes_from_its_path_the_disk_or_the_store_in_this_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let store = Store::open(&format!("file://{}", at("store").display())).expect("a store");
        let files = || Files::new(store.clone(), DiskCache::new(at("cache"), 1 << 20));
        let (path, hash) = (at("a.jpg"), BlobKey::of(b"photograph"));
        let mut fetched = 0;

        let error = files().get(&path, hash, &mut fetched).await.expect_err("it is nowhere");
        assert!(matches!(error, FileError::Read { .. }), "{error}");
        fs::write(&path, b"photograph").expect("written");
        assert!(files().get(&path, hash, &mut fetched).await.is_ok());
        assert!(!at("cache").exists(), "what lies at its path is not copied");
        fs::write(&path, b"retouched").expect("written");
        let error = files().get(&path, hash, &mut fetched).await.expect_err("another photograph");
        assert!(matches!(error, FileError::Changed { .. }) && fetched == 0, "{error}");

        store.put(Bytes::from_static(b"photograph")).await.expect("written");
        assert_eq!(files().get(&path, hash, &mut fetched).await.expect("from the store"), &b"photograph"[..]);
        assert_eq!(fetched, 1);
        fs::remove_dir_all(at("store")).expect("removed");
        assert_eq!(files().get(&path, hash, &mut fetched).await.expect("from the disk"), &b"photograph"[..]);
        assert_eq!(fetched, 1);
    }

    #[tokio::test]
    async fn without_a_cache_files_still_come() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(&format!("file://{}/store", folder.path().display())).expect("a store");
        let no_folder = folder.path().join("file");
        fs::write(&no_folder, b"").expect("written");
        let files = Files::new(store.clone(), DiskCache::new(no_folder.join("cache"), 1 << 20));
        let key = store.put(Bytes::from_static(b"photograph")).await.expect("written");
        for fetches in [1, 2] {
            let mut fetched = fetches - 1;
            assert!(files.get(Path::new("/nowhere/a.jpg"), key, &mut fetched).await.is_ok());
            assert_eq!(fetched, fetches);
        }
    }
}
