//! Worker processes on this host: started, watched, replaced when they die, stopped at the end.

use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use anyhow::{Context, Result};
use planesweep_proto::Role;
use tokio::process::{Child, Command};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::network::Placement;

/// A worker that dies at once is not started again at once.
const RESTART_PAUSE: Duration = Duration::from_millis(500);
/// How long a worker may take to go when nothing is left to do; one that takes longer is frozen.
const LAST_GRACE: Duration = Duration::from_secs(10);

/// The workers of one run.
pub struct Supervisor {
    slots: JoinSet<()>,
    orders: Orders,
}

#[derive(Clone)]
struct Orders {
    stop: CancellationToken,
    kill: CancellationToken,
}

impl Supervisor {
    /// Starts a worker of each of these roles for the coordinator at `url`.
    ///
    /// Each holds the reading end of a pipe from this process, so it notices when this one is gone,
    /// however that happened.
    pub fn start(roles: &[Role], url: &str, placement: &Placement, verbose: u8) -> Result<Self> {
        let program = std::env::current_exe().context("cannot find the program to start workers with")?;
        let orders = Orders { stop: CancellationToken::new(), kill: CancellationToken::new() };
        let mut slots = JoinSet::new();
        for (slot, role) in (0..).zip(roles) {
            let mut command = Command::new(&program);
            command.args(["worker", "--stop-with-stdin", "--coordinator", url, "--role", &role.to_string()]);
            command.args(["--device", &placement.device, "--threads", &placement.threads.to_string()]);
            if let Some(bytes) = placement.memory_bytes {
                command.args(["--memory", &bytes.to_string()]);
            }
            command.args(std::iter::repeat_n("-v", verbose.into()));
            // These are for coordinators elsewhere; this one is on the loopback interface, without TLS.
            for variable in ["PLANESWEEP_TLS_CA", "PLANESWEEP_TLS_CERT", "PLANESWEEP_TLS_KEY"] {
                command.env_remove(variable);
            }
            command.stdin(Stdio::piped()).stdout(Stdio::null()).kill_on_drop(true);
            slots.spawn(keep_alive(slot, command, orders.clone()));
        }
        Ok(Self { slots, orders })
    }

    /// Stops the workers of a run that is finished: they have nothing left to do, so one that does not
    /// go is ended.
    pub async fn finish(self, at_once: &CancellationToken) {
        let at_once = at_once.child_token();
        let too_late = at_once.clone();
        let grace = tokio::spawn(async move {
            tokio::time::sleep(LAST_GRACE).await;
            too_late.cancel();
        });
        self.stop(&at_once).await;
        grace.abort();
    }

    /// Tells all workers to end what they do and waits for them; cancelling `at_once` ends them.
    pub async fn stop(mut self, at_once: &CancellationToken) {
        self.orders.stop.cancel();
        loop {
            tokio::select! {
                ended = self.slots.join_next() => if ended.is_none() { return },
                () = at_once.cancelled(), if !self.orders.kill.is_cancelled() => self.orders.kill.cancel(),
            }
        }
    }
}

/// Runs one worker after the other until told to stop.
async fn keep_alive(slot: u32, mut command: Command, orders: Orders) {
    let stop = &orders.stop;
    while !stop.is_cancelled() {
        match command.spawn() {
            Ok(child) => match watch(child, &orders).await {
                Ok(status) if !stop.is_cancelled() => {
                    tracing::warn!(slot, %status, "a worker ended before its time, starting another");
                }
                Ok(_) => {}
                Err(error) => tracing::warn!(slot, %error, "cannot watch a worker"),
            },
            Err(error) => tracing::warn!(slot, %error, "cannot start a worker"),
        }
        tokio::select! {
            () = stop.cancelled() => {}
            () = tokio::time::sleep(RESTART_PAUSE) => {}
        }
    }
}

async fn watch(mut child: Child, orders: &Orders) -> std::io::Result<ExitStatus> {
    // `wait` would close the pipe at once.
    let pipe = child.stdin.take();
    tokio::select! {
        status = child.wait() => return status,
        () = orders.stop.cancelled() => drop(pipe),
    }
    tokio::select! {
        status = child.wait() => return status,
        () = orders.kill.cancelled() => child.start_kill()?,
    }
    child.wait().await
}
