//! `planesweep reconstruct`: the whole way on one host.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use planesweep_coordinator::{Config, Coordinator};
use planesweep_mvsnet::Refinement;
use planesweep_proto::{Client, Role};
use planesweep_store::Store;

use super::export::{self, Finished};
use crate::args::{FilterArgs, NetworkArgs, PlanArgs, ReadArgs};
use crate::computation::{Computation, Computed};
use crate::console::{Outcome, counted};
use crate::interrupts::Interrupts;
use crate::network::{Placement, backend_factory, default_workers, processors};
use crate::out_folder::check_out;
use crate::prepare::{Network, Prepared, Stages};
use crate::supervisor::Supervisor;

/// Arguments of `reconstruct`.
#[derive(Debug, Args)]
#[command(
    after_help = "SCENE is a COLMAP project (images/ and sparse/ or sparse/0/) or an MVSNet folder (images/ \
    and cams/).\nExample: planesweep reconstruct my-colmap-project -o out --max-size 1152"
)]
pub struct ReconstructArgs {
    /// The scene.
    pub scene: PathBuf,
    /// Where the result goes; an interrupted run in the same folder is resumed.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Worker processes; by default as many as make the machine busy and fit into its memory.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub workers: Option<u32>,
    /// One more worker process does everything but inference, and the others only infer; their depth
    /// maps reach it through shared memory. Changes no bit of the result.
    #[arg(long)]
    pub fusion_worker: bool,
    /// Threads of each worker's inference; by default the processors are shared evenly.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Folder with a mask per view, NAME.png or STEM.png: what is black there gets no depth. By default
    /// STEM.mask.png beside the photographs.
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Forget what an earlier run in the same folder has done.
    #[arg(long)]
    pub fresh: bool,
    #[command(flatten)]
    pub network: NetworkArgs,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub filter: FilterArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// The worker processes of a run.
struct Team {
    roles: Vec<Role>,
    placement: Placement,
    verbose: u8,
}

/// Reconstructs a scene.
pub fn run(args: &ReconstructArgs, json: bool, verbose: u8) -> Result<Outcome> {
    let begun = Instant::now();
    let mut stages = Stages::new();
    let network = Network::read(args.network.weights.as_deref(), &args.network.device)?;
    // The workers make their own; this one only says at once when the device is not there.
    let placement = Placement { device: args.network.device.clone(), threads: 1, memory_bytes: None };
    let factory = backend_factory(&placement)?;
    drop(factory(&network.bytes).map_err(|e| anyhow!("cannot use device {}: {e}", placement.device))?);
    check_out(&args.out, &args.scene)?;
    let refined = network.weights.metadata().refinement != Refinement::None;
    let options = args.plan.options(Some(&args.filter));
    let prepared = Prepared::new(
        &args.scene,
        network,
        &options,
        &args.read.options(),
        args.masks.as_deref(),
        &mut stages,
    )?;
    let workers = args.workers.unwrap_or_else(|| default_workers(&prepared.plan, &placement.device, refined));
    let placement = Placement {
        threads: args.threads.map_or((processors() / workers as usize).max(1), |threads| threads as usize),
        memory_bytes: args.network.memory.map(|bytes| bytes / u64::from(workers)),
        ..placement
    };
    if !json {
        eprintln!(
            "{} views to infer, {} left out, {}",
            prepared.plan.views.len(),
            prepared.left_out(),
            counted(workers, "worker")
        );
    }

    let (state, _lock) = open_state(&args.out, args.fresh)?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    let team = Team { roles: roles(workers, args.fusion_worker), placement, verbose };
    let (store, computed) = runtime.block_on(compute(&state, &prepared, &team, &mut stages))?;
    export::run(&Finished::new(&args.out, &prepared, &store, &runtime, &computed), stages, begun)
}

/// What each worker process does.
fn roles(workers: u32, fusion_worker: bool) -> Vec<Role> {
    let mut roles = vec![if fusion_worker { Role::Infer } else { Role::Both }; workers as usize];
    roles.extend(fusion_worker.then_some(Role::Fuse));
    roles
}

/// Has all jobs done by worker processes; returns what came of them, and the store that holds it.
async fn compute(
    state: &Path,
    prepared: &Prepared,
    team: &Team,
    stages: &mut Stages,
) -> Result<(Store, Computed)> {
    let store = Store::open(&format!("file://{}", state.join("store").display()))?;
    store.put(prepared.network.bytes.clone().into()).await.context("cannot store the weights")?;
    let config = Config::new(state.join("ledger.sqlite"), store.url());
    let coordinator = Coordinator::start(config).await.context("cannot start the coordinator")?;
    let interrupts = Interrupts::default();
    interrupts.clone().listen(
        "stopping when the running jobs are done; Ctrl-C again stops at once",
        Some("stopping at once"),
    );
    let begun = Instant::now();
    let client = Client::connect(&coordinator.url(), None).context("cannot call the coordinator")?;
    let computation = Computation { client, store: &store, prepared, exclusive: true };
    let mut supervisor = None;
    let start_workers = |_: &_| {
        if supervisor.is_none() {
            let Team { roles, placement, verbose } = team;
            supervisor = Some(Supervisor::start(roles, &coordinator.url(), placement, *verbose)?);
        }
        Ok(())
    };
    let computed = computation.run(&interrupts.drain, start_workers).await?;
    stages.push(("compute".to_owned(), begun.elapsed().as_secs_f64()));
    if let Some(supervisor) = supervisor {
        if computed.is_some() {
            supervisor.finish(&interrupts.kill).await;
        } else {
            supervisor.stop(&interrupts.kill).await;
        }
    }
    coordinator.shutdown().await;
    interrupts.computed.cancel();
    let computed = computed.context("stopped; run the same command again to go on")?;
    Ok((store, computed))
}

/// The folder of ledger and store, locked for this process.
fn open_state(out: &Path, fresh: bool) -> Result<(PathBuf, File)> {
    let state = out.join(".planesweep");
    fs::create_dir_all(&state).with_context(|| format!("cannot make the folder {}", state.display()))?;
    let state = state.canonicalize().with_context(|| format!("cannot find {}", state.display()))?;
    let path = state.join("lock");
    let lock = File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
    if lock.try_lock().is_err() {
        bail!("another planesweep works in {}", out.display());
    }
    if fresh {
        for entry in fs::read_dir(&state).with_context(|| format!("cannot list {}", state.display()))? {
            let entry = entry.with_context(|| format!("cannot list {}", state.display()))?.path();
            let is_lock = entry == path;
            let removed = match entry.is_dir() {
                true => fs::remove_dir_all(&entry),
                false if is_lock => Ok(()),
                false => fs::remove_file(&entry),
            };
            removed.with_context(|| format!("cannot remove {}", entry.display()))?;
        }
    }
    Ok((state, lock))
}
