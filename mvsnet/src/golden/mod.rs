//! Golden values: what PyTorch makes of the same input, stage by stage.

mod own_cases;
mod reference_case;

use tch::{Device, Kind, Tensor};

/// All values of a tensor.
fn values(tensor: &Tensor) -> Vec<f64> {
    let tensor = tensor.to_kind(Kind::Double).to_device(Device::Cpu).contiguous();
    let mut values = vec![0.0; tensor.numel()];
    tensor.copy_data(&mut values, tensor.numel());
    values
}

/// Absolute errors at the median, 99 %, 99.9 % and the maximum.
fn error_quantiles(values: &[f64], truth: &[f64]) -> [f64; 4] {
    assert_eq!(values.len(), truth.len());
    let mut errors: Vec<f64> = values.iter().zip(truth).map(|(value, truth)| (value - truth).abs()).collect();
    assert!(errors.iter().all(|error| error.is_finite()));
    errors.sort_by(f64::total_cmp);
    [0.5, 0.99, 0.999, 1.0].map(|share| errors[((errors.len() - 1) as f64 * share) as usize])
}

/// Asserts that ours is at most twice as far from the truth as the golden values are.
///
/// Both are f32 runs of the same formulas, so their rounding errors are two draws from one distribution;
/// twice is room for the draw, not for another formula.
fn assert_as_exact(what: &str, ours: &[f64], golden: &[f64], truth: &[f64]) {
    let (ours, golden) = (error_quantiles(ours, truth), error_quantiles(golden, truth));
    eprintln!("{what}: errors at the median, 99 %, 99.9 %, maximum: ours {ours:?}, golden {golden:?}");
    for (ours, golden) in ours.iter().zip(golden) {
        assert!(*ours <= 2.0 * golden, "{what}: {ours:e} is more than twice {golden:e}");
    }
}
