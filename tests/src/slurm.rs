//! A Slurm cluster of one node, this host.

use std::ffi::OsStr;
use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tempfile::TempDir;

use crate::faults::{send, wait_until};
use crate::scripts::{UNAVAILABLE, script};

/// How long the daemons may take to start, or to stop.
const DAEMONS: Duration = Duration::from_mins(2);

/// Its daemons, started for a test and stopped after it, jobs included.
pub struct Slurm {
    daemons: Child,
    folder: TempDir,
}

impl Slurm {
    /// `None`, and a line on stderr, where there is none and none can be installed.
    #[track_caller]
    pub fn new(test: &str) -> Option<Self> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let log = fs::File::create(folder.path().join("log")).expect("a temporary file");
        let daemons = Command::new(script("slurm_node.sh"))
            .arg(folder.path())
            .args([free_port(), free_port()].map(|port| port.to_string()))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("a script starts");
        let mut made = Self { daemons, folder };
        let is_idle = |made: &Self| made.try_ask("sinfo", &["-h", "-o", "%T"]).as_deref() == Some("idle");
        let is_ready = wait_until(DAEMONS, || is_idle(&made) || made.has_ended());
        if is_ready && !made.has_ended() {
            return Some(made);
        }
        let said = fs::read_to_string(made.folder.path().join("log")).unwrap_or_default();
        let code = made.daemons.try_wait().expect("a child can be asked").and_then(|status| status.code());
        assert_eq!(code, Some(UNAVAILABLE), "Slurm does not start: {said}\n{}", made.describe());
        eprintln!("SKIPPED {test}: {}", said.lines().last().unwrap_or("no reason given"));
        None
    }

    fn has_ended(&mut self) -> bool {
        self.daemons.try_wait().expect("a child can be asked").is_some()
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.folder.path().join("slurm.conf"));
        command
    }

    fn try_ask(&self, program: &str, arguments: &[&str]) -> Option<String> {
        let output = self.command(program).args(arguments).output().ok()?;
        let said = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        output.status.success().then_some(said)
    }

    /// What a command of Slurm says, which must succeed.
    #[track_caller]
    pub fn ask(&self, program: &str, arguments: &[&str]) -> String {
        let said = self.try_ask(program, arguments);
        said.unwrap_or_else(|| panic!("{program} {} fails", arguments.join(" ")))
    }

    /// Submits a batch script from a folder, where its output lies then; the job's id.
    #[track_caller]
    pub fn batch(&self, folder: &Path, arguments: &[&str], variables: &[(&str, &OsStr)]) -> String {
        let mut command = self.command("sbatch");
        command.arg("--parsable").arg("--chdir").arg(folder).args(arguments).envs(variables.iter().copied());
        let output = command.output().expect("sbatch is there");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    }

    /// One field of `scontrol show job`, such as `JobState`.
    #[track_caller]
    pub fn field(&self, job: &str, name: &str) -> String {
        let shown = self.ask("scontrol", &["--oneliner", "show", "job", job]);
        let mut fields = shown.split_ascii_whitespace().filter_map(|field| field.split_once('='));
        let found = fields.find_map(|(key, value)| (key == name).then(|| value.to_owned()));
        found.unwrap_or_else(|| panic!("no {name} in {shown}"))
    }

    /// What its queue and its controller's log say, for a test that fails.
    pub fn describe(&self) -> String {
        let queue = self.try_ask("squeue", &[]).unwrap_or_default();
        let log = fs::read_to_string(self.folder.path().join("slurmctld.log")).unwrap_or_default();
        format!("{queue}\n{log}")
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        if self.has_ended() {
            return;
        }
        let _ = self.try_ask("scancel", &["--user", "root"]);
        let _ = wait_until(DAEMONS, || self.try_ask("squeue", &["-h"]).is_none_or(|jobs| jobs.is_empty()));
        send("TERM", self.daemons.id());
        if !wait_until(DAEMONS, || self.has_ended()) {
            send("KILL", self.daemons.id());
            let _ = self.daemons.wait();
        }
    }
}

/// A port that nobody listens on at the moment.
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("it is bound").port()
}
