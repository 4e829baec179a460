//! View selection as the script `colmap2mvsnet.py` does it, step by step, for comparison: the points of
//! every pair of views are searched for common ones.

use std::collections::BTreeMap;

use planesweep_scene::{Scene, ViewId};

/// Each view's ten best source views with their scores, best first.
pub fn rank(scene: &Scene) -> BTreeMap<ViewId, Vec<(ViewId, f64)>> {
    let ids: Vec<ViewId> = scene.views.keys().copied().collect();
    let positions: Vec<_> = scene.points.iter().map(|(position, _)| *position).collect();
    let mut points_of = vec![Vec::new(); ids.len()];
    for (k, (_, track)) in scene.points.iter().enumerate() {
        for view in track {
            points_of[ids.binary_search(view).expect("a view of the scene")].push(k);
        }
    }
    let mut scores = vec![vec![0.0; ids.len()]; ids.len()];
    for i in 0..ids.len() {
        for j in i + 1..ids.len() {
            let centre = |k: usize| scene.views[&ids[k]].camera.pose.centre();
            let mut score = 0.0;
            for point in points_of[i].iter().filter(|point| points_of[j].contains(point)) {
                let (a, b) = (centre(i) - positions[*point], centre(j) - positions[*point]);
                let angle = (a.dot(&b) / a.norm() / b.norm()).acos().to_degrees();
                let sigma = if angle <= 5.0 { 1.0 } else { 10.0 };
                score += f64::exp(-(angle - 5.0) * (angle - 5.0) / (2.0 * sigma * sigma));
            }
            (scores[i][j], scores[j][i]) = (score, score);
        }
    }
    let best = |i: usize| {
        let mut sources: Vec<_> = ids.iter().copied().zip(scores[i].iter().copied()).collect();
        sources.sort_by(|a, b| b.1.total_cmp(&a.1));
        sources.truncate(10);
        sources
    };
    ids.iter().enumerate().map(|(i, id)| (*id, best(i))).collect()
}
