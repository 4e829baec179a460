//! Folders that one process sees otherwise than all others.

use std::process::Command;

/// Whether a file system can be mounted for one process alone; if not, a line on stderr says that `test` is skipped.
pub fn can_mount(test: &str) -> bool {
    let tried = Command::new("unshare").args(["-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]).output();
    let can = tried.is_ok_and(|tried| tried.status.success());
    if !can {
        eprintln!("SKIPPED {test}: mounting for one process alone needs root");
    }
    can
}

/// A shell script that starts `"$0" "$@"` where these folders are empty.
pub fn hiding(folders: &[&str]) -> String {
    let mounts: Vec<String> = folders.iter().map(|folder| format!("mount -t tmpfs tmpfs {folder}")).collect();
    mounted(&mounts)
}

/// A shell script that starts `"$0" "$@"` where these commands have mounted something.
pub fn mounted<S: AsRef<str>>(mounts: &[S]) -> String {
    let mounts: Vec<String> = mounts.iter().map(|mount| format!("{} || exit 9; ", mount.as_ref())).collect();
    format!("exec unshare -m sh -c '{}exec \"$0\" \"$@\"' \"$0\" \"$@\"", mounts.concat())
}
