//! `planesweep evaluate tnt`: the metric of the Tanks and Temples benchmark.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;
use nalgebra::{Matrix4, Point3};
use planesweep_evaluate::tnt::{
    CropVolume, TntEvaluation, TntScores, align_cloud, align_trajectories, matched_cameras, parse_mapping,
    parse_trajectory, parse_transform, score, threshold,
};
use planesweep_report::{Line, LinePlot};
use serde_json::{Value, json};

use super::figures::Figures;
use super::{cloud_file, read_positions};
use crate::args::values::length;
use crate::console::Outcome;

/// Arguments of `evaluate tnt`.
#[derive(Debug, Args)]
#[command(
    after_help = "TRUTH holds the files of the benchmark: SCENE.ply (the scan), SCENE.json (the volume to \
    judge), SCENE_trans.txt, SCENE_COLMAP_SfM.log and, for a trajectory of a whole video, \
    SCENE_mapping_reference.txt. With --aligned only the first two are needed.\n\
    Example: planesweep evaluate tnt out/Barn tanks-and-temples/Barn -o out/Barn/evaluation"
)]
pub struct TntArgs {
    /// A folder that `reconstruct` made, or a PLY file with --trajectory or --aligned.
    pub result: PathBuf,
    /// The folder of the scene's ground truth.
    pub truth: PathBuf,
    /// The scene, as its files are named; by default as the folder is.
    #[arg(long)]
    pub scene: Option<String>,
    /// Distance within which a point counts, in metres; by default the scene's.
    #[arg(long, value_name = "METRES", value_parser = length)]
    pub threshold: Option<f64>,
    /// The cameras of the cloud; by default trajectory.log of the result.
    #[arg(long, value_name = "LOG", conflicts_with = "aligned")]
    pub trajectory: Option<PathBuf>,
    /// The cloud is in the frame of the scan already: compare it as it is.
    #[arg(long)]
    pub aligned: bool,
    /// Seed of the first, rough alignment.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Write plots, clouds coloured by error and all figures to this folder.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
}

/// Compares a cloud with the scan of its scene.
pub fn run(args: &TntArgs) -> Result<Outcome> {
    let scene = scene_name(args)?;
    let threshold = args
        .threshold
        .or_else(|| threshold(&scene))
        .with_context(|| format!("the benchmark sets no threshold for \"{scene}\"; say --threshold"))?;
    let file = |ending: &str| args.truth.join(format!("{scene}{ending}"));
    let volume = parse(&file(".json"), CropVolume::parse)?;
    let cloud = read_positions(&cloud_file(&args.result))?;
    let scan = read_positions(&file(".ply"))?;
    let transform = if args.aligned {
        Matrix4::identity()
    } else {
        let initial = rough_alignment(args, &file)?;
        align_cloud(&cloud, &scan, &initial, &volume, threshold)
    };
    let evaluation = score(&cloud, &scan, &transform, &volume, threshold);
    let scores = &evaluation.scores;
    let rows: Vec<Vec<f64>> = transform.row_iter().map(|row| row.iter().copied().collect()).collect();
    let value = json!({ "scene": scene, "scores": scores, "transform": rows });
    if let Some(folder) = &args.out {
        write_figures(&Figures::create(folder)?, &evaluation, &value)?;
    }
    let text = format!(
        "{scene} at {threshold} m: precision {:.2} %, recall {:.2} %, F-score {:.2} %\n\
         {} points of the cloud and {} of the scan within the volume\n",
        100.0 * scores.precision,
        100.0 * scores.recall,
        100.0 * scores.f_score,
        scores.cloud_points,
        scores.scan_points,
    );
    Ok(Outcome { text, value, skipped_views: false })
}

fn scene_name(args: &TntArgs) -> Result<String> {
    if let Some(scene) = &args.scene {
        return Ok(scene.clone());
    }
    let folder =
        args.truth.canonicalize().with_context(|| format!("cannot find {}", args.truth.display()))?;
    let name = folder.file_name().and_then(|name| name.to_str());
    name.map(str::to_owned).with_context(|| format!("{} names no scene; say --scene", args.truth.display()))
}

fn rough_alignment(args: &TntArgs, file: &dyn Fn(&str) -> PathBuf) -> Result<Matrix4<f64>> {
    let log = args.trajectory.clone().unwrap_or_else(|| args.result.join("trajectory.log"));
    let trajectory = parse(&log, parse_trajectory)?;
    let reference = parse(&file("_COLMAP_SfM.log"), parse_trajectory)?;
    let to_scan = parse(&file("_trans.txt"), parse_transform)?;
    let mapping = file("_mapping_reference.txt");
    let mapping = mapping.exists().then(|| parse(&mapping, parse_mapping)).transpose()?;
    let pairs = matched_cameras(&trajectory, &reference, &to_scan, mapping.as_deref())
        .with_context(|| format!("cannot match the cameras of {}", log.display()))?;
    Ok(align_trajectories(&pairs, args.seed)?)
}

fn parse<T, E: std::error::Error + Send + Sync + 'static>(
    path: &Path,
    parse: impl Fn(&str) -> Result<T, E>,
) -> Result<T> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    parse(&text).with_context(|| format!("cannot use {}", path.display()))
}

/// Colours end at this many thresholds.
const COLOR_THRESHOLDS: f64 = 3.0;

fn write_figures(figures: &Figures, evaluation: &TntEvaluation, value: &Value) -> Result<()> {
    let TntEvaluation { scores, cloud, scan } = evaluation;
    figures.json("tnt", value)?;
    figures.cloud("precision", cloud, COLOR_THRESHOLDS * scores.threshold)?;
    figures.cloud("recall", scan, COLOR_THRESHOLDS * scores.threshold)?;
    write_curves(figures, scores)?;
    write_histogram(figures, evaluation)
}

fn write_curves(figures: &Figures, scores: &TntScores) -> Result<()> {
    let line = |of: fn(f64, f64) -> f64| -> Vec<(f64, f64)> {
        scores.curve.iter().map(|p| (p.threshold, 100.0 * of(p.precision, p.recall))).collect()
    };
    let (precision, recall) = (line(|precision, _| precision), line(|_, recall| recall));
    figures.plot(
        "precision_recall",
        &LinePlot {
            title: "precision and recall",
            x_label: "distance, m",
            y_label: "share, %",
            lines: &[
                Line { name: "precision", points: &precision },
                Line { name: "recall", points: &recall },
            ],
            mark: Some(scores.threshold),
        },
    )
}

/// Bars of the histogram per threshold, and thresholds that it shows.
const BARS: f64 = 20.0;
const HISTOGRAM_THRESHOLDS: f64 = 5.0;

fn write_histogram(figures: &Figures, evaluation: &TntEvaluation) -> Result<()> {
    let TntEvaluation { scores, cloud, scan } = evaluation;
    let bars = |points: &[(Point3<f64>, f64)]| {
        let distances = &mut points.iter().map(|(_, distance)| *distance);
        Figures::histogram(distances, HISTOGRAM_THRESHOLDS * scores.threshold, scores.threshold / BARS)
    };
    let (cloud, scan) = (bars(cloud), bars(scan));
    figures.plot(
        "error_histogram",
        &LinePlot {
            title: "distances between cloud and scan",
            x_label: "distance, m",
            y_label: "share, %",
            lines: &[
                Line { name: "cloud to scan", points: &cloud },
                Line { name: "scan to cloud", points: &scan },
            ],
            mark: Some(scores.threshold),
        },
    )
}
