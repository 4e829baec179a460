//! The weights that the jobs of a run share.

use bytes::Bytes;
use planesweep_plan::BlobKey;
use tokio::sync::Mutex;

use crate::store::{Store, StoreError};

/// The weights file of the latest inference; that of the next one is mostly the same.
pub(crate) struct WeightsFiles {
    store: Store,
    latest: Mutex<Option<(BlobKey, Bytes)>>,
}

impl WeightsFiles {
    pub fn new(store: Store) -> Self {
        Self { store, latest: Mutex::new(None) }
    }

    /// The file; several that ask for a new one wait for one of them to read it.
    pub async fn get(&self, key: &BlobKey) -> Result<Bytes, StoreError> {
        let mut latest = self.latest.lock().await;
        if let Some((_, bytes)) = latest.as_ref().filter(|(have, _)| have == key) {
            return Ok(bytes.clone());
        }
        let bytes = self.store.get_file(key).await?;
        *latest = Some((*key, bytes.clone()));
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_file_is_read_once_until_another_is_wanted() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(&format!("file://{}/store", folder.path().display())).expect("a store");
        let one = store.put(Bytes::from_static(b"one")).await.expect("written");
        let weights = WeightsFiles::new(store.clone());
        assert_eq!(weights.get(&one).await.expect("read"), &b"one"[..]);
        std::fs::remove_dir_all(folder.path().join("store/blobs")).expect("removed");
        assert_eq!(weights.get(&one).await.expect("kept"), &b"one"[..]);

        let other = store.put(Bytes::from_static(b"other")).await.expect("written");
        assert_eq!(weights.get(&other).await.expect("read"), &b"other"[..]);
        assert!(weights.get(&one).await.is_err_and(|error| error.is_lost()), "only the latest is kept");
    }
}
