//! `planesweep status` and `planesweep cancel`.

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_plan::RunId;
use planesweep_proto::{Client, JobState, RunStatus, RunSummary};
use serde_json::{Value, json};
use tokio_util::sync::CancellationToken;

use crate::args::ConnectArgs;
use crate::computation::follow;
use crate::console::{Outcome, table};

/// Arguments of `status`.
#[derive(Debug, Args)]
#[command(after_help = "Without a run, the latest runs are listed.\n\
    Exit code 3: the run has ended, and some of its jobs failed for good; 1, with --watch: it was cancelled.\n\
    Example: planesweep status castle-3 --watch --coordinator http://10.0.0.1:7070")]
pub struct StatusArgs {
    /// The run, as `submit` named it.
    pub run: Option<String>,
    /// Wait until the run ends; without a run, the latest one.
    #[arg(long)]
    pub watch: bool,
    #[command(flatten)]
    pub connect: ConnectArgs,
}

/// Arguments of `cancel`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep cancel castle-3 --coordinator http://10.0.0.1:7070")]
pub struct CancelArgs {
    /// The run, as `submit` named it.
    pub run: String,
    #[command(flatten)]
    pub connect: ConnectArgs,
}

/// Says how far runs are.
pub fn run(args: &StatusArgs) -> Result<Outcome> {
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    runtime.block_on(async {
        let mut client = args.connect.client()?;
        let run = if let Some(run) = &args.run {
            RunId(run.clone())
        } else {
            let runs = client.runs().await.context("cannot list the runs")?;
            match runs.first() {
                Some(latest) if args.watch => latest.run.clone(),
                _ => return Ok(list(&runs)),
            }
        };
        let status = if args.watch {
            watch(&client, &run).await?
        } else {
            client.status(&run, 0).await.context("cannot ask how far the run is")?
        };
        if args.watch && status.cancelled {
            bail!("run {run} was cancelled");
        }
        Ok(describe(&run, &status))
    })
}

/// Stops a run.
pub fn cancel(args: &CancelArgs) -> Result<Outcome> {
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    runtime.block_on(async {
        let mut client = args.connect.client()?;
        let run = RunId(args.run.clone());
        client.cancel(&run).await.with_context(|| format!("cannot cancel run {run}"))?;
        let text = format!("run {run} is cancelled; what it shares with other runs goes on, results stay\n");
        Ok(Outcome { text, value: json!({ "run": run.0, "cancelled": true }), skipped_views: false })
    })
}

async fn watch(client: &Client, run: &RunId) -> Result<RunStatus> {
    let status = follow(client, run, &CancellationToken::new(), |_| None).await?;
    status.context("the run has no end")
}

fn list(runs: &[RunSummary]) -> Outcome {
    let state = |run: &RunSummary| match (run.cancelled, run.is_finished()) {
        (true, _) => "cancelled",
        (_, true) => "finished",
        _ => "running",
    };
    let mut rows = vec![["run", "state", "jobs", "done", "failed"].map(str::to_owned).to_vec()];
    rows.extend(runs.iter().map(|run| {
        let counts = [run.jobs, run.done, run.failed].map(|n| n.to_string());
        [run.run.0.clone(), state(run).to_owned()].into_iter().chain(counts).collect()
    }));
    let value: Vec<Value> = runs
        .iter()
        .map(|run| {
            json!({
                "run": run.run.0, "name": run.name, "state": state(run),
                "jobs": run.jobs, "done": run.done, "failed": run.failed,
            })
        })
        .collect();
    Outcome { text: table(&rows), value: json!({ "runs": value }), skipped_views: false }
}

fn describe(run: &RunId, status: &RunStatus) -> Outcome {
    let state = match (status.cancelled, status.finished) {
        (true, _) => "cancelled",
        (_, true) => "finished",
        _ => "running",
    };
    let mut by_kind: BTreeMap<&str, BTreeMap<&str, u64>> = BTreeMap::new();
    for ((kind, of), jobs) in &status.counts {
        by_kind.entry(kind).or_default().insert(of.as_str(), *jobs);
    }
    let mut text = format!("{run} is {state}\n\n");
    let heading = std::iter::once("jobs").chain(JobState::ALL.map(JobState::as_str));
    let mut rows = vec![heading.map(str::to_owned).collect::<Vec<_>>()];
    rows.extend(by_kind.iter().map(|(kind, counts)| {
        let count = |of: JobState| counts.get(of.as_str()).copied().unwrap_or(0).to_string();
        std::iter::once((*kind).to_owned()).chain(JobState::ALL.map(count)).collect()
    }));
    text.push_str(&table(&rows));
    text.push('\n');
    let mut rows = vec![["worker", "host", "role", "device", "state", "jobs"].map(str::to_owned).to_vec()];
    rows.extend(status.workers.iter().map(|worker| {
        let state = if worker.alive {
            worker.state.to_string()
        } else {
            format!("not heard of for {} s", worker.last_report_ago.as_secs())
        };
        let (role, held) = (worker.role.to_string(), worker.held.to_string());
        vec![worker.worker.0.clone(), worker.host.clone(), role, worker.device.clone(), state, held]
    }));
    text.push_str(&table(&rows));
    if let Some(waiting) = status.waiting {
        text.push_str(&format!(
            "no worker is alive; the jobs have been waiting for {} s\n",
            waiting.as_secs()
        ));
    }
    for (count, what) in [
        (status.late_results, "results came too late and were refused"),
        (status.divergent_results, "of them differed from the published ones"),
        (status.refused_callers, "callers were refused (no token, a wrong one, or no TLS handshake)"),
    ] {
        if count > 0 {
            text.push_str(&format!("{count} {what}\n"));
        }
    }
    for failed in &status.failures {
        let (_, message) = failed.failure.clone().unwrap_or_default();
        let of = failed.view.map_or_else(|| "the cloud".to_owned(), |view| format!("view {view}"));
        text.push_str(&format!("{} of {of} failed for good: {message}\n", failed.kind));
    }
    let value = json!({
        "run": run.0,
        "name": status.name,
        "state": state,
        "jobs": by_kind,
        "failures": status.failures.iter().map(|failed| json!({
            "kind": failed.kind, "view": failed.view.map(|view| view.0),
            "code": failed.failure.as_ref().map(|(code, _)| code),
            "message": failed.failure.as_ref().map(|(_, message)| message),
        })).collect::<Vec<_>>(),
        "workers": status.workers.iter().map(|worker| json!({
            "worker": worker.worker.0, "host": worker.host, "role": worker.role.to_string(),
            "device": worker.device, "state": worker.state.to_string(), "alive": worker.alive,
            "jobs": worker.held,
        })).collect::<Vec<_>>(),
        "waiting_seconds": status.waiting.map(|waiting| waiting.as_secs_f64()),
        "late_results": status.late_results,
        "divergent_results": status.divergent_results,
        "refused_callers": status.refused_callers,
    });
    let skipped_views = status.finished && status.count(JobState::Failed) > 0;
    Outcome { text, value, skipped_views }
}
