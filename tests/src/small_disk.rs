//! A disk with little room, for root only.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A file system of its own in a folder, in memory. Dropped, it is gone with all that is on it.
pub struct SmallDisk {
    folder: PathBuf,
}

impl SmallDisk {
    /// Mounts one with room for so many bytes; where that is not allowed, says that `test` is skipped.
    pub fn mount(test: &str, folder: &Path, bytes: u64) -> Option<Self> {
        std::fs::create_dir_all(folder).expect("made");
        let size = format!("size={bytes}");
        if run("mount", &["-t", "tmpfs", "-o", &size, "tmpfs"], folder) {
            return Some(Self { folder: folder.to_owned() });
        }
        eprintln!("SKIPPED {test}: a small disk cannot be mounted; that takes root");
        None
    }

    /// Makes room.
    pub fn grow(&self, bytes: u64) {
        assert!(run("mount", &["-o", &format!("remount,size={bytes}")], &self.folder), "it cannot be grown");
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Processes that are being killed may still have files open on it.
        run("umount", &["--lazy"], &self.folder);
    }
}

fn run(program: &str, arguments: &[&str], folder: &Path) -> bool {
    let output = Command::new(program).args(arguments).arg(folder).output();
    output.is_ok_and(|output| output.status.success())
}
