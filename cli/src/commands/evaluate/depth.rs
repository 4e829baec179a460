//! `planesweep evaluate depth`: depth maps against true ones.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use nalgebra::{Point2, Point3};
use planesweep_evaluate::{
    DepthErrorOptions, DepthErrors, DepthMeans, ErrorStatistics, ErrorSummary, depth_error, truth_at_estimate,
};
use planesweep_report::{Line, LinePlot};
use planesweep_scene::{Raster, read_depth_pfm, read_pfm, undistorted_intrinsics};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::figures::Figures;
use super::skipped::split;
use crate::args::values::share;
use crate::console::{Outcome, table};
use crate::run_record::{RecordedView, RunRecord};

/// Arguments of `evaluate depth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep evaluate depth demo/out demo/scene/depth_gt -o demo/evaluation")]
pub struct DepthArgs {
    /// A folder that `reconstruct` made.
    pub result: PathBuf,
    /// The folder with the true depth of each view: NAME.pfm.
    pub truth: PathBuf,
    /// Give the errors also of the pixels of at least these confidences.
    #[arg(long, value_delimiter = ',', default_value = "0.8", value_parser = share)]
    pub min_confidence: Vec<f32>,
    /// Write plots, a cloud coloured by error and all figures to this folder.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
}

/// A view that was measured.
struct Measured {
    name: String,
    errors: DepthErrors,
    /// Its points in the world, each with its relative error.
    points: Vec<(Point3<f64>, f64)>,
}

/// Compares the depth maps of a result with true ones.
pub fn run(args: &DepthArgs) -> Result<Outcome> {
    let record = RunRecord::read(&args.result)?;
    if !args.truth.is_dir() {
        bail!("cannot find the folder {} with true depth", args.truth.display());
    }
    let (measured, skipped) =
        split(record.views.par_iter().map(|view| (view.name.clone(), measure(args, view))).collect());
    let measured: Vec<Measured> = measured.into_iter().flatten().collect();
    let errors: Vec<DepthErrors> = measured.iter().map(|view| view.errors.clone()).collect();
    let Some(means) = DepthMeans::of(&errors) else {
        bail!(
            "no view of {} has both a depth map and true depth NAME.pfm in {}{}",
            args.result.display(),
            args.truth.display(),
            skipped.reasons()
        );
    };
    let views: Vec<Value> =
        measured.iter().map(|view| json!({ "view": view.name, "errors": view.errors })).collect();
    let mean = json!({
        "views": means.views,
        "all": means.all,
        "confident": means.confident.first(),
        "by_confidence": means.confident,
        "curve": means.curve,
    });
    let value = json!({ "mean": mean, "views": views, "skipped": skipped.value() });
    if let Some(folder) = &args.out {
        write_figures(&Figures::create(folder)?, &measured, &means, &value)?;
    }
    let text = skipped.lines() + &text(&measured, &means);
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

fn measure(args: &DepthArgs, view: &RecordedView) -> Result<Option<Measured>> {
    let Some(truth) = truth_file(&args.truth, view) else { return Ok(None) };
    let map_file = |kind: &str| args.result.join(kind).join(format!("{}.pfm", view.file));
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
    let options = DepthErrorOptions {
        hypotheses: Some(view.hypotheses),
        min_confidences: args.min_confidence.clone(),
        ..DepthErrorOptions::default()
    };
    let errors = depth_error(&estimate, &confidence, &truth, &options).with_context(context)?;
    let points = if args.out.is_some() { points(view, &estimate, &truth) } else { Vec::new() };
    Ok(Some(Measured { name: view.name.clone(), errors, points }))
}

fn truth_file(folder: &Path, view: &RecordedView) -> Option<PathBuf> {
    let by_name = [&view.file, &view.name].map(|name| folder.join(format!("{name}.pfm")));
    by_name.into_iter().find(|path| path.exists())
}

/// The estimate's pixels that have a true depth as points, with their relative errors.
fn points(view: &RecordedView, estimate: &Raster<f32>, truth: &Raster<f32>) -> Vec<(Point3<f64>, f64)> {
    let pixels = (0..estimate.height()).flat_map(|y| (0..estimate.width()).map(move |x| (x, y)));
    pixels
        .filter_map(|(x, y)| {
            let (depth, truth) = (f64::from(estimate.at(x, y)), f64::from(truth.at(x, y)));
            let both = depth > 0.0 && truth > 0.0 && depth.is_finite() && truth.is_finite();
            let point = || view.depth_camera.unproject(&Point2::new(x as f64, y as f64), depth);
            both.then(|| (point(), (depth - truth).abs() / truth))
        })
        .collect()
}

fn text(measured: &[Measured], means: &DepthMeans) -> String {
    let heading = [
        "view",
        "confidence",
        "coverage",
        "median abs.",
        "mean abs.",
        "median rel.",
        "mean rel.",
        "within 1 %",
        "2 %",
        "5 %",
        "1 plane",
        "3 planes",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    let above = |confidence: f32| format!(">= {confidence}");
    for view in measured {
        let summary_row = |name: &str, which: &str, summary: &ErrorSummary| {
            row(name, which, summary.coverage, summary.errors.as_ref())
        };
        rows.push(summary_row(&view.name, "all", &view.errors.all));
        rows.extend(view.errors.confident.iter().map(|s| summary_row("", &above(s.min_confidence), s)));
    }
    rows.push(row("mean over views", "all", means.all.share, means.all.errors.as_ref()));
    let confident = means.confident.iter();
    rows.extend(confident.map(|s| row("", &above(s.min_confidence), s.share, s.errors.as_ref())));
    table(&rows)
}

fn row(name: &str, which: &str, coverage: f64, errors: Option<&ErrorStatistics>) -> Vec<String> {
    let mut row = vec![name.to_owned(), which.to_owned(), format!("{coverage:.3}")];
    let Some(errors) = errors else {
        row.resize(12, "-".to_owned());
        return row;
    };
    let share = |value: f64| format!("{value:.3}");
    let optional = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), share);
    row.extend([
        format!("{:.4}", errors.median_absolute),
        format!("{:.4}", errors.mean_absolute),
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

/// Relative errors at which colours and histogram end, and the width of its bars.
const COLOR_ERROR: f64 = 0.05;
const HISTOGRAM_PERCENT: f64 = 10.0;
const BAR_PERCENT: f64 = 0.2;

fn write_figures(figures: &Figures, measured: &[Measured], means: &DepthMeans, value: &Value) -> Result<()> {
    figures.json("depth", value)?;
    let points: Vec<(Point3<f64>, f64)> = measured.iter().flat_map(|view| &view.points).copied().collect();
    figures.cloud("error", &points, COLOR_ERROR)?;
    let line = |of: fn(&ErrorStatistics) -> f64| -> Vec<(f64, f64)> {
        means.curve.iter().map(|point| (100.0 * point.kept, 100.0 * of(&point.errors))).collect()
    };
    let (median, mean) = (line(|e| e.median_relative), line(|e| e.mean_relative));
    figures.plot(
        "error_by_kept_share",
        &LinePlot {
            title: "relative error of the most confident pixels",
            x_label: "kept, %",
            y_label: "error, %",
            lines: &[Line { name: "median", points: &median }, Line { name: "mean", points: &mean }],
            mark: None,
        },
    )?;
    let within = [line(|e| e.within_1_percent), line(|e| e.within_2_percent), line(|e| e.within_5_percent)];
    figures.plot(
        "within_by_kept_share",
        &LinePlot {
            title: "small errors among the most confident pixels",
            x_label: "kept, %",
            y_label: "share, %",
            lines: &[
                Line { name: "within 1 %", points: &within[0] },
                Line { name: "2 %", points: &within[1] },
                Line { name: "5 %", points: &within[2] },
            ],
            mark: None,
        },
    )?;
    let percents = &mut points.iter().map(|(_, error)| 100.0 * error);
    let histogram = Figures::histogram(percents, HISTOGRAM_PERCENT, BAR_PERCENT);
    figures.plot(
        "error_histogram",
        &LinePlot {
            title: "relative errors of depth",
            x_label: "error, %",
            y_label: "share, %",
            lines: &[Line { name: "all pixels", points: &histogram }],
            mark: None,
        },
    )
}
