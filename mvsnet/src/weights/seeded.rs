//! Untrained weights from a seed, the same everywhere, so that tests need no files.

use super::{CostMetric, FeatureNetwork, Normalization, Refinement, Weights, WeightsMetadata, layout};
use crate::weights::WeightTensor;

impl WeightsMetadata {
    /// Metadata of weights that were never trained, with the variance metric and images from 0 to 1.
    pub fn untrained(refinement: Refinement) -> Self {
        Self {
            normalization: Normalization::UnitRange,
            refinement,
            metric: CostMetric::Variance,
            features: FeatureNetwork::Paper,
            spacing_px: None,
            source: "seed".to_owned(),
            licence: "none needed".to_owned(),
            original_blake3: None,
        }
    }
}

impl Weights {
    /// Untrained weights for tests and benches. Kernels are uniform with He's bound, so that signals keep
    /// their magnitude from layer to layer; statistics are within a factor of two of one.
    ///
    /// The values come from splitmix64 over the tensors in the order of their names and are exact, so
    /// any other program can make the same ones (`tests/golden/make_golden.py` does).
    pub fn seeded(metadata: WeightsMetadata, seed: u64) -> Self {
        let mut state = seed;
        let tensors = layout::tensors(&metadata)
            .into_iter()
            .map(|(name, shape)| {
                let (low, high) = range(&name, &shape);
                let len = shape.iter().product();
                let values = (0..len).map(|_| (low + (high - low) * uniform(&mut state)) as f32).collect();
                (name, WeightTensor { shape, values })
            })
            .collect();
        Self { metadata, tensors }
    }
}

/// The interval a tensor's values are drawn from.
fn range(name: &str, shape: &[usize]) -> (f64, f64) {
    if shape.len() > 1 {
        let bound = (6.0 / fan_in(name, shape)).sqrt();
        // Residuals are small, so that refined depth stays in the range.
        let bound = if name.starts_with("refine_network.res") { 0.1 * bound } else { bound };
        (-bound, bound)
    } else if name.ends_with("running_var") || name.ends_with("bn.weight") || name.ends_with(".1.weight") {
        (0.5, 1.5)
    } else {
        (-0.2, 0.2)
    }
}

/// How many products make an output of the convolution with this kernel, on average.
pub(crate) fn fan_in(name: &str, shape: &[usize]) -> f64 {
    let transposed = name.ends_with(".0.weight");
    let inputs = if transposed { shape[0] } else { shape[1] };
    let fan_in = (inputs * shape[2..].iter().product::<usize>()) as f64;
    // A stride of two leaves an output of a transposed layer an eighth of the taps.
    if transposed { fan_in / 8.0 } else { fan_in }
}

/// The next number of [0, 1), a multiple of 2^-24.
pub(crate) fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^= z >> 31;
    (z >> 40) as f64 / (1u64 << 24) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_differ_and_repeat() {
        let make = |seed| Weights::seeded(WeightsMetadata::untrained(Refinement::WithBnRelu), seed);
        assert_eq!(make(1), make(1));
        assert_ne!(make(1), make(2));
        assert!(Weights::new(make(3).metadata, make(3).tensors).is_ok());
    }

    #[test]
    fn generator_is_splitmix64() {
        // The first output of splitmix64 from state 0 is e220a8397b1dcdaf.
        assert_eq!(uniform(&mut 0), 0xe220a8 as f64 / 16_777_216.0);
    }
}
