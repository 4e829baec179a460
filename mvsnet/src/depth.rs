//! Depth and confidence from the probability over depth (paper section 3.3).

use planesweep_scene::{DepthHypotheses, Sampling};
use tch::{Kind, TchError, Tensor};

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

#[cfg(test)]
mod tests {
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
}
