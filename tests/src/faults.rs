//! Processes that are found, watched and sent signals.

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

/// Waits until a state is there; `false` when the deadline comes first.
pub fn wait_until(deadline: Duration, mut is_there: impl FnMut() -> bool) -> bool {
    let begun = Instant::now();
    while !is_there() {
        if begun.elapsed() > deadline {
            return false;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    true
}

/// The children of a process whose command line has `word` as an argument, by id.
pub fn children(parent: u32, word: &str) -> Vec<u32> {
    let entries = fs::read_dir("/proc").expect("/proc is there");
    let names = entries.flatten().filter_map(|entry| entry.file_name().into_string().ok());
    let mut found: Vec<u32> = names
        .filter_map(|name| name.parse().ok())
        .filter(|pid| stat(*pid).is_some_and(|(_, of)| of == parent) && has_argument(*pid, word))
        .collect();
    found.sort_unstable();
    found
}

/// Whether a process exists and has not ended; what ended and was not yet waited for is not alive.
pub fn is_alive(pid: u32) -> bool {
    stat(pid).is_some_and(|(state, _)| !"ZX".contains(state))
}

/// Whether a process stands still, as after SIGSTOP.
pub fn is_frozen(pid: u32) -> bool {
    stat(pid).is_some_and(|(state, _)| state == 'T')
}

/// Sends a signal, such as "KILL", to a process; whether it was there to get it.
pub fn send(signal: &str, pid: u32) -> bool {
    let sent = Command::new("sh").arg("-c").arg(format!("kill -s {signal} {pid}")).status();
    sent.expect("a shell starts").success()
}

/// State and parent of a process.
fn stat(pid: u32) -> Option<(char, u32)> {
    let text = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name before the state is in parentheses and may have any characters.
    let (_, rest) = text.rsplit_once(')')?;
    let mut fields = rest.split_ascii_whitespace();
    Some((fields.next()?.chars().next()?, fields.next()?.parse().ok()?))
}

fn has_argument(pid: u32, word: &str) -> bool {
    let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    line.split(|byte| *byte == 0).any(|argument| argument == word.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_child_is_found_killed_and_gone() {
        let mut child = Command::new("sleep").arg("1000").spawn().expect("started");
        let pid = child.id();
        let found = || children(std::process::id(), "1000") == [pid];
        assert!(wait_until(Duration::from_secs(30), found));
        assert!(is_alive(pid) && send("KILL", pid));
        assert!(wait_until(Duration::from_secs(30), || !is_alive(pid)));
        child.wait().expect("it has ended");
        assert!(!send("KILL", pid));
    }
}
