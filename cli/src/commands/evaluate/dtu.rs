//! `planesweep evaluate dtu`: the distances of the DTU data set.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_evaluate::dtu::{
    DtuEvaluation, DtuMeans, DtuScores, ObservabilityMask, Percentage, SPACING_MM, TablePlane, compare, thin,
};
use planesweep_report::{Line, LinePlot};
use serde_json::json;

use super::figures::Figures;
use super::{cloud_file, read_positions};
use crate::console::{Outcome, table};

/// Arguments of `evaluate dtu`.
#[derive(Debug, Args)]
#[command(after_help = "TRUTH is the data set's folder: Points/stl/stlNNN_total.ply and ObsMask/ with \
    ObsMaskN_10.mat and PlaneN.mat. RESULTS holds scanN/ as `reconstruct` made them, scanN.ply or, as \
    others name them, mvsnetNNN_l3.ply. Lengths are millimetres.\n\
    Example: planesweep evaluate dtu results SampleSet/MVS_Data --scans 1,4,9 -o evaluation")]
pub struct DtuArgs {
    /// The folder of the clouds.
    pub results: PathBuf,
    /// The folder of the ground truth.
    pub truth: PathBuf,
    /// The scans; by default those of the benchmark's test set that there are results of.
    #[arg(long, value_delimiter = ',')]
    pub scans: Option<Vec<u32>>,
    /// Seed of the random order in which a cloud is thinned.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Write plots, clouds coloured by error and all figures to this folder.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
}

/// Compares clouds with the structured light scans.
pub fn run(args: &DtuArgs) -> Result<Outcome> {
    let wanted = args.scans.clone().unwrap_or_else(|| planesweep_evaluate::dtu::TEST_SCANS.to_vec());
    let mut measured: Vec<(u32, DtuScores)> = Vec::new();
    for scan in wanted {
        let cloud = match (scan_cloud(&args.results, scan), &args.scans) {
            (Some(cloud), _) => cloud,
            (None, Some(_)) => bail!("{} holds no cloud of scan {scan}", args.results.display()),
            (None, None) => continue,
        };
        let evaluation =
            measure(args, scan, &cloud).with_context(|| format!("cannot evaluate scan {scan}"))?;
        if let Some(folder) = &args.out {
            write_figures(&Figures::create(&folder.join(format!("scan{scan}")))?, &evaluation)?;
        }
        measured.push((scan, evaluation.scores));
    }
    let Some(means) = DtuMeans::of(measured.iter().map(|(_, scores)| scores)) else {
        bail!("{} holds no cloud of any test scan", args.results.display());
    };
    let scans: Vec<_> =
        measured.iter().map(|(scan, scores)| json!({ "scan": scan, "scores": scores })).collect();
    let value = json!({ "mean": means, "scans": scans });
    if let Some(folder) = &args.out {
        Figures::create(folder)?.json("dtu", &value)?;
    }
    Ok(Outcome { text: text(&measured, &means), value, skipped_views: false })
}

/// The cloud of a scan, under any of the names that are in use.
fn scan_cloud(results: &Path, scan: u32) -> Option<PathBuf> {
    let names = [
        format!("scan{scan}"),
        format!("scan{scan}.ply"),
        format!("scan{scan:03}.ply"),
        format!("mvsnet{scan:03}_l3.ply"),
    ];
    names.iter().map(|name| cloud_file(&results.join(name))).find(|path| path.is_file())
}

fn measure(args: &DtuArgs, scan: u32, cloud: &Path) -> Result<DtuEvaluation> {
    let file = |name: String| args.truth.join(name);
    let mask = ObservabilityMask::read(&file(format!("ObsMask/ObsMask{scan}_10.mat")))?;
    let table = TablePlane::read(&file(format!("ObsMask/Plane{scan}.mat")))?;
    let truth = read_positions(&file(format!("Points/stl/stl{scan:03}_total.ply")))?;
    let cloud = thin(&read_positions(cloud)?, SPACING_MM, args.seed);
    Ok(compare(&cloud, &truth, &mask, &table))
}

fn text(measured: &[(u32, DtuScores)], means: &DtuMeans) -> String {
    let heading = [
        "scan",
        "acc.",
        "comp.",
        "overall",
        "acc. < 1 mm",
        "comp.",
        "f-score",
        "acc. < 2 mm",
        "comp.",
        "f-score",
    ];
    let row = |name: String, distances: [f64; 3], percentages: &[Percentage]| {
        let distances = distances.iter().map(|mm| format!("{mm:.3}"));
        let shares = percentages.iter().flat_map(|p| [p.accuracy, p.completeness, p.f_score]);
        std::iter::once(name)
            .chain(distances)
            .chain(shares.map(|share| format!("{:.2}", 100.0 * share)))
            .collect()
    };
    let mut rows: Vec<Vec<String>> = vec![heading.map(str::to_owned).to_vec()];
    for (scan, scores) in measured {
        let distances = [scores.accuracy.mean, scores.completeness.mean, scores.overall];
        rows.push(row(scan.to_string(), distances, &scores.percentages));
    }
    let distances = [means.accuracy, means.completeness, means.overall];
    rows.push(row("mean".to_owned(), distances, &means.percentages));
    table(&rows)
}

/// Colours end here, as in the pictures of the data set.
const COLOR_MM: f64 = 10.0;
/// The histogram's end and the width of its bars.
const HISTOGRAM_MM: f64 = 5.0;
const BAR_MM: f64 = 0.1;

fn write_figures(figures: &Figures, evaluation: &DtuEvaluation) -> Result<()> {
    figures.cloud("accuracy", &evaluation.cloud, COLOR_MM)?;
    figures.cloud("completeness", &evaluation.truth, COLOR_MM)?;
    let bars = |distances: &mut dyn Iterator<Item = f64>| Figures::histogram(distances, HISTOGRAM_MM, BAR_MM);
    let accuracy = bars(&mut evaluation.cloud.iter().map(|(_, distance)| *distance));
    let completeness = bars(&mut evaluation.truth.iter().map(|(_, distance)| *distance));
    figures.plot(
        "error_histogram",
        &LinePlot {
            title: "distances between cloud and scan",
            x_label: "distance, mm",
            y_label: "share, %",
            lines: &[
                Line { name: "accuracy", points: &accuracy },
                Line { name: "completeness", points: &completeness },
            ],
            mark: None,
        },
    )
}
