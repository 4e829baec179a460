//! What a laser scanner saw of a place: a surface, free space, or nothing.
//!
//! Each point of a scan is the end of a beam that came from the scanner at the origin through free space.
//! The beams near a place are those in about its direction, so the ends are kept by their direction.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::Eth3dOptions;
use crate::nearest::NearestPoints;

/// What is known of a point of a cloud.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observed {
    /// The place of the least tolerance at which it is accurate; their number when it never is.
    pub first_accurate: usize,
    /// Whether a beam went through it and on.
    pub is_in_free_space: bool,
}

impl Observed {
    /// Of a point that no beam came near.
    pub fn nothing(tolerances: usize) -> Self {
        Self { first_accurate: tolerances, is_in_free_space: false }
    }

    /// Adds what another scan or beam says.
    pub fn merge(&mut self, other: Self) {
        self.first_accurate = self.first_accurate.min(other.first_accurate);
        self.is_in_free_space |= other.is_in_free_space;
    }
}

/// The points of a scan by their direction from the scanner.
pub struct ScannedDirections {
    ends: Vec<Point3<f64>>,
    directions: Vec<Vector3<f64>>,
    by_direction: NearestPoints,
}

impl ScannedDirections {
    /// Of points in the frame of the scanner; those at the scanner or nowhere are left out. `None` when
    /// none is left.
    pub fn new(points: &[Point3<f64>]) -> Option<Self> {
        let (ends, directions): (Vec<_>, Vec<_>) = points
            .par_iter()
            .filter_map(|end| {
                let distance = end.coords.norm();
                (distance > 0.0 && distance.is_finite()).then(|| (*end, end.coords / distance))
            })
            .unzip();
        let on_sphere: Vec<Point3<f64>> = directions.iter().copied().map(Point3::from).collect();
        Some(Self { ends, directions, by_direction: NearestPoints::new(&on_sphere)? })
    }

    /// What the beams that `place`, in the frame of the scanner, lies in say of it.
    pub fn observe(&self, place: &Point3<f64>, options: &Eth3dOptions) -> Observed {
        let mut observed = Observed::nothing(options.tolerances.len());
        let distance = place.coords.norm();
        let radius = options.beam_radius + distance * options.beam_half_angle.tan();
        // A ray passes within the radius when the angle between it and the place's direction has a sine
        // of at most radius / distance; the chord of that angle is what a search on the sphere takes.
        let angle = (radius / distance).min(1.0).asin();
        let direction = if distance > 0.0 { place.coords / distance } else { Vector3::x() };
        // A little more, for the rounding of what is tested exactly below.
        let chord = if distance > 0.0 { 2.0 * (0.5 * angle).sin() * (1.0 + 1e-9) } else { 2.0 };
        for beam in self.by_direction.within(&Point3::from(direction), chord) {
            let along = self.directions[beam].dot(&place.coords);
            let beside = (place.coords - along * self.directions[beam]).norm();
            if along < 0.0 || beside > radius {
                continue;
            }
            let end = &self.ends[beam];
            let off = (end - place).norm();
            let first_accurate = options.tolerances.partition_point(|tolerance| *tolerance < off);
            observed.merge(Observed { first_accurate, is_in_free_space: along < end.coords.norm() });
        }
        observed
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn points(most: usize) -> impl Strategy<Value = Vec<Point3<f64>>> {
        let point = (-1.0..1.0, -1.0..1.0, -1.0..1.0).prop_map(|(x, y, z)| Point3::new(x, y, z));
        prop::collection::vec(point, 1..most)
    }

    proptest! {
        /// Beams as wide as rooms, so that places lie in many of them, and some contain the scanner.
        #[test]
        fn searching_by_direction_finds_what_all_beams_together_say(
            scan in points(60), places in points(20), beam_radius in 0.01..0.4, half_angle in 0.01..0.4
        ) {
            let options = Eth3dOptions {
                tolerances: vec![0.1, 0.2, 0.4],
                beam_radius,
                beam_half_angle: half_angle,
                ..Eth3dOptions::default()
            };
            let directions = ScannedDirections::new(&scan).expect("points");
            for place in places.iter().chain([&Point3::origin()]) {
                let mut expected = Observed::nothing(3);
                for end in &scan {
                    // The beam is a cone about the ray through the end, tested in the plane of both.
                    let ray = end.coords.normalize();
                    let (along, beside) = (ray.dot(&place.coords), ray.cross(&place.coords).norm());
                    if along >= 0.0 && beside <= beam_radius + place.coords.norm() * half_angle.tan() {
                        let off = nalgebra::distance(end, place);
                        let first = options.tolerances.iter().take_while(|t| **t < off).count();
                        expected.merge(Observed {
                            first_accurate: first,
                            is_in_free_space: along < end.coords.norm(),
                        });
                    }
                }
                prop_assert_eq!(directions.observe(place, &options), expected);
            }
        }
    }

    #[test]
    fn no_beams_see_nothing() {
        assert!(ScannedDirections::new(&[Point3::origin(), Point3::new(f64::NAN, 0.0, 0.0)]).is_none());
    }
}
