//! The depth range of a view and the number and spacing of its hypotheses.

use nalgebra::Point3;
use planesweep_scene::{Camera, DepthHypotheses, DepthRange, HypothesesError, Sampling};

use crate::options::{MAX_DEPTHS, MIN_DEPTHS, SamplingChoice};
use crate::views::frustum_points;

/// Share of the points that may lie nearer than the range, and farther.
const TAIL: f64 = 0.01;
/// How much the range is widened at each end, as a share of its extent: the surface between sparse
/// points may lie a little nearer or farther than they do.
const MARGIN: f64 = 0.05;
/// Fewer points than this say nothing about the range.
pub const MIN_POINTS: usize = 20;
/// Hypotheses come in multiples of this, because the network halves the depth axis three times.
pub const DEPTH_MULTIPLE: u32 = 8;
/// More hypotheses than this are not taken from any file.
pub const MOST_DEPTHS: u32 = 4096;
/// From this ratio of the far to the near end on, inverse sampling is chosen.
const INVERSE_FROM_RATIO: f64 = 3.0;

/// The robust range of depths (z, scene units): 1st to 99th percentile, widened by a margin.
///
/// `None` with fewer than [`MIN_POINTS`] positive depths.
pub fn robust_range(mut depths: Vec<f64>) -> Option<DepthRange> {
    depths.retain(|depth| depth.is_finite() && *depth > 0.0);
    if depths.len() < MIN_POINTS {
        return None;
    }
    depths.sort_by(f64::total_cmp);
    let at = |share: f64| depths[((share * depths.len() as f64) as usize).min(depths.len() - 1)];
    let (near, far) = (at(TAIL), at(1.0 - TAIL));
    // A flat scene seen head-on has no extent; a thousandth of its depth stands in for it.
    let extent = (far - near).max(1e-3 * far);
    // For wide ranges five per cent of the extent would reach behind the camera: never take more
    // than five per cent of the near depth itself.
    Some(DepthRange { min: near - MARGIN * extent.min(near), max: far + MARGIN * extent, count: None })
}

/// How hypotheses over a range are spaced when the user did not say.
pub fn choose_sampling(choice: SamplingChoice, range: &DepthRange) -> Sampling {
    match choice {
        SamplingChoice::Inverse => Sampling::Inverse,
        SamplingChoice::Auto if range.max / range.min > INVERSE_FROM_RATIO => Sampling::Inverse,
        SamplingChoice::Auto | SamplingChoice::Uniform => Sampling::Uniform,
    }
}

/// The hypotheses of a view: `depths` of them if given, else what the range says, else as many as
/// make one step move one pixel of the working image in the best source view.
///
/// `points` are the view's sparse points (world); without any, the frustum is sampled. `source` is
/// the working camera of the best source view.
pub fn hypotheses(
    reference: &Camera,
    source: &Camera,
    points: &[Point3<f64>],
    range: &DepthRange,
    sampling: Sampling,
    depths: Option<u32>,
) -> Result<DepthHypotheses, HypothesesError> {
    // With two planes an index is a share of the range.
    let ends = DepthHypotheses::new(sampling, range.min, range.max, 2)?;
    let count = depths.or(range.count).unwrap_or_else(|| {
        let from_frustum;
        let points = if points.is_empty() {
            from_frustum = frustum_points(reference, range);
            &from_frustum
        } else {
            points
        };
        let mut steps: Vec<f64> =
            points.iter().filter_map(|point| pixels_per_range(reference, source, point, &ends)).collect();
        if steps.is_empty() {
            return MIN_DEPTHS;
        }
        steps.sort_by(f64::total_cmp);
        let pixels = steps[steps.len() / 2].round().clamp(MIN_DEPTHS as f64, MAX_DEPTHS as f64);
        pixels as u32
    });
    DepthHypotheses::new(
        sampling,
        range.min,
        range.max,
        count.min(MOST_DEPTHS).next_multiple_of(DEPTH_MULTIPLE),
    )
}

/// How many pixels of the source image the whole range would span, at the rate at which the
/// projection of `point` moves when its depth in the reference does.
fn pixels_per_range(
    reference: &Camera,
    source: &Camera,
    point: &Point3<f64>,
    ends: &DepthHypotheses,
) -> Option<f64> {
    const STEP: f64 = 1e-4;
    let (pixel, depth) = reference.project(point)?;
    let moved_depth = ends.depth_at(ends.index_of(depth) + STEP);
    let (here, _) = source.project(point)?;
    let (there, _) = source.project(&reference.unproject(&pixel, moved_depth))?;
    Some((there - here).norm() / STEP)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use planesweep_scene::{Intrinsics, Pose};

    use super::*;

    fn camera(x: f64) -> Camera {
        let intrinsics =
            Intrinsics { width: 200, height: 100, fx: 100.0, fy: 100.0, skew: 0.0, cx: 99.5, cy: 49.5 };
        let ahead = Point3::new(x, 0.0, 1.0);
        Camera { intrinsics, pose: Pose::look_at(&Point3::new(x, 0.0, 0.0), &ahead, &-Vector3::y()) }
    }

    #[test]
    fn outliers_and_points_behind_the_camera_do_not_widen_the_range() {
        let mut depths: Vec<f64> = (0..1000).map(|k| 10.0 + 0.01 * k as f64).collect();
        depths.extend([-5.0, 0.0, f64::NAN, f64::INFINITY, 1e-9, 1e6]);
        let range = robust_range(depths).expect("a thousand points");
        assert!((range.min - (10.1 - 0.05 * 9.8)).abs() < 0.05, "{range:?}");
        assert!((range.max - (19.9 + 0.05 * 9.8)).abs() < 0.05, "{range:?}");
        assert_eq!(robust_range(vec![1.0; MIN_POINTS - 1]), None);
    }

    #[test]
    fn a_wide_range_stays_in_front_of_the_camera_and_a_flat_one_is_not_empty() {
        let wide = robust_range((1..=100).map(|k| (k * k) as f64).collect()).expect("enough points");
        assert!(wide.min > 0.9 * 4.0);
        let flat = robust_range(vec![2.0; 50]).expect("enough points");
        assert!(flat.min < 2.0 && flat.max > 2.0);
    }

    #[test]
    fn one_inverse_step_moves_one_pixel() {
        // Sideways by b, disparity is f b / z: over 1/2 to 1/10 that is 100 b 0.4 pixels.
        let (reference, source) = (camera(0.0), camera(5.0));
        let range = DepthRange { min: 2.0, max: 10.0, count: None };
        let points: Vec<_> = (0..9).map(|k| Point3::new(0.1 * k as f64, 0.0, 3.0)).collect();
        let h = hypotheses(&reference, &source, &points, &range, Sampling::Inverse, None).expect("valid");
        assert_eq!(h.count(), 200);
        let fixed = hypotheses(&reference, &source, &points, &range, Sampling::Inverse, Some(99));
        assert_eq!(fixed.expect("valid").count(), 104);
        let stated = DepthRange { count: Some(192), ..range };
        let h = hypotheses(&reference, &source, &points, &stated, Sampling::Uniform, None).expect("valid");
        assert_eq!(h.count(), 192);
    }

    #[test]
    fn the_count_is_bounded_and_zero_baseline_is_harmless() {
        let range = DepthRange { min: 2.0, max: 10.0, count: None };
        let same = hypotheses(&camera(0.0), &camera(0.0), &[], &range, Sampling::Inverse, None);
        assert_eq!(same.expect("valid").count(), MIN_DEPTHS);
        let far = hypotheses(&camera(0.0), &camera(500.0), &[], &range, Sampling::Inverse, None);
        assert_eq!(far.expect("valid").count(), MAX_DEPTHS);
    }

    #[test]
    fn auto_turns_inverse_beyond_a_ratio_of_three() {
        let range = |max| DepthRange { min: 1.0, max, count: None };
        assert_eq!(choose_sampling(SamplingChoice::Auto, &range(2.9)), Sampling::Uniform);
        assert_eq!(choose_sampling(SamplingChoice::Auto, &range(3.1)), Sampling::Inverse);
        assert_eq!(choose_sampling(SamplingChoice::Uniform, &range(30.0)), Sampling::Uniform);
    }
}
