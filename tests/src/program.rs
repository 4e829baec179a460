//! The program under test, built once, started as a process and never waited for without an end.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

use crate::faults::{send, wait_until};

/// How long a run may take before the test fails with what it said so far; far above what any takes.
const DEADLINE: Duration = Duration::from_mins(30);

/// A process that has ended.
#[derive(Debug)]
pub struct Finished {
    /// The exit code; `None` when a signal ended it.
    pub code: Option<i32>,
    /// Everything on stdout.
    pub stdout: String,
    /// Everything on stderr.
    pub stderr: String,
}

impl Finished {
    /// The same process, which must have ended with this exit code.
    #[must_use]
    #[track_caller]
    pub fn expect_code(self, code: i32) -> Self {
        assert_eq!(self.code, Some(code), "stdout: {}\nstderr: {}", self.stdout, self.stderr);
        self
    }

    /// The same with one of these exit codes.
    #[must_use]
    #[track_caller]
    pub fn expect_one_of(self, codes: &[i32]) -> Self {
        let is_expected = self.code.is_some_and(|code| codes.contains(&code));
        assert!(is_expected, "ended with {:?}: {}\n{}", self.code, self.stdout, self.stderr);
        self
    }

    /// The one JSON object that stdout must be.
    #[track_caller]
    pub fn json(&self) -> Value {
        let value: Value = serde_json::from_str(&self.stdout)
            .unwrap_or_else(|error| panic!("stdout is not one JSON value: {error}\n{}", self.stdout));
        assert!(value.is_object(), "stdout is no object: {}", self.stdout);
        value
    }
}

/// A process of the program. Dropped before its end, it is killed.
pub struct Running {
    child: Child,
    output: TempDir,
}

impl Running {
    /// Starts `planesweep` with these arguments and an empty standard input.
    pub fn start<S: AsRef<OsStr>>(arguments: impl IntoIterator<Item = S>) -> Self {
        Self::start_in(&[], arguments)
    }

    /// The same with more variables in its environment.
    pub fn start_in<S: AsRef<OsStr>>(
        environment: &[(&'static str, String)],
        arguments: impl IntoIterator<Item = S>,
    ) -> Self {
        Self::start_by(&mut Command::new(program()), environment, arguments)
    }

    /// Has a shell script start it, as `"$0" "$@"`.
    pub fn start_in_script<S: AsRef<OsStr>>(script: &str, arguments: impl IntoIterator<Item = S>) -> Self {
        Self::start_by(Command::new("sh").args(["-c", script]).arg(program()), &[], arguments)
    }

    fn start_by<S: AsRef<OsStr>>(
        command: &mut Command,
        environment: &[(&'static str, String)],
        arguments: impl IntoIterator<Item = S>,
    ) -> Self {
        let output = tempfile::tempdir().expect("a temporary folder");
        let file = |name: &str| File::create(output.path().join(name)).expect("a temporary file");
        let child = command
            .args(arguments)
            .env_remove("PLANESWEEP_WEIGHTS")
            .env_remove("PLANESWEEP_LOG")
            .envs(environment.iter().cloned())
            .stdin(Stdio::null())
            .stdout(file("stdout"))
            .stderr(file("stderr"))
            .spawn()
            .expect("the program starts");
        Self { child, output }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// What it has said on stderr so far.
    pub fn stderr(&self) -> String {
        self.read("stderr")
    }

    /// Whether it has not ended yet.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("a child can be asked").is_none()
    }

    /// Waits for its end.
    #[track_caller]
    pub fn wait(mut self) -> Finished {
        let has_ended = wait_until(DEADLINE, || !self.is_running());
        assert!(has_ended, "still running after {DEADLINE:?}: {}", self.stderr());
        let code = self.child.wait().expect("it has ended").code();
        Finished { code, stdout: self.read("stdout"), stderr: self.stderr() }
    }

    fn read(&self, name: &str) -> String {
        let bytes = fs::read(self.output.path().join(name)).expect("a temporary file");
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.is_running() {
            send("KILL", self.pid());
            let _ = self.child.wait();
        }
    }
}

/// Runs `planesweep` with these arguments to its end.
#[track_caller]
pub fn run<S: AsRef<OsStr>>(arguments: impl IntoIterator<Item = S>) -> Finished {
    Running::start(arguments).wait()
}

/// The program that PLANESWEEP_PROGRAM names, or else the one beside the running test, of the same
/// profile. Cargo builds that where it is missing or older than its sources; several tests that ask at
/// once wait for one another.
pub fn program() -> &'static PathBuf {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        if let Some(named) = std::env::var_os("PLANESWEEP_PROGRAM") {
            return named.into();
        }
        let test = std::env::current_exe().expect("a test knows its file");
        // target/PROFILE/{deps,examples}/TEST
        let folder = test.ancestors().nth(2).expect("tests lie two folders deep");
        let profile = match folder.file_name().and_then(OsStr::to_str) {
            Some("debug") => "dev",
            Some(name) => name,
            None => panic!("{} has no profile", test.display()),
        };
        let target = folder.parent().expect("the target folder");
        let built = Command::new(env!("CARGO"))
            .args(["build", "--quiet", "--package", "planesweep", "--profile", profile, "--target-dir"])
            .arg(target)
            .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
            .status()
            .expect("cargo starts");
        assert!(built.success(), "the program cannot be built");
        folder.join("planesweep")
    })
}
