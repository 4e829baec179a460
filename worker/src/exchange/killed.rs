//! Processes that are killed with an end of the exchange in their hands: what they leave in shared memory
//! is removed by the next process of their user, and by no other.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use super::conformance::shared_memory;
use super::*;

/// What the child does: "inbox NAME" or "outbox NAME", and as which user.
const ROLE: &str = "PLANESWEEP_TEST_END";
const USER: &str = "PLANESWEEP_TEST_USER";
const NOBODY: u32 = 65534;

/// Not a test but the process that the tests below kill; without being asked it does nothing.
#[test]
fn child() {
    let Ok(role) = std::env::var(ROLE) else { return };
    if let Ok(user) = std::env::var(USER) {
        let user = user.parse().expect("a user id");
        // SAFETY: the call changes who the process is, and nothing of its memory.
        #[allow(unsafe_code)]
        let result = unsafe { libc::setuid(user) };
        assert_eq!(result, 0, "cannot become user {user}");
    }
    let (end, name) = role.split_once(' ').expect("an end and a name");
    let _held = if end == "inbox" {
        (Some(Inbox::open(name, 1 << 20).expect("an inbox")), None)
    } else {
        let outbox = Outbox::open(name).expect("an outbox");
        outbox.fit(100).expect("a segment");
        let sent = outbox.lend(100, |out| out.put_bytes(7, 100)).is_some_and(|loan| loan.send(&KEY));
        assert!(sent, "the inbox takes nothing");
        let lent = outbox.lend(100, |out| out.put_bytes(8, 100));
        (None, Some((outbox, lent)))
    };
    println!("ready");
    std::io::stdin().read_line(&mut String::new()).expect("a parent");
}

const KEY: BlobKey = BlobKey([3; 32]);

/// A process of this test that holds an end.
struct Holder {
    child: Child,
}

impl Holder {
    fn start(end: &str, name: &str, user: Option<u32>) -> Self {
        let mut command = Command::new(std::env::current_exe().expect("a test knows its file"));
        command
            .args(["--exact", "exchange::killed::child", "--nocapture"])
            .env(ROLE, format!("{end} {name}"));
        command.envs(user.map(|user| (USER, user.to_string())));
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("started");
        let lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let is_ready = lines.map_while(Result::ok).any(|line| line.ends_with("ready"));
        assert!(is_ready, "the process ended before it was ready");
        Self { child }
    }

    /// Kills it, and sees that what it had is still there.
    fn kill(mut self) -> BTreeSet<PathBuf> {
        let segments = mapped(&self.child.id().to_string());
        self.child.kill().expect("it lives");
        let status = self.child.wait().expect("it can be waited for");
        assert_eq!(status.signal(), Some(9), "it was not the signal that ended it");
        let left: BTreeSet<PathBuf> = segments.into_iter().filter(|file| file.exists()).collect();
        assert!(!left.is_empty(), "nothing is left behind");
        left
    }
}

/// The files in shared memory that a process has mapped.
fn mapped(process: &str) -> BTreeSet<PathBuf> {
    let maps = std::fs::read_to_string(format!("/proc/{process}/maps")).expect("it lives");
    maps.lines().filter_map(|line| Some(PathBuf::from(&line[line.find("/dev/shm/")?..]))).collect()
}

fn unique(name: &str) -> String {
    format!("{name}-{}", std::process::id())
}

fn still_there(segments: &BTreeSet<PathBuf>) -> Vec<&PathBuf> {
    segments.iter().filter(|file| file.exists()).collect()
}

#[test]
fn what_a_killed_inbox_leaves_is_removed_by_the_next_process() {
    let Some(_alone) = shared_memory("what_a_killed_inbox_leaves_is_removed_by_the_next_process") else {
        return;
    };
    let name = unique("killed-inbox");
    let left = Holder::start("inbox", &name, None).kill();
    let _next = Inbox::open(&unique("next-inbox"), 1 << 20).expect("an inbox");
    assert_eq!(still_there(&left), Vec::<&PathBuf>::new());
    assert!(
        matches!(Outbox::open(&name), Err(SharedMemoryError::Elsewhere { .. })),
        "the dead inbox is gone"
    );
}

#[test]
fn what_a_killed_sender_leaves_is_removed_and_what_it_sent_stays_readable() {
    let Some(_alone) =
        shared_memory("what_a_killed_sender_leaves_is_removed_and_what_it_sent_stays_readable")
    else {
        return;
    };
    let name = unique("survivor");
    let inbox = Inbox::open(&name, 1 << 20).expect("an inbox");
    let of_the_inbox = mapped("self");
    let holder = Holder::start("outbox", &name, None);
    let received = inbox.get(&KEY);
    assert_eq!(received.as_deref(), Some(&[7; 100][..]));
    let left = holder.kill();
    let size = |file: &&PathBuf| file.metadata().map_or(0, |file| file.len());
    let segment = left.difference(&of_the_inbox).max_by_key(size).expect("it had a segment").clone();
    assert!(size(&&segment) >= (5 * 64) << 10, "{} is no segment of maps", segment.display());

    let _next = Outbox::open(&name).expect("the inbox lives on");
    assert!(!segment.exists(), "the segment is left behind");
    assert_eq!(inbox.get(&KEY).as_deref(), Some(&[7; 100][..]), "a map that is kept outlives its sender");
    assert_eq!(received.as_deref(), Some(&[7; 100][..]));
    // And the next sender is heard.
    drop(Holder::start("outbox", &name, None).kill());
}

#[test]
fn what_other_users_leave_is_left_alone() {
    let test = "what_other_users_leave_is_left_alone";
    let Some(_alone) = shared_memory(test) else { return };
    if !rustix::process::getuid().is_root() {
        eprintln!("SKIPPED {test}: only root can be several users");
        return;
    }
    let left = Holder::start("inbox", &unique("nobodys-inbox"), Some(NOBODY)).kill();
    drop(Inbox::open(&unique("roots-inbox"), 1 << 20).expect("an inbox"));
    assert_eq!(still_there(&left).len(), left.len(), "another user's segments were removed");
    let next = Holder::start("inbox", &unique("nobodys-next"), Some(NOBODY));
    assert_eq!(still_there(&left), Vec::<&PathBuf>::new());
    // Its own are the next one's to remove; here by a process that ends by itself.
    next.kill();
    drop(Holder::start("inbox", &unique("nobodys-last"), Some(NOBODY)));
}

impl Drop for Holder {
    fn drop(&mut self) {
        // Its standard input ends, and so does it.
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}
