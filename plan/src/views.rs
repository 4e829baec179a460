//! Which views help which: scores from common tracks, or from the overlap of frusta without them.

use std::collections::BTreeMap;

use nalgebra::{Point2, Point3};
use planesweep_scene::{Camera, DepthRange, Scene, SourceScore, SparsePoints, ViewId};
use rayon::prelude::*;

/// The baseline angle that counts most, in degrees.
const BEST_ANGLE_DEG: f64 = 5.0;
/// Width of the score below the best angle, in degrees.
const SIGMA_BELOW_DEG: f64 = 1.0;
/// Width of the score above the best angle, in degrees.
const SIGMA_ABOVE_DEG: f64 = 10.0;
/// Pixels per side of the grid that stands for an image where there are no sparse points.
const OVERLAP_GRID: u32 = 8;
/// Depths per pixel of that grid.
const OVERLAP_DEPTHS: u32 = 4;

/// Every view's possible source views, best first; equal scores by id.
pub type SourceRanking = BTreeMap<ViewId, Vec<SourceScore>>;

/// The piecewise Gaussian of the baseline angle (paper, section 4.1).
///
/// The paper's formula omits that the two rays are normalised.
pub fn angle_score(angle_deg: f64) -> f64 {
    let sigma = if angle_deg <= BEST_ANGLE_DEG { SIGMA_BELOW_DEG } else { SIGMA_ABOVE_DEG };
    let off = (angle_deg - BEST_ANGLE_DEG) / sigma;
    (-0.5 * off * off).exp()
}

/// The angle at `point` between the two camera centres, in degrees.
pub(crate) fn angle_deg(point: &Point3<f64>, centre_a: &Point3<f64>, centre_b: &Point3<f64>) -> f64 {
    let (a, b) = (centre_a - point, centre_b - point);
    // atan2 stays exact for the small angles that matter here, where acos loses half its digits.
    a.cross(&b).norm().atan2(a.dot(&b)).to_degrees()
}

/// Ranks source views by what the scene knows: common tracks, else its pair file, else (for views
/// that the pair file leaves out, too) the overlap between `ranges` of the frusta of `cameras`, those of
/// the undistorted images.
pub fn rank_sources(
    scene: &Scene,
    cameras: &BTreeMap<ViewId, Camera>,
    ranges: &BTreeMap<ViewId, DepthRange>,
) -> SourceRanking {
    if !scene.points.is_empty() {
        return rank_by_tracks(scene);
    }
    let known = |score: &SourceScore| scene.views.contains_key(&score.view);
    let listed = scene.pairs.iter().filter(|(id, _)| scene.views.contains_key(id));
    let mut ranking: SourceRanking =
        listed.map(|(id, sources)| (*id, sources.iter().copied().filter(known).collect())).collect();
    let unlisted: Vec<ViewId> = scene.views.keys().copied().filter(|id| !ranking.contains_key(id)).collect();
    ranking.par_extend(unlisted.par_iter().map(|id| (*id, rank_by_overlap(cameras, ranges, *id))));
    ranking
}

/// The paper's score: the sum over common tracks of [`angle_score`].
///
/// Work and memory grow with the observations times the length of the tracks, not with pairs of
/// views times points. Each view's scores are summed in the order of the points, so the result does
/// not depend on the number of threads.
fn rank_by_tracks(scene: &Scene) -> SourceRanking {
    let ids: Vec<ViewId> = scene.views.keys().copied().collect();
    let centres: Vec<Point3<f64>> = scene.views.values().map(|view| view.camera.pose.centre()).collect();
    let tracks = Tracks::of(&scene.points, &ids);
    (0..ids.len())
        .into_par_iter()
        .map_init(
            || vec![0.0_f64; ids.len()],
            |scores, reference| {
                let mut touched = Vec::new();
                for &point in tracks.points_of(reference) {
                    let position = &tracks.positions[point as usize];
                    for &source in tracks.views_of(point) {
                        if source as usize != reference {
                            if scores[source as usize] == 0.0 {
                                touched.push(source);
                            }
                            let angle = angle_deg(position, &centres[reference], &centres[source as usize]);
                            // The smallest positive number marks a view as touched even where the
                            // Gaussian underflows.
                            scores[source as usize] += angle_score(angle).max(f64::MIN_POSITIVE);
                        }
                    }
                }
                let take = |&source: &u32| {
                    let score = std::mem::take(&mut scores[source as usize]);
                    SourceScore { view: ids[source as usize], score }
                };
                (ids[reference], ranked(touched.iter().map(take).collect()))
            },
        )
        .collect()
}

/// Tracks by dense indices, both ways, in two flat arrays each.
struct Tracks<'a> {
    positions: Vec<&'a Point3<f64>>,
    view_starts: Vec<usize>,
    views: Vec<u32>,
    point_starts: Vec<usize>,
    points: Vec<u32>,
}

impl<'a> Tracks<'a> {
    fn of(points: &'a SparsePoints, ids: &[ViewId]) -> Self {
        let mut tracks = Self {
            positions: Vec::with_capacity(points.len()),
            view_starts: vec![0],
            views: Vec::new(),
            point_starts: vec![0; ids.len() + 1],
            points: Vec::new(),
        };
        for (position, track) in points.iter() {
            for index in track.iter().filter_map(|id| ids.binary_search(id).ok()) {
                tracks.views.push(index as u32);
                tracks.point_starts[index + 1] += 1;
            }
            tracks.positions.push(position);
            tracks.view_starts.push(tracks.views.len());
        }
        for index in 0..ids.len() {
            tracks.point_starts[index + 1] += tracks.point_starts[index];
        }
        let mut next = tracks.point_starts.clone();
        tracks.points = vec![0; tracks.views.len()];
        for point in 0..tracks.positions.len() {
            for &view in &tracks.views[tracks.view_starts[point]..tracks.view_starts[point + 1]] {
                tracks.points[next[view as usize]] = point as u32;
                next[view as usize] += 1;
            }
        }
        tracks
    }

    fn points_of(&self, view: usize) -> &[u32] {
        &self.points[self.point_starts[view]..self.point_starts[view + 1]]
    }

    fn views_of(&self, point: u32) -> &[u32] {
        &self.views[self.view_starts[point as usize]..self.view_starts[point as usize + 1]]
    }
}

/// Scores each source by the grid points of the reference frustum that it sees, each weighted by its
/// baseline angle.
fn rank_by_overlap(
    cameras: &BTreeMap<ViewId, Camera>,
    ranges: &BTreeMap<ViewId, DepthRange>,
    reference: ViewId,
) -> Vec<SourceScore> {
    let camera = &cameras[&reference];
    let range = ranges.get(&reference);
    let points = range.map_or_else(Vec::new, |range| frustum_points(camera, range));
    let centre = camera.pose.centre();
    let score_of = |source: &Camera| -> f64 {
        let other = source.pose.centre();
        let seen = points.iter().filter(|point| sees(source, point));
        seen.map(|point| angle_score(angle_deg(point, &centre, &other))).sum()
    };
    let others = cameras.iter().filter(|(source, _)| **source != reference);
    let scores = others.map(|(source, camera)| SourceScore { view: *source, score: score_of(camera) });
    ranked(scores.filter(|source| source.score > 0.0).collect())
}

/// Whether a world point falls into the image.
pub(crate) fn sees(camera: &Camera, point: &Point3<f64>) -> bool {
    let (width, height) = (camera.intrinsics.width as f64, camera.intrinsics.height as f64);
    camera.project(point).is_some_and(|(pixel, _)| {
        pixel.x >= -0.5 && pixel.y >= -0.5 && pixel.x < width - 0.5 && pixel.y < height - 0.5
    })
}

/// A grid of world points that fills the frustum of a camera, evenly in inverse depth.
pub(crate) fn frustum_points(camera: &Camera, range: &DepthRange) -> Vec<Point3<f64>> {
    let steps = |n: u32| (0..n).map(move |k| (k as f64 + 0.5) / n as f64);
    let (width, height) = (camera.intrinsics.width as f64, camera.intrinsics.height as f64);
    let mut points = Vec::with_capacity((OVERLAP_GRID * OVERLAP_GRID * OVERLAP_DEPTHS) as usize);
    for v in steps(OVERLAP_GRID) {
        for u in steps(OVERLAP_GRID) {
            for t in steps(OVERLAP_DEPTHS) {
                let depth = 1.0 / (1.0 / range.min + t * (1.0 / range.max - 1.0 / range.min));
                points.push(camera.unproject(&Point2::new(u * width - 0.5, v * height - 0.5), depth));
            }
        }
    }
    points
}

fn ranked(mut scores: Vec<SourceScore>) -> Vec<SourceScore> {
    scores.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.view.cmp(&b.view)));
    scores
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use planesweep_scene::{Distortion, Intrinsics, Pose, View};

    use super::*;

    fn scene_with_centres(xs: &[f64]) -> Scene {
        let intrinsics =
            Intrinsics { width: 100, height: 100, fx: 100.0, fy: 100.0, skew: 0.0, cx: 49.5, cy: 49.5 };
        let mut scene = Scene::default();
        for (k, x) in xs.iter().enumerate() {
            let id = ViewId(10 * k as u32 + 1);
            let pose =
                Pose::look_at(&Point3::new(*x, 0.0, 0.0), &Point3::new(0.0, 0.0, 10.0), &-Vector3::y());
            let view = View {
                id,
                name: format!("{k}.png"),
                image: format!("{k}.png").into(),
                camera: Camera { intrinsics, pose },
                distortion: Distortion::None,
                depth_range: None,
            };
            scene.views.insert(id, view);
        }
        scene
    }

    fn rank(scene: &Scene, ranges: &BTreeMap<ViewId, DepthRange>) -> SourceRanking {
        rank_sources(scene, &scene.undistorted_cameras(), ranges)
    }

    #[test]
    fn the_angle_is_measured_between_normalised_rays_in_degrees() {
        let origin = Point3::new(0.0, 0.0, 10.0);
        let angle = angle_deg(&origin, &Point3::new(0.0, 0.0, 0.0), &Point3::new(10.0, 0.0, 10.0));
        assert!((angle - 90.0).abs() < 1e-12);
        assert_eq!(angle_score(5.0), 1.0);
        assert!((angle_score(4.0) - (-0.5_f64).exp()).abs() < 1e-15);
        assert!((angle_score(15.0) - (-0.5_f64).exp()).abs() < 1e-15);
    }

    #[test]
    fn the_best_baseline_comes_first_and_strangers_are_absent() {
        // Angles at the point (0, 0, 10) to view 1: 0.57, 5.7 and 45 degrees.
        let mut scene = scene_with_centres(&[0.0, 0.1, 1.0, 10.0, 3.0]);
        let all_but_last = [ViewId(1), ViewId(11), ViewId(21), ViewId(31)];
        scene.points.push(Point3::new(0.0, 0.0, 10.0), all_but_last);
        scene.points.push(Point3::new(0.0, 0.0, 10.0), [ViewId(41), ViewId(999)]);
        let ranking = rank(&scene, &BTreeMap::new());
        let order: Vec<u32> = ranking[&ViewId(1)].iter().map(|s| s.view.0).collect();
        assert_eq!(order, [21, 31, 11]);
        assert!(ranking[&ViewId(41)].is_empty(), "a view that shares nothing has no sources");
    }

    #[test]
    fn scores_are_symmetric_and_match_the_plain_formula() {
        let mut scene = scene_with_centres(&[0.0, 0.7, 1.5, 2.0]);
        let ids: Vec<ViewId> = scene.views.keys().copied().collect();
        for k in 0..40_u32 {
            let point = Point3::new(0.1 * k as f64 - 2.0, 0.05 * k as f64, 8.0 + 0.2 * k as f64);
            scene.points.push(point, ids.iter().copied().filter(|id| (k + id.0) % 3 != 0));
        }
        let ranking = rank(&scene, &BTreeMap::new());
        let score = |a: ViewId, b: ViewId| ranking[&a].iter().find(|s| s.view == b).map_or(0.0, |s| s.score);
        for &a in &ids {
            for &b in ids.iter().filter(|b| **b != a) {
                let (ca, cb) = (scene.views[&a].camera.pose.centre(), scene.views[&b].camera.pose.centre());
                let common = scene.points.iter().filter(|(_, t)| t.contains(&a) && t.contains(&b));
                let plain: f64 = common.map(|(p, _)| angle_score(angle_deg(p, &ca, &cb))).sum();
                assert!((score(a, b) - plain).abs() <= 1e-12 * plain);
                assert!((score(a, b) - score(b, a)).abs() <= 1e-12 * plain);
            }
        }
    }

    #[test]
    fn without_tracks_frusta_decide() {
        let scene = scene_with_centres(&[0.0, 1.0, 60.0]);
        let range = DepthRange { min: 8.0, max: 12.0, count: None };
        let ranges = scene.views.keys().map(|id| (*id, range)).collect();
        let ranking = rank(&scene, &ranges);
        assert_eq!(ranking[&ViewId(1)][0].view, ViewId(11));
        assert!(rank(&scene, &BTreeMap::new())[&ViewId(1)].is_empty());
    }

    #[test]
    fn a_pair_file_that_leaves_views_out_is_completed_by_overlap() {
        let mut scene = scene_with_centres(&[0.0, 1.0, 2.0]);
        let stated = |view: u32| SourceScore { view: ViewId(view), score: 1.0 };
        scene.pairs.insert(ViewId(1), vec![stated(21), stated(99)]);
        let range = DepthRange { min: 8.0, max: 12.0, count: None };
        let ranges = scene.views.keys().map(|id| (*id, range)).collect();
        let ranking = rank(&scene, &ranges);
        assert_eq!(ranking[&ViewId(1)], [stated(21)]);
        assert_eq!(ranking[&ViewId(11)].len(), 2);
    }
}
