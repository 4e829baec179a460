//! `planesweep evaluate consistency`: how many pixels the views agree on, whatever their confidences mean.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_fusion::{FilterOptions, FusionMethod, filter};
use planesweep_report::{Line, LinePlot};
use planesweep_scene::{DepthMap, Raster, ViewId, read_depth_pfm, read_pfm};
use rayon::prelude::*;
use serde_json::json;

use super::figures::Figures;
use super::skipped::split;
use crate::console::{Outcome, table};
use crate::run_record::{RecordedView, RunRecord};

/// Arguments of `evaluate consistency`.
#[derive(Debug, Args)]
#[command(
    after_help = "The most confident share of each view's pixels is kept, so that networks whose confidences \
    mean different things can be compared; of these, the share is given that enough views agree on.\n\
    Example: planesweep evaluate consistency demo/out"
)]
pub struct ConsistencyArgs {
    /// A folder that `reconstruct` made.
    pub result: PathBuf,
    /// Views that must agree on a depth, the reference included.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=255))]
    pub min_views: u32,
    /// Write a plot and all figures to this folder.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
}

/// Shares that are kept.
const STEPS: u32 = 10;

/// Counts.
pub fn run(args: &ConsistencyArgs) -> Result<Outcome> {
    let record = RunRecord::read(&args.result)?;
    let read =
        |view: &RecordedView| (view.name.clone(), read_ranked(&args.result, view).map(|map| (view.id, map)));
    let (maps, skipped) = split(record.views.par_iter().map(read).collect());
    let maps: BTreeMap<ViewId, DepthMap> = maps.into_iter().collect();
    if maps.is_empty() {
        bail!("{} has no depth map{}", args.result.display(), skipped.reasons());
    }
    let consistent: Vec<(f64, f64)> = (1..=STEPS)
        .map(|step| {
            let kept = f64::from(step) / f64::from(STEPS);
            let options = FilterOptions {
                method: FusionMethod::Consistency,
                min_confidence: (1.0 - kept) as f32,
                min_views: args.min_views,
                ..FilterOptions::default()
            };
            let shares = record.views.iter().filter_map(|view| {
                let neighbours: Vec<&DepthMap> =
                    view.neighbours.iter().filter_map(|id| maps.get(id)).collect();
                let funnel = filter(maps.get(&view.id)?, &neighbours, &options).funnel;
                Some(funnel.geometric as f64 / funnel.photometric.max(1) as f64)
            });
            (kept, shares.sum::<f64>() / maps.len() as f64)
        })
        .collect();
    let curve: Vec<_> =
        consistent.iter().map(|(kept, share)| json!({ "kept": kept, "consistent": share })).collect();
    let value = json!({
        "views": maps.len(),
        "min_views": args.min_views,
        "curve": curve,
        "skipped": skipped.value(),
    });
    if let Some(folder) = &args.out {
        let figures = Figures::create(folder)?;
        figures.json("consistency", &value)?;
        write_plot(&figures, &consistent)?;
    }
    let mut rows = vec![["kept", "consistent"].map(str::to_owned).to_vec()];
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    rows.extend(consistent.iter().map(|(kept, share)| vec![percent(*kept), percent(*share)]));
    let text = format!(
        "{}mean over {} views: share of the most confident pixels that {} views agree on\n{}",
        skipped.lines(),
        maps.len(),
        args.min_views,
        table(&rows)
    );
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

/// A depth map whose confidence is the share of its pixels that are less confident.
fn read_ranked(result: &Path, view: &RecordedView) -> Result<DepthMap> {
    let file = |kind: &str| result.join(kind).join(format!("{}.pfm", view.file));
    let (depth, confidence) = (read_depth_pfm(&file("depth"))?, read_pfm(&file("confidence"))?);
    let mut order: Vec<usize> = (0..confidence.values().len()).collect();
    // Stable: equal confidences rank in pixel order.
    order.sort_by(|a, b| confidence.values()[*a].total_cmp(&confidence.values()[*b]));
    let mut ranks = Raster::filled(confidence.width(), confidence.height(), 0.0_f32);
    for (rank, pixel) in order.iter().enumerate() {
        ranks.values_mut()[*pixel] = rank as f32 / order.len() as f32;
    }
    let color = Raster::filled(depth.width(), depth.height(), [0; 3]);
    DepthMap::new(view.depth_camera, depth, ranks, color)
        .with_context(|| format!("cannot use the depth map of view {}", view.name))
}

fn write_plot(figures: &Figures, consistent: &[(f64, f64)]) -> Result<()> {
    let percent: Vec<(f64, f64)> =
        consistent.iter().map(|(kept, share)| (100.0 * kept, 100.0 * share)).collect();
    figures.plot(
        "consistency",
        &LinePlot {
            title: "pixels that the views agree on",
            x_label: "kept, %",
            y_label: "of these consistent, %",
            lines: &[Line { name: "consistent", points: &percent }],
            mark: None,
        },
    )
}
