//! `planesweep depth`: one view, in this process, without a coordinator.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_mvsnet::{CpuBackend, DepthBackend, InferInput, TorchBackend, Weights};
use planesweep_plan::{Plan, ViewPlan, plan, working_size};
use planesweep_report::plot_probability;
use planesweep_scene::{DepthMap, Raster, Scene, ViewId, WorkingImage, read_image, undistorted_intrinsics};
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::args::values::pixel;
use crate::args::{NetworkArgs, PlanArgs, ReadArgs};
use crate::console::Outcome;
use crate::input;
use crate::network::{processors, weights_or_default};
use crate::out_folder::{MapFiles, OutFolder};

/// Arguments of `depth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep depth my-colmap-project --view DSC_0001.JPG -o one-view")]
pub struct DepthArgs {
    /// The scene.
    pub scene: PathBuf,
    /// The view, by name or id.
    #[arg(long)]
    pub view: String,
    /// The folder that depth, confidence and preview go to.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Write the probability over depth at this pixel of the depth map too, as CSV and as a plot.
    #[arg(long, value_name = "X,Y", value_parser = pixel)]
    pub probe: Option<(usize, usize)>,
    #[command(flatten)]
    pub network: NetworkArgs,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// Infers and writes one depth map.
pub fn run(args: &DepthArgs) -> Result<Outcome> {
    let input::Input { scene, skipped, .. } = input::read(&args.scene, &args.read.options())?;
    for view in &skipped {
        eprintln!("skipped: {}: {}", view.view, view.reason);
    }
    let plan = plan(&scene, &args.plan.options(None));
    let view = find(&scene, &plan, &args.view)?;
    let (_, weights) = weights_or_default(args.network.weights.as_deref())?;

    let begun = Instant::now();
    let ids: Vec<ViewId> = std::iter::once(view.view).chain(view.sources.iter().copied()).collect();
    let images: Vec<WorkingImage> =
        ids.par_iter().map(|id| working_image(&scene, &plan, *id)).collect::<Result<_>>()?;
    let sources: Vec<&WorkingImage> = images[1..].iter().collect();
    let request = InferInput { reference: &images[0], sources: &sources, hypotheses: &view.hypotheses };
    let images_seconds = begun.elapsed().as_secs_f64();
    let (map, probability) = infer(args, &weights, request)?;
    let seconds = begun.elapsed().as_secs_f64();

    let name = &scene.views[&view.view].name;
    let out = OutFolder::create(&args.out, [(view.view, name.as_str())])?;
    let everything = Raster::filled(map.width(), map.height(), true);
    let files = out.write_map(view.view, &map, &everything, &view.hypotheses)?;
    let probed = write_probability(args, &out, view, &map, probability.as_deref())?;
    let confident = map.confidence.values().iter().filter(|c| **c > 0.8).count();
    let share = confident as f64 / map.confidence.values().len() as f64;
    let MapFiles { depth, confidence, preview, .. } = &files;
    let text = format!(
        "{name}: {}x{} depths in {seconds:.1} s, {:.0} % of them above confidence 0.8\n{}\n{}\n{}\n",
        map.width(),
        map.height(),
        100.0 * share,
        depth.display(),
        confidence.display(),
        preview.display(),
    );
    let value = json!({
        "view": name,
        "width": map.width(),
        "height": map.height(),
        "seconds": seconds,
        "seconds_for_images": images_seconds,
        "confident_share": share,
        "hypotheses": view.hypotheses,
        "sources": view.sources,
        "depth": depth,
        "confidence": confidence,
        "preview": preview,
        "probability": probed,
    });
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

/// The depth map, and the probability over depth at the probed pixel.
fn infer(args: &DepthArgs, weights: &Weights, input: InferInput<'_>) -> Result<(DepthMap, Option<Vec<f32>>)> {
    let probe = args.probe;
    let NetworkArgs { device, memory, .. } = &args.network;
    if device == "cpu" {
        let mut backend = CpuBackend::new(weights, processors(), *memory)?;
        let map = backend.infer(input).context("cannot infer the depth map")?;
        let probability = probe.map(|(x, y)| backend.probability(input, x, y)).transpose();
        return Ok((map, probability.context("cannot probe")?));
    }
    let device = if device == "torch" { "cpu" } else { device };
    let mut backend = TorchBackend::new(weights, device, processors())?;
    let map = backend.infer(input).context("cannot infer the depth map")?;
    let probability = probe.map(|(x, y)| backend.probability(input, x, y)).transpose();
    Ok((map, probability.context("cannot probe")?))
}

/// The plan of a view, by name or id.
pub(super) fn find<'a>(scene: &Scene, plan: &'a Plan, wanted: &str) -> Result<&'a ViewPlan> {
    let known = scene.views.values().find(|view| view.name == wanted || view.id.to_string() == wanted);
    let Some(known) = known else {
        let names: Vec<&str> = scene.views.values().take(10).map(|view| view.name.as_str()).collect();
        bail!("there is no view \"{wanted}\"; the first views are {}", names.join(", "));
    };
    if let Some(reason) = plan.skipped.get(&known.id) {
        bail!("view \"{wanted}\" cannot be inferred: {reason}");
    }
    plan.views.iter().find(|view| view.view == known.id).context("the plan leaves the view out")
}

/// The image of a view as the network takes it.
pub fn working_image(scene: &Scene, plan: &Plan, id: ViewId) -> Result<WorkingImage> {
    let view = &scene.views[&id];
    let size = undistorted_intrinsics(&view.camera.intrinsics, &view.distortion);
    let (width, height) = working_size(size.width, size.height, plan.options.max_size);
    let pixels = read_image(&view.image)?;
    WorkingImage::prepare(pixels, &view.camera, &view.distortion, width, height)
        .with_context(|| format!("cannot prepare view {}", view.name))
}

/// Writes the probability over depth at the probed pixel as CSV and as a plot like the paper's figure 3.
fn write_probability(
    args: &DepthArgs,
    out: &OutFolder,
    view: &ViewPlan,
    map: &DepthMap,
    probability: Option<&[f32]>,
) -> Result<Value> {
    let (Some(probability), Some((x, y))) = (probability, args.probe) else {
        return Ok(Value::Null);
    };
    let depths = view.hypotheses.depths();
    let mut csv = "depth,probability\n".to_owned();
    for (depth, probability) in depths.iter().zip(probability) {
        csv.push_str(&format!("{depth},{probability}\n"));
    }
    let name = format!("probability-{x}-{y}");
    let values = out.write_file(&format!("{name}.csv"), csv.as_bytes())?;
    let estimate = map.depth.get(x, y).unwrap_or(0.0);
    let svg = plot_probability(&depths, probability, f64::from(estimate));
    let plot = out.write_file(&format!("{name}.svg"), svg.as_bytes())?;
    Ok(json!({ "values": values, "plot": plot }))
}
