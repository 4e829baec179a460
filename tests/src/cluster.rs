//! A coordinator and workers as processes of their own.

use std::time::Duration;

use serde_json::Value;

use crate::bench::Bench;
use crate::faults::{send, wait_until};
use crate::program::Running;

/// How long a process may take to say that it is ready.
const READY: Duration = Duration::from_mins(2);
/// A dead worker is noticed soon, and one that waits for its turn on a busy machine is not taken for dead.
const LEASE_SECONDS: &str = "3";

/// A coordinator whose ledger and store lie in the folder of a bench.
pub struct Cluster {
    url: String,
    environment: Vec<(&'static str, String)>,
    options: Vec<String>,
    coordinator: Running,
}

impl Cluster {
    /// Starts a coordinator on a free port, with `more` options.
    #[track_caller]
    pub fn start(bench: &Bench, more: &[&str]) -> Self {
        Self::start_on(&bench.path("ledger.sqlite"), &bench.path("store"), Vec::new(), more)
    }

    /// The same with a ledger and a store elsewhere, which the variables of `environment` open.
    #[track_caller]
    pub fn start_on(
        ledger: &str,
        store: &str,
        environment: Vec<(&'static str, String)>,
        more: &[&str],
    ) -> Self {
        let lease: &[&str] = if more.contains(&"--lease") { &[] } else { &["--lease", LEASE_SECONDS] };
        let options = ["--ledger", ledger, "--store", store];
        let options: Vec<String> = options.iter().chain(lease).chain(more).map(ToString::to_string).collect();
        let coordinator = listening("127.0.0.1:0", &environment, &options);
        let url = said_url(&coordinator).expect("it listens");
        Self { url, environment, options, coordinator }
    }

    /// The variables that its processes have.
    pub fn environment(&self) -> &[(&'static str, String)] {
        &self.environment
    }

    /// Its address.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// The coordinator's process.
    pub fn coordinator(&mut self) -> &mut Running {
        &mut self.coordinator
    }

    /// What the coordinator has said so far.
    pub fn coordinator_stderr(&self) -> String {
        self.coordinator.stderr()
    }

    /// Kills the coordinator and, when this client misses it, starts another on the same ledger and address.
    #[track_caller]
    pub fn kill_and_restart(&mut self, client: &Running) {
        let outages = || client.stderr().matches("the coordinator does not answer").count();
        let before = outages();
        assert!(self.coordinator.is_running() && send("KILL", self.coordinator.pid()));
        assert!(wait_until(READY, || !self.coordinator.is_running()), "it cannot be killed");
        assert!(wait_until(READY, || outages() > before), "nobody misses it: {}", client.stderr());
        let address = self.url.rsplit('/').next().expect("an address").to_owned();
        self.coordinator = listening(&address, &self.environment, &self.options);
    }

    /// Starts a worker.
    pub fn worker(&self, more: &[&str]) -> Running {
        let given = ["worker", "--coordinator", &self.url, "--threads", "1"];
        Running::start_in(&self.environment, given.iter().chain(more))
    }

    /// Starts a worker with this fault, as `worker/src/fault_point.rs` has them.
    pub fn faulty_worker(&self, fault: &str, more: &[&str]) -> Running {
        let mut environment = self.environment.clone();
        environment.push(("PLANESWEEP_FAULT", fault.to_owned()));
        let given = ["worker", "--coordinator", &self.url, "--threads", "1"];
        Running::start_in(&environment, given.iter().chain(more))
    }

    /// What `planesweep status` says of a run.
    #[track_caller]
    pub fn status(&self, run: &str, more: &[&str]) -> Value {
        let given = ["status", run, "--coordinator", &self.url, "--json"];
        Running::start_in(&self.environment, given.iter().chain(more)).wait().expect_one_of(&[0, 3]).json()
    }

    /// Ends the coordinator as a service manager does; it takes its workers with it.
    pub fn drain(self) -> Running {
        assert!(send("TERM", self.coordinator.pid()), "{}", self.coordinator.stderr());
        self.coordinator
    }
}

#[track_caller]
fn listening(address: &str, environment: &[(&'static str, String)], options: &[String]) -> Running {
    let given = ["coordinator", "--listen", address].map(str::to_owned);
    let mut coordinator = Running::start_in(environment, given.iter().chain(options));
    let is_ready = wait_until(READY, || said_url(&coordinator).is_some() || !coordinator.is_running());
    assert!(is_ready && coordinator.is_running(), "no coordinator: {}", coordinator.stderr());
    coordinator
}

fn said_url(coordinator: &Running) -> Option<String> {
    let said = coordinator.stderr();
    let (line, _) = said.split_once("listening on ")?.1.split_once('\n')?;
    Some(line.to_owned())
}
