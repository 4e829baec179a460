//! `planesweep evaluate eth3d`: the metric of the ETH3D multi-view benchmark.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;
use planesweep_evaluate::eth3d::{
    Eth3dEvaluation, Eth3dOptions, Eth3dScores, LaserScan, PlacedScan, compare, parse_project,
};
use planesweep_report::{Line, LinePlot};
use serde_json::{Value, json};

use super::figures::Figures;
use super::{cloud_file, read_positions};
use crate::args::values::length;
use crate::console::{Outcome, table};

/// Arguments of `evaluate eth3d`.
#[derive(Debug, Args)]
#[command(
    after_help = "TRUTH is the scene's scan_alignment.mlp: it names the scans, each in the frame of its scanner, \
    and says where the scanners stood. The cloud must be in the frame of the scans. Lengths are metres.\n\
    Example: planesweep evaluate eth3d out/courtyard eth3d/courtyard/dslr_scan_eval/scan_alignment.mlp"
)]
pub struct Eth3dArgs {
    /// A folder that `reconstruct` made, or a PLY file.
    pub result: PathBuf,
    /// The MeshLab project of the scene's scans.
    pub truth: PathBuf,
    /// Distances within which a point counts, in metres.
    #[arg(long, value_name = "METRES", value_delimiter = ',', value_parser = length,
        default_value = "0.01,0.02,0.05,0.1,0.2,0.5")]
    pub tolerances: Vec<f64>,
    /// Side of the cells that weigh the same, in metres.
    #[arg(long, value_name = "METRES", default_value = "0.01", value_parser = length)]
    pub cell: f64,
    /// Write a plot, a cloud coloured by error and all figures to this folder.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
}

/// Compares a cloud with the laser scans of its scene.
pub fn run(args: &Eth3dArgs) -> Result<Outcome> {
    let scans = read_scans(&args.truth)?;
    let cloud = read_positions(&cloud_file(&args.result))?;
    let mut tolerances = args.tolerances.clone();
    tolerances.sort_by(f64::total_cmp);
    let options = Eth3dOptions { tolerances, cell: args.cell, ..Eth3dOptions::default() };
    let evaluation = compare(&cloud, &scans, &options);
    let value = json!({
        "points": cloud.len(),
        "unobserved": evaluation.unobserved,
        "scan_points": scans.iter().map(|scan| scan.points.len()).sum::<usize>(),
        "scores": evaluation.scores,
    });
    if let Some(folder) = &args.out {
        write_figures(&Figures::create(folder)?, &evaluation, &value)?;
    }
    let mut rows = vec![["tolerance", "accuracy", "completeness", "F1"].map(str::to_owned).to_vec()];
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    rows.extend(evaluation.scores.iter().map(|scores| {
        let shares = [scores.accuracy, scores.completeness, scores.f1].map(percent);
        std::iter::once(format!("{} m", scores.tolerance)).chain(shares).collect()
    }));
    let text = format!(
        "{}{} of {} points are unobserved at the least tolerance and do not count there\n",
        table(&rows),
        evaluation.unobserved,
        cloud.len()
    );
    Ok(Outcome { text, value, skipped_views: false })
}

/// The scans that a MeshLab project names.
fn read_scans(project: &Path) -> Result<Vec<LaserScan>> {
    let text = fs::read_to_string(project).with_context(|| format!("cannot read {}", project.display()))?;
    let placed = parse_project(&text).with_context(|| format!("cannot use {}", project.display()))?;
    let folder = project.parent().unwrap_or(Path::new("."));
    let scan = |placed: PlacedScan| {
        Ok(LaserScan { points: read_positions(&folder.join(placed.file))?, to_world: placed.to_world })
    };
    placed.into_iter().map(scan).collect()
}

fn write_figures(figures: &Figures, evaluation: &Eth3dEvaluation, value: &Value) -> Result<()> {
    figures.json("eth3d", value)?;
    let largest = evaluation.scores.last().map_or(1.0, |scores| scores.tolerance);
    figures.cloud("completeness", &evaluation.scan, largest)?;
    let line = |of: fn(&Eth3dScores) -> f64| -> Vec<(f64, f64)> {
        evaluation.scores.iter().map(|scores| (scores.tolerance, 100.0 * of(scores))).collect()
    };
    let (accuracy, completeness, f1) = (line(|s| s.accuracy), line(|s| s.completeness), line(|s| s.f1));
    figures.plot(
        "tolerances",
        &LinePlot {
            title: "accuracy and completeness",
            x_label: "tolerance, m",
            y_label: "share, %",
            lines: &[
                Line { name: "accuracy", points: &accuracy },
                Line { name: "completeness", points: &completeness },
                Line { name: "F1", points: &f1 },
            ],
            mark: None,
        },
    )
}
