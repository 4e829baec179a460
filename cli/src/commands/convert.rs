//! `planesweep convert`.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use planesweep_plan::{PlanOptions, plan, rank_sources};
use planesweep_scene::{DepthRange, Scene, TargetFormat, read_scene, write_scene};
use serde_json::json;

use crate::args::ReadArgs;
use crate::console::Outcome;
use crate::out_folder::check_empty;

/// Source views that a pair.txt lists for each view.
const LISTED_SOURCES: usize = 10;

/// Arguments of `convert`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep convert my-colmap-project --to mvsnet my-mvsnet-folder")]
pub struct ConvertArgs {
    /// The scene.
    pub scene: PathBuf,
    /// The folder that the converted scene goes to, with its images; a new or empty one.
    pub out: PathBuf,
    /// The format to write.
    #[arg(long, value_enum)]
    pub to: TargetArg,
    /// Undistort all images; COLMAP then gets a dense workspace.
    #[arg(long)]
    pub undistort: bool,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// [`TargetFormat`] on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum TargetArg {
    /// A binary COLMAP model in sparse/.
    Colmap,
    /// A COLMAP model in text.
    ColmapText,
    /// An MVSNet folder; depth ranges and source views come from the sparse points.
    Mvsnet,
    /// sfm_data.json of OpenMVG.
    Openmvg,
}

/// Writes a scene in another format and says what that cannot hold.
pub fn run(args: &ConvertArgs) -> Result<Outcome> {
    // Of two scenes in one folder the wrong one may be read, and views that only one has would stay.
    check_empty(&args.out)?;
    let mut scene = read_scene(&args.scene, &args.read.options())
        .with_context(|| format!("cannot read the scene {}", args.scene.display()))?;
    let format = match args.to {
        TargetArg::Colmap => TargetFormat::Colmap,
        TargetArg::ColmapText => TargetFormat::ColmapText,
        TargetArg::Mvsnet => TargetFormat::Mvsnet,
        TargetArg::Openmvg => TargetFormat::OpenMvg,
    };
    let mut notes = Vec::new();
    if format == TargetFormat::Mvsnet {
        notes = complete(&mut scene);
    }
    let held = write_scene(&scene, format, args.undistort, &args.out)
        .with_context(|| format!("cannot write the scene to {}", args.out.display()))?;
    let views = held.scene.views.len();
    let mut text = format!("{views} views are in {}\n", args.out.display());
    for warning in &scene.warnings {
        text.push_str(&format!("warning: {warning}\n"));
    }
    for (view, reason) in &scene.skipped {
        text.push_str(&format!("left out: view {view}: {reason}\n"));
    }
    for note in &notes {
        text.push_str(&format!("added: {note}\n"));
    }
    for loss in &held.losses {
        text.push_str(&format!("not held: {loss}\n"));
    }
    let value = json!({
        "out": args.out,
        "views": views,
        "warnings": scene.warnings.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "added": notes,
        "not_held": held.losses,
        "resampled": held.resampled,
        "skipped": scene.skipped,
    });
    Ok(Outcome { text, value, skipped_views: !scene.skipped.is_empty() })
}

/// Adds what an MVSNet folder needs and the scene can tell: depth ranges and source views.
fn complete(scene: &mut Scene) -> Vec<String> {
    let mut notes = Vec::new();
    let planned = plan(scene, &PlanOptions::default());
    let mut added = 0;
    for planned in &planned.views {
        if let Some(view) = scene.views.get_mut(&planned.view)
            && view.depth_range.is_none()
        {
            let planes = &planned.hypotheses;
            view.depth_range =
                Some(DepthRange { min: planes.min(), max: planes.max(), count: Some(planes.count()) });
            added += 1;
        }
    }
    if added > 0 {
        notes.push(format!("depth ranges of {added} views, as planned for reconstruction"));
    }
    if scene.pairs.is_empty() {
        let ranges = scene.views.values().filter_map(|view| Some((view.id, view.depth_range?))).collect();
        scene.pairs = rank_sources(scene, &scene.undistorted_cameras(), &ranges);
        scene.pairs.values_mut().for_each(|sources| sources.truncate(LISTED_SOURCES));
        notes.push(format!("up to {LISTED_SOURCES} source views of each view"));
    }
    notes
}
