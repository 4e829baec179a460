//! How many probabilities make the confidence (paper section 3.3).

use nalgebra::Point2;
use planesweep_scene::{Camera, DepthHypotheses};

use crate::InferInput;

/// Hypotheses whose probabilities make the confidence, unless they are finer than in training.
const CONFIDENCE_WINDOW: u32 = 4;

/// How many probabilities make the confidence of this input, for weights trained with hypotheses of this spacing, in
/// pixels of the best source view.
pub(crate) fn window_of(trained_px: Option<f64>, input: InferInput<'_>) -> u32 {
    input.sources.first().map_or(CONFIDENCE_WINDOW, |source| {
        let spacing_px = spacing_px(&input.reference.camera, &source.camera, input.hypotheses);
        widened(trained_px, spacing_px)
    })
}

/// How many probabilities make the confidence: those that cover as much of the source image as four
/// hypotheses did in training, and never fewer than four. Spacings are in pixels of the best source view.
fn widened(trained_px: Option<f64>, spacing_px: f64) -> u32 {
    let Some(trained_px) = trained_px.filter(|px| px.is_finite() && spacing_px > 0.0 && *px > spacing_px)
    else {
        return CONFIDENCE_WINDOW;
    };
    let half = f64::from(CONFIDENCE_WINDOW / 2) * trained_px / spacing_px;
    2 * half.round().clamp(2.0, 1024.0) as u32
}

/// How far one step in the middle of the hypotheses moves the centre of the reference image in the source, in
/// pixels of the source; zero when it is not seen there.
pub(crate) fn spacing_px(reference: &Camera, source: &Camera, hypotheses: &DepthHypotheses) -> f64 {
    let size = reference.intrinsics;
    let centre = Point2::new(f64::from(size.width - 1) / 2.0, f64::from(size.height - 1) / 2.0);
    let middle = f64::from(hypotheses.count() / 2);
    let seen = |index: f64| source.project(&reference.unproject(&centre, hypotheses.depth_at(index)));
    match (seen(middle - 1.0), seen(middle)) {
        (Some((near, _)), Some((far, _))) => (near - far).norm(),
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};
    use planesweep_scene::{Intrinsics, Pose, Sampling};

    use super::*;

    #[test]
    fn window_widens_with_finer_hypotheses_only() {
        assert_eq!(widened(None, 0.1), 4);
        assert_eq!(widened(Some(1.0), 1.5), 4);
        assert_eq!(widened(Some(1.0), 0.5), 8);
        assert_eq!(widened(Some(1.0), 0.7), 6);
        assert_eq!(widened(Some(1.0), 0.0), 4);
    }

    #[test]
    fn spacing_is_the_step_of_disparity() {
        let camera = |x| {
            let intrinsics =
                Intrinsics { width: 101, height: 81, fx: 100.0, fy: 100.0, skew: 0.0, cx: 50.0, cy: 40.0 };
            let pose = Pose::look_at(&Point3::new(x, 0.0, 0.0), &Point3::new(x, 0.0, 1.0), &-Vector3::y());
            Camera { intrinsics, pose }
        };
        // Disparity is focal length times baseline over depth: 100 * 0.5 * (1/2 - 1/4) over 10 steps.
        let hypotheses = DepthHypotheses::new(Sampling::Inverse, 2.0, 4.0, 11).expect("a valid range");
        assert!((spacing_px(&camera(0.0), &camera(0.5), &hypotheses) - 1.25).abs() < 1e-9);
    }
}
