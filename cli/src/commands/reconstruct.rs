//! `planesweep reconstruct`: the whole way on one host.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use planesweep_coordinator::{Config, Coordinator, Handle};
use planesweep_mvsnet::Weights;
use planesweep_plan::{BlobKey, Job, JobId, Plan, RunId, jobs, plan};
use planesweep_proto::{JobResult, JobState, RunStatus, SubmitHeader};
use planesweep_worker::Store;
use tokio_util::sync::CancellationToken;

use super::export::{self, Finished};
use crate::args::ReconstructArgs;
use crate::console::{Outcome, Progress};
use crate::input::{self, Input};
use crate::network::{backend_factory, default_workers, read_weights};
use crate::supervisor::Supervisor;

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

/// Reconstructs a scene.
pub fn run(args: &ReconstructArgs, json: bool) -> Result<Outcome> {
    let begun = Instant::now();
    let mut stages = Stages::new();
    // The workers make their own; this only refuses a wrong name before any work.
    drop(backend_factory(&args.network.device)?);
    let (weights_bytes, weights) = read_weights(&args.network.weights)?;
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
    let workers = args.workers.unwrap_or_else(|| default_workers(&plan));
    if !json {
        eprintln!(
            "{} views to infer, {} left out, {workers} workers",
            plan.views.len(),
            input.skipped.len() + plan.skipped.len()
        );
    }
    let prepared = Prepared { input, plan, weights, weights_key, jobs };

    let state = args.out.join(".planesweep");
    if args.fresh && state.exists() {
        fs::remove_dir_all(&state).with_context(|| format!("cannot remove {}", state.display()))?;
    }
    fs::create_dir_all(&state).with_context(|| format!("cannot make the folder {}", state.display()))?;
    let state = state.canonicalize().with_context(|| format!("cannot resolve {}", state.display()))?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    let (store, results) =
        runtime.block_on(compute(args, &state, weights_bytes, &prepared, workers, &mut stages))?;
    let finished =
        Finished { args, prepared: &prepared, store: &store, results: &results, runtime: &runtime };
    export::run(&finished, stages, begun)
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
    workers: u32,
    stages: &mut Stages,
) -> Result<(Store, Vec<JobResult>)> {
    let store = Store::open(&format!("file://{}", state.join("store").display()))?;
    store.put(weights.into()).await.context("cannot store the weights")?;
    let config = Config::new(state.join("ledger.sqlite"), store.url());
    let coordinator = Coordinator::start(config).await.context("cannot start the coordinator")?;
    let (drain, kill) = (CancellationToken::new(), CancellationToken::new());
    listen_for_ctrl_c(drain.clone(), kill.clone());
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
        let is_finished = coordinator.status(&submitted.run, 0).await?.finished;
        if supervisor.is_none() && !is_finished {
            supervisor = Some(Supervisor::start(workers, &coordinator.url(), &args.network.device)?);
        }
        let interrupted = follow(&coordinator, &submitted.run, &drain, prepared).await?;
        if interrupted {
            if let Some(supervisor) = supervisor.take() {
                supervisor.stop(&kill).await;
            }
            coordinator.shutdown().await;
            bail!("stopped; run the same command again to go on");
        }
        let results = coordinator.results(&submitted.run).await.context("cannot read the ledger")?;
        for result in &results {
            if let Some((key, length)) = &result.blob
                && !store.has(key, *length).await?
            {
                missing.push(result.job);
            }
        }
        if missing.is_empty() {
            stages.push(("compute".to_owned(), begun.elapsed().as_secs_f64()));
            if let Some(supervisor) = supervisor.take() {
                supervisor.stop(&kill).await;
            }
            coordinator.shutdown().await;
            return Ok((store, results));
        }
        eprintln!("{} results are no longer in the store and are made again", missing.len());
    }
    bail!("results keep vanishing from the store at {}", store.url());
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
        let per_view = if inferred > 0 { infer_seconds / f64::from(inferred) } else { 0.0 };
        progress.show(
            status.count(JobState::Done) + status.count(JobState::Failed),
            format!("{}, {per_view:.1} s a view", depth_maps_done(&status)),
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

fn depth_maps_done(status: &RunStatus) -> String {
    let of = |wanted: Option<JobState>| -> u64 {
        let counts = status.counts.iter();
        counts
            .filter(|((kind, state), _)| kind == "infer" && wanted.is_none_or(|w| w == *state))
            .map(|(_, n)| n)
            .sum()
    };
    format!("{} of {} depth maps", of(Some(JobState::Done)), of(None))
}

/// The first Ctrl-C drains, the second ends at once; both leave a run that can be resumed.
fn listen_for_ctrl_c(drain: CancellationToken, kill: CancellationToken) {
    tokio::spawn(async move {
        for order in [drain, kill] {
            if tokio::signal::ctrl_c().await.is_err() {
                return;
            }
            order.cancel();
            eprintln!("stopping when the running jobs are done; Ctrl-C again stops at once");
        }
    });
}
