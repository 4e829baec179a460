//! Depth ranges where nothing but cameras is known: photographers look at what they take.

use std::collections::BTreeMap;

use planesweep_scene::{Camera, DepthRange, ViewId};
use rayon::prelude::*;

/// Optical axes that meet at a smaller angle, in degrees, meet anywhere.
const SMALLEST_ANGLE_DEG: f64 = 5.0;
/// Fewer axes than this that meet a view's say nothing.
const FEWEST: usize = 3;
/// Share of the meeting points that may lie nearer or farther.
const TAIL: f64 = 0.1;
/// The surface may lie this much nearer or farther than the meeting points.
const FACTOR: f64 = 2.0;

/// A range for every view whose optical axis passes those of three others or more in front of both:
/// from half to twice the depths of the points of closest approach. With each range, how many axes.
pub fn focus_ranges(cameras: &BTreeMap<ViewId, Camera>) -> BTreeMap<ViewId, (DepthRange, usize)> {
    let of_view = |(id, camera): (&ViewId, &Camera)| {
        let others = cameras.iter().filter(|(other, _)| *other != id);
        let mut depths: Vec<f64> = others.filter_map(|(_, other)| meeting_depth(camera, other)).collect();
        if depths.len() < FEWEST {
            return None;
        }
        depths.sort_by(f64::total_cmp);
        let at = |share: f64| depths[((share * depths.len() as f64) as usize).min(depths.len() - 1)];
        let range = DepthRange { min: at(TAIL) / FACTOR, max: at(1.0 - TAIL) * FACTOR, count: None };
        Some((*id, (range, depths.len())))
    };
    cameras.par_iter().filter_map(of_view).collect()
}

/// The depth in `camera` of the point on its axis that is closest to the axis of `other`; `None` where
/// that lies behind either, or the axes are nearly parallel.
fn meeting_depth(camera: &Camera, other: &Camera) -> Option<f64> {
    let axis = |camera: &Camera| camera.pose.rotation.row(2).transpose();
    let (a, b) = (axis(camera), axis(other));
    let between = other.pose.centre() - camera.pose.centre();
    let (cosine, sine) = (a.dot(&b), a.cross(&b).norm());
    if sine < SMALLEST_ANGLE_DEG.to_radians().sin() {
        return None;
    }
    let (along_a, along_b) = (between.dot(&a), between.dot(&b));
    let depth = (along_a - cosine * along_b) / (sine * sine);
    let depth_other = (cosine * along_a - along_b) / (sine * sine);
    (depth > 0.0 && depth_other > 0.0 && depth.is_finite()).then_some(depth)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};
    use planesweep_scene::{Intrinsics, Pose};

    use super::*;

    fn camera(centre: Point3<f64>, target: Point3<f64>) -> Camera {
        let intrinsics =
            Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, skew: 0.0, cx: 31.5, cy: 23.5 };
        Camera { intrinsics, pose: Pose::look_at(&centre, &target, &Vector3::z()) }
    }

    fn on_a_circle(target: impl Fn(Point3<f64>) -> Point3<f64>) -> BTreeMap<ViewId, Camera> {
        let place = |k: u32| {
            let (y, x) = (0.5 * k as f64).sin_cos();
            let centre = Point3::new(4.0 * x, 4.0 * y, 0.1 * k as f64);
            (ViewId(k), camera(centre, target(centre)))
        };
        (0..12).map(place).collect()
    }

    #[test]
    fn cameras_around_an_object_get_a_range_around_it() {
        let ranges = focus_ranges(&on_a_circle(|_| Point3::new(0.0, 0.0, 0.5)));
        assert_eq!(ranges.len(), 12);
        for (range, count) in ranges.values() {
            assert!(range.min < 3.0 && range.max > 5.0 && range.min > 1.5 && range.max < 9.0, "{range:?}");
            assert!(*count >= 10);
        }
    }

    #[test]
    fn cameras_that_look_away_from_each_other_get_none() {
        assert!(focus_ranges(&on_a_circle(|centre| centre + 2.0 * centre.coords)).is_empty());
        assert!(focus_ranges(&on_a_circle(|centre| centre + Vector3::x())).is_empty());
    }
}
