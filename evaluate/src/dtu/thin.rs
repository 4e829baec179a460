//! One point where there were many.

use nalgebra::Point3;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use crate::nearest::NearestPoints;

/// Points of which no two are within `radius` of each other, and which have one within `radius` of each
/// point that was dropped, in the order of `points`.
///
/// The points are visited in an order that the seed decides; one that is still there drops all others
/// within `radius`. Points that are not finite are dropped first.
pub fn thin(points: &[Point3<f64>], radius: f64, seed: u64) -> Vec<Point3<f64>> {
    let finite: Vec<Point3<f64>> =
        points.iter().filter(|p| p.iter().all(|v| v.is_finite())).copied().collect();
    let Some(tree) = NearestPoints::new(&finite) else { return Vec::new() };
    let mut order: Vec<usize> = (0..finite.len()).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    let mut is_kept = vec![true; finite.len()];
    for visited in order {
        if is_kept[visited] {
            for near in tree.within(&finite[visited], radius) {
                is_kept[near] = false;
            }
            is_kept[visited] = true;
        }
    }
    finite.into_iter().zip(is_kept).filter_map(|(point, is_kept)| is_kept.then_some(point)).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn kept_points_are_apart_and_cover_the_others(
            points in prop::collection::vec(prop::array::uniform3(0.0..1.0), 0..200),
            radius in 0.05..0.5,
            seed in any::<u64>(),
        ) {
            let mut points: Vec<Point3<f64>> = points.into_iter().map(Point3::from).collect();
            let kept = thin(&points, radius, seed);
            for (i, point) in kept.iter().enumerate() {
                prop_assert!(kept[..i].iter().all(|other| nalgebra::distance(point, other) > radius));
            }
            for point in &points {
                prop_assert!(kept.iter().any(|other| nalgebra::distance(point, other) <= radius));
            }
            points.push(Point3::new(f64::NAN, 0.0, 0.0));
            prop_assert_eq!(thin(&points, radius, seed), kept);
        }
    }
}
