//! From a scene to what is to be done for each view.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

use nalgebra::Point3;
use planesweep_scene::{Camera, DepthHypotheses, DepthRange, Scene, ViewId};
use rayon::iter::Either;
use rayon::prelude::*;
use serde::Serialize;

use crate::bands::bands;
use crate::depth_range::{choose_sampling, hypotheses, robust_range};
use crate::focus::focus_ranges;
use crate::job::MaskSpec;
use crate::options::PlanOptions;
use crate::order::{order_views, symmetric_neighbours};
use crate::size::working_size;
use crate::views::{SourceRanking, rank_sources, sees};

/// What is to be done, view by view, and what cannot be.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// The choices it was made with.
    pub options: PlanOptions,
    /// The views to infer, in the order of work.
    pub views: Vec<ViewPlan>,
    /// The views that get no depth map, with the reason, by id.
    pub skipped: BTreeMap<ViewId, SkipReason>,
    /// What is left out of the depth maps of views; empty until whoever reads the disk fills it.
    #[serde(skip)]
    pub masks: BTreeMap<ViewId, MaskSpec>,
}

/// What is to be done for one view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewPlan {
    /// The reference view.
    pub view: ViewId,
    /// Its source views, best first; at least one.
    pub sources: Vec<ViewId>,
    /// The views that its depth map is checked against, best first; symmetric over all views.
    pub neighbours: Vec<ViewId>,
    /// Its depth planes.
    pub hypotheses: DepthHypotheses,
    /// Where the depth range comes from.
    pub range_origin: RangeOrigin,
    /// Size of the working image, not padded.
    pub working_size: (u32, u32),
    /// Rows of the depth map that each of its inferences gives, from the top; empty when one gives all.
    pub bands: Vec<Range<u32>>,
}

/// Where a depth range comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RangeOrigin {
    /// The user gave it.
    Option,
    /// The scene's files name it.
    File,
    /// The sparse points that the view sees; how many.
    Points(usize),
    /// The sparse points of its best neighbours, because it sees too few itself; how many.
    NeighbourPoints(usize),
    /// Where its optical axis meets those of other views, for want of points; how many.
    Focus(usize),
}

/// Why a view gets no depth map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SkipReason {
    /// It shares nothing with any other view.
    Isolated,
    /// Neither it nor its neighbours see enough sparse points, and no range was given.
    NoDepthRange,
    /// Its depth range cannot be divided into hypotheses.
    BadDepthRange,
}

impl fmt::Display for SkipReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Isolated => "isolated: shares nothing with the other views",
            Self::NoDepthRange => "no depth range: too few sparse points in it and its neighbours",
            Self::BadDepthRange => "its depth range cannot be divided into hypotheses",
        })
    }
}

/// How many of a view's best neighbours lend it their points.
const LENDING_NEIGHBOURS: usize = 4;

/// Decides for every view what is to be done. Pure: the same scene and options give the same plan.
pub fn plan(scene: &Scene, options: &PlanOptions) -> Plan {
    let cameras = scene.undistorted_cameras();
    let stated = stated_ranges(scene, &cameras, options);
    let known = stated.iter().map(|(view, (range, _))| (*view, *range)).collect();
    let mut ranking = rank_sources(scene, &cameras, &known);
    let seen = points_by_view(scene);
    let mut skipped = BTreeMap::new();
    let mut ranges = BTreeMap::new();
    for &view in scene.views.keys() {
        let sources = ranking.get(&view).map_or(&[][..], Vec::as_slice);
        if sources.is_empty() {
            skipped.insert(view, SkipReason::Isolated);
        } else if let Some(range) = range_of(&cameras[&view], &stated, &seen, &ranking, view) {
            ranges.insert(view, range);
        } else {
            skipped.insert(view, SkipReason::NoDepthRange);
        }
    }
    // An isolated view is nobody's source; one without a depth range still is, but has no depth map
    // to check against.
    let sources = ranking.clone();
    ranking.retain(|view, _| ranges.contains_key(view));
    let mut neighbours = symmetric_neighbours(&ranking, options.fusion_views as usize);

    let order = order_views(&ranking);
    let planned = order.into_par_iter().map(|view| {
        let (range, origin) = ranges[&view];
        let best: Vec<ViewId> =
            sources[&view].iter().map(|s| s.view).take(options.views.max(2) as usize - 1).collect();
        let working = |id: ViewId| working_camera(&cameras[&id], options);
        let reference = working(view);
        let sampling = choose_sampling(options.sampling, &range);
        let points = seen.get(&view).map_or(&[][..], Vec::as_slice);
        let hypotheses = hypotheses(&reference, &working(best[0]), points, &range, sampling, options.depths);
        let working_size = (reference.intrinsics.width, reference.intrinsics.height);
        let hypotheses = hypotheses.map_err(|_| view)?;
        Ok(ViewPlan {
            view,
            sources: best,
            neighbours: Vec::new(),
            hypotheses,
            range_origin: origin,
            working_size,
            bands: bands(reference.intrinsics.quartered().height, options.band_rows),
        })
    });
    let (mut views, refused): (Vec<ViewPlan>, Vec<ViewId>) =
        planned.partition_map(|view: Result<ViewPlan, ViewId>| match view {
            Ok(view) => Either::Left(view),
            Err(view) => Either::Right(view),
        });
    skipped.extend(refused.into_iter().map(|view| (view, SkipReason::BadDepthRange)));
    for view in &mut views {
        view.neighbours = neighbours.remove(&view.view).unwrap_or_default();
        view.neighbours.retain(|neighbour| !skipped.contains_key(neighbour));
    }
    Plan { options: options.clone(), views, skipped, masks: BTreeMap::new() }
}

/// The camera of a view's image at working size.
fn working_camera(camera: &Camera, options: &PlanOptions) -> Camera {
    let (width, height) = working_size(camera.intrinsics.width, camera.intrinsics.height, options.max_size);
    Camera { intrinsics: camera.intrinsics.resized(width, height), ..*camera }
}

/// The depth ranges that need no points: the user's, those of the scene's files, or, where there are no
/// points at all, those of the cameras' common focus.
fn stated_ranges(
    scene: &Scene,
    cameras: &BTreeMap<ViewId, Camera>,
    options: &PlanOptions,
) -> BTreeMap<ViewId, (DepthRange, RangeOrigin)> {
    let is_valid = |range: &DepthRange| range.min > 0.0 && range.max > range.min && range.max.is_finite();
    let given = options.depth_range.map(|(min, max)| DepthRange { min, max, count: None });
    let origin = if given.is_some() { RangeOrigin::Option } else { RangeOrigin::File };
    let views = scene.views.values();
    let mut ranges: BTreeMap<_, _> = views
        .filter_map(|view| Some((view.id, (given.or(view.depth_range).filter(is_valid)?, origin))))
        .collect();
    if scene.points.is_empty() && ranges.len() < scene.views.len() {
        for (view, (range, axes)) in focus_ranges(cameras) {
            ranges.entry(view).or_insert((range, RangeOrigin::Focus(axes)));
        }
    }
    ranges
}

/// The sparse points (world) that each view sees.
fn points_by_view(scene: &Scene) -> BTreeMap<ViewId, Vec<Point3<f64>>> {
    let mut seen: BTreeMap<ViewId, Vec<Point3<f64>>> = BTreeMap::new();
    for (position, track) in scene.points.iter() {
        for view in track.iter().filter(|view| scene.views.contains_key(view)) {
            seen.entry(*view).or_default().push(*position);
        }
    }
    seen
}

fn range_of(
    camera: &Camera,
    stated: &BTreeMap<ViewId, (DepthRange, RangeOrigin)>,
    seen: &BTreeMap<ViewId, Vec<Point3<f64>>>,
    ranking: &SourceRanking,
    view: ViewId,
) -> Option<(DepthRange, RangeOrigin)> {
    if let Some(stated) = stated.get(&view) {
        return Some(*stated);
    }
    let depth = |point: &Point3<f64>| camera.pose.to_camera(point).z;
    let own = seen.get(&view).map_or(&[][..], Vec::as_slice);
    if let Some(range) = robust_range(own.iter().map(depth).collect()) {
        return Some((range, RangeOrigin::Points(own.len())));
    }
    let lent = ranking[&view].iter().take(LENDING_NEIGHBOURS).filter_map(|source| seen.get(&source.view));
    let lent: Vec<f64> = lent.flatten().filter(|point| sees(camera, point)).map(depth).collect();
    let count = lent.len();
    robust_range(lent).map(|range| (range, RangeOrigin::NeighbourPoints(count)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use planesweep_scene::{Distortion, Intrinsics, Pose, Sampling, View};

    use super::*;

    /// Five cameras in a row that look at a wall of points; the last one looks away.
    fn scene() -> Scene {
        let intrinsics =
            Intrinsics { width: 320, height: 240, fx: 300.0, fy: 300.0, skew: 0.0, cx: 159.5, cy: 119.5 };
        let mut scene = Scene::default();
        for k in 0..5_u32 {
            let centre = Point3::new(0.4 * k as f64, 0.0, 0.0);
            let ahead = centre + if k == 4 { -Vector3::z() } else { Vector3::z() };
            let camera = Camera { intrinsics, pose: Pose::look_at(&centre, &ahead, &-Vector3::y()) };
            let view = View {
                id: ViewId(3 * k),
                name: format!("{k}.jpg"),
                image: format!("{k}.jpg").into(),
                camera,
                distortion: Distortion::None,
                depth_range: None,
            };
            scene.views.insert(view.id, view);
        }
        for k in 0..400_u32 {
            let point =
                Point3::new(0.01 * k as f64 - 1.0, 0.3 * ((k % 7) as f64 - 3.0), 5.0 + 0.002 * k as f64);
            let views = scene.views.values().filter(|v| sees(&v.camera, &point)).map(|v| v.id);
            let track: Vec<ViewId> = views.collect();
            scene.points.push(point, track);
        }
        scene
    }

    #[test]
    fn every_view_is_planned_or_skipped_with_its_reason() {
        let plan = plan(&scene(), &PlanOptions { views: 3, ..PlanOptions::default() });
        assert_eq!(plan.skipped, BTreeMap::from([(ViewId(12), SkipReason::Isolated)]));
        let mut ids: Vec<u32> = plan.views.iter().map(|v| v.view.0).collect();
        ids.sort_unstable();
        assert_eq!(ids, [0, 3, 6, 9]);
        for view in &plan.views {
            assert_eq!(view.sources.len(), 2);
            assert_eq!(view.neighbours.len(), 3);
            assert!(!view.sources.contains(&view.view));
            assert_eq!(view.working_size, (320, 240));
            assert_eq!(view.hypotheses.sampling(), Sampling::Uniform);
            assert!(view.hypotheses.min() < 5.0 && view.hypotheses.max() > 5.78);
            assert!(matches!(view.range_origin, RangeOrigin::Points(n) if n > 100));
        }
    }

    #[test]
    fn a_view_with_too_few_points_borrows_its_neighbours_range() {
        let mut scene = scene();
        let points = scene.points.clone();
        scene.points = planesweep_scene::SparsePoints::default();
        for (k, (position, track)) in points.iter().enumerate() {
            // View 3 keeps five of its points: enough to know its neighbours, not its range.
            let keep = |view: &&ViewId| **view != ViewId(3) || k % 80 == 40;
            scene.points.push(*position, track.iter().filter(keep).copied().collect::<Vec<_>>());
        }
        let plan = plan(&scene, &PlanOptions::default());
        let view = plan.views.iter().find(|v| v.view == ViewId(3)).expect("planned");
        assert!(matches!(view.range_origin, RangeOrigin::NeighbourPoints(n) if n > 100));
        assert!(view.hypotheses.min() > 4.0 && view.hypotheses.max() < 7.0);
    }

    #[test]
    fn the_users_range_and_count_win() {
        let options = PlanOptions {
            depth_range: Some((1.0, 50.0)),
            depths: Some(96),
            max_size: Some(160),
            ..PlanOptions::default()
        };
        let plan = plan(&scene(), &options);
        let view = &plan.views[0];
        assert_eq!((view.hypotheses.min(), view.hypotheses.max()), (1.0, 50.0));
        assert_eq!((view.hypotheses.count(), view.hypotheses.sampling()), (96, Sampling::Inverse));
        assert_eq!(view.range_origin, RangeOrigin::Option);
        assert_eq!(view.working_size, (160, 120));
    }

    #[test]
    fn a_range_that_cannot_be_divided_is_named() {
        let mut scene = scene();
        let tiny = DepthRange { min: f64::MIN_POSITIVE, max: f64::MAX, count: Some(1) };
        scene.views.get_mut(&ViewId(3)).expect("exists").depth_range = Some(tiny);
        let options = PlanOptions { sampling: crate::SamplingChoice::Uniform, ..PlanOptions::default() };
        let plan = plan(&scene, &options);
        assert_eq!(plan.views.len() + plan.skipped.len(), scene.views.len());
        let absurd = DepthRange { min: 1.0, max: 2.0, count: Some(u32::MAX) };
        scene.views.get_mut(&ViewId(3)).expect("exists").depth_range = Some(absurd);
        let plan = super::plan(&scene, &options);
        let view = plan.views.iter().find(|v| v.view == ViewId(3)).expect("planned");
        assert_eq!(view.hypotheses.count(), crate::depth_range::MOST_DEPTHS);
    }

    #[test]
    fn an_empty_scene_gives_an_empty_plan() {
        let plan = plan(&Scene::default(), &PlanOptions::default());
        assert!(plan.views.is_empty() && plan.skipped.is_empty());
    }
}
