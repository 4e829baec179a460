//! `planesweep inspect`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use planesweep_mvsnet::InferCost;
use planesweep_plan::{Plan, RangeOrigin, ViewPlan, plan};
use planesweep_scene::{Sampling, Scene};
use serde_json::json;

use crate::args::{FilterArgs, PlanArgs, ReadArgs};
use crate::console::{Outcome, table};
use crate::input::{self, all_skipped};
use crate::network::infer_size;

/// Arguments of `inspect`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep inspect my-colmap-project --max-size 1152")]
pub struct InspectArgs {
    /// The scene.
    pub scene: PathBuf,
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
    let mut text = format!(
        "{}: {} views, {} sparse points\n",
        args.scene.display(),
        scene.views.len(),
        scene.points.len()
    );
    for warning in &scene.warnings {
        text.push_str(&format!("warning: {warning}\n"));
    }
    for view in &skipped {
        text.push_str(&format!("skipped: {}: {}\n", view.view, view.reason));
    }
    text.push('\n');
    text.push_str(&table(&rows(scene, &plan)));
    let value = json!({
        "scene": args.scene,
        "views": scene.views.len(),
        "sparse_points": scene.points.len(),
        "warnings": scene.warnings,
        "skipped": skipped,
        "plan": plan,
    });
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

fn rows(scene: &Scene, plan: &Plan) -> Vec<Vec<String>> {
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
        "neighbours",
        "sources",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    let mut views: Vec<&ViewPlan> = plan.views.iter().collect();
    views.sort_by_key(|view| view.view);
    rows.extend(views.into_iter().map(|view| row(scene, view)));
    rows
}

fn row(scene: &Scene, plan: &ViewPlan) -> Vec<String> {
    let view = &scene.views[&plan.view];
    let size = &view.camera.intrinsics;
    let planes = &plan.hypotheses;
    // On the processor, with one thread.
    let cost = InferCost::predict(infer_size(plan), 1, None);
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
        },
        format!(
            "{} {}",
            planes.count(),
            if planes.sampling() == Sampling::Uniform { "uniform" } else { "inverse" }
        ),
        format!("{} MiB", cost.bytes >> 20),
        format!("{:.0}", cost.operations / 1e9),
        plan.neighbours.len().to_string(),
        sources.join(" "),
    ]
}
