//! A plan's way through a coordinator, in this process or elsewhere: submitted, followed, its results
//! checked and made again where the store has lost them.

use std::time::Duration;

use anyhow::{Context, Result, bail};
use planesweep_plan::{JobId, RunId};
use planesweep_proto::{Client, JobResult, JobState, RunStatus, ServiceError, SubmitHeader, Submitted};
use planesweep_scene::ViewId;
use planesweep_store::Store;
use tokio_util::sync::CancellationToken;

use crate::console::Progress;
use crate::prepare::Prepared;

/// How often progress is asked for, and how long after a question without an answer the next one is.
const POLL: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(2));
/// A run whose results vanish from the store more often than this has a broken disk.
const MAX_REPAIRS: u32 = 3;
/// How long workers may be missing before it is said.
const WAITING: Duration = Duration::from_secs(15);

/// A plan, the coordinator that has it done, and the store that the results come to.
pub struct Computation<'a> {
    pub client: Client,
    pub store: &'a Store,
    pub prepared: &'a Prepared,
    /// Cancels every other run.
    pub exclusive: bool,
}

/// What came of it.
pub struct Computed {
    /// Of every job; all blobs are in the store.
    pub results: Vec<JobResult>,
    /// How many jobs an earlier run had done.
    pub reused: u32,
}

impl Computation<'_> {
    /// Has all jobs done; `None` when `stop` was cancelled first. `on_work` is told each run that has something to be
    /// done.
    pub async fn run(
        &self,
        stop: &CancellationToken,
        mut on_work: impl FnMut(&RunId) -> Result<()>,
    ) -> Result<Option<Computed>> {
        let mut missing: Vec<JobId> = Vec::new();
        let mut reused_before = None;
        for _ in 0..=MAX_REPAIRS {
            let Submitted { run, jobs, reused } = self.submit(std::mem::take(&mut missing)).await?;
            if reused > 0 {
                eprintln!("{reused} of {jobs} jobs are done already");
            }
            let Some(mut results) = results(&self.client, &run, stop).await? else { return Ok(None) };
            missing = self.lost(&results).await?;
            if missing.is_empty() && !results.iter().all(|result| has_ended(result.state)) {
                // What is reused later may be this command's own, and what was lost is not reused.
                reused_before.get_or_insert(reused);
                on_work(&run)?;
                let name_of = |view| self.prepared.view_name(view).map(str::to_owned);
                let Some(status) = follow(&self.client, &run, stop, name_of).await? else { return Ok(None) };
                if status.cancelled {
                    bail!("run {run} was cancelled");
                }
                match self::results(&self.client, &run, stop).await? {
                    Some(ended) => results = ended,
                    None => return Ok(None),
                }
                missing = self.lost(&results).await?;
            }
            if missing.is_empty() {
                return Ok(Some(Computed { results, reused: reused_before.unwrap_or(reused) }));
            }
            eprintln!("{} results in the store are lost or damaged and are made again", missing.len());
        }
        bail!("results keep vanishing from the store at {}", self.store.url());
    }

    /// Submits the plan once.
    pub async fn submit(&self, missing_results: Vec<JobId>) -> Result<Submitted> {
        let header =
            SubmitHeader { name: self.prepared.run_name(), exclusive: self.exclusive, missing_results };
        let mut client = self.client.clone();
        client.submit(&header, self.prepared.jobs.clone()).await.context("cannot submit the jobs")
    }

    /// Done jobs whose results are not in the store, or not as they were written.
    async fn lost(&self, results: &[JobResult]) -> Result<Vec<JobId>> {
        let mut lost = Vec::new();
        for result in results {
            let Some((key, _)) = &result.blob else { continue };
            if !self.store.holds(key).await.context("cannot read the store")? {
                lost.push(result.job);
            }
        }
        Ok(lost)
    }
}

fn has_ended(state: JobState) -> bool {
    !matches!(state, JobState::Open | JobState::Leased)
}

/// Every job of a run; `None` when `stop` was cancelled first.
async fn results(client: &Client, run: &RunId, stop: &CancellationToken) -> Result<Option<Vec<JobResult>>> {
    let ask = async || client.clone().results(run).await;
    patiently(stop, ask).await.context("cannot read the results of the run")
}

/// Shows progress until the run is finished; `None` when `stop` was cancelled first.
pub async fn follow(
    client: &Client,
    run: &RunId,
    stop: &CancellationToken,
    name_of: impl Fn(ViewId) -> Option<String>,
) -> Result<Option<RunStatus>> {
    let mut progress = None;
    let mut after = 0;
    let mut was_waiting = false;
    let (mut inferred, mut infer_seconds) = (0_u32, 0.0);
    loop {
        let ask = async || client.clone().status(run, after).await;
        let status = patiently(stop, ask).await.context("cannot ask how far the run is")?;
        let Some(status) = status else { return Ok(None) };
        let progress = progress.get_or_insert_with(|| Progress::new(status.counts.values().sum()));
        for result in &status.recent {
            after = after.max(result.ended);
            if let (JobState::Failed, Some((_, message))) = (result.state, &result.failure) {
                let of = result.view.map_or_else(
                    || "the cloud".to_owned(),
                    |view| name_of(view).unwrap_or_else(|| format!("view {view}")),
                );
                progress.say(&format!("{} of {of}: {message}", result.kind));
            }
            if result.kind == "infer" && result.state == JobState::Done {
                inferred += 1;
                infer_seconds += result.measurements.get("network_seconds").unwrap_or(&result.seconds);
            }
        }
        let each = if inferred > 0 { infer_seconds / f64::from(inferred) } else { 0.0 };
        progress.show(
            status.count(JobState::Done) + status.count(JobState::Failed),
            work_done(&status),
            &format!("{}, {each:.1} s each", inferences_done(&status)),
        );
        if status.waiting.is_some_and(|waiting| waiting > WAITING) != was_waiting {
            was_waiting = !was_waiting;
            progress.say(if was_waiting {
                "no worker is alive; waiting for one"
            } else {
                "workers are back"
            });
        }
        if status.finished {
            progress.finish();
            return Ok(Some(status));
        }
        tokio::select! {
            () = tokio::time::sleep(POLL.0) => {}
            () = stop.cancelled() => {
                progress.finish();
                return Ok(None);
            }
        }
    }
}

/// How much of the run is done, and how much there is, in jobs other than inference.
fn work_done(status: &RunStatus) -> (f64, f64) {
    // About what an inference takes, in filters and emissions of a view.
    const INFERENCE: f64 = 40.0;
    status.counts.iter().fold((0.0, 0.0), |(done, all), ((kind, state), jobs)| {
        let work = *jobs as f64 * if kind == "infer" { INFERENCE } else { 1.0 };
        (done + if has_ended(*state) { work } else { 0.0 }, all + work)
    })
}

/// Asks until there is an answer: a coordinator may be restarted while a run goes on. `None` when
/// `stop` was cancelled first.
async fn patiently<T>(
    stop: &CancellationToken,
    ask: impl AsyncFn() -> Result<T, ServiceError>,
) -> Result<Option<T>, ServiceError> {
    let mut was_silent = false;
    loop {
        let answer = tokio::select! {
            answer = ask() => answer,
            () = stop.cancelled() => return Ok(None),
        };
        match answer {
            Ok(answer) => {
                if was_silent {
                    eprintln!("the coordinator is back");
                }
                return Ok(Some(answer));
            }
            Err(error) if error.is_retryable() => {
                if !was_silent {
                    eprintln!("the coordinator does not answer, trying again: {error}");
                }
                was_silent = true;
            }
            Err(error) => return Err(error),
        }
        tokio::select! {
            () = tokio::time::sleep(POLL.1) => {}
            () = stop.cancelled() => return Ok(None),
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
