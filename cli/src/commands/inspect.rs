//! `planesweep inspect`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use planesweep_mvsnet::{InferRates, Refinement};
use planesweep_plan::{Finding, Plan, RangeOrigin, Severity, ViewPlan, checkup, plan};
use planesweep_scene::{Sampling, Scene};
use serde_json::json;

use crate::args::values::bytes;
use crate::args::{FilterArgs, PlanArgs, ReadArgs};
use crate::console::{Outcome, counted, table};
use crate::forecast::{Forecast, Team, ViewForecast};
use crate::input::{self, all_skipped};
use crate::network::{default_workers, processors, read_weights};

/// Arguments of `inspect`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep inspect my-colmap-project --max-size 1152")]
pub struct InspectArgs {
    /// The scene.
    pub scene: PathBuf,
    /// The weights that will be used; they decide whether depth maps are refined, which takes time.
    #[arg(long, env = "PLANESWEEP_WEIGHTS", value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Worker processes, as for `reconstruct`.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub workers: Option<u32>,
    /// Threads of each worker's inference, as for `reconstruct`.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Memory for inference, as for `reconstruct`.
    #[arg(long, value_name = "SIZE", value_parser = bytes)]
    pub memory: Option<u64>,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub filter: FilterArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// Says what would be done.
pub fn run(args: &InspectArgs) -> Result<Outcome> {
    let input = input::read(&args.scene, &args.read.options())?;
    let plan = plan(&input.scene, &args.plan.options(Some(&args.filter)));
    let skipped = all_skipped(&input, &plan);
    let scene = &input.scene;
    let left_out = input.skipped.iter().map(|view| (view.view.clone(), view.reason.clone())).collect();
    let mut text = format!(
        "{}: {} views, {} sparse points\n",
        args.scene.display(),
        scene.views.len(),
        scene.points.len()
    );
    let findings = checkup(scene, &left_out, &plan);
    if findings.is_empty() {
        text.push_str("nothing odd was found\n");
    }
    for Finding { severity, what, advice, .. } in &findings {
        let severity = match severity {
            Severity::Wrong => "wrong",
            Severity::Lost => "lost",
            Severity::Weak => "weak",
            Severity::Note => "note",
        };
        text.push_str(&format!("{severity}: {what}\n      {advice}\n"));
    }
    let team = team(args, &plan)?;
    let forecast = Forecast::new(&plan, team, &InferRates::measure(team.threads)?);
    text.push('\n');
    text.push_str(&table(&rows(scene, &plan, &forecast)));
    text.push_str(&format!(
        "\non the processors of this machine: {:.0} s for the depth maps with {} of {}, {} MiB each\n",
        forecast.seconds,
        counted(team.workers, "worker"),
        counted(team.threads as u32, "thread"),
        forecast.worker_bytes >> 20,
    ));
    let value = json!({
        "scene": args.scene,
        "views": scene.views.len(),
        "sparse_points": scene.points.len(),
        "warnings": scene.warnings.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "skipped": skipped,
        "findings": findings,
        "plan": plan,
        "forecast": forecast,
    });
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

/// The workers that `reconstruct` would start.
fn team(args: &InspectArgs, plan: &Plan) -> Result<Team> {
    let weights = args.weights.as_deref().map(read_weights).transpose()?;
    let refined = weights.is_some_and(|(_, weights)| weights.metadata().refinement != Refinement::None);
    let workers = args.workers.unwrap_or_else(|| default_workers(plan, "cpu", refined));
    let threads = args.threads.map_or((processors() / workers as usize).max(1), |threads| threads as usize);
    let memory_bytes = args.memory.map(|bytes| bytes / u64::from(workers));
    Ok(Team { workers, threads, memory_bytes, refined })
}

fn rows(scene: &Scene, plan: &Plan, forecast: &Forecast) -> Vec<Vec<String>> {
    let heading = [
        "view",
        "image",
        "lens",
        "network sees",
        "depth range",
        "from",
        "planes",
        "memory",
        "GFLOP",
        "seconds",
        "neighbours",
        "sources",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    let mut views: Vec<(&ViewPlan, &ViewForecast)> = plan.views.iter().zip(&forecast.views).collect();
    views.sort_by_key(|(view, _)| view.view);
    rows.extend(views.into_iter().map(|(view, forecast)| row(scene, view, forecast)));
    rows
}

fn row(scene: &Scene, plan: &ViewPlan, forecast: &ViewForecast) -> Vec<String> {
    let view = &scene.views[&plan.view];
    let size = &view.camera.intrinsics;
    let planes = &plan.hypotheses;
    let sources: Vec<&str> = plan.sources.iter().map(|id| scene.views[id].name.as_str()).collect();
    vec![
        view.name.clone(),
        format!("{}x{}", size.width, size.height),
        view.distortion.model().to_owned(),
        match plan.bands.len() {
            0 => format!("{}x{}", plan.working_size.0, plan.working_size.1),
            bands => format!("{}x{} in {bands} bands", plan.working_size.0, plan.working_size.1),
        },
        format!("{:.4} to {:.4}", planes.min(), planes.max()),
        match plan.range_origin {
            RangeOrigin::Option => "option".to_owned(),
            RangeOrigin::File => "file".to_owned(),
            RangeOrigin::Points(count) => format!("{count} points"),
            RangeOrigin::NeighbourPoints(count) => format!("{count} points of neighbours"),
            RangeOrigin::Focus(count) => format!("{count} optical axes"),
        },
        format!(
            "{} {}",
            planes.count(),
            if planes.sampling() == Sampling::Uniform { "uniform" } else { "inverse" }
        ),
        format!("{} MiB", forecast.bytes >> 20),
        format!("{:.0}", forecast.operations / 1e9),
        format!("{:.2}", forecast.seconds),
        plan.neighbours.len().to_string(),
        sources.join(" "),
    ]
}
