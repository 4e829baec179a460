//! A container engine, and containers of the program on networks of their own.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

use crate::faults::{send, wait_until};
use crate::program::program;
use crate::scripts::{script, unavailable};

/// How long the engine may take to start, or to stop.
const ENGINE: Duration = Duration::from_mins(2);

/// The engine that runs on this host, or one that is started for the test and stopped after it; containers and
/// networks made through it are removed with it.
pub struct Containers {
    /// Where a started engine listens; `None` for the host's own.
    socket: Option<PathBuf>,
    engine: Option<Child>,
    folder: TempDir,
    /// Begins the names of this test's containers and networks, for the engine may serve others, too.
    prefix: String,
    started: Vec<String>,
    networks: Vec<String>,
}

/// What `docker run` gets for each container of the program: as `docker/compose.yaml` has it.
const LOCKED: [&str; 7] =
    ["--init", "--read-only", "--cap-drop", "ALL", "--security-opt", "no-new-privileges", "--detach"];

impl Containers {
    /// `None`, and a line on stderr, where there is no engine and none can be started.
    pub fn new(test: &str) -> Option<Self> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut made = Self {
            socket: None,
            engine: None,
            folder,
            prefix: format!("planesweep-{}", std::process::id()),
            started: Vec::new(),
            networks: Vec::new(),
        };
        if made.answers() {
            return Some(made);
        }
        let folder = made.folder.path().to_owned();
        made.socket = Some(folder.join("docker.sock"));
        let log = fs::File::create(folder.join("log")).expect("a temporary file");
        let engine = Command::new(script("docker_engine.sh"))
            .arg(&folder)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("a script starts");
        let engine = made.engine.insert(engine);
        let mut has_ended = || engine.try_wait().expect("a child can be asked").is_some();
        let socket = made.socket.as_deref();
        let is_ready = wait_until(ENGINE, || is_answering(socket) || has_ended());
        if is_ready && is_answering(socket) {
            return Some(made);
        }
        let said = fs::read_to_string(folder.join("log")).unwrap_or_default();
        // Not every root may start one: it takes the privileges of a whole machine.
        assert!(has_ended(), "the engine neither answers nor ends: {said}");
        eprintln!("SKIPPED {test}: {}", said.lines().last().unwrap_or("no container engine starts"));
        None
    }

    fn answers(&self) -> bool {
        is_answering(self.socket.as_deref())
    }

    /// Makes the image of the program under test; `false`, and a line on stderr, where that is not possible.
    pub fn make_image(&self, test: &str, image: &str) -> bool {
        let made = self.script("docker_image.sh").arg(program()).arg(image).output();
        is_made(test, &made.expect("a script starts"))
    }

    /// A script of the project that uses this engine.
    pub(crate) fn script(&self, name: &str) -> Command {
        with_engine(Command::new(script(name)), self.socket.as_deref())
    }

    /// What the names of this test's containers and networks begin with.
    pub(crate) fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Runs `docker` with these arguments, which must succeed; what it said on both streams.
    #[track_caller]
    pub fn docker(&self, arguments: &[&str]) -> String {
        let (done, said) = self.try_docker(arguments);
        assert!(done, "docker {}: {said}", arguments.join(" "));
        said
    }

    /// The same, and whether it succeeded.
    pub fn try_docker(&self, arguments: &[&str]) -> (bool, String) {
        let output = docker(self.socket.as_deref()).args(arguments).output().expect("docker is there");
        let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
        (output.status.success(), said.concat().trim().to_owned())
    }

    /// Makes a network; its full name.
    #[track_caller]
    pub fn network(&mut self, name: &str) -> String {
        let name = format!("{}-{name}", self.prefix);
        // Nothing outside is reached or reaches in.
        self.docker(&["network", "create", "--internal", &name]);
        self.networks.push(name.clone());
        name
    }

    /// Starts a locked-down container in the background; its full name. `command` ends with image and arguments.
    #[track_caller]
    pub fn run(&mut self, name: &str, command: &[&str]) -> String {
        let full = format!("{}-{name}", self.prefix);
        self.started.push(full.clone());
        self.docker(&[&["run", "--name", &full, "--hostname", name], &LOCKED[..], command].concat());
        full
    }

    /// What `docker inspect` says of a container.
    #[track_caller]
    pub fn inspect(&self, container: &str) -> Value {
        let said = self.docker(&["inspect", "--format", "{{json .}}", container]);
        serde_json::from_str(&said).unwrap_or_else(|error| panic!("{error}: {said}"))
    }

    /// A container's state: the part of `docker inspect` of that name.
    #[track_caller]
    pub fn state(&self, container: &str) -> Value {
        self.inspect(container)["State"].take()
    }

    /// What a container has printed.
    #[track_caller]
    pub fn logs(&self, container: &str) -> String {
        self.docker(&["logs", container])
    }
}

impl Drop for Containers {
    fn drop(&mut self) {
        for container in &self.started {
            let _ = self.try_docker(&["rm", "--force", "--volumes", container]);
        }
        for network in &self.networks {
            let _ = self.try_docker(&["network", "rm", network]);
        }
        if let Some(engine) = &mut self.engine {
            send("TERM", engine.id());
            let has_ended = wait_until(ENGINE, || engine.try_wait().is_ok_and(|status| status.is_some()));
            if !has_ended {
                send("KILL", engine.id());
                let _ = engine.wait();
            }
        }
    }
}

/// Whether a script made something; `false`, and a line on stderr, where it cannot be made.
pub(crate) fn is_made(test: &str, output: &Output) -> bool {
    if unavailable(test, output) {
        return false;
    }
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    true
}

fn docker(socket: Option<&Path>) -> Command {
    with_engine(Command::new("docker"), socket)
}

fn with_engine(mut command: Command, socket: Option<&Path>) -> Command {
    if let Some(socket) = socket {
        command.env("DOCKER_HOST", format!("unix://{}", socket.display()));
    }
    command
}

fn is_answering(socket: Option<&Path>) -> bool {
    let answer = docker(socket).args(["info", "--format", "{{.ID}}"]).output();
    answer.is_ok_and(|answer| answer.status.success() && !answer.stdout.trim_ascii().is_empty())
}
