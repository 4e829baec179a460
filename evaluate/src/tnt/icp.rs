//! Iterative closest points with scale.

use nalgebra::{Matrix4, Point3};
use rayon::prelude::*;

use crate::nearest::NearestPoints;
use crate::similarity::{Correspondence, fit_similarity, transformed};

/// Most steps.
const MAX_STEPS: usize = 20;
/// Changes of the share of matched points and of their distance below which it ends.
const TOLERANCE: f64 = 1e-6;

/// The similarity that brings `source` onto `target`, from where they are, by matching each point with
/// the nearest one within `max_distance`; the identity where nothing matches.
pub fn refine(source: &[Point3<f64>], target: &[Point3<f64>], max_distance: f64) -> Matrix4<f64> {
    let mut total = Matrix4::identity();
    let Some(tree) = NearestPoints::new(target) else { return total };
    let mut moved = source.to_vec();
    let mut matches = Matches::new(&moved, &tree, target, max_distance);
    for _ in 0..MAX_STEPS {
        let Some(step) = fit_similarity(&matches.pairs) else { break };
        total = step * total;
        moved = transformed(&moved, &step);
        let next = Matches::new(&moved, &tree, target, max_distance);
        let settled = (next.share - matches.share).abs() < TOLERANCE
            && (next.root_mean_square - matches.root_mean_square).abs() < TOLERANCE;
        matches = next;
        if settled {
            break;
        }
    }
    total
}

/// Points with their nearest ones.
struct Matches {
    pairs: Vec<Correspondence>,
    /// Share of the points that have one within reach.
    share: f64,
    /// Of their distances.
    root_mean_square: f64,
}

impl Matches {
    fn new(points: &[Point3<f64>], tree: &NearestPoints, target: &[Point3<f64>], max_distance: f64) -> Self {
        let pairs: Vec<_> = points
            .par_iter()
            .filter_map(|point| {
                let nearest = tree.nearest(point);
                (nearest.distance < max_distance)
                    .then(|| Correspondence { from: *point, to: target[nearest.index] })
            })
            .collect();
        let squared: f64 = pairs.iter().map(|pair| nalgebra::distance_squared(&pair.from, &pair.to)).sum();
        let count = pairs.len() as f64;
        Self {
            share: count / points.len().max(1) as f64,
            root_mean_square: (squared / count.max(1.0)).sqrt(),
            pairs,
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Similarity3, Vector3};

    use super::*;

    #[test]
    fn a_small_displacement_is_undone() {
        let surface: Vec<Point3<f64>> = (0..4000)
            .map(|i| {
                let (x, y) = (f64::from(i % 80) / 20.0, f64::from(i / 80) / 20.0);
                Point3::new(x, y, (2.0 * x).sin() * (1.5 * y).cos())
            })
            .collect();
        let moved =
            Similarity3::new(Vector3::new(0.02, -0.01, 0.015), Vector3::new(0.004, -0.003, 0.005), 1.005);
        let source = transformed(&surface, &moved.to_homogeneous());
        let found = refine(&source, &surface, 0.2);
        let left = found * moved.to_homogeneous() - Matrix4::identity();
        assert!(left.abs().max() < 1e-3, "{left}");
    }

    #[test]
    fn nothing_in_reach_leaves_the_points_where_they_are() {
        let far = [Point3::new(9.0, 9.0, 9.0), Point3::new(8.0, 9.0, 9.0)];
        assert_eq!(refine(&far, &[Point3::origin()], 1.0), Matrix4::identity());
        assert_eq!(refine(&far, &[], 1.0), Matrix4::identity());
        assert_eq!(refine(&[], &far, 1.0), Matrix4::identity());
    }
}
