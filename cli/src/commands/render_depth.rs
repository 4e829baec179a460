//! `planesweep render-depth`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_plan::rank_sources;
use planesweep_scene::{Camera, DepthRange, View, ViewId, read_scene, undistorted_intrinsics};
use planesweep_synth::{MeshDepthOptions, depth_range_of_mesh, read_mesh, write_mesh_depth};
use serde_json::json;

use crate::args::ReadArgs;
use crate::console::Outcome;
use crate::out_folder::check_empty;

/// Arguments of `render-depth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep render-depth scan2.ply my-colmap-project training/scan2")]
pub struct RenderDepthArgs {
    /// The surface: triangles as PLY, OBJ or NPZ, in the frame of the cameras.
    pub mesh: PathBuf,
    /// The scene whose cameras see it, in any format that `reconstruct` reads.
    pub cameras: PathBuf,
    /// The MVSNet folder to write, a new or empty one: images, cams, pair.txt and rendered_depth_maps.
    pub out: PathBuf,
    /// Source views per reference view at most; a pixel that none of them sees is dropped.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub sources: u32,
    /// Keep depth that no source view sees.
    #[arg(long)]
    pub keep_unseen: bool,
    /// Keep depth where the mesh shows its back, such as the far side seen through a hole.
    #[arg(long)]
    pub keep_back_faces: bool,
    /// How the cameras are read.
    #[command(flatten)]
    pub read: ReadArgs,
}

/// Renders depth maps of a mesh.
pub fn run(args: &RenderDepthArgs) -> Result<Outcome> {
    check_empty(&args.out)?;
    let mut scene = read_scene(&args.cameras, &args.read.options())
        .with_context(|| format!("cannot read the scene {}", args.cameras.display()))?;
    let mesh = read_mesh(&args.mesh)?;
    let options = MeshDepthOptions { keep_unseen: args.keep_unseen, keep_back_faces: args.keep_back_faces };
    let cameras: BTreeMap<ViewId, Camera> = scene
        .views
        .iter()
        .map(|(id, View { camera: Camera { intrinsics, pose }, distortion, .. })| {
            (*id, Camera { intrinsics: undistorted_intrinsics(intrinsics, distortion), pose: *pose })
        })
        .collect();
    // What of the mesh a view shows says which others show the same, if the scene itself does not.
    let ranges: BTreeMap<ViewId, DepthRange> = cameras
        .iter()
        .filter_map(|(id, camera)| Some((*id, depth_range_of_mesh(&mesh, camera, &options)?)))
        .collect();
    if ranges.is_empty() {
        bail!(
            "no view of {} shows the front of {}: are both in one frame, and are its triangles turned outwards (if not: --keep-back-faces)?",
            args.cameras.display(),
            args.mesh.display()
        );
    }
    scene.pairs = rank_sources(&scene, &cameras, &ranges);
    for sources in scene.pairs.values_mut() {
        sources.truncate(args.sources as usize);
    }
    let report = write_mesh_depth(&mesh, &scene, &args.out, &options)
        .with_context(|| format!("cannot render depth into {}", args.out.display()))?;
    let text = format!(
        "{} triangles; {} depth maps with {} pixels are in {}; {} views have none\n",
        mesh.len(),
        report.views,
        report.pixels,
        args.out.display(),
        report.empty_views
    );
    Ok(Outcome {
        text,
        value: json!({
            "out": args.out,
            "triangles": mesh.len(),
            "views": report.views,
            "empty_views": report.empty_views,
            "pixels": report.pixels,
        }),
        skipped_views: !scene.skipped.is_empty(),
    })
}
