//! `planesweep evaluate photometric`: depth maps against photographs that they were not made from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_evaluate::{PhotometricErrors, PhotometricPoint, photometric_error};
use planesweep_plan::{BlobKey, working_size};
use planesweep_report::{Line, LinePlot};
use planesweep_scene::{
    Camera, DepthMap, Raster, ViewId, WorkingImage, read_depth_pfm, read_image, read_pfm,
    undistorted_intrinsics,
};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;

use super::figures::Figures;
use super::skipped::split;
use crate::console::{Outcome, table};
use crate::run_record::{RecordedView, RunRecord};

/// Arguments of `evaluate photometric`.
#[derive(Debug, Args)]
#[command(
    after_help = "For each view, the best of the views that overlap with it and were no source of its depth map \
    is compared in colour; no true depth is needed. The photographs must still be where they were.\n\
    Example: planesweep evaluate photometric demo/out"
)]
pub struct PhotometricArgs {
    /// A folder that `reconstruct` made.
    pub result: PathBuf,
    /// Write a plot and all figures to this folder.
    #[arg(short, long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
}

/// Points of the curve of error against kept share.
const CURVE_POINTS: usize = 20;
/// Of them, those that the table shows, with their headings.
const SHOWN: [(usize, &str); 3] = [(9, "kept 50 %"), (15, "80 %"), (19, "100 %")];

/// Compares depth maps with photographs.
pub fn run(args: &PhotometricArgs) -> Result<Outcome> {
    let record = RunRecord::read(&args.result)?;
    let views: BTreeMap<ViewId, &RecordedView> = record.views.iter().map(|view| (view.id, view)).collect();
    let held_out = |view: &RecordedView| {
        let other = view.neighbours.iter().find(|id| !view.sources.contains(id))?;
        views.get(other).copied()
    };
    let pairs: Vec<(&RecordedView, &RecordedView)> =
        record.views.iter().filter_map(|view| Some((view, held_out(view)?))).collect();
    let judge = |(view, other): &(&RecordedView, &RecordedView)| {
        let errors = measure(args, &record, view, other);
        let judged =
            errors.map(|errors| Judged { view: view.name.clone(), held_out: other.name.clone(), errors });
        (view.name.clone(), judged)
    };
    let (measured, skipped) = split(pairs.par_iter().map(judge).collect());
    let curve = mean_curve(&measured);
    if curve.is_empty() {
        bail!(
            "no view of {} can be compared with one that is no source of it{}",
            args.result.display(),
            skipped.reasons()
        );
    }
    let value = json!({
        "mean": { "views": measured.len(), "curve": curve },
        "views": measured,
        "skipped": skipped.value(),
    });
    if let Some(folder) = &args.out {
        let figures = Figures::create(folder)?;
        figures.json("photometric", &value)?;
        write_plot(&figures, &curve)?;
    }
    let mut rows = vec![["view", "held out", "pixels"].map(str::to_owned).to_vec()];
    rows[0].extend(SHOWN.map(|(_, heading)| heading.to_owned()));
    let shown = |curve: &[PhotometricPoint]| {
        let at =
            |(place, _): (usize, _)| curve.get(place).map_or("-".to_owned(), |p| format!("{:.2}", p.mean));
        SHOWN.map(at)
    };
    for Judged { view, held_out, errors } in &measured {
        rows.push(vec![view.clone(), held_out.clone(), errors.pixels.to_string()]);
        rows.last_mut().context("a row")?.extend(shown(&errors.curve));
    }
    let mut mean = vec!["mean over views".to_owned(), String::new(), String::new()];
    mean.extend(shown(&curve));
    rows.push(mean);
    let text = format!(
        "{}mean difference in grey levels of 255, of the most confident pixels\n{}",
        skipped.lines(),
        table(&rows)
    );
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

/// A view, the one that its depth map is compared with, and what came of it.
#[derive(Serialize)]
struct Judged {
    view: String,
    held_out: String,
    errors: PhotometricErrors,
}

fn measure(
    args: &PhotometricArgs,
    record: &RunRecord,
    view: &RecordedView,
    other: &RecordedView,
) -> Result<PhotometricErrors> {
    let file = |kind: &str| args.result.join(kind).join(format!("{}.pfm", view.file));
    let (_, color) = map_colors(record, view)?;
    let map = DepthMap::new(
        view.depth_camera,
        read_depth_pfm(&file("depth"))?,
        read_pfm(&file("confidence"))?,
        color,
    )?;
    let (camera, colors) = map_colors(record, other)?;
    Ok(photometric_error(&map, &camera, &colors, CURVE_POINTS))
}

/// The colours of a view at the size of its depth map, with the depth map's camera.
fn map_colors(record: &RunRecord, view: &RecordedView) -> Result<(Camera, Raster<[u8; 3]>)> {
    let image = read_recorded(&view.image, &view.image_blake3)?;
    let undistorted = undistorted_intrinsics(&view.image_camera.intrinsics, &view.distortion);
    let (width, height) = working_size(undistorted.width, undistorted.height, record.options.max_size);
    let image = WorkingImage::prepare(image, &view.image_camera, &view.distortion, width, height)?;
    let size = &view.depth_camera.intrinsics;
    Ok((view.depth_camera, image.map_colors(size.width as usize, size.height as usize)))
}

fn read_recorded(path: &Path, recorded: &BlobKey) -> Result<Raster<[u8; 3]>> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    if BlobKey::of(&bytes) != *recorded {
        bail!("{} has changed since the depth maps were made", path.display());
    }
    Ok(read_image(path)?)
}

/// The mean over views of each point of their curves.
fn mean_curve(measured: &[Judged]) -> Vec<PhotometricPoint> {
    let at = |place: usize| {
        let points: Vec<&PhotometricPoint> =
            measured.iter().filter_map(|judged| judged.errors.curve.get(place)).collect();
        let count = points.len() as f64;
        let mean = |of: fn(&PhotometricPoint) -> f64| points.iter().map(|p| of(p)).sum::<f64>() / count;
        (!points.is_empty()).then(|| PhotometricPoint {
            kept: mean(|p| p.kept),
            median: mean(|p| p.median),
            mean: mean(|p| p.mean),
        })
    };
    (0..CURVE_POINTS).filter_map(at).collect()
}

fn write_plot(figures: &Figures, curve: &[PhotometricPoint]) -> Result<()> {
    let line = |of: fn(&PhotometricPoint) -> f64| -> Vec<(f64, f64)> {
        curve.iter().map(|point| (100.0 * point.kept, of(point))).collect()
    };
    let (median, mean) = (line(|p| p.median), line(|p| p.mean));
    figures.plot(
        "photometric",
        &LinePlot {
            title: "difference to a held-out photograph",
            x_label: "kept, %",
            y_label: "grey levels",
            lines: &[Line { name: "median", points: &median }, Line { name: "mean", points: &mean }],
            mark: None,
        },
    )
}
