//! `planesweep reconstruct`: the whole way on one host.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use planesweep_coordinator::{Config, Coordinator, Handle};
use planesweep_mvsnet::{Refinement, Weights};
use planesweep_plan::{BlobKey, Job, JobId, Plan, RunId, jobs, plan};
use planesweep_proto::{JobResult, JobState, RunStatus, SubmitHeader};
use planesweep_worker::Store;
use tokio_util::sync::CancellationToken;

use super::export::{self, Finished};
use crate::args::{FilterArgs, NetworkArgs, PlanArgs, ReadArgs};
use crate::console::{Outcome, Progress};
use crate::input::{self, Input};
use crate::network::{
    Placement, backend_factory, default_workers, processors, weights_for, weights_or_default,
};
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
    /// Threads of each worker's inference; by default the processors are shared evenly.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
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

/// How often progress is asked for.
const POLL: Duration = Duration::from_millis(200);
/// A run whose results vanish from the store more often than this has a broken disk.
const MAX_REPAIRS: u32 = 3;

/// Seconds of each stage, in order.
pub type Stages = Vec<(String, f64)>;

/// Everything that is decided before the first job.
pub struct Prepared {
    pub input: Input,
    pub plan: Plan,
    pub weights: Weights,
    pub weights_key: BlobKey,
    pub jobs: Vec<Job>,
}

/// The worker processes of a run.
struct Team {
    workers: u32,
    placement: Placement,
    verbose: u8,
}

/// Reconstructs a scene.
pub fn run(args: &ReconstructArgs, json: bool, verbose: u8) -> Result<Outcome> {
    let begun = Instant::now();
    let mut stages = Stages::new();
    let (weights_bytes, weights) = weights_or_default(args.network.weights.as_deref())?;
    let weights_bytes = weights_for(&args.network.device, weights_bytes);
    // The workers make their own; this one only says at once when the device is not there.
    let placement = Placement { device: args.network.device.clone(), threads: 1, memory_bytes: None };
    let factory = backend_factory(&placement)?;
    drop(factory(&weights_bytes).map_err(|e| anyhow!("cannot use device {}: {e}", placement.device))?);
    check_out(args)?;
    let input = timed(&mut stages, "read images", || input::read(&args.scene, &args.read.options()))?;
    for warning in &input.scene.warnings {
        eprintln!("warning: {warning}");
    }
    let options = args.plan.options(Some(&args.filter));
    let plan = timed(&mut stages, "plan", || Ok(plan(&input.scene, &options)))?;
    if plan.views.is_empty() {
        bail!("no view can be reconstructed; `planesweep inspect {}` says why", args.scene.display());
    }
    let weights_key = BlobKey::of(&weights_bytes);
    let jobs = jobs(&input.scene, &plan, &input.image_hashes, weights_key)?;
    let refined = weights.metadata().refinement != Refinement::None;
    let workers = args.workers.unwrap_or_else(|| default_workers(&plan, &placement.device, refined));
    let placement = Placement {
        threads: args.threads.map_or((processors() / workers as usize).max(1), |threads| threads as usize),
        memory_bytes: args.network.memory.map(|bytes| bytes / u64::from(workers)),
        ..placement
    };
    if !json {
        eprintln!(
            "{} views to infer, {} left out, {workers} workers",
            plan.views.len(),
            input.skipped.len() + plan.skipped.len()
        );
    }
    let prepared = Prepared { input, plan, weights, weights_key, jobs };

    let (state, _lock) = open_state(&args.out, args.fresh)?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    let (store, results) = runtime.block_on(compute(
        args,
        &state,
        weights_bytes,
        &prepared,
        Team { workers, placement, verbose },
        &mut stages,
    ))?;
    export::run(&Finished::new(args, &prepared, &store, &runtime, &results), stages, begun)
}

fn timed<T>(stages: &mut Stages, name: &str, f: impl FnOnce() -> Result<T>) -> Result<T> {
    let begun = Instant::now();
    let value = f()?;
    stages.push((name.to_owned(), begun.elapsed().as_secs_f64()));
    Ok(value)
}

/// Has all jobs done by worker processes; returns their results, whose blobs are all in the store.
async fn compute(
    args: &ReconstructArgs,
    state: &Path,
    weights: Vec<u8>,
    prepared: &Prepared,
    team: Team,
    stages: &mut Stages,
) -> Result<(Store, Vec<JobResult>)> {
    let store = Store::open(&format!("file://{}", state.join("store").display()))?;
    store.put(weights.into()).await.context("cannot store the weights")?;
    let config = Config::new(state.join("ledger.sqlite"), store.url());
    let coordinator = Coordinator::start(config).await.context("cannot start the coordinator")?;
    let interrupts = Interrupts::default();
    interrupts.clone().listen();
    let begun = Instant::now();
    let mut missing: Vec<JobId> = Vec::new();
    let mut supervisor = None;
    for _ in 0..=MAX_REPAIRS {
        let header = SubmitHeader {
            name: args.scene.display().to_string(),
            exclusive: true,
            missing_results: std::mem::take(&mut missing),
        };
        let submitted =
            coordinator.submit(header, prepared.jobs.clone()).await.context("cannot submit the jobs")?;
        if submitted.reused > 0 {
            eprintln!("{} of {} jobs are done already", submitted.reused, submitted.jobs);
        }
        missing = lost_results(&coordinator, &submitted.run, &store).await?;
        if missing.is_empty() && !coordinator.status(&submitted.run, 0).await?.finished {
            if supervisor.is_none() {
                let Team { workers, placement, verbose } = &team;
                supervisor = Some(Supervisor::start(*workers, &coordinator.url(), placement, *verbose)?);
            }
            if follow(&coordinator, &submitted.run, &interrupts.drain, prepared).await? {
                if let Some(supervisor) = supervisor.take() {
                    supervisor.stop(&interrupts.kill).await;
                }
                coordinator.shutdown().await;
                bail!("stopped; run the same command again to go on");
            }
            missing = lost_results(&coordinator, &submitted.run, &store).await?;
        }
        if missing.is_empty() {
            let results = coordinator.results(&submitted.run).await.context("cannot read the ledger")?;
            stages.push(("compute".to_owned(), begun.elapsed().as_secs_f64()));
            if let Some(supervisor) = supervisor.take() {
                supervisor.finish(&interrupts.kill).await;
            }
            coordinator.shutdown().await;
            interrupts.computed.cancel();
            return Ok((store, results));
        }
        eprintln!("{} results in the store are lost or damaged and are made again", missing.len());
    }
    bail!("results keep vanishing from the store at {}", store.url());
}

/// Done jobs whose results are not in the store, or not as they were written.
async fn lost_results(coordinator: &Handle, run: &RunId, store: &Store) -> Result<Vec<JobId>> {
    let mut lost = Vec::new();
    for result in coordinator.results(run).await.context("cannot read the ledger")? {
        let Some((key, _)) = &result.blob else { continue };
        match store.get(key).await {
            Ok(_) => {}
            Err(error) if error.is_lost() => lost.push(result.job),
            Err(error) => return Err(error).context("cannot read the store"),
        }
    }
    Ok(lost)
}

/// Refuses an output folder that would be written over the scene or cannot be named on the wire.
fn check_out(args: &ReconstructArgs) -> Result<()> {
    fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot make the folder {}", args.out.display()))?;
    let out = args.out.canonicalize().with_context(|| format!("cannot find {}", args.out.display()))?;
    if args.scene.canonicalize().is_ok_and(|scene| scene == out) {
        bail!("the result would be written over the scene; choose another folder for -o");
    }
    if out.to_str().is_none() {
        bail!("the path of {} is not UTF-8; choose another folder for -o", out.display());
    }
    Ok(())
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

/// Shows progress until the run is finished (`false`) or the user wants to stop (`true`).
async fn follow(
    coordinator: &Handle,
    run: &RunId,
    drain: &CancellationToken,
    prepared: &Prepared,
) -> Result<bool> {
    let mut progress = Progress::new(prepared.jobs.len() as u64);
    let mut after = 0;
    let mut was_waiting = false;
    let (mut inferred, mut infer_seconds) = (0_u32, 0.0);
    loop {
        let status = coordinator.status(run, after).await.context("cannot ask how far the run is")?;
        for result in &status.recent {
            after = after.max(result.ended);
            let name =
                result.view.and_then(|id| prepared.input.scene.views.get(&id)).map(|v| v.name.as_str());
            if let (JobState::Failed, Some((_, message))) = (result.state, &result.failure) {
                progress.say(&format!("{} of {}: {message}", result.kind, name.unwrap_or("the cloud")));
            }
            if result.kind == "infer" && result.state == JobState::Done {
                inferred += 1;
                infer_seconds += result.measurements.get("network_seconds").unwrap_or(&result.seconds);
            }
        }
        let each = if inferred > 0 { infer_seconds / f64::from(inferred) } else { 0.0 };
        progress.show(
            status.count(JobState::Done) + status.count(JobState::Failed),
            format!("{}, {each:.1} s each", inferences_done(&status)),
        );
        if status.waiting.is_some_and(|w| w > Duration::from_secs(15)) != was_waiting {
            was_waiting = !was_waiting;
            progress.say(if was_waiting {
                "no worker is alive; waiting for one"
            } else {
                "workers are back"
            });
        }
        if status.finished || drain.is_cancelled() {
            progress.finish();
            return Ok(!status.finished);
        }
        tokio::select! {
            () = tokio::time::sleep(POLL) => {}
            () = drain.cancelled() => {}
        }
    }
}

fn inferences_done(status: &RunStatus) -> String {
    let of = |wanted: Option<JobState>| -> u64 {
        let counts = status.counts.iter();
        counts
            .filter(|((kind, state), _)| kind == "infer" && wanted.is_none_or(|w| w == *state))
            .map(|(_, n)| n)
            .sum()
    };
    format!("{} of {} inferences", of(Some(JobState::Done)), of(None))
}

/// What Ctrl-C means at the moment.
#[derive(Clone, Default)]
struct Interrupts {
    /// The first: running jobs are ended, the run can be resumed.
    drain: CancellationToken,
    /// The second: workers are ended at once; the run can still be resumed.
    kill: CancellationToken,
    /// All is computed: now it just ends the program, for files are complete or absent.
    computed: CancellationToken,
}

impl Interrupts {
    fn listen(self) {
        tokio::spawn(async move {
            while tokio::signal::ctrl_c().await.is_ok() {
                if self.computed.is_cancelled() || self.kill.is_cancelled() {
                    std::process::exit(1);
                } else if self.drain.is_cancelled() {
                    self.kill.cancel();
                    eprintln!("stopping at once");
                } else {
                    self.drain.cancel();
                    eprintln!("stopping when the running jobs are done; Ctrl-C again stops at once");
                }
            }
        });
    }
}
