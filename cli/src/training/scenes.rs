//! Scenes with true depth to validate on.

use std::path::Path;

use anyhow::{Context, Result, bail};
use planesweep_evaluate::truth_at_estimate;
use planesweep_mvsnet::train::ValidationSet;
use planesweep_plan::{Plan, PlanOptions, ViewPlan, plan};
use planesweep_scene::{
    DepthHypotheses, DepthRange, ReadOptions, Scene, TrainingSample, ViewId, read_depth_pfm,
};

use crate::commands::depth::working_image;
use crate::input;

/// Views of a scene that are measured, and the size they are inferred at: enough to see a trend.
const VIEWS: usize = 4;
const MAX_SIZE: u32 = 640;

/// Adds a scene with `depth_gt/NAME.pfm` beside its images.
pub fn add_scene(set: &mut ValidationSet, folder: &Path) -> Result<()> {
    let input::Input { scene, .. } = input::read(folder, &ReadOptions::default())?;
    let options = PlanOptions { views: 3, max_size: Some(MAX_SIZE), ..PlanOptions::default() };
    let plan = plan(&scene, &options);
    let mut cases = Vec::new();
    for view in &plan.views {
        if cases.len() < VIEWS {
            cases.extend(case(folder, &scene, &plan, view)?);
        }
    }
    if cases.is_empty() {
        bail!("no view of {} has its true depth in depth_gt/NAME.pfm", folder.display());
    }
    let name = folder.file_name().map_or_else(|| "scene".to_owned(), |n| n.to_string_lossy().into_owned());
    set.add_scene(&name, cases);
    Ok(())
}

fn case(
    folder: &Path,
    scene: &Scene,
    plan: &Plan,
    view: &ViewPlan,
) -> Result<Option<(TrainingSample, DepthHypotheses)>> {
    let name = Path::new(&scene.views[&view.view].name);
    let stem = name.file_stem().unwrap_or(name.as_os_str()).to_string_lossy();
    let truths = [format!("{}.pfm", name.display()), format!("{stem}.pfm")];
    let truths = truths.map(|file| folder.join("depth_gt").join(file));
    let Some(truth) = truths.into_iter().find(|path| path.exists()) else { return Ok(None) };
    let truth = read_depth_pfm(&truth)?;
    let ids: Vec<ViewId> = std::iter::once(view.view).chain(view.sources.iter().copied()).collect();
    let views: Vec<_> = ids.iter().map(|id| working_image(scene, plan, *id)).collect::<Result<_>>()?;
    let camera = views[0].camera.intrinsics;
    let of_truth = camera.resized(truth.width() as u32, truth.height() as u32);
    let depth = truth_at_estimate(&truth, &of_truth, &camera.quartered())
        .with_context(|| format!("cannot use the true depth of view {}", name.display()))?;
    let (min, max) = (view.hypotheses.min(), view.hypotheses.max());
    let sample = TrainingSample { views, depth, range: DepthRange { min, max, count: None } };
    Ok(Some((sample, view.hypotheses)))
}
