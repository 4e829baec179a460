//! Depth and confidence from the probability over depth (paper section 3.3).

use nalgebra::Point2;
use planesweep_scene::{Camera, DepthHypotheses, Sampling};
use tch::{Kind, TchError, Tensor};

/// Hypotheses whose probabilities make the confidence, unless they are finer than in training.
pub(crate) const CONFIDENCE_WINDOW: u32 = 4;

/// Probabilities `[D, H, W]` from logits, over depth.
pub(crate) fn probability(logits: &Tensor) -> Result<Tensor, TchError> {
    logits.f_softmax(0, None)
}

/// The expected index of the hypothesis, `[H, W]`, f64. Depth (or inverse depth) is linear in it, so
/// this one expectation serves depth and confidence, with either sampling.
pub(crate) fn expected_index(probability: &Tensor) -> Result<Tensor, TchError> {
    let (planes, _, _) = probability.size3()?;
    let index =
        Tensor::f_arange(planes, (probability.kind(), probability.device()))?.f_view([planes, 1, 1])?;
    probability.f_mul(&index)?.f_sum_dim_intlist([0].as_slice(), false, Kind::Double)
}

/// Depth in scene units at fractional indices.
pub(crate) fn depth_at(index: &Tensor, hypotheses: &DepthHypotheses) -> Result<Tensor, TchError> {
    let steps = (hypotheses.count() - 1) as f64;
    let linear = |first: f64, last: f64| index.f_mul_scalar((last - first) / steps)?.f_add_scalar(first);
    match hypotheses.sampling() {
        Sampling::Uniform => linear(hypotheses.min(), hypotheses.max()),
        Sampling::Inverse => linear(1.0 / hypotheses.min(), 1.0 / hypotheses.max())?.f_reciprocal(),
    }
}

/// The sum of the `window` probabilities around the expected index `E`: from `floor(E) - window / 2 + 1`
/// to `floor(E) + window / 2`, zero outside the volume; `window` is even.
pub(crate) fn confidence(probability: &Tensor, index: &Tensor, window: u32) -> Result<Tensor, TchError> {
    let planes = probability.size()[0];
    let window = window as i64;
    let padded = probability.f_constant_pad_nd([0, 0, 0, 0, window / 2 - 1, window / 2])?;
    let first = index.f_floor()?.f_to_kind(Kind::Int64)?.f_clamp(0, planes - 1)?;
    let offsets = Tensor::f_arange(window, (Kind::Int64, index.device()))?.f_view([window, 1, 1])?;
    let indices = first.f_unsqueeze(0)?.f_add(&offsets)?;
    padded.f_gather(0, &indices, false)?.f_sum_dim_intlist([0].as_slice(), false, None)
}

/// How many probabilities make the confidence: those that cover as much of the source image as four
/// hypotheses did in training, and never fewer than four. Spacings are in pixels of the best source view.
pub(crate) fn confidence_window(trained_px: Option<f64>, spacing_px: f64) -> u32 {
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
    use planesweep_scene::{Intrinsics, Pose};
    use tch::Device;

    use super::*;

    /// Probabilities of one pixel.
    fn pixel(probability: &[f64]) -> Tensor {
        Tensor::from_slice(probability).view([-1, 1, 1])
    }

    #[test]
    fn expectation_is_over_depth_or_over_inverse_depth() {
        let index = expected_index(&pixel(&[0.5, 0.0, 0.5])).expect("an expectation");
        let depth = |sampling| {
            let hypotheses = DepthHypotheses::new(sampling, 2.0, 6.0, 3).expect("a valid range");
            depth_at(&index, &hypotheses).expect("a depth").double_value(&[0, 0])
        };
        assert!((depth(Sampling::Uniform) - 4.0).abs() < 1e-12);
        assert!((depth(Sampling::Inverse) - 3.0).abs() < 1e-12);
    }

    #[test]
    fn confidence_is_the_sum_around_the_expectation_and_zero_outside() {
        let p = [0.05, 0.1, 0.2, 0.3, 0.2, 0.1, 0.05];
        let at = |index: f64, window| {
            let index = Tensor::full([1, 1], index, (Kind::Double, Device::Cpu));
            confidence(&pixel(&p), &index, window).expect("a confidence").double_value(&[0, 0])
        };
        assert!((at(3.4, 4) - 0.8).abs() < 1e-12);
        assert!((at(2.9, 4) - 0.8).abs() < 1e-12);
        assert!((at(3.4, 6) - 0.95).abs() < 1e-12);
        assert!((at(0.0, 4) - 0.35).abs() < 1e-12);
        assert!((at(6.0, 4) - 0.15).abs() < 1e-12);
    }

    #[test]
    fn window_widens_with_finer_hypotheses_only() {
        assert_eq!(confidence_window(None, 0.1), 4);
        assert_eq!(confidence_window(Some(1.0), 1.5), 4);
        assert_eq!(confidence_window(Some(1.0), 0.5), 8);
        assert_eq!(confidence_window(Some(1.0), 0.7), 6);
        assert_eq!(confidence_window(Some(1.0), 0.0), 4);
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
