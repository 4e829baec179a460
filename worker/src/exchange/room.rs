//! Room in shared memory. What is written beyond it ends the process with SIGBUS, so it is looked for
//! before anything is made there, and what was made is reserved at once.

use std::collections::BTreeSet;
use std::fs::OpenOptions;
use std::{fs, io};

use rustix::fs::{FallocateFlags, fallocate, statvfs};

use super::SharedMemoryError;

/// Where POSIX shared memory lies.
const FOLDER: &str = "/dev/shm";
/// What is left to others, and to the small segments that manage the large ones.
const MARGIN_BYTES: u64 = 8 << 20;

/// Bytes that may be used now.
pub(super) fn free_bytes() -> Result<u64, SharedMemoryError> {
    let absent = |source: io::Error| SharedMemoryError::Absent { folder: FOLDER, source };
    let folder = statvfs(FOLDER).map_err(|error| absent(error.into()))?;
    // A folder of the root file system stands in where no memory is mounted; its room says nothing.
    let is_memory = rustix::fs::statfs(FOLDER).map_err(|error| absent(error.into()))?.f_type == TMPFS_MAGIC;
    if !is_memory || folder.f_flag.contains(rustix::fs::StatVfsMountFlags::RDONLY) {
        return Err(absent(io::Error::other("no writable memory is mounted there")));
    }
    let free = folder.f_bavail.saturating_mul(folder.f_frsize);
    match free.saturating_sub(MARGIN_BYTES) {
        0 => Err(SharedMemoryError::Full { folder: FOLDER, free }),
        usable => Ok(usable),
    }
}

/// The kernel's mark of a file system in memory.
const TMPFS_MAGIC: rustix::fs::FsWord = 0x0102_1994;

/// Takes the pages of all that this process has mapped under names with this beginning from the system
/// now, so that there is an error rather than a signal when there are none left.
pub(super) fn reserve(prefix: &str) -> Result<(), SharedMemoryError> {
    let reserve = || -> io::Result<usize> {
        let maps = fs::read_to_string("/proc/self/maps")?;
        let beginning = format!("{FOLDER}/{prefix}");
        let mapped = maps.lines().filter_map(|line| Some(&line[line.find(&beginning)?..]));
        // What others have removed meanwhile is mapped, but has no name.
        let files: BTreeSet<&str> = mapped.filter(|path| !path.ends_with(" (deleted)")).collect();
        for path in &files {
            let file = OpenOptions::new().read(true).write(true).open(path)?;
            fallocate(&file, FallocateFlags::empty(), 0, file.metadata()?.len())?;
        }
        Ok(files.len())
    };
    let reserved = reserve().and_then(|files| match files {
        0 => Err(io::Error::from(io::ErrorKind::NotFound)),
        _ => Ok(()),
    });
    reserved.map_err(|source| SharedMemoryError::Reserve { folder: FOLDER, source })
}
