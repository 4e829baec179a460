//! `planesweep coordinator`.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Args;
use planesweep_coordinator::{Config, Coordinator, ServedStore};
use planesweep_store::Objects;
use serde_json::json;
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::args::values::seconds;
use crate::args::{ServerTlsArgs, TokenArgs, store_url};
use crate::console::Outcome;
use crate::host::unique;

/// Arguments of `coordinator`.
#[derive(Debug, Args)]
#[command(
    after_help = "SIGTERM or Ctrl-C drains: workers end what they hold and go, then it goes itself; a second one \
    stops at once. In both cases, and when it is killed, it goes on from its ledger.\n\
    Example: planesweep coordinator --listen 0.0.0.0:7070 --token-file token --ledger ledger.sqlite --store /shared/store"
)]
pub struct CoordinatorArgs {
    /// Where to listen; other hosts are let in with a token only. Port 0 takes a free one.
    #[arg(long, env = "PLANESWEEP_LISTEN", default_value = "127.0.0.1:7070", value_name = "ADDRESS")]
    pub listen: SocketAddr,
    /// What knows every job: an SQLite file, made when it is not there, or a database that several
    /// coordinators share, postgres://user:password@host/database.
    #[arg(long, env = "PLANESWEEP_LEDGER", hide_env_values = true, value_name = "FILE|URL")]
    pub ledger: String,
    /// Where results lie: a folder, or an object store such as s3://bucket/prefix. Workers and clients that do
    /// not reach it get and send their blobs through the coordinator.
    #[arg(long, env = "PLANESWEEP_STORE", value_name = "URL", value_parser = store_url)]
    pub store: String,
    #[command(flatten)]
    pub token: TokenArgs,
    #[command(flatten)]
    pub tls: ServerTlsArgs,
    /// How long a worker that does not report keeps its jobs; all other times follow from it.
    #[arg(long, default_value = "7", value_name = "SECONDS", value_parser = seconds)]
    pub lease: Duration,
}

/// Serves until told to stop.
pub fn run(args: &CoordinatorArgs) -> Result<Outcome> {
    let store = Objects::open(&args.store)?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    let new_identity = unique().context("cannot make an identity for the store")?;
    let config = Config {
        listen: args.listen,
        lease: args.lease,
        token: args.token.read()?,
        served: Some(ServedStore { store: store.clone(), new_identity }),
        tls: args.tls.read()?,
        ..Config::new(&*args.ledger, store.url())
    };
    let url = runtime.block_on(serve(config))?;
    Ok(Outcome { text: String::new(), value: json!({ "url": url }), skipped_views: false })
}

async fn serve(config: Config) -> Result<String> {
    let mut signals = Signals::new()?;
    let coordinator = Coordinator::start(config).await.context("cannot start the coordinator")?;
    let url = coordinator.url();
    eprintln!("listening on {url}");
    signals.next().await;
    eprintln!("stopping when the running jobs are done; once more stops at once");
    coordinator.drain().await?;
    tokio::select! {
        drained = coordinator.drained() => drained?,
        () = signals.next() => eprintln!("stopping at once"),
    }
    coordinator.shutdown().await;
    Ok(url)
}

/// What ends a coordinator.
struct Signals {
    terminate: Signal,
    interrupt: Signal,
}

impl Signals {
    fn new() -> Result<Self> {
        let listen = |kind| signal(kind).context("cannot listen for signals");
        Ok(Self { terminate: listen(SignalKind::terminate())?, interrupt: listen(SignalKind::interrupt())? })
    }

    async fn next(&mut self) {
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
        }
    }
}
