//! Nearest points of a cloud, exactly.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Point3;
use rayon::prelude::*;

/// A point of a cloud, and how far it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// Its place in the cloud.
    pub index: usize,
    /// Its distance.
    pub distance: f64,
}

/// A cloud that can be asked for the points near a place; a k-d tree.
///
/// Where several points are equally near, any of them may be given, but always the same one.
#[derive(Debug)]
pub struct NearestPoints {
    tree: ImmutableKdTree<f64, 3>,
}

impl NearestPoints {
    /// Prepares a cloud; `None` when it has no points or one whose position is not finite.
    pub fn new(points: &[Point3<f64>]) -> Option<Self> {
        let is_finite = points.par_iter().all(|point| point.iter().all(|v| v.is_finite()));
        if points.is_empty() || !is_finite {
            return None;
        }
        let positions: Vec<[f64; 3]> = points.iter().map(|point| (*point).into()).collect();
        ImmutableKdTree::new_from_slice(&positions).ok().map(|tree| Self { tree })
    }

    /// The point nearest to `place`, whose coordinates are finite.
    pub fn nearest(&self, place: &Point3<f64>) -> Nearest {
        let found = self.tree.query(&(*place).into()).nearest_one::<SquaredEuclidean<f64>>().execute();
        Nearest { index: found.item as usize, distance: found.distance.sqrt() }
    }

    /// The distance from each place to the point nearest to it, in the order of `places`.
    pub fn distances(&self, places: &[Point3<f64>]) -> Vec<f64> {
        places.par_iter().map(|place| self.nearest(place).distance).collect()
    }

    /// The places in the cloud of all points at most `radius` away from `place`, in no meaningful order.
    pub fn within(&self, place: &Point3<f64>, radius: f64) -> impl Iterator<Item = usize> {
        let place: [f64; 3] = (*place).into();
        let query = self.tree.query(&place);
        let found = query.within::<SquaredEuclidean<f64>>(radius * radius).unsorted().execute();
        found.into_iter().map(|found| found.item as usize)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn points() -> impl Strategy<Value = Vec<Point3<f64>>> {
        // Few values per axis, so that points coincide and lie in common planes.
        let coordinate = || (-4_i8..4).prop_map(|v| f64::from(v) / 2.0);
        let point = (coordinate(), coordinate(), coordinate());
        prop::collection::vec(point.prop_map(|(x, y, z)| Point3::new(x, y, z)), 1..300)
    }

    proptest! {
        #[test]
        fn what_is_found_is_what_comparing_with_all_finds(cloud in points(), places in points(), radius in 0.1..2.0) {
            let tree = NearestPoints::new(&cloud).expect("finite points");
            let distances = tree.distances(&places);
            for (place, distance) in places.iter().zip(distances) {
                let least = cloud.iter().map(|p| nalgebra::distance(p, place)).fold(f64::INFINITY, f64::min);
                prop_assert!((distance - least).abs() < 1e-12);
                let found = tree.nearest(place);
                prop_assert!((nalgebra::distance(&cloud[found.index], place) - least).abs() < 1e-12);
                let mut within: Vec<usize> = tree.within(place, radius).collect();
                within.sort_unstable();
                let near = |i: &usize| nalgebra::distance_squared(&cloud[*i], place) <= radius * radius;
                prop_assert_eq!(within, (0..cloud.len()).filter(near).collect::<Vec<_>>());
            }
        }
    }

    #[test]
    fn no_points_and_points_nowhere_are_refused() {
        assert!(NearestPoints::new(&[]).is_none());
        assert!(NearestPoints::new(&[Point3::new(0.0, f64::NAN, 0.0)]).is_none());
    }
}
