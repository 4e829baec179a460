//! `planesweep fuse`: depth maps to a point cloud, whoever made them.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use planesweep_fusion::{
    FilterOptions, Funnel, Fused, LasWriter, PlyWriter, Preset, VertexFormat, ViewPoints, VisibilityWriter,
    Work, fuse_out_of_core,
};
use planesweep_plan::{BlobKey, NUMERICS_VERSION};
use planesweep_scene::{DepthFiles, DepthMap, ViewId, first_reasons};
use serde_json::json;

use crate::args::values::bytes;
use crate::args::{FilterArgs, ReadArgs};
use crate::console::{Outcome, Progress, shortest};
use crate::depth_maps::{self, DepthMaps, Neighbourhood};
use crate::out_folder::make_folder_of;
use crate::workspace::Workspace;

/// Arguments of `fuse`.
#[derive(Debug, Args)]
#[command(
    after_help = "DIR is a folder that `reconstruct` made, or one in the MVSNet layout: cams/, images/, pair.txt, \
    and depth maps as depth_est/ID.pfm with confidence/ID.pfm, or depths_mvsnet/ID_init.pfm with ID_prob.pfm.\n\
    Example: planesweep fuse mvsnet-outputs/scan1 -o cloud.ply --preset mvsnet"
)]
pub struct FuseArgs {
    /// The depth maps.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// The cloud: .ply, .las or .laz.
    #[arg(short, long)]
    pub out: PathBuf,
    /// The thresholds of a common evaluation script; each can be overridden.
    #[arg(long, value_enum, conflicts_with = "fusion")]
    pub preset: Option<PresetArg>,
    /// Folder with a mask per view, NAME.png or STEM.png: what is black there is left out. By default
    /// STEM.mask.png beside the photographs.
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Memory, such as 512M or 2G; any number of views fits into it.
    #[arg(long, value_name = "SIZE", default_value = "2G", value_parser = bytes)]
    pub memory: u64,
    /// Write the confidence and the number of views of each point, too (PLY).
    #[arg(long)]
    pub quality: bool,
    /// Write which views see each point to OUT.vis, as COLMAP does beside its fused.ply.
    #[arg(long)]
    pub vis: bool,
    /// Write photographs, cameras, depth and normal maps as a dense workspace of COLMAP to this folder, too, for its
    /// stereo_fusion and its meshers.
    #[arg(long, value_name = "FOLDER")]
    pub workspace: Option<PathBuf>,
    /// Forget what an interrupted run for the same file has done.
    #[arg(long)]
    pub fresh: bool,
    #[command(flatten)]
    pub filter: FilterArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// [`Preset`] on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum PresetArg {
    /// MVSNet's PyTorch port: confidence 0.8, three sources within 1 pixel and 1 %.
    Mvsnet,
    /// CasMVSNet's static filter: confidence 0.9, five sources within 1 pixel and 1 %.
    Casmvsnet,
    /// Dynamic consistency as D2HC-RMVSNet has it: confidence 0.3, n sources within n/4 pixels and n/1300.
    Dynamic,
}

impl From<PresetArg> for Preset {
    fn from(arg: PresetArg) -> Self {
        match arg {
            PresetArg::Mvsnet => Self::MvsNet,
            PresetArg::Casmvsnet => Self::CasMvsNet,
            PresetArg::Dynamic => Self::Dynamic,
        }
    }
}

/// Memory of the program itself, most of it the network's library, and of the view in work, in multiples of its pixels.
const BASE_BYTES: u64 = 120 << 20;
const WORK_BYTES_PER_PIXEL: u64 = 256;
/// Less for the maps than this is no use.
const LEAST_MAP_BYTES: u64 = 16 << 20;

/// Fuses.
pub fn run(args: &FuseArgs, json: bool) -> Result<Outcome> {
    let begun = Instant::now();
    let format = Format::of(&args.out)?;
    let preset = args.preset.map(Preset::from);
    let mut options = match preset {
        Some(preset) => args.filter.options_over(preset.options()),
        None => args.filter.options(),
    };
    let neighbourhood =
        Neighbourhood { count: args.filter.fusion_views as usize, symmetric: preset.is_none() };
    let maps = depth_maps::find(&args.folder, args.masks.as_deref(), neighbourhood, &args.read.options())?;
    for warning in &maps.warnings {
        eprintln!("warning: {warning}");
    }
    options.network_pixel = maps.network_pixel;
    if args.filter.full_resolution {
        options.network_pixel *= upsampling(&maps);
    }
    let photographs = maps.files.values().map(|files| files.view.image.as_path());
    let workspace = args.workspace.clone().map(|root| Workspace::create(root, &args.folder, photographs));
    let mut workspace = workspace.transpose()?;
    let work = work(args, &maps, options);
    if args.fresh && work.scratch.exists() {
        fs::remove_dir_all(&work.scratch)
            .with_context(|| format!("cannot remove {}", work.scratch.display()))?;
    }
    make_folder_of(&args.out)?;
    let mut outputs = Outputs::create(args, format, &maps)?;
    let load = |view: ViewId| -> Result<DepthMap, Box<dyn std::error::Error + Send + Sync>> {
        let files = &maps.files[&view];
        Ok(if args.filter.full_resolution { files.read_upsampled()? } else { files.read()? })
    };
    let steps = 2 * work.views.len();
    let mut progress = Progress::new(steps as u64);
    let mut show = |done: usize| {
        if !json {
            progress.show(done as u64, (done as f64, steps as f64), "");
        }
    };
    let fused = fuse_out_of_core(&work, &load, &mut show, &mut |points| {
        if let Some(workspace) = &mut workspace {
            workspace.add(&maps.files[&points.view], points.map, points.neighbours)?;
        }
        outputs.write(&points)
    })?;
    progress.finish();
    let funnel: Funnel = fused.funnels.values().copied().sum();
    if let Some(empty) = funnel.emptied_by() {
        let reasons =
            first_reasons(fused.skipped.iter().map(|(view, why)| (&maps.files[view].view.name, why)));
        if fused.funnels.is_empty() {
            bail!("no view of {} could be read{reasons}", args.folder.display());
        }
        let left_out = if reasons.is_empty() { "" } else { "; left out" };
        bail!("{empty}{left_out}{reasons}");
    }
    workspace.map(Workspace::finish).transpose()?;
    outputs.finish()?;
    fs::remove_dir_all(&work.scratch).with_context(|| format!("cannot remove {}", work.scratch.display()))?;
    Ok(outcome(args, &maps, &fused, options, begun))
}

fn work(args: &FuseArgs, maps: &DepthMaps, options: FilterOptions) -> Work {
    let views = maps.order.iter().map(|view| (*view, maps.neighbours[view].clone())).collect();
    let fingerprint =
        format!("{NUMERICS_VERSION} {options:?} {}\n{}", args.filter.full_resolution, maps.fingerprint());
    let largest = maps.files.values().map(|files| files.view.camera.intrinsics).map(|k| k.width * k.height);
    let working = BASE_BYTES + WORK_BYTES_PER_PIXEL * u64::from(largest.max().unwrap_or(0)) / 16;
    Work {
        views,
        options,
        once_per_surface: !args.filter.every_view,
        memory_bytes: args.memory.saturating_sub(working).max(LEAST_MAP_BYTES),
        scratch: beside(&args.out, ".parts"),
        fingerprint: BlobKey::of(fingerprint.as_bytes()).to_string(),
    }
}

/// Pixels of the photographs to one of the depth maps: of the first pair that can be read.
fn upsampling(maps: &DepthMaps) -> f32 {
    let read = |files: &DepthFiles| {
        let (map, photograph) = files.read_with_photograph().ok()?;
        Some(photograph.camera.intrinsics.fx / map.camera.intrinsics.fx)
    };
    maps.files.values().find_map(read).unwrap_or(1.0) as f32
}

/// What matters of a coordinate: a tenth of the smallest pixel.
fn resolution(maps: &DepthMaps) -> f64 {
    let pixels = maps.cameras().filter_map(|(camera, nearest)| Some(nearest? / camera.intrinsics.fx));
    pixels.fold(f64::INFINITY, f64::min) / 10.0
}

/// The path with something behind its name.
fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(suffix);
    PathBuf::from(name)
}

#[derive(Clone, Copy, PartialEq)]
enum Format {
    Ply,
    Las,
}

impl Format {
    fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().map(OsStr::to_ascii_lowercase);
        match extension.as_ref().and_then(|e| e.to_str()) {
            Some("ply") => Ok(Self::Ply),
            Some("las" | "laz") => Ok(Self::Las),
            _ => bail!("cannot tell the format of {}: .ply, .las and .laz are written", path.display()),
        }
    }
}

/// The files that points go to.
struct Outputs {
    ply: Option<PlyWriter>,
    las: Option<LasWriter>,
    vis: Option<VisibilityWriter>,
    /// What views are called in the visibility file: their place in the order of ids.
    numbers: BTreeMap<ViewId, u32>,
}

impl Outputs {
    fn create(args: &FuseArgs, format: Format, maps: &DepthMaps) -> Result<Self> {
        let double = maps.cameras().any(|(camera, nearest)| VertexFormat::needs_doubles(camera, nearest));
        let vertex = VertexFormat { double, quality: args.quality };
        let path = &args.out;
        Ok(Self {
            ply: (format == Format::Ply).then(|| PlyWriter::create(path, vertex)).transpose()?,
            las: (format == Format::Las).then(|| LasWriter::create(path, resolution(maps))).transpose()?,
            vis: args.vis.then(|| VisibilityWriter::create(&beside(path, ".vis"))).transpose()?,
            numbers: maps.files.keys().copied().zip(0..).collect(),
        })
    }

    fn write(&mut self, view: &ViewPoints<'_>) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        if let Some(ply) = &mut self.ply {
            ply.write(view.points)?;
        }
        if let Some(las) = &mut self.las {
            las.write(view.points)?;
        }
        if let Some(vis) = &mut self.vis {
            let neighbours: Vec<u32> = view.neighbours.iter().map(|view| self.numbers[view]).collect();
            vis.write(self.numbers[&view.view], &neighbours, view.points)?;
        }
        Ok(())
    }

    fn finish(self) -> Result<()> {
        // The cloud last: where it stands, the rest does too.
        self.vis.map(VisibilityWriter::finish).transpose()?;
        self.las.map(LasWriter::finish).transpose()?;
        self.ply.map(PlyWriter::finish).transpose()?;
        Ok(())
    }
}

fn outcome(
    args: &FuseArgs,
    maps: &DepthMaps,
    fused: &Fused,
    options: FilterOptions,
    begun: Instant,
) -> Outcome {
    let funnel: Funnel = fused.funnels.values().copied().sum();
    let name = |view: &ViewId| maps.files[view].view.name.clone();
    let mut skipped: BTreeMap<String, String> =
        fused.skipped.iter().map(|(view, why)| (name(view), why.clone())).collect();
    skipped.extend(maps.without.iter().map(|name| (name.clone(), "it has no depth map".to_owned())));
    let mut text = String::new();
    for (step, left) in funnel.steps() {
        text.push_str(&format!("{left:>12}  {step}\n"));
    }
    for (view, reason) in &skipped {
        text.push_str(&format!("skipped: {view}: {reason}\n"));
    }
    let seconds = begun.elapsed().as_secs_f64();
    text.push_str(&format!(
        "{} points of {} views in {} ({seconds:.1} s)\n",
        funnel.emitted,
        fused.funnels.len(),
        args.out.display()
    ));
    let funnels: BTreeMap<String, Funnel> = fused.funnels.iter().map(|(view, f)| (name(view), *f)).collect();
    let value = json!({
        "out": args.out,
        "points": funnel.emitted,
        "options": shortest(&options),
        "funnel": funnel,
        "views": funnels,
        "skipped": skipped,
        "resumed": fused.resumed,
        "seconds": seconds,
    });
    Outcome { text, value, skipped_views: !skipped.is_empty() }
}
