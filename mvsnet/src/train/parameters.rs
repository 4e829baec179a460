//! The values that training changes, by the names of the weights.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{AboutConfig, NetworkConfig};
use crate::weights::{fan_in, layout};
use crate::{WeightTensor, Weights, WeightsError, WeightsMetadata};

/// Tensors by name, such as weights, gradients or moments.
pub type Tensors = BTreeMap<String, WeightTensor>;

/// Whether a tensor is a statistic of batch normalisation, which no gradient changes.
pub(crate) fn is_statistic(name: &str) -> bool {
    name.ends_with("running_mean") || name.ends_with("running_var")
}

/// Whether a tensor is the kernel of a convolution.
pub(crate) fn is_kernel(tensor: &WeightTensor) -> bool {
    tensor.shape.len() > 1
}

/// What is known of weights in training.
pub(crate) fn metadata(
    network: NetworkConfig,
    about: &AboutConfig,
    spacing_px: Option<f64>,
) -> WeightsMetadata {
    WeightsMetadata {
        normalization: network.normalization,
        refinement: network.refinement,
        metric: network.metric,
        features: network.features,
        spacing_px,
        source: about.source.clone(),
        licence: about.licence.clone(),
        original_blake3: None,
    }
}

/// Weights to begin with: kernels uniform with the bound of He et al. (2015), batch normalisation the identity,
/// biases zero, and the refinement's last kernel small, so that refined depth begins as the initial one.
pub fn initial(network: NetworkConfig, seed: u64) -> Tensors {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let tensors = layout::tensors(&metadata(network, &AboutConfig::default(), None));
    let tensor = |(name, shape): (String, Vec<usize>)| {
        let len = shape.iter().product();
        let values = if shape.len() > 1 {
            let residual = if name.starts_with("refine_network.res") { 0.1 } else { 1.0 };
            let bound = (residual * (6.0 / fan_in(&name, &shape)).sqrt()) as f32;
            (0..len).map(|_| rng.random_range(-bound..=bound)).collect()
        } else {
            let one = name.ends_with("running_var") || name.ends_with(".weight");
            vec![if one { 1.0 } else { 0.0 }; len]
        };
        (name, WeightTensor { shape, values })
    };
    tensors.into_iter().map(tensor).collect()
}

/// Tensors of the same names and shapes, all zero.
pub(crate) fn zeros_like(tensors: &Tensors) -> Tensors {
    let zero = |t: &WeightTensor| WeightTensor { shape: t.shape.clone(), values: vec![0.0; t.values.len()] };
    tensors.iter().map(|(name, tensor)| (name.clone(), zero(tensor))).collect()
}

/// Checked weights of these tensors.
pub(crate) fn to_weights(metadata: WeightsMetadata, tensors: &Tensors) -> Result<Weights, WeightsError> {
    Weights::new(metadata, tensors.clone())
}
