//! `planesweep evaluate`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use planesweep_evaluate::{DepthErrorOptions, DepthErrors, ErrorSummary, depth_error, truth_at_estimate};
use planesweep_scene::{read_depth_pfm, read_pfm, undistorted_intrinsics};
use rayon::prelude::*;
use serde_json::json;

use crate::console::{Outcome, table};
use crate::run_record::{RecordedView, RunRecord};

/// The evaluate commands.
#[derive(Debug, Subcommand)]
pub enum EvaluateCommand {
    /// Compare the depth maps of a result with true ones.
    Depth(EvaluateDepthArgs),
}

/// Arguments of `evaluate depth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep evaluate depth demo/out demo/scene/depth_gt")]
pub struct EvaluateDepthArgs {
    /// A folder that `reconstruct` made.
    pub out: PathBuf,
    /// The folder with the true depth of each view: NAME.pfm.
    pub truth: PathBuf,
}

/// Measures.
pub fn run(command: &EvaluateCommand) -> Result<Outcome> {
    match command {
        EvaluateCommand::Depth(args) => depth(args),
    }
}

fn depth(args: &EvaluateDepthArgs) -> Result<Outcome> {
    let record = RunRecord::read(&args.out)?;
    let measured: Vec<Option<(String, DepthErrors)>> =
        record.views.par_iter().map(|view| measure(args, view)).collect::<Result<_>>()?;
    let measured: Vec<(String, DepthErrors)> = measured.into_iter().flatten().collect();
    if measured.is_empty() {
        bail!(
            "no view of {} has both a depth map and true depth NAME.pfm in {}",
            args.out.display(),
            args.truth.display()
        );
    }
    let heading = [
        "view",
        "confidence",
        "coverage",
        "median",
        "mean",
        "within 1 %",
        "2 %",
        "5 %",
        "1 plane",
        "3 planes",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for (name, errors) in &measured {
        rows.push(row(name, "all", &errors.all));
        rows.extend(errors.confident.iter().map(|s| row("", &format!("> {}", s.min_confidence), s)));
    }
    let mean = |of: &dyn Fn(&DepthErrors) -> Option<f64>| {
        let values: Vec<f64> = measured.iter().filter_map(|(_, errors)| of(errors)).collect();
        if values.is_empty() { None } else { Some(values.iter().sum::<f64>() / values.len() as f64) }
    };
    let confident = |errors: &DepthErrors| errors.confident.first().and_then(|s| s.errors);
    let summary = json!({
        "views": measured.len(),
        "all": {
            "median_relative": mean(&|e| e.all.errors.as_ref().map(|x| x.median_relative)),
            "within_1_percent": mean(&|e| e.all.errors.as_ref().map(|x| x.within_1_percent)),
            "within_5_percent": mean(&|e| e.all.errors.as_ref().map(|x| x.within_5_percent)),
        },
        "confident": {
            "share": mean(&|e| e.confident.first().map(|s| s.coverage)),
            "median_relative": mean(&|e| confident(e).map(|x| x.median_relative)),
            "within_1_percent": mean(&|e| confident(e).map(|x| x.within_1_percent)),
            "within_5_percent": mean(&|e| confident(e).map(|x| x.within_5_percent)),
        },
    });
    let shown = |part: &str, field: &str| {
        summary[part][field].as_f64().map_or_else(|| "-".to_owned(), |value| format!("{value:.4}"))
    };
    let mut text = table(&rows);
    for (part, title) in [("all", "all pixels"), ("confident", "above confidence 0.8")] {
        text.push_str(&format!(
            "\nmean over views, {title}: median relative error {}, within 1 % {}, within 5 % {}",
            shown(part, "median_relative"),
            shown(part, "within_1_percent"),
            shown(part, "within_5_percent"),
        ));
    }
    text.push_str(&format!("\nshare of pixels above confidence 0.8: {}\n", shown("confident", "share")));
    let views: Vec<_> =
        measured.iter().map(|(name, errors)| json!({ "view": name, "errors": errors })).collect();
    Ok(Outcome { text, value: json!({ "mean": summary, "views": views }), skipped_views: false })
}

fn measure(args: &EvaluateDepthArgs, view: &RecordedView) -> Result<Option<(String, DepthErrors)>> {
    let Some(truth) = truth_file(&args.truth, view) else { return Ok(None) };
    let map_file = |kind: &str| args.out.join(kind).join(format!("{}.pfm", view.file));
    if !map_file("depth").exists() {
        return Ok(None);
    }
    let truth = read_depth_pfm(&truth)?;
    let estimate = read_depth_pfm(&map_file("depth"))?;
    let confidence = read_pfm(&map_file("confidence"))?;
    let (width, height) = (truth.width() as u32, truth.height() as u32);
    // Depth maps have no lens, so the true one belongs to the undistorted photograph.
    let undistorted = undistorted_intrinsics(&view.image_camera.intrinsics, &view.distortion);
    let truth_camera = undistorted.resized(width, height);
    let context = || format!("cannot compare view {}", view.name);
    let truth =
        truth_at_estimate(&truth, &truth_camera, &view.depth_camera.intrinsics).with_context(context)?;
    let options = DepthErrorOptions { hypotheses: Some(view.hypotheses), ..DepthErrorOptions::default() };
    let errors = depth_error(&estimate, &confidence, &truth, &options).with_context(context)?;
    Ok(Some((view.name.clone(), errors)))
}

fn truth_file(folder: &Path, view: &RecordedView) -> Option<PathBuf> {
    let by_name = [&view.file, &view.name].map(|name| folder.join(format!("{name}.pfm")));
    by_name.into_iter().find(|path| path.exists())
}

fn row(name: &str, which: &str, summary: &ErrorSummary) -> Vec<String> {
    let mut row = vec![name.to_owned(), which.to_owned(), format!("{:.3}", summary.coverage)];
    let Some(errors) = &summary.errors else {
        row.resize(10, "-".to_owned());
        return row;
    };
    let share = |value: f64| format!("{value:.3}");
    let optional = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), share);
    row.extend([
        format!("{:.4}", errors.median_relative),
        format!("{:.4}", errors.mean_relative),
        share(errors.within_1_percent),
        share(errors.within_2_percent),
        share(errors.within_5_percent),
        optional(errors.within_1_interval),
        optional(errors.within_3_intervals),
    ]);
    row
}
