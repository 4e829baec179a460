//! What is odd about a scene and its plan, worst first, and what to do about it.

use std::collections::BTreeMap;

use nalgebra::Point3;
use planesweep_scene::{Scene, View, ViewId};
use serde::Serialize;

use crate::views::angle_deg;
use crate::{MAX_DEPTHS, MIN_POINTS, Plan, RangeOrigin, SkipReason, ViewPlan};

/// Points may be seen this far outside an image, in pixels: features are found up to its border.
const BORDER_PX: f64 = 2.0;
/// From this share of a view's points on, points outside its image or behind it are no outliers.
const WRONG_SHARE: f64 = 0.05;
/// Baselines below this angle leave depth to noise, in degrees.
const SMALL_ANGLE_DEG: f64 = 1.0;
/// From this share on, points outside the depth range are more than its tails.
const OUTSIDE_RANGE_SHARE: f64 = 0.05;
/// Names listed in a finding.
const LISTED: usize = 5;

/// How much a finding hurts, worst first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Depth maps will be wrong.
    Wrong,
    /// Views get no depth map.
    Lost,
    /// Depth maps will be less exact or less complete than they could be.
    Weak,
    /// Good to know.
    Note,
}

/// Something odd.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How much it hurts.
    pub severity: Severity,
    /// How many views it is about; all of them where it is about the scene.
    pub views: usize,
    /// What is odd.
    pub what: String,
    /// What to do about it.
    pub advice: String,
}

/// The sparse points that a view sees.
#[derive(Default)]
struct Seen {
    /// Depths (z, scene units) of those before the camera.
    depths: Vec<f64>,
    behind: usize,
    outside: usize,
    /// Angles at the points between the view and its best source, in degrees.
    angles_deg: Vec<f64>,
}

impl Seen {
    fn total(&self) -> usize {
        self.depths.len() + self.behind
    }
}

/// The depths (z, scene units) of the sparse points that each view sees, those behind it left out.
pub fn sparse_depths(scene: &Scene) -> BTreeMap<ViewId, Vec<f64>> {
    let mut depths: BTreeMap<ViewId, Vec<f64>> = BTreeMap::new();
    for (position, track) in scene.points.iter() {
        for view in track.iter().filter_map(|id| scene.views.get(id)) {
            let depth = view.camera.pose.to_camera(position).z;
            if depth > 0.0 {
                depths.entry(view.id).or_default().push(depth);
            }
        }
    }
    depths
}

/// Examines a scene and the plan that was made of it. `left_out` are the views, by name, that could not
/// be used at all, each with the reason. Pure.
pub fn checkup(scene: &Scene, left_out: &BTreeMap<String, String>, plan: &Plan) -> Vec<Finding> {
    let seen = seen_points(scene, plan);
    let mut findings = Vec::new();
    wrong(scene, &seen, &mut findings);
    lost(scene, left_out, plan, &mut findings);
    weak(scene, plan, &seen, &mut findings);
    for warning in &scene.warnings {
        let (what, advice) = (warning.what.clone(), warning.advice.to_owned());
        findings.push(Finding { severity: Severity::Note, views: scene.views.len(), what, advice });
    }
    // Stable: within one severity and number of views the order is that of the checks.
    findings.sort_by_key(|finding| (finding.severity, std::cmp::Reverse(finding.views)));
    findings
}

fn seen_points(scene: &Scene, plan: &Plan) -> BTreeMap<ViewId, Seen> {
    let best: BTreeMap<ViewId, Point3<f64>> = plan
        .views
        .iter()
        .filter_map(|view| Some((view.view, scene.views.get(view.sources.first()?)?.camera.pose.centre())))
        .collect();
    let mut seen: BTreeMap<ViewId, Seen> = BTreeMap::new();
    for (position, track) in scene.points.iter() {
        for view in track.iter().filter_map(|id| scene.views.get(id)) {
            let of_view = seen.entry(view.id).or_default();
            let depth = view.camera.pose.to_camera(position).z;
            if depth <= 0.0 {
                of_view.behind += 1;
                continue;
            }
            of_view.depths.push(depth);
            of_view.outside += usize::from(!shows(view, position));
            if let Some(source) = best.get(&view.id) {
                of_view.angles_deg.push(angle_deg(position, &view.camera.pose.centre(), source));
            }
        }
    }
    seen
}

/// Whether a point before the camera falls into the stored image, or nearly.
fn shows(view: &View, position: &Point3<f64>) -> bool {
    let point = view.camera.pose.to_camera(position);
    let (x, y) = view.distortion.distort(point.x / point.z, point.y / point.z);
    let k = &view.camera.intrinsics;
    let (u, v) = (k.fx * x + k.skew * y + k.cx, k.fy * y + k.cy);
    let within = |at: f64, side: u32| (-BORDER_PX - 0.5..side as f64 - 0.5 + BORDER_PX).contains(&at);
    within(u, k.width) && within(v, k.height)
}

/// Collects the views that have something in common into one finding.
fn about<'a>(
    findings: &mut Vec<Finding>,
    severity: Severity,
    names: impl IntoIterator<Item = &'a str>,
    what: &str,
    advice: &str,
) {
    let names: Vec<&str> = names.into_iter().collect();
    if names.is_empty() {
        return;
    }
    let mut list = names.iter().take(LISTED).copied().collect::<Vec<_>>().join(", ");
    if names.len() > LISTED {
        list.push_str(", ...");
    }
    let views = if names.len() == 1 { "1 view" } else { &format!("{} views", names.len()) };
    let what = format!("{views} {what}: {list}");
    findings.push(Finding { severity, views: names.len(), what, advice: advice.to_owned() });
}

fn wrong(scene: &Scene, seen: &BTreeMap<ViewId, Seen>, findings: &mut Vec<Finding>) {
    let where_share = |share: &dyn Fn(&Seen) -> usize| {
        let bad = |(id, seen): (&ViewId, &Seen)| {
            (share(seen) as f64 > WRONG_SHARE * seen.total() as f64).then(|| scene.views[id].name.as_str())
        };
        seen.iter().filter_map(bad).collect::<Vec<_>>()
    };
    about(
        findings,
        Severity::Wrong,
        where_share(&|seen| seen.behind),
        "have more than 5 % of their sparse points behind them",
        "check that poses are world-to-camera with z forward, and that the points are of the same model",
    );
    about(
        findings,
        Severity::Wrong,
        where_share(&|seen| seen.outside),
        "have more than 5 % of their sparse points outside their image",
        "check that focal length, principal point and image size belong to these photographs",
    );
}

fn lost(scene: &Scene, left_out: &BTreeMap<String, String>, plan: &Plan, findings: &mut Vec<Finding>) {
    let mut reasons: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (name, reason) in left_out {
        reasons.entry(reason).or_default().push(name);
    }
    for (reason, names) in reasons {
        let what = format!("cannot be used ({reason})");
        about(findings, Severity::Lost, names, &what, "mend or replace the file, or leave the view out");
    }
    for (reason, advice) in [
        (SkipReason::Isolated, "match it with its neighbours again, or take photographs that bridge the gap"),
        (SkipReason::NoDepthRange, "give a range with --depth-range NEAR,FAR"),
        (SkipReason::BadDepthRange, "mend the range in the scene's files, or give --depth-range NEAR,FAR"),
    ] {
        let names = plan.skipped.iter().filter(|(_, r)| **r == reason);
        let names = names.filter_map(|(id, _)| Some(scene.views.get(id)?.name.as_str()));
        about(findings, Severity::Lost, names, &format!("get no depth map ({reason})"), advice);
    }
}

fn weak(scene: &Scene, plan: &Plan, seen: &BTreeMap<ViewId, Seen>, findings: &mut Vec<Finding>) {
    let where_plan = |test: &dyn Fn(&ViewPlan) -> bool| {
        plan.views.iter().filter(|view| test(view)).map(|v| scene.views[&v.view].name.as_str()).collect()
    };
    let mut check = |severity, test: &dyn Fn(&ViewPlan) -> bool, what: &str, advice: &str| {
        let names: Vec<&str> = where_plan(test);
        about(findings, severity, names, what, advice);
    };
    let median_angle = |view: &ViewPlan| {
        let mut angles = seen.get(&view.view)?.angles_deg.clone();
        angles.sort_by(f64::total_cmp);
        angles.get(angles.len() / 2).copied()
    };
    check(
        Severity::Weak,
        &|view| median_angle(view).is_some_and(|angle| angle < SMALL_ANGLE_DEG),
        "see their points from less than 1 degree beside their best source view",
        "take photographs farther apart: depth is guesswork at such angles",
    );
    check(
        Severity::Weak,
        &|view| view.sources.len() + 1 < plan.options.views as usize,
        "have fewer source views than asked for",
        "take more photographs there, or ask for fewer with --views",
    );
    check(
        Severity::Weak,
        &|view| matches!(view.range_origin, RangeOrigin::NeighbourPoints(_)),
        "see too few sparse points and take the depth range of their neighbours",
        "look at whether the range fits, or give --depth-range NEAR,FAR",
    );
    check(
        Severity::Weak,
        &|view| matches!(view.range_origin, RangeOrigin::Focus(_)),
        "have a depth range that is a guess from where optical axes meet",
        "give --depth-range NEAR,FAR",
    );
    check(
        Severity::Weak,
        &|view| matches!(view.range_origin, RangeOrigin::Points(count) if count < 5 * MIN_POINTS),
        "see fewer than 100 sparse points, so their depth range is uncertain",
        "look at whether the range fits, or give --depth-range NEAR,FAR",
    );
    check(
        Severity::Weak,
        &|view| {
            let Some(seen) = seen.get(&view.view) else { return false };
            let (near, far) = (view.hypotheses.min(), view.hypotheses.max());
            let beyond = seen.depths.iter().filter(|depth| !(near..=far).contains(*depth)).count();
            beyond as f64 > OUTSIDE_RANGE_SHARE * seen.depths.len() as f64
        },
        "see more than 5 % of their sparse points outside their depth range",
        "widen the range with --depth-range NEAR,FAR, or mend that of the scene's files",
    );
    check(
        Severity::Note,
        &|view| plan.options.depths.is_none() && view.hypotheses.count() == MAX_DEPTHS,
        "would need more depth planes than are taken without being asked for",
        "give --depths, or a smaller --max-size, so that a plane moves one pixel again",
    );
    if scene.points.is_empty() {
        findings.push(Finding {
            severity: Severity::Note,
            views: scene.views.len(),
            what: "the scene has no sparse points".to_owned(),
            advice: "depth ranges come from the files or from --depth-range, source views from pair.txt or \
                     from overlapping frusta: look at both"
                .to_owned(),
        });
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use planesweep_scene::{Camera, Distortion, Intrinsics, Pose, SparsePoints, Warning};

    use super::*;
    use crate::{PlanOptions, plan};

    /// Four cameras in a row before a wall of points.
    fn scene() -> Scene {
        let intrinsics =
            Intrinsics { width: 320, height: 240, fx: 300.0, fy: 300.0, skew: 0.0, cx: 159.5, cy: 119.5 };
        let mut scene = Scene::default();
        for k in 0..4_u32 {
            let centre = Point3::new(0.4 * k as f64, 0.0, 0.0);
            let pose = Pose::look_at(&centre, &(centre + Vector3::z()), &-Vector3::y());
            let (id, name) = (ViewId(k), format!("{k}.jpg"));
            let (camera, distortion) = (Camera { intrinsics, pose }, Distortion::None);
            let image = name.clone().into();
            scene.views.insert(id, View { id, name, image, camera, distortion, depth_range: None });
        }
        for k in 0..400_u32 {
            let point = Point3::new(0.5 + 0.001 * k as f64, 0.3 * ((k % 7) as f64 - 3.0), 5.0);
            scene.points.push(point, (0..4).map(ViewId));
        }
        scene
    }

    fn findings(scene: &Scene, options: &PlanOptions) -> Vec<(Severity, usize, String)> {
        let found = checkup(scene, &scene.skipped, &plan(scene, options));
        found.into_iter().map(|f| (f.severity, f.views, f.what)).collect()
    }

    #[test]
    fn a_good_scene_has_nothing_odd() {
        let options = PlanOptions { views: 3, ..PlanOptions::default() };
        assert_eq!(findings(&scene(), &options), []);
        let depths = sparse_depths(&scene());
        assert!(depths.len() == 4 && depths[&ViewId(2)].iter().all(|depth| (depth - 5.0).abs() < 1e-12));
    }

    #[test]
    fn what_hurts_most_comes_first() {
        let mut scene = scene();
        // A camera-to-world pose, a view that was left out, one without points, and a warning.
        let pose = &mut scene.views.get_mut(&ViewId(0)).expect("a view").camera.pose;
        *pose = Pose::look_at(&pose.centre(), &Point3::new(0.0, 0.0, -1.0), &-Vector3::y());
        scene.skipped.insert("lost.jpg".to_owned(), "its file is damaged".to_owned());
        let mut stranger = scene.views[&ViewId(3)].clone();
        (stranger.id, stranger.name) = (ViewId(9), "9.jpg".to_owned());
        scene.views.insert(stranger.id, stranger);
        scene.warnings.push(Warning::new("something odd".to_owned(), "look at it"));
        let found = findings(&scene, &PlanOptions { views: 5, ..PlanOptions::default() });
        assert!(found.is_sorted_by_key(|(severity, views, _)| (*severity, std::cmp::Reverse(*views))));
        let expected = [
            (Severity::Wrong, "behind them: 0.jpg"),
            (Severity::Lost, "cannot be used (its file is damaged): lost.jpg"),
            (Severity::Lost, "isolated"),
            (Severity::Weak, "fewer source views"),
            (Severity::Note, "something odd"),
        ];
        for (severity, text) in expected {
            assert!(found.iter().any(|f| f.0 == severity && f.2.contains(text)), "{text}: {found:?}");
        }
    }

    #[test]
    fn small_baselines_foreign_cameras_and_narrow_ranges_are_found() {
        let mut close = scene();
        for view in close.views.values_mut() {
            let centre = Point3::from(view.camera.pose.centre().coords * 0.01);
            view.camera.pose = Pose::look_at(&centre, &(centre + Vector3::z()), &-Vector3::y());
        }
        let options = PlanOptions { views: 3, ..PlanOptions::default() };
        assert!(findings(&close, &options)[0].2.starts_with("4 views see their points from less than 1"));
        let mut foreign = scene();
        foreign.views.get_mut(&ViewId(1)).expect("a view").camera.intrinsics.cx = 900.0;
        assert!(findings(&foreign, &options)[0].2.ends_with("outside their image: 1.jpg"));
        let narrow = PlanOptions { depth_range: Some((6.0, 7.0)), ..options };
        assert!(findings(&scene(), &narrow)[0].2.contains("outside their depth range"));
        let mut empty = scene();
        empty.points = SparsePoints::default();
        assert!(findings(&empty, &narrow).iter().any(|f| f.2 == "the scene has no sparse points"));
    }
}
