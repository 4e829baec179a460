//! `planesweep worker`.

use std::fmt;
use std::io::Read;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use planesweep_plan::WorkerId;
use planesweep_proto::{Role, Slots};
use planesweep_worker::{ExchangeConfig, ExchangeError, WorkerConfig, WorkerError, run_worker};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::args::values::{bytes, device};
use crate::args::{ConnectArgs, ServerTlsArgs};
use crate::console::Outcome;
use crate::host;
use crate::network::{Placement, backend_factory, processors};

/// Arguments of `worker`.
#[derive(Debug, Args)]
#[command(
    // Scripts give some, and whoever calls them may give them anew.
    args_override_self = true,
    after_help = "An option that is given twice counts as it is given last.\n\
    Exit codes: 0 the coordinator said stop; 75 a SIGTERM did, start it again elsewhere; 78 the coordinator refuses it \
    (token, version), or it may not serve its maps as it is told, do not start it again; 1 anything else.\n\
    Example: planesweep worker --coordinator http://10.0.0.1:7070 --role both"
)]
pub struct WorkerArgs {
    #[command(flatten)]
    pub connect: ConnectArgs,
    /// Which jobs it takes.
    #[arg(long, value_enum, default_value = "both")]
    pub role: RoleArg,
    /// Where other workers fetch the maps that this one has in memory, such as 10.0.0.2:7071; port 0 takes
    /// a free one, and 0.0.0.0 is found by the host's name. Beyond this host a token is needed.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:0")]
    pub listen: SocketAddr,
    #[command(flatten)]
    pub tls: ServerTlsArgs,
    /// Send no maps through shared memory to the fusion worker of this host.
    #[arg(long)]
    pub no_shared_memory: bool,
    /// Where to infer: cpu, torch, cuda or cuda:N; `analytic` is a test double that knows a plane.
    #[arg(long, default_value = "cpu", value_parser = device)]
    pub device: String,
    /// Threads of an inference; by default all processors.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Memory for inference, such as 800M or 2G.
    #[arg(long, value_name = "SIZE", value_parser = bytes)]
    pub memory: Option<u64>,
    /// Where photographs are kept that come from the store, because they do not lie under their paths here; all
    /// workers of a host may share it. By default planesweep/photographs in the user's cache folder.
    #[arg(long, env = "PLANESWEEP_CACHE", value_name = "DIR", default_value_os_t = cache_folder())]
    pub cache: PathBuf,
    /// How much is kept there; what was not used for the longest time goes first.
    #[arg(long, value_name = "SIZE", default_value = "8G", value_parser = bytes)]
    pub cache_size: u64,
    /// Stop when standard input ends, that is, when the process that started this one is gone.
    #[arg(long, hide = true)]
    pub stop_with_stdin: bool,
}

/// Which jobs a worker takes, on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum RoleArg {
    /// Inference only.
    Infer,
    /// Everything but inference.
    Fuse,
    /// Every job.
    Both,
}

/// One inference runs, the next one loads its images.
const SLOTS: Slots = Slots { infer: 2, fuse: 2 };
/// Budget of images, and of depth maps.
const CACHE_BYTES: u64 = 256 << 20;

/// The worker was told to go by a signal, not by the coordinator: its work is not done.
#[derive(Debug)]
struct Terminated;

impl fmt::Display for Terminated {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("stopped by SIGTERM; another worker may take its place")
    }
}

/// The exit codes that tell whoever places workers what to do next; they are those of sysexits.h.
pub fn exit_code(error: &anyhow::Error) -> Option<u8> {
    const TEMPFAIL: u8 = 75;
    const CONFIG: u8 = 78;
    match error.downcast_ref() {
        // Elsewhere, or later, it may get what it listens on.
        Some(WorkerError::Exchange(ExchangeError::Listen { .. })) => None,
        Some(WorkerError::Refused { .. } | WorkerError::Exchange(_)) => Some(CONFIG),
        _ => error.is::<Terminated>().then_some(TEMPFAIL),
    }
}

/// Works until told to stop.
pub fn run(args: WorkerArgs) -> Result<Outcome> {
    let role = match args.role {
        RoleArg::Infer => Role::Infer,
        RoleArg::Fuse => Role::Fuse,
        RoleArg::Both => Role::Both,
    };
    let host = host::name();
    let coordinator = args.connect.coordinator.clone();
    // Those that `reconstruct` starts are its own affair.
    let is_on_its_own = !args.stop_with_stdin;
    let connected = Box::new(move |maps: &str| {
        if is_on_its_own {
            let Slots { infer, fuse } = SLOTS;
            let slots = match role {
                Role::Infer => format!("{infer} for inference"),
                Role::Fuse => format!("{fuse} for fusion"),
                Role::Both => format!("{infer} for inference, {fuse} for fusion"),
            };
            eprintln!("working for {coordinator} as {role}; slots: {slots}; maps are served at {maps}");
        }
    });
    // A new one for every life of the process.
    let nonce = host::unique().context("cannot make an id for this worker")?;
    let config = WorkerConfig {
        coordinator: args.connect.coordinator,
        credentials: args.connect.credentials.read()?,
        id: WorkerId(format!("{host}-{}-{}", std::process::id(), &nonce[..8.min(nonce.len())])),
        host,
        boot_id: host::boot_id(),
        role,
        backend: backend_factory(&Placement {
            device: args.device.clone(),
            threads: args.threads.map_or_else(processors, |threads| threads as usize),
            memory_bytes: args.memory,
        })?,
        connected,
        device: args.device,
        slots: SLOTS,
        cache_bytes: CACHE_BYTES,
        disk_cache: (args.cache, args.cache_size),
        exchange: ExchangeConfig {
            listen: args.listen,
            tls: args.tls.read()?,
            shared_memory: !args.no_shared_memory,
        },
    };
    let id = config.id.0.clone();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("cannot start the runtime")?;
    let terminated = CancellationToken::new();
    runtime.block_on(async {
        let stop = terminated.child_token();
        stop_on_signal(terminated.clone())?;
        if args.stop_with_stdin {
            let stop = stop.clone();
            std::thread::spawn(move || {
                let mut sink = Vec::new();
                // Nothing is ever written; the end of the stream is the message.
                let _ = std::io::stdin().read_to_end(&mut sink);
                stop.cancel();
            });
        }
        run_worker(config, stop).await.context("the worker ended")
    })?;
    // A forward pass cannot be interrupted, so its thread may still run: leave without it.
    runtime.shutdown_background();
    if terminated.is_cancelled() {
        return Err(anyhow::Error::msg(Terminated));
    }
    Ok(Outcome { text: String::new(), value: json!({ "worker": id }), skipped_views: false })
}

/// Beside what the program's scripts keep.
fn cache_folder() -> PathBuf {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let users = set("XDG_CACHE_HOME").or_else(|| Some(set("HOME")?.join(".cache")));
    users.unwrap_or_else(std::env::temp_dir).join("planesweep/photographs")
}

/// Ctrl-C reaches the whole group of processes; whoever started this one decides what it means.
fn stop_on_signal(stop: CancellationToken) -> Result<()> {
    let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())
        .context("cannot listen for SIGTERM")?;
    tokio::spawn(async move {
        loop {
            tokio::select! {
                _ = terminate.recv() => stop.cancel(),
                _ = tokio::signal::ctrl_c() => {}
            }
        }
    });
    Ok(())
}
