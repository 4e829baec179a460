//! A folder of depth maps: one that `reconstruct` made, or one in the MVSNet layout.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail};
use planesweep_plan::{SourceRanking, order_views, rank_sources, symmetric_neighbours, working_size};
use planesweep_scene::{
    Camera, DepthFiles, MapGeometry, ReadOptions, SourceScore, View, ViewId, find_depth_files, find_mask,
    read_scene, undistorted_intrinsics,
};

use crate::input::no_mask_matches;
use crate::run_record::{FILE_NAME, RunRecord};

/// Depth maps on disk, and who is checked against whom.
pub struct DepthMaps {
    /// By view.
    pub files: BTreeMap<ViewId, DepthFiles>,
    /// The views that each is checked against, best first.
    pub neighbours: BTreeMap<ViewId, Vec<ViewId>>,
    /// The views in an order in which neighbours follow each other.
    pub order: Vec<ViewId>,
    /// What was odd.
    pub warnings: Vec<String>,
    /// The views without a depth map.
    pub without: Vec<String>,
    /// Pixels of the maps to one of the network's maps.
    pub network_pixel: f32,
}

/// Who is checked against whom.
#[derive(Clone, Copy)]
pub struct Neighbourhood {
    /// The best of each view.
    pub count: usize,
    /// Whether a view is checked against those, too, that are checked against it; the common scripts
    /// don't.
    pub symmetric: bool,
}

/// Finds the depth maps of a folder. Those of a folder that `reconstruct` made keep the neighbours that
/// they were planned with.
pub fn find(
    folder: &Path,
    masks: Option<&Path>,
    neighbourhood: Neighbourhood,
    options: &ReadOptions,
) -> Result<DepthMaps> {
    let is_result = folder.join(FILE_NAME).exists();
    let found = if is_result { of_result(folder, masks)? } else { of_mvsnet_folder(folder, masks, options)? };
    let Found { files, mut ranking, mut warnings, without, network_pixel } = found;
    if files.is_empty() {
        bail!(
            "no depth map is in {}: depth/, depth_est/ or depths_mvsnet/ with ID.pfm or ID_init.pfm are looked for",
            folder.display()
        );
    }
    let masked = files.values().filter(|files| files.mask.is_some()).count();
    warnings.extend(no_mask_matches(masks, masked));
    ranking.retain(|view, _| files.contains_key(view));
    for sources in ranking.values_mut() {
        sources.retain(|source| files.contains_key(&source.view));
    }
    for view in files.keys() {
        ranking.entry(*view).or_default();
    }
    let neighbours = if is_result {
        // As they were planned, so that the same options give the same cloud.
        ranking.iter().map(|(view, sources)| (*view, sources.iter().map(|s| s.view).collect())).collect()
    } else if neighbourhood.symmetric {
        symmetric_neighbours(&ranking, neighbourhood.count)
    } else {
        let best =
            |sources: &Vec<SourceScore>| sources.iter().take(neighbourhood.count).map(|s| s.view).collect();
        ranking.iter().map(|(view, sources)| (*view, best(sources))).collect()
    };
    Ok(DepthMaps { order: order_views(&ranking), files, neighbours, warnings, without, network_pixel })
}

struct Found {
    files: BTreeMap<ViewId, DepthFiles>,
    ranking: SourceRanking,
    warnings: Vec<String>,
    without: Vec<String>,
    network_pixel: f32,
}

/// Of a folder that `reconstruct` made: its record knows everything.
fn of_result(folder: &Path, masks: Option<&Path>) -> Result<Found> {
    let record = RunRecord::read(folder)?;
    let (mut files, mut ranking) = (BTreeMap::new(), SourceRanking::new());
    for recorded in record.views {
        let size = undistorted_intrinsics(&recorded.image_camera.intrinsics, &recorded.distortion);
        let (width, height) = working_size(size.width, size.height, record.options.max_size);
        let view = View {
            id: recorded.id,
            name: recorded.name,
            image: recorded.image,
            camera: recorded.image_camera,
            distortion: recorded.distortion,
            depth_range: Some(crate::out_folder::depth_range(&recorded.hypotheses)),
        };
        let map = |kind: &str| folder.join(kind).join(format!("{}.pfm", recorded.file));
        let mask = find_mask(&view, masks);
        let geometry = if record.options.full_resolution {
            MapGeometry::Whole { width, height }
        } else {
            MapGeometry::QuarterOf { width, height }
        };
        let depth_files =
            DepthFiles { view, geometry, depth: map("depth"), confidence: Some(map("confidence")), mask };
        files.insert(recorded.id, depth_files);
        // The order is all that is known of the scores.
        let count = recorded.neighbours.len();
        let score =
            |(rank, view): (usize, &ViewId)| SourceScore { view: *view, score: (count - rank) as f64 };
        ranking.insert(recorded.id, recorded.neighbours.iter().enumerate().map(score).collect());
    }
    let network_pixel = record.options.filter.network_pixel;
    Ok(Found { files, ranking, warnings: Vec::new(), without: Vec::new(), network_pixel })
}

fn of_mvsnet_folder(folder: &Path, masks: Option<&Path>, options: &ReadOptions) -> Result<Found> {
    let mut scene =
        read_scene(folder, options).with_context(|| format!("cannot read {}", folder.display()))?;
    let (mut files, mut without) = (BTreeMap::new(), Vec::new());
    for (id, view) in &scene.views {
        match find_depth_files(folder, view, masks) {
            Some(found) => {
                files.insert(*id, found);
            }
            None => without.push(view.name.clone()),
        }
    }
    let ranges = scene.views.values().filter_map(|view| Some((view.id, view.depth_range?))).collect();
    // Whoever made the depth maps meant these pairs.
    if !scene.pairs.is_empty() {
        scene.points = planesweep_scene::SparsePoints::default();
    }
    let ranking = rank_sources(&scene, &scene.undistorted_cameras(), &ranges);
    let left_out = scene.skipped.iter().map(|(view, reason)| format!("view {view} is left out: {reason}"));
    let warnings = scene.warnings.iter().map(ToString::to_string).chain(left_out).collect();
    Ok(Found { files, ranking, warnings, without, network_pixel: 1.0 })
}

impl DepthMaps {
    /// What determines the depth maps: files with their sizes and times of change, cameras and
    /// neighbours.
    pub fn fingerprint(&self) -> String {
        let of = |(view, files): (&ViewId, &DepthFiles)| {
            format!("{:?}\n{}{:?}\n", files.view, files.state(), self.neighbours.get(view))
        };
        self.files.iter().map(of).collect()
    }

    /// Cameras of the photographs, each with the nearest depth that is expected.
    pub fn cameras(&self) -> impl Iterator<Item = (&Camera, Option<f64>)> {
        self.files.values().map(|files| (&files.view.camera, files.view.depth_range.map(|range| range.min)))
    }
}
