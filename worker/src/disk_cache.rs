//! Files from the store on this host's disk, for all of its workers and for those to come.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use planesweep_plan::BlobKey;

/// Under this name lies the lock of those that write.
const LOCK: &str = "lock";
/// Begins the names of files that are not whole yet.
const PARTIAL: &str = "partial-";
/// How long another worker may hold the lock before this one does without keeping its file: that one may be frozen.
const PATIENCE: (u32, Duration) = (40, Duration::from_millis(25));

/// A folder of files named by the hash of their bytes, within a budget.
///
/// Several processes may share it, and any of them may be killed at any moment: a file is written under another
/// name and renamed, one process writes at a time, and what a killed one left is removed by the next that writes.
/// What is read has its hash or is removed. What was not used for the longest time goes first.
#[derive(Debug)]
pub(crate) struct DiskCache {
    folder: PathBuf,
    budget_bytes: u64,
}

impl DiskCache {
    /// Nothing is made before there is something to keep.
    pub fn new(folder: PathBuf, budget_bytes: u64) -> Self {
        Self { folder, budget_bytes }
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The bytes of this hash, if they are there.
    pub fn get(&self, key: &BlobKey) -> Option<Bytes> {
        let path = self.path(key);
        let bytes = fs::read(&path).ok()?;
        if BlobKey::of(&bytes) != *key {
            tracing::warn!("{} is damaged and removed", path.display());
            let _ = fs::remove_file(&path);
            return None;
        }
        // Another process may have removed it meanwhile.
        let _ = touch(&path);
        Some(bytes.into())
    }

    /// Keeps bytes, in place of what was not used for the longest time; not if they are more than the budget or
    /// another process does not stop writing.
    pub fn put(&self, key: &BlobKey, bytes: &[u8]) -> io::Result<()> {
        let length = bytes.len() as u64;
        if length > self.budget_bytes {
            return Ok(());
        }
        fs::create_dir_all(&self.folder)?;
        let Some(_lock) = self.lock()? else { return Ok(()) };
        self.make_room(length)?;
        let partial = self.folder.join(format!("{PARTIAL}{key}"));
        let written = (|| {
            File::create(&partial)?.write_all(bytes)?;
            touch(&partial)?;
            fs::rename(&partial, self.path(key))
        })();
        if written.is_err() {
            let _ = fs::remove_file(&partial);
        }
        written
    }

    fn path(&self, key: &BlobKey) -> PathBuf {
        self.folder.join(key.to_string())
    }

    /// The lock, which the system takes from a process that dies.
    fn lock(&self) -> io::Result<Option<File>> {
        let lock = File::options().create(true).append(true).open(self.folder.join(LOCK))?;
        for _ in 0..PATIENCE.0 {
            match lock.try_lock() {
                Ok(()) => return Ok(Some(lock)),
                Err(TryLockError::WouldBlock) => sleep(PATIENCE.1),
                Err(TryLockError::Error(error)) => return Err(error),
            }
        }
        Ok(None)
    }

    /// Removes what is not whole, and the least recently used until `length` more bytes fit. With the lock only.
    fn make_room(&self, length: u64) -> io::Result<()> {
        let mut kept: Vec<(SystemTime, PathBuf, u64)> = Vec::new();
        for entry in fs::read_dir(&self.folder)? {
            let entry = entry?;
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if name.starts_with(PARTIAL) {
                fs::remove_file(entry.path())?;
            } else if name.parse::<BlobKey>().is_ok() {
                let metadata = entry.metadata()?;
                kept.push((metadata.modified()?, entry.path(), metadata.len()));
            }
        }
        kept.sort_unstable();
        let mut bytes: u64 = kept.iter().map(|(_, _, length)| length).sum();
        for (_, path, freed) in kept {
            if bytes + length <= self.budget_bytes {
                break;
            }
            match fs::remove_file(&path) {
                Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
                _ => bytes -= freed,
            }
        }
        Ok(())
    }
}

/// Notes that a file was used just now.
fn touch(path: &Path) -> io::Result<()> {
    File::options().append(true).open(path)?.set_modified(SystemTime::now())
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;
    use tempfile::TempDir;

    use super::*;

    fn cache(budget_bytes: u64) -> (TempDir, DiskCache) {
        let folder = tempfile::tempdir().expect("a folder");
        let cache = DiskCache::new(folder.path().join("of/photographs"), budget_bytes);
        (folder, cache)
    }

    fn put(cache: &DiskCache, bytes: &[u8]) -> BlobKey {
        let key = BlobKey::of(bytes);
        cache.put(&key, bytes).expect("a folder that can be written");
        key
    }

    /// Names and bytes of what is in the folder, without the lock.
    fn files(cache: &DiskCache) -> Vec<(String, Vec<u8>)> {
        let entries = fs::read_dir(cache.folder()).expect("a folder");
        let paths = entries.map(|entry| entry.expect("an entry").path());
        let named = paths.map(|path| {
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            (name, fs::read(path).expect("a file"))
        });
        named.filter(|(name, _)| name != LOCK).collect()
    }

    #[test]
    fn what_was_not_used_for_the_longest_time_goes_first() {
        let (_folder, cache) = cache(6);
        let (a, b) = (put(&cache, b"aa"), put(&cache, b"bb"));
        let another = DiskCache::new(cache.folder().to_owned(), 6);
        let c = put(&another, b"cc");
        assert_eq!(another.get(&a).as_deref(), Some(&b"aa"[..]));
        put(&another, b"dd");
        assert!(cache.get(&b).is_none(), "it was used first");
        assert!(cache.get(&a).is_some() && cache.get(&c).is_some());
        put(&cache, b"longer than all");
        assert_eq!(files(&cache).len(), 3, "what is larger than the budget takes nobody's place");
    }

    #[test]
    fn what_a_killed_process_left_and_what_is_damaged_is_removed() {
        let (_folder, cache) = cache(100);
        let key = put(&cache, b"photograph");
        let partial = cache.folder().join(format!("{PARTIAL}{}", BlobKey::of(b"half of it")));
        fs::write(&partial, b"half").expect("written");
        assert!(cache.get(&BlobKey::of(b"half of it")).is_none());
        put(&cache, b"another");
        assert!(!partial.exists());

        fs::write(cache.folder().join(key.to_string()), b"photo").expect("cut off");
        assert!(cache.get(&key).is_none());
        assert_eq!(files(&cache).len(), 1);
        put(&cache, b"photograph");
        assert!(cache.get(&key).is_some());
    }

    #[test]
    fn a_process_that_writes_for_ever_holds_nobody_up() {
        let (_folder, cache) = cache(100);
        put(&cache, b"first");
        let lock = cache.lock().expect("a file").expect("nobody has it");
        let key = put(&cache, b"second");
        assert!(cache.get(&key).is_none());
        drop(lock);
        assert_eq!(put(&cache, b"second"), key);
        assert!(cache.get(&key).is_some());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn the_budget_is_never_exceeded(lengths in vec(0..30_usize, 1..20), budget in 0..60_u64) {
            let (_folder, cache) = cache(budget);
            for (seed, length) in lengths.into_iter().enumerate() {
                let bytes = vec![seed as u8; length];
                let key = put(&cache, &bytes);
                let is_kept = length as u64 <= budget;
                prop_assert_eq!(cache.get(&key).is_some(), is_kept);
                if is_kept {
                    let bytes: usize = files(&cache).iter().map(|(_, bytes)| bytes.len()).sum();
                    prop_assert!(bytes as u64 <= budget);
                }
            }
        }
    }
}
